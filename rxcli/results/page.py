"""`inspect`'s page: one file that needs nothing else, in the design of `vlc-rx serve`; drawings are SVG."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from rxcli.profiles import CameraProfile, ScreenProfile
from rxcli.results.aim import height_share, light_of, split_message
from rxcli.results.grids import rival_grids
from rxcli.results.inspection import BINS, EYE_TIMES, RANGE, Inspection, Trace, inspect_frame
from rxcli.results.overlay import column_polygons, jpeg_address, preview
from rxcli.results.report import headline, mirror_note, plural, printable
from rxcli.types import ColumnResult, FloatArray, Frame, FrameResult

#: Told by the first lines of a page that this program wrote.
MARK = "<!-- written by vlc-rx inspect -->"
_WORDS = {"ok": "received", "weak": "unsure", "no_packet": "no packet", "dark": "too dark"}
_STYLE = Path(__file__).parents[1] / "web" / "page" / "app.css"
#: Width of drawings, in their own units; rows are thinned out to so many points.
_WIDTH, _POINTS, _FEW_POINTS = 1000, 1200, 500
_MANY_COLUMNS = 24
_MORE_STYLE = """
header, main { max-width: 75rem; } td.mono { min-width: 8rem; }
svg { display: block; width: 100%; height: auto; background: var(--card); }
svg.small { max-width: 34rem; }
svg text { fill: var(--soft); stroke: none; font-size: 12px; display: inline; }
svg .light { fill: none; stroke: var(--ink); stroke-width: 1; }
svg .model { fill: none; stroke: var(--accent); stroke-width: 1.5; stroke-opacity: .8; }
svg .slots { fill: #f0a63c; fill-opacity: .3; }
svg .border { stroke: var(--no_packet); stroke-width: 1.5; stroke-dasharray: 4 3; }
svg .axis { stroke: var(--line); stroke-width: 1; }
svg .dot { fill: var(--accent); fill-opacity: .6; }
svg .lit { fill: #f0a63c; fill-opacity: .55; } svg .unlit { fill: #5b7fb5; fill-opacity: .55; }
.view svg { background: none; } .view svg text { fill: #fff; stroke: #000; stroke-width: 3px; font-size: 14px; }
.wide { overflow-x: auto; } .wide > svg { min-width: 44rem; }
p, td, dd { overflow-wrap: anywhere; } img { max-width: 100%; } th.number { white-space: normal; }
.steps { list-style: none; padding: 0; display: flex; flex-wrap: wrap; gap: .5rem; }
.steps li { border: 1px solid var(--line); border-radius: .5rem; padding: .25rem .6rem; }
.steps .done { border-color: var(--ok); color: var(--ok); } .steps .failed { border-color: var(--no_packet); color: var(--no_packet); }
.steps .open { color: var(--soft); }
"""


def inspection_page(
    frame: Frame,
    result: FrameResult,
    screen: ScreenProfile | None,
    camera: CameraProfile | None,
    timeline: Sequence[FrameResult] = (),
) -> str:
    """The page of a frame.

    Args:
        frame: the picture.
        result: what became of it.
        screen: the profile that `result` names.
        camera: the profile that `result` names, or the estimated one.
        timeline: results of all frames of the clip that it is of.
    """
    known = inspect_frame(frame, result, screen, camera) if screen is not None else None
    parts = [
        _summary(frame, result),
        _photo(frame, result, screen, camera),
        _timeline(timeline),
        _packets(result),
    ]
    if known is not None:
        received = any(trace.borders for trace in known.traces)
        parts.append(_traces(known))
        parts += [_eye(known), _residuals(known), _crosstalk(known)] if received else []
    parts += [_confidence(result), _encoder(result), _times(result)]
    title = html.escape(f"{printable(Path(result.source).name)}: {headline(result).lower()}")
    return (
        f'<!doctype html>\n{MARK}\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{title}</title>\n<style>\n{_STYLE.read_text(encoding='utf-8')}{_MORE_STYLE}</style>\n</head>\n<body>\n"
        "<header><h1>vlc-rx inspect</h1></header>\n<main>\n"
        + "\n".join(filter(None, parts))
        + "\n</main>\n</body>\n</html>\n"
    )


def _section(title: str, body: str, caption: str = "") -> str:
    told = f"<p class='hint'>{html.escape(caption)}</p>" if caption else ""
    return f"<section>\n<h2>{html.escape(title)}</h2>\n{told}\n{body}\n</section>"


def _svg(height: float, body: str, told: str, width: float = _WIDTH, kind: str = "") -> str:
    """A drawing with a text for those who do not see it."""
    return (
        f'<svg viewBox="0 0 {width:g} {height:g}" role="img" class="{kind}" aria-label="{html.escape(told)}">'
        f"<title>{html.escape(told)}</title>{body}</svg>"
    )


def _drawing(title: str, height: float, body: str, told: str, caption: str) -> str:
    """A section with a wide drawing; `told` says in words what it shows, before the caption."""
    return _section(title, f'<div class="wide">{_svg(height, body, told)}</div>', f"{told} {caption}")


def _path(x: FloatArray, y: FloatArray) -> str:
    """Points as a path that breaks where they are NaN."""
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if not known.size:
        return ""
    points = list(zip(x[known].round(1).tolist(), y[known].round(1).tolist(), strict=True))
    breaks = np.flatnonzero(np.diff(known) > 1) + 1
    edges = [0, *breaks.tolist(), known.size]
    return "".join("M" + "L".join(f"{px} {py}" for px, py in points[a:b]) for a, b in pairwise(edges))


# -- what came of it ---------------------------------------------------------------------------------------------------


def _summary(frame: Frame, result: FrameResult) -> str:
    facts = {
        "Picture": f"{frame.width} x {frame.height}",
        "Light": light_of(frame).word,
        "Screen": result.screen_profile or "not found",
        "Camera": result.camera_profile or ("estimated from the picture" if result.line_delay_s else "unknown"),
    }
    share = height_share(result.corners, frame.height)
    if share is not None:
        facts["Screen fills of the height"] = f"{100 * share:.0f} %"
    if result.line_delay_s:
        facts["A row takes"] = f"{result.line_delay_s * 1e6:.3f} µs"
    cells = "".join(f"<div><dt>{html.escape(k)}</dt><dd>{html.escape(v)}</dd></div>" for k, v in facts.items())
    body = f"<p>{html.escape(printable(result.source))}</p>\n{_steps(result)}\n"
    if result.columns:
        facts["Columns"] = str(len(result.columns))
    body += f"<p>{mirror_note(result)}</p>\n" if mirror_note(result) else ""
    if result.message:
        reason, advice = split_message(result)
        body += f"<p>{html.escape(reason)}</p>\n" + (f"<p class='advice'>{html.escape(advice)}</p>\n" if advice else "")
    return _section(headline(result), f"{body}{_texts(result)}<dl>{cells}</dl>")


def _steps(result: FrameResult) -> str:
    """How far reception came."""
    done = [
        ("picture read", result.status != "unreadable"),
        ("screen found", result.corners is not None),
        ("camera known", bool(result.line_delay_s)),
        ("clock found", bool(result.columns)),
        ("packets decoded", bool(result.packets)),
    ]
    items, failed = [], False
    for name, good in done:
        kind = "done" if good else "open" if failed else "failed"
        failed |= not good
        word = {"done": "✓", "failed": "✗", "open": "–"}[kind]
        told = {"done": "done", "failed": "failed here", "open": "not reached"}[kind]
        items.append(
            f'<li class="{kind}"><span aria-hidden="true">{word}</span> {name}'
            f'<span class="visually-hidden">: {told}</span></li>'
        )
    return f'<ol class="steps" aria-label="How far it came">{"".join(items)}</ol>'


def _texts(result: FrameResult) -> str:
    """Texts and files that the link layer has complete with the frame: the one place where they come to the page."""
    lines = [
        f"<blockquote>{html.escape(message.text or message.data.hex())}</blockquote>" for message in result.messages
    ]
    lines += [
        f"<p>File: {html.escape(received.name)} ({plural(received.size, 'byte')})</p>" for received in result.objects
    ]
    return f'<div class="texts">{"".join(lines)}</div>' if lines else ""


def _photo(frame: Frame, result: FrameResult, screen: ScreenProfile | None, camera: CameraProfile | None) -> str:
    small = preview(frame, 1200)
    height, width = small.pixels.shape
    shapes = []
    polygons = column_polygons(result, frame, screen, camera)
    for number, status, points in polygons:
        at = " ".join(f"{x:.1f},{y:.1f}" for x, y in points / small.step)
        shapes.append(
            f'<polygon class="{status}" points="{at}"><title>column {number}: {_WORDS[status]}</title></polygon>'
        )
        if len(polygons) <= _MANY_COLUMNS or number % 10 == 0:
            x, y = points[:, 0].mean() / small.step, points[:, 1].max() / small.step - 8
            shapes.append(f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="middle">{number}</text>')
    if result.corners is not None:
        at = " ".join(f"{x:.1f},{y:.1f}" for x, y in result.corners / small.step)
        shapes.append(f'<polygon class="corners" points="{at}"/>')
    told = _told(result.columns) if polygons else "No columns could be outlined."
    legend = "".join(f'<li class="{kind}">{word}</li>' for kind, word in _WORDS.items()) if polygons else ""
    body = (
        f'<figure><div class="view"><img src="{jpeg_address(small.pixels, 80)}" width="{width}" height="{height}" '
        f'alt="The picture. {html.escape(told)}"><svg viewBox="0 0 {width} {height}" aria-hidden="true">'
        f"{''.join(shapes)}</svg></div><figcaption>{html.escape(told)}</figcaption></figure>"
        f'<ul class="legend">{legend}</ul>{_coherence(frame)}{rival_grids(frame)}'
    )
    caption = "White: the outline of the screen that was found. Colours: what became of each column of its backlight."
    return _section("The picture", body, caption if polygons else "")


def _coherence(frame: Frame) -> str:
    """Where the picture has stripes that neighbouring pixels share, as a small map."""
    from rxcli.receiver.corners import levels_of
    from rxcli.receiver.screen.picture import Picture, reduce
    from rxcli.receiver.screen.stripes import find_stripes

    if min(frame.width, frame.height) < 96:
        return ""
    levels: dict[str, Any] = levels_of(frame)
    plane = reduce(Picture(frame.pixels, levels["black"], levels["white"], levels.get("mosaic_period", 1)))
    striped = find_stripes(plane).striped
    big = np.kron(striped.astype(np.uint8) * 215 + 20, np.ones((4, 4), np.uint8))
    told = f"Stripes were found in {100 * float(striped.mean()):.0f} % of the picture."
    return (
        "<details><summary>Where the picture has stripes</summary><figure>"
        f'<img src="{jpeg_address(big, 85)}" alt="{told}" width="480">'
        f"<figcaption>{told} White: light that changes from row to row alike in neighbouring pixels, as only a "
        "flickering light does. The search for the screen begins with this map.</figcaption></figure></details>"
    )


def _told(columns: Iterable[ColumnResult]) -> str:
    counts = {kind: sum(column.status == kind for column in columns) for kind in _WORDS}
    return "Columns: " + ", ".join(f"{n} {_WORDS[kind]}" for kind, n in counts.items() if n) + "."


def _timeline(results: Sequence[FrameResult]) -> str:
    if len(results) < 2:
        return ""
    counts = [len(result.packets) for result in results]
    most, step = max(max(counts), 1), _WIDTH / len(results)
    bars = []
    for number, (result, n) in enumerate(zip(results, counts, strict=True)):
        kind = "ok" if result.status in ("ok", "partial") else "no_packet"
        top = 100 - 90 * n / most
        told = f"frame {result.frame}, {result.time_s:.2f} s: {headline(result).lower()}"
        bars.append(
            f'<g><title>{told}</title><rect class="axis" x="{number * step:.2f}" y="100" width="{step:.2f}" '
            f'height="8" fill="var(--{kind})"/><rect x="{number * step:.2f}" y="{top:.1f}" '
            f'width="{max(step - 0.5, 0.5):.2f}" height="{100 - top:.1f}" fill="var(--accent)"/></g>'
        )
    ends = f'<text x="0" y="124">{results[0].time_s:.2f} s</text><text x="{_WIDTH}" y="124" text-anchor="end">{results[-1].time_s:.2f} s</text>'
    lost = sum(result.status not in ("ok", "partial") for result in results)
    told = f"{plural(len(results), 'frame')}, {sum(counts)} packets, {lost} frames without reception."
    caption = (
        f"Height: packets that ended in a frame, {most} at most. The line below is green where the frame was received."
    )
    return _drawing("The clip", 128, "".join(bars) + ends, told, caption)


def _packets(result: FrameResult) -> str:
    packets = [(column.column, packet) for column in result.columns for packet in column.packets]
    scored = any(packet.bit_errors is not None for _, packet in packets)  # only where the truth is known
    rows = []
    for column, packet in packets:
        wrong = "" if packet.bit_errors is None else str(packet.bit_errors)
        kind = "ok" if packet.is_believable else "weak"
        sure = math.floor(packet.confidence * 1000) / 10
        rows.append(
            f'<tr><td class="number">{column}</td><td class="number {kind}">{sure:.1f} %</td>'
            f'<td class="number">{packet.copies:.2f}</td>'
            + (f'<td class="number">{wrong}</td>' if scored else "")
            + f'<td class="mono">{html.escape(packet.payload)}</td></tr>'
        )
    reasons: dict[str, list[int]] = {}
    for silent in result.columns:
        if silent.message and not silent.packets:
            reasons.setdefault(silent.message, []).append(silent.column)
    lines = "".join(
        f"<li>Column{'s' if len(which) > 1 else ''} {', '.join(map(str, which))}: {html.escape(why)}</li>"
        for why, which in reasons.items()
    )
    body = ""
    if rows:
        body += (
            '<div class="scroll" tabindex="0"><table><thead><tr><th scope="col" class="number">Column</th>'
            '<th scope="col" class="number">Sure</th><th scope="col" class="number">Seen</th>'
            + ('<th scope="col" class="number">Wrong bits</th>' if scored else "")
            + f'<th scope="col">Payload</th></tr></thead><tbody>{"".join(rows)}</tbody></table></div>'
        )
    if lines:
        body += f"<h3>Columns without a packet</h3><ul>{lines}</ul>"
    return (
        _section(
            "Packets",
            body,
            "Sure: probability that every bit is right. Seen: how often the packet is in view."
            + (" Wrong bits: against the truth." if scored else ""),
        )
        if body
        else ""
    )


# -- light and slots ---------------------------------------------------------------------------------------------------


def _traces(known: Inspection) -> str:
    many = len(known.traces) > _MANY_COLUMNS
    height = 34 if many else 58
    rows = np.concatenate([trace.rows[[0, -1]] for trace in known.traces if trace.rows.size])
    if not rows.size:
        return ""
    low, high = float(rows.min()), float(rows.max())
    scale = (_WIDTH - 60) / max(high - low, 1.0)
    body = "".join(
        _one_trace(trace, 6 + place * height, height - 8, low, scale, _FEW_POINTS if many else _POINTS)
        for place, trace in enumerate(known.traces)
    )
    total = 6 + len(known.traces) * height + 22
    body += f'<text x="50" y="{total - 6}">row {low:.0f}</text><text x="{_WIDTH}" y="{total - 6}" text-anchor="end">row {high:.0f} of the sensor</text>'
    told = f"Light of {plural(len(known.traces), 'column')} over the sensor's rows; a slot takes {known.rows_per_slot:.2f} rows."
    caption = (
        "The light of each column from the first row of the picture to the last; a row is an instant. Shaded: slots that were "
        "decided to be lit. Green: the light that these slots should give; where it lies on the black line, the decision fits. "
        f"Red dashes: a packet begins. {told}"
    )
    return _section("Light and slots", f'<div class="wide">{_svg(total, body, told)}</div>', caption)


def _one_trace(trace: Trace, top: float, height: float, low: float, scale: float, points: int) -> str:
    status = trace.column.status
    label = (
        f'<text x="44" y="{top + height / 2 + 4:.0f}" text-anchor="end">{trace.column.column}'
        f"<title>column {trace.column.column}: {_WORDS[status]}</title></text>"
        f'<rect x="48" y="{top:.0f}" width="3" height="{height:.0f}" fill="var(--{status})"/>'
    )
    if not trace.rows.size:
        return label
    root = np.sqrt(np.maximum(trace.light, 0))  # the root shows dark parts too
    most = max(float(np.quantile(root, 0.995)), 1e-6)

    def x(rows: Any) -> Any:
        return 56 + (rows - low) * scale

    def y(values: FloatArray) -> FloatArray:
        return np.asarray(top + height * (1 - np.clip(values / most, 0, 1.08)))

    step = max(1, trace.rows.size // points)
    first, last = float(trace.rows[0]), float(trace.rows[-1])
    shown = [(max(a, first), min(b, last)) for a, b in trace.lit_spans if b > first and a < last]
    spans = "".join(f"M{x(a):.1f} {top:.0f}h{(b - a) * scale:.1f}v{height:.0f}H{x(a):.1f}z" for a, b in shown)
    light = _path(x(trace.rows[::step]), y(root[::step]))
    model = _path(x(trace.rows[::step]), y(np.sqrt(np.maximum(trace.model, 0))[::step]))
    borders = "".join(
        f'<path class="border" d="M{x(row):.1f} {top - 2:.0f}v{height + 4:.0f}"/>'
        for row in trace.borders
        if x(row) >= 56
    )
    return f'{label}<path class="slots" d="{spans}"/><path class="light" d="{light}"/><path class="model" d="{model}"/>{borders}'


def _eye(known: Inspection) -> str:
    """Histogram of slots and eye diagram, side by side."""
    width, height = 480, 240
    most = max(int(known.histogram.max()), 1)
    step = width / BINS
    bars = "".join(
        f'<rect class="{kind}" x="{i * step:.1f}" y="{height - height * n / most:.1f}" width="{step:.1f}" height="{height * n / most:.1f}"/>'
        for kind, counts in zip(("unlit", "lit"), known.histogram.tolist(), strict=True)
        for i, n in enumerate(counts)
        if n
    )
    zero, one = ((value - RANGE[0]) / (RANGE[1] - RANGE[0]) * width for value in (0, 1))
    marks = "".join(
        f'<path class="axis" d="M{x:.0f} 0v{height}"/><text x="{x:.0f}" y="{height + 16}" text-anchor="middle">{word}</text>'
        for x, word in ((zero, "dark"), (one, "lit"))
    )
    share = _overlap(known)
    told = f"Light of dark (blue) and lit (orange) slots: {share}."
    first = _svg(height + 22, marks + bars, told, width, "small")
    eye = known.eye / max(int(known.eye.max()), 1)
    cells = "".join(
        f'<rect x="{j * width / EYE_TIMES:.1f}" y="{height - (i + 1) * height / BINS:.1f}" width="{width / EYE_TIMES + 0.3:.1f}" '
        f'height="{height / BINS + 0.3:.1f}" fill="var(--accent)" fill-opacity="{math.sqrt(eye[i, j]):.2f}"/>'
        for i in range(BINS)
        for j in range(EYE_TIMES)
        if eye[i, j] > 1e-3
    )
    second = _svg(
        height + 22,
        cells + f'<text x="0" y="{height + 16}">0</text><text x="{width / 2}" y="{height + 16}" '
        f'text-anchor="middle">1 slot</text><text x="{width}" y="{height + 16}" text-anchor="end">2 slots</text>',
        "Eye diagram: how light and time within two slots meet.",
        width,
        "small",
    )
    body = (
        f"<h3>Slot values</h3>{first}<p class='hint'>{html.escape(told)} The further apart, the surer.</p>"
        f"<h3>Eye diagram</h3>{second}<p class='hint'>All columns, folded over two slots, the picture's own brightness taken out. "
        "Open eyes between the traces mean that slots can be told apart; a long exposure closes them.</p>"
    )
    return _section("How clear slots are", body)


def _overlap(known: Inspection) -> str:
    dark, lit = known.histogram
    half = np.linspace(*RANGE, BINS + 1)[:-1] >= 0.5
    total = int(dark.sum() + lit.sum())
    wrong = int(dark[half].sum() + lit[~half].sum())
    return f"{100 * wrong / max(total, 1):.1f} % of {total} values lie on the wrong side of the middle"


def _residuals(known: Inspection) -> str:
    points = [
        (row, late) for trace in known.traces if trace.residuals is not None for row, late in trace.residuals.tolist()
    ]
    if not points:
        return ""
    rows, late = (np.array(values) for values in zip(*points, strict=True))
    reach = max(0.25, float(np.quantile(np.abs(late), 0.98)))
    low, span = float(rows.min()), max(float(np.ptp(rows)), 1.0)
    dots = "".join(
        f'<circle class="dot" r="3" cx="{50 + (r - low) / span * (_WIDTH - 60):.0f}" '
        f'cy="{100 - 90 * max(-1.0, min(1.0, v / reach)):.1f}"/>'
        for r, v in points
    )
    axis = (
        f'<path class="axis" d="M50 100H{_WIDTH}"/><text x="46" y="104" text-anchor="end">0</text>'
        f'<text x="46" y="20" text-anchor="end">+{reach:.2f}</text><text x="46" y="192" text-anchor="end">-{reach:.2f}</text>'
    )
    spread = float(np.sqrt(np.mean(late**2)))
    told = f"Clock residuals of {len(points)} places: {spread:.3f} slots root mean square."
    return _drawing(
        "Is the clock right?",
        204,
        axis + dots,
        told,
        "Each dot: how much later than expected, in slots, the light of one column is around a row. Dots on the "
        "line mean that line delay, lens and clock fit; a slope means another line delay, a bow another lens.",
    )


def _crosstalk(known: Inspection) -> str:
    values = known.crosstalk
    beside = values[:, [0, 2]]
    if not np.isfinite(beside).any():
        return ""
    step, most = (_WIDTH - 60) / len(values), max(0.1, float(np.nanmax(np.abs(beside))))
    bars = []
    for number, (left, _, right) in enumerate(values.tolist()):
        for side, value, kind in ((0, left, "unlit"), (1, right, "lit")):
            if math.isfinite(value):
                height = 120 * max(value, 0) / most
                bars.append(
                    f'<rect class="{kind}" x="{50 + (number + 0.1 + 0.4 * side) * step:.1f}" y="{130 - height:.1f}" '
                    f'width="{0.38 * step:.1f}" height="{height:.1f}"/>'
                )
        if len(values) <= _MANY_COLUMNS or number % 10 == 0:
            bars.append(f'<text x="{50 + (number + 0.5) * step:.0f}" y="146" text-anchor="middle">{number}</text>')
    told = f"A neighbour's light is {100 * float(np.nanmean(beside)):.0f} % of a column's own on average, {100 * most:.0f} % at most."
    axis = f'<text x="46" y="16" text-anchor="end">{100 * most:.0f} %</text><path class="axis" d="M50 130H{_WIDTH}"/>'
    caption = "Blue: how much of a column's light follows the slots of the column to its left; orange: to its right."
    return _drawing("Light of neighbours", 152, axis + "".join(bars), told, caption)


# -- the rest ----------------------------------------------------------------------------------------------------------


def _confidence(result: FrameResult) -> str:
    n_packets = max((len(column.packets) for column in result.columns), default=0)
    if not n_packets:
        return ""
    columns = len(result.columns)
    step, height = (_WIDTH - 60) / columns, 26
    cells = []
    for place, column in enumerate(result.columns):
        for number in range(n_packets):
            packet = column.packets[number] if number < len(column.packets) else None
            kind = column.status if packet is None else "ok" if packet.is_believable else "weak"
            fade = 0.25 if packet is None else 0.25 + 0.75 * packet.confidence
            told = f"column {column.column}: " + ("none" if packet is None else f"{packet.confidence:.4f}")
            x, y = 50 + place * step, 4 + number * height
            cells.append(
                f'<rect x="{x:.1f}" y="{y}" width="{max(step - 1, 0.5):.1f}" height="{height - 2}" fill="var(--{kind})" '
                f'fill-opacity="{fade:.2f}"><title>{told}</title></rect>'
            )
            if columns <= _MANY_COLUMNS and packet is not None:
                cells.append(
                    f'<text x="{x + step / 2:.0f}" y="{y + 16}" text-anchor="middle" style="fill:var(--on-accent)">'
                    f"{math.floor(packet.confidence * 100):d}</text>"
                )
        if columns <= _MANY_COLUMNS or place % 10 == 0:
            cells.append(
                f'<text x="{50 + (place + 0.5) * step:.0f}" y="{n_packets * height + 18}" text-anchor="middle">{column.column}</text>'
            )
    found = [packet.confidence for packet in result.packets]
    told = f"{plural(len(found), 'packet')}; {sum(value >= 0.9 for value in found)} with a confidence of 0.9 or more."
    caption = "Columns across, packets downwards; numbers are percent."
    return _drawing("Confidence", n_packets * height + 24, "".join(cells), told, caption)


def _encoder(result: FrameResult) -> str:
    changed = [column.column for column in result.columns if column.denoised]
    if result.denoiser is None:
        return ""
    rows = "".join(
        f"<tr><th scope='row'>{html.escape(str(key).replace('_', ' '))}</th><td>{html.escape(_short(value))}</td></tr>"
        for key, value in result.denoiser.items()
    )
    kept = (
        f"Its corrections were kept in column{'s' if len(changed) > 1 else ''} {', '.join(map(str, changed))}."
        if changed
        else "None of its corrections were kept."
    )
    return _section(
        "Auto-encoder",
        f"<p>{kept}</p><table>{rows}</table>",
        "A small network that cleans the slots of columns in doubt; corrections are kept where they leave less doubt.",
    )


def _short(value: Any) -> str:
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 200 else text[:199] + "…"


def _times(result: FrameResult) -> str:
    stages = {name: value for name, value in result.timing_ms.items() if name != "total" and math.isfinite(value)}
    most = max(stages.values(), default=0.0) or 1.0
    bars = "".join(
        f'<text x="96" y="{18 + 24 * i}" text-anchor="end">{html.escape(name)}</text><rect x="104" y="{6 + 24 * i}" height="16" '
        f'width="{300 * value / most:.1f}" fill="var(--accent)"/><text x="{110 + 300 * value / most:.0f}" y="{18 + 24 * i}">{value:.0f} ms</text>'
        for i, (name, value) in enumerate(stages.items())
    )
    told = f"{result.timing_ms.get('total', math.nan):.0f} ms in all."
    drawn = _svg(24 * len(stages) + 8, bars, "Time by stage: " + told, 480, "small") if stages else ""
    left = ", ".join(f"{html.escape(name.replace('_', ' '))} {count}" for name, count in result.skipped.items())
    skipped = (
        f"<p>Left out because the picture did not need it: {left}.</p>" if left else "<p>Nothing was left out.</p>"
    )
    return _section("Time", f"{drawn}{skipped}", told)
