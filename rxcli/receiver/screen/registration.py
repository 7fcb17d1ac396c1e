"""Register the screen in every frame of a clip by the picture on it, for a camera held by hand.

The outline alone is not precise enough: on a dark picture a side is found to several pixels, whereas a picture learned
over frames must be aligned to a fraction of a pixel. The picture's own texture gives a tenth of a pixel. Stripes hardly
disturb it: the backlight is smooth across a row, so light divided by its mean over a few neighbouring pixels is
texture. Residual stripes differ from texture in their incoherence. Columns send different data, so parts of a screen
without texture disagree about its motion. The scatter of these parts gives the precision of the position (a sandwich
estimate of the covariance); directions that it leaves undetermined follow the outline.

The texture is stored in the screen's coordinates (u, v). A frame is read at the expected position of the screen, and
the four corners are moved until the textures agree: weighted least squares on the corners' eight coordinates, coarse,
then fine (Lucas and Kanade 1981; gradients of both textures as in Benhimane and Malis 2004). Four free corners follow
more than a flat screen in front of a lens: rows are read one after the other, so that a steady motion of the camera
shears and stretches the screen. That is a motion of corners, too, and a row remains one instant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY
from rxcli.receiver.screen import geometry
from rxcli.types import Float32Array, FloatArray, Frame, Lens

#: Exponent of the tone curve that is undone before texture is computed; any of the usual values is accurate enough.
_TONE = 2.2
#: Ratio of a screen's width to its height.
_ASPECT = 16 / 9
#: Approximate number of cells of the texture, across and down the screen.
_CELLS_ACROSS, _CELLS_DOWN = 360, 110
#: Share of the screen's size beyond its sides that belongs to the texture: the sides help to locate it.
_MARGIN = 0.01
#: Cells across over whose mean light is texture.
_NEIGHBOURS = 7
#: Noise of a cell, as a share of white before the tone curve is undone, and residual of the stripes in the texture.
_CELL_NOISE, _STRIPE_NOISE = 0.004, 0.08
#: Squared relative change of the texture from row to row by stripes, as rows are lit unevenly.
_UNEVEN_ROWS = 0.1
#: Factor by which a gradient of the texture must exceed its expected noise; cells around over which both are averaged.
_ABOVE_NOISE, _LOCAL_CELLS = 1.3, 15
#: Value below which the slope of the tone curve is kept constant.
_DARKEST = 0.03
#: Percentile of the cells' light that is taken as the light of a dark column.
_DARK_PERCENT = 8.0
#: Cells of a coarse cell across and down, smoothing of the coarse texture in such cells, and iterations.
_COARSE_CELLS, _COARSE_BLUR, _COARSE_ITERATIONS = (4, 2), 0.8, 4
#: Iterations of the fine fit, and squared standard deviations of a step after which a fit ends. The same for a texture
#: known from few frames, where an error of position would remain in the texture.
_FINE_ITERATIONS, _CONVERGED = 3, 0.5
_FIRST_ITERATIONS, _FIRST_CONVERGED = 7, 0.001
#: Spacing of the rows of cells that a well-known texture is fitted on.
_SOME_ROWS = 2
#: Test for a screen at rest: spacing of the rows of cells used, maximum measured motion of the screen and its corners
#: in screen sizes, and minimum share of the textures' earlier correlation.
_FEW_ROWS, _STILL_SHIFT, _STILL_CORNERS, _STILL_CORRELATION = 4, 0.0003, 0.0008, 0.97
#: Maximum error of the last prediction, in cells, for the next fit to use fine cells alone.
_FORESEEN_CELLS = 2.0
#: Standard deviations beyond which a cell is an outlier: a hand, a reflection.
_OUTLIER = 2.5
#: Standard deviations of a prediction in screen sizes: shift, affine modes, perspective modes.
#: A screen's size is its width, or the width that its height implies on pixels that are not square.
_SHIFT_SD, _AFFINE_SD, _PERSPECTIVE_SD = 0.008, 0.0027, 0.0004
#: Information below which there is no texture, 1 over pixels squared. Number of neighbouring cells whose errors are
#: fully correlated.
_MIN_INFORMATION, _CORRELATED_CELLS = 1e-9, 4.0
#: Parts of the screen, across and down, with independent errors; standard deviation of an outline found in a frame,
#: screen sizes.
_PARTS, _OUTLINE_SD = (20, 6), 0.002
#: Maximum standard deviation of the corners in screen sizes, and minimum correlation of the textures, of a certain
#: position.
_MAX_SD, _MIN_CORRELATION = 0.0012, 0.35
#: Share of the last frame's motion that the next is expected to repeat.
_PERSISTENCE = 0.7
#: Number of first frames that each update the texture, and the interval of updates afterwards.
_FIRST_FRAMES, _LEARN_EVERY = 10, 4
#: Maximum weight of the earlier frames in the texture, in frames.
_MAX_WEIGHT = 40.0
#: Corners clockwise from the top-left: their u and v.
_AT_U, _AT_V = np.array([0, 1, 1, 0]), np.array([0, 0, 1, 1])
#: Points across and down through which the screen is projected.
_KNOTS_U, _KNOTS_V = 17, 9


@dataclass(frozen=True, slots=True)
class Registration:
    """Position of the screen in a frame."""

    #: (4, 2) pixels of the stored picture, the viewer's top-left first.
    corners: FloatArray
    #: (8, 8) covariance of the corners, x and y of each in turn, pixels squared.
    covariance: FloatArray
    #: Correlation of the frame's texture with the known one, -1..1.
    correlation: float

    @property
    def sd_px(self) -> float:
        """Standard deviation of the corners, root mean square."""
        return float(np.sqrt(np.trace(self.covariance) / 8))

    @property
    def tells(self) -> bool:
        """Whether the texture suffices to locate the screen, provided that the picture has not changed."""
        return self.sd_px < _MAX_SD * _size(self.corners)

    @property
    def certain(self) -> bool:
        """Whether the screen is certainly at this position."""
        return self.tells and self.fits

    @property
    def fits(self) -> bool:
        """Whether the picture at this position is the known one, even if there is little texture."""
        return self.correlation > _MIN_CORRELATION


@dataclass(frozen=True, slots=True)
class _Texture:
    """Light of cells over the mean of their neighbours along the row, minus 1, with its weight 0..1."""

    value: Float32Array
    weight: Float32Array
    cell_x: int
    cell_y: int


@dataclass(frozen=True, slots=True)
class _Known:
    """The known texture at the positions v x u, (V, U) each."""

    value: Float32Array
    #: (2, V, U) gradients along u and v, shrunk by their expected noise, and (3, V, U) their products.
    along: Float32Array
    products: Float32Array
    #: Reliability of the texture, 0..1.
    trust: Float32Array
    places: _Places

    def every(self, step: int, places: _Places) -> _Known:
        """The texture on every `step`-th row alone; `places` are the positions of these rows."""
        all_rows = (self.value, self.along, self.products, self.trust)
        value, along, products, trust = (np.ascontiguousarray(part[..., ::step, :]) for part in all_rows)
        return _Known(value, along, products, trust, places)


@dataclass(frozen=True, slots=True)
class _AllKnown:
    """The known texture: on all rows of cells, on some, and on a few."""

    fine: _Known
    some: _Known
    few: _Known


@dataclass(frozen=True, slots=True)
class _Places:
    """Positions v x u on the screen, and matrices that depend on them alone."""

    u: FloatArray
    v: FloatArray
    #: (knots, 3) points through which the screen is projected, and interpolation from these to (V, U): (V, knots down)
    #: and (knots across, U).
    knots: FloatArray
    down: Float32Array
    across: Float32Array
    #: (3, V) and (U, 3) products of two corners' weights, where a weight is the share of a corner's motion.
    pairs_v: Float32Array
    pairs_u: Float32Array
    #: (2 * parts down, V) and (U, 2 * parts across) weights of the corners in each part of the screen.
    parts_v: Float32Array
    parts_u: Float32Array

    @classmethod
    def of(cls, u: FloatArray, v: FloatArray) -> _Places:
        """Of ascending u and v."""
        knots_u, knots_v = np.linspace(u[0], u[-1], _KNOTS_U), np.linspace(v[0], v[-1], _KNOTS_V)
        grid_u, grid_v = np.meshgrid(knots_u, knots_v)
        knots = np.stack([grid_u, grid_v, np.ones_like(grid_u)], axis=-1).reshape(-1, 3)
        share_u, share_v = _corner_weights(u), _corner_weights(v)
        return cls(
            u,
            v,
            knots,
            _between(v, knots_v),
            np.ascontiguousarray(_between(u, knots_u).T),
            _pairs(share_v),
            np.ascontiguousarray(_pairs(share_u).T),
            _in_parts(share_v, _PARTS[1]),
            np.ascontiguousarray(_in_parts(share_u, _PARTS[0]).T),
        )


class ScreenTexture:
    """The texture of a screen, and its position in the last frames.

    Args:
        frame: a frame with a known position of the screen.
        corners: (4, 2) of the screen in that frame, the viewer's top-left first.
        lens: of the camera, None for one without.
    """

    def __init__(self, frame: Frame, corners: FloatArray, lens: Lens | None) -> None:
        self._lens = lens if lens is not None and not lens.corrected else None
        width = (np.linalg.norm(corners[1] - corners[0]) + np.linalg.norm(corners[2] - corners[3])) / 2
        height = (np.linalg.norm(corners[3] - corners[0]) + np.linalg.norm(corners[2] - corners[1])) / 2
        self._cell_x = max(round(float(width) / _CELLS_ACROSS), 1)
        self._cell_y = max(round(float(height) / _CELLS_DOWN), 1)
        n_u, n_v = int(width / self._cell_x), int(height / self._cell_y)
        self._u = np.linspace(-_MARGIN, 1 + _MARGIN, n_u)
        self._v = np.linspace(-_MARGIN, 1 + _MARGIN, n_v)
        self._plane = self._undistorted(corners)
        self._before = self._plane
        #: Frames so far, and the texture known from them; None if it has to be recomputed.
        self._n_frames = 0
        self._known_so_far: _AllKnown | None = None
        self._coarse_so_far: _Known | None = None
        across, down = _COARSE_CELLS
        self._coarse_places = _Places.of(_middles(self._u, across), _middles(self._v, down))
        self._places = _Places.of(self._u, self._v)
        self._some_places, self._few_places = (_Places.of(self._u, self._v[::n]) for n in (_SOME_ROWS, _FEW_ROWS))
        #: Correlation of the textures when the screen was last fitted.
        self._correlation = 1.0
        #: Error of the last prediction: the maximum over the corners.
        self._surprise_px = float("inf")
        self._read_last: tuple[Frame, _Texture] | None = None
        self._value: Float32Array = np.zeros((n_v, n_u), np.float32)
        self._weight: Float32Array = np.zeros((n_v, n_u), np.float32)
        self.learn(frame, Registration(corners, np.zeros((8, 8)), 1.0))

    def find(self, frame: Frame) -> Registration:
        """Register the screen in the next frame."""
        texture = self._texture_of(frame)
        if self._known_so_far is None:
            self._known_so_far = self._known()
        known = self._known_so_far
        still = self._still(texture, known.few)
        if still is not None:
            return still
        expected = self._plane + _PERSISTENCE * (self._plane - self._before).mean(axis=0)
        found = self._near(texture, known.some, expected) or self._anywhere(texture, known, expected)
        self._surprise_px = float(np.abs(found.corners - self._lens_of(expected)).max())
        return found

    def _near(self, texture: _Texture, some: _Known, expected: FloatArray) -> Registration | None:
        """Fit on fine cells alone: if the last prediction was good, and the textures still correlate; else None."""
        if self._surprise_px > _FORESEEN_CELLS * self._cell_x or self._n_frames <= _FIRST_FRAMES:
            return None
        before = self._correlation
        found = self._found(texture, some, (expected, expected), _FINE_ITERATIONS)
        is_correlated = found.correlation > max(_STILL_CORRELATION * before, _MIN_CORRELATION)
        if is_correlated and found.tells:
            return found
        self._correlation = before
        return None

    def _anywhere(self, texture: _Texture, known: _AllKnown, expected: FloatArray) -> Registration:
        """Fit on coarse cells, then on fine ones."""
        if self._coarse_so_far is None:
            self._coarse_so_far = self._known_coarsely()
        plane, _, _ = self._fit(_coarser(texture), self._coarse_so_far, (expected, expected), _COARSE_ITERATIONS)
        if self._n_frames > _FIRST_FRAMES:
            found = self._found(texture, known.some, (plane, expected), _FINE_ITERATIONS)
            if found.tells:
                return found
            return self._found(texture, known.fine, (plane, expected), _FINE_ITERATIONS)
        return self._found(texture, known.fine, (plane, expected), _FIRST_ITERATIONS)

    def _found(
        self, texture: _Texture, known: _Known, poses: tuple[FloatArray, FloatArray], iterations: int
    ) -> Registration:
        plane, covariance, self._correlation = self._fit(texture, known, poses, iterations)
        return Registration(self._lens_of(plane), covariance, self._correlation)

    def _still(self, texture: _Texture, few: _Known) -> Registration | None:
        """The last position, if the screen was at rest and a fit on a few rows finds no motion; else None.

        One step of a fit measures small motions only. After a large motion the correlation of the textures drops.
        """
        if not np.array_equal(self._plane, self._before):
            return None
        plane, covariance, correlation = self._fit(texture, few, (self._plane, self._plane), 1)
        moved = plane - self._plane
        found = Registration(self._lens_of(self._plane), covariance, correlation)
        shift, each, size = np.abs(moved.mean(axis=0)).max(), np.sqrt(np.square(moved).mean()), _size(plane)
        near = shift < _STILL_SHIFT * size and each < _STILL_CORNERS * size
        is_correlated = correlation > max(_STILL_CORRELATION * self._correlation, _MIN_CORRELATION)
        return found if near and is_correlated and found.tells else None

    def with_outline(self, found: Registration, outline: FloatArray, sd: float = _OUTLINE_SD) -> Registration:
        """Combine a registration with an outline (4, 2) of standard deviation `sd`, screen sizes."""
        measured, at = self._undistorted(outline), self._undistorted(found.corners)
        information = np.linalg.inv(found.covariance)
        known = 1 / (sd * _size(outline)) ** 2
        covariance = np.asarray(np.linalg.inv(information + known * np.eye(8)), np.float64)
        plane = covariance @ (information @ at.ravel() + known * measured.ravel())
        return Registration(self._lens_of(plane.reshape(4, 2)), covariance, found.correlation)

    def seek(self, corners: FloatArray) -> None:
        """Expect the next frame at corners (4, 2) that were found in another way."""
        self._before = self._plane = self._undistorted(corners)

    def learn(self, frame: Frame, found: Registration) -> None:
        """Update the texture with a frame in which the screen was found."""
        self._before, self._plane = self._plane, self._undistorted(found.corners)
        self._n_frames += 1
        if self._n_frames > _FIRST_FRAMES and self._n_frames % _LEARN_EVERY:
            return
        self._known_so_far = self._coarse_so_far = None
        value, weight = self._read(self._texture_of(frame), self._plane, self._places)
        total = self._weight + weight
        self._value += (value - self._value) * (weight / np.maximum(total, np.float32(TINY)))
        self._weight = np.minimum(total, np.float32(_MAX_WEIGHT))

    def _known(self) -> _AllKnown:
        """The texture so far."""
        fine = _known(_Texture(self._value, self._weight, 1, 1), 1.0, self._places)
        some, few = fine.every(_SOME_ROWS, self._some_places), fine.every(_FEW_ROWS, self._few_places)
        return _AllKnown(fine, some, few)

    def _known_coarsely(self) -> _Known:
        """The texture so far, of coarse cells."""
        across, down = _COARSE_CELLS
        # Number of cells that a blurred mean averages: noise is smaller by this factor.
        fewer = across * down * (1 + 4 * np.pi * _COARSE_BLUR**2) / 2
        return _known(_coarser(_Texture(self._value, self._weight, 1, 1)), fewer, self._coarse_places)

    def _texture_of(self, frame: Frame) -> _Texture:
        """The texture of a frame; that of the last one is cached."""
        if self._read_last is None or self._read_last[0] is not frame:
            self._read_last = frame, _texture_of(frame, self._cell_x, self._cell_y)
        return self._read_last[1]

    # -- one fit ---------------------------------------------------------------------------------------------------

    def _fit(
        self,
        texture: _Texture,
        known: _Known,
        poses: tuple[FloatArray, FloatArray],
        iterations: int,
    ) -> tuple[FloatArray, FloatArray, float]:
        """Corners (4, 2) on the undistorted picture, their covariance (8, 8), and the textures' correlation.

        `poses` are where to begin, and where the corners are expected.
        """
        plane, expected = poses
        prior = _information(_size(plane))
        converged = _FIRST_CONVERGED if self._n_frames <= _FIRST_FRAMES else _CONVERGED
        for _ in range(iterations):
            value, weight = self._read(texture, plane, known.places)
            weight *= known.trust
            error = known.value - value
            squared = error * error
            variance = max(float(np.vdot(weight, squared)) / max(float(weight.sum()), TINY), TINY)
            squared *= np.float32(1 / (_OUTLIER**2 * variance))
            squared += np.float32(1)
            weight /= squared
            per_pixel = _per_pixel(plane)
            normal = _normal_matrix(known, weight, per_pixel)
            error *= weight
            scores = _scores_of_parts(known, error, per_pixel)
            # The normal matrix is scaled to the information that the scatter of the parts leaves.
            scale = max(float(np.square(scores).sum() / max(np.trace(normal), TINY)), TINY)
            total = normal / scale + prior
            slope = scores.sum(axis=0) / scale + prior @ (expected - plane).ravel()
            step = np.linalg.solve(total, slope)
            plane = plane + step.reshape(4, 2)
            if step @ slope < converged:
                break
        of_known = weight * known.value
        power = float(np.vdot(of_known, known.value)) * float(np.vdot(weight * value, value))
        correlation = float(np.vdot(of_known, value)) / max(power, TINY**2) ** 0.5
        return plane, _sandwich(normal, scores, variance, prior), correlation

    def _read(self, texture: _Texture, plane: FloatArray, places: _Places) -> tuple[Float32Array, Float32Array]:
        """Value and weight of a frame's texture at screen positions, assuming the screen at `plane`."""
        import cv2

        x, y = self._project(plane, places, (texture.cell_x, texture.cell_y))
        value, weight = (
            np.asarray(cv2.remap(part, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0))
            for part in (texture.value, texture.weight)
        )
        return value, weight

    def _project(self, plane: FloatArray, places: _Places, cell: tuple[int, int]) -> tuple[Float32Array, Float32Array]:
        """Cells (V, U) of screen positions: exact at knots, bilinear in between."""
        projected = places.knots @ geometry.homography(plane).T
        pixels = self._lens_of(projected[:, :2] / projected[:, 2:])
        cells = ((pixels + 0.5) / cell - 0.5).T.reshape(2, places.down.shape[1], -1).astype(np.float32)
        return places.down @ (cells[0] @ places.across), places.down @ (cells[1] @ places.across)

    def _lens_of(self, points: FloatArray) -> FloatArray:
        return points if self._lens is None else geometry.distort(points, self._lens)

    def _undistorted(self, corners: FloatArray) -> FloatArray:
        return corners.copy() if self._lens is None else geometry.undistort(corners, self._lens)


def _texture_of(frame: Frame, cell_x: int, cell_y: int) -> _Texture:
    """The texture of a whole frame."""
    import cv2

    n_y, n_x = frame.height // cell_y, frame.width // cell_x
    pixels: NDArray[Any] = frame.pixels[: n_y * cell_y, : n_x * cell_x]
    wide = np.uint16 if pixels.dtype == np.uint8 else np.uint32
    sums = np.add.reduce(pixels.reshape(n_y, cell_y, -1), axis=1, dtype=wide)
    if wide is np.uint32:
        sums = sums.astype(np.float32)
    sums = np.asarray(cv2.resize(sums, (n_x, n_y), interpolation=cv2.INTER_AREA))
    levels = cell_y, frame.black, frame.white, frame.linear
    if wide is np.uint32:
        light, noise = _light_and_noise(sums, *levels)
    else:
        light, noise = (table.take(sums) for table in _light_and_noise_of_sums(*levels))
    mean = cv2.boxFilter(light, -1, (_NEIGHBOURS, 1), borderType=cv2.BORDER_REPLICATE)
    # A dark strip of the screen shows room light; its texture is not that of the picture.
    lit = np.maximum(mean - _darkest(mean), np.float32(1e-4))
    noise /= lit
    noise *= noise
    noise += np.float32(1)
    light -= mean
    light /= lit
    value = np.clip(light, np.float32(-1), np.float32(1), out=light)
    return _Texture(value, np.reciprocal(noise, out=noise), cell_x, cell_y)


@lru_cache(maxsize=4)
def _light_and_noise_of_sums(
    cell_y: int, black: float, white: float, linear: bool
) -> tuple[Float32Array, Float32Array]:
    """Light and noise of every possible sum of `cell_y` 8-bit pixels."""
    return _light_and_noise(np.arange(255 * cell_y + 1, dtype=np.float32), cell_y, black, white, linear)


def _light_and_noise(
    sums: Float32Array, cell_y: int, black: float, white: float, linear: bool
) -> tuple[Float32Array, Float32Array]:
    """Light of sums of `cell_y` pixels, and the noise of a cell of that light relative to the residual of stripes."""
    coded = np.clip((sums / np.float32(cell_y) - np.float32(black)) / np.float32(white - black), 0, 1)
    tone = np.float32(1.0 if linear else _TONE)
    steep = np.maximum(coded, np.float32(_DARKEST)) ** (tone - np.float32(1))
    return coded**tone, steep * np.float32(tone * _CELL_NOISE / _STRIPE_NOISE)


def _darkest(mean: Float32Array) -> np.float32:
    """Low percentile of the light of cells in the middle of a picture, where the screen is."""
    n_rows = len(mean)
    some = mean[n_rows // 4 : n_rows - n_rows // 4 : 2, ::2].ravel()
    place = int(some.size * _DARK_PERCENT / 100)
    return np.float32(np.partition(some, place)[place])


def _coarser(texture: _Texture) -> _Texture:
    """Weighted means over coarse cells; incomplete cells at the right and at the bottom are dropped."""
    import cv2

    across, down = _COARSE_CELLS
    n_y, n_x = texture.value.shape[0] // down, texture.value.shape[1] // across
    part = np.s_[: n_y * down, : n_x * across]
    fine = (texture.weight[part], (texture.value * texture.weight)[part])
    coarse = [cv2.resize(values, (n_x, n_y), interpolation=cv2.INTER_AREA) for values in fine]
    weight, value = (cv2.GaussianBlur(values, (0, 0), _COARSE_BLUR) for values in coarse)
    return _Texture(
        np.asarray(value / np.maximum(weight, np.float32(TINY))),
        np.asarray(weight),
        texture.cell_x * across,
        texture.cell_y * down,
    )


def _middles(places: FloatArray, cells: int) -> FloatArray:
    """Means of each `cells` neighbouring positions."""
    return np.asarray(places[: places.size // cells * cells].reshape(-1, cells).mean(axis=1))


def _between(places: FloatArray, knots: FloatArray) -> Float32Array:
    """(n, knots) weights of linear interpolation at ascending positions."""
    step = (places - knots[0]) * ((knots.size - 1) / (knots[-1] - knots[0]))
    return np.asarray(np.maximum(1 - np.abs(step[:, None] - np.arange(knots.size)), 0), np.float32)


def _corner_weights(places: FloatArray) -> Float32Array:
    """(2, n) shares of the motion of the corners at 0 and at 1 that positions follow."""
    return np.stack([1 - places, places]).astype(np.float32)


def _pairs(shares: Float32Array) -> Float32Array:
    """(3, n) products of pairs of the corners' weights (2, n), along u or along v."""
    return np.stack([shares[0] * shares[0], shares[0] * shares[1], shares[1] * shares[1]])


def _in_parts(shares: Float32Array, parts: int) -> Float32Array:
    """(2 * parts, n) the corners' weights (2, n), split into `parts` consecutive parts and zero elsewhere."""
    n = shares.shape[1]
    part = np.searchsorted(np.arange(1, parts) * n // parts, np.arange(n), side="right")
    return np.asarray((shares[:, None] * (part == np.arange(parts)[:, None])).reshape(-1, n), np.float32)


def _known(texture: _Texture, fewer: float, places: _Places) -> _Known:
    """The texture at `places`, its gradients shrunk by their expected noise, which is `fewer` times smaller."""
    import cv2

    def around(values: Float32Array) -> Float32Array:
        return np.asarray(cv2.boxFilter(values, -1, (_LOCAL_CELLS, _LOCAL_CELLS)))

    u, v = places.u, places.v
    value, weight = texture.value, texture.weight
    along: Float32Array = np.zeros((2, *value.shape), np.float32)
    along_u, along_v = along
    along_u[:, 1:-1] = (value[:, 2:] - value[:, :-2]) * np.float32(0.5)
    along_v[1:-1] = (value[2:] - value[:-2]) * np.float32(0.5)
    noise = np.float32(0.5 * _STRIPE_NOISE**2 / fewer)
    uneven = np.float32(_UNEVEN_ROWS) * around(value * value * weight)
    total = np.maximum(around(weight), np.float32(TINY))
    n = total / np.maximum(around((weight > 0).astype(np.float32)), np.float32(TINY))
    for change, more, step in ((along_u, np.float32(0), u[1] - u[0]), (along_v, uneven / total, v[1] - v[0])):
        power = around(change * change * weight) / total
        min_power = np.float32(_ABOVE_NOISE) * (noise + more) / np.maximum(n, np.float32(TINY))
        change *= np.maximum(1 - min_power / np.maximum(power, np.float32(TINY)), 0) / np.float32(step)
    products = along[[0, 0, 1]] * along[[0, 1, 1]]
    return _Known(value, along, products, weight / (weight + np.float32(1.0)), places)


def _per_pixel(plane: FloatArray) -> FloatArray:
    """(2, 2) gradients per pixel from those along u and v, with the screen approximated by a parallelogram."""
    side_u, side_v = (plane[1] - plane[0] + plane[2] - plane[3]) / 2, (plane[3] - plane[0] + plane[2] - plane[1]) / 2
    return np.asarray(np.linalg.inv(np.stack([side_u, side_v], axis=1)), np.float64)


def _normal_matrix(known: _Known, weight: Float32Array, per_pixel: FloatArray) -> FloatArray:
    """(8, 8) normal matrix of the motion of the corners, x and y of each in turn."""
    pairs_v, pairs_u = known.places.pairs_v, known.places.pairs_u
    uu, uv, vv = (
        (pairs_v @ (weight * product) @ pairs_u)[_AT_V[:, None] + _AT_V, _AT_U[:, None] + _AT_U]
        for product in known.products
    )
    normal = np.array([[uu, uv], [uv, vv]], np.float64)
    # From gradients along u and v, of two corners each, to gradients per pixel.
    normal = np.tensordot(per_pixel, np.tensordot(per_pixel, normal, (0, 1)), (0, 1))
    return np.asarray(normal.transpose(2, 0, 3, 1).reshape(8, 8))


def _scores_of_parts(known: _Known, weighted: Float32Array, per_pixel: FloatArray) -> FloatArray:
    """(parts, 8) right-hand sides of the normal equations for the motion of the corners, by part of the screen.

    `weighted` is the error of the texture times its weight.
    """
    across, down = _PARTS
    scores = np.empty((2, 4, down * across))
    for axis, along in enumerate(known.along):
        moment = known.places.parts_v @ (weighted * along) @ known.places.parts_u
        scores[axis] = moment.reshape(2, down, 2, across)[_AT_V, :, _AT_U].reshape(4, -1)
    return np.asarray((scores.T @ per_pixel).reshape(-1, 8))


def _sandwich(normal: FloatArray, scores: FloatArray, variance: float, prior: FloatArray) -> FloatArray:
    """(8, 8) sandwich covariance of a fit, from the scatter of its parts, white noise and the prior."""
    bread = np.linalg.inv(normal + (1e-6 * np.trace(normal) + _MIN_INFORMATION) * np.eye(8))
    scatter = scores - scores.mean(axis=0)
    noise = _CORRELATED_CELLS * variance * (normal + _MIN_INFORMATION * np.eye(8))
    covariance = bread @ (scatter.T @ scatter + noise) @ bread + 1e-4 * np.eye(8)
    return np.asarray(np.linalg.inv(np.linalg.inv(covariance) + prior))


def _size(corners: FloatArray) -> float:
    """Size of a screen (4, 2), pixels: the larger of its width and the width that its height implies."""
    return float(max(np.ptp(corners[:, 0]), np.ptp(corners[:, 1]) * _ASPECT))


def _information(size: float) -> FloatArray:
    """(8, 8) prior information on the difference of the corners from their prediction."""
    return _information_of_one() / (size * size)


@cache
def _information_of_one() -> FloatArray:
    """As `_information`, of a screen of size 1."""
    # Modes of four corners along one axis: common, right against left, bottom against top, and crosswise.
    modes = np.array([[1, 1, 1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1], [1, -1, 1, -1]]) / 4
    sds: Sequence[float] = (_SHIFT_SD, _AFFINE_SD, _AFFINE_SD, _PERSPECTIVE_SD)
    along = (modes.T / np.square(np.array(sds))) @ modes
    return np.asarray(np.kron(along, np.eye(2)), np.float64)
