"""Where a picture's columns lie on the screen, as far as the picture leaves it open: check sums decide."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rxcli.link.softbits import information
from rxcli.types import ColumnResult, FloatArray, FrameResult, MessageKind, Remark

#: Largest shift that is tried, columns; and information from which a column is one of the screen's, relative to that of
#: the column with the most.
_MAX_SHIFT, _MIN_INFORMATION = 6, 0.25


@dataclass(frozen=True, slots=True)
class Placement:
    """A hypothesis of where columns lie on the screen."""

    #: Whether columns count from the opposite side.
    mirrored: bool = False
    #: Columns that are added to the numbers after that.
    shift: int = 0

    def of(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values of the picture's columns (..., C, 7) as those of the screen's, 0 for columns beyond the picture's."""
        values = values[..., ::-1, :] if self.mirrored else values
        if not self.shift:
            return values
        out, n_columns = np.zeros_like(values), values.shape[-2]
        left, right = max(self.shift, 0), max(-self.shift, 0)
        out[..., left : n_columns - right, :] = values[..., right : n_columns - left, :]
        return out

    def after(self, before: Placement) -> Placement:
        """The placement that first places by `before`, then by this one."""
        shift = -before.shift if self.mirrored else before.shift
        return Placement(self.mirrored != before.mirrored, self.shift + shift)

    @property
    def inverse(self) -> Placement:
        """The placement that undoes this one."""
        return Placement(self.mirrored, self.shift if self.mirrored else -self.shift)


class Found(NamedTuple):
    """A decoded message, with the placement of the columns and the sources that were added up for it."""

    content: tuple[MessageKind, bytes]
    placement: Placement
    sources: tuple[str, ...]


def possible_placements(llr: NDArray[np.floating]) -> list[list[Placement]]:
    """Hypotheses in groups, likeliest first: as numbered, mirrored, shifted.

    No shift leaves out a column that carries bits.

    Args:
        llr: (..., C, 7) log-likelihood ratios.
    """
    bits = information(llr).sum(axis=(*range(llr.ndim - 2), -1))
    lit = np.flatnonzero(bits > _MIN_INFORMATION * bits.max())
    room = (int(lit[0]), int(bits.size - 1 - lit[-1])) if lit.size else (0, 0)
    shifts = [
        Placement(mirrored, shift)
        for mirrored, (left, right) in ((False, room), (True, room[::-1]))
        for shift in range(-min(left, _MAX_SHIFT), min(right, _MAX_SHIFT) + 1)
    ]
    return [list(group) for _, group in groupby(sorted(shifts, key=_order), key=_order)]


def _order(placement: Placement) -> tuple[bool, bool]:
    return placement.shift != 0, not placement.shift and placement.mirrored


def placed(result: FrameResult, placement: Placement, n_columns: int) -> FrameResult:
    """Number the `n_columns` columns of a screen as a decoded message shows; the numbers are then certain."""
    remarks = tuple(remark for remark in result.remarks if remark.reason != "column_numbers")
    certainty, shift = result.column_certainty, placement.shift
    result = result.with_columns_mirrored() if placement.mirrored else replace(result, mirrored=bool(result.mirrored))
    columns, corners = result.columns, result.corners
    if certainty < 1:
        sure = ([replace(p, confidence=min(p.confidence / certainty, 1.0)) for p in c.packets] for c in columns)
        columns = tuple(replace(c, packets=tuple(packets)) for c, packets in zip(columns, sure, strict=True))
    if shift and n_columns > 1:
        by_number = {c.column + shift: replace(c, column=c.column + shift) for c in columns}
        unread = [ColumnResult(number, "no_packet", remark=Remark("not_read")) for number in range(n_columns)]
        columns = tuple(by_number.get(column.column, column) for column in unread) if columns else ()
        corners = None if corners is None else _moved(corners, -shift / n_columns)
    return replace(result, columns=columns, corners=corners, remarks=remarks, column_certainty=1.0, column_offset=0)


def _moved(corners: FloatArray, share: float) -> FloatArray:
    """Corners of the outline beside another one, by a share of its width."""
    import cv2

    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    to_picture = cv2.getPerspectiveTransform(unit, corners.astype(np.float32))
    beside = unit + np.array([share, 0], np.float32)
    return np.asarray(cv2.perspectiveTransform(beside[None], to_picture)[0], np.float64)
