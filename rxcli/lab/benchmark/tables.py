"""Plain tables for people, CSV and JSON for programs, and a plot."""

from __future__ import annotations

import csv
import io
import json
import logging
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rxcli.outputs import make_parent, write_whole

log = logging.getLogger(__name__)

Row = dict[str, Any]
#: Rates of zero stand here on a logarithmic axis.
_BOTTOM = 1e-6


def format_table(rows: Sequence[Row]) -> str:
    """Rows of equal keys as an aligned table; numbers to the right."""
    if not rows:
        return "(nothing to show)"
    names = list(rows[0])
    cells = [names, *([format_value(row.get(name)) for name in names] for row in rows)]
    widths = [max(len(line[i]) for line in cells) for i in range(len(names))]
    numeric = [all(isinstance(row.get(name), (int, float, type(None))) for row in rows) for name in names]
    pads = [str.rjust if right else str.ljust for right in numeric]
    lines = ["  ".join(pad(cell, w) for pad, cell, w in zip(pads, line, widths, strict=True)) for line in cells]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(line.rstrip() for line in lines)


def format_value(value: Any) -> str:
    """A value as it stands in a table: four significant digits, an interval as `low..high`, `-` for unknown."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1 else f"{value:.4g}"
    if isinstance(value, (tuple, list)):
        return "..".join(format_value(part) for part in value)
    return str(value)


def to_csv(rows: Sequence[Row]) -> str:
    """Rows as CSV; an interval becomes two columns `NAME_low`, `NAME_high`."""
    flat = [dict(part for name, value in row.items() for part in _parts(name, value)) for row in rows]
    names = list(dict.fromkeys(name for row in flat for name in row))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return buffer.getvalue()


def _parts(name: str, value: Any) -> list[tuple[str, Any]]:
    is_interval = isinstance(value, (tuple, list))
    return list(zip((f"{name}_low", f"{name}_high"), value, strict=True)) if is_interval else [(name, value)]


def write_outputs(folder: Path, name: str, rows: Sequence[Row], details: Any = None) -> list[Path]:
    """Write `NAME.csv` and `NAME.json` into `folder`; returns where.

    Args:
        folder: made where it does not exist.
        name: of the files.
        rows: the table.
        details: what the JSON holds beside the table.
    """
    content = {"rows": list(rows), **({} if details is None else {"details": details})}
    return [
        write_text(folder / f"{name}.csv", to_csv(rows)),
        write_text(folder / f"{name}.json", json.dumps(content, indent=1) + "\n"),
    ]


def write_text(path: Path, text: str) -> Path:
    """Write a file and the folder it lies in.

    Raises:
        OutputError: it cannot be written.
    """
    make_parent(path)
    write_whole(path, text)
    return path


def titled(sections: Iterable[tuple[str, Sequence[Row]]]) -> str:
    """Several tables under their titles."""
    return "\n\n".join(f"{title}\n{format_table(rows)}" for title, rows in sections)


def plot(rows: Sequence[Row], path: Path, measure: str, interval: str, across: str = "scenes") -> bool:
    """Draw one measure of a table with its intervals, a line for each way; False where matplotlib is not installed.

    Args:
        rows: the table.
        path: of the PNG.
        measure: a column between 0 and 1; error rates stand on a logarithmic axis.
        interval: the column of its intervals.
        across: the column along the other axis.
    """
    if find_spec("matplotlib") is None:
        log.warning("no plots: matplotlib is not installed (pip install '.[plot]')")
        return False
    from matplotlib.figure import Figure

    figure = Figure(figsize=(max(6.4, 0.7 * len({row[across] for row in rows})), 4.8), layout="constrained")
    axes = figure.subplots()
    names = list(dict.fromkeys(row[across] for row in rows))
    for way in dict.fromkeys(row.get("way") for row in rows):
        mine = [row for row in rows if row.get("way") == way and row[measure] is not None]
        values = [max(row[measure], _BOTTOM) for row in mine]
        low = [max(value - max(row[interval][0], _BOTTOM), 0.0) for value, row in zip(values, mine, strict=True)]
        high = [max(row[interval][1] - value, 0.0) for value, row in zip(values, mine, strict=True)]
        x = [names.index(row[across]) for row in mine]
        axes.errorbar(x, values, yerr=[low, high], fmt="o-", capsize=2, label=way or measure)
    axes.set_xticks(range(len(names)), names, rotation=30, ha="right")
    if measure == "ber":
        axes.set_yscale("log")
    axes.set(ylabel=measure, ylim=(_BOTTOM / 2 if measure == "ber" else 0, 1))
    axes.legend(fontsize=8)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=130, format="png")
    write_whole(path, buffer.getvalue())
    return True
