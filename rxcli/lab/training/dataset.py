"""Data sets: made once, kept in a folder, picked up where an interrupted run left them.

A sample is the input of the network for the doubtful columns of a frame, with the log-likelihood of every possible word
by the light model, and the word that was sent.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from rxcli.lab.benchmark.trial import simulate_trial
from rxcli.lab.simulate.camera import Exposure
from rxcli.lab.simulate.scenes import Scene as SimulatedScene
from rxcli.lab.training.scenes import SCENE_CLASSES, training_scene, validation_scene
from rxcli.protocol import HEADER, PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, codebook
from rxcli.receiver.channel.denoise import DenoiserInput, network_inputs, payload_observed
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.search import Found, search
from rxcli.receiver.still import decode, doubtful_columns, without_row_noise
from rxcli.types import Clock, Float32Array

#: Words of the largest codebook, and what stands for a word that is not known.
MAX_WORDS, UNKNOWN = 128, -1
_SCREENS = ("paper-34k6", "paper-17k3")
#: Maximum number of training columns per frame, since columns of one picture are similar.
_MAX_COLUMNS = 8
#: Lower limit of the log-likelihood of a word relative to the best.
_MIN_SCORE = -60.0
#: Streams of random numbers.
_FRAMES, _VALIDATION = 77, 900_000


@dataclass(frozen=True)
class Sample:
    """Doubtful columns of a frame as the network sees them, and what was sent; B columns, N slots, M symbols."""

    #: (B, S, F, N) float16.
    strips: NDArray[np.float16]
    #: (B, G, N) float16.
    columns: NDArray[np.float16]
    #: (B, N) 1 where a slot of the payload can be seen.
    reception: NDArray[np.float16]
    #: (): place of the first slot in its packet, and slots of a packet.
    first_slot: NDArray[np.int64]
    packet_slots: NDArray[np.int64]
    #: (copies,) burst of each copy.
    burst: NDArray[np.int64]
    #: (B,) weight that was sent.
    w: NDArray[np.int64]
    #: (bursts, B, M, 128) log-likelihood of every word by the light model alone.
    scores: NDArray[np.float16]
    #: (bursts, B, M) index of the word that was sent, or `UNKNOWN`.
    words: NDArray[np.int64]


def frame_samples(n_frames: int, seed: int, folder: Path, *, progress: bool = True) -> list[Sample]:
    """Samples of simulated frames, as the receiver sees them; frames without a doubtful column or a lock give none.

    Args:
        n_frames: frames to simulate.
        seed: equal ones give equal samples.
        folder: cache.
        progress: show a bar on stderr.
    """

    def make(number: int) -> Sample | None:
        rng = np.random.default_rng([_FRAMES, seed, number])
        return _simulated(training_scene(rng), int(rng.integers(2**31)))

    return list(_cached(make, n_frames, folder / f"frames-{seed}", "frames", progress))


def validation_samples(n_frames: int, folder: Path, *, progress: bool = True) -> list[Sample]:
    """Samples of the first validation frames."""
    return list(_cached(validation_sample, n_frames, folder / "validation", "validation", progress))


def validation_sample(number: int) -> Sample | None:
    """Sample of a picture and a camera not trained on, all scene classes in turn, or None.

    It holds columns that the receiver uses the network for; training also uses hopeless ones.
    """
    turn, kind = divmod(number, len(SCENE_CLASSES))
    scene = validation_scene(SCENE_CLASSES[kind], _SCREENS[turn % 2], turn // 2)
    return _simulated(scene, _VALIDATION + number)


def _cached(make: Callable[[int], Sample | None], n: int, folder: Path, what: str, progress: bool) -> Iterator[Sample]:
    """Samples of `n` frames, one file each; a missing or damaged file is made again."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in tqdm(range(n), desc=what, disable=not progress):
        path = folder / f"{number:05d}.npz"
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
                sample = Sample(**stored) if stored.files else None
        except (OSError, ValueError, TypeError, BadZipFile, EOFError):
            sample, part = make(number), path.with_suffix(".part")
            with part.open("wb") as out:
                np.savez(out, allow_pickle=False, **(vars(sample) if sample else {}))
            part.replace(path)
        if sample is not None:
            yield sample


def _simulated(simulated: SimulatedScene, seed: int) -> Sample | None:
    """One frame as a sample; None if the receiver finds no clock, a wrong one, or no doubtful column."""
    trial = simulate_trial(simulated, seed)
    found = search(FrameCache(trial.frame), trial.options())
    if not isinstance(found, Found):
        return None
    reception = decode(found.best.acquisition, trial.options().skip, found.best.reception)
    columns = doubtful_columns(reception)
    if reception.is_long or not columns.size:
        return None
    _, scene, _ = without_row_noise(found.best.acquisition, reception, columns)
    slots = sent_slots(trial.capture.exposure, scene.clock)
    if not _headers_fit(slots, scene.clock):
        return None
    chosen = np.sort(np.random.default_rng(seed).permutation(columns.size)[:_MAX_COLUMNS])
    return sample_of(scene, columns[chosen], slots, trial.capture.exposure.link.weights)


def sample_of(
    scene: DenoiserInput, columns: NDArray[np.int64], slots: NDArray[np.uint8], weights: NDArray[np.integer]
) -> Sample | None:
    """What is to be learned from some columns of a scene; None where the receiver mixed up the bursts.

    Args:
        scene: what the network is shown.
        columns: columns to learn from, B of them.
        slots: (C, N) what was sent on the receiver's grid.
        weights: (C,) what was sent.
    """
    clock = scene.clock
    lit, dark = (clock.by_burst(part.astype(np.int64)) for part in (slots[columns], 1 - slots[columns]))
    if (lit * dark).any():
        return None
    bursts = clock.by_burst(scene.llr[columns])
    scores, words = [], []
    for burst in range(bursts.shape[0]):
        for row, w in enumerate(weights[columns]):
            sent = (lit[burst, row] > 0).astype(np.uint8)
            scores.append(_word_scores(_payload(bursts[burst, row]), int(w)))
            word = (codebook(int(w)).astype(np.int64) @ _payload(sent).T).argmax(axis=0)
            words.append(np.where(_payload(lit[burst, row] + dark[burst, row]).all(axis=1), word, UNKNOWN))
    shape = (*bursts.shape[:2], len(words[0]))
    strips, features = network_inputs(scene, columns)
    return Sample(
        strips=strips.astype(np.float16),
        columns=features.astype(np.float16),
        reception=payload_observed(scene)[columns].astype(np.float16),
        first_slot=np.array(clock.first_slot),
        packet_slots=np.array(clock.packet_slots),
        burst=clock.burst,
        w=np.asarray(weights[columns], np.int64),
        scores=np.stack(scores).reshape(*shape, MAX_WORDS),
        words=np.stack(words).reshape(shape),
    )


def _payload(packet: NDArray[Any]) -> NDArray[Any]:
    """(symbols, 10) slots of a packet."""
    return packet[PREAMBLE_SLOTS:].reshape(-1, SLOTS_PER_SYMBOL)


def _word_scores(llr: Float32Array, w: int) -> NDArray[np.float16]:
    """(symbols, 128) log-likelihood of every word of weight `w` by the slots (symbols, 10), against the best one.

    -inf where there is no word.
    """
    score = llr @ codebook(w).T
    out = np.full((len(score), MAX_WORDS), -np.inf)
    out[:, : score.shape[1]] = np.maximum(score - score.max(axis=1, keepdims=True), _MIN_SCORE)
    return out.astype(np.float16)


def sent_slots(exposure: Exposure, clock: Clock) -> NDArray[np.uint8]:
    """(C, N) what was sent in every slot of the receiver's grid."""
    slots_per_row = exposure.scene.sensor.line_delay_s * exposure.slot_rate_hz
    rows = clock.row0 + clock.delay_slots * clock.rows_per_slot
    centre = exposure.start_slot + rows * slots_per_row + exposure.exposure_slots / 2
    first_slot = np.rint(centre - exposure.delays).astype(np.int64)
    sent = exposure.link.slots(int(first_slot.min()), int(first_slot.max()) + clock.n_slots)
    index = (first_slot - first_slot.min())[:, None] + np.arange(clock.n_slots)
    return np.asarray(np.take_along_axis(sent, index, axis=1), np.uint8)


def _headers_fit(slots: NDArray[np.uint8], clock: Clock) -> bool:
    """Whether headers lie where the clock has them: a wrong lock would teach nonsense."""
    inside = clock.places < len(HEADER)
    return bool(inside.any() and (slots[:, inside] == np.array(HEADER)[clock.places[inside]]).mean() > 0.99)
