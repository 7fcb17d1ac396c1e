"""Slot likelihoods for a picture that is known from earlier frames.

Strip s of column c receives on a row z = black level + T * sum over k of K[s, k] * m[c + k], with T the picture, K the
crosstalk and m the exposure-averaged slots of the columns (see `channel`). In a clip T is estimated from earlier
frames. The m of all columns on a row then solve a small linear system, for all rows at once. This removes crosstalk,
weights strips by their information, and gives each column as a single series with a precision.

`picture` estimates T, `equations` solves for m, `exposure` applies the exposure to slots, `response` fits the effect of
compression, `header` measures the contrast of headers, and `metrics` computes slot log-likelihoods.
"""

from rxcli.receiver.channel.known_picture.exposure import Response, expected_light, row_positions
from rxcli.receiver.channel.known_picture.header import first_decision, header_contrast
from rxcli.receiver.channel.known_picture.metrics import slot_likelihoods
from rxcli.receiver.channel.known_picture.picture import ColumnLight, KnownPicture, Observation, PlacedPicture, Update
from rxcli.receiver.channel.known_picture.response import fit_response

__all__ = [
    "ColumnLight",
    "KnownPicture",
    "Observation",
    "PlacedPicture",
    "Response",
    "Update",
    "expected_light",
    "first_decision",
    "fit_response",
    "header_contrast",
    "row_positions",
    "slot_likelihoods",
]
