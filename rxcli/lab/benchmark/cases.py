"""A case is a scene or clip as a receiver gets it. The ways to receive one, and the record of a reception."""

import json
import os
import shutil
import subprocess
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from functools import lru_cache
from multiprocessing.connection import Connection
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import cv2
import msgspec
import numpy as np

from rxcli.ingest import open_source
from rxcli.lab.benchmark.media import bare_decode
from rxcli.lab.benchmark.trial import SOURCE, Trial
from rxcli.lab.benchmark.yardsticks import bound_result, paper_result
from rxcli.link.collector import Collector, PhotoCollector
from rxcli.options import SKIPS, ReceiverOptions
from rxcli.outputs import write_whole
from rxcli.profiles import CameraProfile, ScreenProfile, dump_profile
from rxcli.receiver.receive import receive, receive_frame
from rxcli.results.cameras import estimated_camera
from rxcli.results.record import from_record
from rxcli.results.truth import Scorer, Truth, truth_path
from rxcli.runs.processes import ONE_THREAD, environment, peak_memory_mb, start_process
from rxcli.types import FloatArray, Frame, FrameResult

Record = dict[str, Any]
#: Receives a case; results in order of time.
Way = Callable[["Case"], Iterable[FrameResult]]

#: OpenBLAS kernel of the way `OTHER_KERNEL`: runs on every x86-64 processor and is the native one of none sold today.
KERNEL = "Prescott"
#: Share of the pixels that a rounding error of one grey level hits in the way "grey levels".
_GREY_SHARE = 0.01
#: Right packets with a common shift of their column numbers from which the numbering counts as shifted.
_MIN_SHIFTED = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """One scene or clip as a receiver gets it, with what is known of it."""

    #: A file, files of photographs that are taken of one transmission, or frames in memory.
    source: tuple[Path, ...] | tuple[Frame, ...]
    options: ReceiverOptions
    #: Rows of the table that count this case, beside the row of all cases.
    groups: tuple[str, ...] = ()
    #: What was drawn, as JSON values.
    about: Record
    #: What was sent, where that is known.
    truth: Truth | None = None
    #: The same with all that the simulator knows, as it stands beside a capture.
    whole_truth: Record | None = None
    #: False for pictures from which nothing may be reported.
    has_data: bool = True
    #: (4, 2) true corners of the screen on the stored picture.
    corners: FloatArray | None = None
    #: With screen, camera and corners named, as far as a perfect calibration knows them.
    named: ReceiverOptions | None = None
    #: The text that the screen sends.
    text: str | None = None
    #: The simulated photographs, for the bound and the paper's pipeline.
    trials: tuple[Trial, ...] = ()
    #: The same without what is measured: its picture at rest, its camera upright and plain.
    twin: "Case | None" = None

    def receive(
        self, options: ReceiverOptions, changed: Callable[[Frame], Frame] | None = None
    ) -> Iterator[FrameResult]:
        """The results of all sources, photographs numbered as the frames of a clip."""
        sources = self.sources()
        for number, frames in enumerate(sources):
            for result in receive(map(changed, frames) if changed else frames, options):
                yield result if len(sources) == 1 else replace(result, frame=number)

    def sources(self) -> list[Iterable[Frame]]:
        """The frames of every source."""
        files = [open_source(source) for source in self.source if isinstance(source, Path)]
        return list(files) or [[source for source in self.source if isinstance(source, Frame)]]


def write_case(case: Case, stem: Path) -> list[Path]:
    """Write a case as files of this stem, their truth beside them; returns where."""
    stem.parent.mkdir(parents=True, exist_ok=True)
    paths = []
    for number, file in enumerate(path for path in case.source if isinstance(path, Path)):
        turn = f"-{number}" if len(case.source) > 1 else ""
        paths.append(shutil.copyfile(file, stem.with_name(stem.name + turn + file.suffix)))
    known: Sequence[Any] = [trial.capture.truth for trial in case.trials]
    truths = known or [case.whole_truth or case.truth] * len(paths)
    for path, truth in zip(paths, truths, strict=True):
        if truth is not None:
            write_whole(truth_path(path), msgspec.json.encode(truth, enc_hook=float))
    return paths


def arguments_of(paths: Sequence[Path], options: ReceiverOptions) -> list[str]:
    """The arguments of `vlc-rx` that receive a written case with some options; profiles go beside the file."""
    arguments = ["decode", *map(str, paths), "--json", "-", "--quiet", "--truth", "auto", "--cae", options.cae]
    named: list[ScreenProfile | CameraProfile] = list(options.cameras if options.force_camera else ())
    named += () if options.screens == ReceiverOptions().screens else options.screens
    for number, profile in enumerate(named):
        toml = paths[0].with_suffix(f".{number}.toml")
        write_whole(toml, dump_profile(profile))
        arguments += [f"--{profile.kind}", str(toml)]
    if options.corners is not None:
        arguments += ["--corners", *(f"{x:.3f},{y:.3f}" for x, y in options.corners)]
    return arguments + [part for name in SKIPS if name not in options.skip for part in ("--no-skip", name)]


def _with_options(**changes: Any) -> Way:
    return lambda case: case.receive(replace(case.options, **changes))


def _on_two_threads(case: Case) -> Iterator[FrameResult]:
    with threads(2):
        yield from case.receive(case.options)


def _as_photographs(case: Case) -> Iterator[FrameResult]:
    """Every frame of a clip alone, with the camera of the first one that shows it, as by --same-camera."""
    options = case.options
    for frame in case.sources()[0]:
        yield (result := receive_frame(frame, options))
        if options is case.options and result.gives_camera:
            camera = estimated_camera(frame, result, "same-camera")
            options = replace(options, cameras=(camera,), force_camera=True)


def _by_command(case: Case) -> Iterator[FrameResult]:
    """By `vlc-rx decode` in a process of its own: what a user waits for, start-up included."""
    paths = [path for path in case.source if isinstance(path, Path)]
    command = [sys.executable, "-P", "-m", "rxcli.cli.main", *arguments_of(paths, case.options)]
    done = subprocess.run(command, stdout=subprocess.PIPE, check=False)
    yield from (from_record(json.loads(line)) for line in done.stdout.splitlines())


RECEIVER, OTHER_KERNEL, TWIN = "receiver", "another kernel", "twin"
#: Name of a way -> how it receives a case. `OTHER_KERNEL` is `RECEIVER` in another process, `TWIN` of the twin.
WAYS: dict[str, Way] = {
    RECEIVER: _with_options(),
    "corners given": lambda case: case.receive(replace(case.options, corners=case.corners)),
    "camera and corners given": lambda case: case.receive(case.named or case.options),
    "photographs": _as_photographs,
    "frames one by one": _with_options(skip=frozenset(SKIPS) - {"tracking"}),
    "searched": _with_options(corners=None),
    "no auto-encoder": _with_options(cae="never"),
    "auto-encoder always": _with_options(cae="always"),
    **{f"no skip of {name}": _with_options(skip=frozenset(SKIPS) - {name}) for name in SKIPS},
    "no skip at all": _with_options(skip=frozenset()),
    "two threads": _on_two_threads,
    "command": _by_command,
    "grey levels": lambda case: case.receive(case.options, with_grey_levels),
    "bound": lambda case: map(bound_result, case.trials),
    "paper": lambda case: map(paper_result, case.trials),
}


@contextmanager
def threads(n: int) -> Iterator[None]:
    """OpenCV and the matrix library on `n` threads for a while, so that times mean the same on every machine."""
    from threadpoolctl import threadpool_limits

    before = cv2.getNumThreads()
    cv2.setNumThreads(n)
    try:
        with threadpool_limits(n):
            yield
    finally:
        cv2.setNumThreads(before)


def _cpu_s() -> float:
    """Processor time of this process and of its children that have ended."""
    children = os.times()
    return process_time() + children.children_user + children.children_system


def received(case: Case, way: str) -> Record:
    """Receive a case in one of the ways; the record of it, as JSON values.

    An exception is a finding here: it stands in the record like a warning and NaN in a result.
    """
    if way == TWIN:
        assert case.twin is not None, "drawn where this way is asked for"
        return received(case.twin, RECEIVER)
    if way == OTHER_KERNEL:
        # A trial stays here: its simulation is large, and no receiver looks at it.
        _other_kernel().send(replace(case, trials=()))
        return dict(_other_kernel().recv())
    scorer = None if case.truth is None else Scorer(case.truth)
    results: list[FrameResult] = []
    problems: list[str] = []
    start, wall = _cpu_s(), perf_counter()
    with threads(1), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            results.extend(result if scorer is None else scorer.add(result) for result in WAYS[way](case))
        except Exception as error:
            problems.append(f"{type(error).__name__}: {error}")
    cpu_s, wall_s = _cpu_s() - start, perf_counter() - wall
    problems += [f"{w.category.__name__}: {w.message} ({Path(w.filename).name}:{w.lineno})" for w in caught]
    problems += [problem for result in results for problem in nonsense(result)]
    stages_ms = sum((Counter(result.timing_ms) for result in results), Counter[str]())
    return {
        "cpu_s": cpu_s,
        "wall_s": wall_s,
        # Of a clip, its last frame included.
        "seconds": results[-1].time_s * len(results) / (len(results) - 1) if len(results) > 1 else None,
        "stages_ms": dict(stages_ms),
        "mb": peak_memory_mb(),
        "kernel": os.environ.get("OPENBLAS_CORETYPE"),
        "problems": list(dict.fromkeys(problems)),
        "score": None if scorer is None else asdict(scorer.score()),
        "packets": [packet for result in results for packet in _packets(result, case)],
        "texts": [text == case.text for text in _texts(results, case)],
        **(_found(results[0], case) if results else {"status": "exception"}),
    }


@lru_cache(maxsize=1)
def _other_kernel() -> Connection:
    """To a process whose matrix library uses `KERNEL`: the library chooses once, when it is loaded."""
    with environment({**ONE_THREAD, "OPENBLAS_CORETYPE": KERNEL}):
        return start_process(_serve)[1]


def _serve(connection: Connection) -> None:
    """Receive what comes until this daemon ends with the process that started it."""
    while True:
        connection.send(received(connection.recv(), RECEIVER))


def bare(case: Case) -> Record:
    """Frames of a case's file, and seconds that its bare decode takes; nothing where there is none."""
    decode = bare_decode(case.source[0]) if isinstance(case.source[0], Path) and len(case.source) == 1 else None
    if decode is None:
        return {}
    with threads(1):
        start, wall = process_time(), perf_counter()
        n_frames = decode()
    return {"bare_cpu_s": process_time() - start, "bare_wall_s": perf_counter() - wall, "n_frames": n_frames}


def _packets(result: FrameResult, case: Case) -> Iterator[Record]:
    """What one scored frame reported of every packet; where no truth is known none is wrong."""
    for column in result.columns:
        for packet in column.packets:
            false = packet.payload_bits if case.truth is not None or not case.has_data else 0
            wrong = false if packet.bit_errors is None else packet.bit_errors
            place = {"frame": result.frame, "column": column.column, "payload": packet.payload}
            features = packet.confidence_features
            yield {**place, "confidence": packet.confidence, "bit_errors": wrong, "evidence": features}


def _texts(results: Sequence[FrameResult], case: Case) -> Iterator[str | None]:
    """The messages that the link layer makes of the results, photographs together."""
    collector = (PhotoCollector if len(case.trials) > 1 else Collector)(case.options.screens)
    for result in results if case.text is not None else ():
        added = collector.add(replace(result, source=SOURCE))
        # A clip's end brings what was left.
        ended = result is results[-1] and not case.trials
        yield from (message.text for message in (collector.finish(added) if ended else added).messages)


def _found(result: FrameResult, case: Case) -> Record:
    """Screen and camera as estimated from the first frame."""
    found, truth = result.corners, case.corners
    return {
        "status": result.status,
        "rows_per_slot": result.estimated.get("rows_per_slot"),
        "corner_error": corner_error(found, truth) if found is not None and truth is not None else None,
        "shift": column_shift(result, case.truth) if case.truth is not None else 0,
        "numbered": result.column_offset is not None,
        "certainty": result.column_certainty,
    }


def corner_error(found: FloatArray, truth: FloatArray) -> float:
    """Largest distance of a corner in screen widths, whichever comes first in their order."""
    distances = [np.linalg.norm(np.roll(found, turn, axis=0) - truth, axis=1).max() for turn in range(4)]
    return float(min(distances) / np.linalg.norm(truth[1] - truth[0]))


def column_shift(result: FrameResult, truth: Truth) -> int:
    """Number of columns by which right packets stand under a wrong number; 0 where they stand under their own."""
    sent = {(p, column) for burst in truth.payload.values() for column, p in enumerate(burst) if len(p) > 2}
    reported = ((column.column, packet.payload) for column in result.columns for packet in column.packets)
    votes = Counter(column - own for column, payload in reported for this, own in sent if this == payload)
    best = max(votes, key=votes.__getitem__, default=0)
    return best if votes[best] >= _MIN_SHIFTED and votes[best] > votes[0] else 0


# The same picture with a change that no receiver should notice.


def with_grey_levels(frame: Frame) -> Frame:
    """The frame with one grey level more or less on 1 % of its pixels; deterministic for a frame."""
    rng = np.random.default_rng(frame.index)
    pixels = frame.pixels.astype(np.int32)
    pixels += rng.choice([-1, 0, 1], pixels.shape, p=[_GREY_SHARE / 2, 1 - _GREY_SHARE, _GREY_SHARE / 2])
    changed: Any = pixels.clip(0, np.iinfo(frame.pixels.dtype).max).astype(frame.pixels.dtype)
    return replace(frame, pixels=changed)


def nonsense(result: FrameResult) -> Iterator[str]:
    """What a result must never hold."""
    yield from problems_in(replace(result, timing_ms={}), "result")
    for column in result.columns:
        for packet in column.packets:
            if not (0 <= packet.confidence <= 1 and 0 <= packet.ber_hat <= 1):
                yield f"confidence {packet.confidence}, ber_hat {packet.ber_hat} out of 0..1"
            if len(packet.payload) != 2 * -(-packet.payload_bits // 8):
                yield f"payload of {len(packet.payload)} hex digits for {packet.payload_bits} bits"
        if not column.packets and not column.remark:
            yield f"column {column.column} has neither packet nor message"
    if not result.columns and not result.remarks:
        yield "neither columns nor message"


def problems_in(value: Any, name: str) -> Iterator[str]:
    """Places in `value` that hold NaN or positive infinity; -inf is the logarithm of an impossible event."""
    if is_dataclass(value) and not isinstance(value, type):
        # Soft bits hold NaN by their contract.
        for part in (part.name for part in fields(value) if part.name != "bit_llr"):
            yield from problems_in(getattr(value, part), f"{name}.{part}")
    elif isinstance(value, (tuple, list, dict)):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, part in items:
            yield from problems_in(part, f"{name}[{key!r}]")
    elif isinstance(value, (float, np.ndarray, np.floating)) and np.asarray(value).dtype.kind == "f":
        if np.isnan(value).any():
            yield f"{name} holds NaN"
        if np.isposinf(value).any():
            yield f"{name} holds infinity"
