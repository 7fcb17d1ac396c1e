"""Thousands of random scenes: no exception, no warning, no NaN, no confident nonsense."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np

from rxcli.lab.benchmark.journal import SEEDS_A_RUN, Record, Run, Task
from rxcli.lab.benchmark.statistics import wilson
from rxcli.lab.benchmark.trial import score_result, simulate_trial
from rxcli.lab.benchmark.watch import problems_in, watched
from rxcli.lab.simulate.scenes import Scene, random_scene
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.receiver.pipeline import ReceiverOptions, receive
from rxcli.results.report import to_record
from rxcli.types import Frame, FrameResult

#: From this confidence on a packet claims to be right.
CONFIDENT = 0.99
#: Rows per slot of the small scenes, and their width in pixels.
_ROWS_PER_SLOT = (1.5, 6.0)
_WIDTH_PX = (48, 400)
#: Every so many random scenes are received again on other threads.
_THREADS_EVERY = 50
#: Size of the panel of small scenes: drawing the picture would otherwise take longer than the reception.
_PANEL_PX = (342, 192)

Problems = list[str]


def small(scene: Scene, width: float, rows_per_slot: float, **changes: Any) -> Scene:
    """A scene of the same time span on few pixels, and a coarse panel."""
    screen = msgspec.structs.replace(scene.screen, width_px=_PANEL_PX[0], height_px=_PANEL_PX[1])
    scene = replace(scene, screen=screen, n_frames=1, **changes)
    shrink = min(rows_per_slot / scene.rows_per_slot, 1.0)
    return scene.scaled(width / scene.sensor.width, shrink, keep_readout=True)


def inspect_frame(frame: Frame, options: ReceiverOptions) -> tuple[FrameResult | None, Problems]:
    """Receive one frame under watch; returns the result, None where it raised, and everything that is wrong."""
    result = None
    with watched() as found:
        try:
            result = next(iter(receive([frame], options)))
        except Exception as error:  # whatever it is, it is what we look for
            found.append(f"{type(error).__name__}: {error}")
    return result, unique([*found, *(_nonsense(result) if result else ())])


def unique(problems: Problems) -> Problems:
    """Problems without repetition, in order."""
    return list(dict.fromkeys(problems))


def _nonsense(result: FrameResult) -> Iterator[str]:
    """What a result must never say."""
    yield from problems_in(replace(result, timing_ms={}), "result")
    for column in result.columns:
        for packet in column.packets:
            if not (0 <= packet.confidence <= 1 and 0 <= packet.ber_hat <= 1):
                yield f"confidence {packet.confidence}, ber_hat {packet.ber_hat} out of 0..1"
            if len(packet.payload) != 2 * -(-packet.payload_bits // 8):
                yield f"payload of {len(packet.payload)} hex digits for {packet.payload_bits} bits"
        if not column.packets and not column.message:
            yield f"column {column.column} has neither packet nor message"
    if not result.columns and not result.message:
        yield "neither columns nor message"


def thread_orders(frame: Frame, options: ReceiverOptions) -> Problems:
    """The same frame on one thread, on several, and several times at once: the same bits must come out."""
    import cv2

    before, texts = cv2.getNumThreads(), []
    try:
        for threads in (1, 4):
            cv2.setNumThreads(threads)
            texts.append(_bits(frame, options))
        with ThreadPoolExecutor(3) as pool:
            texts += pool.map(lambda _: _bits(frame, options), range(3))
    finally:
        cv2.setNumThreads(before)
    return [] if len(set(texts)) == 1 else ["results differ with the order of threads"]


def _bits(frame: Frame, options: ReceiverOptions) -> str:
    result = replace(next(iter(receive([frame], options))), timing_ms={})
    return json.dumps(to_record(result), sort_keys=True)


def small_scene(seed: int) -> Scene:
    """A random scene on few pixels, from clean to hopeless."""
    rng = np.random.default_rng([seed, 9])
    scene = random_scene(rng)
    width, rows = rng.integers(*_WIDTH_PX), rng.uniform(*_ROWS_PER_SLOT)
    return _brighter(small(scene, float(width), rows), 10 ** rng.uniform(-0.5, 1.5))


def _brighter(scene: Scene, factor: float) -> Scene:
    """The scene with more electrons behind the same picture: few pixels have to do with what many would gather."""
    return replace(
        scene,
        light_e_per_s=scene.light_e_per_s * factor,
        room=replace(scene.room, light_e_per_s=scene.room.light_e_per_s * factor),
        sensor=replace(scene.sensor, full_scale_e=scene.sensor.full_scale_e * factor),
    )


def scene_record(task: Task) -> Record:
    """Receive one random scene under watch; returns problems and what the packets claimed."""
    seed = int(task["seed"])
    rng = np.random.default_rng([seed, 10])
    trial = simulate_trial(small_scene(seed), seed)
    screens = _all_screens() if rng.random() < 0.2 else ()
    options = trial.options(known_outline=bool(rng.random() < 0.7))
    options = replace(options, screens=(*options.screens, *screens))
    result, problems = inspect_frame(trial.frame, options)
    if seed % _THREADS_EVERY == 0:
        problems += _tried(lambda: thread_orders(trial.frame, options))
    if result is None:
        return {"problems": problems, "status": "exception", "confident": 0, "wrong": 0, "packets": 0, "false": 0}
    scored, score = score_result(result, trial.truth)
    confident = [packet for packet in scored.packets if packet.confidence >= CONFIDENT]
    return {
        "problems": problems,
        "status": result.status,
        "packets": len(scored.packets),
        "false": score.false,
        "confident": len(confident),
        "wrong": sum(packet.bit_errors != 0 for packet in confident),
    }


@lru_cache(maxsize=1)
def _all_screens() -> tuple[ScreenProfile, ...]:
    return tuple(load_profile(name, ScreenProfile) for name in ("paper-8k65", "paper-17k3", "paper-34k6"))


def _tried(case: Callable[[], Problems]) -> Problems:
    try:
        return case()
    except Exception as error:  # whatever it is, it is what we look for
        return [f"{type(error).__name__}: {error}"]


@dataclass(frozen=True)
class Verdict:
    """What a stability run found."""

    #: Problem -> seeds of the random scenes that show it.
    scenes: dict[str, list[int]]
    n_scenes: int
    confident: int
    wrong: int
    status: dict[str, int]

    @property
    def wrong_interval(self) -> tuple[float, float]:
        """Wilson interval of the share of wrong packets among those that claim to be right."""
        return wilson(self.wrong, self.confident)

    @property
    def within_rate(self) -> bool:
        """Whether confident packets are wrong no more often than they say, as far as the run can tell."""
        return self.wrong_interval[0] <= 1 - CONFIDENT

    @property
    def stable(self) -> bool:
        """Whether nothing was found."""
        return not self.scenes and self.within_rate


def run(n_scenes: int, how: Run) -> Verdict:
    """Receive `n_scenes` random scenes under watch."""
    records = how.scenes("scenes", scene_record, n_scenes)
    scenes: dict[str, list[int]] = {}
    for number, record in enumerate(records, SEEDS_A_RUN * how.seed):
        for problem in record["problems"]:
            scenes.setdefault(problem, []).append(number)
    status = [str(record["status"]) for record in records]
    return Verdict(
        scenes=scenes,
        n_scenes=n_scenes,
        confident=sum(record["confident"] for record in records),
        wrong=sum(record["wrong"] for record in records),
        status={name: status.count(name) for name in sorted(set(status))},
    )


def rows(verdict: Verdict) -> list[dict[str, Any]]:
    """The verdict as a table: one row per problem."""
    table = [
        {"check": f"{len(seeds)} random scenes", "result": problem, "seeds": " ".join(map(str, seeds[:5]))}
        for problem, seeds in verdict.scenes.items()
    ]
    return table or [{"check": f"{verdict.n_scenes} random scenes", "result": "ok", "seeds": ""}]
