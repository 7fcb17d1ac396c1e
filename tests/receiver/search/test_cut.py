"""Less than a packet in view: slots without a header."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from row_profiles import Shot, random_link, row_profiles

from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.receiver import receive
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.result import Received
from rxcli.receiver.search import cut
from rxcli.receiver.search.settings import SETTINGS
from rxcli.receiver.still import initial_pass
from rxcli.types import Clock, Frame, FrameResult, FrameSoftBits, SearchStep

SCREEN = load_profile("data-17k3", ScreenProfile)


@pytest.mark.parametrize("ambient", [0.0, 0.1, 0.3])
def test_room_light_is_known_without_a_header(ambient: float) -> None:
    """Slots of a payload alone: the light of dark ones is that of the room, otherwise weights come out too large."""
    rng, shot = np.random.default_rng(2), Shot(8.0, 0.8, 25.0, 600, ambient=ambient, texture=0.1, crosstalk=0.1)
    link = random_link(rng, [5] * 20, SCREEN.payload_symbols)
    clock = Clock(8.0, 0.8, SCREEN.packet_slots, 0.0, 75, 25, np.zeros(1, np.int64), np.zeros(20), 0.0)
    acquisition = Acquisition(SCREEN, row_profiles(link, shot, rng), clock, (SCREEN,))
    found = initial_pass(acquisition)
    assert found.model.black_level == pytest.approx(ambient, abs=0.02)
    assert (found.posteriors.w == 5).all()
    lit = found.clock.on_grid(found.posteriors.lit) > 0.5
    assert (lit[:, 5:75] == link.slots()[:, 30:100]).mean() > 0.99
    assert initial_pass(acquisition, 0.5).model.black_level == pytest.approx(found.model.black_level / 2)


@pytest.mark.parametrize("is_known", [False, True])
def test_a_known_camera_is_not_asked_for_less_than_an_unknown_one(
    is_known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Packets that are plain but none believable: their cut packets come first, then the soft bits as received."""
    monkeypatch.setattr(receive, "proposed_screens", lambda *_: [[]])
    monkeypatch.setattr(receive, "known_camera", lambda *_: receive.UNKNOWN if is_known else None)
    monkeypatch.setattr(receive, "cut_packets", lambda _: (shown,))
    shown, own = (FrameSoftBits(np.arange(1), np.full((1, 11, 20, 7), value, np.float32)) for value in (1, 0))
    frame = Frame(np.zeros((4, 4), np.uint8), "photo")
    result = FrameResult("photo", 0, 0.0, "no_signal", corners=np.zeros((4, 2)), soft_bits=own)
    received = Received(replace(result, search=(SearchStep("", 0.0, 215.0, 17.0, "won"),)), {})
    soft = receive._with_cut_packets(FrameCache(frame), received, ReceiverOptions(soft_bits=True))
    assert soft is not None
    assert soft.llr is shown.llr
    assert soft.alternatives == (own,)


def test_one_pass_tells_where_symbols_begin(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, shot = np.random.default_rng(3), Shot(8.0, 0.8, 33.0, 560, texture=0.1, crosstalk=0.1)
    profiles = row_profiles(random_link(rng, [5] * 20, SCREEN.payload_symbols), shot, rng)
    camera = SimpleNamespace(line_delay_s=1 / (8.0 * SCREEN.slot_rate_hz), exposure_s=0.8 / SCREEN.slot_rate_hz)
    context = SimpleNamespace(screens=(SCREEN,), camera=camera, sample_columns=lambda _: profiles)
    passes: list[Acquisition] = []
    monkeypatch.setattr(
        cut, "initial_pass", lambda acquisition: passes.append(acquisition) or initial_pass(acquisition)
    )
    found = [candidate for candidate in cut._clocks(context) if candidate.acquisition.clock.header_peak_ratio == 0]
    assert len(found) == 10 * SETTINGS.cut_phases
    assert len(passes) <= SETTINGS.cut_phases + 1
    clock = max(found, key=lambda candidate: candidate.evidence).acquisition.clock
    # Row 0 is exposed around slot 33 of the packet.
    off = (-clock.row0 / 8.0 + clock.first_slot - 33.0 + 5) % 10 - 5
    assert abs(off) <= 0.5 / SETTINGS.cut_phases + 0.07
