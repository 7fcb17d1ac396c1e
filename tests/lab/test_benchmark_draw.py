"""What the benchmark draws: as asked for, the same for the same seed, and as in earlier versions."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from rxcli.lab.benchmark import draw
from rxcli.lab.benchmark.cases import WAYS
from rxcli.lab.benchmark.draw import DRAWERS, Place
from rxcli.lab.benchmark.measures import MEASURES
from rxcli.lab.benchmark.media import Medium
from rxcli.lab.benchmark.runner import scenarios
from rxcli.lab.simulate.capture import warped
from rxcli.lab.simulate.files import Encoding
from rxcli.lab.simulate.no_data import EVEN_KINDS, STRIPED_KINDS
from rxcli.lab.simulate.pictures import DARK_KINDS, draw_dark_picture
from rxcli.lab.simulate.population import Population
from rxcli.lab.simulate.scenes import preset


def test_every_row_of_the_table_names_what_there_is() -> None:
    for name, scenario in scenarios().items():
        assert scenario.draw in {*DRAWERS, "transfer"}, name
        assert set(scenario.ways) <= {*WAYS, "another kernel", "twin"}, name
        assert set(scenario.all_columns) <= MEASURES.keys(), name
        assert scenario.beside is None or scenario.beside in scenario.ways, name


def test_people_take_what_the_population_says() -> None:
    aim = {"exposure_slots": [0.4, 10.0], "packets": [1.25, 9.0], "dark": 0.5}
    population = msgspec.convert(aim, Population)
    drawn = [population.draw(np.random.default_rng(number)) for number in range(24)]
    slots = [scene.exposure_s * scene.screen.slot_rate_hz for scene, _ in drawn]
    assert 0.4 <= min(slots) < 1 < 4 < max(slots) <= 10
    assert 5 < sum(kind in DARK_KINDS for _, kind in drawn) < 19
    for scene, _ in drawn:
        sensor = scene.sensor
        assert 10e-3 <= sensor.line_delay_s * sensor.height <= 31e-3
        # The gain follows the exposure: white is as bright as ever.
        assert 1.6 <= sensor.full_scale_e / (scene.light_e_per_s * scene.exposure_s * scene.isp.gain) <= 2.4
    assert {scene.orientation for scene, _ in drawn} == {1, 3}
    again, _ = population.draw(np.random.default_rng(5))
    assert replace(again, picture="") == replace(drawn[5][0], picture="")


@pytest.mark.parametrize("name", [name for name, row in scenarios().items() if row.draw == "people"])
def test_points_of_populations_can_be_drawn(name: str) -> None:
    for point in scenarios()[name].points.values():
        people = msgspec.convert(scenarios()[name].base | point, draw.People)
        scene, _ = people.draw(np.random.default_rng(3))
        assert scene.screen.name in people.screens
        assert scene.n_frames == people.n_frames
        sensor = scene.sensor
        if people.width_px is not None:
            assert people.width_px[0] <= sensor.width + 0.5 <= people.width_px[1] + 1
        corners = scene.view.corners
        assert (corners > -0.1 * sensor.width).all()
        assert people.encoding(scene, np.random.default_rng(1))[0] in people.codecs


@pytest.mark.parametrize("kind", DARK_KINDS)
def test_dark_pictures_are_dark_but_not_black(kind: str) -> None:
    picture, again = (draw_dark_picture(kind, np.random.default_rng(3), 683, 384) for _ in range(2))
    assert picture.shape == (384, 683, 3)
    assert picture.max() > 60
    assert np.mean(picture.max(axis=2) < 40) > 0.1
    assert np.array_equal(picture, again)


def no_data_frames(kind: str, seed: int) -> list[np.ndarray[Any, Any]]:
    """Two small frames of a kind without data."""
    scene, _ = draw.no_data_scene(kind, np.random.default_rng(seed), 2)
    take = draw.prepare(scene.scaled(0.3, keep_readout=True), seed)
    return [take.frame(number).pixels for number in range(2)]


@pytest.mark.parametrize("kind", [*STRIPED_KINDS, *EVEN_KINDS])
def test_every_kind_without_data_is_drawn_and_drawn_again(kind: str) -> None:
    one, again = no_data_frames(kind, 4), no_data_frames(kind, 4)
    assert one[0].std() > 0.5
    np.testing.assert_array_equal(one, again)


def test_switched_light_moves_from_frame_to_frame_and_slats_do_not() -> None:
    """Rows of the frames: those of a lamp are at another place of its period, those of slats are where they were."""

    def likeness(kind: str) -> float:
        by_row = [np.diff(frame.astype(np.float64).mean(axis=1)) for frame in no_data_frames(kind, 11)]
        return float(np.corrcoef(*by_row)[0, 1])

    assert likeness("blinds") > 0.9
    assert likeness("pwm") < 0.8


def test_every_other_picture_without_data_is_striped(tmp_path: Path) -> None:
    cases = [next(draw.draw_nodata(Place(3, number, {"camera_named": True}, tmp_path))) for number in range(2)]
    assert cases[0].about["kind"] in STRIPED_KINDS
    assert cases[1].about["kind"] in EVEN_KINDS
    assert all(case.options.force_camera and not case.has_data for case in cases)


def test_files_of_captures_go_away(tmp_path: Path) -> None:
    small = preset("video-1080p", "paper-8k65").scaled(0.2, 0.2, keep_readout=True)
    recording = draw.prepare(replace(small, n_frames=2), 44)
    with draw.recorded(recording, Place(0, 44, {}, tmp_path), encoding=Encoding("hevc", 10**6)) as case:
        (path,) = case.source
        assert isinstance(path, Path)
        assert path.stat().st_size > 1000
    assert not path.parent.exists()


def test_points_of_sweeps_have_scenes() -> None:
    for scenario in (scenario for scenario in scenarios().values() if scenario.draw == "point"):
        for point in ({**scenario.base, **values} for values in scenario.points.values()):
            scene = draw.scene_at(**point)
            narrow = point.get("is_binned", True)
            assert scene.screen.columns == point.get("columns", 20)
            assert not narrow or scene.sensor.width <= scene.screen.columns * 46


def test_rows_are_moved_smoothly_and_no_further_than_said() -> None:
    ramp = np.add.outer(np.arange(200), np.arange(300)).astype(np.uint16) * 10  # a pixel either way is ten levels
    moves = []
    for seed in range(20):
        share = (6 / 300, 0.0) if seed % 2 else (0.0, 6 / 200)
        pixels = warped(ramp, np.random.default_rng(seed), share).astype(np.float64)
        moved = (pixels - ramp)[10:-10, 10:-10] / 10
        assert np.ptp(moved, axis=1).max() <= 0.2  # rows keep their shape
        assert np.abs(np.diff(moved[:, 0])).max() < 0.6
        moves.append(np.abs(moved).max())
    assert 3 < max(moves) <= 6.1


def test_binning_keeps_the_electrons() -> None:
    whole = preset("xs10-still", "paper-17k3")
    narrow = draw.binned(whole, 0.25)
    assert narrow.sensor.height == whole.sensor.height
    white, old_white = (scene.light_e_per_s / scene.sensor.full_scale_e for scene in (narrow, whole))
    assert white == pytest.approx(old_white)
    assert narrow.light_e_per_s * narrow.sensor.width == pytest.approx(whole.light_e_per_s * whole.sensor.width)
    assert draw.binned(whole, 1.5) is whole


@pytest.mark.parametrize("name", ["speed/4K, 24 frames", "speed/1080p, 300 frames", "memory/clip of 1000"])
def test_the_payload_comes_again_with_the_first_frame_of_a_clip(name: str) -> None:
    scenario, _, point = name.partition("/")
    medium = Medium(**scenarios()[scenario].points[point])
    scene = medium.scene
    bursts = scene.n_frames * scene.screen.slot_rate_hz / scene.frame_rate_hz
    bursts /= scene.screen.packet_slots * scene.screen.repeats
    assert bursts == pytest.approx(round(bursts), abs=1e-9)
    assert scene.payload is not None
    bits = {"paper-8k65": 35, "paper-17k3": 77, "paper-34k6": 168}[medium.screen] * 20 * round(bursts)
    assert len(scene.payload) == bits // 8
    assert scene.sensor.width % 2 == scene.sensor.height % 2 == 0


def test_a_film_and_a_tilt_have_twins(tmp_path: Path) -> None:
    """The twin sends the same to an upright camera before a picture at rest, under the same options."""
    small = {"cameras": ["video-1080p"], "screens": ["paper-17k3"], "width_px": [384, 384], "rows": [0.2, 0.2]}
    film = {**small, "films": ["cut"], "n_frames": 2}
    tilt = {**small, "tilt_deg": [30.0, 0.0, 0.0]}
    for point, is_photo in ((film, False), (tilt, True)):
        with_twin = next(draw.draw_people(Place(3, 1, point, tmp_path, twin=True)))
        alone = next(draw.draw_people(Place(3, 1, point, tmp_path)))
        assert alone.twin is None
        twin = with_twin.twin
        assert twin is not None
        assert twin.truth is not None
        assert with_twin.truth is not None
        assert (len(twin.trials) == 1) == is_photo
        assert twin.options == with_twin.options
        common = twin.truth.payload.keys() & with_twin.truth.payload.keys()
        assert common
        assert all(twin.truth.payload[burst] == with_twin.truth.payload[burst] for burst in common)
        corners, upright = with_twin.corners, twin.corners
        assert corners is not None
        assert upright is not None
        lean = np.degrees(np.arctan2(*(corners[1] - corners[0])[::-1])) % 180
        lean_of_twin = np.degrees(np.arctan2(*(upright[1] - upright[0])[::-1])) % 180
        assert abs((lean - lean_of_twin + 90) % 180 - 90) == pytest.approx(30 if is_photo else 0, abs=3)


def test_tilted_screens_stay_in_view_and_zero_tilt_draws_as_before() -> None:
    tilted = Population(tilt_deg=(50.0, 30.0, 30.0), tilt_share=(0.0, 1.0))
    for number in range(8):
        scene, _ = tilted.draw(np.random.default_rng(number))
        sensor = scene.sensor
        corners = scene.view.corners
        assert (corners > -1).all()
        assert (corners < [sensor.width, sensor.height]).all()


def test_media_have_an_exposure_and_need_not_show_a_screen() -> None:
    points = scenarios()["speed"].points
    long = Medium(**points["phone 12 MP, 4 slots"]).scene
    assert long.exposure_s * long.screen.slot_rate_hz == pytest.approx(4)
    steady = draw.prepare(Medium(**points["phone 12 MP, no screen"], scale=0.1).scene, 1)
    (lit,) = steady.exposure().lit
    assert lit == pytest.approx(np.ones_like(lit))
    edges = steady.exposure().pixels_to_screen(np.array([[0.0, 0], [399, 0], [399, 299], [0, 299]]))
    assert ((edges > 0) & (edges < 1)).all()
    rows = steady.frame().rgb[..., 1].astype(float).mean(axis=1)
    assert np.abs(np.diff(rows)).max() < 0.2 * rows.mean()
