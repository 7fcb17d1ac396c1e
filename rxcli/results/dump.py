"""Arrays at the stage boundaries, written for people and for tests: one NPZ a frame."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rxcli.outputs import TAPS, check_replaceable, replacing, unwritable


def dump_stages(folder: Path, source: str, frame: int, stages: Mapping[str, Any]) -> Path:
    """Write arrays, and dataclasses of arrays, to `folder`/SOURCE-FRAME.npz.

    In frames' dumps stages and fields are those of `rxcli.types`; `geometry.corners` and `channel.metrics` stand beside
    them. Bit log-likelihood ratios are ln p(1)/p(0).

    Args:
        folder: made where it does not exist.
        source: path or device that the frame came from.
        frame: its number.
        stages: name -> array, or dataclass whose fields are written as `name.field`; None is left out.

    Raises:
        OutputError: the folder cannot be written, or holds a file of this name that is none of ours.
    """
    arrays: dict[str, Any] = {name: array for stage, value in stages.items() for name, array in _arrays(stage, value)}
    path = folder / f"{plain_name(source)}-{frame:06d}.npz"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(path, error) from None
    check_replaceable(path, TAPS, "--dump-dir")
    with replacing(path) as hidden:
        np.savez(hidden, **arrays)
    return path


def plain_name(source: str) -> str:
    """The name of a source's file, as any file system takes it."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", Path(source).name) or "frame"


def _arrays(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if is_dataclass(value):
        for item in fields(value):
            yield from _arrays(f"{name}.{item.name}", getattr(value, item.name))
    elif value is not None:
        yield name, np.asarray(value)
