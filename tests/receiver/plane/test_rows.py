"""Row profiles against means computed by hand, and the noise model against noise of known size."""

from dataclasses import replace

import numpy as np
import pytest
from ingest_files import BAYER, XTRANS
from numpy.typing import NDArray

from rxcli.receiver.plane.read import read_plane
from rxcli.receiver.plane.rows import sample_rows as sample_plane
from rxcli.receiver.plane.rows import strips_per_column, tone_to_light
from rxcli.types import Frame, Mosaic, Outlines, RowProfiles

FloatArray = NDArray[np.float64]


def sample_rows(frame: Frame, where: Outlines, tone: str) -> RowProfiles:
    return sample_plane(read_plane(frame), where, tone)


def outlines(edges: FloatArray, n_columns: int, first_row: int = 0) -> Outlines:
    """Outlines from the strips' edges (C*S + 1, R), everything on the screen."""
    n_rows = edges.shape[1]
    inside = np.ones((n_columns, (edges.shape[0] - 1) // n_columns, n_rows), bool)
    return Outlines(np.arange(first_row, first_row + n_rows), edges.astype(np.float32), inside, None)


def slanted(n_edges: int, n_rows: int, left: float, pitch: float, slope: float) -> FloatArray:
    return left + pitch * np.arange(n_edges)[:, None] + slope * np.arange(n_rows)


def linear16(light: FloatArray) -> Frame:
    """A linear picture of 16 bits."""
    return Frame(np.round(light * 65535).astype(np.uint16), "memory", white=65535.0, linear=True)


@pytest.mark.parametrize("slope", [0.0, 0.21, -0.37])
@pytest.mark.parametrize("pitch", [2.0, 7.3, 40.5])
def test_a_constant_picture_has_that_light_everywhere(pitch: float, slope: float) -> None:
    frame = linear16(np.full((150, 400), 0.4))
    edges = slanted(9, 150, 60.0, pitch, slope)
    found = sample_rows(frame, outlines(edges, 4), "srgb")
    np.testing.assert_allclose(found.light, 0.4, rtol=1e-4)
    np.testing.assert_allclose(found.count, pitch, rtol=0.02)
    assert found.light.shape == (4, 2, 150)


@pytest.mark.parametrize("slope", [0.0, 0.21, -0.37])
def test_light_that_changes_along_the_rows_only_is_exact(slope: float) -> None:
    """More rows than are read at a time, so that the seams between bands are seen."""
    coded = np.random.default_rng(0).integers(30, 256, 300).astype(np.uint8)
    frame = Frame(np.repeat(coded[:, None], 500, axis=1), "memory")
    edges = slanted(7, 250, 120.0, 31.0, slope)
    found = sample_rows(frame, outlines(edges, 3, first_row=20), "srgb")
    light = tone_to_light("srgb", coded[20:270] / 255)
    assert found.rows.tolist() == list(range(20, 270))
    np.testing.assert_allclose(found.light, np.broadcast_to(light, found.light.shape), rtol=2e-4, atol=2e-5)


@pytest.mark.parametrize("slope", [0.0, 0.3])
@pytest.mark.parametrize("pitch", [6.0, 25.0, 64.0])
def test_a_ramp_across_has_the_light_of_each_strips_middle(pitch: float, slope: float) -> None:
    """Cells of a quarter strip at most: a partial cell at each edge errs by an eighth of its own change at most."""
    per_px = 0.8 / 699
    frame = linear16(np.repeat(0.1 + per_px * np.arange(700.0)[None], 120, axis=0))
    edges = slanted(9, 120, 40.0, pitch, slope)
    found = sample_rows(frame, outlines(edges, 4), "linear").light.reshape(8, 120)
    expected = 0.1 + per_px * (edges[1:] + edges[:-1]) / 2
    cell = max(pitch / 4, 1.0)
    worst = 2 * per_px * cell**2 / 8 / pitch
    np.testing.assert_allclose(found, expected, rtol=0, atol=worst + 2e-5)


def test_edges_that_run_to_the_left_mean_the_same() -> None:
    """A screen held upside down: column 0 lies on the right."""
    frame = linear16(np.random.default_rng(1).random((90, 300)))
    edges = slanted(7, 90, 50.0, 30.0, 0.1)
    forth = sample_rows(frame, outlines(edges, 3), "linear").light.reshape(6, 90)
    back = sample_rows(frame, outlines(edges[::-1], 3), "linear").light.reshape(6, 90)
    np.testing.assert_allclose(forth, back[::-1], rtol=1e-4)


def test_rows_outside_the_screen_are_zero() -> None:
    frame = linear16(np.full((40, 100), 0.5))
    where = outlines(slanted(3, 40, 10.0, 30.0, 0.0), 2)
    inside = where.inside.copy()
    inside[1, 0, 7:] = False
    light = sample_rows(frame, replace(where, inside=inside), "linear").light
    assert (light[1, 0, 7:] == 0).all()
    assert (light[inside] > 0).all()


def test_the_frame_is_not_changed() -> None:
    frame = linear16(np.random.default_rng(2).random((70, 90)))
    before = frame.pixels.copy()
    sample_rows(frame, outlines(slanted(3, 70, 10.0, 30.0, 0.0), 2), "linear")
    assert (frame.pixels == before).all()


def encode(tone: str, light: FloatArray) -> FloatArray:
    """IEC 61966-2-1 and ITU-R BT.709-6 in the camera's direction."""
    if tone == "linear":
        return light
    if tone == "srgb":
        return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.where(light < 0.018, 4.5 * light, 1.099 * light**0.45 - 0.099)


@pytest.mark.parametrize("tone", ["linear", "srgb", "bt709"])
def test_tone_curves_are_undone(tone: str) -> None:
    light = np.linspace(0, 1, 5001)
    found = tone_to_light(tone, encode(tone, light))
    np.testing.assert_allclose(found, light, atol=3e-4)
    # BT.709's rounded constants leave a step of 5e-5 where its two parts meet.
    assert (np.diff(tone_to_light(tone, np.linspace(0, 1, 5001))) > -1e-4).all()
    assert tone_to_light(tone, np.array([0.0, 1.0])).tolist() == pytest.approx([0.0, 1.0])


def test_unknown_tone() -> None:
    with pytest.raises(ValueError, match=r"tone must be linear, srgb or bt709 \(got 'gamma'\)"):
        tone_to_light("gamma", np.zeros(1))


@pytest.mark.parametrize("tone", ["linear", "srgb", "bt709"])
@pytest.mark.parametrize(
    ("dtype", "black", "white"),
    [(np.uint8, 0.0, 255.0), (np.uint8, 16.0, 235.0), (np.uint16, 0.0, 65535.0), (np.uint16, 64.0, 940.0)],
)
def test_levels_of_developed_pictures(dtype: type, black: float, white: float, tone: str) -> None:
    value = round(black + 0.6 * (white - black))
    frame = Frame(np.full((30, 80), value, dtype), "memory", black=black, white=white)
    found = sample_rows(frame, outlines(slanted(3, 30, 10.0, 30.0, 0.1), 2), tone)
    share = (value - black) / (white - black)
    expected = float(tone_to_light(tone, np.array([share]))[0])
    np.testing.assert_allclose(found.light, expected, rtol=1e-4)


@pytest.mark.parametrize("value", [0, 3, 250, 255])
def test_values_beyond_limited_range_are_clipped(value: int) -> None:
    frame = Frame(np.full((30, 80), value, np.uint8), "memory", black=16.0, white=235.0)
    found = sample_rows(frame, outlines(slanted(3, 30, 10.0, 30.0, 0.1), 2), "srgb")
    np.testing.assert_allclose(found.light, 1.0 if value > 200 else 0.0)


def test_light_of_a_textured_strip_changes_as_that_of_its_pixels() -> None:
    """The strip's own light is another, its rows' light against one another is the same within a thousandth or two."""
    rng = np.random.default_rng(2)
    exposure = rng.uniform(0.3, 1.0, 120)
    light = rng.uniform(0.1, 0.9, 400)[None] * exposure[:, None]
    coded = 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    frame = Frame(np.round(coded).astype(np.uint8), "memory")
    found = sample_rows(frame, outlines(slanted(5, 120, 19.5, 80.0, 0.0), 2), "srgb").light.reshape(4, 120)
    share = found / light[:, 20:340].reshape(120, 4, 80).mean(axis=2).T
    assert 0.85 < share.min() < share.max() < 0.98
    np.testing.assert_allclose(share, np.broadcast_to(share.mean(axis=1, keepdims=True), share.shape), rtol=0.002)


def mosaic_of(pattern: NDArray[np.uint8], gains: tuple[float, float, float]) -> Mosaic:
    return Mosaic(pattern, gains, black=(1000.0, 1010.0, 990.0), white=15000.0)


def mosaic_frame(light: FloatArray, colour: tuple[float, float, float], mosaic: Mosaic) -> Frame:
    """Raw numbers of a surface of one `colour` (red, green, blue on the sensor) under `light` (H, W)."""
    height, width = light.shape
    kind = np.tile(mosaic.pattern, (height, width))[:height, :width]
    black, share = np.array(mosaic.black)[kind], np.array(colour)[kind]
    raw = black + light * share * (mosaic.white - 1000.0)
    return Frame(np.round(raw).astype(np.uint16), "memory", mosaic=mosaic)


@pytest.mark.parametrize("first_row", [0, 1, 5])
@pytest.mark.parametrize("pattern", [BAYER, XTRANS, XTRANS.T, np.roll(BAYER, 1, 0)], ids=["bayer", "x", "x.T", "gbrg"])
def test_uniform_colour_has_the_same_light_on_all_rows(pattern: NDArray[np.uint8], first_row: int) -> None:
    """Rows hold different colours; all of them must measure the same mix, at the picture's border too."""
    frame = mosaic_frame(np.full((131, 241), 0.8), (0.31, 0.97, 0.52), mosaic_of(pattern, (2.1, 1.0, 1.6)))
    edges = slanted(5, 131 - first_row, 20.0, 40.0, 0.13)
    light = sample_rows(frame, outlines(edges, 2, first_row), "srgb").light
    assert 0.2 < light[0, 0, 0] < 0.8
    np.testing.assert_allclose(light, light[0, 0, 0], rtol=1e-3)


@pytest.mark.parametrize("pattern", [BAYER, XTRANS], ids=["bayer", "xtrans"])
def test_a_mosaic_is_proportional_to_light(pattern: NDArray[np.uint8]) -> None:
    mosaic = mosaic_of(pattern, (2.0, 1.0, 1.5))
    where = outlines(slanted(5, 60, 20.0, 40.0, 0.0), 2)
    grey = (0.5, 1.0, 1 / 1.5)
    levels = [
        float(sample_rows(mosaic_frame(np.full((60, 240), x), grey, mosaic), where, "srgb").light.mean())
        for x in (0.0, 0.25, 0.5, 1.0)
    ]
    assert levels[0] == pytest.approx(0.0, abs=1e-4)
    np.testing.assert_allclose(np.array(levels[1:]) / levels[3], [0.25, 0.5, 1.0], rtol=1e-3)


@pytest.mark.parametrize(("pattern", "mixed"), [(XTRANS, []), (BAYER, [29, 31])], ids=["xtrans", "bayer"])
def test_bayer_mixes_adjacent_rows_alone(pattern: NDArray[np.uint8], mixed: list[int]) -> None:
    """Every row of X-Trans holds all colours: no row is mixed with its neighbours."""
    light = np.full((60, 240), 0.1)
    light[30] = 0.9
    frame = mosaic_frame(light, (0.5, 1.0, 0.7), mosaic_of(pattern, (2.0, 1.0, 1.4)))
    found = sample_rows(frame, outlines(slanted(3, 60, 20.0, 90.0, 0.0), 2), "srgb").light[0, 0]
    found = found / found[0]
    np.testing.assert_allclose(found[np.setdiff1d([27, 28, 29, 31, 32, 33], mixed)], 1, rtol=2e-3)
    assert found[30] > found[29:32:2].max() > 1.5 if mixed else found[30] == pytest.approx(9, rel=2e-3)


def noisy_steps(floor: float, slope: float, seed: int) -> tuple[Frame, Outlines]:
    """Bands of eighty rows of different light, each pixel with variance floor + slope * light."""
    rng = np.random.default_rng(seed)
    light = np.repeat(np.repeat([0.03, 0.06, 0.2, 0.5, 0.8], 80)[:, None], 4800, axis=1)
    light = light + rng.normal(0, 1, light.shape) * np.sqrt(floor + slope * light)
    return linear16(np.maximum(light, 0)), outlines(slanted(9, 400, -0.5, 600.0, 0.0), 4)


@pytest.mark.parametrize(("floor", "slope"), [(1e-4, 0.0), (1e-5, 1e-3), (2e-5, 2e-4)])
def test_noise_model_finds_the_variance(floor: float, slope: float) -> None:
    frame, where = noisy_steps(floor, slope, seed=5)
    found = sample_rows(frame, where, "linear")
    measured = found.light.reshape(8, 5, 80).var(axis=2).mean(axis=0)
    modelled = found.variance().reshape(8, 5, 80).mean(axis=(0, 2))
    np.testing.assert_allclose(modelled, measured, rtol=0.35)


def test_noise_model_of_a_clean_picture_is_small() -> None:
    frame = linear16(np.full((200, 400), 0.5))
    found = sample_rows(frame, outlines(slanted(9, 200, 20.0, 40.0, 0.0), 4), "linear")
    assert 0 < found.noise_floor < 1e-6
    assert found.noise_slope >= 0


def hostile(kind: str) -> NDArray[np.uint8]:
    rng = np.random.default_rng(0)
    if kind == "noise":
        return rng.integers(0, 256, (64, 90), dtype=np.uint8)
    pixels = np.full((64, 90), 255 if kind == "saturated" else 0, np.uint8)
    if kind == "one lit pixel":
        pixels[30, 40] = 255
    return pixels


def check_sound(found: RowProfiles) -> None:
    assert np.isfinite(found.light).all()
    assert np.isfinite(found.count).all()
    assert np.isfinite(found.variance()).all()
    assert (found.light >= -1e-6).all()
    assert (found.light <= 1.0 + 1e-6).all()
    assert found.noise_floor > 0
    assert found.noise_slope >= 0


@pytest.mark.parametrize("kind", ["black", "saturated", "noise", "one lit pixel"])
@pytest.mark.parametrize("n_rows", [1, 2, 64])
@pytest.mark.parametrize("pitch", [0.5, 2.0, 20.0])
def test_tiny_screens_and_hostile_pictures(kind: str, n_rows: int, pitch: float) -> None:
    frame = Frame(hostile(kind), "memory")
    found = sample_rows(frame, outlines(slanted(5, n_rows, 3.0, pitch, 0.0), 4), "srgb")
    assert found.light.shape == (4, 1, n_rows)
    check_sound(found)


@pytest.mark.parametrize("pattern", [BAYER, XTRANS], ids=["bayer", "xtrans"])
@pytest.mark.parametrize("shape", [(1, 12), (2, 13), (7, 6)])
def test_tiny_mosaics(pattern: NDArray[np.uint8], shape: tuple[int, int]) -> None:
    frame = mosaic_frame(np.full(shape, 0.5), (0.5, 1.0, 0.7), mosaic_of(pattern, (2.0, 1.0, 1.4)))
    check_sound(sample_rows(frame, outlines(slanted(4, shape[0], -0.5, shape[1] / 3, 0.0), 3), "srgb"))


@pytest.mark.parametrize("left", [-70.0, 60.0, 500.0])
def test_strips_beyond_the_picture_give_no_light(left: float) -> None:
    """Edges partly or wholly outside: what lies inside is averaged, the rest is nothing."""
    frame = linear16(np.full((50, 100), 0.5))
    found = sample_rows(frame, outlines(slanted(5, 50, left, 30.0, 0.0), 4), "linear")
    check_sound(found)
    seen = found.light[:, 0, 0] > 0
    assert seen.sum() == {-70.0: 2, 60.0: 2, 500.0: 0}[left]
    np.testing.assert_allclose(found.light[seen], 0.5, rtol=1e-3)


def test_strips_grow_with_the_column() -> None:
    widths = [1.0, 12.0, 30.0, 60.0, 100.0, 300.0, 5000.0]
    strips = [strips_per_column(width) for width in widths]
    assert strips[0] == 1
    assert strips == sorted(strips)
    assert all(count == 1 or width / count >= 8 for width, count in zip(widths, strips, strict=True))
