"""Where the screen is in every frame of a clip, by the picture on it: what a hand that holds the camera asks for.

The outline alone does not tell: on a dark picture a side is found to several pixels, and what is learned of a picture
must lie where it was to a fraction of one. The picture's own texture tells to a tenth of a pixel, and stripes hardly
disturb it: the backlight is smooth across a row, so light over its mean over a few neighbouring pixels is texture.
What stripes leave of themselves is told from texture by its incoherence: columns send different things, so where
stripes are all there is, parts of the screen disagree about where it went. The scatter of these parts says how well
the place is known (a sandwich estimate of the covariance); what it leaves open the outline has to say.

The texture lives in the screen's coordinates (u, v). A frame is read at the place where the screen should be, and the
four corners are moved until it agrees: weighted least squares on the corners' eight coordinates, coarse, then fine
(Lucas and Kanade 1981; gradients of both textures as Benhimane and Malis 2004 have them). Four free corners follow
more than a flat screen before a lens: while a camera moves, rows are read one after the other, so that a steady motion
shears and stretches the screen. That, too, is a motion of corners, and a row remains one instant.
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

#: Exponent of the tone curve that is taken off where texture is placed; any of the usual ones will do.
_TONE = 2.2
#: Width of a screen over its height.
_ASPECT = 16 / 9
#: Cells across and down the screen that its texture is known by, about.
_CELLS_ACROSS, _CELLS_DOWN = 360, 110
#: Share of the screen's size beyond its sides that belongs to the texture: its sides tell where it is.
_MARGIN = 0.01
#: Cells across over whose mean light is texture.
_NEIGHBOURS = 7
#: Error of a cell, parts of white before the tone curve is undone, and what stripes leave of themselves in the texture.
_CELL_NOISE, _STRIPE_NOISE = 0.004, 0.08
#: What stripes make of texture on its way down the screen, squared, in parts of it: rows are lit more or less.
_UNEVEN_ROWS = 0.1
#: How much more than its expected noise a change of the texture must be; cells around over which that is judged.
_ABOVE_NOISE, _LOCAL_CELLS = 1.3, 15
#: Value below which the tone curve is taken to be as steep as there.
_DARKEST = 0.03
#: Percentage of the cells that are darker than what a dark column is taken to show.
_DARK_PERCENT = 8.0
#: Cells of a coarse cell across and down, smoothing of the coarse texture in such cells, and iterations.
_COARSE_CELLS, _COARSE_BLUR, _COARSE_ITERATIONS = (4, 2), 0.8, 4
#: Iterations of the fine fit, and squared standard deviations of a step after which a fit ends; and the same of a
#: screen whose texture is known from few frames: what is learned in a wrong place stays.
_FINE_ITERATIONS, _CONVERGED = 3, 0.5
_FIRST_ITERATIONS, _FIRST_CONVERGED = 7, 0.001
#: Every so manieth row of cells is enough of a texture that is known well.
_SOME_ROWS = 2
#: Every so manieth row of cells tells whether a screen stands still; how far, in screen sizes, it and its corners may
#: seem to have moved; and the share of the textures' correlation that must be left.
_FEW_ROWS, _STILL_SHIFT, _STILL_CORNERS, _STILL_CORRELATION = 4, 0.0003, 0.0008, 0.97
#: Cells across that a screen was at most from where it was expected, for the next to be looked for on fine cells alone.
_FORESEEN_CELLS = 2.0
#: Beyond how many standard deviations a cell is an outlier: a hand, a reflection.
_OUTLIER = 2.5
#: How far a frame may be from where it is expected, screen sizes: shift, affine modes, perspective modes.
#: A screen's size is its width, or what its height makes it on pixels that are no squares.
_SHIFT_SD, _AFFINE_SD, _PERSPECTIVE_SD = 0.008, 0.0027, 0.0004
#: Information below which there is no texture, 1 over pixels squared. Neighbouring cells err alike: that of so many
#: counts once.
_MIN_INFORMATION, _ALIKE_CELLS = 1e-9, 4.0
#: Parts of the screen, across and down, of which each may err in its own way; and how well an outline that is found in
#: a frame is known, screen sizes.
_PARTS, _OUTLINE_SD = (20, 6), 0.002
#: Standard deviation of the corners in screen sizes, and correlation of the textures, that make it certain where a
#: screen is.
_MAX_SD, _MIN_CORRELATION = 0.0012, 0.35
#: Share of the last frame's motion that the next is expected to repeat.
_PERSISTENCE = 0.7
#: Frames from which the texture is learned one by one, and how often from then on.
_FIRST_FRAMES, _LEARN_EVERY = 10, 4
#: Weight of the frames before, at most, in frames, in what is known of the texture.
_MAX_WEIGHT = 40.0
#: Corners clockwise from the top-left: their u and v.
_AT_U, _AT_V = np.array([0, 1, 1, 0]), np.array([0, 0, 1, 1])
#: Points across and down through which the screen is projected.
_KNOTS_U, _KNOTS_V = 17, 9


@dataclass(frozen=True, slots=True)
class Registration:
    """Where the screen is in a frame."""

    #: (4, 2) pixels of the stored picture, the viewer's top-left first.
    corners: FloatArray
    #: (8, 8) covariance of the corners, x and y of each in turn, pixels squared.
    covariance: FloatArray
    #: Correlation of the frame's texture with the one known, -1..1.
    correlation: float

    @property
    def sd_px(self) -> float:
        """Standard deviation of the corners, root mean square."""
        return float(np.sqrt(np.trace(self.covariance) / 8))

    @property
    def tells(self) -> bool:
        """Whether there is texture enough to tell where the screen is, if it is what it was."""
        return self.sd_px < _MAX_SD * _size(self.corners)

    @property
    def certain(self) -> bool:
        """Whether the screen is there."""
        return self.tells and self.fits

    @property
    def fits(self) -> bool:
        """Whether the picture there is the one known, be there ever so little texture."""
        return self.correlation > _MIN_CORRELATION


@dataclass(frozen=True, slots=True)
class _Texture:
    """Light over the mean of its neighbours along the row, less 1, and its weight 0..1; of cells of a picture."""

    value: Float32Array
    weight: Float32Array
    cell_x: int
    cell_y: int


@dataclass(frozen=True, slots=True)
class _Known:
    """What is known of the texture at the places v x u, (V, U) each."""

    value: Float32Array
    #: (2, V, U) its change along u and along v as far as it is more than noise, and (3, V, U) the products of these.
    along: Float32Array
    products: Float32Array
    #: How well it is known, 0..1.
    trust: Float32Array
    places: _Places

    def every(self, step: int, places: _Places) -> _Known:
        """Of every so manieth row alone, whose `places` these are."""
        all_rows = (self.value, self.along, self.products, self.trust)
        value, along, products, trust = (np.ascontiguousarray(part[..., ::step, :]) for part in all_rows)
        return _Known(value, along, products, trust, places)


@dataclass(frozen=True, slots=True)
class _AllKnown:
    """What is known of the texture: of all cells, on some rows, and on a few."""

    fine: _Known
    some: _Known
    few: _Known


@dataclass(frozen=True, slots=True)
class _Places:
    """Places v x u on the screen, and what is worked out of them once."""

    u: FloatArray
    v: FloatArray
    #: (knots, 3) points through which the screen is projected, and what makes (V, U) of values there: (V, knots down)
    #: and (knots across, U).
    knots: FloatArray
    down: Float32Array
    across: Float32Array
    #: (3, V) and (U, 3) products of two corners' shares, of a motion of which places take part in theirs.
    pairs_v: Float32Array
    pairs_u: Float32Array
    #: (2 * parts down, V) and (U, 2 * parts across) shares of the corners in each part of the screen.
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
    """The texture of a screen, and where the screen was in the last frames.

    Args:
        frame: a frame in which the screen is known.
        corners: (4, 2) where it is there, the viewer's top-left first.
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
        #: Frames so far, and what they taught of the texture; None where it has to be worked out anew.
        self._n_frames = 0
        self._known_so_far: _AllKnown | None = None
        self._coarse_so_far: _Known | None = None
        across, down = _COARSE_CELLS
        self._coarse_places = _Places.of(_middles(self._u, across), _middles(self._v, down))
        self._places = _Places.of(self._u, self._v)
        self._some_places, self._few_places = (_Places.of(self._u, self._v[::n]) for n in (_SOME_ROWS, _FEW_ROWS))
        #: Correlation of the textures when the screen was found last, all of them looked at.
        self._correlation = 1.0
        #: How far the screen was from where it was expected, at most of its corners.
        self._surprise_px = float("inf")
        self._read_last: tuple[Frame, _Texture] | None = None
        self._value: Float32Array = np.zeros((n_v, n_u), np.float32)
        self._weight: Float32Array = np.zeros((n_v, n_u), np.float32)
        self.learn(frame, Registration(corners, np.zeros((8, 8)), 1.0))

    def find(self, frame: Frame) -> Registration:
        """Where the screen is in the next frame."""
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
        """Where the screen is, if the last frame was about where it was expected and the textures agree as they did."""
        if self._surprise_px > _FORESEEN_CELLS * self._cell_x or self._n_frames <= _FIRST_FRAMES:
            return None
        before = self._correlation
        found = self._found(texture, some, (expected, expected), _FINE_ITERATIONS)
        alike = found.correlation > max(_STILL_CORRELATION * before, _MIN_CORRELATION)
        if alike and found.tells:
            return found
        self._correlation = before
        return None

    def _anywhere(self, texture: _Texture, known: _AllKnown, expected: FloatArray) -> Registration:
        """Where the screen is, on coarse cells first."""
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
        """Where the screen was, if it stood still before and a look at a few rows finds that it did not move.

        A step of a fit tells of small motions only; after a large one the textures do not agree as they did.
        """
        if not np.array_equal(self._plane, self._before):
            return None
        plane, covariance, correlation = self._fit(texture, few, (self._plane, self._plane), 1)
        moved = plane - self._plane
        found = Registration(self._lens_of(self._plane), covariance, correlation)
        shift, each, size = np.abs(moved.mean(axis=0)).max(), np.sqrt(np.square(moved).mean()), _size(plane)
        near = shift < _STILL_SHIFT * size and each < _STILL_CORNERS * size
        alike = correlation > max(_STILL_CORRELATION * self._correlation, _MIN_CORRELATION)
        return found if near and alike and found.tells else None

    def with_outline(self, found: Registration, outline: FloatArray, sd: float = _OUTLINE_SD) -> Registration:
        """What the texture says of a place, and what an outline (4, 2) says, together; `sd` in screen sizes."""
        seen, at = self._undistorted(outline), self._undistorted(found.corners)
        information = np.linalg.inv(found.covariance)
        known = 1 / (sd * _size(outline)) ** 2
        covariance = np.asarray(np.linalg.inv(information + known * np.eye(8)), np.float64)
        plane = covariance @ (information @ at.ravel() + known * seen.ravel())
        return Registration(self._lens_of(plane.reshape(4, 2)), covariance, found.correlation)

    def seek(self, corners: FloatArray) -> None:
        """The screen was found at the corners (4, 2) in another way: the next frame is expected there."""
        self._before = self._plane = self._undistorted(corners)

    def learn(self, frame: Frame, found: Registration) -> None:
        """Take the texture of a frame in which the screen was found."""
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
        # Blurred means of so many cells have so much less noise.
        fewer = across * down * (1 + 4 * np.pi * _COARSE_BLUR**2) / 2
        return _known(_coarser(_Texture(self._value, self._weight, 1, 1)), fewer, self._coarse_places)

    def _texture_of(self, frame: Frame) -> _Texture:
        """The texture of a frame; of the one that was asked for last, without reading it again."""
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
            # The prior counts against as much information as the parts' scatter leaves.
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
        """Value and weight of a frame's texture at screen places, were the screen at `plane`."""
        import cv2

        x, y = self._project(plane, places, (texture.cell_x, texture.cell_y))
        value, weight = (
            np.asarray(cv2.remap(part, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0))
            for part in (texture.value, texture.weight)
        )
        return value, weight

    def _project(self, plane: FloatArray, places: _Places, cell: tuple[int, int]) -> tuple[Float32Array, Float32Array]:
        """Cells (V, U) of screen places: exactly at some knots, and bilinearly between."""
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
    # A strip of the screen that is dark shows the room's light; its texture is nobody's.
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
    """Light and noise of every sum that so many pixels of eight bits can have."""
    return _light_and_noise(np.arange(255 * cell_y + 1, dtype=np.float32), cell_y, black, white, linear)


def _light_and_noise(
    sums: Float32Array, cell_y: int, black: float, white: float, linear: bool
) -> tuple[Float32Array, Float32Array]:
    """Light of sums of so many pixels, and what a cell of that light errs by, in parts of what stripes leave."""
    coded = np.clip((sums / np.float32(cell_y) - np.float32(black)) / np.float32(white - black), 0, 1)
    tone = np.float32(1.0 if linear else _TONE)
    steep = np.maximum(coded, np.float32(_DARKEST)) ** (tone - np.float32(1))
    return coded**tone, steep * np.float32(tone * _CELL_NOISE / _STRIPE_NOISE)


def _darkest(mean: Float32Array) -> np.float32:
    """Light that few of the cells in the middle of a picture, where the screen is, fall short of."""
    n_rows = len(mean)
    some = mean[n_rows // 4 : n_rows - n_rows // 4 : 2, ::2].ravel()
    place = int(some.size * _DARK_PERCENT / 100)
    return np.float32(np.partition(some, place)[place])


def _coarser(texture: _Texture) -> _Texture:
    """Weighted means over coarse cells; what is left over at the right and at the bottom is left out."""
    import cv2

    across, down = _COARSE_CELLS
    n_y, n_x = texture.value.shape[0] // down, texture.value.shape[1] // across
    part = np.s_[: n_y * down, : n_x * across]
    both = (texture.weight[part], (texture.value * texture.weight)[part])
    coarse = [cv2.resize(values, (n_x, n_y), interpolation=cv2.INTER_AREA) for values in both]
    weight, value = (cv2.GaussianBlur(values, (0, 0), _COARSE_BLUR) for values in coarse)
    return _Texture(
        np.asarray(value / np.maximum(weight, np.float32(TINY))),
        np.asarray(weight),
        texture.cell_x * across,
        texture.cell_y * down,
    )


def _middles(places: FloatArray, cells: int) -> FloatArray:
    """Middles of so many neighbouring places each."""
    return np.asarray(places[: places.size // cells * cells].reshape(-1, cells).mean(axis=1))


def _between(places: FloatArray, knots: FloatArray) -> Float32Array:
    """(n, knots) weights of linear interpolation at ascending places."""
    step = (places - knots[0]) * ((knots.size - 1) / (knots[-1] - knots[0]))
    return np.asarray(np.maximum(1 - np.abs(step[:, None] - np.arange(knots.size)), 0), np.float32)


def _corner_weights(places: FloatArray) -> Float32Array:
    """(2, n) how much of the motion of the corners at 0 and at 1 a place takes part in."""
    return np.stack([1 - places, places]).astype(np.float32)


def _pairs(shares: Float32Array) -> Float32Array:
    """(3, n) products of two corners' shares (2, n): those of two along u times those along v are those of two."""
    return np.stack([shares[0] * shares[0], shares[0] * shares[1], shares[1] * shares[1]])


def _in_parts(shares: Float32Array, parts: int) -> Float32Array:
    """(2 * parts, n) the corners' shares (2, n), in so many parts one after the other and none elsewhere."""
    n = shares.shape[1]
    part = np.searchsorted(np.arange(1, parts) * n // parts, np.arange(n), side="right")
    return np.asarray((shares[:, None] * (part == np.arange(parts)[:, None])).reshape(-1, n), np.float32)


def _known(texture: _Texture, fewer: float, places: _Places) -> _Known:
    """The texture at some places, its changes drawn to none where noise could make them; that is `fewer` times less."""
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
        least = np.float32(_ABOVE_NOISE) * (noise + more) / np.maximum(n, np.float32(TINY))
        change *= np.maximum(1 - least / np.maximum(power, np.float32(TINY)), 0) / np.float32(step)
    products = along[[0, 0, 1]] * along[[0, 1, 1]]
    return _Known(value, along, products, weight / (weight + np.float32(1.0)), places)


def _per_pixel(plane: FloatArray) -> FloatArray:
    """(2, 2) changes to the right and down, per pixel, by those along u and v, were the screen a parallelogram."""
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
    # From changes along u and v, of two corners each, to those per pixel.
    normal = np.tensordot(per_pixel, np.tensordot(per_pixel, normal, (0, 1)), (0, 1))
    return np.asarray(normal.transpose(2, 0, 3, 1).reshape(8, 8))


def _scores_of_parts(known: _Known, weighted: Float32Array, per_pixel: FloatArray) -> FloatArray:
    """(parts, 8) what every part of the screen says of the motion of the corners: its share of the normal equations.

    `weighted` is the error of the texture times its weight.
    """
    across, down = _PARTS
    scores = np.empty((2, 4, down * across))
    for axis, along in enumerate(known.along):
        moment = known.places.parts_v @ (weighted * along) @ known.places.parts_u
        scores[axis] = moment.reshape(2, down, 2, across)[_AT_V, :, _AT_U].reshape(4, -1)
    return np.asarray((scores.T @ per_pixel).reshape(-1, 8))


def _sandwich(normal: FloatArray, scores: FloatArray, variance: float, prior: FloatArray) -> FloatArray:
    """(8, 8) covariance of a fit: by the scatter of its parts, not below that of even noise of a `variance`, and no
    larger than the prior allows."""
    bread = np.linalg.inv(normal + (1e-6 * np.trace(normal) + _MIN_INFORMATION) * np.eye(8))
    spread = scores - scores.mean(axis=0)
    noise = _ALIKE_CELLS * variance * (normal + _MIN_INFORMATION * np.eye(8))
    covariance = bread @ (spread.T @ spread + noise) @ bread + 1e-4 * np.eye(8)
    return np.asarray(np.linalg.inv(np.linalg.inv(covariance) + prior))


def _size(corners: FloatArray) -> float:
    """Size of a screen (4, 2), pixels: its width, or what a screen as high is wide where that is more."""
    return float(max(np.ptp(corners[:, 0]), np.ptp(corners[:, 1]) * _ASPECT))


def _information(size: float) -> FloatArray:
    """(8, 8) information on how far the corners may be from where they are expected."""
    return _information_of_one() / (size * size)


@cache
def _information_of_one() -> FloatArray:
    """As `_information`, of a screen of size 1."""
    # Modes of four corners along one axis: all alike, right against left, bottom against top, and crosswise.
    modes = np.array([[1, 1, 1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1], [1, -1, 1, -1]]) / 4
    sds: Sequence[float] = (_SHIFT_SD, _AFFINE_SD, _AFFINE_SD, _PERSPECTIVE_SD)
    along = (modes.T / np.square(np.array(sds))) @ modes
    return np.asarray(np.kron(along, np.eye(2)), np.float64)
