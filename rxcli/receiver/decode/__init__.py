"""Slots to symbols (`detect`), and symbols to packets with their confidence (`assemble`)."""
