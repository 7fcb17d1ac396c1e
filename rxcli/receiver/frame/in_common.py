"""Name what a screen sends first in a laboratory: the same in all columns, or one column alone. Part of the wiring."""

from collections import Counter
from dataclasses import replace

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile
from rxcli.types import ColumnResult, FrameResult, Remark

#: Smallest number of columns that can send the same: a lit one is seen in both its neighbours.
_MIN_COLUMNS = 4
#: Width over height of an outline, as a share of the screen's, below which it is that of one column.
_ONE_COLUMN = 0.3
#: Share of the sending columns that have a packet in common where all send the same: some may be received wrong.
_COMMON = 0.75


def named(result: FrameResult, options: ReceiverOptions) -> FrameResult:
    """The result with a remark where all columns send the same, or one alone."""
    screen = next((screen for screen in options.screens if screen.name == result.screen_profile), None)
    sending = [column for column in result.columns if any(packet.is_believable for packet in column.packets)]
    if screen is None or screen.columns < _MIN_COLUMNS or not sending:
        return result
    payloads = Counter(packet.payload for column in sending for packet in column.packets)
    if max(payloads.values()) < _COMMON * len(sending):
        return result
    number = sending[0].column
    if options.corners is None and _is_one_column(result, screen):
        best = max(sending, key=lambda column: max(packet.confidence for packet in column.packets))
        result, remark = replace(result, columns=(replace(best, column=0),), status="ok"), Remark("one_column")
    elif len(sending) == 1 and all(_is_unlit(column) for column in result.columns if column.column != number):
        remark = Remark("column_alone", {"column": number})
    elif len(sending) >= _MIN_COLUMNS:
        remark = Remark("all_the_same")
    else:
        return result
    # The numbers of equal columns do not matter, and that of a column alone does not show.
    remarks = tuple(known for known in result.remarks if known.reason != "column_numbers")
    return replace(result, remarks=(*remarks, remark))


def _is_one_column(result: FrameResult, screen: ScreenProfile) -> bool:
    if result.corners is None:
        return False
    top, side = np.diff(result.corners[:3], axis=0)
    return bool(np.linalg.norm(top) < _ONE_COLUMN * screen.aspect * np.linalg.norm(side))


def _is_unlit(column: ColumnResult) -> bool:
    return column.status == "dark" or column.reason == "echo"
