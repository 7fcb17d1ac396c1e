"""Plain tables for people, CSV and JSON for programs, and a plot."""

import csv
import io
import json
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rxcli.outputs import write_whole
from rxcli.results.report import format_table

log = logging.getLogger(__name__)

Row = dict[str, Any]


def as_text(rows: Sequence[Row]) -> str:
    """Rows of equal keys as an aligned table."""
    if not rows:
        return "(nothing to show)"
    return format_table(rows[0], ([format_value(row.get(name)) for name in rows[0]] for row in rows))


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
    flat: list[Row] = [{} for _ in rows]
    for row, cells in zip(rows, flat, strict=True):
        for name, value in row.items():
            is_interval = isinstance(value, (tuple, list))
            cells.update(zip((f"{name}_low", f"{name}_high"), value, strict=True) if is_interval else [(name, value)])
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, dict.fromkeys(name for row in flat for name in row), lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return buffer.getvalue()


def write_outputs(folder: Path, name: str, rows: Sequence[Row], details: Any) -> list[Path]:
    """Write a table as `NAME.csv`, and with its details as `NAME.json`; returns where.

    Raises:
        OutputError: it cannot be written.
    """
    texts = {".csv": to_csv(rows), ".json": json.dumps({"rows": list(rows), "details": details}, indent=1) + "\n"}
    for suffix, text in texts.items():
        write_whole(folder / f"{name}{suffix}", text)
    return [folder / f"{name}{suffix}" for suffix in texts]


def titled(sections: Iterable[tuple[str, Sequence[Row]]]) -> str:
    """Several tables under their titles."""
    return "\n\n".join(f"{title}\n{as_text(rows)}" for title, rows in sections)


def plot(rows: Sequence[Row], path: Path, measure: str, interval: str, across: str = "scenes") -> None:
    """Draw one measure of a table with its intervals, a line for each way.

    Args:
        rows: the table.
        path: of the PNG.
        measure: a column, between 0 and 1 but for `kbps`.
        interval: the column of its intervals.
        across: the column along the other axis.
    """
    names = list(dict.fromkeys(row[across] for row in rows))

    def draw(axes: Any) -> None:
        for number, way in enumerate(dict.fromkeys(row.get("way") for row in rows)):
            mine = [row for row in rows if row.get("way") == way and row[measure] is not None]
            # Lines step aside a little, lest their intervals cover each other.
            x = [names.index(row[across]) + 0.05 * number for row in mine]
            axes.plot(x, [row[measure] for row in mine], "o-", color=f"C{number}", label=way or measure)
            axes.vlines(x, *([row[interval][end] for row in mine] for end in (0, 1)), color=f"C{number}")
        axes.set_xticks(range(len(names)), names, rotation=30, ha="right")
        if measure == "ber":
            axes.set_yscale("symlog", linthresh=1e-5)
        axes.set(ylabel=measure, ylim=(0, None if measure == "kbps" else 1))

    draw_figure(draw, path, width=max(6.4, 0.7 * len(names)))


def plot_error_over_time(points: Mapping[str, Sequence[tuple[float, float]]], stem: Path) -> list[Path]:
    """Draw bit error rate against run time as PNG and SVG; returns where.

    Args:
        points: way -> seconds and bit error rate of every file; a large mark stands for their means.
        stem: path without suffix.
    """

    def draw(axes: Any) -> None:
        for number, (way, found) in enumerate(points.items()):
            seconds, rates = zip(*found, strict=True)
            mean = sum(seconds) / len(found), sum(rates) / len(found)
            axes.plot(seconds, rates, ".", color=f"C{number}", alpha=0.5)
            axes.plot(*mean, "o", color=f"C{number}", markersize=11, label=f"{way}, mean of all files")
        axes.set_xscale("log")
        axes.set_yscale("symlog", linthresh=1e-4)
        axes.set(xlabel="processor time of a file, s", ylabel="bit error rate, lost packets included", ylim=(-2e-5, 1))

    return draw_figure(draw, *(stem.with_name(stem.name + suffix) for suffix in (".png", ".svg")))


def draw_figure(draw: Callable[[Any], None], *paths: Path, width: float = 6.4) -> list[Path]:
    """Have `draw` fill the axes of a figure, write it to `paths`; returns where, nothing without matplotlib."""
    if find_spec("matplotlib") is None:
        log.warning("no plots: matplotlib is not installed (pip install matplotlib)")
        return []
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, 4.8), layout="constrained")
    axes = figure.subplots()
    draw(axes)
    axes.legend(fontsize=8)
    for path in paths:
        figure.savefig(path, dpi=130)
    return list(paths)
