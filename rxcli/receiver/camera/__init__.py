"""What a picture says of the camera that took it: rows per slot, direction of readout, exposure, bend of the stripes.

`propose` yields hypotheses from the light alone, best first; the wiring receives with each and decides. `settle` fits
one to the slots that were decoded with it. docs/blind.md explains both.
"""

from rxcli.receiver.camera.advice import stripe_likeness, why_not
from rxcli.receiver.camera.camera import camera_profile, in_time_order, is_linear, lens_of, summary
from rxcli.receiver.camera.columns import columns_misfit
from rxcli.receiver.camera.curvature import curvature_terms, estimate_curvature, straightened
from rxcli.receiver.camera.fit import settle
from rxcli.receiver.camera.proposals import CameraHypothesis, propose
from rxcli.receiver.camera.strips import Strips, joined, levelled, strips_of
from rxcli.receiver.camera.structure import structure_llr

__all__ = [
    "CameraHypothesis",
    "Strips",
    "camera_profile",
    "columns_misfit",
    "curvature_terms",
    "estimate_curvature",
    "in_time_order",
    "is_linear",
    "joined",
    "lens_of",
    "levelled",
    "propose",
    "settle",
    "straightened",
    "stripe_likeness",
    "strips_of",
    "structure_llr",
    "summary",
    "why_not",
]
