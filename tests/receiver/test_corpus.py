"""Captures of the project and beside the checkout: what each gives neither falls nor rises unnoticed."""

import json
from pathlib import Path

import numpy as np
import pytest
from corpus import TABLE, Counts, counts_of, floors, path_of, received

FLOORS = floors()
KNOWN_PHOTOS = [name for name in FLOORS if name.startswith("captures/") and name.endswith(("jpg known", "dng known"))]


def test_counts_fail_below_the_floor_and_far_above_it() -> None:
    floor = Counts(100, 80, 4, 0)
    assert not list(floor.faults(floor))
    assert not list(Counts(101, 81, 3, 0).faults(floor))
    assert list(Counts(99, 82, 4, 1).faults(floor)) == [
        "right: 99, the floor is 100",
        "sure: 82 is better than the floor of 80: raise it with `python tests/corpus.py`",
        "surely_wrong: 1, the floor is 0",
    ]
    assert Counts(99, 82, 5, 0).raised(floor) == Counts(100, 82, 4, 0)


@pytest.mark.parametrize("name", FLOORS)
def test_floor(name: str) -> None:
    if not path_of(name).is_file():
        pytest.skip(f"no capture at {path_of(name)}")
    assert not list(counts_of(received(name)).faults(FLOORS[name])), TABLE.name


@pytest.mark.parametrize("name", KNOWN_PHOTOS)
def test_corners_are_found(shared_captures: Path, name: str) -> None:
    """Those in the picture: across the columns within an eighth of a column of twenty, along them 2 %."""
    import cv2

    (result,) = received(name)
    truth = json.loads(path_of(name).with_suffix(".truth.json").read_text())
    camera, corners = truth["camera"], np.array(truth["corners_sensor_px"])
    if camera["distortion_already_corrected"]:
        matrix, coeffs = np.array(camera["camera_matrix"]), np.array(camera["dist_coeffs"])
        corners = cv2.undistortPoints(corners[:, None], matrix, coeffs, P=matrix)[:, 0]
    in_picture = ((corners >= 0) & (corners <= [camera["width"] - 1, camera["height"] - 1])).all(axis=1)
    assert in_picture.sum() >= 2
    width = float(np.linalg.norm(corners[1] - corners[0]))
    across = (corners[1] - corners[0]) / width
    off = (result.corners - corners)[in_picture]
    assert np.abs(off @ across).max() < width / 160
    # Of dark rows packets cannot tell whose they are.
    assert np.linalg.norm(off, axis=1).max() < 0.02 * width
