"""Results from posteriors made by hand."""

from dataclasses import replace

import made_stages
import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.protocol import bits_per_symbol, bits_to_hex, indices_to_bits
from rxcli.receiver.decode import assemble, confidence
from rxcli.results.reasons import sentence_of
from rxcli.types import BurstPosteriors, Clock, ColumnResult, PacketResult, SlotSamples

N_SYMBOLS, PACKET, Q = 3, 50, 4


def clock_of(n_slots: int, first_slot: int, burst: list[int], n_columns: int = 2) -> Clock:
    known = {"n_slots": n_slots, "first_slot": first_slot, "burst": np.array(burst), "header_peak_ratio": 5.0}
    delay = np.array([0.0, 1.5, 0.0, 0.0][:n_columns])
    return made_stages.clock_of(
        n_columns, packet_slots=PACKET, exposure_slots=1.2, row0=17.0, delay_slots=delay, **known
    )


def samples_of(n_slots: int, n_columns: int = 2) -> SlotSamples:
    shape = (n_columns, 2, n_slots * Q)
    return SlotSamples(np.ones(shape, np.float32), np.ones(shape, np.float32), Q)


def posteriors_of(
    w: list[int], index: NDArray[np.int64], probability: float = 0.9999, w_probability: float = 0.9999
) -> BurstPosteriors:
    """Posteriors of (B, C, N) indices, each right with `probability`, its bits as sure as that."""
    n_bursts, n_columns, n_symbols = index.shape
    w_log_prob = np.full((n_columns, 9), np.log((1 - w_probability) / 8))
    w_log_prob[np.arange(n_columns), np.array(w) - 1] = np.log(w_probability)
    bit_llr = np.full((n_bursts, n_columns, n_symbols, 7), np.nan)
    for column, weight in enumerate(w):
        k = bits_per_symbol(weight)
        bits = indices_to_bits(index[:, column].ravel(), weight).reshape(n_bursts, n_symbols, k)
        bit_llr[:, column, :, :k] = (2.0 * bits - 1) * np.log(probability / (1 - probability))
    known = {"w": np.array(w), "w_log_prob": w_log_prob, "index": index, "bit_llr": bit_llr}
    log_prob, header_llr = np.full(index.shape, np.log(probability)), np.full((n_bursts, n_columns), 20.0)
    return made_stages.posteriors_of(*index.shape, log_prob=log_prob, header_llr=header_llr, **known)


def indices(w: list[int], n_bursts: int = 1) -> NDArray[np.int64]:
    rng = np.random.default_rng(0)
    columns = [rng.integers(0, 1 << bits_per_symbol(weight), (n_bursts, N_SYMBOLS)) for weight in w]
    return np.stack(columns, axis=1)


def snr(n_slots: int, value: float = 100.0, n_columns: int = 2) -> NDArray[np.float32]:
    return np.full((n_columns, n_slots), value, np.float32)


def results_of(
    clock: Clock,
    posteriors: BurstPosteriors,
    snr: NDArray[np.float32],
    samples: SlotSamples,
    min_confidence: float = 0.0,
    slot_margin: float | NDArray[np.float32] = 10.0,
) -> tuple[ColumnResult, ...]:
    """Results where every slot of the grid has the same support unless told otherwise."""
    margin = assemble.slot_margin_by_burst(np.broadcast_to(np.asarray(slot_margin, np.float32), snr.shape), clock)
    features = confidence.confidence_features(posteriors, margin, np.zeros(len(snr), bool), samples.light.shape[1])
    headerless = assemble.find_headerless(posteriors.header_llr)
    n_observed = assemble.slots_observed(samples, clock)
    frame = assemble.FrameColumns(clock, snr, headerless, min_confidence)
    return assemble.column_results(frame, posteriors, n_observed, features)


def test_a_sure_packet() -> None:
    w = [5, 8]
    index = indices(w)
    columns = results_of(clock_of(120, 30, [0, 0, 0]), posteriors_of(w, index), snr(120), samples_of(120), 0)
    assert [c.status for c in columns] == ["ok", "ok"]
    assert [c.column for c in columns] == [0, 1]
    assert [c.w for c in columns] == w
    assert [c.snr_db for c in columns] == pytest.approx([20.0, 20.0])
    assert [c.delay_slots for c in columns] == [0.0, 1.5]
    assert [c.reason for c in columns] == [None, None]
    for column, result in enumerate(columns):
        (packet,) = result.packets
        assert packet.payload_bits == N_SYMBOLS * bits_per_symbol(w[column])
        assert packet.payload == bits_to_hex(indices_to_bits(index[0, column], w[column]))
        assert packet.copies == pytest.approx(120 / 50)
        assert 0.99 < packet.confidence < 1
        assert packet.ber_hat == pytest.approx(1e-4, rel=0.01)
        assert packet.bit_errors is None


def test_first_row_is_where_the_exposure_of_the_header_starts() -> None:
    """Grid slot 0 is slot 30 of its packet; row0 has it in the middle of its exposure of 1.2 slots of 5 rows."""
    columns = results_of(
        clock_of(120, 30, [0, 0, 0]), posteriors_of([5, 5], indices([5, 5])), snr(120), samples_of(120), 0
    )
    rows = [c.packets[0].first_row for c in columns]
    assert rows == pytest.approx([17 + (0.6 - 30) * 5, 17 + (0.6 - 30 + 1.5) * 5])


def test_one_entry_a_burst_in_time_order() -> None:
    index = indices([5, 5], n_bursts=2)
    clock = clock_of(180, 0, [0, 0, 1, 1])
    columns = results_of(clock, posteriors_of([5, 5], index), snr(180), samples_of(180), 0)
    for column, result in enumerate(columns):
        payloads = [bits_to_hex(indices_to_bits(index[burst, column], 5)) for burst in range(2)]
        assert [packet.payload for packet in result.packets] == payloads
        assert [packet.copies for packet in result.packets] == pytest.approx([2.0, 1.6])
        assert result.packets[1].first_row - result.packets[0].first_row == pytest.approx(100 * 5)


def test_a_payload_slot_that_was_never_seen_is_no_packet() -> None:
    """37 slots of the second burst are seen: some of its payload is not."""
    clock = clock_of(137, 0, [0, 0, 1])
    index = indices([5, 5], n_bursts=2)
    columns = results_of(clock, posteriors_of([5, 5], index), snr(137), samples_of(137), 0)
    assert [len(c.packets) for c in columns] == [1, 1]


def test_slots_off_the_screen_are_not_seen() -> None:
    clock, samples = clock_of(60, 0, [0, 0]), samples_of(60)
    valid = samples.valid.copy()
    valid[0, :, 30 * Q : 33 * Q] = 0
    valid[1, 0, 30 * Q : 33 * Q] = 0
    samples = replace(samples, valid=valid)
    columns = results_of(clock, posteriors_of([5, 5], indices([5, 5])), snr(60), samples, 0)
    assert [len(c.packets) for c in columns] == [0, 1]
    assert assemble.slots_observed(samples, clock)[0, 0, 28:34].tolist() == [1, 1, 0, 0, 0, 1]
    assert assemble.slots_observed(samples, clock)[0, 1, :12].tolist() == [2] * 10 + [1] * 2


@pytest.mark.parametrize(("min_confidence", "n_packets"), [(0.0, 1), (0.6, 1), (0.99, 0), (1.0, 0)])
def test_packets_below_the_confidence_asked_for(min_confidence: float, n_packets: int) -> None:
    posteriors = posteriors_of([5, 5], indices([5, 5]), probability=0.9)
    columns = results_of(clock_of(120, 0, [0, 0, 0]), posteriors, snr(120), samples_of(120), min_confidence)
    assert [len(c.packets) for c in columns] == [n_packets] * 2


def test_a_packet_of_low_confidence_is_weak_and_counts_beside_a_surer_one_alone() -> None:
    """Where no packet of a photograph is likely what looks like packets is chance."""
    posteriors = posteriors_of([5, 5], indices([5, 5]), probability=0.95)
    log_prob = np.log(np.stack([np.full((1, N_SYMBOLS), 0.1), np.full((1, N_SYMBOLS), 0.999)], axis=1))

    def found(log_prob: NDArray[np.float64]) -> tuple[ColumnResult, ...]:
        doubted = replace(posteriors, log_prob=log_prob)
        return results_of(clock_of(120, 0, [0, 0, 0]), doubted, snr(120), samples_of(120), 0)

    first, second = found(log_prob)
    assert (first.status, second.status) == ("weak", "ok")
    assert 0 < first.packets[0].confidence < 0.1
    assert [column.packets for column in found(log_prob[:, [0, 0]])] == [(), ()]


def test_confidence_grows_with_the_log_probability_and_stays_below_one() -> None:
    confidences = []
    for log_prob in (-800.0, -10.0, -1.0, -0.1, -1e-3, -1e-12, 0.0):
        posteriors = posteriors_of([5, 5], indices([5, 5]), probability=0.999)
        of_columns = np.array([log_prob, -1e-3]) / N_SYMBOLS  # beside a sure packet, without which none is reported
        posteriors = replace(posteriors, log_prob=np.tile(of_columns[:, None], (1, 1, N_SYMBOLS)))
        (first, _) = results_of(clock_of(120, 0, [0, 0, 0]), posteriors, snr(120), samples_of(120), 0)
        confidences.append(first.packets[0].confidence)
    assert confidences == sorted(confidences)
    assert confidences[0] >= 0
    assert confidences[-1] < 1


def test_slots_that_speak_against_a_packet_make_it_less_sure() -> None:
    """Slots of its own payload only: the header, dimming symbol and other bursts have no say."""
    clock = clock_of(180, 0, [0, 0, 1, 1])
    posteriors = posteriors_of([5, 5], indices([5, 5], n_bursts=2))

    def confidences(slots: list[int]) -> list[float]:
        slot_margin = np.full((2, 180), 10.0, np.float32)
        slot_margin[0, slots] = -9.0
        (first, _) = results_of(clock, posteriors, snr(180), samples_of(180), slot_margin=slot_margin)
        return [packet.confidence for packet in first.packets]

    sure = confidences([])
    assert confidences([3, 12, 53, 104]) == sure
    one, two = confidences([25]), confidences([25, 77])
    assert two[0] < one[0] < sure[0]
    assert two[1] == one[1] == sure[1]


def test_where_slots_stand_out_a_symbol_in_doubt_leaves_the_packet_in_doubt() -> None:
    """What errs then is not noise, and confidence does not exceed the posterior."""
    w = [5]

    def found(margin: float, probability: float) -> float:
        sure, slot_margin = posteriors_of(w, indices(w), probability), np.full((1, 1, PACKET), margin, np.float32)
        features = confidence.confidence_features(sure, slot_margin, np.zeros(1, bool), 2)
        return float(confidence.confidence(features).squeeze())

    n_symbols = indices(w).shape[-1]
    doubtful = 0.99**n_symbols
    assert found(40.0, 0.99) == pytest.approx(doubtful, abs=1e-6)
    assert found(8.0, 0.99) > doubtful
    assert found(40.0, 0.999999) > 0.99


def test_a_header_that_is_contradicted_stands_for_no_packet() -> None:
    posteriors = posteriors_of([5, 5], indices([5, 5]), probability=0.9999)
    posteriors = replace(posteriors, header_llr=np.array([[-20.0, 40.0]]))
    first, second = results_of(clock_of(120, 0, [0, 0, 0]), posteriors, snr(120), samples_of(120), 0)
    assert not first.packets
    assert first.w is None
    assert first.status == "no_packet"
    assert first.reason == "headerless"
    assert second.packets


def test_nothing_decoded_says_why() -> None:
    unsure = posteriors_of([5, 5], indices([5, 5]), probability=0.5001)
    clock, samples = clock_of(120, 0, [0, 0, 0]), samples_of(120)
    light = np.stack([snr(120)[0], snr(120, 0.01)[0]])
    bright, dark = results_of(clock, unsure, light, samples, 0)
    assert (bright.status, dark.status) == ("no_packet", "dark")
    assert "20.0 dB" in sentence_of(bright.remark)
    assert dark.reason == "dark"
    short = clock_of(30, 0, [0])
    (few, _) = results_of(short, unsure, snr(30), samples_of(30), 0)
    expected = "of 50 slots 20 are missing; a picture shows 60 % of a packet: send 2 more photos, or film"
    assert expected in sentence_of(few.remark)
    for column in (bright, dark, few):
        assert "\n" not in sentence_of(column.remark)
        assert "; " in sentence_of(column.remark)


def test_a_column_never_seen_is_dark() -> None:
    posteriors = posteriors_of([5, 5], indices([5, 5]), probability=0.5001)
    (first, _) = results_of(clock_of(120, 0, [0, 0, 0]), posteriors, snr(120, 0.0), samples_of(120), 0)
    assert (first.status, first.snr_db, first.packets) == ("dark", None, ())


PACKET_RESULT = PacketResult(0.0, 1.0, 21, "000000", 0.99, 0.001)


def column(status: str, with_packet: bool) -> ColumnResult:
    return ColumnResult(0, status, packets=(PACKET_RESULT,) if with_packet else ())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ([column("ok", True), column("weak", True)], "ok"),
        ([column("ok", True), column("dark", False)], "ok"),
        ([column("ok", True), column("no_packet", False)], "partial"),
        ([column("no_packet", False), column("dark", False)], "no_signal"),
        ([column("dark", False)], "no_signal"),
        ([], "no_signal"),
    ],
)
def test_frame_status(columns: list[ColumnResult], expected: str) -> None:
    assert assemble.frame_status(tuple(columns)) == expected


@pytest.mark.parametrize(
    ("same", "quieter", "expected"),
    [
        ((1, 2), 2, [2]),
        ((1, 2), 1, [1]),
        ((1, 3), 3, []),
        ((0, 1, 2, 3), 2, []),
        ((), 2, []),
    ],
    ids=["of the left", "of the right", "not beside", "all send the same", "all differ"],
)
def test_a_column_that_shows_its_neighbour_has_no_packet(
    same: tuple[int, ...], quieter: int, expected: list[int]
) -> None:
    clock = clock_of(2 * PACKET, 0, [0, 0], n_columns=4)
    w = [4, 4, 4, 4]
    index = np.arange(4 * N_SYMBOLS).reshape(1, 4, N_SYMBOLS)
    index[:, list(same)] = 50
    snr = np.full((4, clock.n_slots), 100.0, np.float32)
    snr[quieter] = 30.0
    results = results_of(clock, posteriors_of(w, index), snr, samples_of(clock.n_slots, 4), 0.0)
    assert [c.column for c in results if not c.packets] == expected
    assert all(results[column].reason == "echo" for column in expected)


def test_a_packet_may_miss_two_slots_of_a_symbol_but_not_three() -> None:
    n_observed = np.ones((2, 3, 60), np.int64)
    n_observed[0, 0, :20] = 0  # The header and the dimming symbol are not needed.
    n_observed[0, 1, [20, 21, 30, 31, 58, 59]] = 0
    n_observed[1, 2, 57:] = 0
    np.testing.assert_array_equal(assemble.complete(n_observed, 2), [[True, True, True], [True, True, False]])
    np.testing.assert_array_equal(assemble.complete(n_observed), [[True, False, True], [True, True, False]])


def test_a_packet_of_a_clip_that_misses_a_slot_is_not_whole() -> None:
    clock, n_observed = clock_of(60, 0, [0, 0]), np.ones((2, 50), np.int64)
    n_observed[0, 30] = 0
    posteriors = posteriors_of([5, 5], indices([5, 5]))
    burst = confidence.BurstInView(0, 0, posteriors, n_observed, (3,), None, np.zeros(2, np.float32))
    first, second = assemble.clip_results(
        assemble.FrameColumns(clock, snr(60), np.zeros(2, bool), 0.0), [burst], lambda _: False
    )
    assert not first.packets
    assert (first.reason, first.remark.facts["missing"]) == ("incomplete", 1)
    assert second.packets


def test_a_probability_that_was_rounded_up_is_one() -> None:
    clock, posteriors = clock_of(60, 0, [0, 0]), posteriors_of([5, 5], indices([5, 5]))
    burst = confidence.BurstInView(0, 0, posteriors, np.ones((2, 50), np.int64), (3,), None, np.zeros(2, np.float32))
    packets = [
        assemble.clip_results(
            assemble.FrameColumns(clock, snr(60), np.zeros(2, bool), 0.0, framing=np.array([framing])),
            [burst],
            lambda _: False,
        )[0].packets
        for framing in (1.0, 1.001)
    ]
    assert packets[0]
    assert packets[0] == packets[1]
