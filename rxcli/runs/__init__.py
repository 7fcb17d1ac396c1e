"""Many sources in one run: worker processes, journals that survive a kill, clusters."""
