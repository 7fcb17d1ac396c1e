"""The frames of a clip, one after the other: three states and a step.

`Acquiring`: no frame has been received; the first ones agree on an outline and, where each shows little, on a clock.
`Tracking`: screen, picture, clock and camera are known, and checked in every frame. `Lost`: the next frame is received
like a photograph, with the camera and the link's time that are still believed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import one_blas_thread
from rxcli.options import ReceiverOptions
from rxcli.receiver.clip.acquiring import FirstOutline, acquisition_at, shows_little
from rxcli.receiver.clip.camera import ClipCamera, Located, Settled
from rxcli.receiver.clip.ledger import Ledger
from rxcli.receiver.clip.scene import TrackedScreen
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.views import View, Waiting
from rxcli.receiver.context import Failure, Timer
from rxcli.receiver.decode import assemble
from rxcli.receiver.reception import Reception, shows_steady_light
from rxcli.receiver.search import Found
from rxcli.receiver.search.refusal import STEADY_LIGHT
from rxcli.receiver.still import apply_autoencoder, decode
from rxcli.receiver.sync import tracking
from rxcli.types import FloatArray, Frame, FrameResult

_SAME = "it shows the frame before once more, so that its time is not that of its rows; it was left out"
_NOMINAL_TIME = "the clip's time stamps do not advance here; its nominal frame rate was taken"


def receive_clip(frames: Iterable[Frame], options: ReceiverOptions) -> Iterator[FrameResult]:
    """Receive the frames of a clip; results come a frame or more late. An error of `frames` comes after all results."""
    state = begin(options)
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

    #: Link time, bursts and results that wait: these add up over all frames.
    ledger: Ledger
    camera: ClipCamera
    #: (4, 2) of the screen in the last frame that showed it.
    corners: FloatArray | None = None
    #: Some pixels of the last frame.
    thumbnail: NDArray[np.float32] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FirstFrames:
    """The first frames that show screen and camera."""

    #: Where the screen is in the first of them, and its outline by all.
    located: Located
    outline: FirstOutline
    frames: tuple[Frame, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Acquiring:
    """No frame has been received: the first ones wait until they agree."""

    known: Known
    started: FirstFrames | None = None


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


def begin(options: ReceiverOptions) -> State:
    """The state before the first frame."""
    known = Known(Ledger(options), ClipCamera(options))
    return Acquiring(known) if "tracking" in options.skip else Lost(known)


def step(state: State, frame: Frame) -> tuple[State, list[FrameResult]]:
    """Receive the next frame; returns the state after it and the results that are complete."""
    return _acquire(state, frame) if isinstance(state, Acquiring) else _receive(state, frame)


def finish(state: State) -> list[FrameResult]:
    """The results still held back."""
    if not isinstance(state, Acquiring) or state.started is None:
        return state.known.ledger.finish()
    after, results = _receive_first(state.known, state.started)
    return results + after.known.ledger.finish()


# -- the first frames --------------------------------------------------------------------------------------------------


def _acquire(state: Acquiring, frame: Frame) -> tuple[State, list[FrameResult]]:
    """Take one of the first frames; they are received once they agree on an outline and, perhaps, on a clock."""
    known, started = state.known, state.started
    if started is None:
        located = known.camera.locate(frame, Timer())
        if isinstance(located, Failure):
            after, results = _receive(Lost(known), frame, located)
            return Acquiring(after.known), results
        outline = FirstOutline(frame, located.outline.corners, known.camera.options, located.context)
        started = FirstFrames(located, outline, (frame,))
    else:
        started = _with_frame(known, started, frame)
    little, unsettled = shows_little(started.located.context), started.located.camera_error == np.inf
    if unsettled:
        min_frames = SETTINGS.frames_held_long if little else SETTINGS.frames_together
    else:
        min_frames = SETTINGS.frames_together if little else 1
    enough = started.outline.settled and len(started.frames) >= min_frames
    return _receive_first(known, started) if enough else (Acquiring(known, started), [])


def _with_frame(known: Known, started: FirstFrames, frame: Frame) -> FirstFrames:
    """The first frames and one more; where each shows little or nothing, the surest of their cameras counts."""
    started.outline.add(frame)
    located = started.located
    if located.camera_error == np.inf or (located.camera_error > 0 and shows_little(located.context)):
        located = located.with_surer_camera(known.camera.locate(frame, Timer()))
    return FirstFrames(located, started.outline, (*started.frames, frame))


def _receive_first(known: Known, started: FirstFrames) -> tuple[State, list[FrameResult]]:
    """Receive the first frames: they have agreed on an outline and, where each shows little, on a clock."""
    located = started.located.moved_to(started.outline.corners)
    if isinstance(located.found, Found) and located.found.best.context.frame is not started.frames[0]:
        located = replace(located, found=None)
    camera, located = known.camera.read_in_time(located, started.frames)
    if len(started.frames) > 1 and shows_little(located.context):
        located, known.ledger.start = camera.with_common_clock(located, started.frames)
    after, results = _receive(Lost(replace(known, camera=camera)), started.frames[0], located)
    for frame in started.frames[1:]:
        after, more = _receive(after, frame)
        results += more
    return after, results


# -- one frame ---------------------------------------------------------------------------------------------------------


def _receive(
    state: Tracking | Lost, frame: Frame, located: Located | Failure | None = None
) -> tuple[Tracking | Lost, list[FrameResult]]:
    """Receive a frame by what is known, or like a photograph where that does not fit; `located` where it is."""
    timer, ledger = Timer(), state.known.ledger
    message = _NOMINAL_TIME if frame.nominal_time else ledger.message
    waiting = Waiting(FrameResult(frame.source, frame.index, frame.time_s, "ok", message=message))
    doubled, known = _is_doubled(state.known, frame)
    state = replace(state, known=known)
    reason = _reason_to_skip(state, frame, doubled)
    if reason is not None:
        counter, message = reason
        waiting.result = replace(waiting.result, message=message)
        waiting.skip(counter, 1)
        return state, ledger.add(waiting)
    view: View | Failure | None = _tracked_view(state, frame, timer)
    if isinstance(state, Tracking) and view is not None:
        waiting.skip("tracking", 1)
        state = Tracking(replace(known, corners=state.scene.corners), state.scene)
    else:
        state, view, report = _receive_anew(state, frame, located, timer)
        waiting.result = replace(waiting.result, denoiser=report)
    camera = state.known.camera
    if camera.message and not waiting.result.message:
        waiting.result = replace(waiting.result, message=camera.message)
    if isinstance(view, Failure):
        waiting.result = replace(waiting.result, status=view.status, message=view.message, timing_ms=timer.total())
        return state, ledger.add(waiting, scene_ends=True)
    waiting.result = replace(
        waiting.result,
        **view.context.camera.result_fields,
        screen_profile=view.acquisition.screen.name,
        corners=state.known.corners,
    )
    scene = state.scene if isinstance(state, Tracking) else None
    results = ledger.enter(waiting, view, scene)
    waiting.result = replace(waiting.result, timing_ms=timer.total())
    return state, results


def _reason_to_skip(state: Tracking | Lost, frame: Frame, doubled: bool) -> tuple[str, str] | None:
    """Counter and message of a frame that need not be received; None of others."""
    if doubled:
        return "doubled_frames", _SAME
    known = state.known
    if (
        isinstance(state, Tracking)
        and known.camera.options.stop_when_certain
        and known.ledger.has_certain_bursts(frame, state.scene)
    ):
        return "certain_frames", "its bursts are certain from the frames before"
    return None


def _is_doubled(known: Known, frame: Frame) -> tuple[bool, Known]:
    """Whether a frame is the one before once more, as a change of the frame rate makes them: its time is wrong."""
    if "tracking" not in known.camera.options.skip or known.corners is None:
        return False, known
    some = frame.pixels[:: SETTINGS.same_step, :: SETTINGS.same_step].astype(np.float32)
    before, known = known.thumbnail, replace(known, thumbnail=some)
    if before is None or before.shape != some.shape:
        return False, known
    assert known.corners is not None
    (left, top), (right, bottom) = (known.corners[[0, 2]] / SETTINGS.same_step).astype(int).clip(0)
    screen = np.s_[min(top, bottom) : max(top, bottom), min(left, right) : max(left, right)]
    some, before = some[screen], before[screen]
    if min(some.shape) < 2:
        return False, known
    # Stripes are elsewhere in every other frame.
    unit = (frame.white - frame.black) / 255
    contrast = float(np.abs(np.diff(some, axis=0)).mean())
    changed = float(np.abs(some - before).mean())
    return contrast > SETTINGS.same_contrast * unit and changed < SETTINGS.same_share * contrast, known


def _tracked_view(state: Tracking | Lost, frame: Frame, timer: Timer) -> View | None:
    """The view of a frame by what is known; None where that does not fit."""
    if not isinstance(state, Tracking) or not state.known.camera.fits(frame):
        return None
    time, thorough = state.known.ledger.time, not state.known.ledger.holds_more
    return None if time is None else state.scene.view(frame, time, thorough, timer)


# -- a frame like a photograph -----------------------------------------------------------------------------------------


def _receive_anew(
    state: Tracking | Lost, frame: Frame, located: Located | Failure | None, timer: Timer
) -> tuple[Tracking | Lost, View | Failure, dict[str, Any] | None]:
    """Receive a frame like a photograph, only the camera taken from before.

    Returns:
        The state after it, its view, and what the auto-encoder reports.
    """
    known, ledger = state.known, state.known.ledger
    camera = known.camera.for_frame(frame)
    located = located or camera.locate(frame, timer)
    if isinstance(located, Failure):
        return Lost(replace(known, camera=camera)), located, None
    ledger.certainty = located.outline.certainty
    corners = located.outline.corners
    camera = camera.found_with(located, frame)
    assert camera.context is not None
    context = replace(camera.context, frame=frame, corners=corners, timer=timer)
    predicted = None if ledger.start is None else acquisition_at(ledger.start, context)
    camera, settled = camera.settled(replace(located, context=context), predicted)
    lost = Lost(replace(known, camera=camera, corners=corners))
    if isinstance(settled, Failure):
        return lost, settled, None
    reception, denoised, report = _decoded(settled, known, timer)
    camera, estimated = camera.estimated(settled.context, reception)
    lost = replace(lost, known=replace(lost.known, camera=camera))
    if estimated is not None:
        settled = estimated
        reception, denoised, report = _decoded(settled, lost.known, timer)
    if ledger.start is None and shows_steady_light(reception):
        return lost, Failure("no_signal", STEADY_LIGHT), None
    if assemble.all_dark(reception.snr):
        message = "no light of the screen's columns is seen; something may be in front of it"
        return lost, Failure("no_signal", message), None
    view = View(
        settled.context,
        settled.acquisition,
        _bursts_of(frame, reception),
        reception.model.exposure.isi_memory,
        frame.height,
        reception.snr,
        denoised,
    )
    if not _can_track(settled, camera.options):
        return lost, view, report
    with timer("sampling"):
        named = camera.options.corners is not None
        scene = TrackedScreen(settled.context, settled.acquisition, reception.model.black_level, named)
        view.light, view.pose = scene.strips(frame), scene.pose
    scene.update(view, lambda: reception.clock.on_grid(reception.posteriors.lit))
    return Tracking(lost.known, scene), view, report


def _decoded(settled: Settled, known: Known, timer: Timer) -> tuple[Reception, frozenset[int], dict[str, Any] | None]:
    """What is received with a clock and camera, columns that the auto-encoder changed, and its report.

    A reception that there is already needs no other.
    """
    options, acquisition, reception = known.camera.options, settled.acquisition, settled.reception
    if reception is None:
        with timer("detect"):
            reception = decode(acquisition, options.skip, settled.initial)
    with timer("denoise"):
        return apply_autoencoder(acquisition, reception, options)


def _can_track(settled: Settled, options: ReceiverOptions) -> bool:
    """Whether a row of the picture is one instant, in the order of time."""
    return (
        "tracking" in options.skip
        and settled.context.frame.mosaic is None
        and settled.acquisition.profiles.sensor_row is None
        and not settled.context.camera.reversed
    )


def _bursts_of(frame: Frame, reception: Reception) -> tracking.FrameBursts:
    by_copy = replace(reception.clock, burst=np.arange(reception.clock.n_copies))
    shown = np.minimum(assemble.slots_observed(reception.samples, by_copy), 1)
    return tracking.FrameBursts(frame.index, 0, reception.clock, reception.metrics, shown)
