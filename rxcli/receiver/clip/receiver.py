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
from rxcli.receiver.clip.camera import Acquired, ClipCamera, Located
from rxcli.receiver.clip.ledger import Ledger
from rxcli.receiver.clip.scene import TrackedScreen, by_copy_llr
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.views import JointSlots, View, Waiting, decides_jointly
from rxcli.receiver.clip.window import Source, first_place
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
    source, receiver = Source(frames), ClipReceiver(options, on_taps)
    while source.ahead(1):
        with one_blas_thread():
            results = receiver.receive_next(source)
        yield from results
    yield from receiver.finish()
    if source.error is not None:
        raise source.error


class ClipReceiver:
    """Receives the frames of a clip, one after the other."""

    def __init__(self, options: ReceiverOptions, on_taps: OnTaps | None) -> None:
        #: Link time, bursts and results that wait.
        self._ledger = Ledger(options, on_taps)
        self._camera = ClipCamera(options)
        #: Whether first frames are still looked at together, and how many of the next showed nothing so.
        self._is_acquiring, self._n_alone = "tracking" in options.skip, 0
        #: The screen that is followed; None where no picture is known.
        self._scene: TrackedScreen | None = None
        #: The last frame; (4, 2) of the screen in the last one that showed it; and where it was found last.
        self._before: Frame | None = None
        self._corners: FloatArray | None = None
        self._outline: Outline | None = None
        #: Log-odds that the picture moves on the screen, and whether it was another one before.
        self._film_log_odds, self._has_changed = SETTINGS.film_log_odds, False

    def receive_next(self, source: Source) -> list[FrameResult]:
        """Receive the next frame; returns the results that are complete."""
        located: Located | Failure | None = None
        if self._is_acquiring:
            located, n_seen = first_place(source, self._camera, may_wait=self._n_alone == 0)
            if isinstance(located, Located):
                self._is_acquiring, self._ledger.start = False, located.start
            self._n_alone = max(self._n_alone, n_seen) - 1
        return self._receive(source.pop(), located)

    def finish(self) -> list[FrameResult]:
        """The results still held back."""
        return self._ledger.finish()

    # -- one frame -----------------------------------------------------------------------------------------------------

    def _receive(self, frame: Frame, located: Located | Failure | None) -> list[FrameResult]:
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
        assert self._outline is not None
        waiting.certainty = self._outline.certainty
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
        self._camera, acquired = self._camera.acquire(located, self._ledger.start, cache)
        self._corners = located.outline.corners
        if isinstance(acquired, Failure):
            return acquired
        options, acquisition, timer = self._camera.options, acquired.acquisition, cache.timer
        tracks, is_joint = _can_track(acquired, options), decides_jointly(acquired.initial.clock)
        denoised = frozenset[int]()
        # Slots of copies that were detected jointly, or of a picture that changes, do not add up.
        adds_up = not (is_joint or self._has_changed)
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
        view = View(
            acquired.context,
            acquisition,
            reception.clock,
            by_copy_llr(lit_of(reception.llr)) if is_joint else reception.llr,
            np.minimum(assemble.slots_observed(reception.samples, reception.clock.by_copy), 1),
            reception.snr,
            denoised,
            framing=acquired.framing,
            changed=self._has_changed,
            joint=None if adds_up else JointSlots(reception.clock.burst, reception.posteriors),
        )
        if tracks:
            with timer("sampling"):
                self._follow(view, located, reception)
        return view

    def _follow(self, view: View, located: Located, reception: Reception) -> None:
        """Follow the screen from a frame on, and learn its picture there."""
        scene = self._scene = TrackedScreen(
            replace(view.context, sampled_corners=located.context.sampled_corners),
            view.acquisition,
            reception,
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
