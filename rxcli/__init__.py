"""Receiver for data sent by the mini-LED backlight of a liquid crystal display."""

__version__ = "0.1.0"
