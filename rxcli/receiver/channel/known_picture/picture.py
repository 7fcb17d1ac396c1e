"""Picture without stripes, estimated over frames, and the light of the columns behind it."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rxcli.numerics import TINY, box_sums
from rxcli.receiver.channel.known_picture.equations import RowEquations
from rxcli.receiver.channel.known_picture.settings import SETTINGS
from rxcli.receiver.light import Crosstalk, NoiseModel
from rxcli.types import BoolArray, Float32Array, FloatArray

#: Information of light that almost nothing shows.
_FAINT = np.float32(1e-3)


@dataclass(frozen=True, slots=True)
class ColumnLight:
    """Light of C columns on R rows, 0 dark to 1 lit."""

    #: (C, R) float32.
    value: Float32Array
    #: (C, R) float32: inverse variance; 0 where nothing is visible.
    precision: Float32Array


@dataclass(frozen=True, slots=True)
class Observation:
    """Observation of the picture by one frame."""

    #: (C, S, R) light of the strips.
    light: Float32Array
    #: (C, R) exposure-averaged slots, 0..1, and their reliability.
    slots: Float32Array
    trust: Float32Array
    #: (C, S, R) bool: the strip is on the screen.
    inside: BoolArray
    #: Of the strips.
    crosstalk: Crosstalk
    #: (C, P) frame row of each picture row; None if unchanged since the first frame.
    frame_row: Float32Array | None = None
    #: Strips by which the picture has moved to the right on the screen.
    shift: int = 0


@dataclass(frozen=True, slots=True)
class Update:
    """What a frame shows of the picture."""

    #: (4, C, S, R), see `KnownPicture`, and the strips by which the picture had moved.
    sums: Float32Array
    shift: int


class KnownPicture:
    """Picture without stripes, estimated over frames, on the screen rows of the first frame.

    Args:
        shape: columns, strips of a column, and rows.
        black_level: light of a dark slot.
        noise: noise of a strip's light.
        exposure_slots: exposure in slots; a wrong slot changes a row's light by its share of them.
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        black_level: float,
        noise: NoiseModel,
        exposure_slots: float = 1.0,
    ) -> None:
        self._black_level = np.float32(black_level)
        self._noise = noise
        self._exposure_slots = max(exposure_slots, 1.0)
        #: (4, C, S, R) sums over the frames, see `_update_of`.
        self._sums: Float32Array = np.zeros((4, *shape), np.float32)
        #: Strips by which the picture has moved to the right on the screen.
        self._shift = 0
        #: Picture and variance of its light, and the picture where it was placed last; None after a change.
        self._made: tuple[Float32Array, Float32Array] | None = None
        self._placed: tuple[BoolArray, PlacedPicture] | None = None
        #: (C,) variance of the columns' light over what was predicted; all placed pictures share it.
        self.excess, self.adapted_excess = np.ones((2, shape[0]), np.float32)

    def placed(
        self,
        inside: BoolArray,
        crosstalk: Crosstalk,
        picture_row: Float32Array | None = None,
        shift: int = 0,
    ) -> PlacedPicture:
        """The picture on the rows of a frame.

        Args:
            inside: (C, S, R) the strip is on the screen.
            crosstalk: of the strips.
            picture_row: (C, R) row of the picture at each row of the frame; None if they are the same.
            shift: strips by which the picture has moved to the right on the screen.
        """
        if self._placed is None or self._placed[0] is not inside:
            self._move(shift)
            picture, variance = self.picture()
            if picture_row is not None:
                picture, variance = (_resampled(values, picture_row, beyond=False) for values in (picture, variance))
            excess = self.excess, self.adapted_excess
            on_frame = PlacedPicture(
                picture, variance, inside, crosstalk.shares.astype(np.float32), self._black_level, *excess
            )
            self._placed = inside, on_frame
        return self._placed[1]

    def _move(self, shift: int) -> None:
        """Move the picture on the screen; what comes in from its sides is unknown."""
        if shift != self._shift:
            self._sums, self._shift = _rolled(self._sums, shift - self._shift), shift
            self._made = self._placed = None

    def learn(self, observation: Observation, *, forget: bool = True) -> Update:
        """Update the picture by a frame with known slots, and return the update.

        With `forget`, earlier frames lose some weight.
        """
        self._move(observation.shift)
        update = self._update_of(observation)
        self._sums = self._sums * np.float32(SETTINGS.memory_share if forget else 1.0) + update
        self._made = self._placed = None
        return Update(update, observation.shift)

    def without(self, update: Update) -> KnownPicture:
        """The picture without an update that `learn` returned, with nothing forgotten since.

        A picture that contains a frame's own light would confirm its decisions, wrong or right.
        """
        rest = copy(self)
        rest._sums = self._sums - _rolled(update.sums, self._shift - update.shift)
        np.maximum(rest._sums[1:], 0, out=rest._sums[1:])
        rest._made, rest._placed, rest.excess = None, None, self.excess.copy()
        rest.adapted_excess = self.adapted_excess.copy()
        return rest

    def _update_of(self, observation: Observation) -> Float32Array:
        """(4, C, S, R) sums on the rows of the picture, two by the slots and two whatever was sent.

        Light and predicted light of a picture of 1, each weighted by the latter; predicted and measured mean light, as
        half of the slots are lit.
        """
        expected = observation.crosstalk.shares.astype(np.float32) @ _with_neighbours(observation.slots)
        inside, row = observation.inside.astype(np.float32), observation.frame_row
        # If little light was predicted, the observed light may come from other slots.
        power = expected * expected
        weighted = expected * np.square(power / (power + np.float32(SETTINGS.prediction_error))) * inside
        weighted *= observation.trust[:, None]
        light = observation.light - self._black_level
        sums = np.stack([weighted * light, weighted * expected, np.float32(0.5) * inside, inside * light])
        return sums if row is None else np.stack([_resampled(values, row, beyond=True) for values in sums])

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
        error += np.float32(SETTINGS.row_error / self._exposure_slots**2) * observed
        error /= total * total
        error += np.float32(SETTINGS.min_error**2)
        return picture, self._noise.through_picture(picture, picture * picture * error, np.full(1, 0.5, np.float32))


@dataclass(frozen=True, eq=False)
class PlacedPicture:
    """The known picture on the rows of a frame, which gives the light of the columns."""

    #: (C, S, R) light of the strips with all slots lit, and its variance where half of the slots are lit.
    picture: Float32Array
    variance: Float32Array
    #: (C, S, R) the strip is on the screen.
    inside: BoolArray
    #: (S, 3) see `Crosstalk`; and light of a dark slot.
    crosstalk: Float32Array
    black_level: np.float32
    #: (C,) variance of the columns' light over what is predicted; `judge` updates it in place.
    excess: Float32Array
    #: The same where it is adapted to a frame.
    adapted_excess: Float32Array

    @cached_property
    def _equations(self) -> RowEquations:
        return RowEquations.of(self.picture, self.picture * self.inside / self.variance, self.crosstalk)

    def solve(self, light: Float32Array) -> ColumnLight:
        """Solve for the columns' own light in a frame.

        Args:
            light: (C, S, R).
        """
        return self._solved(light, self._equations)

    def solve_again(self, light: Float32Array, expected: Float32Array, rows_per_slot: float) -> ColumnLight:
        """Solve again with strips weighted by their errors in neighbouring slots.

        A slot's own error is left out, because it would confirm the decision of that slot.

        Args:
            light: (C, S, R).
            expected: (C, R) light predicted from the decided slots.
            rows_per_slot: rows per slot.
        """
        error = light - self.black_level - self.picture * (self.crosstalk @ _with_neighbours(expected))
        error *= error
        error *= self.inside
        around = _around(error, rows_per_slot) / (_around(self.inside.astype(np.float32), rows_per_slot) + _FAINT)
        gain = self.picture * self.inside / (self.variance + np.maximum(around, 0))
        return self._solved(light, RowEquations.of(self.picture, gain, self.crosstalk))

    def _solved(self, light: Float32Array, equations: RowEquations) -> ColumnLight:
        """The columns' light by least squares, without the prior that kept the equations regular."""
        shrunk, precision = equations.solve(light - self.black_level), equations.precision
        prior = np.float32(SETTINGS.prior_precision)
        value = shrunk + (shrunk - np.float32(0.5)) * (prior / np.maximum(precision, _FAINT))
        # Precisions are reduced by the estimated noise of the columns; 0 where almost nothing is visible.
        tempered = precision / (self.excess[:, None] + np.float32(SETTINGS.common_error**2) * precision)
        tempered[precision <= _FAINT] = 0
        return ColumnLight(np.asarray(value, np.float32), np.asarray(tempered, np.float32))

    def adapted(self, light: Float32Array, slots: Float32Array | None, rows_per_slot: float) -> PlacedPicture:
        """The picture as the light of a frame shows it, where that differs from what was known.

        The mean light of some symbols shows the picture whatever was sent; finer texture is kept by the share to which
        it explains the light.

        Args:
            light: (C, S, R).
            slots: (C, R) light of the columns; None: nothing was decided.
            rows_per_slot: rows per slot.
        """
        half = max(int(SETTINGS.level_slots * rows_per_slot), 1)
        own = np.float32(0.5) if slots is None else self.crosstalk @ _with_neighbours(slots)
        inside = self.inside.astype(np.float32)
        above, predicted = (light - self.black_level) * inside, self.picture * own * inside
        total = box_sums(predicted, half) + _FAINT
        gain = box_sums(above, half) / total
        noise = box_sums(self.variance * inside, half) / np.square(total)
        power = np.square(gain - 1)
        gain = 1 + (gain - 1) * np.maximum(power - noise, 0) / (power + np.float32(TINY))
        picture = self.picture * np.maximum(gain, 0)
        smooth = box_sums(picture * inside, half) / (box_sums(inside, half) + _FAINT)
        fine, weight = (picture - smooth) * own, inside / self.variance
        error = above - smooth * own * inside
        explained, most = (box_sums((weight * fine * values).sum(axis=1), half) for values in (error, fine))
        share = np.clip((explained + 1) / (most + 1), 0, 1)[:, None]
        return replace(self, picture=smooth + share * (picture - smooth), excess=self.adapted_excess)

    def displacement(
        self, light: Float32Array, slots: Float32Array, slope: Float32Array
    ) -> tuple[FloatArray, FloatArray] | None:
        """Columns by which the left and the right lie to the right of where they are taken to be, and their covariance.

        Args:
            light: (C, S, R).
            slots: (C, R) light of the columns, from decided slots.
            slope: (S, 3) change of the crosstalk with the place of a strip, per column.

        Returns:
            (2,) and (2, 2); None where nothing shows it.
        """
        around = _with_neighbours(slots)
        error = light - self.black_level - self.picture * (self.crosstalk @ around)
        change = self.picture * (slope @ around)
        weighted = change * (self.inside / self.variance)
        shown, information = ((weighted * each).sum(axis=2, dtype=np.float64).ravel() for each in (error, change))
        right = (np.arange(shown.size) + 0.5) / shown.size
        sides = np.stack([1 - right, right])
        total = (sides * information) @ sides.T
        if np.linalg.det(total) <= 0:
            return None
        inverse = np.linalg.inv(total)
        off = inverse @ (sides @ shown)
        # Errors are correlated over the rows of a strip, and not over strips.
        left = sides * (shown - information * (off @ sides))
        return off, inverse @ (left @ left.T) @ inverse

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
        error = observed.value - expected
        weighted = error * observed.precision
        # One additional row with the predicted error, for columns without visible rows.
        n_observed = (observed.precision > 0).sum(axis=1)
        ratio = np.asarray((np.einsum("cr,cr->c", weighted, error) + 1) / (n_observed + 1), np.float32)
        if np.median(ratio) > most:
            return None
        np.multiply(self.excess, 1 + np.float32(share) * (ratio - 1), out=self.excess)
        ratio *= _error_correlation(weighted / ratio[:, None], observed.precision / ratio[:, None], rows_per_slot)
        return ColumnLight(observed.value, observed.precision / ratio[:, None])


def _error_correlation(weighted: Float32Array, precision: Float32Array, rows_per_slot: float) -> Float32Array:
    """(C,) squared error of the sums over a slot's rows, relative to rows with uncorrelated errors.

    Sensor noise is uncorrelated; the error of an encoder is common to all rows of a slot. Columns with few usable slots
    are shrunk towards the mean over all columns.

    Args:
        weighted: (C, R) errors times their precision.
        precision: (C, R).
        rows_per_slot: rows per slot.
    """
    n = max(round(rows_per_slot), 1)
    n_slots = precision.shape[1] // n
    total, predicted = (
        values[:, : n_slots * n].reshape(-1, n_slots, n).sum(axis=2) for values in (weighted, precision)
    )
    used = predicted > SETTINGS.min_slot_precision
    # Means, because medians underestimate the correlation and give wrong packets with high confidence.
    squared = np.sum(np.square(total) / np.maximum(predicted, SETTINGS.min_slot_precision), axis=1, where=used)
    count = used.sum(axis=1)
    of_all = squared.sum() / max(int(count.sum()), 1)
    ratio = (squared + SETTINGS.mean_error_slots * of_all) / (count + SETTINGS.mean_error_slots)
    return np.asarray(np.maximum(ratio, SETTINGS.min_correlated_error), np.float32)


def _rolled(values: Float32Array, strips: int) -> Float32Array:
    """(4, C, S, R) values moved to the right by some strips; 0 comes in."""
    if not strips:
        return values
    flat = values.reshape(len(values), -1, values.shape[-1])
    out, n = np.zeros_like(flat), flat.shape[1]
    n_left = max(n - abs(strips), 0)
    start, source = max(strips, 0), max(-strips, 0)
    out[:, start : start + n_left] = flat[:, source : source + n_left]
    return out.reshape(values.shape)


def _with_neighbours(columns: Float32Array) -> Float32Array:
    """(C, 3, R): each column between its neighbours."""
    out = np.zeros((len(columns), 3, columns.shape[1]), np.float32)
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
