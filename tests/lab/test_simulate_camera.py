"""Optics, shutter and sensor of the simulator against closed forms."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.lab.simulate.camera import render_band
from rxcli.lab.simulate.capture import prepare
from rxcli.lab.simulate.isp import Isp, correction_map, develop, local_gain, tone_curve
from rxcli.lab.simulate.optics import Lens, Pose, View, distort, undistort
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.lab.simulate.sensor import Sensor, count_electrons, pick_colours, to_raw
from rxcli.lab.simulate.shutter import flicker, lit_share, slot_shares
from rxcli.lab.simulate.transmitter import light_spread
from rxcli.profiles import ScreenProfile, load_profile

COEFFICIENTS = [(-0.06, 0.02, 0.0005, -0.0003, 0.0), (0.07, -0.09, 0.0004, 0.0006, 0.01), (0.0, 0.0, 0.0, 0.0, 0.0)]


@pytest.fixture(scope="module")
def small() -> Scene:
    """A quick scene: tall enough for whole packets, narrow."""
    return preset("xs10-still", "paper-34k6").scaled(0.08, 0.25)


@pytest.mark.parametrize("coefficients", COEFFICIENTS)
def test_distortion_is_opencvs_and_its_inverse_is_exact(coefficients: tuple[float, ...]) -> None:
    import cv2

    rng = np.random.default_rng(1)
    ideal = rng.uniform(-0.6, 0.6, (500, 2))
    moved = distort(ideal, np.array(coefficients))
    np.testing.assert_allclose(undistort(moved, np.array(coefficients)), ideal, atol=1e-9)
    points = np.column_stack([ideal, np.ones(500)])
    theirs = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients))[0][:, 0]
    np.testing.assert_allclose(moved, theirs, atol=1e-12)


VIEWS = [Pose(0.8, roll, 8.0, -6.0, 0.02, -0.03) for roll in (0.0, 3.0, 180.0)]
VIEWS += [Pose(corners=((211.0, 300.5), (3800.0, 280.0), (3700.0, 2600.0), (250.0, 2500.0)))]


@pytest.mark.parametrize("pose", VIEWS)
def test_places_go_to_the_sensor_and_back(pose: Pose) -> None:
    view = View(load_profile("paper-34k6", ScreenProfile), Lens(0.8, COEFFICIENTS[1]), pose, 4000, 3000)
    places = np.random.default_rng(2).uniform(0, 1, (300, 2))
    np.testing.assert_allclose(view.pixels_to_screen(view.screen_to_pixels(places)), places, atol=1e-9)
    np.testing.assert_allclose(view.corners, pose.corners or view.corners, atol=1e-6)


def test_straight_view_has_the_size_that_was_asked() -> None:
    screen = load_profile("paper-34k6", ScreenProfile)
    view = View(screen, Lens(1.5), Pose(fill=0.9), 4000, 3000)
    np.testing.assert_allclose(view.corners[:, 0].min(), 1999.5 - 1800, atol=1e-6)
    assert (view.pixels_per_width, view.pixels_per_height) == pytest.approx((3600, 3600 / screen.aspect))


def brute_share(slots: NDArray[np.uint8], start: float, length: float) -> float:
    times = start + (np.arange(200_000) + 0.5) / 200_000 * length
    index = np.floor(times).astype(int)
    inside = (index >= 0) & (index < slots.size)
    return float(np.where(inside, slots[np.clip(index, 0, slots.size - 1)], 0).mean())


@pytest.mark.parametrize("length", [0.01, 0.25, 1.0, 1.08, 4.3])
def test_lit_share_is_the_integral_over_the_exposure(length: float) -> None:
    rng = np.random.default_rng(3)
    slots = rng.integers(0, 2, 40, dtype=np.uint8)
    starts = rng.uniform(-3, 41, 20)
    shares = lit_share(slots, starts, length)
    np.testing.assert_allclose(shares, [brute_share(slots, s, length) for s in starts], atol=3e-5)
    inside = (starts >= 0) & (starts + length <= 35)
    parts = slot_shares(starts[inside], length, np.arange(40.0))
    np.testing.assert_allclose(parts.sum(axis=1), 1.0)
    np.testing.assert_allclose(parts @ slots, shares[inside], atol=1e-12)


@pytest.mark.parametrize(("length", "decay"), [(0.5, 60.0), (4.3, 7.0), (1.0, 0.2)])
def test_lagging_light_decays_exponentially(length: float, decay: float) -> None:
    """Against Euler's method, and as the sum of what every slot adds."""
    slots = np.random.default_rng(4).integers(0, 2, 60, dtype=np.uint8)
    starts, fine = np.array([0.0, 0.7, 20.2, 54.9]), 2000
    light = [0.0]
    for step in range(60 * fine):
        light.append(light[-1] + (slots[step // fine] - light[-1]) / (decay * fine))
    begin, n = np.rint(starts * fine).astype(int), round(length * fine)
    means = [np.mean(light[b : b + n]) for b in begin]
    shares = lit_share(slots, starts, length, decay, 0.0)
    np.testing.assert_allclose(shares, means, atol=2e-3)
    np.testing.assert_allclose(slot_shares(starts, length, np.arange(60.0), decay) @ slots, shares, atol=1e-9)
    steady = lit_share(np.ones(60, np.uint8), starts, length, decay, 1.0)
    np.testing.assert_allclose(steady, 1.0)


def test_flicker_is_averaged_over_the_exposure() -> None:
    starts = np.linspace(0, 0.02, 50)
    times = starts[:, None] + np.linspace(0, 4e-3, 20001)
    expected = (1 + 0.4 * np.sin(2 * np.pi * 100 * times + 0.3)).mean(axis=1)
    np.testing.assert_allclose(flicker(starts, 4e-3, 100, 0.4, 0.3), expected, atol=1e-4)


@pytest.mark.parametrize("mean", [0.2, 20.0, 5000.0])
def test_noise_has_the_variance_of_its_parts(mean: float) -> None:
    sensor = Sensor(read_noise_e=2.0, row_noise_e=0.5)
    n = 400_000
    drawn = count_electrons(np.full((400, n // 400), mean, np.float32), sensor, np.random.default_rng(5))
    # Row noise moves whole rows: within rows shot and read noise are left.
    within = drawn.var(axis=1, ddof=1).mean()
    variance = mean + 4.0
    spread = np.sqrt(2 * variance**2 / n + mean / n)
    assert abs(within - variance) < 5 * spread
    assert abs(drawn.mean() - mean) < 5 * np.sqrt(variance / n + 0.25 / 400)
    rows = drawn.mean(axis=1).var(ddof=1) - variance / (n // 400)
    assert rows == pytest.approx(0.25, rel=0.4)


def test_red_that_lags_blinks_less_and_shines_as_long(small: Scene) -> None:
    sensor = replace(small.sensor, cfa="rgb", colour_mixing=0.0)
    scene = replace(small, picture="white", sensor=sensor, vignetting=0.0, red_lag_s=8e-3, start_slot=5000.0)
    plain, lagging = (prepare(replace(scene, red_lag_share=share), 1).exposure() for share in (0.0, 0.9))
    mean, lagged = (render_band(exposure, 256, 512).mean_e[:, 200:300].mean(axis=1) for exposure in (plain, lagging))
    np.testing.assert_allclose(lagged[:, 1:], mean[:, 1:], rtol=1e-5)
    assert lagged[:, 0].std() / lagged[:, 0].mean() < 0.2 * mean[:, 0].std() / mean[:, 0].mean()
    assert lagged[:, 0].mean() == pytest.approx(mean[:, 0].mean(), rel=0.1)


def test_glare_adds_a_share_of_the_whole_picture_at_the_same_instant(small: Scene) -> None:
    sensor = replace(small.sensor, cfa="rgb")
    scene = replace(small, picture="white", sensor=sensor, room=replace(small.room, light_e_per_s=0.0))
    exposures = [prepare(replace(scene, glare=glare), 1).exposure() for glare in (0.0, 0.1)]
    plain, glaring = (render_band(exposure, 0, sensor.height).mean_e for exposure in exposures)
    added = glaring - plain
    np.testing.assert_allclose(added, np.broadcast_to(added[:, :1], added.shape), atol=1e-3)
    assert added.mean() == pytest.approx(0.1 * plain.mean(), rel=0.05)
    assert np.corrcoef(added.mean(axis=(1, 2)), exposures[0].lit[0].mean(axis=1))[0, 1] > 0.95


def test_a_person_hides_the_screen_and_a_desk_mirrors_it(small: Scene) -> None:
    view = replace(small.pose, fill=0.5, roll_deg=0.0, yaw_deg=0.0, pitch_deg=0.0)
    base = replace(small, picture="white", pose=view, vignetting=0.0, lens=replace(small.lens, distortion=(0.0,) * 5))
    base = replace(base, sensor=replace(base.sensor, cfa="rgb"), room=replace(base.room, light_e_per_s=0.0))

    def light(place: tuple[float, float], **room: Any) -> float:
        exposure = prepare(replace(base, waveform=np.ones_like, room=replace(base.room, **room)), 1).exposure()
        x, y = np.rint(exposure.screen_to_pixels(np.array(place))).astype(int)
        return float(render_band(exposure, 0, base.sensor.height).mean_e[y, x, 1])

    person: dict[str, Any] = {"person": 0.4, "person_place": (0.3, 0.1)}
    assert light((0.3, 0.2), **person) < 0.01 * light((0.3, 0.2))
    assert light((0.3, 0.8), **person) < 0.01 * light((0.3, 0.8))
    assert light((0.8, 0.8), **person) == light((0.8, 0.8))
    assert light((0.5, 1.3), desk=0.25) == pytest.approx(0.25 * light((0.5, 0.82)), rel=0.02)
    assert light((0.5, 1.3)) < 0.01 * light((0.5, 0.82))


def test_rows_read_at_once_see_the_same_instant(small: Scene) -> None:
    scene = replace(small, sensor=replace(small.sensor, rows_at_once=2))
    (lit,) = prepare(scene, 1).exposure().lit
    np.testing.assert_array_equal(lit[::2], lit[1::2])
    np.testing.assert_array_equal(lit[::2], prepare(small, 1).exposure().lit[0][::2])


def test_raw_numbers_keep_black_and_white_level() -> None:
    sensor = Sensor(full_scale_e=100.0, black_level=512, white_level=4095)
    raw = to_raw(np.array([[-1e6, 0.0, 50.0, 1e6]], np.float32), sensor)
    assert raw.tolist() == [[0, 512, round(512 + 3583 / 2 + 1e-6), 4095]]


def test_rendered_light_is_the_model_written_out(small: Scene) -> None:
    """The banded, interpolated rendering against the plain sum over columns and segment rows, pixel by pixel."""
    lens = Lens(0.7, (0.2, -0.1, 0, 0, 0))
    scene = replace(small, picture="white", vignetting=0.0, lens=lens, pose=Pose(fill=0.9, roll_deg=0.4))
    exposure = prepare(scene, 1).exposure()
    band = render_band(exposure, 256, 512)
    y, x = np.mgrid[256:512:7, 0 : scene.sensor.width : 3]
    place = exposure.view.pixels_to_screen(np.stack([x, y], axis=-1).astype(float))
    screen = scene.screen
    own = (light_spread(place[..., 1], 8, screen.light_spread) @ exposure.drive.lit_light) * light_spread(
        place[..., 0], screen.columns, screen.light_spread
    )
    expected = (own * exposure.lit[0][y]).sum(axis=-1) * scene.light_e_per_s * scene.exposure_s
    inside = (np.abs(place - 0.5) < 0.5).all(axis=-1)
    error = band.backlights[0][::7, ::3][inside] - expected[inside]
    assert np.abs(error).max() < 0.01 * expected[inside].max()


def test_blur_keeps_the_pictures_light(small: Scene) -> None:
    sharp, soft = (
        prepare(replace(small, picture="checker", blur_px=blur), 1).exposure().textures[0][0][0].sum()
        for blur in (0.3, 2.5)
    )
    assert soft == pytest.approx(sharp, rel=1e-3)


def test_same_seed_same_pixels_whatever_threads_and_order(small: Scene) -> None:
    scene = replace(small, n_frames=3, hand_px=2.0)
    one, two = prepare(scene, 7).frame(threads=1), prepare(scene, 7).frame(threads=2)
    np.testing.assert_array_equal(one.raw, two.raw)
    assert (one.truth, one.jpeg) == (two.truth, two.jpeg)
    assert (prepare(scene, 8).frame().raw != one.raw).any()
    take = prepare(scene, 7)
    last = take.frame(2).raw
    np.testing.assert_array_equal(take.frame(0).raw, one.raw)
    np.testing.assert_array_equal(prepare(scene, 7).frame(2).raw, last)


def test_clock_error_and_frame_rate_move_the_start(small: Scene) -> None:
    scene = replace(small, n_frames=2, frame_rate_hz=50.0, start_slot=20.0, slot_rate_error_ppm=100.0)
    assert prepare(scene, 0).exposure(1).start_slot == pytest.approx(20 + 0.02 * 34600 * 1.0001)


def test_delays_move_columns_by_slots(small: Scene) -> None:
    rows = 7
    delay = rows * small.sensor.line_delay_s * small.screen.slot_rate_hz
    scene = replace(small, start_slot=40.0)
    plain = prepare(scene, 1).exposure()
    late = prepare(replace(scene, column_delay_slots=(delay,) + (0.0,) * 19), 1).exposure()
    np.testing.assert_allclose(late.lit[0][rows:, 0], plain.lit[0][:-rows, 0], atol=1e-9)
    np.testing.assert_allclose(plain.lit[0][:, 1:], late.lit[0][:, 1:], atol=1e-9)


def test_electrons_over_the_picture_have_the_expected_mean(small: Scene) -> None:
    scene = replace(small, sensor=replace(small.sensor, full_scale_e=2000.0), output="raw")
    take = prepare(scene, 4)
    raw, exposure = take.frame().raw, take.exposure()
    mean = np.concatenate([render_band(exposure, t, min(t + 256, 1040)).mean_e for t in range(0, 1040, 256)])
    read = (raw.astype(float) - scene.sensor.black_level) / scene.sensor.raw_per_e
    assert read.mean() == pytest.approx(mean.mean(), rel=0.01)
    variance = (mean + scene.sensor.read_noise_e**2 + scene.sensor.row_noise_e**2 + (0.008 * mean) ** 2).mean()
    assert (read - mean).var() == pytest.approx(variance, rel=0.03)


@pytest.mark.parametrize("cfa", ["bayer", "xtrans", "rgb"])
def test_development_gives_back_a_flat_picture(cfa: str) -> None:
    sensor = Sensor(96, 90, cfa=cfa, full_scale_e=1000.0)  # type: ignore[arg-type]
    light = np.full((90, 96, 3), 0.3 * 1000, np.float32) * np.array(sensor.response, np.float32)
    raw = to_raw(pick_colours(light, sensor.pattern, 0), sensor)
    view = View(load_profile("paper-34k6", ScreenProfile), Lens(), Pose(), 96, 90)
    rgb = develop(raw, sensor, Isp(tone="srgb", gain=1.5, sharpen=0.5), view)
    expected = 255 * (1.055 * 0.45 ** (1 / 2.4) - 0.055)
    assert np.abs(rgb.astype(float) - expected).max() < 1.01


@pytest.mark.parametrize(
    ("tone", "light", "value"), [("srgb", 0.2, 0.48453), ("bt709", 0.2, 0.43368), ("linear", 0.2, 0.2)]
)
def test_tone_curves_have_their_standard_values(tone: str, light: float, value: float) -> None:
    dark = 1e-3
    curve = tone_curve(np.array([[light, 0.0, 1.0, dark, 2.0]], np.float32), tone)[0]  # type: ignore[arg-type]
    toe = {"srgb": 12.92, "bt709": 4.5, "linear": 1.0}[tone]
    np.testing.assert_allclose(curve, [value, 0, 1, toe * dark, 1], atol=2e-5)


def test_correction_in_the_camera_undoes_the_lens() -> None:
    screen = load_profile("paper-34k6", ScreenProfile)
    view = View(screen, Lens(0.8, COEFFICIENTS[1]), Pose(), 800, 600)
    x, y = np.moveaxis(correction_map(view), -1, 0)
    places = np.stack([x[100, 200], y[100, 200]]).astype(float)
    ideal = view.pixels_to_ideal(places)
    matrix = view.camera_matrix
    np.testing.assert_allclose(ideal * matrix[[0, 1], [0, 1]] + matrix[:2, 2], [200, 100], atol=0.02)


@pytest.mark.parametrize("tone", ["srgb", "bt709", "gamma", "linear", "filmic"])
def test_tone_curves_rise_from_black_to_white(tone: Any) -> None:
    curve = tone_curve(np.linspace(0, 1, 500, dtype=np.float32), tone)
    assert (curve[0], curve[-1]) == pytest.approx((0, 1), abs=1e-5)
    assert (np.diff(curve) > 0).all()


def test_local_tone_mapping_raises_dark_places_and_keeps_their_stripes() -> None:
    planes = np.full((300, 400, 3), 0.6, np.float32)
    planes[:, 200:] = 0.03
    planes[::10] *= 0.5
    gain = local_gain(planes)
    assert 0.5 < gain[150, 100, 0] < 1 < 2 < gain[150, 300, 0] <= 3
    mapped = planes * gain
    assert mapped[150, 300, 0] / mapped[151, 300, 0] == pytest.approx(0.5, rel=0.02)
