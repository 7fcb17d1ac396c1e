"""Scoring against the truth: the definitions, by hand-made packets."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rxcli.errors import InputError
from rxcli.protocol import bits_to_hex
from rxcli.results.truth import Score, Scorer, Truth, load_truth, truth_for, wrong_bits
from rxcli.types import ColumnResult, FrameResult, PacketResult

N_BITS = 40
#: Five symbols of seven bits would be 35; the scorer goes by `payload_bits` alone. 70 slots a packet: 71.4 are needed.
RAW: dict[str, Any] = {
    "columns": 2,
    "payload_symbols": 5,
    "w": [5, 4],
    "payload_bits": [N_BITS, N_BITS],
    "frames": [
        {"frame": 0, "bursts": [{"burst": 0, "visible_slots": 71.5}, {"burst": 1, "visible_slots": 71.3}]},
        {"frame": 1, "bursts": [{"burst": 1, "visible_slots": 60.0}, {"burst": 2, "visible_slots": 100.0}]},
    ],
    "payload": {
        "0": ["0000000000", "ffffffffff"],
        "1": ["aaaaaaaaaa", "5555555555"],
        "2": ["0f0f0f0f0f", "f0f0f0f0f0"],
    },
    "a key of the simulator": {"tone": "srgb"},
}


def truth(**changes: Any) -> Truth:
    return msgspec.convert(json.loads(json.dumps(RAW | changes)), Truth, strict=False)


def frame(index: int, payloads: Sequence[tuple[int, str]], w: tuple[int, int] = (5, 4)) -> FrameResult:
    columns: list[list[PacketResult]] = [[], []]
    for column, text in payloads:
        columns[column].append(PacketResult(0.0, 1.0, 4 * len(text), text, confidence=0.9, ber_hat=0.0))
    found = (ColumnResult(n, "ok", w=w[n], packets=tuple(packets)) for n, packets in enumerate(columns))
    return FrameResult("a", index, 0.0, "ok", columns=tuple(found))


def flip(text: str, n: int) -> str:
    """`text` with its first `n` bits inverted."""
    return f"{int(text, 16) ^ ((1 << n) - 1) << (4 * len(text) - n):0{len(text)}x}"


def score(*frames: FrameResult) -> Score:
    scorer = Scorer(truth())
    for result in frames:
        scorer.add(result)
    return scorer.score()


ALL = ([(0, "0000000000"), (1, "ffffffffff")], [(0, "0f0f0f0f0f"), (1, "f0f0f0f0f0")])


def test_all_and_nothing_received() -> None:
    """Expected are bursts of more than a packet length and two percent; of lost packets half the bits are wrong."""
    assert truth().expected_bursts == {0, 2}
    found = score(frame(0, ALL[0]), frame(1, ALL[1]))
    assert found == Score(expected=4, bits=4 * N_BITS, error_free=4)
    nothing = score(frame(0, []), frame(1, []))
    assert (nothing.lost, nothing.error_free, nothing.ber) == (4, 0, 0.5)
    assert ((found + nothing).expected, (found + nothing).ber, Score().ber) == (8, 0.25, None)


def test_bit_errors_are_filled_in_and_counted() -> None:
    scorer = Scorer(truth())
    filled = scorer.add(frame(0, [(0, flip("0000000000", 3)), (1, "ffffffffff")]))
    assert [packet.bit_errors for column in filled.columns for packet in column.packets] == [3, 0]
    scorer.add(frame(1, ALL[1]))
    found = scorer.score()
    assert (found.error_free, found.bit_errors, found.lost, found.false) == (3, 3, 0, 0)
    assert found.ber == pytest.approx(3 / 160)


@pytest.mark.parametrize(("n_wrong", "n_lost"), [(10, 0), (11, 1)])
def test_a_quarter_of_wrong_bits_is_the_limit(n_wrong: int, n_lost: int) -> None:
    found = score(frame(0, [(0, flip("0000000000", n_wrong)), (1, "ffffffffff")]), frame(1, ALL[1]))
    assert (found.lost, found.false) == (n_lost, n_lost)
    assert found.ber == pytest.approx((N_BITS / 2 if n_lost else n_wrong) / 160)


@pytest.mark.parametrize(
    ("index", "payload", "n_false"),
    [(1, "0000000000", 0), (0, "0f0f0f0f0f", 1), (2, "0f0f0f0f0f", 0), (3, "0f0f0f0f0f", 1), (0, "ffffffffff", 1)],
)
def test_a_burst_of_the_frame_before_is_no_false_packet_but_one_of_the_next_is(
    index: int, payload: str, n_false: int
) -> None:
    """Nor is one of another column."""
    assert score(frame(index, [(0, payload)])).false == n_false


def test_copies_extra_packets_and_wrong_weights() -> None:
    twice = score(frame(0, [(0, flip("0000000000", 2))]), frame(1, [(0, "0000000000")]))  # the better copy counts
    assert (twice.error_free, twice.bit_errors, twice.lost) == (1, 0, 3)
    partial = score(frame(1, [(0, "aaaaaaaaaa"), (1, flip("5555555555", 1))]))  # of a burst that no frame shows whole
    assert (partial.extra, partial.extra_error_free, partial.false, partial.lost) == (2, 1, 0, 4)
    wrong = score(frame(0, [(0, "00000000")], w=(4, 4)))  # bits that lack are wrong
    assert (wrong.wrong_w, wrong.bit_errors, wrong.error_free) == (1, 8, 0)


def test_a_column_that_the_screen_does_not_have_is_false() -> None:
    scorer = Scorer(truth(columns=1, w=[5], payload_bits=[40], payload={b: [p[0]] for b, p in RAW["payload"].items()}))
    filled = scorer.add(frame(0, [(0, "0000000000"), (1, "ffffffffff")]))
    assert scorer.score().false == 1
    assert filled.columns[1].packets[0].bit_errors is None


@given(st.lists(st.booleans(), min_size=1, max_size=90), st.data())
def test_wrong_bits_agrees_with_counting_them(bits: list[bool], data: st.DataObject) -> None:
    received = np.array(bits, np.uint8)
    sent = np.array(data.draw(st.lists(st.booleans(), min_size=len(bits), max_size=len(bits))), np.uint8)
    errors = wrong_bits(bits_to_hex(received), received.size, bits_to_hex(sent), sent.size)
    assert errors == int(np.sum(received != sent))
    assert wrong_bits(bits_to_hex(received), received.size, "", 0) == received.size


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (RAW | {"w": [5]}, "w must have one entry per column, 2"),
        (RAW | {"w": [5, 10]}, "w must be in 1..9 .got 10"),
        (RAW | {"payload_bits": [40, 40, 40]}, "payload_bits must have one entry per column"),
        (RAW | {"payload": {"0": RAW["payload"]["0"], "1": RAW["payload"]["1"]}}, "burst 2 is missing"),
        (RAW | {"payload": RAW["payload"] | {"1": ["aa"]}}, "payload of burst 1 must have one entry per column"),
        (RAW | {"payload": RAW["payload"] | {"1": ["aa", "bb"]}}, "column 0, must be hex of at least 40 bits"),
        (RAW | {"payload": RAW["payload"] | {"1": ["zzzzzzzzzz", "bb"]}}, "must be hex"),
        (RAW | {"columns": "two"}, "cannot be read as truth .*columns"),
        (RAW | {"frames": None}, "cannot be read as truth .*frames"),
        *((content, "cannot be read as truth") for content in (b"", b"{", b"\xff\xfe", b"[]", b"null")),
    ],
)
def test_a_wrong_truth_file_is_named_with_the_reason(
    tmp_path: Path, content: dict[str, Any] | bytes, message: str
) -> None:
    path = tmp_path / "a.truth.json"
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    with pytest.raises(InputError, match=message) as caught:
        load_truth(path)
    assert str(path) in str(caught.value)


def test_truth_beside_a_capture(tmp_path: Path) -> None:
    assert truth_for(tmp_path / "a.b.jpg", "auto") is None
    (tmp_path / "a.b.truth.json").write_text(json.dumps(RAW))
    path = truth_for(tmp_path / "a.b.jpg", "auto")
    assert load_truth(path).payload[2][1] == "f0f0f0f0f0"
    with pytest.raises(InputError, match="No such file"):
        load_truth(tmp_path / "none.truth.json")


def test_a_packet_that_several_bursts_send_is_received_in_all_of_them() -> None:
    """Beacons and test patterns: the burst that the frame shows best need not be the first."""
    same = RAW["payload"]["0"]
    scorer = Scorer(truth(payload={"0": same, "1": same, "2": same}))
    scorer.add(frame(1, ALL[0]))
    found = scorer.score()
    assert (found.error_free, found.lost, found.false, found.ber) == (4, 0, 0, 0.0)


@pytest.mark.parametrize(
    ("packets", "expected"),
    [
        ([(0, "aaaaaaaaaa"), (1, flip("5555555555", 2))], Score(2, 80, error_free=1, bit_errors=2)),
        ([(0, "0f0f0f0f0f"), (1, "5555555555")], Score(4, 160, error_free=2, lost=2, lost_bits=80)),
        ([(1, "5555555555")], Score(2, 80, error_free=1, lost=1, lost_bits=40)),
        ([(0, "aaaaaaaaaa"), (1, "f0f0f0f0f1")], Score(4, 160, 1, 1, 2, 80)),
        ([(0, "3333333333")], Score(2, 80, lost=2, lost_bits=80, false=1)),
        ([], Score(2, 80, lost=2, lost_bits=80)),
    ],
    ids=["one burst", "two bursts", "one column", "two bursts, wrong bit", "false", "nothing"],
)
def test_the_packets_of_a_frame_find_its_bursts_in_a_transmission(
    packets: list[tuple[int, str]], expected: Score
) -> None:
    scorer = Scorer(truth(frames=[]))
    scorer.add(frame(0, packets))
    assert scorer.score() == expected


def test_bursts_of_a_counter_differ_in_few_bits() -> None:
    """One burst is expected, not all that are like it."""
    numbers = {str(burst): [f"{burst:010x}"] * 2 for burst in range(8)}
    scorer = Scorer(truth(frames=[], payload=numbers))
    scorer.add(frame(0, [(0, numbers["5"][0]), (1, numbers["5"][1])]))
    assert scorer.score() == Score(2, 80, error_free=2)


def test_dark_columns_of_a_transmission_are_not_expected() -> None:
    scorer = Scorer(truth(frames=[], payload_bits=[N_BITS, 0], payload={"0": ["0000000000", ""]}))
    scorer.add(frame(3, [(0, "0000000000")]))
    assert scorer.score() == Score(1, N_BITS, error_free=1)
