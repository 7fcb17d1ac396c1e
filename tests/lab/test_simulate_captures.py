"""Files, truth, bound and command line of the simulator."""

import io
import json
import re
import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import msgspec
import numpy as np
import pytest
import rawpy
from click.testing import CliRunner
from PIL import Image

from rxcli.cli.simulate import simulate
from rxcli.errors import ReceiverError, UsageError
from rxcli.ingest import open_source
from rxcli.lab.simulate.camera import render_band
from rxcli.lab.simulate.capture import prepare
from rxcli.lab.simulate.files import Encoding, write_dng, write_video
from rxcli.lab.simulate.scenes import PRESETS, Scene, preset
from rxcli.protocol import codebook
from rxcli.resources import data_dir

SHARED = Path(__file__).resolve().parents[2].parent / "shared" / "captures"
SMALL = ["--scale", "0.12", "--keep-readout", "--picture", "sky"]


@pytest.fixture(scope="module")
def small() -> Scene:
    return preset("xs10-still", "paper-34k6").scaled(0.08, 0.4)


def run(*args: str) -> Any:
    return CliRunner().invoke(simulate, list(args), catch_exceptions=True)


@pytest.mark.parametrize("orientation", [1, 3])
def test_a_clip_notes_how_its_camera_was_held(orientation: int, tmp_path: Path) -> None:
    pictures = [np.zeros((32, 48, 3), np.uint8)] * 2
    write_video(pictures, tmp_path / "a.mp4", Encoding("h264"), 30, orientation=orientation)
    assert {frame.metadata.orientation for frame in open_source(tmp_path / "a.mp4")} == {orientation}


def test_a_clip_of_an_odd_side_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"must be even \(got 48 x 31\)"):
        write_video([np.zeros((31, 48, 3), np.uint8)], tmp_path / "a.mp4", Encoding("h264"), 30)


def test_a_film_is_played_by_the_command(tmp_path: Path) -> None:
    arguments = [*SMALL, "--preset", "video-1080p", "--screen", "paper-8k65", "--frames", "2", "--set", "panel=0"]
    for name, film in (("rest.mp4", []), ("film.mp4", ["--film", "pan:40", "--set", "film.content_hz=30"])):
        assert run(str(tmp_path / name), *arguments, *film).exit_code == 0
    rest, film = ([frame.pixels for frame in open_source(tmp_path / name)] for name in ("rest.mp4", "film.mp4"))
    assert (rest[1] != film[1]).any()
    refused = run(str(tmp_path / "no.mp4"), *arguments, "--film", "tilt:4")
    assert isinstance(refused.exception, UsageError)


@pytest.mark.parametrize("cfa", ["bayer", "xtrans"])
@pytest.mark.parametrize("bits", [14, 16])
def test_dng_opens_bit_exact(small: Scene, tmp_path: Path, cfa: str, bits: int) -> None:
    sensor = replace(small.sensor, cfa=cfa, width=498, height=300)  # type: ignore[arg-type]
    raw = np.random.default_rng(1).integers(0, 16384, (300, 498)).astype(np.uint16)
    path = tmp_path / "a.dng"
    write_dng(raw, replace(small, sensor=sensor, make="Synthetic", model="xs10", iso=1600), path, bits)
    with rawpy.imread(str(path)) as file:
        np.testing.assert_array_equal(file.raw_image_visible, raw)
        assert file.black_level_per_channel[:3] == [1022] * 3
        assert file.white_level == 16383
        found = file.raw_colors_visible[:6, :6]
        colours = found % 3 if cfa == "xtrans" else np.where(found == 3, 1, found)
        np.testing.assert_array_equal(colours, np.tile(sensor.pattern, (3, 3))[:6, :6])
        assert file.other.iso_speed == 1600
        assert file.other.shutter_speed == pytest.approx(1 / 32000)
        np.testing.assert_allclose(file.camera_whitebalance[:3], [1 / 0.55, 1, 1 / 0.65], rtol=1e-3)


def test_jpeg_carries_what_a_camera_writes(small: Scene) -> None:
    capture = prepare(replace(small, orientation=3, iso=800), 1).frame()
    with Image.open(io.BytesIO(capture.jpeg)) as picture:
        exif = picture.getexif()
        assert picture.size == (small.sensor.width, small.sensor.height)
        assert (exif[0x10F], exif[0x110], exif[0x112]) == ("FUJIFILM", "X-S10", 3)
        assert float(exif.get_ifd(0x8769)[0x829A]) == pytest.approx(1 / 32000, rel=1e-6)
        assert exif.get_ifd(0x8769)[0x8827] == 800


def test_truth_counts_the_slots_between_the_corners(small: Scene) -> None:
    scene = replace(small, start_slot=500.0)
    truth = prepare(scene, 1).frame().truth
    heights = np.array(truth["corners_sensor_px"])[:, 1]
    slots = (heights.max() - heights.min()) * scene.sensor.line_delay_s * 34600
    bursts = truth["frames"][0]["bursts"]
    assert sum(entry["visible_slots"] for entry in bursts) == pytest.approx(slots, abs=0.7)
    assert [entry["burst"] for entry in bursts] == [0, 1]
    seen = 780 - 500 - heights.min() * scene.sensor.line_delay_s * 34600
    assert bursts[0]["visible_slots"] == pytest.approx(seen, abs=0.4)
    assert list(truth["payload"]) == ["0", "1"]
    assert {len(text) for text in truth["payload"]["0"]} == {42}


@pytest.mark.parametrize("name", list(PRESETS))
def test_truth_has_the_form_of_the_reference_captures(name: str) -> None:
    if not SHARED.is_dir():
        pytest.skip("the reference captures are not here")
    reference = json.loads((SHARED / "phone_coffee_8k65.truth.json").read_text())
    scene = replace(preset(name, "paper-8k65").scaled(0.05), n_frames=1)
    truth = json.loads(json.dumps(prepare(scene, 1).truth("x.jpg")))
    assert set(form(reference)) <= set(form(truth))


def form(value: Any, place: str = "truth") -> Iterator[tuple[str, str]]:
    """Places in a JSON value and the kinds of values there; bursts and entries of lists share a place."""
    parts = value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(value, list) else ()
    yield place, "number" if isinstance(value, (int, float)) else type(value).__name__
    for key, part in parts:
        yield from form(part, f"{place}.{'n' if str(key).isdigit() else key}")


def symbol_error_rate(energy: np.ndarray, rng: np.random.Generator) -> float:
    """Monte Carlo of maximum likelihood over the codebook, slots of given energies (n, 10) in white Gaussian noise."""
    words = codebook(5).astype(float)
    sent = rng.integers(0, len(words), len(energy))
    matched = energy * words[sent] + np.sqrt(energy) * rng.standard_normal(energy.shape)
    score = matched @ words.T - 0.5 * energy @ words.T
    return float((np.argmax(score, axis=1) != sent).mean())


def test_the_bound_meets_theory_at_moderate_light() -> None:
    """With slots that do not overlap and noise that is not the light's own, errors are those of ten Gaussian slots."""
    base = preset("xs10-still", "paper-34k6").scaled(0.02, 0.25)
    sensor = replace(base.sensor, read_noise_e=40.0, row_noise_e=0.0, prnu=0.0, full_scale_e=4000.0)
    scene = replace(base, sensor=sensor, picture="white", start_slot=20.0, exposure_s=0.02 / 34600, light_e_per_s=3.2e7)
    rng = np.random.default_rng(1)
    wrong = total = 0
    expected = []
    for seed in range(5):
        oracle = prepare(scene, seed).frame(oracle=True).oracle
        for column in range(20):
            decided, sent, seen = oracle.decide(column, 0)
            wrong, total = wrong + int((decided != sent)[seen].sum()), total + int(seen.sum())
            # Every payload symbol that the frame sees whole stands for itself, many times.
            starts = 20 + 10 * np.flatnonzero(seen)
            energy = np.stack([np.diagonal(oracle.about_slots(column, start)[1]) for start in starts])
            expected.append(symbol_error_rate(np.tile(energy, (20, 1)), rng))
    rate, theory = wrong / total, float(np.mean(expected))
    assert 0.1 < theory < 0.9
    assert rate == pytest.approx(theory, abs=5 * np.sqrt(theory * (1 - theory) / total) + 0.01)


@pytest.mark.parametrize(("exposure_slots", "red_lag_s"), [(3.4, 0.0), (0.7, 6e-4), (5.0, 2e-3)])
def test_the_bound_counts_all_that_a_slot_does_to_the_sensor(exposure_slots: float, red_lag_s: float) -> None:
    """Long exposures and red that lags: its information against that of pixels, slot by slot lit alone."""
    base = preset("phone-plain", "paper-34k6").scaled(0.02, 0.2)
    screen = msgspec.structs.replace(base.screen, columns=1, width_px=40, height_px=60)
    sensor = replace(base.sensor, cfa="rgb", row_noise_e=0.0)
    scene = replace(base, screen=screen, sensor=sensor, picture="gradient", start_slot=300.0, red_lag_s=red_lag_s)
    scene = replace(scene, exposure_s=exposure_slots / screen.slot_rate_hz)
    oracle = prepare(scene, 1).frame(oracle=True).oracle

    def mean_e(**changes: Any) -> np.ndarray:
        exposure = prepare(replace(scene, **changes), 1).exposure()
        return render_band(exposure, 0, sensor.height).mean_e.astype(np.float64)

    def alone(slot: int) -> Any:
        return lambda slots: (slots == slot).astype(float)

    slots, mean = 310 + np.arange(10), mean_e()
    variance = mean + sensor.read_noise_e**2 + (sensor.prnu * mean) ** 2
    effects = np.stack([mean_e(waveform=alone(slot)) - mean_e(waveform=alone(-1)) for slot in slots])
    expected = np.einsum("sypc,typc->st", effects / variance, effects)
    found = oracle.about_slots(0, 310)[1]
    np.testing.assert_allclose(found, expected, atol=0.02 * np.abs(expected).max())


def test_command_writes_capture_and_truth(tmp_path: Path) -> None:
    out = tmp_path / "a.jpg"
    result = run(str(out), *SMALL, "--start-slot", "20", "--payload", "hex:00ff", "--w", "4", "--roll", "180")
    assert result.exit_code == 0, result.output
    assert result.stdout == ""
    truth = json.loads((tmp_path / "a.truth.json").read_text())
    assert truth["capture"] == "a.jpg"
    assert truth["w"] == [4] * 20
    assert truth["orientation"] == 3
    assert truth["payload"]["0"][0].startswith("00ff00ff")
    fields = {"pose.yaw_deg": "5", "camera_name": "mine", "lens.distortion": "[0.1, 0, 0, 0, 0]", "orientation": "8"}
    changed = run(
        str(tmp_path / "b.jpg"), *SMALL, *(part for field in fields.items() for part in ("--set", "=".join(field)))
    )
    assert changed.exit_code == 0, changed.output
    other = json.loads((tmp_path / "b.truth.json").read_text())
    assert (other["camera"]["name"], other["camera"]["dist_coeffs"][0], other["orientation"]) == ("mine", 0.1, 8)
    quick = run(str(tmp_path / "c.jpg"), *SMALL, "--readout", "5e-3", "--exposure-slots", "4")
    assert quick.exit_code == 0, quick.output
    camera = json.loads((tmp_path / "c.truth.json").read_text())["camera"]
    assert camera["line_delay_s"] * camera["height"] == pytest.approx(5e-3, rel=1e-3)
    assert camera["exposure_s"] == pytest.approx(4 / 34600)
    first = out.read_bytes()
    run(str(out), *SMALL, "--start-slot", "20", "--payload", "hex:00ff", "--w", "4", "--roll", "180")
    assert out.read_bytes() == first


@pytest.mark.parametrize("name", ["a.dng", "a.png", "a.tiff"])
def test_command_writes_other_stills(tmp_path: Path, name: str) -> None:
    result = run(str(tmp_path / name), *SMALL)
    assert result.exit_code == 0, result.output
    frame = next(open_source(tmp_path / name))
    assert (frame.width, frame.height, frame.mosaic is not None) == (749, 499, name == "a.dng")


@pytest.mark.parametrize(
    ("name", "codec", "bits"), [("a.mp4", "h264", 8), ("a.mkv", "hevc-10", 10), ("a.avi", "mjpeg", 8)]
)
def test_command_writes_clips_through_real_encoders(tmp_path: Path, name: str, codec: str, bits: int) -> None:
    out = tmp_path / name
    args = ["--preset", "video-1080p", "--frames", "3", "--scale", "0.2", "--format", codec, "--waveforms"]
    result = run(str(out), *args, str(tmp_path / "lab"))
    assert result.exit_code == 0, result.output
    with av.open(str(out)) as container:
        frames = list(container.decode(video=0))
    formats = [(frame.width, frame.height, frame.format.components[0].bits) for frame in frames]
    assert formats == [(384, 216, bits)] * 3
    truth = json.loads((tmp_path / "a.truth.json").read_text())
    assert [frame["frame"] for frame in truth["frames"]] == [0, 1, 2]
    assert (tmp_path / "lab" / "slots.csv").is_file()


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["a.xyz"], "no format goes with this suffix"),
        (["missing/a.jpg"], "no such folder"),
        (["a.jpg", "--w", "12"], "1..9"),
        (["a.jpg", "--w", "five"], "no weight"),
        (["a.jpg", "--payload", "hex:0g"], "even number of hex digits"),
        (["a.jpg", "--payload", "none.bin"], "cannot be read"),
        (["a.jpg", "--text", "a", "--slots", "s.csv"], "exclude each other"),
        (["a.jpg", "--screen", "nope"], "no profile"),
        (["a.jpg", "--picture", "nope.png"], "no such picture"),
        (["a.dng", "--preset", "video-1080p"], "has none"),
        (["a.jpg", "--set", "isp.colour=3"], "isp.colour: no such field"),
        (["a.jpg", "--set", "sensor.cfa=foveon"], "sensor.cfa = 'foveon' .Invalid enum value"),
        (["a.jpg", "--set", "isp quality"], "not FIELD=VALUE"),
        (["a.jpg", "--electrons", "-1"], r"light_e_per_s must be positive \(got -"),
    ],
)
def test_mistakes_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, args: list[str], message: str) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(*args)
    assert isinstance(result.exception, ReceiverError)
    assert result.exception.hint
    assert re.search(message, str(result.exception))
    assert list(tmp_path.iterdir()) == []


def test_sample_frames_are_what_their_readme_makes(tmp_path: Path) -> None:
    samples = data_dir("sample_frames")
    commands = (samples / "README.md").read_text().replace("\\\n", " ").splitlines()
    line = next(line for line in commands if line.startswith("vlc-rx simulate") and ".dng" in line)
    args = shlex.split(line)[2:]
    profile = args.index("--camera-profile") + 1
    name, toml = args[0], args[profile]
    args[0], args[profile] = str(tmp_path / name), str(tmp_path / toml)
    result = run(*args)
    assert result.exit_code == 0, result.output
    with rawpy.imread(str(samples / name)) as kept, rawpy.imread(str(tmp_path / name)) as made:
        # Another processor may round an exponential otherwise, and with it a few pixels.
        assert (kept.raw_image_visible == made.raw_image_visible).mean() > 0.99
    truth = name.replace(".dng", ".truth.json")
    kept_truth, made_truth = (json.loads((folder / truth).read_text()) for folder in (samples, tmp_path))
    assert made_truth["payload"] == kept_truth["payload"]
    assert made_truth["frames"][0]["bursts"] == kept_truth["frames"][0]["bursts"]
    assert (tmp_path / toml).read_text() == (samples / toml).read_text()
