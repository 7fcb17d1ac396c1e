"""Is a packet reported at 0.99 right 99 times in a hundred? Thousands of packets, from clean to hopeless."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.lab.benchmark.journal import Record, Task
from rxcli.lab.benchmark.statistics import wilson
from rxcli.lab.benchmark.trial import simulate_trial
from rxcli.lab.simulate.pictures import draw_name
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.types import FloatArray, FrameResult

N_BINS = 10
_SCREENS = ("paper-8k65", "paper-17k3", "paper-34k6")
_PRESETS = ("video-1080p", "phone-plain", "xs10-still")
#: Sensor widths, pixels: few, because thousands of frames are wanted, and each is to hold packets in doubt.
_WIDTH_PX = (100.0, 320.0)
#: Share of the frames with few rows a slot, how many, and widths of those: small pictures anyway.
_FEW_ROWS_SHARE, _FEW_ROWS, _FEW_ROWS_WIDTH_PX = 0.4, (1.5, 5.0), (100.0, 900.0)
#: Share of the frames with a hundred columns, in whole pictures, as their screen is searched.
_NARROW_SHARE, _NARROW_SCREEN = 0.05, "wide-100"
#: Powers of ten of the light against that of the preset: clean at one end, hopeless at the other, most about where
#: packets begin to fail.
_LIGHT, _NARROW_LIGHT = (-1.4, 0.1), (-0.5, 0.4)
#: Terms of what confidences are made of: of photographs, and of clips whose picture is known.
TERMS = (8, 3)
#: Confidences are kept this far from 0 and 1 where their logarithm is taken; steps of Newton's method.
_EDGE, _MOST_STEPS = 1e-6, 100


@dataclass(frozen=True)
class Bin:
    """Packets whose reported confidence falls into one bin."""

    low: float
    high: float
    n: int
    right: int
    #: Mean of the reported confidences.
    reported: float

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson interval of the share of error-free packets."""
        return wilson(self.right, self.n)

    @property
    def calibrated(self) -> bool:
        """Whether the mean reported confidence lies inside the interval."""
        low, high = self.interval
        return low <= self.reported <= high


@dataclass(frozen=True)
class Scaling:
    """Map from reported to true confidence: logistic(offset + slope * logit(confidence))."""

    offset: float
    slope: float

    def __call__(self, confidence: FloatArray) -> FloatArray:
        """Calibrated confidences, same shape."""
        return np.asarray(1 / (1 + np.exp(-(self.offset + self.slope * _logit(confidence)))))


@dataclass(frozen=True)
class Calibration:
    """What a run says of the reported confidences."""

    bins: tuple[Bin, ...]
    n_packets: int
    n_frames: int
    #: Mean of squared differences between confidence and outcome (Brier), as reported and after `scaling`.
    brier: float
    brier_scaled: float
    #: Expected calibration error: mean distance of reported from observed over the packets of all bins.
    error: float
    #: None where all packets have the same outcome.
    scaling: Scaling | None
    #: Weights of what the confidences are made of that fit these packets best, by how many terms that is: packets of
    #: photographs and those of clips whose picture is known have their own.
    weights: dict[int, tuple[float, ...]]


def scene_of(seed: int) -> Scene:
    """A small, quick scene of random quality: from clean to hopeless."""
    rng = np.random.default_rng([seed, 5])
    has_narrow_columns = np.random.default_rng([seed, 6]).random() < _NARROW_SHARE
    base, light = (preset(_PRESETS[-1], _NARROW_SCREEN), _NARROW_LIGHT) if has_narrow_columns else (_wide(rng), _LIGHT)
    exposure_slots = rng.choice([0.5, 1.0, 1.5, 2.0]) * rng.uniform(0.8, 1.2)
    exposure_s = max(float(exposure_slots) / base.screen.slot_rate_hz, 1 / 32000)
    return replace(
        base,
        picture=draw_name(rng),
        w="dimming" if rng.random() < 0.3 else int(rng.integers(2, 9)),
        pose=replace(base.pose, fill=rng.uniform(0.8, 0.97), roll_deg=rng.normal(0, 1.0), yaw_deg=rng.normal(0, 4)),
        exposure_s=exposure_s,
        light_e_per_s=base.light_e_per_s * (base.exposure_s / exposure_s) * 10 ** rng.uniform(*light),
        blur_px=rng.uniform(0.4, 2.5),
        slot_rate_error_ppm=rng.uniform(-100, 100),
        column_delay_slots=float(rng.choice([0.0, rng.uniform(0, 2)])),
        isp=replace(base.isp, sharpen=rng.uniform(0, 0.8), denoise_px=rng.uniform(0, 0.6)),
        n_frames=1,
        output="raw" if base.sensor.pattern is not None and rng.random() < 0.3 else "developed",
    )


def _wide(rng: np.random.Generator) -> Scene:
    """A screen of twenty columns, each a few pixels wide, before any camera."""
    base = preset(str(rng.choice(_PRESETS)), str(rng.choice(_SCREENS)))
    few_rows = rng.random() < _FEW_ROWS_SHARE
    rows = np.exp(rng.uniform(*np.log(_FEW_ROWS))) / base.rows_per_slot if few_rows else 1.0
    width_px = rng.uniform(*(_FEW_ROWS_WIDTH_PX if few_rows else _WIDTH_PX))
    return base.scaled(width_px / base.sensor.width, float(min(rows, 1.0)), keep_readout=True)


def packets_of(task: Task) -> Record:
    """Simulate and receive one frame; returns what was reported of every packet."""
    trial = simulate_trial(scene_of(task["seed"]), task["seed"])
    # How well narrow columns are found is part of how well their packets are received.
    known_outline = trial.capture.scene.screen.name != _NARROW_SCREEN
    result, score = trial.receive(trial.options(cae=task["cae"], known_outline=known_outline))
    scene = trial.capture.scene
    about = {
        "screen": scene.screen.name,
        "camera": scene.camera_name,
        "output": scene.output,
        "picture": scene.picture,
        "exposure_slots": scene.exposure_s * scene.screen.slot_rate_hz,
        "rows_per_slot": scene.rows_per_slot,
        "status": result.status,
        "expected": score.expected,
        "lost": score.lost,
    }
    return {**about, "packets": reported_packets(result, trial.truth.w)}


def reported_packets(result: FrameResult, sent_w: Sequence[int]) -> list[Record]:
    """What was reported of every packet of one scored frame, as JSON values; `sent_w`: true weight per column."""
    return [
        {
            "confidence": packet.confidence,
            "ber_hat": packet.ber_hat,
            "bit_errors": packet.payload_bits if packet.bit_errors is None else packet.bit_errors,
            "payload_bits": packet.payload_bits,
            "copies": packet.copies,
            "frames": len(packet.frames or ()),
            "frame": result.frame,
            "column": column.column,
            "w": column.w,
            "tx_w": sent_w[column.column],
            "snr_db": column.snr_db,
            "denoised": column.denoised,
            "evidence": packet.confidence_features,
        }
        for column in result.columns
        for packet in column.packets
    ]


def calibration(records: Sequence[Record]) -> Calibration:
    """Bins, scores and a suggested scaling from the records of `packets_of`."""
    packets = [packet for record in records for packet in record["packets"]]
    confidence = np.array([p["confidence"] for p in packets], np.float64)
    right = np.array([p["bit_errors"] == 0 for p in packets], bool)
    bins = bin_outcomes(confidence, right)
    scaling = fit_scaling(confidence, right)
    n = max(len(packets), 1)
    return Calibration(
        bins=bins,
        n_packets=len(packets),
        n_frames=len(records),
        brier=float(((confidence - right) ** 2).sum() / n),
        brier_scaled=float(((scaling(confidence) - right) ** 2).sum() / n) if scaling else float("nan"),
        error=sum(abs(b.reported * b.n - b.right) for b in bins) / n,
        scaling=scaling,
        weights=_fitted_weights(packets, right),
    )


def _fitted_weights(packets: Sequence[Record], right: NDArray[np.bool_]) -> dict[int, tuple[float, ...]]:
    """Weights by number of terms, of packets that all tell theirs; none where the outcomes do not tell them."""
    n_terms = np.array([len(packet.get("evidence", ())) for packet in packets])
    fitted = {}
    for n in np.unique(n_terms).tolist():
        mine = n_terms == n
        if n in TERMS and 0 < right[mine].sum() < mine.sum():
            terms = np.array([packet["evidence"] for packet, own in zip(packets, mine, strict=True) if own])
            fitted[n] = tuple(logistic_regression(terms, right[mine]).tolist())
    return fitted


def bin_outcomes(confidence: FloatArray, right: NDArray[np.bool_]) -> tuple[Bin, ...]:
    """Packets sorted into `N_BINS` equal bins of confidence; one of 1 belongs to the last.

    Args:
        confidence: (n,) 0..1.
        right: (n,) whether the packet is error-free.
    """
    number = np.minimum((confidence * N_BINS).astype(np.int64), N_BINS - 1)
    count = np.bincount(number, minlength=N_BINS)
    hits = np.bincount(number, weights=right, minlength=N_BINS)
    total = np.bincount(number, weights=confidence, minlength=N_BINS)
    return tuple(
        Bin(i / N_BINS, (i + 1) / N_BINS, int(count[i]), int(hits[i]), float(total[i] / max(count[i], 1)))
        for i in range(N_BINS)
    )


def _logit(p: FloatArray) -> FloatArray:
    kept = np.clip(p, _EDGE, 1 - _EDGE)
    return np.asarray(np.log(kept) - np.log1p(-kept))


def fit_scaling(confidence: FloatArray, right: NDArray[np.bool_]) -> Scaling | None:
    """Logistic regression of the outcome on the logit of the confidence (Platt); None where all outcomes are alike."""
    if right.all() or not right.any():
        return None
    offset, slope = logistic_regression(
        np.stack([np.ones_like(confidence), _logit(confidence)], axis=1), right, np.array([0.0, 1.0])
    )
    return Scaling(float(offset), float(slope))


def logistic_regression(terms: FloatArray, right: NDArray[np.bool_], prior: FloatArray | None = None) -> FloatArray:
    """Weights (k,) that make the outcomes likeliest, by Newton's method.

    A tiny pull towards `prior` keeps them finite where the outcomes can be separated.

    Args:
        terms: (n, k).
        right: (n,) outcomes.
        prior: (k,), 0 by default.
    """
    prior = np.zeros(terms.shape[1]) if prior is None else prior
    weights = prior.copy()
    for _ in range(_MOST_STEPS):
        p = 1 / (1 + np.exp(-np.clip(terms @ weights, -50, 50)))
        gradient = terms.T @ (right - p) - 1e-3 * (weights - prior)
        step = np.linalg.solve((terms.T * (p * (1 - p))) @ terms + 1e-3 * np.eye(weights.size), gradient)
        weights = weights + np.clip(step, -1, 1)
        if np.abs(step).max() < 1e-9:
            break
    return weights


def rows(result: Calibration) -> list[dict[str, Any]]:
    """The bins as a table."""
    return [
        {
            "confidence": f"{b.low:.1f}-{b.high:.1f}",
            "packets": b.n,
            "reported": b.reported if b.n else None,
            "error_free": b.right / b.n if b.n else None,
            "interval95": b.interval,
            "calibrated": b.calibrated if b.n else None,
        }
        for b in result.bins
    ]


def details(result: Calibration) -> dict[str, Any]:
    """Scores and suggestions as JSON values."""
    return {
        "packets": result.n_packets,
        "frames": result.n_frames,
        "calibration_error": result.error,
        "brier": result.brier,
        "brier_scaled": result.brier_scaled if result.scaling else None,
        "scaling": {"offset": result.scaling.offset, "slope": result.scaling.slope} if result.scaling else None,
        "weights": result.weights,
    }
