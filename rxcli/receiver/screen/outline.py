"""Where a screen is in a picture."""

from dataclasses import dataclass, field
from typing import Any

from rxcli.receiver.screen.grid import Grid
from rxcli.receiver.screen.strips import PictureStrips
from rxcli.types import FloatArray, Lens


@dataclass(frozen=True, slots=True)
class Outline:
    """Location of the screen in the picture: given, or proposed by the finder."""

    #: (4, 2) pixels of the stored picture; the finder's begin at the screen's top left there, others at the viewer's.
    corners: FloatArray
    #: Probability that its columns are numbered as the screen's.
    certainty: float = 1.0
    #: Sides of the stored picture that show no light.
    inferred: tuple[str, ...] = ()
    #: Screen number of the first column; None if it is uncertain or columns are counted from the left of the visible
    #: ones.
    column_offset: int | None = 0
    #: Log-odds of its first column and number of columns relative to the likeliest of its grid.
    log_odds: float = 0.0
    #: Outlines of one family differ only in the first column.
    family: int = 0
    #: Log-odds of its grid of columns relative to the likeliest one.
    rival_odds: float = 0.0
    #: Whether light reaches to both ends of the picture, so that no side of the screen is in view.
    fills: bool = False
    #: Whether the columns' borders stand out by more than chance; if not, only packets show that it is a screen.
    stands_out: bool = True
    #: Number of columns; None if it was not determined.
    n_columns: int | None = None
    #: Strips of the picture on which it was found, and their columns, numbered from the screen's first; None where it
    #: was given.
    strips: PictureStrips | None = field(default=None, repr=False, compare=False)
    grid: Grid | None = field(default=None, repr=False, compare=False)

    @property
    def lens(self) -> Lens | None:
        """Estimated lens that bends the columns; used where the camera has no known lens."""
        return self.grid.estimated_lens if self.grid else None

    @property
    def contrast(self) -> float:
        """Log-likelihood by which its columns' borders stand out; 0 where it was given."""
        return self.grid.contrast if self.grid else 0.0

    @property
    def result_fields(self) -> dict[str, Any]:
        """Fields of a result, by name."""
        return {
            "corners": self.corners,
            "column_certainty": self.certainty,
            "inferred_sides": self.inferred,
            "column_offset": self.column_offset,
        }
