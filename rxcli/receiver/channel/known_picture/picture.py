"""Picture without stripes, estimated over frames, and the light of the columns behind it."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass

import numpy as np

from rxcli.numerics import TINY, box_sums
from rxcli.receiver.channel.known_picture.settings import SETTINGS
from rxcli.receiver.light import Crosstalk, NoiseModel
from rxcli.types import BoolArray, Float32Array


@dataclass(frozen=True, slots=True)
class ColumnLight:
    """Light of C columns on R rows, 0 dark to 1 lit."""

    #: (C, R) float32.
    value: Float32Array
    #: (C, R) float32: inverse variance; 0 where nothing is visible.
    precision: Float32Array
    #: (C, R) float32: the value shrunk towards 0.5 by the prior.
    shrunk: Float32Array


@dataclass(frozen=True, slots=True)
class _System:
    """Factored normal equations of all rows, see `_factor`; arrays (C, R)."""

    #: (C, S, R): gain of a strip's light.
    gain: Float32Array
    diagonal: Float32Array
    next: Float32Array
    next_but_one: Float32Array
    precision: Float32Array


@dataclass(frozen=True, slots=True)
class Placement:
    """Position of the picture in a frame relative to the first frame."""

    #: (C, R) picture row of each row of the frame.
    picture_row: Float32Array
    #: (C, S, R) bool: the strip is on the screen there.
    inside: BoolArray


@dataclass(frozen=True, slots=True)
class Observation:
    """Observation of the picture by one frame."""

    #: (C, S, R) light of the strips.
    light: Float32Array
    #: (C, R) exposure-averaged slots, 0..1, and their reliability.
    slots: Float32Array
    trust: Float32Array
    #: Position of the picture, and (C, P) frame row of each picture row; None if unchanged since the first frame.
    placement: Placement | None = None
    frame_row: Float32Array | None = None


class KnownPicture:
    """Picture without stripes, estimated over frames, on the screen rows of the first frame.

    Args:
        inside: (C, S, R) whether the strip is on the screen.
        crosstalk: crosstalk of the strips.
        black_level: light of a dark slot, common or (C, S).
        noise: noise of a strip's light.
    """

    def __init__(
        self,
        inside: BoolArray,
        crosstalk: Crosstalk,
        black_level: float | Float32Array,
        noise: NoiseModel,
    ) -> None:
        self._inside = inside.astype(np.float32)
        self._crosstalk = crosstalk.shares.astype(np.float32)
        self._black_level = np.asarray(black_level, np.float32)[..., None]
        self._noise = noise
        #: (4, C, S, R) sums over the frames, see `_update_of`.
        self._sums: Float32Array = np.zeros((4, *inside.shape), np.float32)
        self._system: _System | None = None
        self._of_one: Float32Array | None = None
        #: Cached picture and variance of its light; None after a change.
        self._made: tuple[Float32Array, Float32Array] | None = None
        #: Last requested placement, and the picture there.
        self._placed: tuple[Placement, KnownPicture] | None = None
        #: (C,) variance of the columns' light over what was predicted.
        self._excess = np.ones(inside.shape[0], np.float32)

    def placed(self, placement: Placement | None) -> KnownPicture:
        """The picture on the rows of a frame; itself if `placement` is None.

        Both share the estimated noise of the columns.
        """
        if placement is None:
            return self
        if self._placed is None or self._placed[0] is not placement:
            self._placed = placement, self._moved(placement)
        return self._placed[1]

    def _moved(self, placement: Placement) -> KnownPicture:
        moved = copy(self)
        picture, variance = (_resampled(values, placement.picture_row, beyond=False) for values in self.picture())
        moved._made = picture, variance
        moved._inside = placement.inside.astype(np.float32)
        moved._system = moved._of_one = moved._placed = None
        return moved

    def learn(self, observation: Observation, *, forget: bool = True) -> Float32Array:
        """Update the picture by a frame with known slots, and return the update.

        With `forget`, earlier frames lose some weight.
        """
        update = self._update_of(observation)
        self._sums = self._sums * np.float32(SETTINGS.memory_share if forget else 1.0) + update
        self._system = self._made = self._placed = None
        return update

    def without(self, update: Float32Array) -> KnownPicture:
        """The picture without an update that `learn` returned, with nothing forgotten since.

        A picture that contains a frame's own light would confirm its decisions, wrong or right.
        """
        rest = copy(self)
        rest._sums = self._sums - update
        np.maximum(rest._sums[1:], 0, out=rest._sums[1:])
        rest._system = rest._made = rest._placed = None
        rest._excess = self._excess.copy()
        return rest

    def _update_of(self, observation: Observation) -> Float32Array:
        """(4, C, S, R) sums on the rows of the picture, two by the slots and two whatever was sent.

        Light and predicted light of a picture of 1, each weighted by the latter; predicted and measured mean light, as
        half of the slots are lit.
        """
        placement = observation.placement
        expected = self._crosstalk @ _with_neighbours(observation.slots)
        doubt = self._crosstalk @ (1 - _with_neighbours(observation.trust, 1.0))
        inside = self._inside if placement is None else placement.inside.astype(np.float32)
        # If little light was predicted, the observed light may come from other slots.
        known = expected * expected
        known /= known + np.float32(SETTINGS.prediction_error) + np.float32(SETTINGS.uncertain_error) * doubt
        light = observation.light - self._black_level
        weighted = expected * known
        weighted *= known
        weighted *= np.maximum(1 - np.float32(SETTINGS.doubt_weight) * doubt, 0)
        weighted *= inside
        sums = np.stack([weighted * light, weighted * expected, np.float32(0.5) * inside, inside * light])
        row = observation.frame_row
        return sums if row is None else np.stack([_resampled(values, row, beyond=True) for values in sums])

    def gain(self, light: Float32Array) -> float:
        """Exposure of a frame relative to earlier ones: the median over the columns of their mean light (C, S, R)."""
        rows = np.s_[..., :: SETTINGS.gain_every_row]
        inside, (usual, usual_light) = self._inside[rows], self._sums[2:][rows].sum(axis=(2, 3))
        before = 0.5 * usual_light / np.maximum(usual, TINY) + self._black_level.mean()
        mean = (light[rows] * inside).sum(axis=(1, 2)) / np.maximum(inside.sum(axis=(1, 2)), TINY)
        return float(np.median(mean / np.maximum(before, TINY)))

    def solve(self, light: Float32Array) -> ColumnLight:
        """Solve for the columns' own light in a frame.

        Args:
            light: (C, S, R).
        """
        return self._solved(light, self._settled())

    def _settled(self) -> _System:
        """The cached equations of the current picture."""
        if self._system is None:
            self._system = self._factor()
        return self._system

    def solve_again(self, light: Float32Array, expected: Float32Array, rows_per_slot: float) -> ColumnLight:
        """Solve again with strips weighted by their errors in neighbouring slots.

        A slot's own error is left out, because it would confirm the decision of that slot.

        Args:
            light: (C, S, R).
            expected: (C, R) light predicted from the decided slots.
            rows_per_slot: rows per slot.
        """
        predicted = self.picture()[0] * (self._crosstalk @ _with_neighbours(expected))
        error = light - self._black_level - predicted
        error *= error
        error *= self._inside
        around = np.maximum(_around(error, rows_per_slot), 0)
        around *= self._share_of_one(rows_per_slot)
        return self._solved(light, self._factor(around))

    def _share_of_one(self, rows_per_slot: float) -> Float32Array:
        """(C, S, R) inverse of the number of rows that `_around` adds up."""
        if self._of_one is None:
            self._of_one = np.float32(1) / (_around(self._inside, rows_per_slot) + np.float32(1e-3))
        return self._of_one

    def _solved(self, light: Float32Array, system: _System) -> ColumnLight:
        observed = self._crosstalk.T @ (system.gain * (light - self._black_level))
        prior = np.float32(SETTINGS.prior_precision)
        right = observed[:, 1] + prior / 2
        right[1:] += observed[:-1, 2]
        right[:-1] += observed[1:, 0]
        shrunk = _solve(system, right)
        precision = np.maximum(system.precision - prior, 0)
        value = shrunk + (shrunk - np.float32(0.5)) * (prior / np.maximum(precision, np.float32(1e-3)))
        return ColumnLight(value, self._tempered(precision), shrunk)

    def judge(
        self, observed: ColumnLight, expected: Float32Array, most: float, share: float, rows_per_slot: float
    ) -> ColumnLight | None:
        """Compare the light of columns with their decisions and update the noise estimate.

        Args:
            observed: the columns' light from `solve`.
            expected: (C, R) light predicted from the decided slots.
            most: largest median over the columns of the squared error relative to the predicted variance.
            share: weight of this frame relative to earlier ones, 0..1.
            rows_per_slot: rows per slot.

        Returns:
            The light with corrected precision; None, without an update, if the frame does not fit.
        """
        error = np.square(observed.value - expected) * observed.precision
        # One additional row with the predicted error, for columns without visible rows.
        n_observed = np.count_nonzero(observed.precision, axis=1).astype(np.float32)
        ratio = (error.sum(axis=1) + 1) / (n_observed + 1)
        if np.median(ratio) > most:
            return None
        self._excess *= 1 + np.float32(share) * (ratio - 1)
        precision = observed.precision / ratio[:, None]
        precision /= _error_correlation(observed.value - expected, precision, rows_per_slot)[:, None]
        return ColumnLight(observed.value, precision, observed.shrunk)

    def _tempered(self, precision: Float32Array) -> Float32Array:
        """Reduce precisions by the estimated noise of the columns; 0 where almost nothing is visible."""
        tempered = precision / (self._excess[:, None] + np.float32(SETTINGS.common_error**2) * precision)
        tempered[precision <= 1e-3] = 0
        return np.asarray(tempered, np.float32)

    def picture(self) -> tuple[Float32Array, Float32Array]:
        """The picture, and the variance of its light where half of the slots are lit; (C, S, R) each."""
        if self._made is None:
            self._made = self._make()
        return self._made

    def _make(self) -> tuple[Float32Array, Float32Array]:
        wide, smooth = np.float32(SETTINGS.wide_weight), np.float32(SETTINGS.smooth_weight)
        light, observed, *mean = self._sums
        usual, usual_light = (box_sums(values, SETTINGS.wide_rows) for values in mean)
        near = box_sums(observed, SETTINGS.around_rows) + wide
        usual_light /= np.maximum(usual, np.float32(0.1))
        around = (box_sums(light, SETTINGS.around_rows) + wide * usual_light) / near
        total = observed + smooth
        picture = np.maximum(light + smooth * around, 0) / total
        # Crosstalk alone is no observation of the picture, whose error may then be arbitrarily large.
        unknown = wide / near
        error = np.float32(SETTINGS.around_error**2) + np.float32(SETTINGS.wide_error**2) * unknown * unknown
        error *= smooth * smooth
        error += np.float32(SETTINGS.row_error) * observed
        error /= total * total
        error += np.float32(SETTINGS.min_error**2)
        return picture, self._noise.through_picture(picture, picture * picture * error, np.full(1, 0.5, np.float32))

    def _factor(self, measured: Float32Array | None = None) -> _System:
        """Factor the normal equations A m = b of every row, A symmetric with two bands: A = L D L', and diag(A^-1)."""
        picture, variance = self.picture()
        gain = picture * self._inside / (variance if measured is None else variance + measured)
        left, own, right = self._crosstalk.T
        products = np.stack([own * own, left * left, right * right, own * right, left * own, left * right])
        power = products @ (gain * picture)
        middle = power[:, 0] + np.float32(SETTINGS.prior_precision)
        middle[:-1] += power[1:, 1]
        middle[1:] += power[:-1, 2]
        beside, beyond = np.zeros_like(middle), np.zeros_like(middle)
        beside[:-1] = power[:-1, 3] + power[1:, 4]
        beyond[:-2] = power[1:-1, 5]
        return _System(gain, *_factored(middle, beside, beyond))


def _error_correlation(error: Float32Array, precision: Float32Array, rows_per_slot: float) -> Float32Array:
    """(C,) squared error of the sums over a slot's rows, relative to rows with uncorrelated errors.

    Sensor noise is uncorrelated; the error of an encoder is common to all rows of a slot. Columns with few usable slots
    are shrunk towards the mean over all columns.
    """
    n = max(round(rows_per_slot), 1)
    shape = len(error), error.shape[1] // n, n
    weight = precision[:, : shape[1] * n].reshape(shape)
    total = np.einsum("csr,csr->cs", weight, error[:, : shape[1] * n].reshape(shape))
    predicted = np.einsum("csr->cs", weight)
    used = predicted > SETTINGS.min_slot_precision
    # Means, because medians underestimate the correlation and give wrong packets with high confidence.
    squared = np.sum(np.square(total) / np.maximum(predicted, SETTINGS.min_slot_precision), axis=1, where=used)
    count = used.sum(axis=1)
    of_all = squared.sum() / max(int(count.sum()), 1)
    ratio = (squared + SETTINGS.mean_error_slots * of_all) / (count + SETTINGS.mean_error_slots)
    return np.asarray(np.maximum(ratio, SETTINGS.min_correlated_error), np.float32)


def _with_neighbours(columns: Float32Array, edge: float = 0.0) -> Float32Array:
    """(C, 3, R): each column between its neighbours."""
    out = np.full((len(columns), 3, columns.shape[1]), edge, np.float32)
    out[1:, 0], out[:, 1], out[:-1, 2] = columns[:-1], columns, columns[1:]
    return out


def _around(values: Float32Array, rows_per_slot: float) -> Float32Array:
    """Sum over the neighbouring slots without a row's own, along the last axis."""
    near, far = (int(slots * rows_per_slot) for slots in (SETTINGS.own_slots, SETTINGS.error_slots))
    return box_sums(values, far) - box_sums(values, near)


def _resampled(values: Float32Array, rows: Float32Array, *, beyond: bool) -> Float32Array:
    """(C, S, M) values (C, S, N) interpolated linearly at the rows (C, M); 0 outside if `beyond`."""
    import cv2

    n_columns, n_strips, n_rows = values.shape
    x = np.repeat(rows, n_strips, axis=0)
    y = np.broadcast_to(np.arange(len(x), dtype=np.float32)[:, None], x.shape)
    border = cv2.BORDER_CONSTANT if beyond else cv2.BORDER_REPLICATE
    read = cv2.remap(values.reshape(-1, n_rows), x, np.ascontiguousarray(y), cv2.INTER_LINEAR, borderMode=border)
    return np.asarray(read).reshape(n_columns, n_strips, -1)


def _factored(
    middle: Float32Array, beside: Float32Array, beyond: Float32Array
) -> tuple[Float32Array, Float32Array, Float32Array, Float32Array]:
    """D, the two bands of L, and the inverse of the diagonal of A^-1, of R symmetric systems (C, R) with two bands.

    A^-1 by the recursion of Takahashi, Fagan and Chin (1973): from the last column up.
    """
    n, _ = middle.shape
    diagonal, band_1, band_2 = middle.copy(), np.zeros_like(middle), np.zeros_like(middle)
    # Diagonal of A^-1 and the negative of its first band, with two more rows of zeros for the ends.
    inverse, near = np.zeros((2, n + 2, middle.shape[1]), np.float32)
    eliminated = beside.copy()
    for i in range(n):
        if i >= 1:
            diagonal[i] -= band_1[i - 1] * eliminated[i - 1]
            eliminated[i] -= band_2[i - 1] * eliminated[i - 1]
        if i >= 2:
            diagonal[i] -= band_2[i - 2] * beyond[i - 2]
        inverse[i] = 1 / diagonal[i]
        band_1[i], band_2[i] = eliminated[i] * inverse[i], beyond[i] * inverse[i]
    for i in range(n - 1, -1, -1):
        far = band_1[i] * near[i + 1] - band_2[i] * inverse[i + 2]
        near[i] = band_1[i] * inverse[i + 1] - band_2[i] * near[i + 1]
        inverse[i] += band_1[i] * near[i] - band_2[i] * far
    return diagonal, band_1, band_2, np.asarray(1 / inverse[:n], np.float32)


def _solve(system: _System, right: Float32Array) -> Float32Array:
    """The solution of every row, (C, R)."""
    n = right.shape[0]
    out = right.copy()
    for i in range(1, n):
        out[i] -= system.next[i - 1] * out[i - 1]
        if i >= 2:
            out[i] -= system.next_but_one[i - 2] * out[i - 2]
    out /= system.diagonal
    for i in range(n - 2, -1, -1):
        out[i] -= system.next[i] * out[i + 1]
        if i + 2 < n:
            out[i] -= system.next_but_one[i] * out[i + 2]
    return out
