"""The detector against enumeration of all symbol sequences, closed forms and its own calibration."""

from itertools import product
from math import erf, log, pi, sqrt

import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.protocol import HEADER, WEIGHTS, bits_per_symbol, codebook, dimming_symbol, indices_to_bits, slot_patterns
from rxcli.receiver.channel.patterns import slot_llr
from rxcli.receiver.decode.detect import common_weights, detect, free_log_evidence, header_llr

FloatArray = NDArray[np.float64]
#: One sample a slot, of that slot alone; memory 1.
WHITE = np.array([[0.0, 1.0]])


def log_sum(values: FloatArray) -> float:
    top = values.max()
    return float(top + np.log(np.exp(values - top).sum()))


def only(w: int, n_columns: int = 1) -> NDArray[np.bool_]:
    return np.tile(np.array(WEIGHTS) == w, (n_columns, 1))


def sequences(w: int, n_symbols: int) -> NDArray[np.int64]:
    return np.array(list(product(range(1 << bits_per_symbol(w)), repeat=n_symbols)))


def packet_and_next(indices: NDArray[np.int64], w: int, isi_memory: int) -> NDArray[np.int64]:
    """Slots of packets (n, N indices) and of the header's start after them."""
    n = indices.shape[0]
    known = np.tile(np.concatenate([HEADER, dimming_symbol(w)]), (n, 1))
    payload = codebook(w)[indices].reshape(n, -1)
    return np.concatenate([known, payload, np.tile(HEADER[:isi_memory], (n, 1))], axis=1).astype(np.int64)


def path_llr(llr: FloatArray, indices: NDArray[np.int64], w: int) -> FloatArray:
    """Log-likelihood of every sequence of `indices` (n, N) against dark slots; llr (L,)."""
    return np.asarray(packet_and_next(indices, w, 0) @ llr)


def box_exposure(exposure_slots: float, isi_memory: int, n_samples: int = 4) -> FloatArray:
    """(n_samples, memory + 1) share of each slot in samples spread over one slot, in the middle of the pattern."""
    start = np.arange(-isi_memory, 1.0)
    centre = -isi_memory / 2 + (np.arange(n_samples)[:, None] + 0.5) / n_samples
    end = np.minimum(centre + exposure_slots / 2, start + 1)
    return np.maximum(end - np.maximum(centre - exposure_slots / 2, start), 0) / exposure_slots


def gaussian_metrics(observed: FloatArray, taps: FloatArray, sigma: float) -> FloatArray:
    """Metrics (..., L, patterns) of observations (..., L, Q) of slots through `taps` (Q, memory + 1), oldest first."""
    levels = slot_patterns(taps.shape[1] - 1) @ taps.T
    return -((observed[..., None, :] - levels) ** 2).sum(axis=-1) / (2 * sigma**2)


def observe(indices: NDArray[np.int64], w: int, taps: FloatArray, sigma: float, rng: np.random.Generator) -> FloatArray:
    """Observations (1, n, L, Q) of packets (n, N indices) through `taps` (Q, memory + 1) and white noise."""
    isi_memory = taps.shape[1] - 1
    slots = packet_and_next(indices, w, isi_memory)
    before = rng.integers(0, 2, (slots.shape[0], isi_memory))
    windows = np.lib.stride_tricks.sliding_window_view(np.concatenate([before, slots], axis=1), isi_memory + 1, axis=1)
    clean = windows @ taps.T
    return (clean + rng.normal(0, sigma, clean.shape))[None]


def sent_through(
    indices: NDArray[np.int64], w: int, taps: FloatArray, sigma: float, rng: np.random.Generator
) -> FloatArray:
    """Ratios (1, n, L) of the slots of packets through a channel that the receiver knows."""
    metrics = gaussian_metrics(observe(indices, w, taps, sigma, rng), taps, sigma)[0]
    return slot_llr(metrics.astype(np.float32))[None].astype(np.float64)


@pytest.mark.parametrize(("w", "n_symbols"), [(1, 3), (9, 3), (2, 2), (8, 2), (5, 1)])
def test_agrees_with_enumeration_of_all_sequences(w: int, n_symbols: int) -> None:
    rng = np.random.default_rng([w, n_symbols])
    llr = rng.normal(0, 1.5, (1, 4, 20 + 10 * n_symbols))
    found = detect(llr, only(w, 4))
    every = sequences(w, n_symbols)
    k = bits_per_symbol(w)
    bits = indices_to_bits(every.ravel(), w).reshape(len(every), n_symbols, k)
    for column in range(4):
        paths = path_llr(llr[0, column], every, w)
        total = log_sum(paths)
        assert found.log_evidence[column] == pytest.approx(total - n_symbols * k * log(2), abs=1e-4)
        share = np.exp(paths - total)
        for symbol in range(n_symbols):
            posterior = np.bincount(every[:, symbol], share, 1 << k)
            assert found.index[0, column, symbol] == posterior.argmax()
            assert found.log_prob[0, column, symbol] == pytest.approx(np.log(posterior.max()), abs=1e-4)
            lit = posterior @ codebook(w)
            at = 20 + 10 * symbol
            np.testing.assert_allclose(found.lit[0, column, at : at + 10], lit, atol=1e-5)
            ones = share @ bits[:, symbol]
            expected = np.log(ones / (1 - ones))
            np.testing.assert_allclose(found.bit_llr[0, column, symbol, :k], expected, rtol=1e-4, atol=1e-4)
            assert np.isnan(found.bit_llr[0, column, symbol, k:]).all()


def test_weight_probabilities_agree_with_enumeration() -> None:
    llr = np.random.default_rng(1).normal(0, 0.4, (2, 3, 30))
    found = detect(llr)
    for column in range(3):
        log_evidence = np.array(
            [
                sum(log_sum(path_llr(burst[column], sequences(w, 1), w)) for burst in llr)
                - 2 * bits_per_symbol(w) * log(2)
                for w in WEIGHTS
            ]
        )
        np.testing.assert_allclose(found.w_log_prob[column], log_evidence - log_sum(log_evidence), atol=1e-4)
        assert found.w[column] == log_evidence.argmax() + 1


def test_arbitrary_slots_and_headers_by_enumeration() -> None:
    """Both against dark slots, as the evidence of packets is."""
    llr = np.random.default_rng(2).normal(0, 2, (2, 10))
    every = np.array(list(product([0, 1], repeat=10)))
    for share in (0.1, 0.5):
        prior = every.sum(axis=1) * log(share) + (1 - every).sum(axis=1) * log(1 - share)
        expected = [log_sum(every @ row + prior) for row in llr]
        np.testing.assert_allclose(free_log_evidence(llr, np.full(2, share)), expected)
    np.testing.assert_allclose(header_llr(llr[None])[0], llr @ np.array(HEADER) - expected)


@pytest.mark.parametrize(("w", "sigma"), [(1, 0.45), (9, 0.45), (1, 0.6)])
def test_symbol_error_rate_of_one_pulse_follows_theory(w: int, sigma: float) -> None:
    """Weights 1 and 9 are orthogonal signals: P(right) = E[Phi(x + 1/sigma)^7], as eight of the ten words are sent."""
    rng = np.random.default_rng([w, int(100 * sigma)])
    tx = rng.integers(0, 8, (500, 20))
    rx = detect(sent_through(tx, w, WHITE, sigma, rng), only(w, 500)).index[0]
    x = np.linspace(-8, 12, 20001)
    below = np.array([0.5 * (1 + erf(v / sqrt(2))) for v in x])
    right = np.trapezoid(np.exp(-((x - 1 / sigma) ** 2) / 2) / sqrt(2 * pi) * below**7, x)
    n, errors = tx.size, int((rx != tx).sum())
    assert abs(errors - n * (1 - right)) < 4 * sqrt(n * right * (1 - right))


@pytest.mark.parametrize(("taps", "sigma"), [(WHITE, 0.4), (box_exposure(0.4, 1), 0.6)])
def test_posteriors_are_calibrated(taps: FloatArray, sigma: float) -> None:
    rng = np.random.default_rng(taps.size)
    probability, right, bit_probability, bit_right = [], [], [], []
    for w in (1, 4, 5, 8):
        tx = rng.integers(0, 1 << bits_per_symbol(w), (150, 11))
        found = detect(sent_through(tx, w, taps, sigma, rng), only(w, 150))
        probability.append(np.exp(found.log_prob[0]).ravel())
        right.append((found.index[0] == tx).ravel())
        llr = found.bit_llr[0, :, :, : bits_per_symbol(w)].ravel()
        bit_probability.append(1 / (1 + np.exp(-np.abs(llr))))
        bit_right.append((llr > 0) == indices_to_bits(tx.ravel(), w).astype(bool))
    for p, ok in ((probability, right), (bit_probability, bit_right)):
        claimed, true = np.concatenate(p), np.concatenate(ok)
        assert claimed.min() < 0.7 < 0.99 < claimed.max()
        for low, high in ((0.0, 0.5), (0.5, 0.7), (0.7, 0.9), (0.9, 0.99), (0.99, 1.01)):
            inside = (claimed >= low) & (claimed < high)
            crosstalk = sqrt(max(float((claimed * (1 - claimed))[inside].sum()), 1.0))
            assert abs(float(true[inside].sum() - claimed[inside].sum())) < 4.5 * crosstalk


def test_columns_and_bursts_do_not_touch_one_another() -> None:
    llr = np.random.default_rng(3).normal(0, 1, (3, 4, 40))
    whole = detect(llr)
    alone = detect(llr[:, 2:3])
    assert alone.w[0] == whole.w[2]
    assert (alone.index[:, 0] == whole.index[:, 2]).all()
    one_burst = detect(llr[1:2], only(4, 4))
    assert (one_burst.index[0] == detect(llr, only(4, 4)).index[1]).all()


def extreme(kind: str, shape: tuple[int, ...]) -> FloatArray:
    rng = np.random.default_rng(0)
    if kind == "mixed":
        return rng.choice([-1e6, 0.0, 1e6], shape)
    if kind == "one huge":
        llr = np.zeros(shape)
        llr[:, :, 25] = 1e6
        return llr
    return np.full(shape, {"equal": 0.0, "huge": 1e6, "never": -1e6}[kind])


@pytest.mark.parametrize("kind", ["equal", "huge", "never", "mixed", "one huge"])
def test_extreme_ratios_give_finite_posteriors(kind: str) -> None:
    llr = extreme(kind, (2, 3, 40))
    for candidates in (None, only(5, 3)):
        found = detect(llr, candidates)
        assert ((found.lit >= 0) & (found.lit <= 1 + 1e-6)).all()
        assert np.isfinite(found.log_prob).all()
        assert (found.log_prob <= 0).all()
        assert np.exp(found.w_log_prob).sum(axis=1) == pytest.approx(np.ones(3))
        for column, w in enumerate(found.w):
            k = bits_per_symbol(int(w))
            assert np.isfinite(found.bit_llr[:, column, :, :k]).all()
            assert (found.index[:, column] < 1 << k).all()


@pytest.mark.parametrize(
    ("alone", "common"),
    [
        ({2: 4}, {}),  # Words alone spoke for a neighbouring weight in one column.
        ({2: 4, 5: 6, 7: 2}, {}),
        (dict.fromkeys(range(0, 20, 2), 3), dict.fromkeys(range(0, 20, 2), 3)),  # Half of the columns differ.
    ],
)
def test_columns_have_weights_in_common(alone: dict[int, int], common: dict[int, int]) -> None:
    w_log_prob = np.full((20, 9), -60.0)
    for column in range(20):
        w_log_prob[column, 4] = -20.0
        w_log_prob[column, alone.get(column, 5) - 1] = 0.0
    found = common_weights(w_log_prob)
    assert found.sum(axis=1).tolist() == [1] * 20
    assert (found.argmax(axis=1) + 1).tolist() == [common.get(column, 5) for column in range(20)]


def test_a_weight_of_its_own_that_is_beyond_doubt_stays() -> None:
    w_log_prob = np.full((20, 9), -120.0)
    w_log_prob[:, 4] = 0.0
    w_log_prob[3] = [-120, -120, 0, -120, -120, -120, -120, -120, -120]
    assert (common_weights(w_log_prob).argmax(axis=1) + 1).tolist() == [5, 5, 5, 3, *[5] * 16]
