"""Pixels to row profiles: each pixel of a frame is read once, into a plane from which profiles are sampled."""

from rxcli.receiver.plane.colour import in_blinking_colours, in_one_mix, may_lag, red_contrast
from rxcli.receiver.plane.read import read_plane, turned
from rxcli.receiver.plane.row_noise import RowNoise, find_row_noise, without_row_noise
from rxcli.receiver.plane.rows import sample_rows, strips_per_column, tone_to_light
from rxcli.receiver.plane.texture import CommonTexture, shows_same

__all__ = [
    "CommonTexture",
    "RowNoise",
    "find_row_noise",
    "in_blinking_colours",
    "in_one_mix",
    "may_lag",
    "read_plane",
    "red_contrast",
    "sample_rows",
    "shows_same",
    "strips_per_column",
    "tone_to_light",
    "turned",
    "without_row_noise",
]
