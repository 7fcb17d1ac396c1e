"""`inspect`'s page: one file that needs nothing else. Here is what it shows; `pages/inspect.js` draws it."""

import html
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, astuple
from pathlib import Path
from typing import Any

import numpy as np

from rxcli.errors import capitalised, printable
from rxcli.resources import data_dir, filled_page
from rxcli.results.aim import brightness_of, height_share, split_message
from rxcli.results.cameras import Reception
from rxcli.results.columns import column_rows, packet_rows, text_rows
from rxcli.results.inspection import Inspection, Trace
from rxcli.results.maps import column_map
from rxcli.results.overlay import picture_of, preview
from rxcli.results.quality import qualities
from rxcli.results.record import plain
from rxcli.results.report import headline, mirror_note, packets_in_words, plural
from rxcli.types import FloatArray, Frame, FrameResult

#: First lines of a page that this program wrote.
MARK = "<!-- written by vlc-rx inspect -->"
#: Points of a column's light, with few and with many columns; widths of the picture, and heights of traces, in steps.
_POINTS, _FEW_POINTS, _MANY_COLUMNS, _STEPS, _WIDTH_PX = 1200, 500, 24, 1000, 1200
#: Quantile of a column's light that fills the height of its trace.
_TOP = 0.995


def inspection_page(shown: Reception, known: Inspection | None, timeline: Sequence[FrameResult] = ()) -> str:
    """The page of a frame.

    Args:
        shown: the frame and what became of it.
        known: its light and slots; None where reception ended before.
        timeline: results of all frames of the clip that it is of.
    """
    frame, result, screen = shown.frame, shown.result, shown.screen
    reason, advice = split_message(result) if result.message else ("", "")
    title, frame_note = headline(result), ""
    if timeline:  # a clip is headed by what all its frames gave
        frame_note = f"Frame {result.frame} is shown: {title.lower()}."
        counted = packets_in_words([packet for entry in timeline for packet in entry.packets])
        title = capitalised(f"{counted}, {plural(len(timeline), 'frame')}")
    data = {
        "headline": title,
        "source": printable(result.source),
        "steps": _steps(result),
        "notes": [sentence for sentence in (frame_note, mirror_note(result), reason) if sentence],
        "advice": advice,
        "texts": [row for entry in timeline or [result] for row in text_rows(entry)],
        "facts": _facts(frame, result),
        "picture": picture_of(shown, preview(frame, _WIDTH_PX)),
        "maps": [drawn for drawn in (column_map(shown),) if drawn],
        "timeline": [
            [entry.frame, entry.time_s, headline(entry), len(entry.packets), entry.status in ("ok", "partial")]
            for entry in timeline
        ],
        "packets": packet_rows(result),
        "columns": column_rows(result),
        "inspection": None if known is None else _inspection(known),
        "quality": [asdict(each) for each in qualities(known, 1 / screen.slot_rate_hz)] if known and screen else [],
        "denoiser": result.denoiser
        and {"corrected": [c.column for c in result.columns if c.denoised], **result.denoiser},
        "times": {name: value for name, value in result.timing_ms.items() if math.isfinite(value)},
        "skipped": result.skipped,
        "search": [astuple(step) for step in result.search],
    }
    return fill(data, f"{printable(Path(result.source).name)}: {title.lower()}")


def fill(data: dict[str, Any], title: str) -> str:
    """The template with its style, scripts and data, so that the file needs no other."""
    pages = data_dir("pages")
    parts = {"mark": MARK, "title": html.escape(title)}
    parts |= {name: (pages / name).read_text(encoding="utf-8") for name in ("app.css", "view.js", "inspect.js")}
    # As Unicode escapes, markup in the data is no markup of the page.
    parts["data"] = json.dumps(plain(data), separators=(",", ":")).replace("<", "\\u003c")
    return filled_page("inspect.html", parts)


def _facts(frame: Frame, result: FrameResult) -> dict[str, str]:
    share, delay_s = height_share(result.corners, frame.height), result.line_delay_s
    facts = {
        "Picture": f"{frame.width} x {frame.height}",
        "Light": brightness_of(frame).word,
        "Screen": result.screen_profile or "not found",
        "Camera": result.camera_profile or ("estimated" if delay_s else "unknown"),
        "Screen fills of the height": None if share is None else f"{100 * share:.0f} %",
        "A row takes": f"{delay_s * 1e6:.3f} µs" if delay_s else None,
        "Columns": str(len(result.columns)) if result.columns else None,
    }
    return {name: value for name, value in facts.items() if value is not None}


def _steps(result: FrameResult) -> list[tuple[str, bool]]:
    """How far reception came."""
    return [
        ("picture read", result.status != "unreadable"),
        ("screen found", result.corners is not None),
        ("camera known", bool(result.line_delay_s)),
        ("clock found", bool(result.columns)),
        ("packets decoded", bool(result.packets)),
    ]


def _inspection(known: Inspection) -> dict[str, Any]:
    n_points = _FEW_POINTS if len(known.traces) > _MANY_COLUMNS else _POINTS
    return {
        **{name: getattr(known, name) for name in ("rows_per_slot", "histogram", "eye", "residuals", "crosstalk")},
        "traces": [_trace(trace, n_points) for trace in known.traces],
        "received": any(trace.borders.size for trace in known.traces),
    }


def _trace(trace: Trace, n_points: int) -> dict[str, Any]:
    """A column's light as steps of its height; its root is drawn, which shows dark parts, too."""
    step = max(1, trace.rows.size // n_points)
    root = np.sqrt(np.maximum(trace.light, 0))
    most = max(float(np.quantile(root, _TOP)), 1e-6) if root.size else 1.0

    def steps(values: FloatArray) -> list[int | None]:
        scaled = _STEPS * np.sqrt(np.maximum(values[::step], 0)) / most
        return [round(value) if math.isfinite(value) else None for value in scaled.tolist()]

    return {
        "column": trace.column.column,
        "status": trace.column.status,
        "rows": trace.rows[::step].round(1),
        "light": steps(trace.light),
        "model": steps(trace.model),
        "lit": np.round(trace.lit_spans, 1),
        "borders": trace.borders,
    }
