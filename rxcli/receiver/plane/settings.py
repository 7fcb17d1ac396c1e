"""Settings for reading light from pixels."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class PlaneSettings:
    """Each with its unit and the reason for it."""

    #: Minimum number of cells of a row: several for every strip of a hundred columns.
    min_cells: int = 1500
    #: Minimum number of cells of a row of a picture rotated by 90 degrees: it is searched for wide columns only.
    turned_cells: int = 400
    #: Width of a strip in pixels from which a column is divided further, and maximum number of strips of a column.
    strip_px: int = 12
    max_strips: int = 8
    #: The noise model compares neighbouring parts of a strip, because denoising correlates neighbouring pixels: parts
    #: per strip, rows it is fitted to, and bins of equal light.
    parts_per_strip: int = 4
    noise_rows: int = 20
    noise_bins: int = 24
    #: Row spacing at which the pixels of a strip are counted.
    count_row_step: int = 16
    #: Minimum distance of two edges, in cells, at which light is measured between them.
    min_enclosed: float = 0.02


SETTINGS = PlaneSettings()
