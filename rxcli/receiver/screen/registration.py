"""Register the screen in every frame of a clip by the texture of the picture on it.

Texture is the light of a cell of pixels over the mean of its neighbours along the row, which hardly shows stripes; the
mean texture of the frames so far is known in the screen's coordinates (u, v). In a frame the four corners are moved by
Gauss-Newton steps, on coarse cells and then on the fine ones of steepest texture, until the frame's texture agrees with
the known one. What remains of the stripes differs from column to column: errors of neighbouring cells are correlated.

The outline of a dark picture is found to several pixels, whereas a picture learned over frames must be aligned to a
fraction of a pixel, which texture gives. Four free corners follow more than a flat screen before a lens: rows are read
one after the other, so that a steady motion of the camera shears and stretches the screen. That is a motion of corners,
too, and a row remains one instant. See Lucas and Kanade 1981.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY
from rxcli.receiver.screen import geometry
from rxcli.types import Float32Array, FloatArray, Frame, IntArray, Lens

#: Ratio of a screen's width to its height.
_ASPECT = 16 / 9
#: Cells down and across the screen whose texture is known, and parts of the screen with independent errors. The parts
#: divide the cells and the coarse cells.
_CELLS, _PARTS = (108, 360), (6, 18)
#: Cells of a coarse cell down and across, and smoothing of the coarse texture in such cells.
_COARSE, _COARSE_BLUR = np.array([2, 4]), 0.8
#: Adjacent fine cells along a row, whose most informative one is compared; and minimum number of rows read in a cell.
_COMPARED_OF, _ROWS_READ = 4, 3
#: Screen sizes around the expected screen that are searched.
_REACH = 0.06
#: Share of the screen's size beyond its sides that belongs to the texture: the sides help to locate it.
_MARGIN = 0.02
#: Cells across over whose mean light is texture.
_NEIGHBOURS = 7
#: Standard deviation of a cell's light as a share of white, and of the stripes that remain in the texture.
_CELL_NOISE, _STRIPE_NOISE = 0.009, 0.08
#: Percentile of the cells' light that is taken as the light of a dark column.
_DARK_PERCENT = 8.0
#: Factor by which a gradient of the texture must exceed its expected noise; cells around over which both are averaged.
_ABOVE_NOISE, _LOCAL_CELLS = 1.3, 15
#: Maximum iterations of a fit, and motion of the corners, cells, after which it ends. Fine detail makes a whole
#: Gauss-Newton step too long.
_ITERATIONS, _CONVERGED, _STEP_SHARE = 8, 0.2, 0.7
#: Standard deviations beyond which a cell is an outlier: a hand, a reflection.
_OUTLIER = 2.5
#: Number of neighbouring cells whose errors are fully correlated, as those of the stripes that remain.
_CORRELATED_CELLS = 4.0
#: Standard deviations of a prediction in screen sizes: shift, affine modes, perspective modes.
#: A screen's size is its width, or the width that its height implies on pixels that are not square.
_SHIFT_SD, _AFFINE_SD, _PERSPECTIVE_SD = 0.008, 0.0027, 0.0004
#: Maximum standard deviation of the corners in screen sizes, and minimum correlation of the textures, of a certain
#: position.
_MAX_SD, _MIN_CORRELATION = 0.0012, 0.35
#: Number of first frames that each update the texture, and the interval of updates afterwards.
_FIRST_FRAMES, _LEARN_EVERY = 10, 8
#: Maximum weight of the earlier frames in the texture, in frames.
_MAX_WEIGHT = 40.0


@dataclass(frozen=True, slots=True)
class Registration:
    """Position of the screen in a frame."""

    #: (4, 2) pixels of the stored picture, the viewer's top-left first.
    corners: FloatArray
    #: Standard deviation of the corners, pixels, root mean square.
    sd_px: float
    #: Correlation of the frame's texture with the known one, -1..1.
    correlation: float

    @property
    def is_precise(self) -> bool:
        """Whether the texture suffices to locate the screen, provided that the picture has not changed."""
        return self.sd_px < _MAX_SD * _size(self.corners)

    @property
    def fits(self) -> bool:
        """Whether the picture at this position is the known one, even if there is little texture."""
        return self.correlation > _MIN_CORRELATION


@dataclass(frozen=True, slots=True)
class _Texture:
    """Texture of a frame around the screen."""

    #: (Y, X, 2) texture, and its weight 0..1.
    values: Float32Array
    #: Pixel x and y of the first cell's corner, and pixels of a cell across and down.
    origin: FloatArray
    cell: FloatArray


@dataclass(frozen=True, slots=True)
class _Known:
    """The known texture of P parts of the screen, on the K most informative cells of each."""

    #: (3, P, K) u, v and 1 of the cells on the screen.
    points: FloatArray
    #: (P, K) texture, and its reliability, 0..1.
    value: Float32Array
    trust: Float32Array
    #: (2, P, K) gradient of the texture along u and v, per screen; and (3, P, K) its products uu, uv and vv.
    gradient: Float32Array
    products: Float32Array


class ScreenTexture:
    """The texture of a screen, and its position in the last frames.

    Args:
        frame: a frame with a known position of the screen.
        corners: (4, 2) of the screen in that frame, the viewer's top-left first.
        lens: of the camera, None for one without.
    """

    def __init__(self, frame: Frame, corners: FloatArray, lens: Lens | None) -> None:
        self._lens = geometry.bending(lens)
        sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
        height, width = (sides[1] + sides[3]) / 2, (sides[0] + sides[2]) / 2
        #: Pixels of a cell across and down.
        self._cell = max(round(width / _CELLS[1]), 1), max(round(height / _CELLS[0]), 1)
        self._flat = geometry.undistort(corners, self._lens)
        self._n_frames = 0
        #: Value and weight of the known texture, and the same on coarse and on fine cells; None if to be recomputed.
        self._mean: Float32Array = np.zeros((*_CELLS, 2), np.float32)
        self._known: tuple[_Known, _Known] | None = None
        self._read_last: tuple[Frame, _Texture] | None = None
        self.learn(frame, Registration(corners, 0.0, 1.0))

    def find(self, frame: Frame) -> Registration:
        """Register the screen in the next frame."""
        if self._known is None:
            self._known = _known_of(_coarser(self._mean), 1), _known_of(self._mean, _COMPARED_OF)
        flat = self._flat
        fine = self._texture_of(frame)
        coarse = _Texture(_coarser(fine.values), fine.origin, fine.cell * _COARSE[::-1])
        for texture, known in zip((coarse, fine), self._known, strict=True):
            flat, sd_px, correlation = self._fit(texture, known, flat)
        return Registration(geometry.distort(flat, self._lens), sd_px, correlation)

    def learn(self, frame: Frame, found: Registration) -> None:
        """Update the texture with a frame in which the screen was found."""
        self._flat = geometry.undistort(found.corners, self._lens)
        self._n_frames += 1
        if self._n_frames > _FIRST_FRAMES and self._n_frames % _LEARN_EVERY:
            return
        self._known = None
        texture = self._texture_of(frame)
        value, weight = self._read(texture, self._flat, _points(*_CELLS))
        mean, before = np.moveaxis(self._mean, 2, 0)
        total = before + weight
        mean += (value - mean) * (weight / np.maximum(total, np.float32(TINY)))
        np.minimum(total, np.float32(_MAX_WEIGHT), out=before)

    def _texture_of(self, frame: Frame) -> _Texture:
        """The texture of a frame around the last place of the screen and in its middle; that of one frame is cached."""
        if self._read_last is None or self._read_last[0] is not frame:
            corners = geometry.distort(self._flat, self._lens)
            reach = _REACH * _size(corners)
            size = np.array([frame.width, frame.height])
            start = (corners.min(axis=0) - reach).clip(0, size // 4).astype(int)
            end = (corners.max(axis=0) + reach).clip(size - size // 4, size).astype(int)
            self._read_last = frame, _texture_of(frame, start, end, *self._cell)
        return self._read_last[1]

    def _fit(self, texture: _Texture, known: _Known, flat: FloatArray) -> tuple[FloatArray, float, float]:
        """Corners (4, 2) on the undistorted picture, their standard deviation, and the textures' correlation.

        Args:
            texture: of the frame.
            known: of the screen, on cells of the same size.
            flat: corners to begin with.
        """
        prior, (shares, pairs) = _prior_of_one() / _size(flat) ** 2, _corner_shares()
        # From the corners' motion along u and v to pixels, with the screen approximated by a parallelogram.
        side_u, side_v = flat[1] - flat[0] + flat[2] - flat[3], flat[3] - flat[0] + flat[2] - flat[1]
        inverse = np.linalg.inv(np.stack([side_u, side_v], axis=1) / 2)
        to_pixels = (np.eye(4)[:, :, None] * inverse[:, None, None]).reshape(8, 8)
        for _ in range(_ITERATIONS):
            value, weight = self._read(texture, flat, known.points)
            error, weight = known.value - value, weight * known.trust
            squared = error * error
            variance = max(float(np.vdot(weight, squared)) / max(float(weight.sum()), TINY), TINY)
            weight /= 1 + squared / np.float32(_OUTLIER**2 * variance)
            products = np.einsum("npk,pk->np", known.products, weight)[[0, 1, 1, 2]]
            along_corners = (products @ pairs).reshape(2, 2, 4, 4).swapaxes(1, 2).reshape(8, 8)
            normal = to_pixels.T @ along_corners @ to_pixels
            along = np.einsum("npk,pk->np", known.gradient, weight * error)
            noise = _CORRELATED_CELLS * variance
            slope = (along @ shares.T).ravel() @ to_pixels / noise + prior @ (self._flat - flat).ravel()
            step = np.linalg.solve(normal / noise + prior, slope) * _STEP_SHARE
            flat = flat + step.reshape(4, 2)
            if np.abs(step.reshape(4, 2) / texture.cell).max() < _CONVERGED:
                break
        power = float((weight * known.value**2).sum() * (weight * value**2).sum())
        correlation = float((weight * known.value * value).sum()) / max(power, TINY**2) ** 0.5
        sd_px = float(np.sqrt(np.trace(np.linalg.inv(normal / noise + prior)) / 8))
        return flat, sd_px, correlation

    def _read(self, texture: _Texture, flat: FloatArray, points: FloatArray) -> tuple[Float32Array, Float32Array]:
        """Texture (n, m) at `points` (3, n, m) of the screen, with the screen at `flat`; and its weight, 0 outside."""
        import cv2

        x, y, scale = np.tensordot(geometry.homography(flat), points, 1)
        pixels = geometry.distort(np.stack([x / scale, y / scale], axis=-1), self._lens)
        cells = ((pixels + (0.5 - texture.origin)) / texture.cell - 0.5).astype(np.float32)
        read = np.asarray(cv2.remap(texture.values, cells[..., 0], cells[..., 1], cv2.INTER_LINEAR))
        return read[..., 0], read[..., 1]


def _texture_of(frame: Frame, start: IntArray, end: IntArray, cell_x: int, cell_y: int) -> _Texture:
    """The texture of a part of a frame, from its `start` to its `end` x and y."""
    import cv2

    (left, top), (n_x, n_y) = start.tolist(), ((end - start) // (cell_x, cell_y)).tolist()
    pixels: NDArray[Any] = frame.pixels[top : top + n_y * cell_y, left : left + n_x * cell_x]
    every = max(cell_y // _ROWS_READ, 1)
    rows = range((cell_y - 1) % every // 2, cell_y, every)
    sums = pixels[rows[0] :: cell_y].astype(np.uint16 if pixels.dtype == np.uint8 else np.float32)
    for row in rows[1:]:
        np.add(sums, pixels[row::cell_y], out=sums)
    coded = cv2.resize(sums, (n_x, n_y), interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(len(rows))
    coded = np.clip((coded - np.float32(frame.black)) / np.float32(frame.white - frame.black), 0, 1)
    # The tone curve is undone roughly: any of the usual ones is accurate enough.
    light = coded if frame.linear else coded * coded
    mean = cv2.boxFilter(light, -1, (_NEIGHBOURS, 1), borderType=cv2.BORDER_REPLICATE)
    # A dark strip of the screen shows room light; its texture is not that of the picture.
    middle = mean[n_y // 4 : n_y - n_y // 4 : 2, ::2]
    lit = np.maximum(mean - np.percentile(middle, _DARK_PERCENT).astype(np.float32), np.float32(1e-4))
    noise = np.float32(_CELL_NOISE / _STRIPE_NOISE) * (np.float32(1) if frame.linear else np.maximum(coded, 0.03)) / lit
    values = np.stack([np.clip((light - mean) / lit, -1, 1), 1 / (1 + noise * noise)], axis=2)
    return _Texture(values, start.astype(np.float64), np.array([cell_x, cell_y], np.float64))


def _coarser(texture: Float32Array) -> Float32Array:
    """Weighted means (Y, X, 2) over coarse cells; incomplete cells at the right and at the bottom are dropped."""
    import cv2

    n_y, n_x = np.floor_divide(texture.shape[:2], _COARSE).tolist()
    fine = texture[: n_y * _COARSE[0], : n_x * _COARSE[1]].copy()
    fine[..., 0] *= fine[..., 1]
    coarse = cv2.GaussianBlur(cv2.resize(fine, (n_x, n_y), interpolation=cv2.INTER_AREA), (0, 0), _COARSE_BLUR)
    coarse[..., 0] /= np.maximum(coarse[..., 1], np.float32(TINY))
    return np.asarray(coarse)


def _known_of(texture: Float32Array, of_cells: int) -> _Known:
    """The known texture of the whole screen, to be compared; gradients are shrunk by their noise.

    Args:
        texture: (V, U, 2).
        of_cells: number of adjacent cells along a row whose most informative one is compared.
    """
    import cv2

    value, weight = (np.ascontiguousarray(part) for part in np.moveaxis(texture, 2, 0))

    def around(values: Float32Array) -> Float32Array:
        return np.asarray(cv2.boxFilter(values, -1, (_LOCAL_CELLS, _LOCAL_CELLS)))

    total = np.maximum(around(weight), np.float32(TINY))
    noise_power = np.float32(_ABOVE_NOISE * 0.5 * _STRIPE_NOISE**2 * value.size / np.prod(_CELLS)) / total
    gradient = np.stack(np.gradient(value)[::-1])
    for change, n in zip(gradient, value.shape[::-1], strict=True):
        power = np.maximum(around(change * change * weight) / total, np.float32(TINY))
        change *= np.maximum(1 - noise_power / power, 0) * np.float32(n / (1 + 2 * _MARGIN))
    trust = weight / (weight + 1)
    along_u, along_v = (trust * change * change for change in gradient)
    information = along_u / (along_u.mean() + np.float32(TINY)) + along_v / (along_v.mean() + np.float32(TINY))
    cells = np.arange(0, value.size, of_cells) + information.reshape(-1, of_cells).argmax(axis=1)
    down, across = _PARTS
    cells = cells.reshape(down, len(value) // down, across, -1).swapaxes(1, 2).reshape(down * across, -1)
    gradient = gradient.reshape(2, -1).take(cells, axis=1)
    products = np.stack([gradient[0] ** 2, gradient[0] * gradient[1], gradient[1] ** 2])
    points = _points(*value.shape).reshape(3, -1).take(cells, axis=1)
    return _Known(points, value.take(cells), trust.take(cells), gradient, products)


@cache
def _corner_shares() -> tuple[FloatArray, FloatArray]:
    """(4, P) share of each corner's motion in that of the middle of every part; (P, 16) products of these shares."""
    v, u = (_fractions(n) for n in _PARTS)
    corners = (1 - v, 1 - u), (1 - v, u), (v, u), (v, 1 - u)
    shares = np.stack([np.outer(down, across).ravel() for down, across in corners])
    return shares, (shares[:, None] * shares).reshape(16, -1).T


def _fractions(n: int) -> FloatArray:
    """Positions of `n` cells on the screen, 0..1 between its sides."""
    return (np.arange(n) + 0.5) / n * (1 + 2 * _MARGIN) - _MARGIN


@cache
def _points(n_v: int, n_u: int) -> FloatArray:
    """(3, V, U) u, v and 1 of the cells of the screen."""
    u, v = np.meshgrid(_fractions(n_u), _fractions(n_v))
    return np.stack([u, v, np.ones_like(u)])


def _size(corners: FloatArray) -> float:
    """Size of a screen (4, 2), pixels: the larger of its width and the width that its height implies."""
    return float(max(np.ptp(corners[:, 0]), np.ptp(corners[:, 1]) * _ASPECT))


@cache
def _prior_of_one() -> FloatArray:
    """(8, 8) information on the difference of the corners from their prediction, of a screen of size 1."""
    # Modes of four corners along one axis: common, right against left, bottom against top, and crosswise.
    modes = np.array([[1, 1, 1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1], [1, -1, 1, -1]]) / 4
    along = (modes.T / np.square([_SHIFT_SD, _AFFINE_SD, _AFFINE_SD, _PERSPECTIVE_SD])) @ modes
    return np.asarray(np.kron(along, np.eye(2)), np.float64)
