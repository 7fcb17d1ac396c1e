"""Numbers of policy of reading light from pixels."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PlaneSettings:
    """Each with its unit and the reason for it."""

    #: Cells that a row should have at least: some for every strip of a hundred columns.
    min_cells: int = 1500
    #: Pixels that a strip should have before a column gets another one, and strips of a column at most.
    strip_px: int = 12
    max_strips: int = 8
    #: The noise model compares neighbouring parts of a strip, of so many: denoised pixels are alike. Rows that it is
    #: fitted to, and bins of equal light that their parts are sorted into.
    parts_per_strip: int = 4
    noise_rows: int = 20
    noise_bins: int = 24
    #: One row in this many says how many pixels a strip has.
    count_row_step: int = 16
    #: Smallest distance of two edges, cells, that have light between them.
    min_enclosed: float = 0.02


SETTINGS = PlaneSettings()
