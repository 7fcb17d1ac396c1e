"""Data sets: made once, kept in a folder, picked up where an interrupted run left them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from rxcli.benchmark.trial import simulate_trial
from rxcli.denoise import Scene, network_inputs
from rxcli.pipeline import denoiser_scene
from rxcli.protocol import HEADER
from rxcli.simulate.camera import Exposure
from rxcli.simulate.scenes import Scene as SimulatedScene
from rxcli.training.columns import random_examples
from rxcli.training.fit import Sample
from rxcli.training.scenes import SCENE_CLASSES, random_picture, training_scene, validation_scene
from rxcli.types import Clock

#: Examples that are cut from one picture.
EXAMPLES_PER_PICTURE = 12
_SCREENS = ("paper-34k6", "paper-17k3")
_PICTURE_SIZE = (1366, 768)
#: Streams of random numbers.
_COLUMNS, _FRAMES, _VALIDATION = 5, 77, 900_000


def column_samples(n_pictures: int, seed: int, folder: Path, *, progress: bool = True) -> list[Sample]:
    """Samples of small screens without pixels.

    Args:
        n_pictures: pictures, of `EXAMPLES_PER_PICTURE` samples each.
        seed: equal ones give equal samples.
        folder: cache.
        progress: show a bar on stderr.
    """

    def make(number: int) -> list[Sample]:
        rng = np.random.default_rng([_COLUMNS, seed, number])
        picture = random_picture(rng, *_PICTURE_SIZE)
        return [_sample(e.scene, e.slots) for e in random_examples(rng, picture, EXAMPLES_PER_PICTURE)]

    return list(_cached(make, n_pictures, folder / f"columns-{seed}", "columns", progress))


def frame_samples(n_frames: int, seed: int, folder: Path, *, progress: bool = True) -> list[Sample]:
    """Samples of whole simulated frames, as the receiver samples them; frames without a lock are left out.

    Args:
        n_frames: frames to simulate.
        seed: equal ones give equal samples.
        folder: cache.
        progress: show a bar on stderr.
    """

    def make(number: int) -> list[Sample]:
        rng = np.random.default_rng([_FRAMES, seed, number])
        return _simulated(training_scene(rng), int(rng.integers(2**31)))

    return list(_cached(make, n_frames, folder / f"frames-{seed}", "frames", progress))


def validation_samples(n_frames: int, folder: Path, *, progress: bool = True) -> list[Sample]:
    """Samples of pictures and cameras that are not trained on, all scene classes in turn."""

    def make(number: int) -> list[Sample]:
        kind, turn = SCENE_CLASSES[number % len(SCENE_CLASSES)], number // len(SCENE_CLASSES)
        return _simulated(validation_scene(kind, _SCREENS[turn % 2], turn // 2), _VALIDATION + number)

    return list(_cached(make, n_frames, folder / "validation", "validation", progress))


def _cached(make: Callable[[int], list[Sample]], n: int, folder: Path, what: str, progress: bool) -> Iterator[Sample]:
    folder.mkdir(parents=True, exist_ok=True)
    for number in tqdm(range(n), desc=what, disable=not progress):
        path = folder / f"{number:05d}.npz"
        samples = _read(path)
        if samples is None:
            samples = make(number)
            _write(path, samples)
        yield from samples


def _write(path: Path, samples: list[Sample]) -> None:
    arrays = {
        f"{name}{i}": getattr(sample, name)
        for i, sample in enumerate(samples)
        for name in ("strips", "columns", "slots", "seen")
    }
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.savez(file, n=np.array(len(samples)), **arrays)
    part.replace(path)


def _read(path: Path) -> list[Sample] | None:
    """Samples of a file; None where it is missing or damaged, so that it is made again."""
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            return [
                Sample(stored[f"strips{i}"], stored[f"columns{i}"], stored[f"slots{i}"], stored[f"seen{i}"])
                for i in range(int(stored["n"]))
            ]
    except (OSError, ValueError, KeyError, BadZipFile, EOFError):
        return None


def _sample(scene: Scene, slots: NDArray[np.uint8]) -> Sample:
    strips, columns = network_inputs(scene, np.arange(slots.shape[0]))
    q = scene.samples.samples_per_slot
    seen = scene.samples.valid.max(axis=1).reshape(slots.shape[0], -1, q).mean(axis=2)
    return Sample(strips.astype(np.float16), columns.astype(np.float16), slots, seen.astype(np.float16))


def _simulated(simulated: SimulatedScene, seed: int) -> list[Sample]:
    """One frame as a sample; none where the receiver finds no clock, or a wrong one."""
    trial = simulate_trial(simulated, seed)
    scene = denoiser_scene(trial.frame, trial.options())
    if scene is None:
        return []
    slots = sent_slots(trial.capture.exposure, scene.clock)
    return [_sample(scene, slots)] if _headers_fit(slots, scene.clock) else []


def sent_slots(exposure: Exposure, clock: Clock) -> NDArray[np.uint8]:
    """(C, N) what was sent in every slot of the receiver's grid."""
    slots_per_row = exposure.sensor.line_delay_s * exposure.slot_rate_hz
    rows = clock.row0 + clock.delay_slots * clock.rows_per_slot
    centre = exposure.start_slot + rows * slots_per_row + exposure.exposure_slots / 2
    first = np.rint(centre - exposure.delays).astype(np.int64)
    sent = exposure.link.slots(int(first.min()), int(first.max()) + clock.n_slots)
    index = (first - first.min())[:, None] + np.arange(clock.n_slots)
    return np.asarray(np.take_along_axis(sent, index, axis=1), np.uint8)


def _headers_fit(slots: NDArray[np.uint8], clock: Clock) -> bool:
    """Whether headers lie where the clock has them: a wrong lock would teach nonsense."""
    position = (np.arange(clock.n_slots) + clock.first_slot) % clock.packet_slots
    inside = position < len(HEADER)
    return bool(inside.any() and (slots[:, inside] == np.array(HEADER)[position[inside]]).mean() > 0.99)
