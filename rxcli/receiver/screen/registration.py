"""Register the screen in every frame of a clip by the texture of the picture on it.

Texture is the light of a cell of pixels over the mean of its neighbours along the row, which hardly shows stripes; the
mean texture of the frames so far is known in the screen's coordinates (u, v). In a frame the four corners are moved by
Gauss-Newton steps, on coarse cells and then on fine ones, until the frame's texture agrees with the known one. What
remains of the stripes differs from column to column: errors of neighbouring cells are correlated.

The outline of a dark picture is found to several pixels, whereas a picture learned over frames must be aligned to a
fraction of a pixel, which texture gives. Four free corners follow more than a flat screen before a lens: rows are read
one after the other, so that a steady motion of the camera shears and stretches the screen. That is a motion of corners,
too, and a row remains one instant. See Lucas and Kanade 1981.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.settings import SETTINGS
from rxcli.types import Float32Array, FloatArray, Frame, IntArray, Lens

#: Ratio of a screen's width to its height.
_ASPECT = 16 / 9


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
        return self.sd_px < SETTINGS.max_sd * _size(self.corners)

    @property
    def fits(self) -> bool:
        """Whether the picture at this position is the known one, even if there is little texture."""
        return self.correlation > SETTINGS.min_correlation


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
    """The known texture of the screen on V x U cells."""

    #: (V, U, 2) u and v of the cells on the screen.
    points: FloatArray
    #: (V, U) texture, and its reliability, 0..1.
    value: Float32Array
    trust: Float32Array
    #: (2, 4, V, U) change of the texture by the motion of each corner along u and v, per screen.
    slopes: Float32Array


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
        across, down = sides[::2].mean(), sides[1::2].mean()
        #: Pixels of a cell across and down.
        self._cell = max(round(across / SETTINGS.cells[1]), 1), max(round(down / SETTINGS.cells[0]), 1)
        self._flat = geometry.undistort(corners, self._lens)
        self._n_frames = 0
        #: Value and weight of the known texture, and the same on coarse and on fine cells; None if to be recomputed.
        self._mean: Float32Array = np.zeros((*SETTINGS.cells, 2), np.float32)
        self._known: tuple[_Known, _Known] | None = None
        self.learn(frame, Registration(corners, 0.0, 1.0))

    def find(self, frame: Frame) -> Registration:
        """Register the screen in the next frame."""
        if self._known is None:
            self._known = _known_of(_coarser(self._mean)), _known_of(self._mean)
        flat, fine = self._flat, self._texture_of(frame)
        coarse = _Texture(_coarser(fine.values), fine.origin, fine.cell * SETTINGS.coarse[::-1])
        for texture, known in zip((coarse, fine), self._known, strict=True):
            flat, sd_px, correlation = self._fit(texture, known, flat)
        return Registration(geometry.distort(flat, self._lens), sd_px, correlation)

    def learn(self, frame: Frame, found: Registration) -> None:
        """Update the texture with a frame in which the screen was found."""
        self._flat = geometry.undistort(found.corners, self._lens)
        self._n_frames += 1
        if self._n_frames > SETTINGS.learn_every and self._n_frames % SETTINGS.learn_every:
            return
        self._known = None
        value, weight = self._read(self._texture_of(frame), self._flat, _points(*SETTINGS.cells))
        mean, before = np.moveaxis(self._mean, 2, 0)
        total = before + weight
        mean += (value - mean) * (weight / np.maximum(total, np.float32(TINY)))
        np.minimum(total, np.float32(SETTINGS.max_weight), out=before)

    def _texture_of(self, frame: Frame) -> _Texture:
        """The texture of a frame around the last place of the screen and in its middle."""
        corners = geometry.distort(self._flat, self._lens)
        reach = SETTINGS.reach * _size(corners)
        size = np.array([frame.width, frame.height])
        start = (corners.min(axis=0) - reach).clip(0, size // 4).astype(int)
        end = (corners.max(axis=0) + reach).clip(size - size // 4, size).astype(int)
        return _texture_of(frame, start, end, *self._cell)

    def _fit(self, texture: _Texture, known: _Known, flat: FloatArray) -> tuple[FloatArray, float, float]:
        """Corners (4, 2) on the undistorted picture, their standard deviation, and the textures' correlation.

        Args:
            texture: of the frame.
            known: of the screen, on cells of the same size.
            flat: corners to begin with.
        """
        prior = _prior_of_one() / _size(flat) ** 2
        # From the corners' motion along u and v to pixels, with the screen approximated by a parallelogram.
        side_u, side_v = flat[1] - flat[0] + flat[2] - flat[-1], flat[-1] - flat[0] + flat[2] - flat[1]
        by_pixels = np.linalg.inv(np.stack([side_u, side_v], axis=1) / 2).astype(np.float32)
        slopes = np.einsum("acvu,ab->cbvu", known.slopes, by_pixels).reshape(len(prior), -1)
        for _ in range(SETTINGS.max_steps):
            value, weight = self._read(texture, flat, known.points)
            error, weight = known.value - value, weight * known.trust
            squared = error * error
            variance = max(float(np.vdot(weight, squared)) / max(float(weight.sum()), TINY), TINY)
            weight /= 1 + squared / np.float32(SETTINGS.outlier**2 * variance)
            noise = SETTINGS.correlated_cells * variance
            normal = (slopes * weight.ravel()) @ slopes.T / noise + prior
            gradient = slopes @ (weight * error).ravel() / noise + prior @ (self._flat - flat).ravel()
            step = (np.linalg.solve(normal, gradient) * SETTINGS.step_share).reshape(flat.shape)
            flat = flat + step
            if np.abs(step / texture.cell).max() < SETTINGS.converged:
                break
        power = float((weight * known.value**2).sum() * (weight * value**2).sum())
        correlation = float((weight * known.value * value).sum()) / max(power, TINY**2) ** 0.5
        return flat, float(np.sqrt(np.diag(np.linalg.inv(normal)).mean())), correlation

    def _read(self, texture: _Texture, flat: FloatArray, points: FloatArray) -> tuple[Float32Array, Float32Array]:
        """Texture (...) at `points` (..., 2) of the screen, with the screen at `flat`; and its weight, 0 outside."""
        import cv2

        pixels = geometry.distort(geometry.projected(points, geometry.homography(flat)), self._lens)
        cells = ((pixels + (0.5 - texture.origin)) / texture.cell - 0.5).astype(np.float32)
        read = np.asarray(cv2.remap(texture.values, cells[..., 0], cells[..., 1], cv2.INTER_LINEAR))
        return read[..., 0], read[..., 1]


def _texture_of(frame: Frame, start: IntArray, end: IntArray, cell_x: int, cell_y: int) -> _Texture:
    """The texture of a part of a frame, from its `start` to its `end` x and y."""
    import cv2

    (left, top), (n_x, n_y) = start.tolist(), ((end - start) // (cell_x, cell_y)).tolist()
    pixels: NDArray[Any] = frame.pixels[top : top + n_y * cell_y, left : left + n_x * cell_x]
    every = max(cell_y // SETTINGS.rows_read, 1)
    rows = range((cell_y - 1) % every // 2, cell_y, every)
    sums = pixels[rows[0] :: cell_y].astype(np.uint16 if pixels.dtype == np.uint8 else np.float32)
    for row in rows[1:]:
        np.add(sums, pixels[row::cell_y], out=sums)
    coded = cv2.resize(sums, (n_x, n_y), interpolation=cv2.INTER_AREA).astype(np.float32) / np.float32(len(rows))
    coded = np.clip((coded - np.float32(frame.black)) / np.float32(frame.white - frame.black), 0, 1)
    # The tone curve is undone roughly: any of the usual ones is accurate enough.
    light = coded if frame.linear else coded * coded
    mean = cv2.boxFilter(light, -1, (SETTINGS.neighbours, 1), borderType=cv2.BORDER_REPLICATE)
    # A dark strip of the screen shows room light; its texture is not that of the picture.
    lit = np.maximum(
        mean - np.percentile(mean[::2, ::2], SETTINGS.dark_percent).astype(np.float32), np.float32(SETTINGS.min_light)
    )
    noise = np.float32(SETTINGS.noise_ratio) * (np.float32(1) if frame.linear else np.maximum(coded, 0.03)) / lit
    values = np.stack([np.clip((light - mean) / lit, -1, 1), 1 / (1 + noise * noise)], axis=2)
    return _Texture(values, start.astype(np.float64), np.array([cell_x, cell_y], np.float64))


def _coarser(texture: Float32Array) -> Float32Array:
    """Weighted means (Y, X, 2) over coarse cells; incomplete cells at the right and at the bottom are dropped."""
    import cv2

    down, across = SETTINGS.coarse
    n_y, n_x = len(texture) // down, texture.shape[1] // across
    fine = texture[: n_y * down, : n_x * across] * np.float32(1)
    fine[..., 0] *= fine[..., 1]
    cells = cv2.resize(fine, (n_x, n_y), interpolation=cv2.INTER_AREA)
    coarse = np.asarray(cv2.GaussianBlur(cells, (0, 0), SETTINGS.coarse_blur))
    coarse[..., 0] /= np.maximum(coarse[..., 1], np.float32(TINY))
    return coarse


def _known_of(texture: Float32Array) -> _Known:
    """The known texture (V, U, 2) of the whole screen, to be compared; gradients are shrunk by their noise."""
    import cv2

    value, weight = (np.ascontiguousarray(part) for part in np.moveaxis(texture, 2, 0))

    def around(values: Float32Array) -> Float32Array:
        return np.asarray(cv2.boxFilter(values, -1, (SETTINGS.local_cells, SETTINGS.local_cells)))

    total = np.maximum(around(weight), np.float32(TINY))
    noise_power = np.float32(SETTINGS.gradient_noise * value.size / np.prod(SETTINGS.cells)) / total
    gradient = np.stack(np.gradient(value)[::-1])
    for change, n in zip(gradient, value.shape[::-1], strict=True):
        power = np.maximum(around(change * change * weight) / total, np.float32(TINY))
        change *= np.maximum(1 - noise_power / power, 0) * np.float32(n / (1 + 2 * SETTINGS.margin))
    points = _points(*value.shape)
    u, v = np.moveaxis(points, 2, 0)
    shares = np.stack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v]).astype(np.float32)
    return _Known(points, value, weight / (weight + 1), gradient[:, None] * shares)


@cache
def _points(n_v: int, n_u: int) -> FloatArray:
    """(V, U, 2) u and v of the cells of the screen, 0..1 between its sides."""
    u, v = ((np.arange(n) + 0.5) / n * (1 + 2 * SETTINGS.margin) - SETTINGS.margin for n in (n_u, n_v))
    return np.stack(np.meshgrid(u, v), axis=-1)


def _size(corners: FloatArray) -> float:
    """Size of a screen (4, 2), pixels: the larger of its width and the width that its height implies."""
    return float(max(np.ptp(corners[:, 0]), np.ptp(corners[:, 1]) * _ASPECT))


@cache
def _prior_of_one() -> FloatArray:
    """(8, 8) information on the difference of the corners from their prediction, of a screen of size 1."""
    # Modes of four corners along one axis: common, right against left, bottom against top, and crosswise.
    modes = np.array([[1, 1, 1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1], [1, -1, 1, -1]]) / 4
    along = (
        modes.T / np.square([SETTINGS.shift_sd, SETTINGS.affine_sd, SETTINGS.affine_sd, SETTINGS.perspective_sd])
    ) @ modes
    return np.asarray(np.kron(along, np.eye(2)), np.float64)
