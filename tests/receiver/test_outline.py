"""Which column is the first: shifted outlines compared on the same rows, and how sure the columns' numbers are."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.result import Received
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.grid import grid_between
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.search.numbers import numbered
from rxcli.receiver.search.outlines import possible_screens
from rxcli.receiver.search.propose import likeliest_of_family
from rxcli.results.reasons import sentence_of
from rxcli.types import ColumnResult, FloatArray, Frame, FrameResult, PacketResult, Remark

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


def test_the_grid_between_corners_has_its_columns_there() -> None:
    grid = grid_between(CORNERS, COLUMNS, (WIDTH, HEIGHT), None)
    u, v = np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 4))
    points = geometry.screen_to_picture(np.stack([u, v], axis=-1), CORNERS, None)
    np.testing.assert_allclose(grid.columns_at(points), COLUMNS * u, atol=1e-6)


def likeliest(candidates: list[Outline]) -> Outline:
    """The likeliest outline and how sure its columns' numbers are, packets showing under all alike."""
    family = max(candidates, key=lambda one: one.log_odds).family
    own = likeliest_of_family([one for one in candidates if one.family == family])
    return numbered(own, candidates, lambda _: None)


LARGE = np.array([[-160.0, 300.0], [1380.0, 280.0], [1400.0, 1170.0], [-180.0, 1140.0]])


def test_a_screen_larger_than_the_picture_has_its_columns_counted_from_the_left_of_what_is_seen() -> None:
    [candidates] = possible_screens(FrameCache(Frame(drawn(0, 20, LARGE), "drawn")), OPTIONS)
    best = likeliest(candidates)
    assert best.column_offset is None
    assert -60 < best.corners[0, 0] < 20
    # Borders of columns lie where they are, by whatever number.
    grid = grid_between(LARGE, COLUMNS, (WIDTH, HEIGHT), None)
    u = grid.columns_at(geometry.screen_to_picture(np.array([[0.1, 0.5], [0.5, 0.5], [0.7, 0.5]]), best.corners, None))
    assert np.abs(u - np.round(u)).max() < 0.1


def test_a_side_in_view_tells_the_columns_of_a_screen_that_goes_on_outside_the_picture() -> None:
    corners = LARGE + np.array([300.0, 0.0])
    [candidates] = possible_screens(FrameCache(Frame(drawn(0, 20, corners), "drawn")), OPTIONS)
    best = likeliest(candidates)
    assert best.certainty > 0.8
    assert abs(float(grid_between(corners, COLUMNS, (WIDTH, HEIGHT), None).columns_at(best.corners)[0])) < 0.3


def test_what_packets_do_not_tell_stays_in_doubt() -> None:
    candidates = [Outline(moved(k), log_odds=-float(k)) for k in range(4)]
    assert likeliest(candidates).certainty == pytest.approx(1 / np.exp(-np.arange(4.0)).sum())


def test_packets_tell_between_families() -> None:
    candidates = [Outline(CORNERS, log_odds=-2.0), Outline(moved(1), log_odds=-2.0), Outline(moved(3), family=1)]
    own = numbered(candidates[0], candidates, {0: 60.0, 1: 20.0}.get)
    assert own.certainty == pytest.approx(0.5, abs=1e-9)
    rival = numbered(candidates[0], candidates, {0: 60.0, 1: 58.0}.get)
    assert rival.certainty == pytest.approx(1 / (2 + np.exp(2 - 2)))
    assert numbered(candidates[0], candidates, {0: 60.0}.get).certainty == own.certainty
    film = Outline(0.8 * CORNERS + 0.2 * CORNERS[[3, 2, 1, 0]], family=-1)
    for rival, is_same in ((film, True), (replace(film, n_columns=100), False)):
        certainty = numbered(candidates[0], [*candidates[:2], rival], {0: 60.0, -1: 60.0}.get).certainty
        assert certainty == pytest.approx(0.5 if is_same else 1 / (2 + np.exp(2)))


@pytest.mark.parametrize(("odds", "offset"), [(3.5, 0), (1.0, None)])
def test_columns_are_said_to_be_the_screens_only_where_that_is_sure(odds: float, offset: int | None) -> None:
    best = likeliest([Outline(CORNERS, log_odds=odds), Outline(moved(1))])
    assert best.column_offset == offset
    np.testing.assert_array_equal(best.corners, CORNERS)


def of_doubtful_number(certainty: float) -> FrameResult:
    """A packet in column 3 that is right, if that is its column."""
    packet = PacketResult(0.0, 1.0, 7, "00", confidence=0.97 * certainty, ber_hat=0.0)
    columns = (ColumnResult(2, "dark"), ColumnResult(3, "ok", w=5, packets=(packet,)))
    return FrameResult("drawn", 0, 0.0, "ok", columns=columns, column_certainty=certainty, column_offset=None)


def test_a_doubtful_number_is_stated_and_asks_for_no_other_camera() -> None:
    message = sentence_of(Remark("column_numbers", {"column": 3, "certainty": 0.3}))
    assert "numbered from the leftmost that was seen: it is the screen's column 3 with a probability of 0.30" in message
    assert Received(of_doubtful_number(0.3), {}).n_believable == 1
    weak = replace(of_doubtful_number(0.3), column_certainty=1.0)
    assert Received(weak, {}).n_believable == 0
