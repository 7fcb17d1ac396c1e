"""Texts of photographs that show a part of a packet and no header: the code finds which part."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from rxcli.lab.benchmark.goodput import detect
from rxcli.lab.benchmark.trial import simulate_trial
from rxcli.lab.simulate.population import Population
from rxcli.link import cut_photos, ldpc
from rxcli.link.collector import Collector, PhotoCollector
from rxcli.link.cut_photos import CutPhotos
from rxcli.link.encoder import message
from rxcli.link.placement import Placement
from rxcli.link.receiver import LinkReceiver
from rxcli.options import ReceiverOptions
from rxcli.receiver.decode.assemble import in_view
from rxcli.receiver.decode.steady import is_steady
from rxcli.receiver.receive import receive_frame
from rxcli.types import BELIEVABLE, ColumnResult, FrameResult, FrameSoftBits

COLUMNS, SYMBOLS, TEXT = 20, 11, "Platform 4: the 10:42 leaves here"
NO = Placement()


def photo(symbols: range, rng: np.random.Generator, placement: Placement = NO, number: int = 0) -> FrameSoftBits:
    """Some symbols of a packet, counted from the first in view; a clock under which they look random is likelier."""
    llr = np.zeros((1, SYMBOLS, COLUMNS, 7), np.float32)
    sent = message(TEXT).labels(np.arange(1), COLUMNS, SYMBOLS)
    llr[:, : len(symbols)] = detect(sent, 5, (9.0,) * COLUMNS, rng)[:, list(symbols)]
    wrong = np.zeros_like(llr)
    wrong[:, : len(symbols)] = rng.normal(0, 1, (1, len(symbols), COLUMNS, 7))
    read = FrameSoftBits(np.arange(1), placement.inverse.of(llr), open_start=True)
    return replace(read, llr=wrong, alternatives=(read,), epoch=number, source=f"{number}")


@pytest.mark.parametrize("placement", [NO, Placement(True)])
@pytest.mark.parametrize("first", [0, 2])
def test_one_photo_that_shows_most_of_a_packet_gives_its_text(first: int, placement: Placement) -> None:
    receiver = LinkReceiver(COLUMNS, SYMBOLS)
    [got] = receiver.add(photo(range(first, first + 8), np.random.default_rng(first), placement))
    assert got.text == TEXT  # type: ignore[union-attr]
    assert receiver.placement == placement


@pytest.mark.parametrize("source", ["", "photo"])
def test_a_label_that_is_sent_twice_may_be_misread_once(source: str) -> None:
    sent = message(TEXT).labels(np.arange(1), COLUMNS, SYMBOLS)
    llr = detect(sent, 5, (12.0,) * COLUMNS, np.random.default_rng(5)).astype(np.float32)
    llr[:, -1, -1, :3] *= -1  # The first label once more.
    [got] = LinkReceiver(COLUMNS, SYMBOLS).add(FrameSoftBits(np.arange(1), llr, source=source))
    assert got.text == TEXT  # type: ignore[union-attr]


def test_photos_of_different_parts_add_up() -> None:
    receiver, rng = LinkReceiver(COLUMNS, SYMBOLS), np.random.default_rng(3)
    came = [receiver.add(photo(range(k, k + 3), rng, number=k)) for k in (1, 5)]
    assert [len(events) for events in came] == [0, 1]
    assert receiver.messages[0].text == TEXT


def test_a_photo_is_read_alone_after_one_that_fits_in_many_ways(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cut_photos, "_MAX_SUMS", 8)
    receiver, rng = LinkReceiver(COLUMNS, SYMBOLS), np.random.default_rng(9)
    llr = np.zeros((1, SYMBOLS, COLUMNS, 7), np.float32)
    llr[:, :4] = rng.choice((-6, 6), (1, 4, COLUMNS, 7))
    receiver.add(FrameSoftBits(np.arange(1), llr, 0, "0", open_start=True))
    assert [event.text for event in receiver.add(photo(range(2, 8), rng, number=1))] == [TEXT]  # type: ignore[union-attr]


def test_a_symbol_hardly_in_view_gives_no_soft_bits() -> None:
    n_observed = np.ones((1, 1, 70), np.int64)
    n_observed[..., 20:23] = n_observed[..., 68:] = 0
    assert in_view(n_observed, 2).tolist() == [[[False, True, True, True, True]]]


def test_no_period_explains_light_that_is_shorter_than_two_of_it() -> None:
    rng = np.random.default_rng(5)
    lit = np.repeat(rng.integers(0, 2, (8, 1, 57)), 1, axis=1)[:, 0].astype(np.float32)
    value = 2 * np.repeat(lit, 2, axis=1) - 1
    assert not is_steady(value, np.ones_like(value), np.roll(lit, 3, axis=1), 130)


def test_noise_gives_no_text() -> None:
    receiver, rng = LinkReceiver(COLUMNS, SYMBOLS), np.random.default_rng(4)
    for number in range(3):
        llr = np.zeros((1, SYMBOLS, COLUMNS, 7), np.float32)
        llr[:, :7] = rng.normal(0, 5, (1, 7, COLUMNS, 7))
        assert receiver.add(FrameSoftBits(np.arange(1), llr, number, f"{number}", open_start=True)) == []


@pytest.mark.parametrize(("n_bursts", "n_symbols"), [(1, 11), (2, 11), (2, 5)], ids=["repeats", "bursts", "parts"])
def test_no_code_is_tried_where_bits_that_a_text_repeats_differ(
    n_bursts: int, n_symbols: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[object] = []
    monkeypatch.setattr(ldpc, "decode", lambda *args, **_: tried.append(args))
    llr = np.zeros((n_bursts, SYMBOLS, COLUMNS, 7), np.float32)
    llr[:, :n_symbols] = np.random.default_rng(6).choice((-30, 30), (n_bursts, n_symbols, COLUMNS, 7))
    assert CutPhotos(COLUMNS, SYMBOLS).add(FrameSoftBits(np.arange(n_bursts), llr, 0, "photo")) == []
    assert tried == []


def test_a_whole_packet_without_a_text_is_decoded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    tried: list[bytes] = []

    def fails(_: object, llr: np.ndarray, *__: object, **___: object) -> np.ndarray:
        tried.extend(row.tobytes() for row in llr)
        return np.zeros(len(llr), bool)

    monkeypatch.setattr(ldpc, "decode", fails)
    whole = photo(range(SYMBOLS), np.random.default_rng(2)).alternatives[0]
    assert LinkReceiver(COLUMNS, SYMBOLS).add(replace(whole, open_start=False, source="photo")) == []
    assert len(tried) == len(set(tried)) > 0


#: Slot at the first row; the line delay that is stated, times the right one; whether no header is in view: five slots
#: of the packet before are, of the last ones.
@pytest.mark.parametrize(
    ("start_slot", "stated", "is_open"),
    [(12.0, 1.0, True), (12.0, None, True), (112.0, None, False), (112.0, 1.02, False)],
)
def test_a_picture_of_less_than_a_packet_gives_its_text(start_slot: float, stated: float | None, is_open: bool) -> None:
    rng = np.random.default_rng(4)
    drawn = Population(
        screens=("data-17k3",),
        readout_s=(7e-3, 7e-3),
        exposure_slots=(0.7, 0.7),
        packets=(0.2, 0.95),
        fill=(0.75, 0.75),
        width_px=(900, 900),
        aim=0,
    )
    scene, _ = drawn.draw(rng)
    scene = replace(scene, labels=message("hello there"), start_slot=start_slot, w=5)
    trial = simulate_trial(scene, 1)
    cameras = ()
    if stated is not None:
        (mode,) = trial.camera.modes
        mode = msgspec.structs.replace(mode, line_delay_s=stated * mode.line_delay_s)
        cameras = (msgspec.structs.replace(trial.camera, modes=(mode,)),)
    options = ReceiverOptions(cameras=cameras, force_camera=bool(cameras), corners=trial.corners, soft_bits=True)
    result = receive_frame(trial.frame, options)
    assert not any(packet.confidence >= BELIEVABLE for packet in result.packets)
    assert result.soft_bits.open_start == is_open
    assert [m.text for m in Collector(options.screens).add(result).messages] == ["hello there"]


def test_a_photo_that_gives_its_text_is_received_from_the_screen_that_sends_texts() -> None:
    """Whatever screen without packets it was taken for; the text names the photographs that were added up."""
    collector, rng = PhotoCollector(ReceiverOptions().screens), np.random.default_rng(3)
    column = ColumnResult(0, "no_packet", message="of 70 slots 27 are missing")
    nothing = FrameResult("", 0, 0.0, "no_signal", "move closer", "paper-8k65", columns=(column,))
    photos = [photo(range(k, k + 3), rng, number=k) for k in (1, 5)]
    photos = [replace(soft, screen_profile="paper-17k3") for soft in photos]
    first, second = (collector.add(replace(nothing, source=soft.source, soft_bits=soft)) for soft in photos)
    assert (first.status, first.message) == ("no_signal", "move closer")
    assert (second.status, second.message, second.screen_profile) == ("ok", None, "data-17k3")
    assert second.columns == ()
    assert [(message.text, message.photos) for message in second.messages] == [(TEXT, ("1", "5"))]
