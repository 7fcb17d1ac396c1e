"""Arrays at the stage boundaries, written for people and for tests: one NPZ a frame."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rxcli.errors import failure_explained
from rxcli.outputs import TAPS, tapped
from rxcli.types import BurstPosteriors, Clock, Float32Array, FloatArray, OnTaps, RowProfiles, SlotSamples

#: Longer names, of the 255 bytes that file systems take, are cut where something is appended.
MAX_NAME_BYTES = 200


@dataclass(frozen=True, slots=True)
class Taps:
    """The arrays of every stage boundary of one photograph: what each stage hands to the next."""

    #: (4, 2) float64 stored pixels, top-left first, clockwise as a viewer sees the screen: where the screen is, by the
    #: decided slots, and where the light was read.
    corners: FloatArray
    sampled_corners: FloatArray
    #: Out of sampling: the light of every strip on every row.
    profiles: RowProfiles
    #: Out of sync: the link's time, and the light resampled to it in the initial pass.
    clock: Clock
    samples: SlotSamples
    #: (C, N) float32, out of the channel: log-likelihood ratio of each slot being lit; of `samples`, and of the last
    #: pass of each column.
    initial_llr: Float32Array
    llr: Float32Array
    #: Out of detection.
    posteriors: BurstPosteriors


def read_taps(path: str | Path) -> Taps:
    """Read what `--dump-dir` wrote of a photograph.

    Raises:
        InputError: no such file, or not the taps of a photograph.
    """
    with failure_explained(f"{path}: not the taps of a photograph", "write them with --dump-dir"):
        with np.load(path) as file:
            arrays = dict(file)
        kinds = {"sampling": RowProfiles, "clock": Clock, "samples": SlotSamples, "detect": BurstPosteriors}
        return taps_of(arrays | {name: _stage(arrays, name, kind) for name, kind in kinds.items()})


def taps_of(stages: Mapping[str, Any]) -> Taps:
    """The arrays that a photograph's reception hands to its callback."""
    names = ("geometry.corners", "geometry.sampled_corners", "sampling", "clock", "samples")
    return Taps(*(stages[name] for name in (*names, "channel.initial_llr", "channel.llr", "detect")))


def _stage(arrays: Mapping[str, Any], name: str, kind: type[Any]) -> Any:
    """One stage's dataclass; what was None was left out."""
    found: dict[str, Any] = {item.name: arrays.get(f"{name}.{item.name}") for item in fields(kind)}
    scalars = {key: value.item() for key, value in found.items() if value is not None and not value.ndim}
    return kind(**(found | scalars))


def taps_writer(folder: Path | None) -> OnTaps | None:
    """Writes the taps of every frame to a folder, or None; see `dump_stages`."""
    return None if folder is None else partial(dump_stages, folder)


def dump_stages(folder: Path, source: str, frame: int, stages: Mapping[str, Any]) -> Path:
    """Write arrays, and dataclasses of arrays, to `folder`/SOURCE-FRAME.npz.

    In frames' dumps stages and fields are those of `rxcli.types`; `geometry.corners` and `channel.llr` stand beside
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
    with tapped(path, TAPS, "--dump-dir") as hidden:
        np.savez(hidden, **arrays)
    return path


def plain_name(source: str) -> str:
    """The name of a source's file, as any file system takes it, with room for an ending."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", Path(source).name)[:MAX_NAME_BYTES] or "frame"


def _arrays(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if is_dataclass(value):
        for item in fields(value):
            yield from _arrays(f"{name}.{item.name}", getattr(value, item.name))
    elif value is not None:
        yield name, np.asarray(value)
