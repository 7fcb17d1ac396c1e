"""The joint detector against enumeration of all words, on smeared light, and where nothing is visible."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.protocol import HEADER, WEIGHTS, bits_per_symbol, codebook, dimming_symbol
from rxcli.receiver.decode.settings import SURVIVORS
from rxcli.receiver.decode.survivors import detect, detect_against_free, detect_free, log_evidence_of, side_by_side
from rxcli.receiver.light import Exposure
from rxcli.types import BurstSamples

Q, STRIPS = 2, 4
EVERY_PATH = msgspec.structs.replace(SURVIVORS, max_paths=2000)


def packet(index: NDArray[np.int64], w: int) -> NDArray[np.int64]:
    """Slots of a packet and of the next header."""
    payload = codebook(w)[index].ravel()
    return np.concatenate([HEADER, dimming_symbol(w), payload, HEADER]).astype(np.int64)


def exposed(slots: NDArray[np.int64], exposure_slots: float, n_slots: int) -> NDArray[np.float64]:
    """(n_slots, Q) share of lit slots in exposures by their start."""
    taps = Exposure.by_start(exposure_slots, Q).taps
    return np.stack([taps @ slots[n : n + taps.shape[1]] for n in range(n_slots)])


def samples(
    slots: list[NDArray[np.int64]], exposure_slots: float, rng: np.random.Generator, noise: float, texture: float
) -> BurstSamples:
    """Samples of columns that do not light each other, through a picture that steps from slot to slot."""
    n = len(slots[0]) - len(HEADER)
    light = np.stack([exposed(one, exposure_slots, n) for one in slots], axis=2)[..., None]
    steps = rng.normal(0, texture / np.sqrt(Q), (n * Q, len(slots), STRIPS)).cumsum(axis=0)
    picture = np.exp(steps).reshape(n, Q, len(slots), STRIPS)
    received = light * picture * 1.9 + rng.normal(0, noise, picture.shape)
    like = np.ones(picture.shape, np.float32)
    return BurstSamples(
        light=received.astype(np.float32),
        noise=np.float32(noise**2) * like,
        valid=like,
        neighbours=0 * like,
        own=np.ones(STRIPS, np.float32),
        exposure_slots=exposure_slots,
        log_scale=np.zeros(len(slots)),
        n_bursts=1,
    )


@pytest.mark.parametrize("exposure_slots", [0.5, 1.0, 2.4, 4.0, 6.5, 8.0])
def test_smeared_slots_are_read(exposure_slots: float) -> None:
    rng = np.random.default_rng(3)
    weights = [2, 4, 5, 6, 8]
    index = [rng.integers(0, 1 << bits_per_symbol(w), 4) for w in weights]
    found = detect(
        samples([packet(i, w) for i, w in zip(index, weights, strict=True)], exposure_slots, rng, 0.01, 0.02)
    )
    assert found.w.tolist() == weights
    assert np.array_equal(found.index[0], index)
    assert found.log_prob.sum(axis=2).min() > -0.05
    sent = np.stack([packet(i, w)[: -len(HEADER)] for i, w in zip(index, weights, strict=True)])
    assert np.abs(found.lit[0] - sent).max() < 0.05


def test_a_picture_that_jumps_is_followed() -> None:
    rng = np.random.default_rng(5)
    index = rng.integers(0, 128, (6, 5))
    burst = samples([packet(i, 5) for i in index], 3.0, rng, 0.01, 0.03)
    step = np.where(np.arange(len(burst.light)) < 37, 1, 0.35).astype(np.float32)[:, None, None, None]
    found = detect(replace(burst, light=burst.light * step, noise=burst.noise))
    assert (found.index[0] == index).mean() > 0.9


def test_posterior_is_that_of_all_words() -> None:
    """One payload symbol: every path is followed by itself, without trellis, and the posteriors are compared."""
    rng = np.random.default_rng(8)
    burst = samples([packet(np.array([77]), 5)], 4.0, rng, 0.06, 0.08)
    found = detect(burst, EVERY_PATH)
    paths = [(w, k) for w in WEIGHTS for k in range(1 << bits_per_symbol(w))]
    log = np.array(
        [path_log_likelihood(burst, packet(np.array([k]), w)) - np.log(1 << bits_per_symbol(w)) for w, k in paths]
    )
    log -= np.log(len(WEIGHTS))
    evidence = float(np.logaddexp.reduce(log))
    assert log_evidence_of([burst, burst], EVERY_PATH) == pytest.approx(evidence, abs=0.3)
    of_five = np.array([value for value, (w, _) in zip(log, paths, strict=True) if w == 5])
    posterior = np.exp(of_five - np.logaddexp.reduce(of_five))
    assert found.w[0] == 5
    assert found.index[0, 0, 0] == posterior.argmax()
    assert np.exp(found.log_prob[0, 0, 0]) == pytest.approx(posterior.max(), abs=0.03)


def path_log_likelihood(burst: BurstSamples, slots: NDArray[np.int64]) -> float:
    """Log-likelihood of samples given the slots, by a Kalman filter of the picture with heavy tails, as documented."""
    settings, total = SURVIVORS, 0.0
    light = exposed(slots, burst.exposure_slots, len(burst.light))
    picture, variance = np.full(STRIPS, 2.0), np.full(STRIPS, (2 * settings.first_deviation) ** 2)
    nu = settings.degrees
    for n in range(len(light)):
        for place in range(Q):
            a, noise = light[n, place], burst.noise[n, place, 0]
            variance = variance + settings.drift_per_slot**2 / Q * picture**2
            if not burst.valid[n, place].any():
                continue
            error = burst.light[n, place, 0] - a * picture
            spread = a * a * variance + noise
            total += float((-np.log(spread) / 2 - (nu + 1) / 2 * np.log1p(error**2 / spread / nu)).sum())
            jump = np.maximum((nu + error**2 / spread) / (nu + 1), 1)
            variance = np.minimum(variance * jump, settings.max_variance * picture**2)
            gain = a * variance / (a * a * variance + noise)
            picture = np.clip(picture + gain * error, 1 / settings.max_picture, settings.max_picture)
            variance = np.maximum(variance * (1 - gain * a), 0)
    return settings.information_of(Q) / Q * total


@pytest.mark.parametrize("exposure_slots", [1.0, 2.5])
def test_evidence_of_arbitrary_slots_is_that_of_all_slots(exposure_slots: float) -> None:
    """Six slots in view, which see a few more: all of them are tried."""
    rng = np.random.default_rng(14)
    burst = samples([packet(np.array([77]), 5)], exposure_slots, rng, 0.06, 0.08)
    burst.valid[:12] = burst.valid[18:] = 0
    n_shown = 6 + Exposure.by_start(exposure_slots, Q).taps.shape[1] - 1
    log = []
    for number in range(1 << n_shown):
        slots = np.zeros(40, np.int64)
        slots[12 : 12 + n_shown] = (number >> np.arange(n_shown)) & 1
        log.append(path_log_likelihood(burst, slots) - n_shown * np.log(2))
    for free in (detect_against_free(burst, EVERY_PATH)[1], detect_free(burst, EVERY_PATH)[1]):
        assert free == pytest.approx(np.logaddexp.reduce(log), abs=0.3)


@pytest.mark.parametrize("exposure_slots", [1.1, 4.0])
def test_a_column_is_detected_the_same_beside_any_other(exposure_slots: float) -> None:
    """Poor columns have many paths and good ones few; none has a say in another's."""
    rng = np.random.default_rng(15)
    parts = [
        samples([packet(rng.integers(0, 1 << bits_per_symbol(w), 8), w)], exposure_slots, rng, noise, 0.05)
        for w, noise in ((2, 0.01), (4, 0.3), (5, 0.02), (8, 0.1))
    ]
    together = detect(replace(side_by_side(parts), n_bursts=1))
    for column, part in enumerate(parts):
        alone = detect(part)
        assert together.log_evidence[column] == pytest.approx(alone.log_evidence[0], abs=1e-4)
        assert np.allclose(together.lit[0, column], alone.lit[0, 0], atol=1e-5)


def test_bursts_of_other_copies_and_exposures_are_weighed_side_by_side() -> None:
    rng = np.random.default_rng(16)
    sent = [packet(rng.integers(0, 128, 5), 5) for _ in range(3)]
    one, longer = (samples(sent, exposure_slots, rng, 0.02, 0.05) for exposure_slots in (3.6, 4.4))
    light, noise, valid, neighbours = (
        np.concatenate([values, values], axis=3) for values in (one.light, one.noise, one.valid, one.neighbours)
    )
    twice = replace(one, light=light, noise=noise, valid=valid, neighbours=neighbours, own=np.tile(one.own, 2))
    parts = [one, twice, longer]
    apart = np.concatenate([log_evidence_of([part], EVERY_PATH) for part in parts])
    assert np.allclose(log_evidence_of(parts, EVERY_PATH), apart, atol=0.01)


def test_a_symbol_that_nothing_shows_is_open() -> None:
    rng = np.random.default_rng(9)
    index = rng.integers(0, 128, (3, 4))
    burst = samples([packet(i, 5) for i in index], 2.5, rng, 0.01, 0.02)
    hidden = burst.valid.copy()
    hidden[38:] = 0
    found = detect(replace(burst, valid=hidden))
    assert np.array_equal(found.index[0, :, :1], index[:, :1])
    assert found.log_prob[0, :, 2:].max() < np.log(0.2)


def test_a_burst_that_shows_its_header_alone_costs_the_other_nothing() -> None:
    rng = np.random.default_rng(12)
    weights = [3, 5, 8]
    index = [rng.integers(0, 1 << bits_per_symbol(w), 30) for w in weights]
    burst = samples([packet(i, w) for i, w in zip(index, weights, strict=True)], 1.1, rng, 0.01, 0.02)
    both = side_by_side([burst, burst])
    both.valid[12:, :, 3:] = 0
    found, alone = detect(both), detect(burst)
    assert np.array_equal(found.w, alone.w)
    assert np.allclose(np.exp(found.w_log_prob), np.exp(alone.w_log_prob), atol=0.01)
    assert np.allclose(found.log_prob[0], alone.log_prob[0])
    assert np.allclose(found.log_prob[1], [[-np.log(1 << bits_per_symbol(w))] for w in weights])


def test_a_column_that_leaves_its_weight_open_has_that_of_all() -> None:
    rng = np.random.default_rng(11)
    weights = [7, 7, 7, 7, 7, 3]
    sent = [packet(rng.integers(0, 1 << bits_per_symbol(w), 4), w) for w in weights]
    burst = samples(sent, 2.0, rng, 0.01, 0.02)
    burst.noise[:, :, 1] = 4
    assert detect(burst).w[1] != 7
    assert detect(burst, has_common_weights=True).w.tolist() == weights


def test_few_paths_are_enough_and_packets_beat_arbitrary_slots() -> None:
    rng = np.random.default_rng(10)
    index = rng.integers(0, 128, (4, 5))
    burst = samples([packet(i, 5) for i in index], 4.0, rng, 0.02, 0.05)
    few, many = detect(burst), detect(burst, msgspec.structs.replace(SURVIVORS, max_paths=300))
    assert np.array_equal(few.index, many.index)
    assert (few.log_evidence > detect_against_free(burst)[1]).all()
    other = rng.integers(0, 2, (4, 80)).astype(np.int64)
    noise = samples([np.concatenate([slots, HEADER]) for slots in other], 4.0, rng, 0.02, 0.05)
    assert (detect(noise).log_evidence < detect_against_free(noise)[1]).all()


@pytest.mark.parametrize("exposure_slots", [1.1, 6.0])
@pytest.mark.parametrize(("first", "last"), [(27, 80), (0, 52), (33, 64)])
def test_words_that_are_mostly_out_of_view_are_open_and_leave_the_next_alone(
    exposure_slots: float, first: int, last: int
) -> None:
    """A packet that is cut before slot `first` and after `last`: what is not in view has no say in what is."""
    rng = np.random.default_rng(12)
    index = rng.integers(0, 128, (8, 6))
    burst = samples([packet(one, 5) for one in index], exposure_slots, rng, 0.01, 0.02)
    burst.valid[:first] = 0
    burst.valid[last:] = 0
    known = np.full((8, len(WEIGHTS)), -20.0)
    known[:, 5 - 1] = 0.0
    found = detect(replace(burst, w_log_prior=known))
    start, end = 20 + 10 * np.arange(6), 30 + 10 * np.arange(6)
    whole = (start >= first) & (end <= last)
    out_of_view = (end <= first + 4) | (start >= last + np.ceil(exposure_slots) - 5)
    assert (found.index[0][:, whole] == index[:, whole]).mean() > 0.95
    assert np.allclose(found.log_prob[0][:, out_of_view], -np.log(1 << bits_per_symbol(5)))
