"""Pictures of one frame: the photo with its columns, light profiles with the decided slots, a map of confidence.

Needs the extra `plot`.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError, UsageError
from rxcli.profiles import CameraProfile, ScreenProfile
from rxcli.protocol import bits_per_symbol, encode_packet, hex_to_bits
from rxcli.receiver import camera as blind
from rxcli.receiver import sampling
from rxcli.receiver.decode import assemble
from rxcli.receiver.screen import geometry
from rxcli.results.report import format_frame, printable
from rxcli.results.undistort import grey_levels
from rxcli.types import ColumnResult, FloatArray, Frame, FrameResult, Outlines, PacketResult, RowProfiles

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_PHOTO_PX = 1600
#: Height of the picture of a picture, whatever its shape.
_TALLEST_IN = 24
_COLUMNS_PER_PICTURE = 20
#: Colour of a confidence from 0 to 1.
_COLOURS = "RdYlGn"


def write_pictures(
    folder: Path, frame: Frame, result: FrameResult, screen: ScreenProfile | None, camera: CameraProfile | None
) -> Path:
    """Write PNG pictures of every stage, as far as reception got, and a page that shows them.

    Args:
        folder: where to; made where it is missing.
        frame: the picture.
        result: what became of it.
        screen: the profile that `result` names.
        camera: likewise.

    Returns:
        The page.

    Raises:
        InputError: something cannot be written.
        UsageError: matplotlib is not installed.
    """
    figures = dict(_figures(frame, result, screen, camera))
    page = folder / "index.html"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, figure in figures.items():
            figure.savefig(folder / f"{name}.png", dpi=100)
        page.write_text(_page(result, list(figures)), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror})", "name another folder with --out") from None
    return page


def _figures(
    frame: Frame, result: FrameResult, screen: ScreenProfile | None, camera: CameraProfile | None
) -> Iterator[tuple[str, Figure]]:
    if result.corners is None or screen is None:
        yield "photo", photo_figure(frame, result, None)
        return
    lens = geometry.lens_for(camera.lens, frame.width, frame.height) if camera and camera.lens else None
    column_px = float(np.linalg.norm(result.corners[1] - result.corners[0])) / screen.columns
    n_strips = sampling.strips_per_column(column_px)
    outlines = geometry.column_outlines(result.corners, screen.columns, n_strips, frame.width, frame.height, lens)
    yield "photo", photo_figure(frame, result, outlines)
    if result.columns:
        yield "confidence", confidence_figure(result)
    tone = "srgb" if camera is None or camera.tone == "auto" else camera.tone
    profiles, columns = _in_time_order(frame, result, sampling.sample_rows(frame, outlines, tone))
    for first in range(0, len(columns), _COLUMNS_PER_PICTURE):
        chosen = columns[first : first + _COLUMNS_PER_PICTURE]
        last = chosen[-1].column
        yield f"profiles-{chosen[0].column:03}-{last:03}", profile_figure(profiles, result, chosen, screen)


def _in_time_order(
    frame: Frame, result: FrameResult, profiles: RowProfiles
) -> tuple[RowProfiles, tuple[ColumnResult, ...]]:
    """Row profiles and columns with rows counted as they were read out, not as software may have turned them."""
    if not result.estimated.get("readout_reversed", (0.0, 0.0))[0]:
        return profiles, result.columns
    columns = tuple(assemble.in_stored_rows(column, frame.height) for column in result.columns)
    return blind.in_time_order(profiles, frame.height), columns


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure that belongs to nobody else.

    Raises:
        UsageError: matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise UsageError("pictures need the package matplotlib", "pip install 'vlc-rx[plot]'") from None
    return Figure(figsize=(width_in, height_in), layout="constrained")


def photo_figure(frame: Frame, result: FrameResult, outlines: Outlines | None) -> Figure:
    """The photo with corners, and every column's outline in the colour of its confidence."""
    step = max(1, math.ceil(max(frame.width, frame.height) / _PHOTO_PX))
    figure = new_figure(12, min(max(12 * frame.height / frame.width, 1), _TALLEST_IN) + 0.5)
    axes = figure.add_subplot()
    extent = (-0.5, frame.width - 0.5, frame.height - 0.5, -0.5)
    axes.imshow(grey_levels(frame)[::step, ::step], cmap="gray", vmin=0, vmax=255, extent=extent)
    title = f"{printable(result.source)}: {result.status}" + (f" ({result.message})" if result.message else "")
    axes.set_title(title, parse_math=False)  # $ in a name is no formula
    if result.corners is not None:
        closed = result.corners[[0, 1, 2, 3, 0]]
        axes.plot(closed[:, 0], closed[:, 1], color="tab:blue", linewidth=1)
        for name, (x, y) in zip("1234", result.corners, strict=True):
            axes.annotate(name, (x, y), color="tab:blue", fontsize=14, fontweight="bold")
    if outlines is not None:
        _draw_columns(axes, outlines, result.columns)
    axes.set_xlim(extent[:2])
    axes.set_ylim(extent[2:])
    return figure


def _draw_columns(axes: Axes, outlines: Outlines, columns: tuple[ColumnResult, ...]) -> None:
    from matplotlib import colormaps

    n_strips = outlines.inside.shape[1]
    for column in columns:
        left, right = outlines.edges_x[column.column * n_strips], outlines.edges_x[(column.column + 1) * n_strips]
        on_screen = outlines.inside[column.column].any(axis=0)
        colour = colormaps[_COLOURS](lowest_confidence(column))
        axes.fill_betweenx(outlines.rows, left, right, where=on_screen, color=colour, alpha=0.3, linewidth=0.5)
        if on_screen.any():
            middle = int(np.flatnonzero(on_screen).mean())
            place = ((left[middle] + right[middle]) / 2, outlines.rows[middle])
            axes.annotate(str(column.column), place, ha="center", color="white", fontsize=8)


def lowest_confidence(column: ColumnResult) -> float:
    """The lowest confidence of a column's packets, 0 where there are none."""
    return min((packet.confidence for packet in column.packets), default=0.0)


def confidence_figure(result: FrameResult) -> Figure:
    """Confidence of every packet, columns across and bursts downwards."""
    from matplotlib.ticker import MaxNLocator

    n_bursts = max(1, *(len(column.packets) for column in result.columns))
    values = np.full((n_bursts, len(result.columns)), np.nan)
    for place, column in enumerate(result.columns):
        values[: len(column.packets), place] = [packet.confidence for packet in column.packets]
    figure = new_figure(12, 1.5 + 0.5 * n_bursts)
    axes = figure.add_subplot()
    image = axes.imshow(values, vmin=0, vmax=1, cmap=_COLOURS, aspect="auto")
    if len(result.columns) <= 2 * _COLUMNS_PER_PICTURE:
        for (burst, place), value in np.ndenumerate(values):
            axes.text(place, burst, "none" if np.isnan(value) else f"{value:.3f}", ha="center", va="center", fontsize=7)
    axes.set(xlabel="column", ylabel="packet", yticks=range(n_bursts), title="confidence")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    figure.colorbar(image)
    return figure


def profile_figure(
    profiles: RowProfiles, result: FrameResult, columns: tuple[ColumnResult, ...], screen: ScreenProfile
) -> Figure:
    """Root of the mean light of each column on every sensor row, over the decided slots: lit ones are shaded."""
    figure = new_figure(16, 1.1 * len(columns) + 0.6)
    many = figure.subplots(len(columns), 1, sharex=True, squeeze=False)[:, 0]
    rows_observed: list[float] = []
    for axes, column in zip(many, columns, strict=True):
        rows, light = column_light(profiles, column.column)
        axes.plot(rows, np.sqrt(np.maximum(light, 0)), linewidth=0.5, color="black")  # the root shows dark parts too
        rows_observed += [float(rows[0]), float(rows[-1])] if rows.size else []
        if result.line_delay_s:
            rows_per_slot = 1 / (screen.slot_rate_hz * result.line_delay_s)
            # A packet starts on the row whose exposure starts with it; a slot shows most where exposures are half over.
            half_exposure = (result.exposure_s or 0.0) / result.line_delay_s / 2
            for start, slots in decided_slots(column, screen, rows_per_slot, rows):
                _shade(axes, start - half_exposure, rows_per_slot, slots)
        axes.set_ylabel(f"{column.column}", rotation=0, ha="right")
        axes.set_yticks([])
        axes.set_title(f"{column.status}, w {column.w}", loc="right", fontsize=7, pad=1)
    if rows_observed:
        many[-1].set_xlim(min(rows_observed), max(rows_observed))
    many[-1].set_xlabel("sensor row")
    return figure


def column_light(profiles: RowProfiles, column: int) -> tuple[FloatArray, FloatArray]:
    """Sensor rows (n,) and mean light (n,) of one column, where it is on the screen."""
    inside = profiles.inside[column]
    on_screen = inside.any(axis=0)
    light = (profiles.light[column] * inside).sum(axis=0)[on_screen] / inside.sum(axis=0)[on_screen]
    rows = profiles.rows.astype(np.float64) if profiles.sensor_row is None else profiles.sensor_row[column].mean(axis=0)
    return rows[on_screen], light.astype(np.float64)


def decided_slots(
    column: ColumnResult, screen: ScreenProfile, rows_per_slot: float, rows: FloatArray
) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """What each packet of a column says the slots were, over the copies that are visible.

    Args:
        column: the column.
        screen: its screen.
        rows_per_slot: sensor rows of a slot.
        rows: sensor rows on which the column is seen.

    Yields:
        Sensor row where the first slot starts, and the slots, 0 or 1.
    """
    if column.w is None or rows.size == 0 or not column.packets:
        return
    ends = [packet.first_row for packet in column.packets[1:]] + [float(rows.max())]
    for packet, end in zip(column.packets, ends, strict=True):
        slots = packet_slots_of(packet, column.w, screen)
        if slots is None:
            continue
        longest = screen.repeats * slots.size
        n_slots = min(math.ceil((end - packet.first_row) / rows_per_slot), longest)
        if n_slots > 0:
            yield packet.first_row, np.resize(slots, n_slots)


def packet_slots_of(packet: PacketResult, w: int, screen: ScreenProfile) -> NDArray[np.uint8] | None:
    """The slots that would send `packet`, None where it is no packet of that weight and screen."""
    if packet.payload_bits != bits_per_symbol(w) * screen.payload_symbols:
        return None
    return encode_packet(hex_to_bits(packet.payload, packet.payload_bits), w)


def _shade(axes: Axes, start: float, rows_per_slot: float, slots: NDArray[np.uint8]) -> None:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], slots, [0]])))
    spans = [(start + a * rows_per_slot, (b - a) * rows_per_slot) for a, b in edges.reshape(-1, 2)]
    low, high = axes.get_ylim()
    axes.broken_barh(spans, (low, high - low), facecolor="tab:orange", alpha=0.3)


def _page(result: FrameResult, names: list[str]) -> str:
    title = html.escape(printable(result.source))
    images = "\n".join(f'<h2>{name}</h2>\n<img src="{name}.png" alt="{name}">' for name in names)
    return (
        f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>{title}</title>\n'
        "<style>body { font-family: sans-serif; margin: 2em } img { max-width: 100% }</style>\n"
        f"<h1>{title}</h1>\n<pre>{html.escape(format_frame(result))}</pre>\n{images}\n</html>\n"
    )
