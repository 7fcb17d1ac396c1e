"""Line delay from blinking lamps: waveforms, regions, several lamps, refusals, intervals that hold."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rxcli.calibrate.frames import frame_light
from rxcli.calibrate.periodic import fit_fundamental, fit_periodic
from rxcli.calibrate.saving import profile_to_extend, with_mode, write_profile
from rxcli.calibrate.shutter import calibrate_shutter, find_stripes
from rxcli.cli.main import run
from rxcli.errors import ExitCode, ProfileError, ReceiverError, UsageError
from rxcli.profiles import CameraProfile, ReadoutMode, load_profile
from rxcli.types import Frame, Metadata, Mosaic

LINE_DELAY_S = 20e-6


def lamp(frequency_hz: float, n_rows: int, exposure_s: float, duty: float | None = 0.5, phase: float = 0.3) -> Any:
    """(n_rows,) light of a lamp, averaged over each row's exposure exactly; a sine where `duty` is None."""
    start = np.arange(n_rows) * LINE_DELAY_S
    if duty is None:
        depth = np.sinc(frequency_hz * exposure_s)
        return 0.5 + 0.5 * depth * np.sin(2 * np.pi * (frequency_hz * (start + exposure_s / 2) + phase))

    def lit_until(t: Any) -> Any:
        cycles = frequency_hz * t + phase
        return (np.floor(cycles) * duty + np.minimum(cycles % 1, duty)) / frequency_hz

    return (lit_until(start + exposure_s) - lit_until(start)) / exposure_s


def scene(height: int, width: int) -> Any:
    y, x = np.mgrid[0:height, 0:width]
    return 1 - 0.3 * ((x / width - 0.4) ** 2 + (y / height - 0.5) ** 2)


def spot(height: int, width: int, x: float, y: float, radius: float) -> Any:
    yy, xx = np.mgrid[0:height, 0:width]
    return np.exp(-0.5 * (((xx - x) / radius) ** 2 + ((yy - y) / radius) ** 2) ** 2)


def exposed(light: Any, rng: np.random.Generator, noise: float = 0.01, gain: float = 0.6) -> Any:
    """The picture of `light`: ambient light, shot and read noise, 8 bits."""
    values = 0.02 + gain * light
    values = values + noise * np.sqrt(0.1 + np.maximum(values, 0)) * rng.standard_normal(values.shape)
    return np.round(255 * np.clip(values, 0, 1)) / 255


@pytest.mark.parametrize(
    ("duty", "period"), [(None, 7.7), (None, 97.3), (0.1, 97.3), (1 / 3, 31.1), (0.5, 7.7), (0.7, 31.1), (0.9, 97.3)]
)
def test_the_fundamental_is_found_for_every_waveform(duty: float | None, period: float) -> None:
    frequency = 1 / (period * LINE_DELAY_S)
    light = lamp(frequency, 800, 0.2 / frequency, duty)[:, None] * scene(800, 160)
    along, [found] = find_stripes(exposed(light, np.random.default_rng(1)))
    assert along == "rows"
    assert found.period_px == pytest.approx(period, rel=2e-3)
    assert abs(found.period_px - period) < 5 * found.period_sd_px


def test_strong_harmonics_are_no_fundamental() -> None:
    rng, phase = np.random.default_rng(2), np.arange(900) / 90.0
    for harmonics in ([0.4, 0.0, 0.9], [0.4, 0.8, 0.3]):
        wave = sum(a * np.sin(2 * np.pi * (k + 1) * phase + k) for k, a in enumerate(harmonics))
        fit = fit_fundamental(1 + wave + 0.05 * rng.standard_normal(900), 3 / 90)
        assert 1 / fit.frequency == pytest.approx(90, rel=2e-3)


def two_spots(left_hz: float, right_hz: float, duty: float, seed: int) -> Any:
    left = lamp(left_hz, 800, 1e-4)[:, None] * spot(800, 640, 150, 400, 130)
    right = lamp(right_hz, 800, 1e-4, duty, 0.7)[:, None] * spot(800, 640, 490, 380, 130)
    return exposed(left + right, np.random.default_rng(seed))


@pytest.mark.parametrize("n_rows", range(5, 20))
def test_few_rows_determine_no_fit_and_do_not_fail(n_rows: int) -> None:
    fit = fit_periodic(np.random.default_rng(1).normal(size=n_rows), 0.3)
    assert fit is None or fit.residual.size == n_rows


def test_lamps_of_different_frequency_each_have_their_region() -> None:
    picture = two_spots(1000, 1370, 0.3, 5)
    result = calibrate_shutter([picture], [1370, 1000], "rows")
    by_frequency = {stripes.frequency_hz: stripes for stripes in result.lamps}
    assert set(by_frequency) == {1000, 1370}
    assert by_frequency[1000].bounds[2] <= 340
    assert by_frequency[1370].bounds[0] >= 300
    assert result.line_delay_s == pytest.approx(LINE_DELAY_S, rel=1e-3)
    assert result.readout_s == pytest.approx(800 * LINE_DELAY_S, rel=1e-3)
    assert not result.warnings
    one_named = calibrate_shutter([picture], [1000], "rows")
    assert one_named.line_delay_s == pytest.approx(LINE_DELAY_S, rel=2e-3)
    assert "blinks at about 137" in " ".join(one_named.warnings)


LAMPS_HZ = [2000, 2500, 3000, 3500, 4000]


def dark_photo(seed: int, radius: float, steady: bool = False) -> tuple[Any, list[tuple[float, int, int]]]:
    """A dark picture of five spots of different lamps, one of them faint, with halos; frequency and centre of each."""
    rng = np.random.default_rng(seed)
    height, width = 1080, 1920
    light = np.zeros((height, width))
    placed = []
    for x, frequency in zip(rng.permutation(np.linspace(0.12, 0.88, 5)) * width, LAMPS_HZ, strict=True):
        y, size = height * rng.uniform(0.3, 0.7), radius * rng.uniform(0.8, 1.25)
        brightness = 0.15 if frequency == 3000 else 1.5
        shape = spot(height, width, x, y, size) + 0.03 * spot(height, width, x, y, 3 * size)
        light += brightness * lamp(frequency, height, 1 / 8000, 0.5, rng.random())[:, None] * shape
        placed.append((frequency, int(x), int(y)))
    if steady:
        light += spot(height, width, width / 2, 0.9 * height, radius)
    return exposed(light, rng, 0.03, 1.0), placed


@pytest.mark.parametrize(("seed", "radius", "steady"), [(1, 40, False), (2, 75, True)])
def test_five_spots_in_a_dark_picture_are_five_regions_and_one_readout(seed: int, radius: float, steady: bool) -> None:
    picture, placed = dark_photo(seed, radius, steady)
    result = calibrate_shutter([picture], LAMPS_HZ, "rows" if steady else None)
    assert result.axis == "rows"
    assert result.line_delay_s == pytest.approx(LINE_DELAY_S, rel=1e-3)
    low, high = result.line_delay_interval_s
    assert abs(result.line_delay_s - LINE_DELAY_S) < 3 * (high - low)
    regions = {stripes.frequency_hz: stripes.bounds for stripes in result.lamps}
    assert set(regions) == set(LAMPS_HZ)
    assert result.warnings == ()
    for frequency, x, y in placed:
        left, top, right, bottom = regions[frequency]
        assert left <= x <= right
        assert top <= y <= bottom


def test_lamps_that_fit_in_two_ways_are_refused() -> None:
    """One lamp may be either of two; two lamps an octave apart may be any two of four."""
    alone = exposed(lamp(1000, 800, 1e-4)[:, None] * spot(800, 640, 320, 400, 150), np.random.default_rng(20))
    picture = two_spots(1000, 2000, 0.5, 21)
    for unclear, named in ((alone, [1000, 1370]), (picture, [500, 1000, 2000, 4000])):
        with pytest.raises(ReceiverError, match=r"fit the frequencies given in more than one way: [\d.]+ or"):
            calibrate_shutter([unclear], named, "rows")
    assert calibrate_shutter([picture], [1000, 2000], "rows").line_delay_s == pytest.approx(LINE_DELAY_S, rel=1e-3)


def textured(rng: np.random.Generator) -> Any:
    """A picture with the spectrum of natural scenes."""
    spectrum = np.fft.rfft2(rng.standard_normal((400, 300)))
    frequency = np.hypot(np.fft.fftfreq(400)[:, None], np.fft.rfftfreq(300)[None])
    values = np.fft.irfft2(spectrum / np.maximum(frequency, 1 / 400), (400, 300))
    return np.clip(0.5 + 0.15 * values / values.std(), 0, 1)


def test_no_stripes_are_found_where_there_are_none() -> None:
    rng = np.random.default_rng(7)
    tiles = np.indices((400, 300)) // 40
    scenes = [textured(rng) for _ in range(6)]
    scenes += [np.full((400, 300), 0.5) + 0.01 * rng.standard_normal((400, 300)), np.zeros((400, 300))]
    scenes += [np.where((tiles[0] + tiles[1]) % 2, 0.8, 0.1), scene(400, 300), spot(400, 300, 150, 200, 60)]
    assert [find_stripes(picture)[1] for picture in scenes] == [[]] * len(scenes)
    with pytest.raises(ReceiverError, match="no stripes"):
        calibrate_shutter(scenes[6:8], [1000])
    lit = lamp(1800, 400, 1e-4)[:, None] * (0.4 + textured(rng))
    assert calibrate_shutter([exposed(lit, rng)], [1800]).line_delay_s == pytest.approx(LINE_DELAY_S, rel=3e-3)


def autoregressive(n: int, rng: np.random.Generator) -> Any:
    from scipy.signal import lfilter

    return lfilter([1.0], [1.0, -0.9], rng.standard_normal(n))


@pytest.mark.parametrize(
    ("duty", "noise", "gain", "least"), [(0.5, 0.05, 0.5, 51), (None, 0.3, 0.4, 51), (None, None, 10.0, 50)]
)
def test_the_interval_holds_as_often_as_it_says(duty: Any, noise: Any, gain: float, least: int) -> None:
    """Of 60 intervals of 95 % at least 51 hold (fewer: 1 in 2000), and they are not needlessly wide.

    In autoregressive noise (no number) they must follow the noise's power at the stripes' own frequency.
    """
    deviations = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        period = 25 + rng.random()
        light = lamp(1 / (period * LINE_DELAY_S), 400, 1e-4, duty, rng.random())
        if noise is None:
            profile = gain * light + autoregressive(400, rng)
        else:
            profile = exposed(light[:, None] * scene(400, 12), rng, noise, gain).mean(axis=1)
        fit = fit_periodic(profile, 1 / 25.5)
        deviations.append((fit.frequency - 1 / period) / fit.frequency_sd)
    assert sum(abs(d) < 1.96 for d in deviations) >= least
    assert np.std(deviations) > 0.5


@pytest.mark.parametrize(
    ("on_s", "exposure_s", "exif_s", "expected_s"),
    [
        (6.25e-4, 1e-4, None, 1e-4),
        (6.25e-4, 2e-4, None, 2e-4),
        (1e-4, 4e-4, None, 1e-4),  # a flash of 0.1 ms seen through 0.4 ms looks like the reverse
        (1e-4, 4e-4, 1 / 2500, 4e-4),
        (None, 1e-4, None, None),  # a sine has no edges
    ],
)
def test_exposure_from_the_edges(on_s: float | None, exposure_s: float, exif_s: Any, expected_s: Any) -> None:
    light = lamp(800, 800, exposure_s, on_s and 800 * on_s)[:, None] * scene(800, 200)
    picture = exposed(light, np.random.default_rng(11), gain=2.0 if on_s == 1e-4 else 0.6)
    result = calibrate_shutter([picture], [800], "rows", exif_s)
    twice, found = calibrate_shutter([picture] * 2, [800], "rows"), result.exposure
    assert np.ptp(twice.line_delay_interval_s) < 0.8 * np.ptp(result.line_delay_interval_s)
    assert found.exposure_s == (expected_s and pytest.approx(expected_s, rel=0.05))
    assert found.comment
    if found.exposure_s is not None:
        assert found.interval_s[0] < found.exposure_s < found.interval_s[1]


def test_light_undoes_tone_and_range_and_mixes_no_rows_of_a_mosaic() -> None:
    pattern = np.array([[0, 1], [1, 2]], np.uint8)
    rows = np.arange(8, dtype=np.uint16)[:, None] * np.ones((1, 6), np.uint16)
    pixels = (1000 + 100 * rows).astype(np.uint16)
    pixels[::2, ::2] = 4000  # red pixels, which a red lamp would saturate
    frame = Frame(pixels, "x", mosaic=Mosaic(pattern, (2.0, 1.0, 1.5), (1000.0,) * 3, 5000.0))
    np.testing.assert_allclose(frame_light(frame), np.repeat(np.arange(8)[:, None] * 100 / 4000, 6, axis=1), rtol=1e-6)
    frame = Frame(np.array([[16, 235, 126]], np.uint8), "x", black=16, white=235)
    np.testing.assert_allclose(frame_light(frame), [[0, 1, ((110 / 219 + 0.055) / 1.055) ** 2.4]], rtol=1e-5)
    linear = Frame(np.array([[0, 128]], np.uint8), "x", linear=True)
    np.testing.assert_allclose(frame_light(linear), [[0, 128 / 255]], rtol=1e-5)


def test_a_mode_replaces_that_of_its_size_and_keeps_the_rest(tmp_path: Path) -> None:
    path = tmp_path / "cam.toml"
    old = ReadoutMode(name="video", width=640, height=480, line_delay_s=1e-5, frame_rate_hz=30.0)
    other = ReadoutMode(name="still", width=4000, height=3000, line_delay_s=1e-5)
    profile = with_mode(with_mode(profile_to_extend(path, Metadata(make="A", model="B ")), old), other)
    write_profile(profile, path)
    new = ReadoutMode(name="640x480", width=640, height=480, line_delay_s=2e-5)
    write_profile(with_mode(profile_to_extend(path), new), path)
    saved = load_profile(str(path), CameraProfile)
    assert saved.models == ("B",)
    assert saved.mode_for(4000, 3000) == other
    mode = saved.mode_for(640, 480)
    assert (mode.line_delay_s, mode.frame_rate_hz, len(saved.modes)) == (2e-5, 30.0, 2)
    path.write_text("hello = 1")
    with pytest.raises(ProfileError, match="cam"):
        profile_to_extend(path)
    with pytest.raises(UsageError, match="cannot name"):
        profile_to_extend(tmp_path / "my camera.toml")


@pytest.fixture
def lamp_file(tmp_path: Path) -> str:
    picture = exposed(lamp(1000, 480, 1e-4)[:, None] * scene(480, 200), np.random.default_rng(13))
    encoded = np.where(picture <= 0.0031308, 12.92 * picture, 1.055 * picture ** (1 / 2.4) - 0.055)
    Image.fromarray(np.round(255 * encoded).astype(np.uint8)).save(tmp_path / "lamp.png")
    return str(tmp_path / "lamp.png")


def test_command(lamp_file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    profile = tmp_path / "cam.toml"
    arguments = ["calibrate", "shutter", lamp_file, "--frequency", "1000"]
    assert run([*arguments, "--json", "-", "--save", str(profile), "--mode", "clip"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["readout_s"] == pytest.approx(480 * LINE_DELAY_S, rel=2e-3)
    assert record["readout_interval_s"][0] < record["readout_s"] < record["readout_interval_s"][1]
    assert record["periods"] == pytest.approx(9.6, rel=0.01)
    assert record["axis"] == "rows"
    mode = load_profile(str(profile), CameraProfile).mode_for(200, 480)
    assert mode.name == "clip"
    assert mode.line_delay_s == pytest.approx(record["line_delay_s"], abs=0, rel=1e-12)
    assert run([*arguments, "--region", "0,0,200,300"]) == 0
    assert "ms over 480 rows" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("extra", "word"),
    [
        ([], "--frequency"),
        (["--frequency", "0"], "--frequency"),
        (["--frequency", "nan"], "--frequency"),
        (["--frequency", "1000", "--region", "1,2"], "--region"),
        (["--frequency", "1000", "--region", "900,900,100,100"], "region"),
        (["--frequency", "1000", "--exposure", "3"], "--exposure"),
        (["--frequency", "1000", "--save", "a.toml", "--name", "b"], "--name"),
        (["--frequency", "1000", "--name", "a/b"], "--name"),
        (["--board", "9"], "--board"),
        (["--board", "1x1"], "1x1"),
        (["--square", "0"], "square"),
    ],
)
def test_wrong_usage_is_one_line(
    lamp_file: str, extra: list[str], word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    command = "lens" if extra[:1] in (["--board"], ["--square"]) else "shutter"
    assert run(["calibrate", command, lamp_file, *extra]) == ExitCode.USAGE
    err = capsys.readouterr().err
    assert word in err
    assert len(err.strip().splitlines()) == 1


def test_refusals_and_unreadable_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Image.new("L", (200, 200), 99).save(tmp_path / "dull.png")
    Image.new("L", (100, 200), 99).save(tmp_path / "narrow.png")
    for names, code, reason in [
        (["dull.png"], ExitCode.NOT_RECEIVED, "no stripes"),
        (["absent.png"], ExitCode.UNREADABLE, "absent.png"),
        (["dull.png", "narrow.png"], ExitCode.USAGE, "of different sizes (100x200, 200x200)"),
    ]:
        assert run(["calibrate", "shutter", *(str(tmp_path / name) for name in names), "--frequency", "1000"]) == code
        assert reason in capsys.readouterr().err


def test_a_narrow_strip_is_enough() -> None:
    """Of a lamp at 5 kHz, as of a laser's reflection."""
    strip = exposed(lamp(5000, 864, 2e-5)[:, None] * scene(864, 16), np.random.default_rng(3), gain=0.3)
    assert calibrate_shutter([strip], [5000]).line_delay_s == pytest.approx(LINE_DELAY_S, rel=2e-3)


def test_the_strip_across_a_red_laser(shared_captures: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = shared_captures.parent / "cases" / "shutter" / "red_strip.png"
    assert run(["calibrate", "shutter", str(path), "--frequency", "5000", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["line_delay_s"] == pytest.approx(9.11e-6, rel=3e-3)


@pytest.mark.parametrize(("period_px", "doubt"), [(3.0, "readout of 400 ms"), (8.0, "period of 8 px"), (11.0, None)])
def test_texture_and_blocks_are_doubted_and_give_no_profile(
    period_px: float, doubt: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frequency_hz = 1 / (period_px * LINE_DELAY_S)
    picture = exposed(lamp(frequency_hz, 480, 1e-6, None)[:, None] * scene(480, 200), np.random.default_rng(13))
    path, profile = tmp_path / "a.png", tmp_path / "a.toml"
    Image.fromarray(np.round(255 * picture).astype(np.uint8)).save(path)
    claimed_hz = 400 if period_px == 3.0 else frequency_hz
    arguments = ["calibrate", "shutter", str(path), "--frequency", str(claimed_hz), "--save", str(profile)]
    assert run(arguments) == (ExitCode.USAGE if doubt else 0)
    assert (doubt or "") in capsys.readouterr().err
    assert profile.exists() == (doubt is None)
    assert run([*arguments, "--force"]) == 0
    assert profile.exists()


def test_rotated_pictures_give_no_mode(lamp_file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Image.open(lamp_file) as picture:
        picture.transpose(Image.Transpose.TRANSPOSE).save(lamp_file)
    arguments = ["calibrate", "shutter", lamp_file, "--frequency", "1000"]
    assert run([*arguments, "--save", str(tmp_path / "c.toml")]) == ExitCode.USAGE
    assert not (tmp_path / "c.toml").exists()
    capsys.readouterr()
    assert run([*arguments, "--json", "-"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["axis"] == "columns"
    assert record["lamps"][0]["period_px"] == pytest.approx(1e-3 / LINE_DELAY_S, rel=2e-3)


def test_nikon_led(shared_real: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = shared_real / "shutter" / "nikon_1j1_1000hz.png"
    assert run(["calibrate", "shutter", str(path), "--frequency", "1000", "--json", "-"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert (1e3 * record["readout_s"], record["periods"]) == pytest.approx((15.73, 15.73), rel=3e-3)
    assert record["axis"] == "rows"
    assert record["exposure_s"] == pytest.approx(1 / 16000, rel=0.3)
