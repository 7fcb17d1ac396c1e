"""Hostile values: frames, outlines, exposures, damaged arrays and detector inputs that must not upset the receiver."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, cast

import msgspec
import numpy as np
from numpy.typing import NDArray
from watched_stages import watched

from rxcli.lab.benchmark.cases import nonsense
from rxcli.lab.benchmark.draw import small
from rxcli.lab.benchmark.trial import Trial, simulate_trial
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.protocol import encode_packet, payload_bits
from rxcli.receiver import sampling
from rxcli.receiver.decode import detect
from rxcli.receiver.pipeline import ReceiverOptions, receive
from rxcli.results.report import to_record
from rxcli.types import FloatArray, Frame, FrameResult

Problems = list[str]

#: Ties: float32 may decide otherwise where the best two log-probabilities are this close.
_TIE = 1e-2


@lru_cache(maxsize=16)
def base_trial(picture: str = "coffee", screen: str = "paper-17k3") -> Trial:
    """A clean small frame of 240 x 1000 pixels that the hostile frames start from."""
    return simulate_trial(small(preset("phone-plain", screen), 240, 3.0, picture=picture), 1)


def inspect_frame(frame: Frame, options: ReceiverOptions) -> tuple[FrameResult | None, Problems]:
    """Receive one frame under watch; returns the result, None where it raised, and everything that is wrong."""
    result = None
    with watched() as found:
        try:
            result = next(iter(receive([frame], options)))
        except Exception as error:  # whatever it is, it is what we look for
            found.append(f"{type(error).__name__}: {error}")
    return result, list(dict.fromkeys([*found, *(nonsense(result) if result else ())]))


def unique(problems: Problems) -> Problems:
    """Problems without repetition, in order."""
    return list(dict.fromkeys(problems))


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


# Hostile frames: the base frame's pixels with something done to them.


def _filled(value: int) -> Callable[[NDArray[Any]], NDArray[Any]]:
    return lambda pixels: np.full_like(pixels, value)


def _with_rows(first: float, last: float, value: int) -> Callable[[NDArray[Any]], NDArray[Any]]:
    def change(pixels: NDArray[Any]) -> NDArray[Any]:
        changed = pixels.copy()
        changed[int(first * len(pixels)) : int(last * len(pixels))] = value
        return changed

    return change


def _one_lit(pixels: NDArray[Any]) -> NDArray[Any]:
    changed = np.zeros_like(pixels)
    changed[pixels.shape[0] // 2, pixels.shape[1] // 2] = 255
    return changed


def _noise(pixels: NDArray[Any]) -> NDArray[Any]:
    return np.random.default_rng(0).integers(0, 256, pixels.shape).astype(pixels.dtype)


def _alternating(pixels: NDArray[Any]) -> NDArray[Any]:
    changed = np.zeros_like(pixels)
    changed[1::2] = 255
    return changed


def _mean_rows(pixels: NDArray[Any]) -> NDArray[Any]:
    return np.broadcast_to(pixels.mean(axis=1, keepdims=True), pixels.shape).astype(pixels.dtype)


FRAMES: dict[str, Callable[[NDArray[Any]], NDArray[Any]]] = {
    "all zero": _filled(0),
    "all saturated": _filled(255),
    "constant grey": _filled(77),
    "one lit pixel": _one_lit,
    "noise": _noise,
    "alternating rows": _alternating,
    "no variance within rows": _mean_rows,
    "zero rows": _with_rows(0.3, 0.6, 0),
    "saturated rows": _with_rows(0.3, 0.6, 255),
    "upper half zero": _with_rows(0.0, 0.5, 0),
    "two values": lambda pixels: np.where(pixels > 60, 255, 0).astype(np.uint8),
    "one bit": lambda pixels: (pixels > 60).astype(np.uint8),
    "right half zero": lambda pixels: np.where(np.arange(pixels.shape[1]) < pixels.shape[1] // 2, pixels, 0),
}


def _hostile_frame(change: Callable[[NDArray[Any]], NDArray[Any]]) -> Problems:
    base = base_trial()
    frame = replace(base.frame, pixels=np.asarray(change(base.frame.pixels), np.uint8))
    return inspect_frame(frame, base.options())[1]


def _outline(corners: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Callable[[], Problems]:
    def case() -> Problems:
        base = base_trial()
        return inspect_frame(base.frame, replace(base.options(), corners=corners(base.corners)))[1]

    return case


def _one_row(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    top = corners.mean(axis=0)[1]
    return np.stack([corners[:, 0], [top - 0.5, top - 0.5, top + 0.5, top + 0.5]], axis=1)


def _narrow(width_px: float) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """The outline squeezed so that a column is `width_px` wide."""

    def squeeze(corners: NDArray[np.float64]) -> NDArray[np.float64]:
        centre = corners.mean(axis=0)
        factor = 20 * width_px / np.ptp(corners[:, 0])
        return np.asarray(centre + (corners - centre) * [factor, 1.0])

    return squeeze


OUTLINES: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    "one row of screen": _one_row,
    "columns of 2 px": _narrow(2.0),
    "columns of 0.2 px": _narrow(0.2),
    "far larger than the picture": lambda corners: (corners - corners.mean(axis=0)) * 20 + corners.mean(axis=0),
    "mostly left of the picture": lambda corners: corners - np.array([0.9 * np.ptp(corners[:, 0]), 0.0]),
    "wholly outside": lambda corners: corners + np.array([5000.0, 0.0]),
    "below the picture": lambda corners: corners + np.array([0.0, 1e5]),
    "upside down": lambda corners: corners[[2, 3, 0, 1]],
    "mirrored": lambda corners: corners[[1, 0, 3, 2]],
    "on its side": lambda corners: corners[[1, 2, 3, 0]],
}


def _scene_case(make: Callable[[], Scene]) -> Callable[[], Problems]:
    def case() -> Problems:
        trial = simulate_trial(make(), 2)
        return inspect_frame(trial.frame, trial.options())[1]

    return case


def _exposure(slots: float) -> Callable[[], Scene]:
    def make() -> Scene:
        scene = small(preset("phone-plain", "paper-17k3"), 200, 3.0)
        light = scene.light_e_per_s * scene.exposure_s * scene.screen.slot_rate_hz / slots
        return replace(scene, exposure_s=slots / scene.screen.slot_rate_hz, light_e_per_s=light)

    return make


def _rows_per_slot(rows: float) -> Callable[[], Scene]:
    def make() -> Scene:
        scene = small(preset("phone-plain", "paper-8k65"), 160, 3.0)
        delay = 1 / (rows * scene.screen.slot_rate_hz)
        return replace(scene, sensor=replace(scene.sensor, line_delay_s=delay, height=min(int(120 * rows), 4000)))

    return make


def _electrons(count: float) -> Callable[[], Scene]:
    def make() -> Scene:
        scene = small(preset("phone-plain", "paper-17k3"), 200, 3.0, output="raw")
        sensor = replace(scene.sensor, full_scale_e=2 * count)
        room = replace(scene.room, light_e_per_s=0.1 * count / scene.exposure_s)
        return replace(scene, light_e_per_s=count / scene.exposure_s, sensor=sensor, room=room)

    return make


def _contaminated(value: float, share: float) -> Callable[[], Problems]:
    """Row profiles as a damaged dump would hold them: NaN or infinity in some places."""

    def case() -> Problems:
        base = base_trial()
        with _light_replaced(value, share):
            return inspect_frame(base.frame, base.options())[1]

    return case


@contextmanager
def _light_replaced(value: float, share: float) -> Iterator[None]:
    original = sampling.sample_rows

    def sample(*args: Any, **kwargs: Any) -> Any:
        profiles = original(*args, **kwargs)
        light = profiles.light.copy()
        light[np.random.default_rng(4).random(light.shape) < share] = value
        return replace(profiles, light=light)

    sampling.sample_rows = sample
    try:
        yield
    finally:
        sampling.sample_rows = original


def _metrics(seed: int = 0, scale: float = 1.0) -> NDArray[np.float64]:
    """(1, 4, slots, patterns) log-likelihoods of four packets of weights 3..6 in noise, memory of one slot."""
    rng = np.random.default_rng(seed)
    packets = [encode_packet(rng.integers(0, 2, payload_bits(w, 5)).astype(np.uint8), w) for w in range(3, 7)]
    slots = np.concatenate([np.array(packets), np.array(packets)[:, :1]], axis=1)
    before = np.concatenate([slots[:, :1], slots[:, :-1]], axis=1)
    index = 2 * before + slots
    clean = -1.5 * np.abs(index[..., None] - np.arange(4))
    return np.asarray(scale * (clean + rng.normal(0, 1.2, clean.shape)))[None]


def _detector(change: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> Callable[[], Problems]:
    def case() -> Problems:
        with watched() as found:
            try:
                detect.detect(change(_metrics()))
            except Exception as error:  # whatever it is, it is what we look for
                found.append(f"{type(error).__name__}: {error}")
        return found

    return case


DETECTOR: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    "all metrics equal": np.zeros_like,
    "metrics of 1e30": lambda metrics: metrics * 1e30,
    "metrics of 1e-300": lambda metrics: metrics * 1e-300,
    "all metrics -1e9": lambda metrics: np.full_like(metrics, -1e9),
}


def _precision() -> Problems:
    """float32 against float64 metrics: LLRs to 1e-3 relative, decisions exactly, away from ties."""
    problems = []
    for seed in range(20):
        metrics = _metrics(seed).astype(np.float32)
        single, double = detect.detect(cast(FloatArray, metrics)), detect.detect(metrics.astype(np.float64))
        sure = double.log_prob > np.log(0.5) + _TIE
        if (single.index != double.index)[sure].any() or (single.w != double.w).any():
            problems.append(f"float32 decides otherwise than float64 (seed {seed})")
        both = np.isfinite(double.bit_llr)
        error = np.abs(single.bit_llr - double.bit_llr)[both]
        if (error > 1e-3 * np.maximum(np.abs(double.bit_llr[both]), 1.0)).any():
            problems.append(f"LLRs of float32 and float64 differ by up to {error.max():.2g} (seed {seed})")
    return problems


def _depth() -> Problems:
    """The same picture in 8 and 16 bits: the same packets."""
    base = base_trial()
    wide = replace(base.frame, pixels=np.asarray(base.frame.pixels, np.uint16) * np.uint16(257), white=65535.0)
    (first, problems), (second, more) = (inspect_frame(f, base.options()) for f in (base.frame, wide))
    if first and second and _payloads(first) != _payloads(second):
        problems.append("8 and 16 bits of the same picture give different packets")
    return [*problems, *more]


def _integer_edges() -> Problems:
    """uint16 mosaics at 0 and 65535, black above all values and white at the edge of the type."""
    trial = simulate_trial(small(preset("phone-plain", "paper-17k3"), 200, 3.0, output="raw"), 2)
    mosaic = trial.frame.mosaic
    assert mosaic is not None
    problems = []
    sensed = np.asarray(trial.frame.pixels, np.uint16)
    for pixels in (np.zeros_like(sensed), np.full_like(sensed, 65535), sensed):
        for black, white in ((0.0, 65535.0), (65534.0, 65535.0), (512.0, 4095.0)):
            frame = replace(trial.frame, pixels=pixels, mosaic=replace(mosaic, black=(black,) * 3, white=white))
            problems += inspect_frame(frame, trial.options())[1]
    return problems


def _tiny_pictures() -> Problems:
    """Pictures of one row, one column, one pixel."""
    base, problems = base_trial(), []
    for height, width in ((1, 240), (300, 1), (1, 1), (2, 2), (40, 40)):
        frame = replace(base.frame, pixels=np.ascontiguousarray(base.frame.pixels[:height, :width], np.uint8))
        mode = msgspec.structs.replace(base.camera.modes[0], width=width, height=height)
        camera = msgspec.structs.replace(base.camera, modes=(mode,))
        problems += inspect_frame(frame, replace(base.options(), cameras=(camera,)))[1]
    return problems


def _payloads(result: FrameResult) -> list[tuple[int, str]]:
    return [(column.column, packet.payload) for column in result.columns for packet in column.packets]


CASES: dict[str, Callable[[], Problems]] = {
    **{f"frame: {name}": partial(_hostile_frame, change) for name, change in FRAMES.items()},
    **{f"outline: {name}": _outline(corners) for name, corners in OUTLINES.items()},
    **{f"exposure of {s:g} slots": _scene_case(_exposure(s)) for s in (0.01, 0.05, 0.25, 2.0, 4.0, 7.0, 20.0)},
    **{f"{r:g} rows per slot": _scene_case(_rows_per_slot(r)) for r in (1.5, 2.0, 3.3, 20.0, 60.0)},
    **{f"{n:g} electrons": _scene_case(_electrons(n)) for n in (1.0, 10.0, 1e3, 1e6, 1e9)},
    "NaN in row profiles": _contaminated(float("nan"), 0.001),
    "infinity in row profiles": _contaminated(float("inf"), 0.001),
    "row profiles of NaN alone": _contaminated(float("nan"), 1.1),
    "row profiles of 1e30": _contaminated(1e30, 0.001),
    **{f"detector: {name}": _detector(change) for name, change in DETECTOR.items()},
    "float32 against float64": _precision,
    "8 against 16 bits": _depth,
    "integers at the edge of their type": _integer_edges,
    "tiny pictures": _tiny_pictures,
    "order of threads": lambda: thread_orders(base_trial().frame, base_trial().options()),
}
