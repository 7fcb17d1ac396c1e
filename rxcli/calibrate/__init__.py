"""Measuring a camera: lens distortion from boards, line delay from blinking lamps, lens data from lensfun."""
