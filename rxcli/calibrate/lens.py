"""Lens model from pictures of a chessboard or ChArUco board."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import ReceiverError, UsageError
from rxcli.profiles import LensModel
from rxcli.types import BoolArray, FloatArray

GrayImage = NDArray[np.uint8]
Detector = Literal["classic", "sector", "charuco"]
#: Fewest boards that a calibration stands on.
MIN_BOARDS = 3
#: Edge width, in squares, from which a picture counts as blurred, and its least value in pixels.
_BLUR_SQUARES, _BLUR_PX = 0.2, 2.0
#: A board is an outlier when its RMS is this many times the median and at least this many pixels above it.
_OUTLIER_RATIO, _OUTLIER_PX = 2.5, 0.2
#: Longest side in which a chessboard is looked for; its corners are then refined in the whole picture.
_DETECTION_SIDE = 2000
#: Fewest ChArUco corners of a usable picture.
_MIN_CORNERS = 8


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
            raise UsageError(
                f"a board needs at least 3 x 3 inner corners (got {self.columns}x{self.rows})",
                "count the corners where four squares meet",
            )
        if self.square_mm <= 0 or not 0 < self.marker_ratio < 1:
            raise UsageError(
                f"square {self.square_mm:g} mm must be positive and marker ratio {self.marker_ratio:g} in 0..1",
                "measure a square and a marker",
            )

    def points(self) -> NDArray[np.float32]:
        """(columns * rows, 3) corners on the board, millimetres, row by row."""
        grid = np.zeros((self.rows * self.columns, 3), np.float32)
        grid[:, :2] = np.mgrid[0 : self.columns, 0 : self.rows].T.reshape(-1, 2)
        return grid * np.float32(self.square_mm)


@dataclass(frozen=True, slots=True)
class Sighting:
    """One board found in one picture."""

    name: str
    #: Detector -> ((n, 3) board points in millimetres, (n, 2) corners in pixels).
    corners: dict[Detector, tuple[NDArray[np.float32], NDArray[np.float32]]]


@dataclass(frozen=True, slots=True)
class Rejected:
    """A picture that was not used."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True)
class LensCalibration:
    """A calibrated lens with what it stands on."""

    model: LensModel
    rms_px: float
    detector: Detector
    #: Names of the pictures used and the RMS of each.
    accepted: dict[str, float]
    rejected: tuple[Rejected, ...]
    #: (n, 2) all corners used, and measured minus projected, pixels.
    corners: FloatArray
    residuals: FloatArray
    #: Parts of the field without corners, in words; empty where the field is covered.
    uncovered: tuple[str, ...]
    #: Standard deviations of fx, fy, cx, cy, pixels.
    intrinsic_sd_px: tuple[float, float, float, float]


def find_board(image: GrayImage, board: Board, name: str) -> Sighting | Rejected:
    """Find a board by every detector that applies.

    Args:
        image: (height, width) grey picture, stored orientation.
        board: what to look for.
        name: the picture's name.
    """
    found = _find_charuco(image, board) if board.dictionary else _find_chessboard(image, board)
    if not found:
        kind = f"ChArUco board {board.dictionary}" if board.dictionary else "chessboard"
        return Rejected(name, f"no {kind} with {board.columns}x{board.rows} inner corners found")
    blur, square = _edge_width(image, next(iter(found.values()))[1], board)
    if blur > max(_BLUR_SQUARES * square, _BLUR_PX):
        return Rejected(name, f"too blurred: edges {blur:.1f} px wide on squares of {square:.0f} px")
    return Sighting(name, found)


Corners = dict[Detector, tuple[NDArray[np.float32], NDArray[np.float32]]]


def find_boards(pictures: Iterable[tuple[str, GrayImage]], board: Board) -> tuple[list[Sighting | Rejected], int, int]:
    """Find the board in every picture; those of another size, or that repeat the view before, are rejected.

    Args:
        pictures: name and (height, width) grey picture each, stored orientation.
        board: what to look for.

    Returns:
        One result a picture, width and height of the pictures.
    """
    sized = [((image.shape[1], image.shape[0]), find_board(image, board, name)) for name, image in pictures]
    if not sized:
        raise ReceiverError("no pictures of a board", "name pictures, a folder of pictures, or a clip")
    found = [size for size, result in sized if isinstance(result, Sighting)] or [sized[0][0]]
    size = max(found, key=found.count)
    results: list[Sighting | Rejected] = []
    last: Sighting | None = None
    for own, result in sized:
        if own != size:
            result = Rejected(result.name, f"size {own[0]}x{own[1]}, the others are {size[0]}x{size[1]}")
        elif isinstance(result, Sighting):
            if last is not None and _same_view(last, result, size[0]):
                result = Rejected(result.name, f"same view as {last.name}")
            else:
                last = result
        results.append(result)
    return results, *size


def _same_view(a: Sighting, b: Sighting, width: int) -> bool:
    """Whether the board has not moved by as much as 0.5 % of the picture's width."""
    detector = next(iter(set(a.corners) & set(b.corners)), None)
    if detector is None or a.corners[detector][1].shape != b.corners[detector][1].shape:
        return False
    moved = np.linalg.norm(a.corners[detector][1] - b.corners[detector][1], axis=1)
    return float(np.median(moved)) < 0.005 * width


def _find_chessboard(image: GrayImage, board: Board) -> Corners:
    """Classic corners refined to sub-pixels, and the sector-based detector's own."""
    shrink = max(image.shape) // _DETECTION_SIDE + 1
    small = _shrunk(image, shrink)
    classic, sector = _classic_corners(small, board), _sector_corners(small, board)
    found: Corners = {}
    for rough in (classic, sector):
        if rough is not None and "classic" not in found:
            found["classic"] = (board.points(), _refine(image, (rough + 0.5) * shrink - 0.5, board))
    if sector is not None and shrink == 1:
        found["sector"] = (board.points(), sector)
    return found


def _shrunk(image: GrayImage, factor: int) -> GrayImage:
    """Means of `factor` x `factor` pixels."""
    import cv2

    if factor == 1:
        return image
    height, width = (side // factor * factor for side in image.shape)
    size = (width // factor, height // factor)
    return np.asarray(cv2.resize(image[:height, :width], size, interpolation=cv2.INTER_AREA), np.uint8)


def _classic_corners(image: GrayImage, board: Board) -> NDArray[np.float32] | None:
    import cv2

    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    ok, corners = cv2.findChessboardCorners(image, (board.columns, board.rows), flags=flags)
    return np.asarray(corners, np.float32).reshape(-1, 2) if ok else None


def _sector_corners(image: GrayImage, board: Board) -> NDArray[np.float32] | None:
    import cv2

    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    ok, corners = cv2.findChessboardCornersSB(image, (board.columns, board.rows), flags=flags)
    return np.asarray(corners, np.float32).reshape(-1, 2) if ok else None


def _refine(image: GrayImage, corners: NDArray[np.float32], board: Board) -> NDArray[np.float32]:
    """Corners by the gradient's saddle, in a window that stays clear of the neighbouring corners."""
    import cv2

    half = int(np.clip(_pitch(corners, board) * 0.3, 2, 25))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
    start = np.ascontiguousarray(corners, np.float32).reshape(-1, 1, 2).copy()
    return np.asarray(cv2.cornerSubPix(image, start, (half, half), (-1, -1), criteria).reshape(-1, 2), np.float32)


def _pitch(corners: NDArray[np.float32], board: Board) -> float:
    """Smallest distance of two neighbouring corners of a full board, pixels."""
    grid = corners.reshape(board.rows, board.columns, 2)
    across, along = np.diff(grid, axis=1), np.diff(grid, axis=0)
    return float(min(np.linalg.norm(across, axis=2).min(), np.linalg.norm(along, axis=2).min()))


def _find_charuco(image: GrayImage, board: Board) -> Corners:
    import cv2

    dictionary_id = getattr(cv2.aruco, str(board.dictionary), None)
    if dictionary_id is None or not str(board.dictionary).startswith("DICT_"):
        raise UsageError(
            f"no marker dictionary {board.dictionary!r}", "use a name such as DICT_5X5_100 or DICT_APRILTAG_36h11"
        )
    charuco = cv2.aruco.CharucoBoard(
        (board.columns + 1, board.rows + 1),
        board.square_mm,
        board.square_mm * board.marker_ratio,
        cv2.aruco.getPredefinedDictionary(dictionary_id),
    )
    corners, ids, _, _ = cv2.aruco.CharucoDetector(charuco).detectBoard(image)
    if ids is None or len(ids) < _MIN_CORNERS:
        return {}
    points = np.asarray(charuco.getChessboardCorners(), np.float32)[np.ravel(ids)]
    if min(np.unique(points[:, 0]).size, np.unique(points[:, 1]).size) < 2:
        return {}
    return {"charuco": (points, np.asarray(corners, np.float32).reshape(-1, 2))}


def _edge_width(image: GrayImage, corners: NDArray[np.float32], board: Board) -> tuple[float, float]:
    """Width of the board's edges and size of its squares, pixels.

    The steepest slope between the levels of black and white at the board says how wide an edge is; noise can only make
    it look sharper, so a low quantile of sharpness over the squares is not used.
    """
    import cv2

    x0, y0 = np.maximum(np.floor(corners.min(axis=0)).astype(int), 0)
    x1, y1 = np.ceil(corners.max(axis=0)).astype(int) + 1
    patch = cv2.GaussianBlur(np.asarray(image[y0:y1, x0:x1], np.float32), (0, 0), 0.7)
    slope = np.hypot(cv2.Sobel(patch, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(patch, cv2.CV_32F, 0, 1, scale=1 / 8))
    contrast = float(np.subtract(*np.percentile(patch, [95, 5])))
    area = cv2.contourArea(cv2.convexHull(corners))
    squares = max((board.columns - 1) * (board.rows - 1), 1)
    return contrast / max(float(np.percentile(slope, 99)), 1e-6), float(np.sqrt(area / squares))


def calibrate_lens(found: Iterable[Sighting | Rejected], width: int, height: int) -> LensCalibration:
    """Fit pinhole, radial (k1 k2 k3) and tangential (p1 p2) distortion; boards that do not fit are dropped.

    Every detector that saw at least as many boards as any other is tried; the lowest RMS is kept.

    Args:
        found: results of `find_board`, all of pictures of one size.
        width: of the pictures, pixels.
        height: of the pictures, pixels.

    Raises:
        ReceiverError: fewer than three usable boards, or a fit that makes no sense.
    """
    results = list(found)
    rejected = [r for r in results if isinstance(r, Rejected)]
    sightings = [s for s in results if isinstance(s, Sighting)]
    if len(sightings) < MIN_BOARDS:
        reasons = "; ".join(f"{r.name}: {r.reason}" for r in rejected[:3])
        raise ReceiverError(
            f"{len(sightings)} usable boards, at least {MIN_BOARDS} are needed ({reasons or 'no pictures'})",
            "check --board (inner corners), and take 10 to 20 sharp pictures at different tilts",
        )
    detectors = {d for s in sightings for d in s.corners}
    seen = {d: [s for s in sightings if d in s.corners] for d in detectors}
    most = max(map(len, seen.values()))
    fits = [_fit_robust(s, d, (width, height)) for d, s in sorted(seen.items()) if len(s) == most]
    # A low RMS is no merit where it was bought by dropping boards.
    best = min(fits, key=lambda fit: fit.rms_px * (1 + len(fit.outliers) / len(fit.sightings)))
    unseen = [s for s in sightings if best.detector not in s.corners]
    rejected += [Rejected(s.name, f"corners not found by the {best.detector} detector") for s in unseen]
    return _finish(best, rejected, width, height)


@dataclass(frozen=True, slots=True)
class _Fit:
    detector: Detector
    sightings: list[Sighting]
    outliers: list[Rejected]
    rms_px: float
    matrix: FloatArray
    distortion: FloatArray
    sd: FloatArray
    view_rms: FloatArray
    rotations: Sequence[Any]
    translations: Sequence[Any]


def _fit_robust(sightings: list[Sighting], detector: Detector, size: tuple[int, int]) -> _Fit:
    """Fit, drop the worst board while one stands out, fit again."""
    kept, outliers = list(sightings), list[Rejected]()
    while True:
        fit = _fit(kept, detector, size, outliers)
        worst, median = int(np.argmax(fit.view_rms)), float(np.median(fit.view_rms))
        value = float(fit.view_rms[worst])
        if len(kept) <= MIN_BOARDS or value < max(_OUTLIER_RATIO * median, median + _OUTLIER_PX):
            return fit
        outliers.append(Rejected(kept[worst].name, f"outlier: RMS {value:.2f} px, the others' median {median:.2f} px"))
        del kept[worst]


def _fit(sightings: list[Sighting], detector: Detector, size: tuple[int, int], outliers: list[Rejected]) -> _Fit:
    import cv2

    pairs = [s.corners[detector] for s in sightings]
    try:
        rms, matrix, distortion, rotations, translations, sd, _, view_rms = cv2.calibrateCameraExtended(
            [points for points, _ in pairs],
            [corners.reshape(-1, 1, 2) for _, corners in pairs],
            size,
            np.eye(3),
            np.zeros(5),
        )
    except cv2.error as error:
        raise ReceiverError(
            f"the boards do not determine a lens ({str(error).strip().splitlines()[-1]})",
            "take pictures with the board tilted in different directions",
        ) from None
    return _Fit(
        detector, sightings, list(outliers), float(rms), matrix, distortion.ravel(), sd.ravel(), view_rms.ravel(),
        rotations, translations,
    )  # fmt: skip


def _finish(fit: _Fit, rejected: list[Rejected], width: int, height: int) -> LensCalibration:
    matrix, distortion = fit.matrix, fit.distortion
    if not np.isfinite(matrix).all() or min(matrix[0, 0], matrix[1, 1]) <= 0 or np.abs(distortion).max() > 100:
        raise ReceiverError(
            "the fitted lens makes no sense (focal length or distortion out of bounds)",
            "take pictures with the board tilted in different directions and out to the corners",
        )
    corners = np.vstack([s.corners[fit.detector][1] for s in fit.sightings]).astype(np.float64)
    model = LensModel(
        width=width,
        height=height,
        camera_matrix=(_triple(matrix[0]), _triple(matrix[1]), (0.0, 0.0, 1.0)),
        dist_coeffs=tuple(float(value) for value in distortion[:5]),
    )
    return LensCalibration(
        model=model,
        rms_px=fit.rms_px,
        detector=fit.detector,
        accepted={s.name: float(rms) for s, rms in zip(fit.sightings, fit.view_rms, strict=True)},
        rejected=(*rejected, *fit.outliers),
        corners=corners,
        residuals=corners - _projected(fit),
        uncovered=uncovered_parts(corners, width, height),
        intrinsic_sd_px=(float(fit.sd[0]), float(fit.sd[1]), float(fit.sd[2]), float(fit.sd[3])),
    )


def _triple(row: FloatArray) -> tuple[float, float, float]:
    return float(row[0]), float(row[1]), float(row[2])


def _projected(fit: _Fit) -> FloatArray:
    """(n, 2) where the fitted lens puts the boards' corners."""
    import cv2

    views = zip(fit.sightings, fit.rotations, fit.translations, strict=True)
    return np.vstack(
        [
            cv2.projectPoints(s.corners[fit.detector][0], r, t, fit.matrix, fit.distortion)[0].reshape(-1, 2)
            for s, r, t in views
        ]
    )


def covered_parts(corners: FloatArray, width: int, height: int) -> BoolArray:
    """(5, 5) whether a part of the field, down and across, holds corners (n, 2), pixels.

    The outer parts decide how far the distortion can be trusted.
    """
    across, down = np.clip((corners + 0.5) / [width, height] * 5, 0, 4).astype(int).T
    covered = np.zeros((5, 5), dtype=bool)
    covered[down, across] = True
    return covered


def uncovered_parts(corners: FloatArray, width: int, height: int) -> tuple[str, ...]:
    """Names of the parts of the field that hold no corners (n, 2), pixels."""
    covered = covered_parts(corners, width, height)
    rows = ("top", "upper", "middle", "lower", "bottom")
    columns = ("left", "centre left", "centre", "centre right", "right")
    return tuple(f"{rows[y]} {columns[x]}" for y, x in np.argwhere(~covered))
