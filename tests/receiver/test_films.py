"""Clips of a screen whose picture changes: it is not taken for a motion of the screen, nor for what it was before."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from rxcli.lab.simulate.capture import Recording, prepare
from rxcli.lab.simulate.film import Film
from rxcli.options import SKIPS
from rxcli.receiver.channel.known_picture import KnownPicture, Observation
from rxcli.receiver.clip.place import ScreenPlace
from rxcli.receiver.light import Crosstalk, NoiseModel, SlotLight
from rxcli.receiver.screen import geometry
from rxcli.results.truth import Score
from rxcli.types import Float32Array, FrameResult
from tests.receiver.test_moving_clips import filmed_by, received, scene_in_hand, surely_wrong

CORNERS = np.array([[100.0, 80.0], [1100.0, 90.0], [1090.0, 640.0], [110.0, 650.0]])
N_COLUMNS, N_FRAMES, SEED = 20, 10, 4
Received = tuple[list[FrameResult], Score]


def recording(shows: str, **changes: object) -> Recording:
    """A recording of a film by a camera at rest."""
    scene = scene_in_hand(0.0, N_FRAMES, film=Film(shows), frame_rate_hz=30.0, picture="chelsea")
    return prepare(replace(scene, **changes), SEED)  # type: ignore[arg-type]


def received_of(take: Recording) -> Received:
    return received(filmed_by(take))


@pytest.fixture(scope="module")
def pan() -> Recording:
    return recording("pan:-3")


@pytest.fixture(scope="module")
def received_pan(pan: Recording) -> Received:
    return received_of(pan)


def test_a_picture_that_moves_does_not_move_the_screen(pan: Recording, received_pan: Received) -> None:
    results, _ = received_pan
    true = np.array(pan.truth("clip")["corners_sensor_px"])
    column_px = np.ptp(true[:, 0]) / N_COLUMNS
    for result in results:
        assert result.corners is not None
        assert np.abs(np.array(result.corners) - true)[:, 0].max() < 0.25 * column_px


def test_a_film_gives_its_packets_and_none_that_is_sure_and_wrong(pan: Recording, received_pan: Received) -> None:
    results, score = received_pan
    at_rest = received_of(pan.plain)[1]
    assert score.error_free >= 0.9 * at_rest.error_free
    assert surely_wrong(results) == 0


@pytest.mark.parametrize("shows", ["pan:6+subtitles", "scroll:3"])
def test_a_film_gives_what_its_frames_give_one_by_one(shows: str) -> None:
    clip = filmed_by(recording(shows))
    results, score = received(clip)
    one_by_one = received(clip, skip=frozenset(SKIPS) - {"tracking"})[1]
    assert score.error_free >= 0.95 * one_by_one.error_free
    assert surely_wrong(results) == 0


def test_a_film_received_promptly_gives_the_same_and_certain_frames_are_passed_over() -> None:
    """As by a live camera, whose first results are not held back until doubts are settled."""
    scene = scene_in_hand(0.0, 24, film=Film("pan:-3"), frame_rate_hz=30.0, picture="chelsea")
    clip = filmed_by(prepare(replace(scene, screen=msgspec.structs.replace(scene.screen, repeats=14)), SEED))
    _, every = received(clip)
    results, score = received(clip, prompt=True, stop_when_certain=True)
    assert any(result.skipped.get("certain_frames") for result in results)
    assert score.error_free == every.error_free > 0
    assert score.false == surely_wrong(results) == 0


# -- where the screen is -----------------------------------------------------------------------------------------------


def place(log_odds: float = -3.0) -> ScreenPlace:
    return ScreenPlace.at(CORNERS, N_COLUMNS, None, log_odds)


def moved(corners: np.ndarray, columns: float) -> np.ndarray:
    return geometry.beside(corners, columns / N_COLUMNS, None)


@pytest.mark.parametrize("is_film", [True, False])
def test_columns_tell_a_moving_picture_from_a_moving_screen(is_film: bool) -> None:
    here, picture = place(), CORNERS
    for number in range(1, 6):
        before, picture = picture, moved(CORNERS, 0.1 * number)
        here = here.after(before, picture)
        true = CORNERS if is_film else picture
        read = here.likelier.corners
        off = N_COLUMNS * geometry.sides_off(true, read, None)
        here = here.measured(read, off, 0.01**2 * np.eye(2))
        assert here.is_film == is_film
        assert np.abs(here.likelier.corners - true).max() < 5


def test_columns_are_found_beside_where_they_were_read() -> None:
    """Light by the model with the strips elsewhere than they are taken to be; left and right are off unlike."""
    rng = np.random.default_rng(3)
    n_strips, n_rows, spread = 4, 600, 0.45
    picture = rng.uniform(0.2, 0.5, (N_COLUMNS, n_strips, n_rows)).astype(np.float32)
    bits = rng.integers(0, 2, (N_COLUMNS, n_rows // 5 + 2)).astype(np.float32)
    slots = SlotLight(bits).mean_over(np.arange(n_rows)[None] / 5 + 0.5, 1.0)
    known = KnownPicture(picture.shape, 0.0, NoiseModel(1e-6, 0.0))
    inside, ones, crosstalk = np.ones(picture.shape, bool), np.ones_like(slots), Crosstalk.of(n_strips, spread)
    for _ in range(3):
        known.learn(Observation(light_at(picture, slots, np.zeros(N_COLUMNS), spread), slots, ones, inside, crosstalk))
    off = np.linspace(-0.05, 0.1, N_COLUMNS)
    near, far = (Crosstalk.of(n_strips, spread, offset=each).shares for each in (-0.01, 0.01))
    found = known.placed(inside, crosstalk).displacement(
        light_at(picture, slots, off, spread), slots, ((far - near) / 0.02).astype(np.float32)
    )
    assert found is not None
    assert found[0] == pytest.approx([-0.05, 0.1], abs=0.015)
    assert (np.sqrt(np.diag(found[1])) < 0.02).all()


def light_at(picture: Float32Array, slots: Float32Array, off: np.ndarray, spread: float) -> Float32Array:
    """Light (C, S, R) of strips that lie `off` (C,) columns to the right of their places."""
    light = np.zeros_like(picture)
    for column, each in enumerate(off):
        shares = Crosstalk.of(picture.shape[1], spread, offset=each).shares
        for k in (-1, 0, 1):
            if 0 <= column + k < len(picture):
                light[column] += picture[column] * shares[:, k + 1, None] * slots[column + k]
    return light


# -- what the picture is -----------------------------------------------------------------------------------------------


def test_a_picture_follows_the_light_of_a_frame_that_it_does_not_explain() -> None:
    rng = np.random.default_rng(6)
    shape = (6, 4, 400)
    crosstalk = Crosstalk(np.tile([0.0, 1.0, 0.0], (4, 1)))
    known, inside = KnownPicture(shape, 0.0, NoiseModel(1e-6, 0.0)), np.ones(shape, bool)
    picture = rng.uniform(0.2, 0.5, (6, 4, 1)).astype(np.float32) * np.ones(shape, np.float32)
    words = np.stack([rng.permutation([0, 1] * 5) for _ in range(6 * 9)]).reshape(6, -1).astype(np.float32)
    slots = SlotLight(words).mean_over(np.arange(shape[2])[None] / 5 + 0.5, 1.0)
    for _ in range(10):
        known.learn(Observation(picture * slots[:, None], slots, np.ones_like(slots), inside, crosstalk))
    changed = picture.copy()
    changed[:3] *= 0.5
    placed = known.placed(inside, crosstalk)
    adapted = placed.adapted(changed * slots[:, None], None, 5.0).picture[..., 60:-60]
    changed, before = changed[..., 60:-60], placed.picture[..., 60:-60]
    assert np.abs(adapted[:3] / changed[:3] - 1).mean() < 0.1
    assert np.abs(adapted[3:] / before[3:] - 1).mean() < 0.1


def test_a_picture_that_moves_on_the_screen_keeps_what_stays_on_it() -> None:
    rng = np.random.default_rng(7)
    shape, shift = (6, 4, 100), 5
    crosstalk, ones = Crosstalk(np.tile([0.0, 1.0, 0.0], (4, 1))), np.ones((6, 100), np.float32)
    known, inside = KnownPicture(shape, 0.0, NoiseModel(1e-6, 0.0)), np.ones(shape, bool)
    picture = np.repeat(rng.uniform(0.2, 0.5, (24, 1)), 100, axis=1).reshape(shape).astype(np.float32)
    for _ in range(10):
        update = known.learn(Observation(picture, ones, ones, inside, crosstalk))
    elsewhere = known.placed(np.ones(shape, bool), crosstalk, None, shift).picture.reshape(24, 100)
    assert elsewhere[shift:] == pytest.approx(picture.reshape(24, 100)[:-shift], rel=0.05)
    left = known.without(update).placed(np.ones(shape, bool), crosstalk, None, shift).picture.reshape(24, 100)
    assert left[shift:] == pytest.approx(picture.reshape(24, 100)[:-shift], rel=0.05)
