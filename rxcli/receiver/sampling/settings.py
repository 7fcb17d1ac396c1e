"""Numbers of policy of reading light from pixels."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SamplingSettings:
    """Each with its unit and the reason for it."""

    #: Of clips: cells of a strip, about; of a picture of more than 8 bits, the part of a strip that is one cell.
    tracked_cells: int = 5
    tracked_cell_share: float = 0.6
    #: Width of strips, pixels, from which cells are whole half words: narrower ones would show what is beside them.
    from_halves_px: float = 12.0


SETTINGS = SamplingSettings()
