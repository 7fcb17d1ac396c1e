"""The wiring of the receiver: `_receive_frame` reads as the block diagram."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rxcli import assemble, blind, channel, clock, denoise, detect, geometry, sampling
from rxcli.dump import dump_frame
from rxcli.errors import ReceiverError
from rxcli.profiles import CameraProfile, ReadoutMode, ScreenProfile, match_camera
from rxcli.types import (
    BurstPosteriors,
    Clock,
    ColumnResult,
    Float32Array,
    FloatArray,
    Frame,
    FrameResult,
    Lens,
    Outlines,
    RowProfiles,
    SlotSamples,
)

CaeMode = Literal["auto", "always", "never"]
#: Names of the shortcuts that `ReceiverOptions.skip` may hold; every one is counted in the report.
SKIPS = ("no_screen", "dark_columns", "certain_columns", "tracking")

_DEFAULT_TONE = "srgb"
_SAMPLES_PER_SLOT = 4
_MAX_ITERATIONS = 5
#: A column all of whose symbols have at least this log probability is not looked at again.
_CERTAIN = -1e-5
#: The quick look at the picture is surer than it should be of textured ones: it must do for all columns, and clearly.
_CERTAIN_AT_ONCE = -1e-6
#: Weights that a quick look finds this much less likely than the best are dropped, nats.
_HOPELESS_WEIGHT = 20.0
#: Rounds of light model and detection from where the auto-encoder starts.
_RESTART_ITERATIONS = 1
#: A header peak less than this times the strongest rival is no lock.
_MIN_LOCK = 1.6
#: Orientations in which the readout runs along the columns' width.
_PORTRAIT = (5, 6, 7, 8)


@dataclass(frozen=True, slots=True)
class ReceiverOptions:
    """What the user asks of the receiver; picklable, so that worker processes can have it."""

    #: Screens to try; the one whose clock fits best is taken.
    screens: tuple[ScreenProfile, ...]
    #: Cameras to choose from by make, model and size; empty: estimate everything blindly.
    cameras: tuple[CameraProfile, ...] = ()
    #: Take `cameras[0]` whatever the file says of itself.
    force_camera: bool = False
    #: (4, 2) image pixels, top-left first, clockwise as a viewer sees the screen; None: find them.
    corners: FloatArray | None = None
    cae: CaeMode = "auto"
    #: Packets below this confidence are not reported.
    min_confidence: float = 0.0
    #: Shortcuts in use.
    skip: frozenset[str] = field(default_factory=lambda: frozenset(SKIPS))
    #: Folder for the arrays of every stage boundary; None: none are written.
    dump_dir: Path | None = None


class _Failure(Exception):
    """Reception ends here, with a status and a message; never leaves this module."""

    def __init__(self, status: Literal["no_screen", "no_signal"], message: str) -> None:
        super().__init__(message)
        self.status = status
        self.message = message


class _Stages:
    """Wall time by stage."""

    def __init__(self) -> None:
        self.timing_ms: dict[str, float] = {}
        self._start = time.perf_counter()

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = 1e3 * (time.perf_counter() - start)
            self.timing_ms[name] = self.timing_ms.get(name, 0.0) + elapsed

    def total(self) -> dict[str, float]:
        return {**self.timing_ms, "total": 1e3 * (time.perf_counter() - self._start)}


@dataclass(frozen=True, slots=True)
class _Camera:
    """What is known of the camera that took a frame."""

    #: None for a camera that was estimated from the frame itself.
    profile: str | None
    line_delay_s: float
    exposure_s: float
    lens: Lens | None
    tone: str
    #: True where the stored rows run against the readout.
    reversed: bool = False
    #: What was estimated: name -> (value, standard deviation).
    estimated: dict[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Lock:
    """A screen whose clock was found."""

    screen: ScreenProfile
    profiles: RowProfiles
    clock: Clock


def receive(frames: Iterable[Frame], options: ReceiverOptions) -> Iterator[FrameResult]:
    """Receive the frames of one source, in order; one result a frame, in order.

    A clip's result may come some frames later than the frame, because a packet stands in the last frame that shows it.
    """
    with closing(_iterator(frames)) as source:
        first = next(source, None)
        if first is None:
            return
        try:
            second = next(source, None)
        except Exception:
            yield _receive_frame(first, options)
            raise
        if second is None:
            yield _receive_frame(first, options)
            return
        from rxcli.clip import receive_clip

        yield from receive_clip(chain((first, second), source), options)


def _iterator(frames: Iterable[Frame]) -> Generator[Frame, None, None]:
    """The frames as a generator, whose end also ends theirs: a file is closed when reception is left early."""
    yield from frames


def denoiser_scene(frame: Frame, options: ReceiverOptions) -> denoise.Scene | None:
    """What the auto-encoder is shown of a frame, None where no signal is found; for training."""
    try:
        corners = _find_corners(frame, options)
        camera, options = _camera_and_screens(frame, corners, options, _Stages())
        lock = _find_lock(frame, corners, camera, options, _Stages())
    except _Failure:
        return None
    return _scene_of(_iterate(lock, _quick_look(lock)))


def _receive_frame(frame: Frame, options: ReceiverOptions) -> FrameResult:
    stages = _Stages()
    result = FrameResult(frame.source, frame.index, frame.time_s, "ok")
    try:
        with stages("geometry"):
            corners = _find_corners(frame, options)
        result = replace(result, corners=corners)
        camera, options = _camera_and_screens(frame, corners, options, stages)
        result = replace(
            result,
            camera_profile=camera.profile,
            line_delay_s=camera.line_delay_s,
            exposure_s=camera.exposure_s,
            estimated=camera.estimated,
        )
        lock = _find_lock(frame, corners, camera, options, stages)
        result = replace(result, screen_profile=lock.screen.name)
        with stages("detect"):
            seen = _decode(lock)
        with stages("denoise"):
            seen, denoised, report = _second_opinion(lock, seen, options)
        if options.dump_dir is not None:
            dump_frame(
                options.dump_dir, frame, corners, lock.profiles, seen.clock, seen.samples, seen.metrics, seen.posteriors
            )
        columns = assemble.column_results(seen.clock, seen.posteriors, seen.snr, seen.samples, options.min_confidence)
        columns = tuple(replace(column, denoised=column.column in denoised) for column in columns)
        if camera.reversed:
            columns = tuple(_in_stored_rows(column, frame.height) for column in columns)
        result = replace(result, denoiser=report)
        result = replace(result, columns=columns, status=assemble.frame_status(columns))
    except _Failure as failure:
        result = replace(result, status=failure.status, message=failure.message)
    return replace(result, timing_ms=stages.total())


def _in_stored_rows(column: ColumnResult, height: int) -> ColumnResult:
    """The column with rows as stored, where they were counted in readout order."""
    packets = (replace(packet, first_row=height - 1 - packet.first_row) for packet in column.packets)
    return replace(column, packets=tuple(packets))


def _camera_of(frame: Frame, options: ReceiverOptions) -> _Camera | None:
    """What the profiles say of the frame's camera; None where none fits."""
    meta = frame.metadata
    profile = (
        options.cameras[0]
        if options.force_camera
        else match_camera(options.cameras, meta.make, meta.model, frame.width, frame.height)
    )
    mode = profile.mode_for(frame.width, frame.height) if profile else None
    if profile is None:
        return None
    if mode is None:
        raise _Failure(
            "no_signal",
            f"camera profile {profile.name} has no readout mode for {frame.width} x {frame.height}; add one with "
            "vlc-rx calibrate shutter, or leave the camera to be estimated with --camera auto",
        )
    lens = geometry.lens_for(profile.lens, frame.width, frame.height) if profile.lens else None
    tone = _DEFAULT_TONE if profile.tone == "auto" else profile.tone
    return _Camera(profile.name, mode.line_delay_s, _exposure_of(frame, mode), lens, tone)


def _camera_and_screens(
    frame: Frame, corners: FloatArray, options: ReceiverOptions, stages: _Stages
) -> tuple[_Camera, ReceiverOptions]:
    """The camera, from a profile or estimated, and the options with the screens that remain."""
    known = _camera_of(frame, options)
    return (known, options) if known is not None else _estimate_camera(frame, corners, options, stages)


def _estimate_camera(
    frame: Frame, corners: FloatArray, options: ReceiverOptions, stages: _Stages
) -> tuple[_Camera, ReceiverOptions]:
    """A camera that no profile fits, estimated from the frame; and the options with the screens that remain."""
    n_columns = min(screen.columns for screen in options.screens)
    with stages("sampling"):
        outlines = _outlines(frame, corners, None, n_columns)
        profiles = sampling.sample_rows(frame, outlines, _DEFAULT_TONE)
    with stages("blind"):
        centre_x = (outlines.edges_x[1:] + outlines.edges_x[:-1]) / 2
        strips = blind.strips_of(profiles, centre_x, frame.width, frame.height)
        found = blind.estimate_camera(strips, options.screens, frame.metadata.exposure_s)
    estimate = found.estimate
    if estimate is None:
        raise _Failure("no_signal", found.reason)
    screens = [screen for screen in options.screens if screen.packet_slots == estimate.packet_slots]
    rate = screens[0].slot_rate_hz
    camera = _Camera(
        profile=None,
        line_delay_s=1 / (estimate.rows_per_slot * rate),
        exposure_s=estimate.exposure_slots / rate,
        lens=blind.lens_of(estimate, frame.width, frame.height),
        tone=_DEFAULT_TONE,
        reversed=estimate.reversed,
        estimated=blind.summary(estimate, rate),
    )
    return camera, replace(options, screens=tuple(screen for screen in screens if screen.slot_rate_hz == rate))


def _exposure_of(frame: Frame, mode: ReadoutMode) -> float:
    exposure = frame.metadata.exposure_s or mode.exposure_s
    return exposure if exposure else 5 * mode.line_delay_s


def _find_corners(frame: Frame, options: ReceiverOptions) -> FloatArray:
    orientation = frame.metadata.orientation
    if orientation in _PORTRAIT:
        raise _Failure(
            "no_signal",
            f"the picture was taken in portrait (EXIF orientation {orientation}): the sensor reads along the width of "
            "the columns, so that they cannot be told apart; hold the camera in landscape",
        )
    if options.corners is not None:
        return options.corners
    from rxcli.find_screen import find_screen

    levels = frame.mosaic
    black, white = (float(np.mean(levels.black)), levels.white) if levels else (frame.black, frame.white)
    period = levels.pattern.shape[1] if levels else 1
    found = find_screen(frame.pixels, black=black, white=white, mosaic_period=period)
    if found.corners is None:
        raise _Failure("no_screen", f"no screen found: {found.reason}; give its place with --corners")
    return geometry.viewer_order(found.corners, orientation)


def _find_lock(frame: Frame, corners: FloatArray, camera: _Camera, options: ReceiverOptions, stages: _Stages) -> _Lock:
    """The screen profile that fits best, with the row profiles of its columns.

    Screens that differ in nothing but their columns share a clock: which of them it is, is asked last.
    """
    n_columns = min(screen.columns for screen in options.screens)
    with stages("sampling"):
        profiles = _sample(frame, corners, camera, n_columns)
    with stages("clock"):
        quick = clock.halved_strips(profiles)
        rates = {(s.slot_rate_hz, s.packet_slots): s for s in options.screens}
        clocks = {rate: found for rate, screen in rates.items() if (found := _clock_of(screen, quick, camera))}
        clocks = {rate: found for rate, found in clocks.items() if found.lock >= _MIN_LOCK}
        if not clocks:
            raise _Failure("no_signal", _why_no_signal(corners, camera, options))
        rate = next(iter(clocks)) if len(clocks) == 1 else max(clocks, key=lambda r: _structure(quick, clocks[r]))
    alike = [screen for screen in options.screens if (screen.slot_rate_hz, screen.packet_slots) == rate]
    locks = [_Lock(alike[0], profiles, clocks[rate])] if alike[0].columns == n_columns else []
    for screen in alike[len(locks) :]:
        with stages("sampling"):
            finer = _sample(frame, corners, camera, screen.columns)
        with stages("clock"):
            found = _clock_of(screen, clock.halved_strips(finer), camera)
        if found:
            locks.append(_Lock(screen, finer, found))
    if not locks:
        raise _Failure("no_signal", _why_no_signal(corners, camera, options))
    return locks[0] if len(locks) == 1 else _with_likely_columns(locks)


def _structure(profiles: RowProfiles, now: Clock) -> float:
    """How much the strips, each on its own, look like packets on this clock."""
    samples = clock.sample_slots(profiles, now, 1)
    slots = samples.light.reshape(-1, now.n_slots).astype(np.float64)
    return blind.structure_evidence(slots, now.first_slot, now.packet_slots)


def _with_likely_columns(locks: list[_Lock]) -> _Lock:
    """Among screens of one clock, the one whose columns are as wide as seen."""
    finest = max(locks, key=lambda lock: lock.profiles.light.shape[0] * lock.profiles.light.shape[1])
    likely = blind.likely_columns(finest.profiles, finest.clock, [lock.screen for lock in locks])
    return next(lock for lock in locks if lock.screen is likely)


def _outlines(frame: Frame, corners: FloatArray, lens: Lens | None, n_columns: int) -> Outlines:
    column_px = float(np.linalg.norm(corners[1] - corners[0])) / n_columns
    n_strips = sampling.strips_per_column(column_px)
    return geometry.column_outlines(corners, n_columns, n_strips, frame.width, frame.height, lens)


def _sample(frame: Frame, corners: FloatArray, camera: _Camera, n_columns: int) -> RowProfiles:
    profiles = sampling.sample_rows(frame, _outlines(frame, corners, camera.lens, n_columns), camera.tone)
    return blind.in_time_order(profiles, frame.height) if camera.reversed else profiles


def _noise_of(profiles: RowProfiles) -> float:
    """Standard deviation of a strip's row of no light."""
    return float(np.sqrt(profiles.noise_floor / max(float(np.median(profiles.count)), 1.0)))


def _clock_of(screen: ScreenProfile, profiles: RowProfiles, camera: _Camera) -> Clock | None:
    rows_per_slot = 1 / (screen.slot_rate_hz * camera.line_delay_s)
    exposure_slots = camera.exposure_s * screen.slot_rate_hz
    return clock.find_clock(profiles, rows_per_slot, exposure_slots, screen.packet_slots, _noise_of(profiles))


def _why_no_signal(corners: FloatArray, camera: _Camera, options: ReceiverOptions) -> str:
    visible_s = float(np.ptp(corners[:, 1])) * camera.line_delay_s
    shortest = min(options.screens, key=lambda screen: screen.packet_s)
    if visible_s < shortest.packet_s:
        return (
            f"the screen's {np.ptp(corners[:, 1]):.0f} rows show {1e3 * visible_s:.2f} ms of the link, less than one "
            f"packet of {shortest.name} ({1e3 * shortest.packet_s:.2f} ms); move closer or use a faster slot rate"
        )
    return "a screen was found but no packet header; check that it sends, the shutter is electronic and HDR is off"


@dataclass(frozen=True, slots=True)
class _Reception:
    """What was received of a frame."""

    clock: Clock
    samples: SlotSamples
    posteriors: BurstPosteriors
    #: (C, N): squared contrast over variance of every slot.
    snr: Float32Array
    model: channel.LightModel
    #: (C, N + memory, patterns).
    metrics: FloatArray


def _decode(lock: _Lock) -> _Reception:
    """A quick look first; where that leaves doubt, the light model in depth."""
    seen = _quick_look(lock)
    if not _doubtful(seen, _CERTAIN_AT_ONCE).any():
        return seen
    return _iterate(lock, seen)


def _quick_look(lock: _Lock) -> _Reception:
    """One pass over the strips pooled in pairs, from the first guess."""
    profiles = clock.halved_strips(lock.profiles)
    now = lock.clock
    samples = clock.sample_slots(profiles, now, _SAMPLES_PER_SLOT)
    model = _light_model(replace(lock, profiles=profiles), samples)
    llr = channel.first_llr(*clock.slot_contrast(samples, model.sigma))
    now = clock.assign_bursts(now, llr, lock.screen.repeats)
    posteriors = _detect(channel.metrics_of(llr, model.memory), now, model)
    columns = np.arange(samples.light.shape[0])
    lit = channel.lit_on_grid(posteriors, now)
    likelihoods = channel.slot_likelihoods(samples, now, model, lit, columns, thorough=False)
    now = clock.assign_bursts(now, detect.slot_llr(likelihoods.metrics), lock.screen.repeats)
    now = clock.corrected(now, likelihoods.timing)
    metrics = likelihoods.metrics
    return _Reception(now, samples, _detect(metrics, now, model), likelihoods.snr, model, metrics)


def _iterate(lock: _Lock, seen: _Reception) -> _Reception:
    """Light model and detection in turn, until every column is certain or nothing more is to be expected."""
    now = seen.clock
    samples = clock.sample_slots(lock.profiles, now, _SAMPLES_PER_SLOT)
    model = _light_model(lock, samples)
    columns = np.arange(samples.light.shape[0])
    metrics = np.zeros((columns.size, now.n_slots + model.memory, 2 << model.memory))
    snr = np.zeros((columns.size, now.n_slots), np.float32)
    for iteration in range(_MAX_ITERATIONS):
        lit = channel.lit_on_grid(seen.posteriors, now)
        likelihoods = channel.slot_likelihoods(samples, now, model, lit, columns)
        metrics[columns], snr[columns] = likelihoods.metrics, likelihoods.snr
        before = seen.posteriors.index
        seen = _Reception(now, samples, _detect(metrics, now, model), snr, model, metrics)
        doubtful = _doubtful(seen, _CERTAIN)
        if iteration and before.shape == seen.posteriors.index.shape:
            # What does not change any more will not do so later.
            doubtful &= (before != seen.posteriors.index).any(axis=(0, 2))
        columns = np.flatnonzero(doubtful)
        if columns.size == 0:
            break
        if iteration == 0:
            bursts = now.burst
            now = clock.assign_bursts(now, detect.slot_llr(metrics), lock.screen.repeats)
            if not np.array_equal(now.burst, bursts):
                seen = replace(seen, clock=now, posteriors=_detect(metrics, now, model))
            now = clock.corrected(now, likelihoods.timing)
            samples = clock.sample_slots(lock.profiles, now, _SAMPLES_PER_SLOT)
    return seen


def _second_opinion(
    lock: _Lock, seen: _Reception, options: ReceiverOptions
) -> tuple[_Reception, frozenset[int], dict[str, Any] | None]:
    """Doubtful columns once more from where the auto-encoder starts; whichever end is more plausible is kept.

    Returns:
        What is kept, the columns whose second end that is, and what to report; None where nothing was done.
    """
    if options.cae == "never":
        return seen, frozenset(), None
    if options.cae == "always" and seen.samples.light.shape[1] < lock.profiles.light.shape[1]:
        seen = _iterate(lock, seen)
    doubtful = np.ones(seen.snr.shape[0], bool) if options.cae == "always" else _doubtful(seen, _CERTAIN)
    columns = np.flatnonzero(doubtful)
    if columns.size == 0:
        return seen, frozenset(), None
    report: dict[str, Any] = {"model": denoise.DEFAULT_MODEL, "columns": columns.size, "kept": 0}
    try:
        denoiser = _denoiser()
        log_odds = denoiser.slot_log_odds(_scene_of(seen), columns)
    except ReceiverError as error:
        return seen, frozenset(), {**report, "columns": 0, "message": str(error)}
    seen = _with_bursts_of(seen, log_odds, lock.screen.repeats)
    again = _restart(seen, log_odds, columns)
    better = _evidence(again.metrics, seen) > _evidence(seen.metrics[columns], seen)
    kept = columns[better]
    if kept.size:
        metrics, snr = seen.metrics.copy(), seen.snr.copy()
        metrics[kept], snr[kept] = again.metrics[better], again.snr[better]
        posteriors = _detect(metrics, seen.clock, seen.model)
        seen = replace(seen, metrics=metrics, snr=snr, posteriors=posteriors)
    return seen, frozenset(kept.tolist()), {**report, "model": denoiser.name, "kept": kept.size}


@lru_cache(maxsize=1)
def _denoiser() -> denoise.Denoiser:
    return denoise.load_denoiser()


def _scene_of(seen: _Reception) -> denoise.Scene:
    model = seen.model
    lit = channel.lit_on_grid(seen.posteriors, seen.clock)
    return denoise.Scene(seen.samples, seen.clock, lit, model.floor, model.sigma, model.shot, model.spread)


def _with_bursts_of(seen: _Reception, log_odds: Float32Array, repeats: int) -> _Reception:
    """Bursts told apart by log-odds that no copy has lent to another; symbols detected anew where that moves them."""
    now = clock.assign_bursts(seen.clock, log_odds, repeats)
    if np.array_equal(now.burst, seen.clock.burst):
        return seen
    return replace(seen, clock=now, posteriors=_detect(seen.metrics, now, seen.model))


def _restart(seen: _Reception, log_odds: Float32Array, columns: NDArray[np.int64]) -> channel.SlotLikelihoods:
    """Light model and detection of some columns from given log-odds of their slots; the other columns stay."""
    lit = channel.lit_on_grid(seen.posteriors, seen.clock).copy()
    metrics = channel.metrics_of(log_odds, seen.model.memory)
    for _ in range(_RESTART_ITERATIONS):
        lit[columns] = channel.lit_on_grid(_detect(metrics, seen.clock, seen.model), seen.clock)
        likelihoods = channel.slot_likelihoods(seen.samples, seen.clock, seen.model, lit, columns)
        metrics = likelihoods.metrics
    return likelihoods


def _evidence(metrics: FloatArray, seen: _Reception) -> FloatArray:
    """(C,) log evidence of columns, over all weights."""
    bursts = channel.by_burst(metrics, seen.clock, seen.model.memory)
    return np.asarray(
        np.logaddexp.reduce(detect.weight_evidence(bursts, detect.plausible_weights(bursts, _HOPELESS_WEIGHT)), axis=1)
    )


def _doubtful(seen: _Reception, certain: float) -> NDArray[np.bool_]:
    """(C,) whether a packet that could be reported has a symbol of less than the log probability `certain`."""
    complete = assemble.complete(assemble.slots_seen(seen.samples, seen.clock))
    return np.asarray(((seen.posteriors.log_prob.min(axis=2) < certain) & complete).any(axis=0))


def _detect(metrics: FloatArray, now: Clock, model: channel.LightModel) -> BurstPosteriors:
    bursts = channel.by_burst(metrics, now, model.memory)
    return detect.detect(bursts, detect.plausible_weights(bursts, _HOPELESS_WEIGHT))


def _light_model(lock: _Lock, samples: SlotSamples) -> channel.LightModel:
    now, profiles = lock.clock, lock.profiles
    memory = channel.memory_for(now.exposure_slots)
    rows_per_sample = max(now.rows_per_slot / _SAMPLES_PER_SLOT, 1.0)
    floor = channel.estimate_floor(samples, now)
    least = _noise_of(profiles) / np.sqrt(rows_per_sample)
    return channel.LightModel(
        floor=floor,
        sigma=channel.estimate_sigma(samples, floor, 0.5 * float(least)),
        shot=profiles.noise_slope / max(float(np.median(profiles.count)), 1.0) / rows_per_sample,
        spread=channel.spread_matrix(samples.light.shape[1], lock.screen.light_spread),
        taps=channel.exposure_taps(now.exposure_slots, 1 / _SAMPLES_PER_SLOT, memory, _SAMPLES_PER_SLOT),
    )
