"""Clips whose camera nobody told: chosen and refitted as of photographs."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rxcli.options import ReceiverOptions
from rxcli.receiver.clip.ledger import Ledger
from rxcli.receiver.clip.views import Waiting
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.receive import receive
from rxcli.receiver.search import cameras, screen_in_changes
from rxcli.receiver.search.outlines import possible_screens
from rxcli.types import FrameResult, Metadata
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


def test_a_screen_is_found_in_what_changed_between_frames() -> None:
    """The picture cancels there; in the frames alone its texture hides the columns of a long exposure."""
    clip = simulate(8, 2, picture="coins", exposure_slots=5.0, height_scale=1.0)
    first, second = clip.frames
    corners = clip.options.corners
    column_px = np.ptp(corners[:, 0]) / 20
    found = screen_in_changes(FrameCache(first), second, ReceiverOptions())
    assert np.abs(found[0].corners - corners)[:, 0].max() < 0.6 * column_px
    alone = possible_screens(FrameCache(first), ReceiverOptions())
    assert not alone or np.abs(alone[0][0].corners - corners)[:, 0].max() > column_px
    assert screen_in_changes(FrameCache(first), first, ReceiverOptions()) == []


def test_the_camera_is_estimated_once_and_refitted(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []
    find = cameras.propose_cameras

    def counted(*args: Any) -> Any:
        asked.append(args)
        return find(*args)

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
            return bool(view.flat == "own")

        def update(self, view: Any, lit: object) -> None:
            learned.append(view.flat)

    ledger = Ledger(ReceiverOptions(), None)
    monkeypatch.setattr(ledger, "_scene", Scene())
    monkeypatch.setattr(ledger, "_add_bursts", lambda view: None)
    for flat in ("before", "own"):
        view: Any = SimpleNamespace(numbers=None, flat=flat)
        ledger._waiting.append(Waiting(FrameResult("clip", 0, 0.0, "ok"), view))
    timeline: Any = SimpleNamespace(number=lambda view: setattr(view, "numbers", np.zeros(0, int)))
    ledger._number_frames(timeline)
    assert learned == ["own"]
