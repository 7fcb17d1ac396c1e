"""Reasons as sentences for people: `reasons.toml` has one for each, in which what was measured is filled in."""

import tomllib
from dataclasses import replace
from functools import cache
from math import ceil
from pathlib import Path
from typing import Any

from rxcli.types import ColumnResult, FrameResult, Remark


@cache
def sentences() -> dict[str, str]:
    """The sentence of every reason: what was observed; the next step."""
    return tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))


def sentence_of(remark: Remark) -> str:
    """The sentence of a remark."""
    facts: dict[str, Any] = {
        name: sentence_of(fact) if isinstance(fact, Remark) else fact for name, fact in remark.facts.items()
    }
    for name, scale, unit in (("_s", 1e6, "_us"), ("_hz", 1e-3, "_khz")):
        facts |= {key.removesuffix(name) + unit: scale * facts[key] for key in [*facts] if key.endswith(name)}
    exposure_s = facts.get("exposure_s") or 1.0
    facts["exposure"] = f"1/{1 / exposure_s:.0f} s" if exposure_s < 0.5 else f"{exposure_s:.2g} s"
    if "share" in facts:
        # Of a packet that a picture shows: further pictures show the rest of a text.
        facts |= {"share_percent": 100 * facts["share"], "n_photos": max(ceil(1 / max(facts["share"], 0.05)), 2)}
    return sentences()[remark.reason].format(**facts)


def explained(result: FrameResult) -> FrameResult:
    """The result with its remarks, and those of its columns, as messages."""
    message = "; ".join(map(sentence_of, result.remarks)) or result.message
    columns, screens = tuple(map(_explained, result.columns)), tuple(map(explained, result.other_screens))
    return replace(result, message=message, columns=columns, other_screens=screens)


def _explained(column: ColumnResult) -> ColumnResult:
    return column if column.remark is None else replace(column, message=sentence_of(column.remark))
