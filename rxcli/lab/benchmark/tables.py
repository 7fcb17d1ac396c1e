"""Plain tables for people, CSV and JSON for programs."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from rxcli.outputs import make_parent, write_whole

Row = dict[str, Any]


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
    flat = [_flat(row) for row in rows]
    names = list(dict.fromkeys(name for row in flat for name in row))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(flat)
    return buffer.getvalue()


def _flat(row: Row) -> Row:
    out: Row = {}
    for name, value in row.items():
        if isinstance(value, (tuple, list)):
            out[f"{name}_low"], out[f"{name}_high"] = value
        else:
            out[name] = value
    return out


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
