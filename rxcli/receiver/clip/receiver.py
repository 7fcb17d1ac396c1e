"""The frames of a clip: a window of first frames, then a stream.

    window -> stream -> photograph -> stream ...

The *window* holds the first frames until they agree on an outline and, where each shows little, on a clock; a window
that shows nothing gives its frames one by one, and the next one opens. In the *stream* a frame is received with screen,
picture, clock and camera as they are known, and checked by them. A frame that does not fit is received like a
*photograph*, with the camera and the link's time that are still believed; the stream goes on with what it shows.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from rxcli.numerics import one_blas_thread
from rxcli.options import ReceiverOptions
from rxcli.receiver.channel import lit_of
from rxcli.receiver.clip.acquiring import Window
from rxcli.receiver.clip.camera import Acquired, ClipCamera, Located
from rxcli.receiver.clip.ledger import Ledger
from rxcli.receiver.clip.scene import TrackedScreen, by_copy_llr
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.views import JointSlots, View, Waiting, decides_jointly
from rxcli.receiver.decode import assemble
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.passes import Reception, shows_steady_light
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.still import apply_autoencoder, decode
from rxcli.types import FloatArray, Frame, FrameResult, OnTaps, Reason, Remark


def receive_clip(
    frames: Iterable[Frame], options: ReceiverOptions, on_taps: OnTaps | None = None
) -> Iterator[FrameResult]:
    """Receive the frames of a clip; results come a frame or more late. An error of `frames` comes after all results."""
    receiver = ClipReceiver(options, on_taps)
    try:
        for frame in frames:
            with one_blas_thread():
                results = receiver.add(frame)
            yield from results
    except Exception:
        yield from receiver.finish()
        raise
    yield from receiver.finish()


class ClipReceiver:
    """Receives the frames of a clip, one after the other."""

    def __init__(self, options: ReceiverOptions, on_taps: OnTaps | None) -> None:
        #: Link time, bursts and results that wait.
        self._ledger = Ledger(options, on_taps)
        self._camera = ClipCamera(options)
        #: Whether the clip is in its window, the frames of it, and whether frames that show nothing may wait.
        self._is_acquiring, self._may_wait = "tracking" in options.skip, True
        self._window: Window | None = None
        #: The screen that is followed; None where no picture is known.
        self._scene: TrackedScreen | None = None
        #: The last frame; (4, 2) of the screen in the last one that showed it; and where it was found last.
        self._before: Frame | None = None
        self._corners: FloatArray | None = None
        self._outline: Outline | None = None
        #: Log-odds that the picture moves on the screen, and whether it was another one before.
        self._film_log_odds, self._has_changed = SETTINGS.film_log_odds, False

    def add(self, frame: Frame) -> list[FrameResult]:
        """Receive the next frame; returns the results that are complete."""
        results: list[FrameResult] = []
        if self._window is not None and not self._window.is_like(frame):
            results = self._close_window()
            self._is_acquiring, self._camera, self._scene = True, self._camera.of_frame(frame), None
        if not self._is_acquiring:
            return self._receive(frame)
        if self._window is None:
            self._window = Window.begin(frame, self._camera, may_wait=self._may_wait)
        else:
            self._window = self._window.with_frame(frame, self._camera)
        return results + self._receive_window()

    def finish(self) -> list[FrameResult]:
        """The results still held back."""
        return self._close_window() + self._ledger.finish()

    # -- the first frames ----------------------------------------------------------------------------------------------

    def _close_window(self) -> list[FrameResult]:
        """Receive the frames that wait for more, since none come."""
        results: list[FrameResult] = []
        while self._window is not None:
            results += self._receive_window(are_all=True)
        return results

    def _receive_window(self, *, are_all: bool = False) -> list[FrameResult]:
        """Receive the window's frames if they are enough; one by one if they show no screen and camera."""
        assert self._window is not None
        window = self._window = self._window.searched(self._camera, are_all=are_all)
        if not (window.is_complete or are_all):
            return []
        self._window = None
        is_found = isinstance(window.located, Located)
        if is_found:
            window = window.with_clock(self._camera.options.screens)
            self._ledger.start = window.start or self._ledger.start
            self._is_acquiring = False
        results = self._receive(window.frames[0], window.located)
        may_wait, self._may_wait = self._may_wait, is_found
        for frame in window.frames[1:]:
            results += self.add(frame)
        self._may_wait = may_wait
        return results

    # -- one frame -----------------------------------------------------------------------------------------------------

    def _receive(self, frame: Frame, located: Located | Failure | None = None) -> list[FrameResult]:
        """Receive a frame by what is known, or like a photograph where it does not fit; `located` where it is."""
        cache, ledger = FrameCache(frame), self._ledger
        remarks = (Remark("nominal_times"),) if frame.nominal_time else ledger.remarks
        waiting = Waiting(FrameResult(frame.source, frame.index, frame.time_s, "ok", remarks=remarks))
        reason, self._before = self._reason_to_skip(frame), frame
        if reason is not None:
            counter, remark = reason
            waiting.update(skipped={counter: 1}, remarks=(Remark(remark),))
            return ledger.add(waiting)
        view = self._tracked(cache, waiting) or self._as_photograph(cache, located, waiting)
        if isinstance(view, Failure):
            waiting.update(status=view.status, remarks=(view.remark,), timing_ms=cache.timer.total())
            return ledger.add(waiting, scene_ends=True)
        waiting.update(
            **view.context.result_fields,
            remarks=remarks or tuple(filter(None, (self._camera.remark,))),
            screen_profile=view.acquisition.screen.name,
            corners=self._corners,
        )
        results = ledger.enter(waiting, view, self._scene)
        waiting.update(timing_ms=cache.timer.total())
        return results

    def _reason_to_skip(self, frame: Frame) -> tuple[str, Reason] | None:
        """Counter and reason of a frame that need not be received; None of others."""
        options, before = self._camera.options, self._before
        if "tracking" in options.skip and before is not None and _is_doubled(frame, before, self._corners):
            return "doubled_frames", "doubled"
        scene = self._scene
        if options.stop_when_certain and scene is not None and self._ledger.has_certain_bursts(frame, scene):
            return "certain_frames", "certain_before"
        return None

    def _tracked(self, cache: FrameCache, waiting: Waiting) -> View | None:
        """Receive a frame by what is known of screen and picture; None where it does not fit."""
        scene = self._scene
        if scene is None or not self._camera.fits(cache.frame):
            return None
        view = scene.view(cache, self._ledger.timeline)
        if view is None:
            self._film_log_odds, self._has_changed = scene.film_log_odds, True
            return None
        waiting.update(skipped={"tracking": 1})
        self._corners = scene.corners
        return view

    # -- a frame like a photograph -------------------------------------------------------------------------------------

    def _as_photograph(self, cache: FrameCache, located: Located | Failure | None, waiting: Waiting) -> View | Failure:
        """Receive a frame like a photograph, only the camera taken from before; the screen is followed from there."""
        self._scene, self._camera = None, self._camera.of_frame(cache.frame)
        located = located or self._camera.locate_again(cache, self._outline, self._corners)
        if isinstance(located, Failure):
            return located
        self._ledger.certainty = located.outline.certainty
        self._camera, acquired = self._camera.acquire(located, self._ledger.start, cache)
        self._corners = located.outline.corners
        if isinstance(acquired, Failure):
            return acquired
        options, acquisition, timer = self._camera.options, acquired.acquisition, cache.timer
        tracks, adds_up, denoised = _can_track(acquired, options), self._adds_up(acquired.initial), frozenset[int]()
        with timer("detect"):
            reception = decode(acquisition, options.skip, acquired.initial, adds_up=adds_up)
        # Else further frames show the picture.
        if not tracks or self._has_changed or options.cae == "always":
            with timer("denoise"):
                reception, denoised, report = apply_autoencoder(acquisition, reception, options)
            waiting.update(denoiser=report)
        # Of long exposures packets were compared with arbitrary slots already.
        if self._ledger.start is None and not reception.is_long and shows_steady_light(reception):
            return Failure(Remark("steady_light"))
        if assemble.all_dark(reception.snr):
            return Failure(Remark("nothing_lit"))
        self._outline = located.outline
        view = self._photographed(acquired, reception, denoised)
        if tracks:
            with timer("sampling"):
                self._follow(view, located, reception)
        return view

    def _adds_up(self, initial: Reception) -> bool:
        """Whether slots of a photograph's copies add up: neither detected jointly nor of a changing picture."""
        return not decides_jointly(initial.clock) and not self._has_changed

    def _photographed(self, acquired: Acquired, reception: Reception, denoised: frozenset[int]) -> View:
        """What a frame that was received like a photograph shows."""
        llr = reception.llr
        if decides_jointly(acquired.initial.clock):
            llr = by_copy_llr(lit_of(llr))
        is_sum = self._adds_up(acquired.initial)
        return View(
            acquired.context,
            acquired.acquisition,
            reception.clock,
            llr,
            np.minimum(assemble.slots_observed(reception.samples, reception.clock.by_copy), 1),
            reception.snr,
            denoised,
            framing=acquired.framing,
            changed=self._has_changed,
            joint=None if is_sum else JointSlots(reception.clock.burst, reception.posteriors),
        )

    def _follow(self, view: View, located: Located, reception: Reception) -> None:
        """Follow the screen from a frame on, and learn its picture there."""
        scene = self._scene = TrackedScreen(
            replace(view.context, sampled_corners=located.context.sampled_corners),
            view.acquisition,
            reception.model,
            reception.posteriors.w_log_prob,
            self._film_log_odds,
            self._has_changed,
            self._camera.options.corners is not None,
            located.dark_ends,
        )
        view.light, view.pose = scene.strips(view.context.frame), scene.pose
        scene.update(view, lambda: reception.clock.on_grid(reception.posteriors.lit))


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


def _can_track(acquired: Acquired, options: ReceiverOptions) -> bool:
    """Whether strips can be followed from frame to frame: each row of the picture is one instant, in order of time."""
    return (
        "tracking" in options.skip
        and acquired.context.frame.mosaic is None
        and acquired.acquisition.profiles.sensor_row is None
        and not acquired.context.camera.reversed
    )
