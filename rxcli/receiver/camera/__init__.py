"""Estimates of the camera from a picture: rows per slot, direction of readout, exposure, bend of the stripes.

`propose` yields hypotheses from the light alone, best first; the wiring receives with each and decides. `settle` fits
one to the slots that were decoded with it. docs/blind.md explains both.
"""

from rxcli.receiver.camera.advice import why_not
from rxcli.receiver.camera.camera import camera_profile, in_time_order, lens_of, summary
from rxcli.receiver.camera.curvature import curvature_terms
from rxcli.receiver.camera.fit import settle
from rxcli.receiver.camera.proposals import CameraHypothesis, in_phase, propose, propose_slots
from rxcli.receiver.camera.stripes import Stripes
from rxcli.receiver.camera.strips import ColumnStrips, strips_of

__all__ = [
    "CameraHypothesis",
    "ColumnStrips",
    "Stripes",
    "camera_profile",
    "curvature_terms",
    "in_phase",
    "in_time_order",
    "lens_of",
    "propose",
    "propose_slots",
    "settle",
    "strips_of",
    "summary",
    "why_not",
]
