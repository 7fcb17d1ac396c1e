"""The light model against numeric integration and links whose every slot is known."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from made_stages import clock_of
from numpy.typing import NDArray
from row_profiles import Link, Shot, random_link, row_profiles, sigma_of

from rxcli.protocol import codewords, slot_patterns
from rxcli.receiver import channel
from rxcli.receiver.channel.patterns import beyond_slots, by_pattern, propagated, slot_llr, word_metrics
from rxcli.receiver.channel.picture import PictureSums, by_place, in_time, predict_picture
from rxcli.receiver.light import Crosstalk, Exposure, NoiseModel, dark_sigma
from rxcli.receiver.sync import clock as sync
from rxcli.types import Clock, SlotSamples

FloatArray = NDArray[np.float64]
Q = 4


def true_clock(shot_gain: Shot, packet_slots: int, n_columns: int) -> Clock:
    """The clock that the shot was made with, its grid starting at the first row."""
    before = int(np.floor(shot_gain.start_slot))
    n_slots = int(np.ceil(shot_gain.n_rows / shot_gain.rows_per_slot)) + 1
    first_slot = before % packet_slots
    n_copies = -(-(first_slot + n_slots) // packet_slots)
    burst = (before // packet_slots + np.arange(n_copies)) // 3
    known = {"packet_slots": packet_slots, "n_slots": n_slots, "first_slot": first_slot, "burst": burst - burst[0]}
    known |= {name: getattr(shot_gain, name) for name in ("rows_per_slot", "exposure_slots")}
    return clock_of(n_columns, row0=(before - shot_gain.start_slot) * shot_gain.rows_per_slot, **known)


def true_slots(link: Link, shot_gain: Shot, n_slots: int) -> NDArray[np.float32]:
    before = int(np.floor(shot_gain.start_slot))
    return link.slots()[:, before : before + n_slots].astype(np.float32)


def model_for(shot_gain: Shot, sigma: float, black_level: float) -> channel.ObservationModel:
    return channel.ObservationModel(
        black_level=black_level,
        noise=NoiseModel(sigma**2, 0.0),
        crosstalk=Crosstalk(np.tile([shot_gain.crosstalk, 1.0, shot_gain.crosstalk], (shot_gain.n_strips, 1))),
        exposure=Exposure.of(shot_gain.exposure_slots, Q),
    )


def brightened(model: channel.ObservationModel, factor: float) -> channel.ObservationModel:
    noise = NoiseModel(model.noise.dark_variance * factor**2, model.noise.shot_gain * factor)
    return replace(model, black_level=model.black_level * factor, noise=noise)


def scene(
    shot_gain: Shot, seed: int, w: list[int] | None = None
) -> tuple[Link, Clock, SlotSamples, channel.ObservationModel]:
    rng = np.random.default_rng(seed)
    link = random_link(rng, w or [5, 3, 7, 4, 6, 5], 5)
    profiles = row_profiles(link, shot_gain, rng)
    now = true_clock(shot_gain, link.packet_slots, len(link.w))
    samples = sync.sample_slots(profiles, now, Q)
    sigma = sigma_of(profiles) / np.sqrt(max(shot_gain.rows_per_slot / Q, 1.0))
    return link, now, samples, model_for(shot_gain, sigma, shot_gain.ambient)


def numeric_taps(exposure: float, blur: float, isi_memory: int, q: int) -> FloatArray:
    """Slot n covers 0..1; sample k's instants lie around -memory/2 + (k + 1/2)/q; both boxes by brute force."""
    instants = (np.arange(500) + 0.5) / 500 - 0.5
    out = np.zeros((q, isi_memory + 1))
    for k in range(q):
        t = -isi_memory / 2 + (k + 0.5) / q + blur * instants[:, None] + exposure * instants[None, :]
        slot = np.floor(t).astype(int) + isi_memory
        inside = (slot >= 0) & (slot <= isi_memory)
        out[k] = np.bincount(slot[inside], minlength=isi_memory + 1) / t.size
    return out


@pytest.mark.parametrize(("exposure", "isi_memory"), [(0.05, 1), (0.5, 1), (1.08, 1), (2.2, 3), (4.0, 5)])
def test_exposure_taps_against_numeric_integration(exposure: float, isi_memory: int) -> None:
    taps = Exposure.of(exposure, Q).taps
    np.testing.assert_allclose(taps, numeric_taps(exposure, 1 / Q, isi_memory, Q), atol=4e-3)


@pytest.mark.parametrize("exposure", [1e-6, 0.2, 1.0, 1.08, 1.3, 2.0, 2.6, 3.0, 4.0])
def test_memory_covers_the_exposure(exposure: float) -> None:
    found = Exposure.of(exposure, Q)
    assert found.isi_memory in {1, 3, 5}
    assert found.taps.sum(axis=1).min() > 0.83
    assert found.isi_memory <= Exposure.of(exposure + 1.0, Q).isi_memory


def test_crosstalk_of_the_specification() -> None:
    """With equal drive about 15 % of the light at a column's middle comes from its neighbours, half at its edge."""
    shares = Crosstalk.of(101, 0.45).shares
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    assert shares[50, 0] + shares[50, 2] == pytest.approx(0.15, abs=0.01)
    assert shares[0, 0] == pytest.approx(0.5, abs=0.02)
    assert shares[-1, 2] == pytest.approx(0.5, abs=0.02)
    np.testing.assert_allclose(shares, shares[::-1, ::-1], atol=1e-12)


@pytest.mark.parametrize("ambient", [0.0, 0.03, 0.2])
@pytest.mark.parametrize("exposure", [0.3, 1.08])
def test_floor_is_the_room_light(ambient: float, exposure: float) -> None:
    shot_gain = Shot(ambient=ambient, exposure_slots=exposure, texture=0.3, sigma=0.003)
    _, now, samples, _ = scene(shot_gain, seed=1)
    assert channel.estimate_black_level(samples, now) == pytest.approx(ambient, abs=0.002)


def test_light_that_does_not_blink_is_taken_off_where_it_is() -> None:
    link = random_link(np.random.default_rng(1), [5] * 6, 3)
    shot_gain = Shot(texture=0.3, sigma=0.001, n_rows=1000)
    profiles = row_profiles(link, shot_gain, np.random.default_rng(2))
    clock = true_clock(shot_gain, link.packet_slots, 6)
    assert np.array_equal(channel.without_steady_light(profiles, clock).light, profiles.light)
    window = np.zeros(profiles.light.shape, np.float32)
    window[2:4, :, :600] = 0.3
    lighted = replace(profiles, light=profiles.light + window)
    left = channel.without_steady_light(lighted, clock).light - profiles.light
    assert np.abs(left[[0, 1, 4, 5]]).max() == 0
    assert np.abs(left[2:4, :, 40:500]).mean() < 0.05


def test_rows_of_bars_are_no_dark_slots() -> None:
    """The bars of a film are left out, but not the dark slots that some columns begin and end with."""
    link = random_link(np.random.default_rng(1), [5] * 6, 3)
    shot_gain = Shot(texture=0.3, sigma=0.001, n_rows=1000)
    profiles = row_profiles(link, shot_gain, np.random.default_rng(2))
    clock, sigma = true_clock(shot_gain, link.packet_slots, 6), 0.001
    whole = channel.within_light(profiles, clock, sigma).inside
    noise = np.random.default_rng(3).normal(0, sigma, profiles.light.shape).astype(np.float32)
    row = np.arange(1000)
    light = np.where((row >= 200) & (row < 900), profiles.light, noise)
    inside = channel.within_light(replace(profiles, light=light), clock, sigma).inside.all(axis=(0, 1))
    for shown, seen in ((whole.all(axis=(0, 1)), profiles.light), (inside, light)):
        lit = np.flatnonzero((seen > 0.1).any(axis=(0, 1)))
        np.testing.assert_allclose(np.flatnonzero(shown)[[0, -1]], lit[[0, -1]], atol=clock.rows_per_slot)
        assert shown[lit[0] + 5 : lit[-1] - 5].all()
    # Nothing is left out where there is no light at all.
    black = replace(profiles, light=noise * 0)
    assert channel.within_light(black, clock, sigma) is black


def test_sigma_is_the_noise_of_a_dark_sample() -> None:
    """Dark parts of a picture: a tenth of the light is left."""
    for sigma in (0.0005, 0.002):
        shot_gain = Shot(rows_per_slot=16.0, n_rows=3000, level=2e-4, sigma=sigma)
        _, _, samples, model = scene(shot_gain, seed=2)
        found = dark_sigma(samples.light, samples.valid, shot_gain.ambient, 1e-6)
        assert found == pytest.approx(model.noise.sigma, rel=0.2)
        assert dark_sigma(samples.light, samples.valid, shot_gain.ambient, 1.0) == 1.0


CLEAN = {
    "plain": Shot(sigma=0.002),
    "textured": Shot(texture=0.3, sigma=0.002),
    "short": Shot(exposure_slots=0.3, texture=0.2),
    "two rows a slot": Shot(rows_per_slot=2.4, n_rows=400, texture=0.1),
    "crosstalk": Shot(crosstalk=0.1, texture=0.2),
}


@pytest.mark.parametrize("is_initial", [True, False])
@pytest.mark.parametrize("kind", CLEAN)
def test_clean_slots_have_the_right_sign(kind: str, is_initial: bool) -> None:
    shot_gain = replace(CLEAN[kind], start_slot=12.3)
    right = []
    for seed in range(6):
        link, now, samples, model = scene(shot_gain, seed)
        lit = true_slots(link, shot_gain, now.n_slots)
        idea = np.abs(lit - np.float32(0.1))
        found = channel.slot_likelihoods(samples, now, model, idea, np.arange(6), is_initial=is_initial)
        inner = slice(3, now.n_slots - 3)
        right.append(((found.llr > 0) == (lit > 0.5))[:, inner].ravel())
    assert np.concatenate(right).mean() > (0.999 if shot_gain.crosstalk == 0 else 0.995)


@pytest.mark.parametrize("late", [-0.2, -0.05, 0.0, 0.05, 0.2])
def test_timing_tells_how_late_the_clock_is(late: float) -> None:
    found = []
    for seed in range(5):
        shot_gain = Shot(texture=0.2, sigma=0.005, start_slot=12.3)
        rng = np.random.default_rng(seed)
        link = random_link(rng, [5, 3, 7, 4, 6, 5], 5)
        profiles = row_profiles(link, shot_gain, rng)
        now = true_clock(shot_gain, 70, 6)
        model = model_for(shot_gain, 0.005, shot_gain.ambient)
        lit = true_slots(link, shot_gain, now.n_slots)
        off = replace(now, row0=now.row0 + late * now.rows_per_slot)
        samples = sync.sample_slots(profiles, off, Q)
        timing = channel.slot_likelihoods(samples, off, model, lit, np.arange(6), is_initial=True).timing
        numerator, denominator = timing.sum(axis=0)
        found.append(numerator / denominator)
        moved = sync.corrected(off, timing)
        assert abs(moved.row0 - now.row0) <= abs(off.row0 - now.row0) + 0.02 * now.rows_per_slot
    if late == 0.0:
        assert abs(np.mean(found)) < 0.01
    else:
        assert 0.3 < np.mean(found) / late < 1.3


@pytest.mark.parametrize("factor", [0.3, 3.0])
def test_brightness_does_not_matter(factor: float) -> None:
    shot_gain = Shot(texture=0.3, sigma=0.004, ambient=0.02, start_slot=12.3)
    link, now, samples, model = scene(shot_gain, seed=4)
    lit = true_slots(link, shot_gain, now.n_slots)
    idea = np.abs(lit - np.float32(0.1))
    brighter = replace(samples, light=samples.light * np.float32(factor))
    scaled = brightened(model, factor)
    one = channel.slot_likelihoods(samples, now, model, idea, np.arange(6)).llr
    other = channel.slot_likelihoods(brighter, now, scaled, idea, np.arange(6)).llr
    np.testing.assert_allclose(other, one, rtol=0.05, atol=0.3)


def test_columns_asked_for_are_those_of_the_whole() -> None:
    shot_gain = Shot(texture=0.3, sigma=0.004, crosstalk=0.1)
    link, now, samples, model = scene(shot_gain, seed=5)
    lit = true_slots(link, shot_gain, now.n_slots)
    whole = channel.slot_likelihoods(samples, now, model, lit, np.arange(6))
    two = SlotSamples(samples.light[[1, 4]], samples.valid[[1, 4]], samples.samples_per_slot)
    some = channel.slot_likelihoods(two, now, model, lit, np.array([1, 4]))
    np.testing.assert_allclose(some.llr, whole.llr[[1, 4]], rtol=1e-4, atol=1e-4)
    assert whole.llr.shape == whole.snr.shape == (6, now.n_slots)


def hostile(kind: str, samples: SlotSamples) -> SlotSamples:
    light = np.zeros_like(samples.light)
    valid = samples.valid
    if kind == "constant":
        light[:] = 0.4
    elif kind == "saturated":
        light[:] = 1.0
    elif kind == "one lit sample":
        light[2, 1, 200] = 1.0
    elif kind == "zero rows":
        light = samples.light.copy()
        light[..., 100:300] = 0.0
    elif kind == "nothing seen":
        valid = np.zeros_like(valid)
    elif kind == "huge":
        light = samples.light * np.float32(1e6)
    elif kind == "tiny":
        light = samples.light * np.float32(1e-9)
    return SlotSamples(light, valid, samples.samples_per_slot)


@pytest.mark.parametrize("idea", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("is_initial", [True, False])
@pytest.mark.parametrize(
    "kind", ["zeros", "constant", "saturated", "one lit sample", "zero rows", "nothing seen", "huge", "tiny"]
)
def test_hostile_light_gives_finite_likelihoods(kind: str, is_initial: bool, idea: float) -> None:
    _, now, samples, _ = scene(Shot(), seed=7)
    samples = hostile(kind, samples)
    black_level = channel.estimate_black_level(samples, now) or 0.0
    sigma = dark_sigma(samples.light, samples.valid, black_level, 1e-5)
    model = model_for(Shot(), sigma, black_level)
    lit = np.full((6, now.n_slots), idea, np.float32)
    contrast = sync.contrast(samples.light, samples.valid, Q, model.noise.sigma)
    first = channel.initial_llr(*contrast, model.exposure)
    found = channel.slot_likelihoods(samples, now, model, lit, np.arange(6), is_initial=is_initial)
    for values in (first, found.llr, found.snr, found.timing):
        assert np.isfinite(values).all()
    if kind == "nothing seen":
        assert (found.llr == 0).all()
        assert (found.snr == 0).all()


@pytest.mark.parametrize("exposure_slots", [0.4, 1.0, 1.8, 2.3, 3.4])
@pytest.mark.parametrize("q", [2, 4])
def test_patterns_add_up_what_their_samples_say(exposure_slots: float, q: int) -> None:
    """Levels that are not asked for are told by a polynomial, which a square is."""
    exposure = Exposure.of(exposure_slots, q)
    isi_memory, n = exposure.isi_memory, 12 * q
    light = np.random.default_rng(3).random((2, n)).astype(np.float32)
    levels = slot_patterns(isi_memory) @ exposure.taps.T
    expected = np.zeros((2, 12 + isi_memory, len(levels)))
    for i in range(n):
        metric, sample = divmod(i + isi_memory * q // 2, q)
        expected[:, metric] -= (light[:, i, None] - levels[:, sample]) ** 2
    said = by_pattern(exposure, lambda place, level: -np.square(light[:, place::q] - np.float32(level)))
    np.testing.assert_allclose(said, expected, atol=1e-4)


@pytest.mark.parametrize("q", [2, 4])
def test_a_slot_says_nothing_of_its_own_picture(q: int) -> None:
    rng, slot = np.random.default_rng(5), 20
    light, expected = (rng.uniform(0.5, 1.0, (1, 2, 40 * q)).astype(np.float32) for _ in range(2))
    other = light.copy()
    other[..., slot * q : (slot + 1) * q] *= 2

    def predicted(light: NDArray[np.float32]) -> NDArray[np.float32]:
        sums = PictureSums.of(*(by_place(each, q) for each in (light, expected, np.ones_like(light))))
        return predict_picture(sums, 1e-4, (1, 2, 5), one_sided=True).picture

    np.testing.assert_array_equal(in_time(by_place(light, q)), light)
    before, after = predicted(light), predicted(other)
    np.testing.assert_array_equal(before[..., slot], after[..., slot])
    assert not np.array_equal(before[..., slot + 1], after[..., slot + 1])


def test_slots_of_copies_are_added() -> None:
    """Four copies of seventy slots, the first from its slot 33 on; the last is another burst."""
    now = Clock(5.0, 1.0, 70, 0.0, 180, 33, np.array([0, 0, 0, 1]), np.zeros(2), 9.0)
    llr = np.random.default_rng(0).normal(0, 1, (2, 180))
    found = now.by_burst(llr)
    assert found.shape == (2, 2, 70)
    at = 50  # seen in copies 0, 1 and 2, on grid slots 17, 87 and 157
    np.testing.assert_allclose(found[0, :, at], llr[:, 17] + llr[:, 87] + llr[:, 157])
    early = 20  # not seen in copy 0
    np.testing.assert_allclose(found[0, :, early], llr[:, 57] + llr[:, 127])
    np.testing.assert_allclose(found[1, :, :3], llr[:, 177:])
    assert (found[1, :, 3:] == 0).all()  # beyond the grid


@pytest.mark.parametrize("isi_memory", [1, 3])
def test_slots_that_are_independent_keep_their_ratio(isi_memory: int) -> None:
    llr = np.random.default_rng(1).normal(0, 3, (2, 50)).astype(np.float32)
    by_slot = np.pad(llr, ((0, 0), (0, isi_memory)))[..., None] * slot_patterns(isi_memory)[:, -1]
    np.testing.assert_allclose(slot_llr(by_slot.astype(np.float32)), llr, atol=1e-4)


@pytest.mark.parametrize("isi_memory", [1, 3])
def test_a_slot_between_known_ones_by_brute_force(isi_memory: int) -> None:
    """Where all others are plain by their own light, the ratio of one is a difference of metrics."""
    rng, n, slot = np.random.default_rng(isi_memory), 13, 6
    metrics, slots = rng.normal(0, 1, (1, n + isi_memory, 2 << isi_memory)), rng.integers(0, 2, n)
    plain = 30.0 * (2 * slots - 1) * (np.arange(n) != slot)
    metrics[0, :n] += plain[:, None] * slot_patterns(isi_memory)[:, -1]

    def total(states: NDArray[np.int64]) -> float:
        padded = np.pad(states, isi_memory)
        index = [int("".join(map(str, padded[i : i + isi_memory + 1])), 2) for i in range(n + isi_memory)]
        return float(metrics[0, np.arange(n + isi_memory), index].sum())

    lit_there, dark_there = (np.where(np.arange(n) == slot, state, slots) for state in (1, 0))
    found = slot_llr(metrics.astype(np.float32))[0]
    assert found[slot] == pytest.approx(total(lit_there) - total(dark_there), abs=0.02)
    assert (np.sign(found) == np.sign(plain))[np.arange(n) != slot].all()


@pytest.mark.parametrize("tails", [0.0, 0.4])
@pytest.mark.parametrize(("n_wrong", "bent"), [(0, 1.0), (2, 1.0), (0, 1.2), (2, 0.8)])
def test_tails_of_the_crosstalk_by_decided_slots(tails: float, n_wrong: int, bent: float) -> None:
    rng, n_columns, n_slots, n_strips, spread = np.random.default_rng(4), 12, 240, 4, 0.45
    lit = rng.integers(0, 2, (n_columns, n_slots)).astype(np.float32)
    clock = Clock(5.0, 0.8, 70, 0.0, n_slots, 0, np.zeros(4, np.int64), np.zeros(n_columns), 10.0)
    model = channel.ObservationModel(
        0.02, NoiseModel(1e-5, 0.0), Crosstalk.of(n_strips, spread), Exposure.of(clock.exposure_slots, 2)
    )
    every = np.arange(n_columns)
    light = model.with_tails(spread, (tails, 0.0)).expected(lit, clock, every).whole
    picture = 0.3 * (1 + 0.2 * rng.standard_normal((n_columns, n_strips, 1)))
    light = 0.02 + picture * light**bent + 3e-3 * rng.standard_normal(light.shape)
    samples = SlotSamples(light.astype(np.float32), np.ones_like(light, np.float32), 2)
    decided = lit.copy()
    decided[:n_wrong] = 1 - decided[:n_wrong]
    trust = np.where(every < n_wrong + 1, 0.05, 0.9)
    estimate, sd = channel.estimate_tails(samples, clock, model, decided, trust, spread)
    assert abs(estimate - tails) < 0.06
    assert sd < 0.05
    assert channel.estimate_tails(samples, clock, model, decided, 1.0 * (every < 2), spread) == (0.0, 0.0)
    wide = model.with_tails(spread, (estimate, sd)).crosstalk.shares
    np.testing.assert_allclose(wide.sum(axis=1), 1)
    assert (wide[:, 1] < 0.97 * model.crosstalk.shares[:, 1]).all() == bool(tails)


@pytest.mark.parametrize("seed", range(8))
def test_ratios_of_slots_agree_with_enumeration_of_all_slots(seed: int) -> None:
    """Of a chain, as through exposures of a slot: no metric counts twice, slots before and after the grid are open."""
    n_slots = 6
    metrics = np.random.default_rng(seed).normal(0, 0.7, (1, n_slots + 1, 4)).astype(np.float32)
    sequences = np.array(list(product((0, 1), repeat=n_slots + 2)))
    patterns = 2 * sequences[:, :-1] + sequences[:, 1:]
    likelihood = np.exp(metrics[0, np.arange(n_slots + 1), patterns].sum(axis=1, dtype=np.float64))
    own = sequences[:, 1:-1]
    exact = np.log(likelihood @ own) - np.log(likelihood @ (1 - own))
    np.testing.assert_allclose(slot_llr(metrics)[0], exact, atol=0.06)


@pytest.mark.parametrize("seed", range(4))
def test_words_agree_with_enumeration_of_all_slots(seed: int) -> None:
    """Of a word with two slots of the next one in view, through exposures of up to two slots."""
    n_slots = 12
    metrics = np.random.default_rng(seed).normal(0, 2.0, (1, n_slots + 1, 4)).astype(np.float32)
    sequences = np.array(list(product((0, 1), repeat=n_slots + 2)))
    total = metrics[0, np.arange(n_slots + 1), 2 * sequences[:, :-1] + sequences[:, 1:]].sum(axis=1, dtype=np.float64)
    words, _ = codewords()
    number = sequences[:, 1:11] @ (1 << np.arange(10))
    exact = np.log(np.bincount(number, np.exp(total))[words @ (1 << np.arange(10))])
    clock = Clock(5.0, 1.0, 20, 0.0, n_slots, 0, np.zeros(1, np.int64), np.zeros(1), 10.0)
    llr, odds = propagated(metrics)
    found = llr[0, :10] @ words.T + beyond_slots(word_metrics(metrics, llr, odds, clock))[0, 0, 0]
    # The slots of the next word come from three passes, which is nearly exact; a constant does not matter.
    np.testing.assert_allclose(found - found.mean(), exact - exact.mean(), atol=0.3)
    by_slot = llr[0, :10] @ words.T
    assert np.abs(by_slot - by_slot.mean() - exact + exact.mean()).max() > 1
