"""Geometry on points against OpenCV and against projections computed another way."""

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from rxcli.profiles import LensModel
from rxcli.receiver.screen import geometry
from rxcli.types import Lens

FloatArray = NDArray[np.float64]
WIDTH, HEIGHT = 4032, 3024
BARREL = (-0.12, 0.03, 0.0006, -0.0004, 0.005)


def lens(coeffs: tuple[float, ...] = BARREL, corrected: bool = False, focal: float = 0.85, width: int = WIDTH) -> Lens:
    matrix = np.array([[focal * width, 0, width / 2 + 11], [0, focal * width * 1.001, width * 3 / 8 - 7], [0, 0, 1.0]])
    return Lens(matrix, np.array(coeffs), corrected)


def project(points: FloatArray, of: Lens) -> FloatArray:
    """Undistorted pixels through OpenCV's projection."""
    flat = points.reshape(-1, 2)
    rays = np.column_stack([(flat - of.camera_matrix[:2, 2]) / np.diag(of.camera_matrix)[:2], np.ones(len(flat))])
    seen, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), of.camera_matrix, of.dist_coeffs)
    return np.asarray(seen, np.float64).reshape(points.shape)


def over_the_picture(n: int = 12) -> FloatArray:
    return np.stack(np.meshgrid(np.linspace(0, WIDTH - 1, n), np.linspace(0, HEIGHT - 1, n)), axis=-1)


def plane_to_picture(corners: FloatArray, points: FloatArray) -> FloatArray:
    """Screen points 0..1 to pixels by OpenCV's homography."""
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    matrix = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
    return np.asarray(cv2.perspectiveTransform(points.reshape(1, -1, 2), matrix)).reshape(points.shape)


def rotated(degrees: float, centre: tuple[float, float], width: float, height: float) -> FloatArray:
    a = np.deg2rad(degrees)
    box = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [width / 2, height / 2]
    return np.asarray(box @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]) + centre)


coefficients = st.tuples(
    st.floats(-0.15, 0.15), st.floats(-0.05, 0.05), *[st.floats(-1e-3, 1e-3)] * 2, st.floats(-0.01, 0.01)
)


@given(coefficients)
@example(BARREL[:4])
@example((-0.1, 0.02, 1e-3, 5e-4, 0.01, 0.03, -0.02, 0.004))
def test_distort_agrees_with_opencv(coeffs: tuple[float, ...]) -> None:
    points = over_the_picture()
    np.testing.assert_allclose(geometry.distort(points, lens(coeffs)), project(points, lens(coeffs)), atol=1e-6)


@given(coefficients)
def test_undistort_inverts_distort(coeffs: tuple[float, ...]) -> None:
    points = over_the_picture()
    back = geometry.undistort(geometry.distort(points, lens(coeffs, focal=1.0)), lens(coeffs, focal=1.0))
    np.testing.assert_allclose(back, points, atol=0.01)


def test_lens_of_a_profile_scales_with_the_picture() -> None:
    """A pixel of a picture at half size shows the point between two by two pixels of the whole one."""
    matrix = ((3400.0, 0.0, 2000.0), (0.0, 3410.0, 1500.0), (0.0, 0.0, 1.0))
    model = LensModel(width=4032, height=3024, camera_matrix=matrix, dist_coeffs=BARREL)
    whole, half = geometry.lens_for(model, 4032, 3024), geometry.lens_for(model, 2016, 1512)
    points = over_the_picture()
    expected = (geometry.distort(points, whole) + 0.5) / 2 - 0.5
    np.testing.assert_allclose(geometry.distort((points + 0.5) / 2 - 0.5, half), expected, atol=1e-9)
    assert whole.camera_matrix.tolist() == [list(row) for row in matrix]


@given(st.lists(st.floats(-200, 200), min_size=8, max_size=8))
def test_homography_maps_the_corners(moves: list[float]) -> None:
    corners = np.array([[500.0, 400], [3500, 400], [3500, 2600], [500, 2600]]) + np.reshape(moves, (4, 2))
    square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    np.testing.assert_allclose(geometry.screen_to_picture(square, corners, None), corners, atol=1e-6)
    centre = np.array([[0.5, 0.5]])
    np.testing.assert_allclose(
        geometry.screen_to_picture(centre, corners, None), plane_to_picture(corners, centre), atol=0.01
    )


@pytest.mark.parametrize(
    ("orientation", "order"), [(1, "ABCD"), (2, "BADC"), (3, "CDAB"), (4, "DCBA"), (6, "ABCD"), (8, "ABCD")]
)
def test_corners_in_the_viewers_order(orientation: int, order: str) -> None:
    """Stored corners A B C D, clockwise from the top left; EXIF says where the viewer's top left lies."""
    corners = np.array([[10.0, 20], [90, 20], [90, 70], [10, 70]])
    expected = corners[["ABCD".index(letter) for letter in order]]
    assert (geometry.viewer_order(corners, orientation) == expected).all()


@pytest.mark.parametrize(("order", "left", "step"), [((0, 1, 2, 3), 99.5, 50), ((2, 3, 0, 1), 499.5, -50)])
def test_outlines_of_a_straight_screen_are_exact(order: tuple[int, ...], left: float, step: int) -> None:
    """Upright, and upside down."""
    corners = np.array([[99.5, 49.5], [499.5, 49.5], [499.5, 349.5], [99.5, 349.5]])[list(order)]
    found = geometry.column_outlines(corners, 4, 2, 640, 480)
    edges = left + step * np.arange(9)
    np.testing.assert_allclose(found.edges_x, np.repeat(edges[:, None], found.rows.size, axis=1), atol=1e-3)
    assert (np.diff(found.rows) == 1).all()
    assert found.inside.shape == (4, 2, found.rows.size)
    assert found.sensor_row is None
    assert (found.inside == ((found.rows >= 50) & (found.rows <= 349))).all()


def test_outlines_of_a_mirrored_screen() -> None:
    corners = np.array([[499.5, 49.5], [99.5, 49.5], [99.5, 349.5], [499.5, 349.5]])
    found = geometry.column_outlines(corners, 4, 1, 640, 480)
    np.testing.assert_allclose(found.edges_x[:, 100], 499.5 - 100 * np.arange(5), atol=1e-3)
    assert found.inside[:, :, 100].all()


def edge_x_at_rows(corners: FloatArray, u: float, rows: NDArray[np.int64], of: Lens | None) -> FloatArray:
    """x of the screen's line of constant u on picture rows, from ten thousand points of it; nan beyond the screen."""
    v = np.linspace(0, 1, 10001)
    plane = corners
    if of is not None:
        plane = cv2.undistortPoints(corners[:, None], of.camera_matrix, of.dist_coeffs, P=of.camera_matrix)[:, 0]
        for _ in range(30):
            plane = plane + corners - project(plane, of)
    line = closed_form_homography(plane) @ np.stack([np.full_like(v, u), v, np.ones_like(v)])
    points = (line[:2] / line[2]).T
    if of is not None:
        points = project(points, of)
    order = np.argsort(points[:, 1])
    return np.interp(rows, points[order, 1], points[order, 0], left=np.nan, right=np.nan)


def closed_form_homography(corners: FloatArray) -> FloatArray:
    """Homography of the unit square to `corners` in closed form (Heckbert 1989)."""
    p0, p1, p2, p3 = corners
    total, first, second = p0 - p1 + p2 - p3, p1 - p2, p3 - p2
    base = first[0] * second[1] - second[0] * first[1]
    g = (total[0] * second[1] - second[0] * total[1]) / base
    h = (first[0] * total[1] - total[0] * first[1]) / base
    return np.column_stack([np.append(p1 - p0 + g * p1, g), np.append(p3 - p0 + h * p3, h), np.append(p0, 1.0)])


ROLLED = rotated(4.0, (2000, 1500), 3300, 1900)
PERSPECTIVE = np.array([[310.0, 420], [3700, 250], [3805, 2790], [205, 2500]])


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 3, 0, 1)], ids=["upright", "upside down"])
@pytest.mark.parametrize("of", [None, lens()], ids=["no lens", "barrel"])
@pytest.mark.parametrize("corners", [ROLLED, PERSPECTIVE], ids=["rolled", "perspective"])
def test_outlines_against_projection(corners: FloatArray, of: Lens | None, order: tuple[int, ...]) -> None:
    corners = corners[list(order)]
    found = geometry.column_outlines(corners, 5, 2, WIDTH, HEIGHT, of)
    for edge, u in enumerate(np.linspace(0, 1, 11)):
        expected = edge_x_at_rows(corners, u, found.rows, of)
        known = np.isfinite(expected)
        assert known.sum() > 1500
        np.testing.assert_allclose(found.edges_x[edge, known], expected[known], atol=0.03)
    for strip in range(10):
        middle = edge_x_at_rows(corners, (strip + 0.5) / 10, found.rows, of)
        shown = np.isfinite(middle)
        assert (found.inside[strip // 2, strip % 2] != shown).sum() <= 4
    assert found.sensor_row is None


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 3, 0, 1)], ids=["upright", "upside down"])
def test_row_map_of_a_picture_corrected_in_the_camera(order: tuple[int, ...]) -> None:
    """The sensor row of a corrected pixel is the y of its distorted place."""
    of = lens(corrected=True)
    found = geometry.column_outlines(PERSPECTIVE[list(order)], 5, 2, WIDTH, HEIGHT, of)
    assert found.sensor_row.shape == found.inside.shape
    middle_x = (found.edges_x[1:] + found.edges_x[:-1]) / 2.0
    pixels = np.stack([middle_x, np.broadcast_to(found.rows, middle_x.shape)], axis=-1).astype(np.float64)
    expected = project(pixels, of)[..., 1].reshape(found.inside.shape)
    bend = np.abs(expected - found.rows)[found.inside].max()
    assert bend > 20
    np.testing.assert_allclose(found.sensor_row[found.inside], expected[found.inside], atol=0.02)
    straight = geometry.column_outlines(PERSPECTIVE[list(order)], 5, 2, WIDTH, HEIGHT, None)
    np.testing.assert_array_equal(found.edges_x, straight.edges_x)


@settings(max_examples=40)
@given(st.lists(st.floats(-900, 900), min_size=8, max_size=8), st.sampled_from([None, lens(), lens(corrected=True)]))
def test_corners_outside_the_picture(moves: list[float], of: Lens | None) -> None:
    corners = np.array([[0.0, 0], [WIDTH, 0], [WIDTH, HEIGHT], [0, HEIGHT]]) + np.reshape(moves, (4, 2))
    found = geometry.column_outlines(corners, 3, 2, WIDTH, HEIGHT, of)
    assert found.rows[0] >= 0
    assert found.rows[-1] <= HEIGHT - 1
    assert np.isfinite(found.edges_x).all()
    strips = found.inside.reshape(6, -1)
    for edges in (found.edges_x[1:], found.edges_x[:-1]):
        assert (edges[strips] >= 0).all()
        assert (edges[strips] <= WIDTH - 1).all()
    if of is not None and of.corrected:
        assert found.sensor_row is not None
        assert np.isfinite(found.sensor_row).all()


@pytest.mark.parametrize("top", [-500.0, 5000.0])
def test_a_screen_beside_the_picture_has_nothing_inside(top: float) -> None:
    corners = np.array([[100.0, top], [900, top], [900, top + 300], [100, top + 300]])
    found = geometry.column_outlines(corners, 4, 1, WIDTH, HEIGHT)
    assert found.rows.size == 1
    assert not found.inside.any()


def test_a_screen_of_one_row() -> None:
    corners = np.array([[100.0, 49.6], [900, 49.6], [900, 50.4], [100, 50.4]])
    found = geometry.column_outlines(corners, 4, 1, WIDTH, HEIGHT)
    assert found.rows[found.inside[0, 0]].tolist() == [50]
    np.testing.assert_allclose(found.edges_x[:, found.rows.tolist().index(50)], 100 + 200 * np.arange(5), atol=1e-3)
