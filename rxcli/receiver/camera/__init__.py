"""Estimates of the camera from a picture: rows per slot, direction of readout, exposure, bend of the stripes.

`propose` yields hypotheses from the light alone, best first; the wiring receives with each and decides. `settle` fits
one to the slots that were decoded with it. docs/blind.md explains both.
"""
