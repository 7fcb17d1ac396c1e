"""Slots through a picture that is known from the frames before.

What strip s of column c sees on a row is z = floor + T * sum over k of K[s, k] * m[c + k], with T the picture, K the
light spread and m the exposure-averaged slots of the columns (see `channel`). In a clip T is known: the sum over
frames of z against what was expected. Then all columns' m of a row are one small linear system, solved for all rows at
once: no crosstalk is left, strips are pooled by what they tell, and every column is a single series with a precision.

`picture` learns and solves, `exposure` says what slots give through an exposure, `response` what compression leaves of
it, `header` where headers show, and `metrics` makes of it all the likelihoods of slots that detection needs.
"""

from rxcli.receiver.channel.known_picture.exposure import expected_light, row_positions, trusted
from rxcli.receiver.channel.known_picture.header import dark_light, first_decision, header_contrast, header_dark
from rxcli.receiver.channel.known_picture.metrics import slot_likelihoods
from rxcli.receiver.channel.known_picture.picture import ColumnLight, KnownPicture, Look, Placement
from rxcli.receiver.channel.known_picture.response import Fit, exposures, fit_response

__all__ = [
    "ColumnLight",
    "Fit",
    "KnownPicture",
    "Look",
    "Placement",
    "dark_light",
    "expected_light",
    "exposures",
    "first_decision",
    "fit_response",
    "header_contrast",
    "header_dark",
    "row_positions",
    "slot_likelihoods",
    "trusted",
]
