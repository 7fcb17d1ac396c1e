"""Hypotheses of unknown cameras against cameras that are known, and the reasons where nothing can be estimated."""

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from made_stages import hypothesis_of, profiles_of

from rxcli.ingest import open_source
from rxcli.lab.simulate.capture import prepare
from rxcli.lab.simulate.isp import Isp
from rxcli.lab.simulate.optics import Lens as SimulatedLens
from rxcli.lab.simulate.optics import Pose
from rxcli.lab.simulate.scenes import preset
from rxcli.lab.simulate.sensor import Sensor
from rxcli.options import ReceiverOptions
from rxcli.profiles import CameraProfile, ScreenProfile, check_profile, dump_profile, load_profile, usual_screens
from rxcli.receiver.camera import proposals, stripes
from rxcli.receiver.camera.advice import why_not
from rxcli.receiver.camera.camera import camera_profile, in_time_order, lens_of, summary
from rxcli.receiver.camera.curvature import curvature_terms
from rxcli.receiver.camera.proposals import in_phase, propose, propose_slots
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.stripes import Stripes
from rxcli.receiver.camera.strips import ColumnStrips, strips_of
from rxcli.receiver.light import NoiseModel
from rxcli.receiver.plane.read import read_plane
from rxcli.receiver.plane.rows import sample_rows, strips_per_column
from rxcli.receiver.receive import receive
from rxcli.receiver.screen import geometry
from rxcli.types import FloatArray, Frame, Lens

SCREENS = usual_screens()


def phone(
    screen: str,
    rows_per_slot: float,
    height: int,
    *,
    corrected: bool = False,
    upside_down: bool = False,
    k1: float = 0.0,
    seed: int = 0,
    exposure_slots: float = 0.9,
) -> tuple[Frame, FloatArray, dict[str, Any]]:
    """A simulated phone's picture, its screen's corners in it, and the truth; upside down: turned by 180 degrees."""
    profile = load_profile(screen, ScreenProfile)
    width = height * 4 // 3
    line_delay = 1 / (rows_per_slot * profile.slot_rate_hz)
    scene = replace(
        preset("phone-plain", profile),
        sensor=Sensor(width, height, line_delay, "bayer", full_scale_e=260.0, black_level=64, white_level=1023),
        lens=SimulatedLens(0.8, (k1, -0.5 * k1, 0.0003, -0.0002, 0.0)),
        pose=Pose(fill=0.92, roll_deg=0.6, yaw_deg=2.0, pitch_deg=-1.5),
        isp=Isp(tone="bt709", gain=2.0, sharpen=0.4, denoise_px=0.3, correct_distortion=corrected),
        exposure_s=exposure_slots / profile.slot_rate_hz,
        light_e_per_s=1.4e6 * profile.slot_rate_hz / 20000,
        picture="coffee",
    )
    capture = prepare(scene, seed).frame(0)
    truth = capture.truth
    corners = np.array(truth["corners_sensor_px"])
    if corrected:
        camera = truth["camera"]
        lens = Lens(np.array(camera["camera_matrix"]), np.array(camera["dist_coeffs"]), corrected=True)
        corners = geometry.undistort(corners, lens)
    pixels = capture.pixels
    if upside_down:
        pixels, corners = np.ascontiguousarray(pixels[::-1, ::-1]), np.array([width - 1, height - 1]) - corners
    return Frame(pixels, "phone"), corners, truth


def stripes_of(frame: Frame, corners: FloatArray, n_columns: int = 20, *, may_bend: bool = True) -> Stripes:
    """Stripes of a frame as the pipeline makes them."""
    column_px = float(np.linalg.norm(corners[1] - corners[0])) / n_columns
    n_strips = strips_per_column(column_px)
    outlines = geometry.column_outlines(corners, n_columns, n_strips, frame.width, frame.height)
    profiles = sample_rows(read_plane(frame), outlines, "srgb")
    centre_x = (outlines.edges_x[1:] + outlines.edges_x[:-1]) / 2
    return Stripes(strips_of(profiles, centre_x, frame.width, frame.height, may_bend=may_bend))


@pytest.mark.parametrize(
    ("screen", "rows_per_slot", "height", "corrected", "upside_down", "k1"),
    [
        ("paper-17k3", 3.7, 960, False, False, -0.02),
        ("paper-34k6", 2.6, 1080, True, False, 0.09),
        ("paper-17k3", 3.4, 960, True, True, -0.06),
        ("paper-8k65", 7.3, 960, False, True, 0.0),
    ],
)
def test_unknown_phones_are_proposed_and_fitted(
    screen: str, rows_per_slot: float, height: int, corrected: bool, upside_down: bool, k1: float
) -> None:
    frame, corners, truth = phone(
        screen, rows_per_slot, height, corrected=corrected, upside_down=upside_down, k1=k1, seed=height
    )
    proposed = propose(stripes_of(frame, corners), SCREENS)
    assert 0 < len(proposed) <= 2 * SETTINGS.n_proposed
    right = [one for one in proposed if one.packet_slots == 20 + 10 * truth["payload_symbols"]]
    right = [one for one in right if one.reversed == upside_down]
    assert min(abs(one.rows_per_slot / rows_per_slot - 1) for one in right) < 2e-2
    estimated = next(receive([frame], ReceiverOptions(cameras=(), corners=corners, cae="never"))).estimated
    found, sd = estimated["rows_per_slot"]
    assert abs(found / rows_per_slot - 1) < 5e-4
    assert abs(found - rows_per_slot) < 5 * sd
    assert estimated["readout_reversed"][0] == upside_down
    exposure_s, _ = estimated["exposure_s"]
    assert exposure_s / estimated["line_delay_s"][0] / found == pytest.approx(0.9, abs=0.25)
    assert bool(estimated.get("distortion_corrected", (0.0, 0.0))[0]) == corrected
    if corrected:
        assert _bend_error_slots(estimated, corners, truth, upside_down) < 0.05


def test_of_noise_one_camera_is_proposed() -> None:
    noise = np.random.default_rng(1).integers(0, 256, (480, 640), np.uint8)
    corners = np.array([[0.0, 0.0], [639.0, 0.0], [639.0, 479.0], [0.0, 479.0]])
    (proposed,) = propose(stripes_of(Frame(cv2.GaussianBlur(noise, (0, 0), 2), "noise"), corners), SCREENS)
    assert proposed.score < SETTINGS.min_score


@pytest.mark.parametrize("exposure_slots", [0.5, 1.2, 2.3, 3.5, 4.0, 6.2])
def test_an_exposure_that_no_file_states_is_proposed(exposure_slots: float) -> None:
    """By the width of the stripes, or where it lasts several slots, by the changes of the light."""
    is_long = exposure_slots > 3
    screen, rows_per_slot, height = ("paper-8k65", 8.0, 1600) if is_long else ("paper-17k3", 4.3, 960)
    frame, corners, _ = phone(screen, rows_per_slot, height, exposure_slots=exposure_slots)
    light = stripes_of(frame, corners)
    best = in_phase(light, propose(light, SCREENS)[0])
    assert best.rows_per_slot == pytest.approx(rows_per_slot, rel=3e-3 if is_long else 5e-3)
    assert best.exposure_slots == pytest.approx(exposure_slots, abs=0.25 if is_long else 0.4)


@pytest.mark.parametrize(("exposure_slots", "k1"), [(0.8, 0.09), (4.0, 0.09), (4.0, -0.06)])
def test_the_light_of_all_rows_shows_rows_per_slot_and_bend_before_packets(exposure_slots: float, k1: float) -> None:
    screen, rows_per_slot, height = ("paper-8k65", 7.7, 1500)
    frame, corners, truth = phone(screen, rows_per_slot, height, corrected=True, k1=k1, exposure_slots=exposure_slots)
    light = stripes_of(frame, corners)
    best = in_phase(light, propose(light, SCREENS)[0])
    assert best.rows_per_slot == pytest.approx(rows_per_slot, rel=1.5e-3)
    lens = truth["camera"]["dist_coeffs"]
    true = np.array([lens[0] / 0.8**2, lens[1] / 0.8**4, lens[2] / 0.8, lens[3] / 0.8])
    strips = light.strips
    moved = np.tensordot(best.curvature - true, curvature_terms(strips.x, strips.rows, frame.width, frame.height), 1)
    off = moved / rows_per_slot + strips.rows * (1 / best.rows_per_slot - 1 / rows_per_slot)
    assert off[strips.inside > 0].std() < 0.06


@pytest.mark.parametrize(("corrected", "k1"), [(False, 0.0), (True, 0.09)])
def test_less_than_a_packet_gives_slots_and_leaves_length_and_direction_open(corrected: bool, k1: float) -> None:
    """Eighty of 130 slots are in view; stripes may be bent, which the file does not say."""
    frame, corners, _ = phone("data-17k3", 8.0, 720, corrected=corrected, k1=k1, exposure_slots=0.7)
    proposed = propose_slots(stripes_of(frame, corners))
    assert {one.packet_slots for one in proposed} == {0}
    assert {(one.number, one.reversed) for one in proposed} >= {(0, False), (0, True)}
    right = [one for one in proposed if one.curvature.any() == corrected]
    assert min(abs(one.rows_per_slot / 8 - 1) for one in right) < 6e-3
    assert right[0].exposure_slots == pytest.approx(0.7, abs=0.4)
    straight = propose_slots(stripes_of(frame, corners, may_bend=False))
    assert not any(one.curvature.any() for one in straight)


@pytest.mark.parametrize("n_rows", [30, 90, 200])
def test_less_than_a_header_in_view_is_no_error(n_rows: int) -> None:
    frame, corners, _ = phone("paper-17k3", 16.0, 400, exposure_slots=0.5)
    whole = stripes_of(frame, corners).strips
    light, inside, x = (part[:, :n_rows] for part in (whole.light, whole.inside, whole.x))
    few = replace(whole, light=light, inside=inside, x=x, rows=whole.rows[:n_rows])
    for exposure_s in (None, 3e-5, 3e-4):
        assert all(np.isfinite(found.score) for found in propose(Stripes(few), SCREENS, exposure_s))


def _bend_error_slots(
    estimated: dict[str, tuple[float, float]], corners: FloatArray, truth: dict[str, Any], upside_down: bool
) -> float:
    """Standard deviation over the screen of the error of the row-time map, start and period aside, in slots."""
    camera = truth["camera"]
    width, height = camera["width"], camera["height"]
    curvature = np.array([estimated[name][0] for name in ("k1", "k2", "p1", "p2")])
    lens = lens_of(curvature, width, height)
    assert lens is not None
    true = Lens(np.array(camera["camera_matrix"]), np.array(camera["dist_coeffs"]), corrected=True)
    low, high = corners.min(axis=0), corners.max(axis=0)
    points = np.stack(np.meshgrid(*(np.linspace(a, b, 15) for a, b in zip(low, high, strict=True))), axis=-1)
    turned = np.array([width - 1, height - 1]) - points if upside_down else points
    sensor = geometry.distort(turned, true)[..., 1]
    if upside_down:
        sensor = height - 1 - sensor
    error = (geometry.distort(points, lens)[..., 1] - sensor).ravel()
    line = np.stack([points[..., 1].ravel(), np.ones(error.size)], axis=1)
    left = error - line @ np.linalg.lstsq(line, error, rcond=None)[0]
    return float(left.std() / estimated["rows_per_slot"][0])


def test_bend_terms_are_the_lens_model_at_any_focal_length() -> None:
    rng = np.random.default_rng(0)
    width, height, focal = 800, 600, 530.0
    points = rng.uniform([0, 0], [width, height], (50, 2))
    coefficients = np.array([0.11, -0.08, 4e-4, -7e-4])
    matrix = np.array([[focal, 0, 399.5], [0, focal, 299.5], [0, 0, 1]])
    moved = geometry.distort(points, Lens(matrix, np.append(coefficients, 0.0), True))[:, 1] - points[:, 1]
    scaled = coefficients * (width / focal) ** np.array([2, 4, 1, 1])
    terms = curvature_terms(points[:, 0], points[:, 1], width, height)
    np.testing.assert_allclose(scaled @ terms, moved, rtol=1e-9, atol=1e-9)


def test_an_estimate_can_be_kept_as_a_profile() -> None:
    curvature = np.array([0.1, -0.2, 3e-4, -1e-4])
    hypothesis = hypothesis_of(5.0, curvature=curvature, exposure_slots=0.8, exposure_slots_sd=0.02)
    estimated = summary(hypothesis, 17300.0)
    assert estimated["line_delay_s"] == pytest.approx((1 / (5 * 17300), 0.001 / 5 / (5 * 17300)))
    profile = camera_profile(estimated, "mine", "Maker", "Phone X", 4032, 3024)
    again = check_profile(tomllib.loads(dump_profile(profile)), CameraProfile, "mine")
    assert again == profile
    assert again.matches("maker", "phone x")
    mode = again.mode_for(4032, 3024)
    assert mode.exposure_s == pytest.approx(0.8 / 17300)
    assert again.lens is not None
    lens, kept = lens_of(curvature, 4032, 3024), geometry.lens_for(again.lens, 4032, 3024)
    points = np.array([[100.0, 200.0], [3900.0, 2800.0]])
    assert lens is not None
    np.testing.assert_allclose(geometry.distort(points, kept), geometry.distort(points, lens))


def _flat_stripes(light: FloatArray) -> Stripes:
    n_rows = light.shape[1]
    strips = ColumnStrips(
        light=light.astype(np.float32),
        inside=np.ones(light.shape, np.float32),
        x=np.broadcast_to(np.linspace(10, 790, light.shape[0])[:, None], light.shape),
        rows=np.arange(n_rows, dtype=np.float64),
        n_columns=20,
        noise=NoiseModel(0.002**2, 0.0),
        width=800,
        height=n_rows,
    )
    return Stripes(strips)


def _striped(rng: np.random.Generator, n_rows: int) -> FloatArray:
    slots = rng.integers(0, 2, (20, n_rows // 4 + 1)).astype(np.float64)
    return np.repeat(np.repeat(slots, 4, axis=1)[:, :n_rows], 4, axis=0) * 0.3


@pytest.mark.parametrize(
    ("kind", "reason"),
    [("dark", "screen_dark"), ("still", "no_stripes"), ("part", "part_striped"), ("random", "no_headers")],
)
def test_pictures_that_cannot_work_are_named(kind: str, reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    n_rows = 800
    light = rng.normal(0.3 if kind != "dark" else 0.0, 0.002, (80, n_rows))
    if kind == "part":
        light[:, :300] = _striped(rng, 300) + rng.normal(0, 0.002, (80, 300))
    if kind == "random":
        light = _striped(rng, n_rows) + rng.normal(0, 0.002, light.shape)
    found = _flat_stripes(light)
    propose(found, SCREENS)
    monkeypatch.setattr(stripes, "half_width", None)  # what was measured is not measured again for the reason
    assert why_not(found).reason == reason


def test_pictures_without_stripes_propose_nothing() -> None:
    assert not (propose(_flat_stripes(np.zeros((40, 400))), SCREENS))
    rng = np.random.default_rng(4)
    noise = _flat_stripes(rng.normal(0.3, 0.002, (40, 400)))
    assert not propose(noise, SCREENS)
    assert not propose_slots(noise)


def test_a_spectrum_without_a_peak_proposes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """As of small pictures: it falls over all rates that slots may have."""
    light = _striped(np.random.default_rng(1), 400)
    assert propose_slots(_flat_stripes(light))
    monkeypatch.setattr(proposals, "_slot_line", lambda columns: 1 / (1.0 + np.arange(50 * columns.shape[1])))
    assert not propose_slots(_flat_stripes(light))


def test_rows_against_the_readout_are_turned_and_back() -> None:
    rng = np.random.default_rng(5)
    light, inside, rows = rng.random((2, 3, 7)), rng.random((2, 3, 7)) > 0.5, np.arange(4, 11)
    profiles = profiles_of(light, inside=inside, rows=rows, sensor_row=rows + rng.random((2, 3, 7)))
    turned = in_time_order(profiles, 20)
    assert turned.rows.tolist() == list(range(9, 16))
    assert turned.sensor_row is not None
    np.testing.assert_array_equal(turned.light[..., 0], profiles.light[..., -1])
    again = in_time_order(turned, 20)
    np.testing.assert_array_equal(again.rows, profiles.rows)
    np.testing.assert_allclose(again.sensor_row, profiles.sensor_row)


CAPTURES = [
    ("phone_coffee_8k65", "paper-8k65", 20, 17),
    ("phone_astronaut_17k3", "paper-17k3", 20, 15),
    ("phone_motorcycle_17k3_near", "paper-17k3", 20, 19),
]


@pytest.mark.parametrize(("name", "screen", "sent", "floor"), CAPTURES)
@pytest.mark.parametrize("scale", [1.0, 0.6])
def test_captures_of_unknown_cameras_decode(
    shared_captures: Path, name: str, screen: str, sent: int, floor: int, scale: float
) -> None:
    """As stored, and as a messenger's copy: no metadata, 60 % of the size."""
    import json

    truth = json.loads((shared_captures / f"{name}.truth.json").read_text())
    frame = next(iter(open_source(str(shared_captures / truth["capture"]))))
    camera = truth["camera"]
    lens = Lens(np.array(camera["camera_matrix"]), np.array(camera["dist_coeffs"]), corrected=True)
    corners = geometry.undistort(np.array(truth["corners_sensor_px"]), lens)
    if scale != 1.0:
        small = cv2.resize(frame.pixels, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        frame, corners = Frame(small, name), (corners + 0.5) * scale - 0.5
    result = next(receive([frame], ReceiverOptions(screens=SCREENS, cameras=(), corners=corners, cae="never")))
    assert result.screen_profile == screen
    assert result.line_delay_s == pytest.approx(camera["line_delay_s"] / scale, rel=1.5e-3)
    right = sum(
        packet.payload in {payload[column.column] for payload in truth["payload"].values()}
        for column in result.columns
        for packet in column.packets
    )
    assert right >= floor - (3 if scale != 1.0 else 0)
    assert sent == len(result.columns)


def test_dark_columns_do_not_hide_the_width_of_the_stripes() -> None:
    """A night picture: two columns are lit, the others show a developed picture's noise that no model foretells."""
    rng, rows_per_slot, n_rows = np.random.default_rng(5), 14, 1400
    light = cv2.blur(rng.normal(0.01, 4e-3, (40, n_rows)), (3, 1)).astype(np.float32)
    light[20:24] += 0.1 * rng.integers(0, 2, (2, n_rows // rows_per_slot)).repeat(2, axis=0).repeat(
        rows_per_slot, axis=1
    )
    places = np.zeros((40, n_rows)), np.arange(float(n_rows))
    strips = ColumnStrips(light, np.ones_like(light), *places, 20, NoiseModel(1e-9, 1e-9), 4000, n_rows)
    assert 0.4 < Stripes(strips).half_width / rows_per_slot < 1


def test_columns_that_lean_are_compared_from_their_first_rows() -> None:
    """Lags at which no column has rows left would make any repetition a surprise."""
    rng, columns = np.random.default_rng(3), np.zeros((4, 500), np.float32)
    light = rng.choice(np.array([-1, 1], np.float32), (4, 120))
    for number, own in enumerate(light):
        columns[number, 100 * number : 100 * number + 120] = own
    np.testing.assert_array_equal(proposals._from_their_tops(columns), light)
    assert proposals._surprise(stripes.autocorrelation(proposals._from_their_tops(columns)), 20)[1:].max() < 10
    assert proposals._surprise(stripes.autocorrelation(columns), 20)[1:].max() > 1e3
