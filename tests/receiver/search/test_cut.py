"""Less than a packet in view: slots without a header."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from row_profiles import Shot, random_link, row_profiles

from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.protocol import SLOTS_PER_SYMBOL
from rxcli.receiver import receive
from rxcli.receiver.camera.proposals import CameraHypothesis
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.camera import FrameCamera
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.result import Received
from rxcli.receiver.frame.timer import Timer
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.search import cut
from rxcli.receiver.search.cameras import estimated_camera, relabelled_camera
from rxcli.receiver.search.settings import SETTINGS
from rxcli.receiver.still import initial_pass
from rxcli.results.reasons import sentence_of
from rxcli.types import (
    Clock,
    ColumnResult,
    Frame,
    FrameResult,
    FrameSoftBits,
    Metadata,
    Remark,
    RowProfiles,
    SearchStep,
)

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
    monkeypatch.setattr(receive, "proposed_screens", lambda *_: [[Outline(np.zeros((4, 2)))]])
    monkeypatch.setattr(receive, "known_camera", lambda *_: receive.UNKNOWN if is_known else None)
    monkeypatch.setattr(receive, "cut_packets", lambda *_: (shown,))
    shown, own = (FrameSoftBits(np.arange(1), np.full((1, 11, 20, 7), value, np.float32)) for value in (1, 0))
    frame = Frame(np.zeros((4, 4), np.uint8), "photo")
    result = FrameResult("photo", 0, 0.0, "no_signal", corners=np.zeros((4, 2)), soft_bits=own)
    received = Received(replace(result, search=(SearchStep("", 0.0, 215.0, 17.0, "won"),)), {})
    soft = receive._with_cut_packets(FrameCache(frame), received, ReceiverOptions(soft_bits=True))
    assert soft.llr is shown.llr
    assert soft.alternatives == (own,)


def test_the_message_names_the_share_of_a_packet_in_view() -> None:
    """Four of eleven symbols: three photographs, of which one is there, may show all."""
    llr = np.zeros((2, 11, 20, 7), np.float32)
    llr[0, :3, 5], llr[1, 2:4, 6] = 3.0, -2.0
    soft = FrameSoftBits(np.arange(2), llr)
    remarks = (Remark("unsure"), Remark("no_headers"))
    kept, part = receive._with_part_in_view(remarks, soft)
    assert kept == remarks[0]
    assert "36 % of a packet: send 3 more photos, or film" in sentence_of(part)
    assert receive._with_part_in_view(remarks, None) == remarks


def test_a_screen_whose_packets_did_not_show_is_left_out_where_a_part_of_anothers_is_likelier() -> None:
    own, part = (FrameSoftBits(np.arange(1), np.ones((1, n, 20, 7), np.float32)) for n in (5, 11))
    columns = (ColumnResult(0, "no_packet", remark=Remark("unsure")),)
    result = FrameResult("photo", 0, 0.0, "no_signal", screen_profile="paper-8k65", columns=columns, soft_bits=own)
    shown = receive._without_unlikely_screen(result, part)
    assert (shown.screen_profile, shown.columns, shown.reason) == (None, (), "no_headers")
    for likely in (result, replace(result, status="partial")):
        soft = own if likely is result else part
        assert receive._without_unlikely_screen(likely, soft) is likely


def seen(monkeypatch: pytest.MonkeyPatch, by_outline: list[RowProfiles]) -> list[FrameContext]:
    """A frame by outlines that give some profiles, its camera known."""
    frame = Frame(np.zeros((600, 600), np.uint8), "photo")
    cache = cast(FrameCache, SimpleNamespace(frame=frame, timer=Timer()))
    monkeypatch.setattr(FrameContext, "sample_columns", lambda self, _: by_outline[int(self.sampled_corners[0, 0])])
    camera = FrameCamera("mine", 1 / (8 * SCREEN.slot_rate_hz), 0.8 / SCREEN.slot_rate_hz, None, "srgb")
    return [FrameContext(cache, np.full((4, 2), n), camera, (SCREEN,)) for n in range(len(by_outline))]


@pytest.mark.parametrize(
    ("start_slot", "is_open"), [(33, True), (8, False), (95, False)], ids=["payload", "its header", "the next header"]
)
def test_the_start_of_a_cut_packet_is_found_on_a_textured_picture(
    monkeypatch: pytest.MonkeyPatch, start_slot: int, is_open: bool
) -> None:
    rng = np.random.default_rng(3)
    shot = Shot(8.0, 0.8, start_slot, 560, texture=0.5, texture_rows=9.0, crosstalk=0.1)
    profiles = row_profiles(random_link(rng, [5] * 20, SCREEN.payload_symbols), shot, rng)
    (slots,) = cut._slots_by(seen(monkeypatch, [profiles])[:1])
    candidates = list(cut._candidates(slots))
    assert len(candidates) <= 3 * SLOTS_PER_SYMBOL  # each takes a detection
    best, *_ = cut._distinct(candidates)
    clock = best.acquisition.clock
    off = -clock.row0 / 8.0 + clock.first_slot - start_slot
    assert best.is_open == is_open
    assert (off + 5) % 10 - 5 == pytest.approx(0, abs=0.13)
    assert is_open or off == pytest.approx(0, abs=0.13)


def test_the_light_shows_which_slot_rate_the_stated_exposure_is_of(monkeypatch: pytest.MonkeyPatch) -> None:
    """A file states seconds, the light shows slots: at 34.6 kHz they would be exposed for twice as many."""
    rng, faster = np.random.default_rng(6), load_profile("data-34k6", ScreenProfile)
    shot = Shot(8.0, 0.7, 33.0, 560, texture=0.2, crosstalk=0.1)
    (known,) = seen(monkeypatch, [row_profiles(random_link(rng, [5] * 20, SCREEN.payload_symbols), shot, rng)])
    frame = replace(known.frame, metadata=Metadata(exposure_s=0.7 / SCREEN.slot_rate_hz))
    hypothesis = CameraHypothesis(8.0, 0, False, np.zeros(4), 1.0, 0.0, 0.0, np.zeros(4))
    camera = relabelled_camera(estimated_camera(hypothesis, faster.slot_rate_hz, frame), faster, frame)
    cache = cast(FrameCache, SimpleNamespace(frame=frame, timer=Timer()))
    context = replace(known, cache=cache, camera=camera, screens=(faster, SCREEN))
    (slots,) = cut._slots_by(cut._exposures(context))
    assert slots.screens == (SCREEN,)
    assert slots.acquisition.clock.exposure_slots == pytest.approx(0.7)


def test_columns_are_told_apart_by_the_right_outline(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, shot = np.random.default_rng(4), Shot(8.0, 0.8, 33.0, 560, texture=0.2, crosstalk=0.1)
    profiles = row_profiles(random_link(rng, [5] * 20, SCREEN.payload_symbols), shot, rng)
    between = replace(profiles, light=(profiles.light + np.roll(profiles.light, 1, axis=0)) / 2)
    right, wrong = (next(cut._slots_by([context])) for context in seen(monkeypatch, [profiles, between]))
    assert right.lead > 1.5 * wrong.lead
    outlines = [Outline(np.full((4, 2), n)) for n in (1, 0)]
    (best,) = cut._best(right.context, outlines)
    assert best.lead == right.lead


def test_clocks_that_fit_no_better_than_light_without_slots_are_not_handed_on(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, shot = np.random.default_rng(5), Shot(8.0, 0.8, 33.0, 560)
    profiles = row_profiles(random_link(rng, [5] * 20, SCREEN.payload_symbols), shot, rng)
    (slots,) = cut._slots_by(seen(monkeypatch, [profiles])[:1])
    found = sorted(cut._candidates(slots), key=lambda candidate: -candidate.fit)
    poor, better = replace(found[0], fit=SETTINGS.cut_fit - 50), replace(found[-1], fit=SETTINGS.cut_fit + 50)
    assert cut._distinct([poor, better]) == [better]
    assert cut._distinct([poor]) == []


def test_a_header_in_the_middle_of_the_view_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, shot = np.random.default_rng(7), Shot(8.0, 0.8, 89.0, 660, texture=0.5, texture_rows=9.0, crosstalk=0.1)
    profiles = row_profiles(random_link(rng, [5] * 20, SCREEN.payload_symbols), shot, rng)
    (slots,) = cut._slots_by(seen(monkeypatch, [profiles])[:1])
    best, *_ = cut._distinct(cut._candidates(slots))
    clock = best.acquisition.clock
    assert -clock.row0 / 8.0 + clock.first_slot == pytest.approx(89, abs=0.13)


@pytest.mark.parametrize(("n_slots", "n_ways"), [(140, 1), (160, 0)])
def test_no_part_of_a_packet_is_sought_where_a_header_is_in_view(
    n_slots: int, n_ways: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(6)
    profiles = row_profiles(random_link(rng, [5] * 20, SCREEN.payload_symbols), Shot(4.0, 0.8, 33.0, 4 * n_slots), rng)
    context = seen(monkeypatch, [profiles])[0]
    camera = replace(context.camera, line_delay_s=2 * context.camera.line_delay_s)
    assert len(list(cut._slots_by([replace(context, camera=camera)]))) == n_ways


@pytest.mark.parametrize(("lead", "n_ways"), [(0.5, 0), (2.0, 1)])
def test_light_in_which_no_phase_of_slots_stands_out_is_not_read(
    lead: float, n_ways: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(8)
    profiles = row_profiles(random_link(rng, [5] * 20, SCREEN.payload_symbols), Shot(8.0, 0.8, 33.0, 560), rng)
    lit = np.zeros((20, SCREEN.packet_slots), np.float32)
    by_phase = [(lit, lead * 71 * number) for number in (0, 1, 0, 0)]
    monkeypatch.setattr(cut, "slots_of_any_kind", lambda _, clocks: by_phase[: len(clocks)])
    monkeypatch.setattr(Clock, "on_grid", lambda *_: lit)
    assert len(list(cut._slots_by(seen(monkeypatch, [profiles])[:1]))) == n_ways
