"""Clock, bursts and delays of links whose every slot is known."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from made_stages import clock_of, profiles_of
from numpy.typing import NDArray
from row_profiles import REPEATS, Link, Shot, random_link, row_profiles, sigma_of

from rxcli.protocol import encode_packet
from rxcli.receiver import channel
from rxcli.receiver.decode import detect
from rxcli.receiver.frame.acquisition import noise_of
from rxcli.receiver.light import Crosstalk, Exposure, NoiseModel, dark_sigma
from rxcli.receiver.sync import clock as sync
from rxcli.types import BurstPosteriors, Clock, RowProfiles, SlotSamples

FloatArray = NDArray[np.float64]
Q = 4


def found_clock(profiles: RowProfiles, shot: Shot, packet_slots: int) -> Clock:
    found = sync.find_clock(profiles, shot.rows_per_slot, shot.exposure_slots, packet_slots, sigma_of(profiles))
    assert found is not None
    return found


def start_error(found: Clock, shot: Shot) -> float:
    """Lateness of the headers in slots, modulo a packet; the truth is that slot 0 of the link starts a packet."""
    header_row = found.row0 - found.first_slot * found.rows_per_slot
    slot = shot.start_slot + (header_row - shot.first_row) / shot.rows_per_slot
    half = found.packet_slots / 2
    return float((slot + half) % found.packet_slots - half)


def received(
    profiles: RowProfiles, shot: Shot, clock_: Clock, rounds: int = 2
) -> tuple[Clock, BurstPosteriors, SlotSamples]:
    """Light model and detection in turn, the clock corrected after each."""
    samples = sync.sample_slots(profiles, clock_, Q)
    floor = channel.estimate_black_level(samples, clock_) or 0.0
    model = channel.ObservationModel(
        black_level=floor,
        noise=NoiseModel(dark_sigma(samples.light, samples.valid, floor, 1e-4) ** 2, 0.0),
        crosstalk=Crosstalk(np.tile([shot.crosstalk, 1.0, shot.crosstalk], (shot.n_strips, 1))),
        exposure=Exposure.of(shot.exposure_slots, Q),
    )
    contrast = sync.contrast(samples.light, samples.valid, Q, model.noise.sigma)
    llr = channel.initial_llr(*contrast, model.exposure)
    clock_ = sync.possible_bursts(clock_, llr, (REPEATS,))[0][0]
    for _ in range(rounds):
        posteriors = detect.detect(clock_.by_burst(llr))
        lit = clock_.on_grid(posteriors.lit)
        found = channel.slot_likelihoods(samples, clock_, model, lit, np.arange(lit.shape[0]), is_initial=True)
        llr = found.llr
        clock_ = sync.corrected(sync.possible_bursts(clock_, llr, (REPEATS,))[0][0], found.timing)
        samples = sync.sample_slots(profiles, clock_, Q)
    posteriors = detect.detect(clock_.by_burst(llr))
    return clock_, posteriors, samples


def right_packets(posteriors: BurstPosteriors, link: Link, first_burst: int) -> NDArray[np.bool_]:
    """(B, C) whether the packets of bursts `first_burst` on were detected without a wrong slot."""
    return np.array(
        [
            [
                (posteriors.lit[b, c].round() == encode_packet(bits, link.w[c])).all()
                for c, bits in enumerate(link.bits[first_burst + b])
            ]
            for b in range(posteriors.lit.shape[0])
        ]
    )


SHOTS = {
    "plain": Shot(),
    "textured": Shot(texture=0.4, sigma=0.01),
    "long exposure": Shot(exposure_slots=2.2, sigma=0.005),
    "short exposure": Shot(exposure_slots=0.3),
    "few rows": Shot(rows_per_slot=2.3, n_rows=330, sigma=0.01),
    "many rows": Shot(rows_per_slot=21.7, n_rows=3000, sigma=0.02),
    "crosstalk": Shot(crosstalk=0.1, texture=0.2, sigma=0.005),
}


@pytest.mark.parametrize("kind", SHOTS)
def test_start_is_found(kind: str) -> None:
    """Within 0.05 slot once the light model has had its say, and every packet in the frame is right."""
    rng = np.random.default_rng(1)
    link = random_link(rng, [5, 3, 7, 5, 4, 5, 6, 2, 5, 8], 5, n_bursts=2)
    shot = replace(SHOTS[kind], start_slot=12.37, first_row=31)
    profiles = row_profiles(link, shot, rng)
    first = found_clock(profiles, shot, link.packet_slots)
    assert abs(start_error(first, shot)) < 0.3
    clock_, posteriors, _ = received(profiles, shot, first)
    assert abs(start_error(clock_, shot)) < 0.05
    assert first.header_peak_ratio > 1.6
    assert (posteriors.w == link.w).all()
    assert right_packets(posteriors, link, 0)[0].all()


@pytest.mark.parametrize("phase", range(6))
def test_copies_are_given_to_their_bursts(phase: int) -> None:
    """Frames of 3.4 packets that begin with the 1st, 2nd, 3rd copy of a burst, at its start or within."""
    rng = np.random.default_rng(phase)
    link = random_link(rng, [5] * 8, 5)
    start = 70 * (phase % 3) + (35.0 if phase >= 3 else 2.0)
    shot = Shot(start_slot=start, n_rows=int(3.4 * 70 * 5), texture=0.2, sigma=0.005)
    profiles = row_profiles(link, shot, rng)
    clock_, posteriors, _ = received(profiles, shot, found_clock(profiles, shot, 70))
    first_copy = int((start + clock_.first_slot * 0) // 70)
    grid_copy = round((shot.start_slot + (clock_.row0 / 5.0)) // 70)
    true_burst = (grid_copy + np.arange(clock_.n_copies)) // REPEATS
    assert grid_copy in {first_copy, first_copy - 1}
    assert (clock_.burst == true_burst - true_burst[0]).all()
    shown = np.bincount(clock_.burst, minlength=2) >= 2
    assert right_packets(posteriors, link, int(true_burst[0]))[np.flatnonzero(shown)].all()


@pytest.mark.parametrize("seed", range(5))
def test_rows_without_light_hold_no_header(seed: int) -> None:
    """A window on a dark desktop: most rows show row noise alone, which the spread of their pixels does not tell."""
    rng = np.random.default_rng([seed, 3])
    link = random_link(rng, [7] * 20, 5)
    shot = Shot(start_slot=20.0, n_rows=1200, sigma=1e-5)
    profiles = row_profiles(link, shot, rng)
    row = np.arange(shot.n_rows)
    light = np.where((row > 250) & (row < 640), profiles.light, np.float32(shot.ambient))
    light += rng.normal(0, 1e-3, shot.n_rows).astype(np.float32)
    found = found_clock(replace(profiles, light=light), shot, link.packet_slots)
    assert abs(start_error(found, shot)) < 0.3
    assert not found.delay_slots.any()


@pytest.mark.parametrize("same", [True, False])
def test_slots_without_light_neither_join_nor_separate_copies(same: bool) -> None:
    rng = np.random.default_rng(2)
    sent = rng.random((2, 20, 150)) < 0.8
    first, second = np.where(sent, 5.0, -5.0)[[0, 0 if same else 1]]
    whole = sync.similarity(first, second)
    second[:, 60:] = rng.normal(0, 0.2, second[:, 60:].shape)  # the screen is dark there
    part, lit = sync.similarity(first, second), sync.similarity(first[:, :60], second[:, :60])
    assert (whole > 100) == same
    assert (part > 30) == same
    assert abs(part - lit) < 5
    assert abs(sync.similarity(first, rng.normal(0, 0.2, first.shape))) < abs(lit) / 4


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("reach", [0.5, 2.0])
def test_delays_of_up_to_two_slots_are_found(seed: int, reach: float) -> None:
    rng = np.random.default_rng([seed, 77])
    link = random_link(rng, [5] * 20, 5, n_bursts=2)
    delays = rng.uniform(-reach, reach, 20)
    shot = Shot(start_slot=9.6 + seed, n_rows=800, texture=0.2, sigma=0.005)
    profiles = row_profiles(link, shot, rng, delays)
    clock_, posteriors, _ = received(profiles, shot, found_clock(profiles, shot, 70), rounds=4)
    off = clock_.delay_slots + start_error(clock_, shot) - delays
    assert np.abs(off).max() < 0.1
    assert right_packets(posteriors, link, 0)[0].mean() >= 0.95


def test_noise_and_still_light_do_not_lock_like_a_link() -> None:
    acquisitions = {}
    for level in (0.0, 0.5):
        found = []
        for seed in range(25):
            rng = np.random.default_rng([seed, 5])
            shot = Shot(start_slot=20.0, level=level, sigma=0.01, texture=0.2)
            profiles = row_profiles(random_link(rng, [5] * 20, 5), shot, rng)
            clock_ = sync.find_clock(profiles, 5.0, 1.0, 70, 0.01)
            found.append(clock_.header_peak_ratio if clock_ else 0.0)
        acquisitions[level] = np.array(found)
    assert np.median(acquisitions[0.0]) < 1.6
    assert acquisitions[0.5].min() > np.quantile(acquisitions[0.0], 0.9)
    assert np.median(acquisitions[0.5]) > 3.5


@pytest.mark.parametrize("start", [0.3, 41.0, 66.0])
def test_one_packet_and_a_little_is_enough(start: float) -> None:
    rng = np.random.default_rng(4)
    link = random_link(rng, [5] * 12, 5)
    shot = Shot(start_slot=start, n_rows=int(5 * 70 * 1.2), texture=0.1, sigma=0.005)
    profiles = row_profiles(link, shot, rng)
    clock_, posteriors, _ = received(profiles, shot, found_clock(profiles, shot, 70))
    assert abs(start_error(clock_, shot)) < (0.15 if start == 0.3 else 0.05)  # at 0.3 the first header is cut
    n_bursts = posteriors.lit.shape[0]
    sent = replace(link, bits=[link.bits[0]] * n_bursts)  # a sliver of the copy before may count as a burst
    assert right_packets(posteriors, sent, 0).any(axis=0).mean() > 0.9


def test_bursts_in_every_way_likeliest_first() -> None:
    rng = np.random.default_rng(4)
    shot = Shot(n_rows=5 * 70 * 4)
    clock_ = found_clock(row_profiles(random_link(rng, [5] * 3, 5), shot, rng), shot, 70)
    clock_ = replace(clock_, first_slot=0, n_slots=350, burst=np.zeros(5, np.int64))
    sent = rng.choice([-4.0, 4.0], (2, 3, 70)).astype(np.float32)
    llr = np.concatenate([sent[0], sent[0], sent[1], sent[1], sent[1]], axis=1)
    possible = sync.possible_bursts(clock_, llr, (REPEATS,))
    assert possible[0][0].burst.tolist() == [0, 0, 1, 1, 1]
    assert sorted(one.burst.tolist() for one, _ in possible) == [[0, 0, 0, 1, 1], [0, 0, 1, 1, 1], [0, 1, 1, 1, 2]]
    scores = [score for _, score in possible]
    assert scores == sorted(scores, reverse=True)
    assert scores[0] - scores[1] > 100
    assert possible[0][0].burst.tolist() == [0, 0, 1, 1, 1]
    alone = replace(clock_, n_slots=70, burst=np.zeros(1, np.int64))
    assert len(sync.possible_bursts(alone, llr[:, :70], (REPEATS,))) == 1
    # Where nothing tells, priors do: of two copies 2 in 3 are one packet if it is sent three times, 0 if once.
    pair = replace(clock_, n_slots=140, burst=np.zeros(2, np.int64))
    unknown = sync.possible_bursts(pair, np.zeros((3, 140), np.float32), (3, 1))
    assert [one.burst.tolist() for one, _ in unknown] == [[0, 1], [0, 0]]
    assert np.exp([score for _, score in unknown]) == pytest.approx([2 / 3, 1 / 3])


@pytest.mark.parametrize("n_rows", [1, 5, 30])
def test_too_few_rows_for_a_header(n_rows: int) -> None:
    rng = np.random.default_rng(4)
    shot = Shot(n_rows=n_rows)
    profiles = row_profiles(random_link(rng, [5] * 3, 5), shot, rng)
    assert sync.find_clock(profiles, 5.0, 1.0, 70, 0.01) is None


@pytest.mark.parametrize("kind", ["zeros", "constant", "one lit row", "nothing inside"])
def test_light_without_a_link(kind: str) -> None:
    rng = np.random.default_rng(4)
    profiles = row_profiles(random_link(rng, [5] * 3, 5), Shot(), rng)
    light = np.full_like(profiles.light, 0.0 if kind == "zeros" else 0.5)
    if kind == "one lit row":
        light[..., 300] = 1.0
    inside = np.zeros_like(profiles.inside) if kind == "nothing inside" else profiles.inside
    found = sync.find_clock(replace(profiles, light=light, inside=inside), 5.0, 1.0, 70, 1e-3)
    assert found is None or (
        np.isfinite([found.row0, found.header_peak_ratio]).all() and np.isfinite(found.delay_slots).all()
    )


def test_resample_integrates_exactly() -> None:
    """Row r covers r - 0.5 .. r + 0.5; a sample is the mean of what it covers."""
    rng = np.random.default_rng(0)
    profiles = row_profiles(random_link(rng, [5] * 2, 5), Shot(n_rows=50, n_strips=3, first_row=100), rng)
    step, row0 = 2.37, 101.3
    light, valid = sync.resample(profiles, row0, step, 19)
    fine = np.arange(100_000) / 2000  # positions from the top of row 100
    row = fine.astype(int)
    for i in range(19):
        low, high = row0 - 99.5 + i * step, row0 - 99.5 + (i + 1) * step
        if high <= 50:
            covered = (fine >= low) & (fine < high)
            expected = profiles.light[:, :, row[covered]].mean(axis=2)
            np.testing.assert_allclose(light[:, :, i], expected, atol=2e-3)
            assert (valid[:, :, i] == 1).all()
    beyond, invalid = sync.resample(profiles, 140.0, step, 10)
    assert (beyond[:, :, -1] == 0).all()
    assert (invalid[:, :, -1] == 0).all()


def test_resample_follows_the_sensor_rows() -> None:
    """Strips whose picture rows lie elsewhere on the sensor give the same samples as rows in place."""
    rng = np.random.default_rng(0)
    profiles = row_profiles(random_link(rng, [5] * 2, 5), Shot(n_rows=300), rng)
    moved = np.broadcast_to(np.arange(300.0), profiles.light.shape) + np.array([0.0, 17.0])[:, None, None]
    bent = replace(profiles, sensor_row=moved.copy())
    straight, _ = sync.resample(profiles, 20.0, 1.25, 100)
    followed, _ = sync.resample(bent, 20.0, 1.25, 100)
    np.testing.assert_allclose(followed[0], straight[0], atol=1e-6)
    later, _ = sync.resample(bent, 37.0, 1.25, 100)
    np.testing.assert_allclose(later[1], straight[1], atol=1e-6)


def test_copies_and_back() -> None:
    clock_ = clock_of(2, n_slots=180, first_slot=33, burst=np.arange(4))
    slots = np.random.default_rng(0).random((2, 180)).astype(np.float32)
    copies = clock_.to_copies(slots)
    assert copies.shape == (2, 4, 70)
    assert (copies[:, 0, :33] == 0).all()
    assert (copies[:, 0, 33] == slots[:, 0]).all()
    assert (copies[:, 1, 0] == slots[:, 37]).all()
    assert (clock_.on_grid(np.moveaxis(copies, 1, 0)) == slots).all()


@pytest.mark.parametrize(("n_strips", "n_binned"), [(2, 1), (3, 3), (4, 2), (8, 4)])
def test_binned_strips_keep_the_light(n_strips: int, n_binned: int) -> None:
    rng = np.random.default_rng(0)
    profiles = row_profiles(random_link(rng, [5] * 2, 5), Shot(n_rows=60, n_strips=n_strips), rng)
    binned = sync.binned_strips(profiles)
    together = n_strips // n_binned
    assert binned.light.shape == (2, n_binned, 60)
    np.testing.assert_allclose(binned.light[:, -1], profiles.light[:, -together:].mean(axis=1), rtol=1e-5)
    np.testing.assert_allclose(binned.count, together)


@pytest.mark.parametrize("n", [168, 170])
def test_columns_that_start_at_their_own_rows_are_resampled_as_each_by_itself(n: int) -> None:
    rng = np.random.default_rng(5)
    rows = np.arange(200.0) + 6e-4 * (np.arange(200.0) - 90) ** 2 + rng.uniform(-0.2, 0.2, (3, 2, 1))
    profiles = profiles_of(rng.random((3, 2, 200), dtype=np.float32), sensor_row=rows)
    row0 = np.array([12.0, 13.7, 9.2])
    light, valid = sync.resample(profiles, row0, 1.3, n)
    for column, start in enumerate(row0):
        one = replace(
            profiles,
            light=profiles.light[column : column + 1],
            inside=profiles.inside[:1],
            sensor_row=rows[column][None],
        )
        alone, shown = sync.resample(one, float(start), 1.3, n)
        np.testing.assert_allclose(light[column], alone[0], atol=1e-6)
        np.testing.assert_array_equal(valid[column], shown[0])
        # The mean over each sample of light that is constant over a row, row by row.
        borders = np.interp(start + 1.3 * np.arange(n + 1), rows[column, 0], np.arange(200) + 0.5, left=0, right=200)
        fine = np.array(
            [
                profiles.light[column, 0][np.minimum(np.linspace(a, b, 400, endpoint=False), 199).astype(int)].mean()
                for a, b in pairwise(borders)
            ]
        )
        shown_well = valid[column, 0] > 0
        np.testing.assert_allclose(light[column, 0][shown_well], fine[shown_well], atol=0.02)


def test_a_dark_row_of_a_clipped_picture_has_noise() -> None:
    rng = np.random.default_rng(1)
    profiles = row_profiles(random_link(rng, [5] * 4, 5), Shot(), rng)
    assert noise_of(replace(profiles, noise_floor=0.0)) == pytest.approx(1e-7**0.5)


@pytest.mark.parametrize("exposure_slots", [2.5, 3.5, 5.0, 8.0])
def test_headers_are_found_through_long_exposures(exposure_slots: float) -> None:
    rng = np.random.default_rng(44)
    link = random_link(rng, rng.integers(3, 8, 20).tolist(), 5)
    shot = Shot(rows_per_slot=7.3, exposure_slots=exposure_slots, n_rows=1000, texture=0.4, start_slot=133.0)
    found = found_clock(row_profiles(link, shot, rng), shot, link.packet_slots)
    assert abs(start_error(found, shot)) < 0.3
    assert found.header_peak_ratio > 1.3
    assert not found.delay_slots.any()
