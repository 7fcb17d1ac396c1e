"""Lens model from pictures of a chessboard or ChArUco board."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rxcli.errors import ReceiverError, UsageError
from rxcli.profiles import LensModel
from rxcli.types import BoolArray, Float32Array, FloatArray

GrayImage = NDArray[np.uint8]
#: Minimum number of boards of a calibration, and of ChArUco corners of a picture.
MIN_BOARDS, _MIN_CORNERS = 3, 8
#: A picture is blurred when its edges are wider than this share of a square and this many pixels.
_BLUR_SQUARES, _BLUR_PX = 0.2, 2.0
#: A board is an outlier when its RMS is this many times the median and this many pixels above it.
_OUTLIER_RATIO, _OUTLIER_PX = 2.5, 0.2
#: Longest side in which a chessboard is searched, pixels; its corners are then refined in the whole picture.
_DETECTION_SIDE = 2000


@dataclass(frozen=True, slots=True)
class Board:
    """The board: `columns` x `rows` inner corners; a marker dictionary makes it a ChArUco board."""

    columns: int
    rows: int
    square_mm: float = 25.0
    #: OpenCV's name of the dictionary ("DICT_5X5_100"); None for a plain chessboard.
    dictionary: str | None = None
    #: Side of a marker over the side of a square.
    marker_ratio: float = 0.75

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            reason = f"a board needs at least 3 x 3 inner corners (got {self.columns}x{self.rows})"
            raise UsageError(reason, "count the corners where four squares meet")
        if self.square_mm <= 0 or not 0 < self.marker_ratio < 1:
            reason = f"square {self.square_mm:g} mm must be positive and marker ratio {self.marker_ratio:g} in 0..1"
            raise UsageError(reason, "measure a square and a marker")

    def points(self) -> Float32Array:
        """(columns * rows, 3) corners on the board, millimetres, row by row."""
        grid = np.zeros((self.rows * self.columns, 3), np.float32)
        grid[:, :2] = np.mgrid[0 : self.columns, 0 : self.rows].T.reshape(-1, 2)
        return grid * np.float32(self.square_mm)


@dataclass(frozen=True, slots=True)
class Sighting:
    """A board found in a picture: (n, 3) points on the board, millimetres, and their (n, 2) corners, pixels."""

    name: str
    points: Float32Array
    corners: Float32Array


@dataclass(frozen=True, slots=True)
class Rejected:
    """A picture that was not used."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class LensCalibration:
    """A calibrated lens and the data behind it."""

    model: LensModel
    rms_px: float
    #: Names of the pictures used and the RMS of each.
    accepted: dict[str, float]
    rejected: tuple[Rejected, ...]
    #: (n, 2) all corners used, and measured minus projected, pixels.
    corners: FloatArray
    residuals: FloatArray
    #: Standard deviations of fx, fy, cx, cy, pixels.
    intrinsic_sd_px: tuple[float, ...]

    @property
    def uncovered(self) -> tuple[str, ...]:
        """Names of the parts of the picture without corners."""
        covered = covered_parts(self.corners, self.model.width, self.model.height)
        rows = ("top", "upper", "middle", "lower", "bottom")
        columns = ("left", "centre left", "centre", "centre right", "right")
        return tuple(f"{rows[y]} {columns[x]}" for y, x in np.argwhere(~covered))


def find_board(image: GrayImage, board: Board, name: str) -> Sighting | Rejected:
    """Find a board in a picture.

    Args:
        image: (height, width) grey picture, stored orientation.
        board: the board to find.
        name: the picture's name.
    """
    found = _find_charuco(image, board) if board.dictionary else _find_chessboard(image, board)
    if found is None:
        kind = f"ChArUco board {board.dictionary}" if board.dictionary else "chessboard"
        return Rejected(name, f"no {kind} with {board.columns}x{board.rows} inner corners found")
    blur, square = _edge_width(image, found[1], board)
    if blur > max(_BLUR_SQUARES * square, _BLUR_PX):
        return Rejected(name, f"too blurred: edges {blur:.1f} px wide on squares of {square:.0f} px")
    return Sighting(name, *found)


def find_boards(pictures: Iterable[tuple[str, GrayImage]], board: Board) -> tuple[list[Sighting | Rejected], int, int]:
    """Find the board in every picture; reject pictures of another size and repeated views.

    Args:
        pictures: name and (height, width) grey picture each, stored orientation.
        board: the board to find.

    Returns:
        One result a picture, width and height of the pictures.
    """
    sized = [(image.shape[::-1], find_board(image, board, name)) for name, image in pictures]
    if not sized:
        raise ReceiverError("no pictures of a board", "name pictures, a folder of pictures, or a clip")
    sizes = [size for size, result in sized if isinstance(result, Sighting)] or [sized[0][0]]
    width, height = max(sizes, key=sizes.count)
    results: list[Sighting | Rejected] = []
    last: Sighting | None = None
    for size, result in sized:
        if size != (width, height):
            result = Rejected(result.name, f"size {size[0]}x{size[1]}, the others are {width}x{height}")
        elif isinstance(result, Sighting):
            if last is not None and _same_view(last, result, width):
                result = Rejected(result.name, f"same view as {last.name}")
            else:
                last = result
        results.append(result)
    return results, width, height


def _same_view(a: Sighting, b: Sighting, width: int) -> bool:
    """Whether the board moved by less than 0.5 % of the picture's width."""
    if a.corners.shape != b.corners.shape:
        return False
    return float(np.median(np.linalg.norm(a.corners - b.corners, axis=1))) < 0.005 * width


def _find_chessboard(image: GrayImage, board: Board) -> tuple[Float32Array, Float32Array] | None:
    """Corners by OpenCV's quadrangles or, failing that, sectors; refined at the gradient's saddle at full size."""
    shrink = max(image.shape) // _DETECTION_SIDE + 1
    height, width = (side // shrink for side in image.shape)
    small = cv2.resize(image[: height * shrink, : width * shrink], (width, height), interpolation=cv2.INTER_AREA)
    size = (board.columns, board.rows)
    fast = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(small, size, flags=fast)
    if not found:
        thorough = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
        found, corners = cv2.findChessboardCornersSB(small, size, flags=thorough)
    if not found:
        return None
    rough = (np.asarray(corners, np.float32).reshape(board.rows, board.columns, 2) + 0.5) * shrink - 0.5
    # The window stays clear of the neighbouring corners.
    pitch = min(np.linalg.norm(np.diff(rough, axis=axis), axis=2).min() for axis in (0, 1))
    half = int(np.clip(pitch * 0.3, 2, 25))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
    refined = cv2.cornerSubPix(image, rough.reshape(-1, 1, 2), (half, half), (-1, -1), criteria)
    return board.points(), np.asarray(refined, np.float32).reshape(-1, 2)


def _find_charuco(image: GrayImage, board: Board) -> tuple[Float32Array, Float32Array] | None:
    name = str(board.dictionary)
    if not name.startswith("DICT_") or not hasattr(cv2.aruco, name):
        raise UsageError(f"no marker dictionary {name!r}", "use a name such as DICT_5X5_100 or DICT_APRILTAG_36h11")
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    squares, marker_mm = (board.columns + 1, board.rows + 1), board.square_mm * board.marker_ratio
    charuco = cv2.aruco.CharucoBoard(squares, board.square_mm, marker_mm, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(charuco).detectBoard(image)
    if ids is None or len(ids) < _MIN_CORNERS:
        return None
    points = np.asarray(charuco.getChessboardCorners(), np.float32)[np.ravel(ids)]
    in_one_line = min(np.unique(points[:, 0]).size, np.unique(points[:, 1]).size) < 2
    return None if in_one_line else (points, np.asarray(corners, np.float32).reshape(-1, 2))


def _edge_width(image: GrayImage, corners: Float32Array, board: Board) -> tuple[float, float]:
    """Width of the board's edges and size of its squares, pixels.

    The width is the contrast of black and white over the steepest slope.
    """
    x0, y0 = np.maximum(np.floor(corners.min(axis=0)).astype(int), 0)
    x1, y1 = np.ceil(corners.max(axis=0)).astype(int) + 1
    patch = cv2.GaussianBlur(np.asarray(image[y0:y1, x0:x1], np.float32), (0, 0), 0.7)
    slope = np.hypot(cv2.Sobel(patch, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(patch, cv2.CV_32F, 0, 1, scale=1 / 8))
    contrast = float(np.subtract(*np.percentile(patch, [95, 5])))
    area = cv2.contourArea(cv2.convexHull(corners))
    squares = (board.columns - 1) * (board.rows - 1)
    return contrast / max(float(np.percentile(slope, 99)), 1e-6), float(np.sqrt(area / squares))


def calibrate_lens(found: Sequence[Sighting | Rejected], width: int, height: int) -> LensCalibration:
    """Fit pinhole, radial (k1 k2 k3) and tangential (p1 p2) distortion; drop the worst board while one stands out.

    Args:
        found: results of `find_board`, all of pictures of one size.
        width: of the pictures, pixels.
        height: of the pictures, pixels.

    Raises:
        ReceiverError: fewer than three usable boards, or the fit fails.
    """
    rejected = [r for r in found if isinstance(r, Rejected)]
    boards = [s for s in found if isinstance(s, Sighting)]
    if len(boards) < MIN_BOARDS:
        reasons = "; ".join(f"{r.name}: {r.reason}" for r in rejected[:3])
        reason = f"{len(boards)} usable boards, at least {MIN_BOARDS} are needed ({reasons or 'no pictures'})"
        hint = "check --board (inner corners), and take 10 to 20 sharp pictures at different tilts"
        raise ReceiverError(reason, hint)
    while True:
        fit = _fit(boards, rejected, (width, height))
        errors = np.array(list(fit.accepted.values()))
        worst, median = int(np.argmax(errors)), float(np.median(errors))
        if len(boards) <= MIN_BOARDS or errors[worst] < max(_OUTLIER_RATIO * median, median + _OUTLIER_PX):
            return fit
        reason = f"outlier: RMS {errors[worst]:.2f} px, the others' median {median:.2f} px"
        rejected.append(Rejected(boards.pop(worst).name, reason))


def _fit(boards: list[Sighting], rejected: list[Rejected], size: tuple[int, int]) -> LensCalibration:
    points, corners = [s.points for s in boards], [s.corners for s in boards]
    hint = "take pictures with the board tilted in different directions and out to the corners"
    try:
        solved = cv2.calibrateCameraExtended(points, corners, size, np.eye(3), np.zeros(5))
    except cv2.error as error:
        reason = str(error).strip().splitlines()[-1]
        raise ReceiverError(f"the boards do not determine a lens ({reason})", hint) from None
    rms, matrix, distortion, rotations, translations, sd, _, view_rms = solved
    if not (np.isfinite(matrix).all() and min(matrix[0, 0], matrix[1, 1]) > 0 and np.abs(distortion).max() <= 100):
        raise ReceiverError("the fitted lens makes no sense (focal length or distortion out of bounds)", hint)
    poses = zip(points, rotations, translations, strict=True)
    projected = [cv2.projectPoints(p, r, t, matrix, distortion)[0].reshape(-1, 2) for p, r, t in poses]
    measured = np.vstack(corners).astype(np.float64)
    rows: Any = tuple(tuple(row) for row in matrix.tolist())
    coefficients: Any = tuple(distortion.ravel()[:5].tolist())
    return LensCalibration(
        model=LensModel(width=size[0], height=size[1], camera_matrix=rows, dist_coeffs=coefficients),
        rms_px=float(rms),
        accepted=dict(zip((s.name for s in boards), view_rms.ravel().tolist(), strict=True)),
        rejected=tuple(rejected),
        corners=measured,
        residuals=measured - np.vstack(projected),
        intrinsic_sd_px=tuple(sd.ravel()[:4].tolist()),
    )


def covered_parts(corners: FloatArray, width: int, height: int) -> BoolArray:
    """(5, 5) whether a part of the picture, down and across, holds corners (n, 2), pixels.

    The outer parts decide how far the distortion can be trusted.
    """
    across, down = np.clip((corners + 0.5) / [width, height] * 5, 0, 4).astype(int).T
    covered = np.zeros((5, 5), dtype=bool)
    covered[down, across] = True
    return covered
