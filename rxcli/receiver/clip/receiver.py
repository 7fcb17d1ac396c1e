"""The frames of a clip, one after the other: three states and a step.

`Acquiring`: no frame has been received; the first ones agree on an outline and, where each shows little, on a clock.
`Tracking`: screen, picture, clock and camera are known, and checked in every frame. `Lost`: the next frame is received
like a photograph, with the camera and the link's time that are still believed.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rxcli.numerics import one_blas_thread
from rxcli.options import ReceiverOptions
from rxcli.receiver.clip.acquiring import FirstFrames
from rxcli.receiver.clip.camera import Acquired, ClipCamera, Located
from rxcli.receiver.clip.common_clock import common_clock, hides_headers, start_by
from rxcli.receiver.clip.ledger import Ledger
from rxcli.receiver.clip.scene import TrackedScreen, by_copy_llr
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.views import JointSlots, View, Waiting, decides_jointly
from rxcli.receiver.decode import assemble
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.passes import shows_steady_light
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.search import Found
from rxcli.receiver.still import apply_autoencoder, decode
from rxcli.types import FloatArray, Frame, FrameResult, OnTaps, Reason, Remark


def receive_clip(
    frames: Iterable[Frame], options: ReceiverOptions, on_taps: OnTaps | None = None
) -> Iterator[FrameResult]:
    """Receive the frames of a clip; results come a frame or more late. An error of `frames` comes after all results."""
    state = begin(options, on_taps)
    try:
        for frame in frames:
            with one_blas_thread():
                state, results = step(state, frame)
            yield from results
    except Exception:
        yield from finish(state)
        raise
    yield from finish(state)


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """What every state knows of a clip."""

    #: Timeline time, bursts and results that wait: these add up over all frames.
    ledger: Ledger
    camera: ClipCamera
    #: (4, 2) of the screen in the last frame that showed it.
    corners: FloatArray | None = None
    #: Where the screen was found last.
    outline: Outline | None = None
    #: The last frame.
    frame: Frame | None = None
    #: Log-odds that the picture moves on the screen, and whether it was another one before.
    film_log_odds: float = SETTINGS.film_log_odds
    has_changed: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Acquiring:
    """No frame has been received: the first ones wait until they agree."""

    known: Known
    frames: FirstFrames | None = None
    #: Whether frames that show nothing by themselves may wait for others.
    may_wait: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Tracking:
    """The screen is followed from frame to frame."""

    known: Known
    scene: TrackedScreen


@dataclass(frozen=True, slots=True, eq=False)
class Lost:
    """No picture is known: the screen was lost, or frames of this kind cannot be tracked."""

    known: Known


State = Acquiring | Tracking | Lost
_Step = tuple[Tracking | Lost, list[FrameResult]]


def begin(options: ReceiverOptions, on_taps: OnTaps | None = None) -> State:
    """The state before the first frame."""
    known = Known(Ledger(options, on_taps), ClipCamera(options))
    return Acquiring(known) if "tracking" in options.skip else Lost(known)


def step(state: State, frame: Frame) -> tuple[State, list[FrameResult]]:
    """Receive the next frame; returns the state after it and the results that are complete."""
    return _acquire(state, frame) if isinstance(state, Acquiring) else _receive(state, frame)


def finish(state: State) -> list[FrameResult]:
    """The results still held back."""
    state, results = _received(state)
    return results + state.known.ledger.finish()


# -- the first frames --------------------------------------------------------------------------------------------------


def _acquire(state: Acquiring, frame: Frame) -> tuple[State, list[FrameResult]]:
    """Take one of the first frames; they are received once they agree."""
    known, held = state.known, state.frames
    if held is None:
        return _go_on(known, FirstFrames.begin(frame, known.camera, may_wait=state.may_wait))
    if _are_alike(held.frames[0], frame):
        return _go_on(known, held.with_frame(frame, known.camera))
    after, results = _received(state)
    anew, more = _acquire(Acquiring(replace(after.known, camera=after.known.camera.of_frame(frame))), frame)
    return anew, results + more


def _are_alike(frame: Frame, following: Frame) -> bool:
    return frame.pixels.shape == following.pixels.shape and frame.pixels.dtype == following.pixels.dtype


def _received(state: State) -> tuple[State, list[FrameResult]]:
    """Receive the first frames that wait for more, since none come."""
    results: list[FrameResult] = []
    while isinstance(state, Acquiring) and state.frames is not None:
        state, more = _go_on(state.known, state.frames, are_all=True)
        results += more
    return state, results


def _go_on(known: Known, held: FirstFrames, *, are_all: bool = False) -> tuple[State, list[FrameResult]]:
    """Receive the first frames if they are enough; the first of them alone if it shows no screen and camera."""
    if len(held.frames) < held.n_needed and not are_all:
        return Acquiring(known, held), []
    if held.is_hidden:
        return _go_on(known, held.shown(known.camera), are_all=are_all)
    if isinstance(held.located, Located):
        return _receive_first(known, held, held.located)
    after, results = _receive(Lost(known), held.frames[0], held.located)
    state: State = Acquiring(after.known, may_wait=False)
    for frame in held.frames[1:]:
        state, more = step(state, frame)
        results += more
    return replace(state, may_wait=True) if isinstance(state, Acquiring) else state, results


def _receive_first(known: Known, held: FirstFrames, located: Located) -> _Step:
    """Receive the first frames by what they show; where each shows little, they agree on a clock."""
    if held.start is not None:
        known.ledger.start = held.start
    elif len(held.frames) > 1 and isinstance(found := located.found, Found) and hides_headers(found):
        known.ledger.start = start_by(found, held.frames)
    elif len(held.frames) > 1 and located.shows_little:
        agreed = common_clock(held.frames, located.context, known.camera.options.screens)
        if agreed is not None:
            known.ledger.start, context = agreed
            located = replace(located, context=context)
    if not (located.is_plain or located.is_long):
        located = replace(located, found=None)  # Of few packets, a second search there finds clock and exposure better.
    after, results = _receive(Lost(known), held.frames[0], located)
    for frame in held.frames[1:]:
        after, more = _receive(after, frame)
        results += more
    return after, results


# -- one frame ---------------------------------------------------------------------------------------------------------


def _receive(state: Tracking | Lost, frame: Frame, located: Located | Failure | None = None) -> _Step:
    """Receive a frame by what is known, or like a photograph where that does not fit; `located` where it is."""
    cache, ledger, before = FrameCache(frame), state.known.ledger, state.known.frame
    remarks = (Remark("nominal_times"),) if frame.nominal_time else ledger.remarks
    waiting = Waiting(FrameResult(frame.source, frame.index, frame.time_s, "ok", remarks=remarks))
    reason = _reason_to_skip(state, frame, before)
    state = replace(state, known=replace(state.known, frame=frame))
    if reason is not None:
        counter, remark = reason
        waiting.update(skipped={counter: 1}, remarks=(Remark(remark),))
        return state, ledger.add(waiting)
    view: View | Failure | None = None
    if isinstance(state, Tracking) and state.known.camera.fits(frame):
        view = state.scene.view(cache, ledger.timeline)
    if isinstance(state, Tracking) and view is not None:
        waiting.update(skipped={"tracking": 1})
        state = replace(state, known=replace(state.known, corners=state.scene.corners))
    else:
        if isinstance(state, Tracking) and state.known.camera.fits(frame):
            log_odds = state.scene.film_log_odds
            state = replace(state, known=replace(state.known, film_log_odds=log_odds, has_changed=True))
        state, view, report = _receive_anew(state.known, cache, located)
        waiting.update(denoiser=report)
    if isinstance(view, Failure):
        waiting.update(status=view.status, remarks=(view.remark,), timing_ms=cache.timer.total())
        return state, ledger.add(waiting, scene_ends=True)
    waiting.update(
        **view.context.result_fields,
        remarks=remarks or tuple(filter(None, (state.known.camera.remark,))),
        screen_profile=view.acquisition.screen.name,
        corners=state.known.corners,
    )
    results = ledger.enter(waiting, view, state.scene if isinstance(state, Tracking) else None)
    waiting.update(timing_ms=cache.timer.total())
    return state, results


def _reason_to_skip(state: Tracking | Lost, frame: Frame, before: Frame | None) -> tuple[str, Reason] | None:
    """Counter and reason of a frame that need not be received; None of others."""
    ledger, options = state.known.ledger, state.known.camera.options
    if "tracking" in options.skip and before is not None and _is_doubled(frame, before, state.known.corners):
        return "doubled_frames", "doubled"
    if options.stop_when_certain and isinstance(state, Tracking) and ledger.has_certain_bursts(frame, state.scene):
        return "certain_frames", "certain_before"
    return None


def _is_doubled(frame: Frame, before: Frame, corners: FloatArray | None) -> bool:
    """Whether a frame is the one before once more, as a change of the frame rate makes them: its time is wrong.

    Args:
        frame: the frame.
        before: the one before.
        corners: (4, 2) of the screen there; stripes are elsewhere in every other frame.
    """
    if corners is None or before.pixels.shape != frame.pixels.shape:
        return False
    starts, ends = np.maximum(corners.min(axis=0), 0).astype(int), np.ceil(corners.max(axis=0)).astype(int)
    steps = np.maximum((ends - starts) // SETTINGS.same_points, 1)
    columns, rows = map(slice, starts.tolist(), ends.tolist(), steps.tolist())
    pixels, earlier = (each.pixels[rows, columns].astype(np.float32) for each in (frame, before))
    if min(pixels.shape) < 2:  # The screen was in a larger frame.
        return False
    contrast = float(np.abs(np.diff(pixels, axis=0)).mean())
    if contrast < SETTINGS.min_contrast * (frame.white - frame.black):
        return False
    # Texture has contrast as well, and through long exposures stripes change the level by little.
    most = min(SETTINGS.same_share * contrast, SETTINGS.same_level_share * float(pixels.mean() - frame.black))
    return float(np.abs(pixels - earlier).mean()) < most


# -- a frame like a photograph -----------------------------------------------------------------------------------------


def _receive_anew(
    known: Known, cache: FrameCache, located: Located | Failure | None
) -> tuple[Tracking | Lost, View | Failure, dict[str, Any] | None]:
    """Receive a frame like a photograph, only the camera taken from before.

    Returns:
        The state after it, its view, and what the auto-encoder reports.
    """
    frame, timer, ledger = cache.frame, cache.timer, known.ledger
    camera = known.camera.of_frame(frame)
    located = located or camera.locate_again(cache, known.outline, known.corners)
    if isinstance(located, Failure):
        return Lost(replace(known, camera=camera)), located, None
    ledger.certainty = located.outline.certainty
    camera, acquired = camera.acquire(located, ledger.start, cache)
    known = replace(known, camera=camera, corners=located.outline.corners)
    if isinstance(acquired, Failure):
        return Lost(known), acquired, None
    options, acquisition, report = camera.options, acquired.acquisition, None
    tracks, denoised = _can_track(acquired, options), frozenset[int]()
    is_joint = decides_jointly(acquired.initial.clock)
    adds_up = not is_joint and not known.has_changed
    with timer("detect"):
        reception = decode(acquisition, options.skip, acquired.initial, adds_up=adds_up)
    # Else further frames show the picture.
    if not tracks or known.has_changed or options.cae == "always":
        with timer("denoise"):
            reception, denoised, report = apply_autoencoder(acquisition, reception, options)
    # Of long exposures packets were compared with arbitrary slots already.
    if ledger.start is None and not reception.is_long and shows_steady_light(reception):
        return Lost(known), Failure(Remark("steady_light")), None
    if assemble.all_dark(reception.snr):
        return Lost(known), Failure(Remark("nothing_lit")), None
    known = replace(known, outline=located.outline)
    llr = by_copy_llr(np.float32(0.5) * (1 + np.tanh(np.float32(0.5) * reception.llr))) if is_joint else reception.llr
    view = View(
        acquired.context,
        acquisition,
        reception.clock,
        llr,
        np.minimum(assemble.slots_observed(reception.samples, reception.clock.by_copy), 1),
        reception.snr,
        denoised,
        framing=acquired.framing,
        changed=known.has_changed,
        joint=None if adds_up else JointSlots(reception.clock.burst, reception.posteriors),
    )
    if not tracks:
        return Lost(known), view, report
    with timer("sampling"):
        place = replace(acquired.context, sampled_corners=located.context.sampled_corners)
        scene = TrackedScreen(
            place,
            acquisition,
            reception.model,
            reception.posteriors.w_log_prob,
            known.film_log_odds,
            known.has_changed,
            options.corners is not None,
            located.dark_ends,
        )
        view.light, view.pose = scene.strips(frame), scene.pose
    scene.update(view, lambda: reception.clock.on_grid(reception.posteriors.lit))
    return Tracking(known, scene), view, report


def _can_track(acquired: Acquired, options: ReceiverOptions) -> bool:
    """Whether strips can be followed from frame to frame: each row of the picture is one instant, in order of time."""
    return (
        "tracking" in options.skip
        and acquired.context.frame.mosaic is None
        and acquired.acquisition.profiles.sensor_row is None
        and not acquired.context.camera.reversed
    )
