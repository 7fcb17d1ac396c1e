"""Clips whose camera nobody told: chosen and refitted as of photographs."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from rxcli.lab.simulate.capture import prepare
from rxcli.lab.simulate.population import Population
from rxcli.options import ReceiverOptions
from rxcli.receiver.clip.camera import ClipCamera, Located
from rxcli.receiver.clip.common_clock import start_by
from rxcli.receiver.clip.ledger import Ledger
from rxcli.receiver.clip.scene import TrackedScreen
from rxcli.receiver.clip.views import Waiting
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.passes import Reception
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.plane.texture import CommonTexture
from rxcli.receiver.receive import receive
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.search import Found, cameras
from rxcli.receiver.search.outlines import possible_screens
from rxcli.receiver.still import decode
from rxcli.results.truth import Truth
from rxcli.types import Frame, FrameResult, Metadata, Remark
from tests.receiver.test_video import Clip, scored, simulate

N_FRAMES = 5


@pytest.fixture(scope="module")
def clip() -> Clip:
    made = simulate(8, N_FRAMES)
    named = tuple(replace(frame, metadata=Metadata("Maker", "One")) for frame in made.frames)
    return replace(made, frames=named)


def _unknown(clip: Clip) -> ReceiverOptions:
    return replace(clip.options, cameras=(), force_camera=False)


def _line_delay_s(clip: Clip) -> float:
    return float(clip.truth.camera["line_delay_s"])


@pytest.mark.parametrize("exposure_slots", [3.0, 4.0])
def test_a_clip_of_long_exposures_is_received(exposure_slots: float) -> None:
    clip = simulate(8, 7, picture="grey", exposure_slots=exposure_slots, height_scale=1.0)
    results, score = scored(list(receive(clip.frames, _unknown(clip))), clip.truth)
    assert results[-1].exposure_s == pytest.approx(exposure_slots / 8650, rel=0.08)
    assert score.error_free >= 0.75 * score.expected > 60
    believed = [p for result in results for p in result.packets if p.confidence >= 0.9]
    assert sum(p.bit_errors != 0 for p in believed) <= 0.03 * len(believed)


@pytest.mark.parametrize("exposure_slots", [1.0, 2.0])
def test_frames_that_decide_picture_and_slots_together_are_measured_twice(
    exposure_slots: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The picture of few frames leaves wrong slots that look sure; a frame received alone decides jointly, too.

    What lies beyond the screen would show as slots: where its outline may reach that far, its ends are left out.
    """
    adds_up, measured, left_out = list[bool](), list[bool](), list[float]()
    measure_again = TrackedScreen.measure_again

    def decoded(*given: Any, **how: bool) -> Reception:
        adds_up.append(how["adds_up"])
        return decode(*given, **how)

    def noted(scene: TrackedScreen, views: Any, known: Any, doubtful: list[bool]) -> None:
        measured.append(all(doubtful))
        rows = np.ptp(scene.corners[:, 1]) - scene.pose.map.inside[10, 0].sum()
        left_out.append(rows / views[0].acquisition.clock.rows_per_slot)
        measure_again(scene, views, known, doubtful)

    monkeypatch.setattr("rxcli.receiver.clip.receiver.decode", decoded)
    monkeypatch.setattr(TrackedScreen, "measure_again", noted)
    clip = simulate(8, 9, picture="grey", exposure_slots=exposure_slots, height_scale=1.0)
    assert len(list(receive(clip.frames, clip.options))) == 9
    is_joint = exposure_slots > 1.7
    assert set(adds_up) == {not is_joint}
    assert measured == [True] * (1 + is_joint)
    assert left_out == pytest.approx([6.0 * is_joint] * len(left_out), abs=1.2)


@pytest.fixture(scope="module")
def textured() -> Clip:
    """Frames whose texture hides the slots of a long exposure in each of them."""
    drawn = {"exposure_slots": (5.0, 5.0), "width_px": (1280.0, 1280.0), "rows": (0.5, 0.5), "n_frames": 16}
    population = Population(cameras=("video-1080p",), screens=("paper-8k65",), **drawn)
    take = prepare(population.draw(np.random.default_rng(4))[0], 4)
    truth = msgspec.json.decode(msgspec.json.encode(take.truth("clip")), type=Truth)
    frames = tuple(Frame(np.asarray(take.frame(k).pixels), "clip", k, k / 29.97) for k in range(16))
    return Clip(frames, truth, ReceiverOptions(corners=np.array(take.truth("clip")["corners_sensor_px"])))


def test_the_texture_that_frames_have_in_common_hides_no_columns(textured: Clip) -> None:
    corners = textured.options.corners
    column_px = np.ptp(corners[:, 0]) / 20
    flat = CommonTexture(textured.frames[:8], "srgb").removed_from(0)
    found = possible_screens(FrameCache(flat), ReceiverOptions())
    assert np.abs(found[0][0].corners - corners)[:, 0].max() < 0.6 * column_px


def test_the_first_frames_show_their_camera_without_their_texture(textured: Clip) -> None:
    results, score = scored(list(receive(textured.frames, ReceiverOptions(cae="never"))), textured.truth)
    assert score.error_free >= 0.9 * score.expected
    # Light that changes little from frame to frame is no repeated frame.
    assert not any("doubled_frames" in result.skipped for result in results)


def test_the_clock_of_a_frame_gives_that_of_the_first(clip: Clip) -> None:
    """Where headers do not show in the first frame, as in some of long exposures."""
    camera, slots = ClipCamera(clip.options), []
    for frame in (clip.frames[0], clip.frames[4]):
        located = camera.locate(FrameCache(frame))
        assert isinstance(located, Located)
        assert isinstance(located.found, Found)
        slots.append(start_by(located.found, clip.frames).time.predict(0, clip.frames[0].time_s))
    # Time stamps are rounded to milliseconds.
    assert slots[1] == pytest.approx(slots[0], abs=4)


def test_the_camera_is_estimated_once_and_refitted(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    find = cameras.propose_cameras

    def counted(*args: Any, **named: Any) -> Any:
        asked.append(args)
        return find(*args, **named)

    monkeypatch.setattr("rxcli.receiver.search.propose.propose_cameras", counted)
    results, score = scored(list(receive(clip.frames, _unknown(clip))), clip.truth)
    assert len(asked) == 1
    known = scored(list(receive(clip.frames, clip.options)), clip.truth)[1]
    assert score.error_free >= 0.95 * known.error_free > 60
    assert score.false == 0
    assert results[-1].line_delay_s == pytest.approx(_line_delay_s(clip), rel=1e-3)
    assert results[-1].estimated == results[0].estimated


@pytest.mark.parametrize("named", [False, True])
def test_frames_of_half_a_packet_show_together_which_screen_it_is(named: bool) -> None:
    """Each leaves open whether it shows a whole packet of another screen; their times do not, nor does a name."""
    clip = simulate(5, 7, screen="data-17k3", repeats=1, readout_s=5.1e-3)
    frames = [replace(frame, time_s=frame.index * 1001 / 60000) for frame in clip.frames]
    options = _unknown(clip)
    results = list(receive(frames, options if named else replace(options, screens=ReceiverOptions().screens)))
    assert all(result.screen_profile in ("data-17k3", "paper-17k3") for result in results)
    assert not any(packet.is_believable for result in results for packet in result.packets)
    assert results[-1].line_delay_s == pytest.approx(_line_delay_s(clip), rel=1e-3)


def test_a_scene_learns_from_its_own_frames_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames wait for the phase of their bursts; by then another scene, with other strips, may be tracked."""
    learned: list[str] = []

    class Scene:
        def can_measure_again(self, view: Any) -> bool:
            return bool(view.name == "own")

        def update(self, view: Any, lit: object) -> None:
            learned.append(view.name)

    ledger = Ledger(ReceiverOptions(), None)
    monkeypatch.setattr(ledger, "_scene", Scene())
    monkeypatch.setattr(ledger, "_add_bursts", lambda view: None)
    for name in ("before", "own"):
        view: Any = SimpleNamespace(numbers=None, tracked=True, name=name)
        ledger._waiting.append(Waiting(FrameResult("clip", 0, 0.0, "ok"), view))
    timeline: Any = SimpleNamespace(number=lambda view: setattr(view, "numbers", np.zeros(0, int)))
    ledger._number_frames(timeline)
    assert learned == ["own"]


#: Of a screen in the picture.
INSIDE = np.array([[100.0, 50.0], [500.0, 50.0], [500.0, 300.0], [100.0, 300.0]])


class _Shown(Located):
    """Packets of some evidence, of a short exposure or a long one, on a screen that may reach out of the picture."""

    def __init__(
        self, evidence: float, is_long: bool = False, reaches_out: bool = False, is_beside: bool = False
    ) -> None:
        width_px = np.ptp(INSIDE[:, 0])
        super().__init__(Outline(INSIDE * [10 if reaches_out else 1, 1] + [is_beside * width_px / 10, 0]), None, None)
        self.__dict__.update(shown=evidence, long=is_long)

    evidence = property(lambda self: self.shown)
    is_long = property(lambda self: self.long)


@pytest.mark.parametrize(
    ("there", "elsewhere", "is_taken_there"),
    [
        (_Shown(100), _Shown(90, is_beside=True), True),
        (_Shown(100), _Shown(110, is_beside=True), False),
        (_Shown(100), _Shown(110), True),
        (_Shown(100), _Shown(190, reaches_out=True), True),
        (_Shown(100), _Shown(210, reaches_out=True), False),
        (_Shown(100, is_long=True), _Shown(110), True),
        (_Shown(100), _Shown(110, is_long=True), True),
        (Failure(Remark("no_stripes")), _Shown(50, is_beside=True), False),
        (Failure(Remark("no_stripes")), Failure("no_screen", "none"), True),
    ],
)
def test_a_lost_screen_is_where_more_packets_are(
    there: Any, elsewhere: Any, is_taken_there: bool, clip: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Packets of a long exposure show on many outlines, and a hand's edge looks like a side: it is where it was."""
    monkeypatch.setattr(ClipCamera, "locate", lambda _, cache, outlines=None: there if outlines else elsewhere)
    found = ClipCamera(clip.options).locate_again(FrameCache(clip.frames[0]), Outline(INSIDE), INSIDE)
    assert found is (there if is_taken_there else elsewhere)
