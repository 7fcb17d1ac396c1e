"""Which column is the first: shifted outlines compared on the same rows; and the camera asked once for all of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.receiver import outline as outlines
from rxcli.receiver.context import Camera, FrameContext, Timer
from rxcli.receiver.outline import Located, Outline, locate, possible_outlines
from rxcli.receiver.pipeline import receive
from rxcli.receiver.screen import columns, find, geometry
from rxcli.receiver.screen.coherence import measure_coherence
from rxcli.receiver.screen.find import ScreenSearch
from rxcli.receiver.screen.grid import grid_between
from rxcli.receiver.screen.numbering import FirstColumns, first_columns, light_profile
from rxcli.receiver.screen.sides import Side
from rxcli.receiver.screen.waveforms import StripLight
from rxcli.types import FloatArray, Frame

HEIGHT, WIDTH, ROWS_PER_SLOT, COLUMNS = 1600, 1200, 10.0, 20
CORNERS = np.array([[150.0, 320.0], [1105.0, 290.0], [1130.0, 880.0], [120.0, 850.0]])
OPTIONS = ReceiverOptions(screens=(load_profile("paper-17k3", ScreenProfile),))


def drawn(
    first: float,
    last: float,
    corners: FloatArray = CORNERS,
    *,
    panel: float = 0.0,
    wall: float = 0.0,
    fading: bool = False,
) -> NDArray[np.uint8]:
    """Luma of a screen that shows light between two places, columns, in a room that lights panel and wall."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    at = np.linalg.inv(geometry.homography(corners)) @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    u, v = (at[:2] / at[2]).reshape(2, HEIGHT, WIDTH)
    sent = rng.integers(0, 2, (int(HEIGHT / ROWS_PER_SLOT) + 2, COLUMNS))
    now = sent[(np.arange(HEIGHT) / ROWS_PER_SLOT).astype(int)]
    light = sum(np.exp(-((COLUMNS * u - k - 0.5) ** 2) / (2 * 0.45**2)) * now[:, k, None] for k in range(COLUMNS))
    light = light * ((COLUMNS * u > first) & (COLUMNS * u < last) & (v > 0) & (v < 1))
    if fading:
        light *= np.clip(1 - np.abs(20 * u - (first + last) / 2) / ((last - first) / 2), 0, 1)
    screen = (u > 0) & (u < 1) & (v > 0) & (v < 1)
    luma = (
        150 * light + 12 + np.where(screen, panel, wall) + rng.normal(0, 4, u.shape) + rng.normal(0, 0.5, (HEIGHT, 1))
    )
    return np.clip(luma, 0, 255).astype(np.uint8)


def moved(columns: float) -> FloatArray:
    """The true corners, moved along the screen."""
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) + np.array([columns / COLUMNS, 0.0])
    return geometry.screen_to_picture(unit, CORNERS, None)


def shift_of(outline: Outline) -> int:
    """Columns by which an outline is numbered wrong."""
    return round(float(grid_between(CORNERS, COLUMNS, (WIDTH, HEIGHT), None).columns_at(outline.corners)[0]))


def found_as(monkeypatch: pytest.MonkeyPatch, corners: FloatArray, inferred: tuple[str, ...], support: float) -> None:
    """Let the search for sides find these."""
    lines = tuple(Side(np.array([0.0, 0.0]), 600.0, 300.0, support if name not in inferred else 0.0) for name in SIDES)
    monkeypatch.setattr(
        find, "find_screen", lambda *_, **__: ScreenSearch(corners, 0.8, inferred=inferred, lines=lines)
    )


SIDES = ("top", "right", "bottom", "left")


def test_the_grid_between_corners_has_its_columns_there() -> None:
    grid = grid_between(CORNERS, COLUMNS, (WIDTH, HEIGHT), None)
    u, v = np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 4))
    points = geometry.screen_to_picture(np.stack([u, v], axis=-1), CORNERS, None)
    np.testing.assert_allclose(grid.columns_at(points), COLUMNS * u, atol=1e-6)


def first_columns_of(luma: NDArray[np.uint8]) -> FirstColumns:
    grid = grid_between(CORNERS, COLUMNS, (WIDTH, HEIGHT), None)
    return first_columns(light_profile(StripLight.of(measure_coherence(luma), 0.45, None), grid), grid, COLUMNS)


def test_light_at_both_ends_leaves_one_first_column() -> None:
    start = first_columns_of(drawn(0, 20))
    assert start.first[np.argsort(start.log_odds)[-1]] == 0
    assert 1 / np.exp(start.log_odds).sum() > 0.9


def test_dark_columns_at_both_ends_leave_as_many_first_columns() -> None:
    start = first_columns_of(drawn(3.6, 17.2))
    share = np.exp(start.log_odds) / np.exp(start.log_odds).sum()
    assert share.max() < 0.5
    assert set(start.first[start.log_odds > -3]) >= {-1, 0, 1, 2}


@pytest.mark.parametrize(("panel", "wall"), [(1.5, 0.0), (0.0, 1.5)])
def test_the_edge_of_a_panel_in_the_light_of_a_room_tells_the_first_column(panel: float, wall: float) -> None:
    start = first_columns_of(drawn(3.6, 17.2, panel=panel, wall=wall))
    assert start.first[np.argmax(start.log_odds)] == 0
    assert np.sort(start.log_odds)[-2] < -3


def test_a_picture_whose_light_fades_out_is_no_film_in_the_middle() -> None:
    grid = grid_between(CORNERS, COLUMNS, (WIDTH, HEIGHT), None)
    sharp, soft = (
        light_profile(StripLight.of(measure_coherence(luma), 0.45, None), grid).still.sharp_ends
        for luma in (drawn(3, 17), drawn(3, 17, fading=True))
    )
    assert soft is None
    assert sharp is not None
    np.testing.assert_allclose(sharp, (3, 17), atol=0.15)


LARGE = np.array([[-160.0, 300.0], [1380.0, 280.0], [1400.0, 1170.0], [-180.0, 1140.0]])


def test_a_screen_larger_than_the_picture_has_its_columns_counted_from_the_left_of_what_is_seen() -> None:
    candidates, _ = possible_outlines(Frame(drawn(0, 20, LARGE), "drawn"), OPTIONS, Timer())
    best = outlines._likeliest(candidates)
    assert best is not None
    assert best.column_offset is None
    assert best.is_counted_from_left
    assert -60 < best.corners[0, 0] < 20
    # Borders of columns lie where they are, by whatever number.
    grid = grid_between(LARGE, COLUMNS, (WIDTH, HEIGHT), None)
    u = grid.columns_at(geometry.screen_to_picture(np.array([[0.1, 0.5], [0.5, 0.5], [0.7, 0.5]]), best.corners, None))
    assert np.abs(u - np.round(u)).max() < 0.1


def test_a_side_in_view_tells_the_columns_of_a_screen_that_goes_on_outside_the_picture() -> None:
    corners = LARGE + np.array([300.0, 0.0])
    candidates, _ = possible_outlines(Frame(drawn(0, 20, corners), "drawn"), OPTIONS, Timer())
    best = outlines._likeliest(candidates)
    assert best is not None
    assert best.column_offset == 0
    assert abs(float(grid_between(corners, COLUMNS, (WIDTH, HEIGHT), None).columns_at(best.corners)[0])) < 0.3


def test_light_in_the_middle_as_bars_of_films_leave_it_speaks_for_it() -> None:
    start = first_columns_of(drawn(2.6, 17.4))
    assert start.first[np.argsort(start.log_odds)[-1]] == 0
    assert -4 < np.sort(start.log_odds)[-2] < -0.7


@pytest.mark.parametrize("columns", [-1, 1, 2])
def test_sides_of_which_one_is_inferred_are_moved_to_where_no_light_is_left_out(
    columns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    found_as(monkeypatch, moved(columns), ("right",), 0.1)
    candidates, _ = possible_outlines(Frame(drawn(0, 20), "drawn"), OPTIONS, Timer())
    assert shift_of(candidates[0]) == 0
    np.testing.assert_allclose(candidates[0].corners, CORNERS, atol=1.0)


def test_where_both_ends_are_dark_a_side_that_is_inferred_leaves_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    found_as(monkeypatch, moved(1), ("right",), 0.1)
    candidates, _ = possible_outlines(Frame(drawn(3.6, 17.2), "drawn"), OPTIONS, Timer())
    assert {shift_of(one) for one in candidates} >= {-1, 0, 1, 2}
    best = outlines._likeliest(candidates)
    assert best is not None
    assert best.certainty < 0.5
    assert best.column_offset is None


def test_left_and_right_that_both_show_need_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    found_as(monkeypatch, CORNERS, (), 0.5)
    candidates, _ = possible_outlines(Frame(drawn(3, 17), "drawn"), OPTIONS, Timer())
    assert [shift_of(one) for one in candidates] == [0]


def camera_of(frame: Frame, corners: FloatArray) -> FrameContext:
    return FrameContext(frame, corners, Camera(None, 1e-5, 1e-4, None, "srgb"), OPTIONS.screens, Timer())


@pytest.mark.parametrize("packets", [0.0, 500.0])
def test_the_camera_is_asked_once_and_handed_on(packets: float, monkeypatch: pytest.MonkeyPatch) -> None:
    frame, asked = Frame(np.zeros((200, 300), np.uint8), "drawn"), []

    def likely(frame: Frame, corners: FloatArray, *_: object) -> FrameContext:
        asked.append(corners)
        return camera_of(frame, corners)

    candidates = [Outline(moved(k), log_odds=-float(k)) for k in range(4)]
    monkeypatch.setattr(outlines, "possible_outlines", lambda *_, **__: (candidates, ""))
    monkeypatch.setattr(outlines, "likely_camera", likely)
    monkeypatch.setattr(outlines, "_packets", lambda _: packets)
    located = locate(frame, OPTIONS, Timer())
    assert isinstance(located, Located)
    assert len(asked) == 1
    assert isinstance(located.context, FrameContext)
    assert located.context.corners is located.outline.corners
    # What the packets do not tell stays in doubt, with packets or without.
    assert located.outline.certainty == pytest.approx(1 / np.exp(-np.arange(4.0)).sum())


def test_once_a_screen_shows_plainly_other_outlines_are_looked_at_with_it_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frame = Frame(np.zeros((200, 300), np.uint8), "drawn")
    looked: list[FrameContext] = []

    def packets(context: FrameContext) -> float:
        looked.append(context)
        context.kept["look"] = len(looked)
        return 1000.0 - len(looked)

    candidates = [replace(Outline(moved(k)), family=k) for k in range(3)]
    monkeypatch.setattr(outlines, "possible_outlines", lambda *_, **__: (candidates, ""))
    monkeypatch.setattr(outlines, "likely_camera", lambda frame, corners, *_, **__: camera_of(frame, corners))
    monkeypatch.setattr(outlines, "_packets", packets)
    monkeypatch.setattr(outlines, "_screens_shown", lambda context: context.screens[:1])
    located = locate(frame, OPTIONS, Timer())
    assert isinstance(located, Located)
    assert [len(context.screens) for context in looked] == [len(OPTIONS.screens), 1, 1]
    # What the look at the chosen outline worked out is handed on.
    assert isinstance(located.context, FrameContext)
    assert located.context.kept["look"] == 1
    assert located.context.screens == OPTIONS.screens


def test_clips_without_a_screen_are_not_searched_for_columns_in_every_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    searched = []

    def counted(pixels: NDArray[np.uint8], *given: Any, **named: Any) -> columns.ColumnSearch:
        searched.append(pixels)
        return columns.ColumnSearch(None, (), columns.ColumnLayout())

    monkeypatch.setattr(columns, "find_columns", counted)
    rng = np.random.default_rng(1)
    frames = [Frame(rng.integers(40, 60, (160, 240), np.uint8), "clip", i, time_s=i / 30) for i in range(40)]
    results = list(receive(frames, OPTIONS))
    assert {result.status for result in results} == {"no_screen"}
    assert len(results) == 40
    assert 8 < len(searched) < 16


def test_sides_that_contradict_the_columns_are_never_sure() -> None:
    sides = Outline(CORNERS, log_odds=5.0, trust=0.85, family=-1)
    best = outlines._likeliest([sides, Outline(moved(3), log_odds=-5.0)])
    assert best is not None
    assert best.certainty == 0.85
    assert best.column_offset is None


@pytest.mark.parametrize(("odds", "offset"), [(3.5, 0), (1.0, None)])
def test_columns_are_said_to_be_the_screens_only_where_that_is_sure(odds: float, offset: int | None) -> None:
    best = outlines._likeliest([Outline(CORNERS, log_odds=odds), Outline(moved(1))])
    assert best is not None
    assert best.column_offset == offset
    np.testing.assert_array_equal(best.corners, CORNERS)
