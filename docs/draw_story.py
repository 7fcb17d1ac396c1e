"""Draw docs/story.jpg, the first picture of the README: from a photo to payloads.

    python docs/draw_story.py docs/story.jpg

The photo is simulated. Its screen sends `MESSAGE` as raw payloads in ASCII, 77 bits per column from left to right. The
link layer sends texts differently: coded, and spread over all columns.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import rxcli
from rxcli.cli.main import run
from rxcli.protocol import HEADER, hex_to_bits

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: 192 bytes fill the 20 columns of one burst. Column 8 starts with byte 77.
MESSAGE = (
    b"A backlight can talk. It flickers too fast for the eye while the screen shows".ljust(77)
    + b"any picture you like. A rolling-shutter camera sees the flicker as stripes, and vlc-rx reads them."
)
COLUMN, SYMBOLS = 8, 4
_BLUE, _ORANGE, _GREY = "#1f5fa8", "#e8862a", "#888888"


def photo(folder: Path) -> rxcli.Frame:
    """A phone's photo of the screen, simulated."""
    (folder / "message.txt").write_bytes(MESSAGE.ljust(192))
    arguments = ["simulate", str(folder / "photo.jpg"), "--preset", "phone-plain", "--screen", "paper-17k3"]
    arguments += ["--picture", "chelsea", "--payload", str(folder / "message.txt"), "--start-slot", "2", "--seed", "4"]
    assert run(arguments) == 0
    return next(iter(rxcli.open_source(folder / "photo.jpg")))


def draw(frame: rxcli.Frame) -> Figure:
    """Photo; stripes, light, slots and bits of one column; the payloads of all columns."""
    result, taps = rxcli.tap(frame)
    assert taps is not None
    figure = Figure(figsize=(13, 6.6), layout="constrained")
    grid = figure.add_gridspec(6, 2, width_ratios=(1, 1.75), height_ratios=(1.0, 1.5, 0.5, 0.5, 0.55, 0.75))
    rows = _rows(taps)
    _draw_photo(figure.add_subplot(grid[:5, 0]), frame, taps, rows)
    parts = [figure.add_subplot(grid[number, 1]) for number in range(5)]
    _draw_stripes(parts[0], frame, taps, rows)
    _draw_light(parts[1], taps, rows)
    _draw_slots(parts[2], taps)
    _draw_symbols(parts[3])
    _draw_bits(parts[4], taps, result.columns[COLUMN])
    _draw_text(figure.add_subplot(grid[5, :]), result)
    return figure


def _first_slot(taps: rxcli.Taps) -> int:
    """Grid slot at which the first whole packet starts."""
    return -taps.clock.first_slot % taps.clock.packet_slots


def _n_slots() -> int:
    return 20 + 10 * SYMBOLS


def _rows(taps: rxcli.Taps) -> tuple[float, float]:
    clock = taps.clock
    first = clock.row0 + _first_slot(taps) * clock.rows_per_slot
    return first, first + _n_slots() * clock.rows_per_slot


def _in_slots(taps: rxcli.Taps, rows: NDArray[np.int64]) -> NDArray[np.float64]:
    """Where rows lie from the packet's start, slots; a row is at the middle of its exposure."""
    return np.asarray((rows - _rows(taps)[0]) / taps.clock.rows_per_slot)


def _draw_photo(axes: Axes, frame: rxcli.Frame, taps: rxcli.Taps, rows: tuple[float, float]) -> None:
    axes.imshow(frame.pixels[::3, ::3], cmap="gray", extent=(0, frame.width, frame.height, 0))
    x = _column_x(taps, np.array(rows))
    axes.fill([*x[0], *x[1][::-1]], [*rows, *rows[::-1]], fill=False, edgecolor=_ORANGE, linewidth=2)
    axes.plot(*np.vstack([taps.corners, taps.corners[:1]]).T, color=_BLUE, linewidth=1.2)
    axes.set_title("1  A photo. The receiver finds the screen\nand its 20 columns.", loc="left", fontsize=11)
    axes.axis("off")


def _column_x(taps: rxcli.Taps, rows: NDArray[np.float64]) -> list[list[float]]:
    """Left and right edge of the column on some rows, the screen being nearly upright."""
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = taps.corners
    edges = []
    for share in (COLUMN / 20, (COLUMN + 1) / 20):
        top, bottom = (x0 + share * (x1 - x0), y0 + share * (y1 - y0)), (x3 + share * (x2 - x3), y3 + share * (y2 - y3))
        edges.append([top[0] + (row - top[1]) / (bottom[1] - top[1]) * (bottom[0] - top[0]) for row in rows])
    return edges


def _draw_stripes(axes: Axes, frame: rxcli.Frame, taps: rxcli.Taps, rows: tuple[float, float]) -> None:
    first, last = round(rows[0]), round(rows[1])
    x = _column_x(taps, np.array([first, last], float))
    cut = frame.pixels[first:last, round(max(x[0])) : round(min(x[1]))].T
    axes.imshow(cut, cmap="gray", aspect="auto", extent=(0, _n_slots(), 0, 1), vmax=np.percentile(cut, 99.5))
    axes.set_title(
        "2  Stripes: one column, rotated. Each row of the picture is a different instant.", loc="left", fontsize=11
    )
    axes.set(xticks=[], yticks=[])


def _draw_light(axes: Axes, taps: rxcli.Taps, rows: tuple[float, float]) -> None:
    light = taps.profiles.light[COLUMN].mean(axis=0)
    at = _in_slots(taps, taps.profiles.rows)
    shown = (at >= 0) & (at <= _n_slots())
    for number, lit in enumerate(_slots(taps)):
        if lit:
            axes.axvspan(number, number + 1, color=_ORANGE, alpha=0.3, linewidth=0)
    axes.plot(at[shown], light[shown], color="black", linewidth=1)
    axes.set_title("3  Light over time, and the slots that were decided as lit (shaded).", loc="left", fontsize=11)
    axes.set(xlim=(0, _n_slots()), xticks=[], yticks=[])


def _slots(taps: rxcli.Taps) -> list[int]:
    burst = int(taps.clock.burst[(_first_slot(taps) + taps.clock.first_slot) // taps.clock.packet_slots])
    return [int(lit > 0.5) for lit in taps.posteriors.lit[burst, COLUMN, : _n_slots()]]


def _draw_slots(axes: Axes, taps: rxcli.Taps) -> None:
    slots = _slots(taps)
    assert tuple(slots[:10]) == HEADER
    for number, lit in enumerate(slots):
        axes.text(number + 0.5, 0.5, str(lit), ha="center", va="center", fontsize=8, color="black" if lit else _GREY)
    axes.set_title("4  Slots: ten make a symbol.", loc="left", fontsize=11, pad=2)
    _bare(axes)


def _draw_symbols(axes: Axes) -> None:
    names = ["header", "dimming: 5 of 10", *(f"symbol {number}" for number in range(1, SYMBOLS + 1))]
    for number, name in enumerate(names):
        colour = _GREY if number < 2 else _BLUE
        axes.plot([10 * number + 0.4, 10 * number + 9.6], [0.9, 0.9], color=colour, linewidth=2)
        axes.text(10 * number + 5, 0.35, name, ha="center", va="center", fontsize=9, color=colour)
    _bare(axes)


def _draw_bits(axes: Axes, taps: rxcli.Taps, column: rxcli.ColumnResult) -> None:
    assert column.packets
    bits = hex_to_bits(column.packets[0].payload, 7 * SYMBOLS).reshape(SYMBOLS, 7)
    for number, symbol in enumerate(bits):
        text = "".join(map(str, symbol))
        axes.text(25 + 10 * number, 0.5, text, ha="center", va="center", fontsize=11, family="monospace", color=_BLUE)
    confidence = f"5  Bits: seven per symbol. The packet's confidence is {column.packets[0].confidence:.3f}."
    axes.set_title(confidence, loc="left", fontsize=11, pad=2)
    _bare(axes)


def _draw_text(axes: Axes, result: rxcli.FrameResult) -> None:
    packets = [column.packets[0] for column in result.columns]
    bits = np.concatenate([hex_to_bits(packet.payload, packet.payload_bits) for packet in packets])
    text = np.packbits(bits)[:192].tobytes().decode("ascii")
    assert text.rstrip() == MESSAGE.decode()
    axes.set_title(
        "6  Payloads of all columns; this sender wrote ASCII into the raw bits (orange: from this column).",
        loc="left",
        fontsize=11,
    )
    before, own, after = text[:77], text[77:86], text[86:].rstrip()
    style: dict[str, Any] = {"fontsize": 11.5, "family": "monospace", "va": "center"}
    axes.text(0, 0.72, before, **style)
    axes.text(0, 0.2, " " * len(own) + after, **style)
    axes.text(0, 0.2, own, color=_ORANGE, fontweight="bold", **style)
    _bare(axes, 1)


def _bare(axes: Axes, width: float | None = None) -> None:
    axes.set_xlim(0, width or _n_slots())
    axes.set_ylim(0, 1)
    axes.axis("off")


if __name__ == "__main__":
    with TemporaryDirectory() as temporary:
        draw(photo(Path(temporary))).savefig(sys.argv[1], dpi=110, pil_kwargs={"quality": 88})
