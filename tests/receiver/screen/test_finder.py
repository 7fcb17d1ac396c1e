"""The outlines that the finder proposes, on pictures drawn here: no side of the screen need show."""

import tracemalloc
from dataclasses import replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.lab.benchmark.trial import simulate_trial
from rxcli.lab.simulate.scenes import preset
from rxcli.receiver.plane.read import read_plane
from rxcli.receiver.screen import find, geometry
from rxcli.receiver.screen.bright import bright_parts
from rxcli.receiver.screen.combs import find_combs
from rxcli.receiver.screen.find import (
    ColumnLayout,
    find_screens,
    why_useless,
    wide_grids,
)
from rxcli.receiver.screen.grid import Grid, columns_at, grid_between, grid_through
from rxcli.receiver.screen.numbering import (
    WEIGHTS,
    LightProfile,
    _faint_light,
    first_column_features,
    first_columns,
    light_profile,
    numbering_weights,
)
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.screen.pose import corners_by_slots
from rxcli.receiver.screen.rows import lit_range
from rxcli.receiver.screen.strips import PictureStrips, read_strips, shows_narrow_columns
from rxcli.receiver.screen.waveforms import moved_by_waveforms, predicted_light, with_light
from rxcli.types import Clock, FloatArray, Frame, Lens, LightPlane, Mosaic, Remark

ASPECT = 16 / 9
WIDE, NARROW = ColumnLayout(20, 0.45, ASPECT), ColumnLayout(100, 0.5, ASPECT)
HEIGHT, WIDTH = 1600, 1200
NARROW_HEIGHT, NARROW_WIDTH = 1120, 1680
#: Tilted by 4 and 3 degrees, turned by 1, before a lens of 0.8 picture widths.
CORNERS = np.array([[144.0, 300.0], [1161.0, 281.0], [1136.0, 871.0], [150.0, 849.0]])
NARROW_CORNERS = np.array([[110.0, 120.0], [1575.0, 150.0], [1560.0, 985.0], [95.0, 950.0]])


def draw(
    picture: str,
    corners: FloatArray = CORNERS,
    *,
    n_columns: int = 20,
    rows_per_slot: float = 10.0,
    bend: float = 0.0,
    seed: int = 0,
    size: tuple[int, int] = (HEIGHT, WIDTH),
    room: float = 0.0,
) -> NDArray[np.uint8]:
    """Luma of a screen whose columns send random slots behind a picture, with row noise.

    `bend`: of a picture that was corrected in the camera, see `strips`. `room`: grey levels of the room around the
    screen and its dark frame.
    """
    height, width = size
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width].astype(np.float32)
    seen = np.linalg.inv(geometry.homography(corners)).astype(np.float32)
    below = seen[2, 0] * x + seen[2, 1] * y + seen[2, 2]
    u, v = ((row[0] * x + row[1] * y + row[2]) / below for row in seen[:2])
    sent = rng.integers(0, 2, (int(height / rows_per_slot) + 40, n_columns + 6)).astype(np.float32)
    centred_x, centred_y = (x - (width - 1) / 2) / width, (y - (height - 1) / 2) / width
    sensor_row = y + bend * centred_y * (centred_x**2 + centred_y**2) * width
    slot = np.clip(sensor_row / rows_per_slot + 20, 0, len(sent) - 1).astype(int)
    light, own = np.zeros_like(u), np.clip(np.floor(n_columns * u), 0, n_columns - 1).astype(int)
    for beside in (-2, -1, 0, 1, 2):
        spread = np.exp(-((n_columns * u - own - beside - 0.5) ** 2) / (2 * 0.47**2))
        light += spread * sent[slot, own + beside + 3]
    light *= shown(picture, u, v) * ((u > 0) & (u < 1) & (v > 0) & (v < 1))
    luma = (
        150 * light
        + 12
        + room * ((np.abs(u - 0.5) > 0.53) | (np.abs(v - 0.5) > 0.55))
        + rng.normal(0, 4, u.shape)
        + rng.normal(0, 0.5, (height, 1))
    )
    return np.clip(luma, 0, 255).astype(np.uint8)


def shown(picture: str, u: NDArray[np.float32], v: NDArray[np.float32]) -> NDArray[np.float32] | float:
    """What a picture lets through of the light."""
    if picture == "white":
        return 1.0
    if picture == "letterbox":
        return ((v > 0.13) & (v < 0.87)).astype(np.float32)
    if picture == "film":
        return ((u > 0.13) & (u < 0.87)).astype(np.float32)
    if picture == "gap":
        return (np.abs(u - 0.47) > 0.1).astype(np.float32)
    if picture == "person":
        return (np.abs(u - 0.25) > 0.16).astype(np.float32)
    if picture == "dark sides":
        return ((u > 0.18) & (u < 0.86)).astype(np.float32)
    if picture == "fading":
        return np.clip(1 - np.abs(u - 0.5) / 0.35, 0, 1)
    if picture == "round":
        return (np.hypot((u - 0.5) * 16 / 9, v - 0.5) < 0.88).astype(np.float32)
    if picture == "window":
        return np.where((u > 0.07) & (u < 0.8) & (v > 0.2) & (v < 0.7), 0.9, 0.06).astype(np.float32)
    return (0.15 + 0.85 * (np.sin(23 * u + 9 * v) * np.sin(17 * v - 5 * u) > 0)).astype(np.float32)


def drawn(*args: Any, **options: Any) -> LightPlane:
    """The plane of a picture drawn by `draw`."""
    return plane_of(draw(*args, **options))


def plane_of(pixels: NDArray[Any]) -> LightPlane:
    return read_plane(Frame(pixels, "memory"))


def find_outlines(plane: LightPlane, layouts: list[ColumnLayout], lens: Lens | None = None) -> list[Outline]:
    """Outlines of the clearest screen, likeliest first, with the bright parts that the receiver looks for."""
    parts = [part for part in bright_parts(plane) if part is not None] if plane.width else []
    return next(iter(find_screens(plane, layouts, lens, parts)), [])


@lru_cache(maxsize=8)
def found(picture: str) -> list[Outline]:
    return find_outlines(drawn(picture), [WIDE])


def apart(candidate: Outline, corners: FloatArray = CORNERS, lens: Lens | None = None) -> FloatArray:
    """Columns between a grid that was found and the true one, over the screen."""
    u, v = np.meshgrid(np.linspace(0.02, 0.98, 15), np.linspace(0.02, 0.98, 9), indexing="ij")
    points = geometry.screen_to_picture(np.stack([u, v], axis=-1), corners, lens)
    return candidate.grid.columns_at(points) - candidate.n_columns * u


@pytest.mark.parametrize("picture", ["white", "letterbox", "round", "window", "blobs"])
def test_the_grid_is_found_whatever_the_picture(picture: str) -> None:
    off = apart(found(picture)[0])
    assert np.abs(off - np.round(np.median(off))).max() < 0.2
    assert any(round(float(np.median(apart(one)))) == 0 for one in found(picture))


@pytest.mark.parametrize("picture", ["white", "letterbox", "blobs", "window", "film"])
def test_where_light_reaches_the_ends_or_a_film_lies_in_the_middle_the_first_column_is_plain(picture: str) -> None:
    candidates = found(picture)
    assert round(float(np.median(apart(candidates[0])))) == 0
    assert len(candidates) == 1 or candidates[1].log_odds < -2


def test_where_the_outer_columns_are_dark_others_are_proposed() -> None:
    candidates = found("dark sides")
    assert candidates[1].log_odds > -3
    assert {round(float(np.median(apart(one)))) for one in candidates} >= {-1, 0, 1}
    assert {"left", "right"} & set(candidates[0].inferred)


def test_corners_follow_from_the_columns_and_the_light() -> None:
    corners = found("white")[0].corners
    assert np.abs(corners[:, 0] - CORNERS[:, 0]).max() < 0.2 * 50
    assert np.abs(corners[:, 1] - CORNERS[:, 1]).max() < 0.02 * 590
    assert found("white")[0].inferred == ()


def test_a_picture_with_bars_lies_in_the_middle_of_the_screen() -> None:
    found_height, true_height = (
        corners[2:, 1].mean() - corners[:2, 1].mean() for corners in (found("letterbox")[0].corners, CORNERS)
    )
    assert found_height == pytest.approx(true_height, rel=0.02)
    assert {"top", "bottom"} <= set(found("letterbox")[0].inferred)


@pytest.mark.parametrize("rows_per_slot", [1.6, 3.0, 8.0])
def test_slots_of_few_and_of_many_rows(rows_per_slot: float) -> None:
    candidates = find_outlines(drawn("white", rows_per_slot=rows_per_slot), [WIDE])
    assert np.abs(apart(candidates[0])).max() < 0.2


@pytest.mark.parametrize(
    "angles",
    [(20, 0, 0), (-45, 0, 0), (0, 40, 0), (0, 0, 35), (-20, 10, 20)],
    ids=["roll", "far rolled", "yaw", "pitch", "all"],
)
def test_columns_that_lean_are_found(angles: tuple[float, float, float]) -> None:
    corners = seen_from(*angles)
    best = find_outlines(drawn("blobs", corners, size=(900, 1200), rows_per_slot=4.0), [WIDE])[0]
    assert np.abs(apart(best, corners)).max() < 0.4
    assert np.abs(best.corners - corners).max() < 30


def test_a_course_is_the_columns() -> None:
    corners = seen_from(30, 20, 10)
    course = grid_between(corners, 20, (1200, 900), None).course
    v = np.linspace(0, 1, 5)
    down = geometry.screen_to_picture(np.stack([np.full(5, 0.3), v], axis=-1), corners, None)
    x, y = ((down - [599.5, 449.5]) / 1200).T
    assert np.ptp(course.across(x, y)) < 1e-9
    slopes = (x[1:] - x[:-1]) / (y[1:] - y[:-1])
    np.testing.assert_allclose(course.slope((x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2), slopes, rtol=1e-3)


def seen_from(roll: float, yaw: float, pitch: float) -> FloatArray:
    """Corners of a screen in a picture of 1200 x 900, before a camera turned by some degrees."""
    (cr, sr), (cy, sy), (cp, sp) = ((np.cos(a), np.sin(a)) for a in np.deg2rad([roll, yaw, pitch]))
    turn = np.array([[cr, -sr, 0], [sr, cr, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    turn = turn @ np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    places = np.array([[-8.0, -4.5], [8, -4.5], [8, 4.5], [-8, 4.5]]) @ turn[:, :2].T + [0, 0, 18 + roll**2 / 500]
    return 960 * places[:, :2] / places[:, 2:] + [599.5, 449.5]


def test_bent_stripes_leave_the_grid_where_it_is() -> None:
    """As of a picture that was corrected in the camera."""
    bent = find_outlines(drawn("white", bend=0.3, rows_per_slot=5.0), [WIDE])
    assert np.abs(apart(bent[0])).max() < 0.2


@pytest.mark.parametrize("pattern", [[[0, 1], [1, 2]], [[0, 1, 2], [1, 2, 0], [2, 0, 1]]], ids=["bayer", "all colours"])
def test_a_screen_is_found_on_a_mosaic(pattern: list[list[int]]) -> None:
    gains, kinds = (2.0, 1.0, 1.5), np.array(pattern, np.uint8)
    n = len(kinds)
    share = 1 / np.array(gains)[np.tile(kinds, (HEIGHT // n + 1, WIDTH // n + 1))[:HEIGHT, :WIDTH]]
    mosaic = Mosaic(kinds, gains, black=(1000.0, 1000.0, 1000.0), white=16000.0)
    frame = Frame((draw("white") * share * 50 + 1000).astype(np.uint16), "memory", mosaic=mosaic)
    candidates = find_outlines(read_plane(frame), [WIDE])
    assert np.abs(apart(candidates[0])).max() < 0.2


def test_a_lens_that_is_known_is_taken_off() -> None:
    lens = Lens(np.array([[1100.0, 0, 599.5], [0, 1100.0, 799.5], [0, 0, 1]]), np.array([-0.12, 0, 0, 0]), False)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    flat = geometry.undistort(np.stack([x, y], axis=-1), lens).astype(np.float32)
    # Every row of the picture as the sensor read it: light comes from its place on the screen, slots from its row.
    rng = np.random.default_rng(5)
    seen = np.linalg.inv(geometry.homography(CORNERS)).astype(np.float32)
    place = np.concatenate([flat, np.ones_like(flat[..., :1])], axis=-1) @ seen.T
    u, v = place[..., 0] / place[..., 2], place[..., 1] / place[..., 2]
    sent = rng.integers(0, 2, (HEIGHT // 10 + 1, 20)).astype(np.float32)[np.arange(HEIGHT) // 10]
    light = sum(np.exp(-((20 * u - k - 0.5) ** 2) / (2 * 0.45**2)) * sent[:, k, None] for k in range(20))
    light = light * ((u > 0) & (u < 1) & (v > 0) & (v < 1))
    luma = np.clip(150 * light + 12 + rng.normal(0, 4, u.shape), 0, 255).astype(np.uint8)
    candidates = find_outlines(plane_of(luma), [WIDE], lens)
    bent = geometry.distort(CORNERS, lens)
    assert np.abs(apart(candidates[0], bent, lens)).max() < 0.4
    np.testing.assert_allclose(candidates[0].corners, bent, atol=25)


def test_columns_that_a_lens_bends_are_read_through_it() -> None:
    straight = grid_between(CORNERS, 100, (WIDTH, HEIGHT), None)
    grid = replace(straight, coefficients=straight.coefficients + np.array([0, 0, 0, 0, 0, 0.04]))
    corners, lens = grid.pixels_of(np.stack(straight.flat(CORNERS), axis=-1)), grid.estimated_lens
    assert lens is not None
    u, v = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 7), indexing="ij")
    points = np.stack([u, v], axis=-1)
    off = grid.columns_at(geometry.screen_to_picture(points, corners, lens)) - 100 * u
    assert np.abs(off).max() < 0.02
    assert np.abs(grid.columns_at(geometry.screen_to_picture(points, corners, None)) - 100 * u).max() > 0.15
    assert replace(grid, lens=lens).estimated_lens is None


@pytest.mark.parametrize("is_turned", [False, True])
def test_decided_slots_move_the_columns_to_their_place(is_turned: bool) -> None:
    strips = read_strips(plane_of(draw("letterbox")))
    n_slots = HEIGHT // 10 + 40
    sent = np.random.default_rng(0).integers(0, 2, (n_slots, 26)).astype(np.float32)
    clock = Clock(10.0, 0.1, n_slots, -200.5, n_slots, 0, np.zeros(1, np.int64), np.zeros(20), 1.0)
    along = (CORNERS[1] - CORNERS[0]) / 20
    before = CORNERS + np.outer([-0.3, 0.2, 0.3, -0.1], along)
    lit = sent[:, 3:23].T
    if is_turned:  # Corners and columns are a viewer's, who sees the stored picture upside down.
        before, lit = before[[2, 3, 0, 1]], lit[::-1]
    corners = corners_by_slots(
        Outline(before, strips=strips), ColumnLayout(20, 0.47, ASPECT), clock, np.ascontiguousarray(lit), None
    )
    corners = corners[[2, 3, 0, 1]] if is_turned else corners
    off = (corners - CORNERS) @ along / (along @ along)
    assert np.abs(off).max() < 0.1
    assert np.abs((corners - CORNERS)[:, 1]).max() < 12


def test_a_screen_larger_than_the_picture_shows_no_side() -> None:
    large = np.array([[-160.0, 300.0], [1380.0, 280.0], [1400.0, 1170.0], [-180.0, 1140.0]])
    candidates = find_outlines(drawn("white", large), [WIDE])
    assert candidates[0].fills
    assert {"left", "right"} <= set(candidates[0].inferred)
    off = apart(candidates[0], large)
    assert np.abs(off - np.round(np.median(off))).max() < 0.3


def test_numbers_of_columns_compete() -> None:
    candidates = find_outlines(drawn("white"), [ColumnLayout(n, 0.45, ASPECT) for n in (10, 20, 40)])
    assert candidates[0].n_columns == WIDE.n_columns
    assert np.abs(apart(candidates[0])).max() < 0.2


def test_the_true_grid_explains_more_than_others_and_is_reached_from_near() -> None:
    strips, true = read_strips(drawn("blobs")), grid_between(CORNERS, 20, (WIDTH, HEIGHT), None)
    own = with_light(strips, true, 0.45)
    for factor in (0.8, 0.95, 1.05, 1.3):
        other = with_light(
            strips, replace(true, coefficients=true.coefficients * np.array([factor, factor, factor, 1, 1, 1])), 0.45
        )
        assert other.explained + 3 * other.contrast < own.explained + 3 * own.contrast
    near = replace(
        true, coefficients=true.coefficients * np.array([1, 1.015, 1, 1, 1, 1]) + np.array([0.1, 0, 0.2, 0, 0, 0])
    )
    off = moved_by_waveforms(strips, near, 0.45, 8).coefficients[:3] - true.coefficients[:3]
    assert np.abs(off).max() < 0.3


@pytest.mark.parametrize(
    ("share", "true_light", "light"),
    [
        pytest.param(1.2, (34090, 2948), (34473, 2634), id="narrower columns explain more but stand out less"),
        pytest.param(2.0, (50758, 16398), (54738, 575), id="far too narrow ones explain more and stand out little"),
        pytest.param(0.8, (34336, 5315), (31592, 5625), id="wide ones stand out more over lamps at night"),
    ],
)
def test_grids_compare_by_contrast_and_by_what_they_explain(
    monkeypatch: pytest.MonkeyPatch, share: float, true_light: FloatArray, light: FloatArray
) -> None:
    strips, true = read_strips(drawn("blobs")), grid_between(CORNERS, 20, (WIDTH, HEIGHT), None)
    rivals = [replace(true, coefficients=true.coefficients * np.array([1, by, 1, 1, 1, 1])) for by in (1, share)]
    lights = {grid.coefficients[1]: light for grid, light in zip(rivals, (true_light, light), strict=True)}

    def lit(_: PictureStrips, grid: Grid, __: float) -> Grid:
        explained, contrast = lights[grid.coefficients[1]]
        return replace(grid, explained=explained, contrast=contrast)

    monkeypatch.setattr(find, "find_combs", lambda *_: rivals)
    monkeypatch.setattr(find, "grid_of_comb", lambda grid, _: replace(grid))
    monkeypatch.setattr(find, "moved_by_waveforms", lambda _, grid, *__: grid)
    monkeypatch.setattr(find, "with_light", lit)
    assert wide_grids(strips, 0.45)[0][1].coefficients[1] == rivals[0].coefficients[1]


def test_all_combs_are_fitted_as_borders_out_of_place_stand_out_little(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    strips, true = read_strips(drawn("blobs")), grid_between(CORNERS, 20, (WIDTH, HEIGHT), None)
    starts = [replace(true, coefficients=true.coefficients * np.array([1, 1 / n, 1, 1, 1, 1])) for n in (1, 2, 3, 4)]

    def lit(_: PictureStrips, grid: Grid, __: float) -> Grid:
        pitch, is_moved = grid.coefficients[1], not any(grid is start for start in starts)
        return replace(grid, explained=2000 * pitch, contrast=300 * pitch if is_moved else 1000 / pitch)

    monkeypatch.setattr(find, "find_combs", lambda _: starts)
    monkeypatch.setattr(find, "grid_of_comb", lambda comb, _: comb)
    monkeypatch.setattr(find, "moved_by_waveforms", lambda _, grid, *__: replace(grid))
    monkeypatch.setattr(find, "with_light", lit)
    assert wide_grids(strips, 0.45)[0][1].coefficients[1] == pytest.approx(true.coefficients[1])


def test_one_grid_over_a_dark_gap_is_one_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    plane, n_strips = drawn("gap"), read_strips(drawn("gap")).coherence.shape[1]

    def too_narrow_at_a_side(strips: PictureStrips, *rest: Any) -> list[tuple[PictureStrips, Grid]]:
        factors = np.array([1, 1.0 if strips.coherence.shape[1] == n_strips else 1.5, 1, 1, 1, 1])
        placed = wide_grids(strips, *rest)
        return [(own, replace(grid, coefficients=grid.coefficients * factors)) for own, grid in placed]

    monkeypatch.setattr(find, "wide_grids", too_narrow_at_a_side)
    (outlines,) = find_screens(plane, [WIDE])
    assert np.abs(apart(outlines[0])).max() < 0.3


@pytest.mark.parametrize("missing", [-1, 0, 1])
def test_the_columns_behind_a_person_are_counted_by_both_sides(missing: int) -> None:
    strips, true = read_strips(drawn("person")), grid_between(CORNERS, 20, (WIDTH, HEIGHT), None)
    u = columns_at(true.coefficients, strips.x, strips.y)
    lit = strips.coherence > 0.2
    wrong = grid_through(true, strips.x[lit], strips.y[lit], (u + missing * (u < 5))[lit])
    start = with_light(strips, moved_by_waveforms(strips, wrong, 0.45, 6), 0.45)
    outlines = find._of_rivals([(strips, start)], [WIDE])
    rival = max(outline.rival_odds for outline in outlines if outline.rival_odds)
    assert outlines[0].grid is not None
    off = outlines[0].grid.columns_at(CORNERS) - 20 * np.array([0, 1, 1, 0])
    assert np.abs(off).max() < 0.4
    assert rival < -np.log(9)


def profile_of(picture: str) -> LightProfile:
    strips, grid = read_strips(drawn(picture)), grid_between(CORNERS, 20, (WIDTH, HEIGHT), None)
    return light_profile(strips, predicted_light(strips, columns_at(grid.coefficients, strips.x, strips.y), 0.45), grid)


def test_a_plane_seen_edge_on_has_no_end_of_columns() -> None:
    strips, grid = read_strips(drawn("white")), grid_between(CORNERS, 20, (WIDTH, HEIGHT), None)
    edge_on = replace(grid, coefficients=grid.coefficients + np.array([0, 0, 0, 2.0004, 0, 0]))
    u = columns_at(edge_on.coefficients, strips.x, strips.y)
    assert np.ptp(u) > 1000
    assert light_profile(strips, predicted_light(strips, u, 0.45), edge_on).place.size < 5000


def test_columns_with_light_are_told_from_those_without() -> None:
    light = profile_of("window")
    inside, outside = (light.place > 3) & (light.place < 14), (light.place < -0.2) | (light.place > 20.2)
    assert light.light[inside].min() > light.light[outside].max()


def test_a_film_has_sharp_edges_and_fading_light_has_none() -> None:
    light = profile_of("film")
    rises, falls = light.edges(light.level)
    borders = light.place - 1 / 16
    np.testing.assert_allclose([borders[edge[:-1] > 0.9].mean() for edge in (rises, falls)], (2.6, 17.4), atol=0.1)
    assert max(edge.max() for edge in profile_of("fading").edges(profile_of("fading").level)) < 0.5
    columns, log_odds, _ = first_columns(light, 20, ASPECT)
    assert columns[log_odds.argmax()] == 0


def profile(start: float, end: float, *, film: tuple[float, float] | None = None, right: float = 22.0) -> LightProfile:
    """Columns' light between two places, and a bright picture of a film between two others."""
    place = (np.arange(-16, right * 8) + 0.5) / 8
    coherent = ((place > start) & (place < end)).astype(np.float64)
    level = coherent if film is None else ((place > film[0]) & (place < film[1])).astype(np.float64)
    none = np.zeros(place.size)
    parts = np.zeros((0, 2)), np.zeros(0)
    return LightProfile(place, np.ones(place.size, bool), coherent, level, none, none > 0, none, 10.0, *parts)


@pytest.mark.parametrize("film", [(2.75, 17.25), (2.5, 16.25)])
def test_bars_of_equal_width_on_both_sides_show_the_first_column(film: tuple[float, float]) -> None:
    columns, log_odds, _ = first_columns(profile(2.5, 17.5, film=film), 20, ASPECT)
    certainty = 1 / np.exp(log_odds - log_odds.max()).sum()
    is_plain = certainty > 0.8 and columns[log_odds.argmax()] == 0
    assert is_plain == (sum(film) == 20)


@pytest.mark.parametrize("first", [-1, 0, 1])
def test_the_little_light_that_a_dark_panel_passes_shows_the_first_column(first: int) -> None:
    light = profile(7, 13)
    inside = (light.place > first) & (light.place < first + 20)
    columns, log_odds, _ = first_columns(replace(light, is_faint=light.coherent == 0, faint=0.4 * inside), 20, ASPECT)
    assert columns[log_odds.argmax()] == first


@pytest.mark.parametrize("off", [0.0, 0.2, 0.9])
def test_a_part_with_the_sides_of_a_screen_shows_the_first_column(off: float) -> None:
    sides = np.array([[4.0, 15.0], [1.0 + off, 21.0 + off]])
    columns, log_odds, _ = first_columns(replace(profile(7, 13), sides=sides, heights=np.zeros(2)), 20, ASPECT)
    certainty = 1 / np.exp(log_odds - log_odds.max()).sum()
    assert columns[log_odds.argmax()] == round(1 + off)
    assert certainty > 0.9


@pytest.mark.parametrize("height", [9.0, 11.25])
def test_a_part_as_high_as_the_screen_lies_in_its_middle(height: float) -> None:
    light = replace(profile(4, 14), sides=np.array([[4.0, 14.0]]), heights=np.array([height]))
    columns, log_odds, _ = first_columns(light, 20, ASPECT)
    certainty = 1 / np.exp(log_odds - log_odds.max()).sum()
    assert (columns[log_odds.argmax()] == -1 and certainty > 0.8) == (height == 11.25)


@pytest.mark.parametrize(("step", "is_plain"), [(1.5, True), (0.1, False)])
def test_faint_light_is_measured_by_its_own_noise(step: float, is_plain: bool) -> None:
    rng, places = np.random.default_rng(3), np.arange(160)
    root = (10 + rng.normal(0, 0.3, 160) + step * (places > 40)) / 255 + 0.7 * (places > 90)
    is_faint, faint = _faint_light(root, places >= 0)
    assert np.array_equal(is_faint, places <= 90)
    assert (faint[41:44].sum() - faint[38:41].sum() > 0.75) == is_plain


def test_steady_light_around_the_screen_shows_the_first_column() -> None:
    dark, lighted = (find_outlines(drawn("dark sides", room=room), [WIDE]) for room in (0.0, 45.0))
    certainty = [
        1 / np.exp([one.log_odds - candidates[0].log_odds for one in candidates if not one.rival_odds]).sum()
        for candidates in (dark, lighted)
    ]
    assert round(float(np.median(apart(lighted[0])))) == 0
    assert certainty[0] < 0.7 < 0.9 < certainty[1]


def test_light_that_ends_just_before_the_edge_of_the_picture_ends_on_the_screen() -> None:
    columns, log_odds, fills = first_columns(profile(7, 20, right=20.4), 20, ASPECT)
    assert columns[log_odds.argmax()] == 0
    assert not fills


def test_light_across_more_columns_than_a_screen_has_does_not_fill_the_picture_with_it() -> None:
    assert [first_columns(profile(-2, right, right=right), 20, ASPECT)[2] for right in (17.5, 22.0)] == [True, False]


def test_a_side_counts_as_hidden_by_the_share_of_a_column_outside_the_picture() -> None:
    columns, features, _ = first_column_features(profile(7, 13, right=19.625), 20, ASPECT)
    hidden = dict(zip(columns.tolist(), features[:, WEIGHTS.index("hidden_unlit")].tolist(), strict=True))
    assert [round(hidden[first], 2) for first in (-3, -2, -1, 0, 1)] == [1, 0.06, 0, 0.44, 1]


@pytest.mark.parametrize(("n_columns", "is_sure"), [(20, True), (100, False)])
def test_columns_may_be_one_off_where_they_are_narrow(n_columns: int, is_sure: bool) -> None:
    light = profile(0, n_columns, film=(0, n_columns), right=n_columns + 2)
    light = replace(light, picture_middle=n_columns / 2)
    columns, log_odds, _ = first_columns(light, n_columns, ASPECT)
    assert columns[log_odds.argmax()] == 0
    assert (1 / np.exp(log_odds - log_odds.max()).sum() > 0.9) == is_sure


def test_the_shipped_weights_are_those_of_the_features() -> None:
    assert len(numbering_weights()) == first_column_features(profile(2, 18), 20, ASPECT)[1].shape[1]


def test_light_ends_where_bars_begin_and_takes_no_more_than_a_screen() -> None:
    v = (np.arange(320) + 0.5) / 320 * 2.2 - 0.6
    rng = np.random.default_rng(1)
    for low, high in ((0.0, 1.0), (0.15, 0.85)):
        top, bottom = lit_range(v, 0.5 * ((v > low) & (v < high)) + rng.normal(0, 0.03, v.size))
        assert abs(top - low) < 0.04
        assert abs(bottom - high) < 0.04
    top, bottom = lit_range(v, np.full(v.size, 0.5))
    assert bottom - top == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("picture", ["white", "fading"])
def test_the_strongest_comb_is_the_columns_and_not_that_of_the_light(picture: str) -> None:
    pitch = grid_between(CORNERS, 20, (WIDTH, HEIGHT), None).coefficients[1]
    assert find_combs(read_strips(drawn(picture)).without_common_light())[0].pitch == pytest.approx(pitch, rel=0.06)


def test_coherence_of_independent_strips_is_chance() -> None:
    luma = np.clip(100 + np.random.default_rng(4).normal(0, 10, (HEIGHT, WIDTH)), 0, 255).astype(np.uint8)
    strips = read_strips(plane_of(luma))
    pairs = strips.coherence_at(7)
    assert abs(float(pairs.mean())) < 0.01
    assert float(pairs.std()) == pytest.approx(strips.n_rows**-0.5, rel=0.3)
    assert not [comb for comb in find_combs(strips.without_common_light()) if comb.score > 7]


@lru_cache(maxsize=1)
def narrow_film() -> NDArray[np.uint8]:
    return draw("film", NARROW_CORNERS, n_columns=100, rows_per_slot=5.0, seed=5, size=(NARROW_HEIGHT, NARROW_WIDTH))


def test_a_hundred_columns_are_found_in_a_film_with_bars() -> None:
    candidate = find_outlines(plane_of(narrow_film()), [WIDE, NARROW])[0]
    assert candidate.n_columns == NARROW.n_columns
    # The film lies in the middle, and so do its columns.
    assert np.abs(apart(candidate, NARROW_CORNERS)).max() < 0.35
    grid = grid_between(NARROW_CORNERS, 100, (NARROW_WIDTH, NARROW_HEIGHT), None)
    np.testing.assert_allclose(grid.columns_at(candidate.corners), [0, 100, 100, 0], atol=0.5)
    np.testing.assert_allclose(candidate.corners[:, 1], NARROW_CORNERS[:, 1], atol=25)


def test_a_turn_of_a_narrow_column_between_two_windows_of_rows_is_not_taken_for_none() -> None:
    """In a high picture a sixteenth of the rows is high enough for columns to be turned by one of them within it."""
    corners = NARROW_CORNERS + np.array([0.0, 500.0])
    high = draw("white", corners, n_columns=100, rows_per_slot=5.0, seed=5, size=(2100, NARROW_WIDTH))
    assert np.abs(apart(find_outlines(plane_of(high), [WIDE, NARROW])[0], corners)).max() < 0.35


def test_wide_columns_are_not_taken_for_narrow_ones() -> None:
    assert shows_narrow_columns(read_strips(plane_of(narrow_film())))
    assert not shows_narrow_columns(read_strips(drawn("film")))


def test_plain_columns_are_told_from_none() -> None:
    assert find_screens(drawn("film"), [WIDE])
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH), dtype=np.uint8)
    assert not find_screens(plane_of(noise), [WIDE])
    assert not find_screens(plane_of(noise[:16, :16]), [WIDE])


def without_screen(name: str) -> NDArray[Any]:
    rng, shape = np.random.default_rng(11), (1080, 1920)
    y, x = np.mgrid[: shape[0], : shape[1]]
    texture = cv2.GaussianBlur(rng.normal(0, 1, shape).astype(np.float32), (0, 0), 6)
    pictures = {
        "grey": np.full(shape, 128.0),
        "noise": rng.integers(0, 256, shape).astype(float),
        "dim noise": rng.normal(10, 3, shape),
        "row noise": rng.normal(60, 8, (shape[0], 1)) + rng.normal(0, 8, shape),
        "stripes over all": np.tile((rng.random((216, 1)) < 0.5).repeat(5, axis=0) * 200.0, (1, 1920)),
        "checkerboard": ((x // 60 + y // 60) % 2) * 200.0 + 20,
        "texture": 100 + 1500 * texture,
        "texture with lines": 100 + 1500 * texture + 20 * np.sin(y / 3) + rng.normal(0, 4, shape),
        "flickering room": np.tile(90 + 40 * np.sin(y[:, :1] / 170), (1, 1920)),
    }
    return np.clip(pictures[name], 0, 255).astype(np.uint8)


PLAIN = ("grey", "noise", "dim noise", "row noise", "stripes over all", "checkerboard", "texture")


@pytest.mark.parametrize("name", [*PLAIN, "texture with lines", "flickering room"])
def test_pictures_without_columns_propose_nothing(name: str) -> None:
    assert not find_outlines(plane_of(without_screen(name)), [WIDE, NARROW])
    assert why_useless(without_screen(name), 0.0, 255.0) is None


def test_blocks_of_a_coder_are_no_columns() -> None:
    texture = cv2.GaussianBlur(np.random.default_rng(1).normal(0, 1, (720, 960)).astype(np.float32), (0, 0), 1)
    picture = np.clip(120 + 28 * texture, 0, 255).astype(np.uint8)
    coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 10])[1]
    assert not find_outlines(plane_of(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE)), [WIDE, NARROW])


@pytest.mark.parametrize(
    ("pixels", "reason"),
    [
        (np.zeros((1080, 1920), np.uint8), "black"),
        (np.full((1080, 1920), 255, np.uint8), "saturated"),
        (np.zeros((0, 0), np.uint8), "few_pixels"),
        (np.zeros((1, 1), np.uint8), "few_pixels"),
        (np.zeros((1, 4000), np.uint8), "few_pixels"),
        (np.zeros((20, 30), np.uint16), "few_pixels"),
    ],
)
def test_useless_pictures_are_named(pixels: NDArray[Any], reason: str) -> None:
    assert not find_outlines(plane_of(pixels), [WIDE, NARROW])
    useless = why_useless(pixels, 0.0, 255.0)
    assert useless is not None
    assert useless.reason == reason
    assert useless.facts.get("width", pixels.shape[1]) == pixels.shape[1]


@pytest.mark.parametrize("shape", [(96, 96), (97, 501), (500, 97), (240, 320)])
def test_small_pictures_do_not_fail(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(2).integers(0, 256, shape, dtype=np.uint8)
    assert not find_outlines(plane_of(noise), [WIDE, NARROW])


@pytest.mark.parametrize("height", range(1582, 1586))
def test_strips_are_read_of_any_height(height: int) -> None:
    """Only whole steps of rows count: of 1582 rows and steps of three the last one is a part."""
    noise = np.random.default_rng(1).integers(0, 255, (height, 40), np.uint8)
    assert read_strips(plane_of(noise)).height == height


def test_a_tall_picture_takes_little_memory_or_is_refused() -> None:
    """Combs are tried in steps of a column at the far end, so their number goes with the square of the height."""
    noise = np.random.default_rng(6).integers(0, 255, (6000, 720), dtype=np.uint8)
    assert find_screens(read_plane(Frame(noise[:, ::2], "memory")), [WIDE]) == []
    assert why_useless(noise[:, ::2], 0, 255) == Remark("too_tall", {"width": 360, "height": 6000, "most": 6})
    strips = read_strips(read_plane(Frame(noise[:4300], "memory")))
    tracemalloc.start()
    find_combs(strips.without_common_light())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20e6


@pytest.mark.parametrize("margin", [0, 30])
@pytest.mark.parametrize("picture", ["coffee", "sky"])
def test_a_screen_that_a_picture_cuts_off_is_numbered_beside_a_black_margin(picture: str, margin: int) -> None:
    """Light goes on where the picture ends, or where the margin of a corrected distortion begins."""
    scene = preset("phone-plain", "paper-17k3").scaled(0.3, 0.5, keep_readout=True)
    trial = simulate_trial(replace(scene, picture=picture), 3)
    left, width = trial.corners[:, 0].min(), float(np.ptp(trial.corners[:, 0]))
    pixels = trial.frame.pixels[:, : int(left + 0.7 * width)].copy()
    pixels[:, pixels.shape[1] - margin :] = 0
    plane = read_plane(replace(trial.frame, pixels=pixels))
    parts = [part for part in bright_parts(plane) if part is not None]
    best, *rivals = find_screens(plane, [ColumnLayout(20, 0.45, 16 / 9)], None, parts)[0]
    assert abs(best.corners[0, 0] - left) < width / 40
    assert all(rival.log_odds < -1.5 for rival in rivals)
