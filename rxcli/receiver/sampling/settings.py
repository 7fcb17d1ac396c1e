"""Numbers of policy of reading light from pixels."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SamplingSettings:
    """Each with its unit and the reason for it."""

    #: Pixels that a strip should have before a column gets another one, and strips of a column at most.
    strip_px: int = 12
    max_strips: int = 8
    #: Cells that a strip should have, so that the fractions at its slanted edges are fine.
    cells_per_strip: int = 4
    #: One row in this many is kept for the noise model, and of those as many as hold this many cells, which are sorted
    #: into so many bins by their light.
    noise_row_step: int = 16
    noise_cells: int = 10_000
    noise_bins: int = 24
    #: Edges that enclose less than this many values have no light between them.
    min_enclosed: float = 0.1

    #: Edges that are this near, pixels, enclose the same light.
    same_edges_px: float = 0.02

    #: Of clips: cells of a strip, about; of a picture of more than 8 bits, the part of a strip that is one cell.
    tracked_cells: int = 5
    tracked_cell_share: float = 0.6
    #: Width of strips, pixels, from which cells are whole half words: narrower ones would show what is beside them.
    from_halves_px: float = 12.0


SETTINGS = SamplingSettings()
