"""The picture without stripes, learned frame by frame, and the columns' light through it."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from rxcli.numerics import box_sums
from rxcli.receiver.channel.known_picture.settings import SETTINGS
from rxcli.receiver.light import Crosstalk, NoiseModel
from rxcli.types import BoolArray, Float32Array


@dataclass(frozen=True, slots=True)
class ColumnLight:
    """Light of C columns on R rows, between 0, dark, and 1, lit."""

    #: (C, R) float32.
    value: Float32Array
    #: (C, R) float32: inverse of the variance; 0 where nothing is seen.
    precision: Float32Array
    #: (C, R) float32: the value drawn to 0.5 where little is seen.
    shrunk: Float32Array


@dataclass(frozen=True, slots=True)
class _System:
    """The normal equations of all rows, factored; see `_factor`. Arrays (C, R)."""

    #: (C, S, R): what a strip's light is multiplied with.
    gain: Float32Array
    diagonal: Float32Array
    next: Float32Array
    next_but_one: Float32Array
    precision: Float32Array


@dataclass(frozen=True, slots=True)
class Placement:
    """Where the picture lies in a frame that shows it elsewhere than the first one did."""

    #: (C, R) row of the picture that each row of the frame shows.
    picture_row: Float32Array
    #: (C, S, R) bool: the strip is on the screen there.
    inside: BoolArray


@dataclass(frozen=True, slots=True)
class Look:
    """What a frame taught of the picture."""

    #: (C, S, R) light of the strips.
    light: Float32Array
    #: (C, R) exposure-averaged slots, 0..1, and how far each is trusted.
    slots: Float32Array
    trust: Float32Array
    #: Where the frame shows the picture, and (C, P) its row that shows each row of the picture; None where it is
    #: where the first one did.
    placement: Placement | None = None
    frame_row: Float32Array | None = None
    #: (R,) the rows that are meant; None for all.
    rows: BoolArray | None = None


class KnownPicture:
    """The picture without stripes, learned frame by frame, on the rows of the screen as the first frame showed it.

    Args:
        inside: (C, S, R) the strip is on the screen there.
        crosstalk: of the strips.
        black_level: light of a dark slot, one for all or (C, S).
        noise: of a strip's light.
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
        self._light: Float32Array = np.zeros(inside.shape, np.float32)
        self._observed: Float32Array = np.zeros(inside.shape, np.float32)
        self._system: _System | None = None
        self._of_one: Float32Array | None = None
        #: The picture and its relative variance as they were made of what is known; None where that changed since.
        self._made: tuple[Float32Array, Float32Array] | None = None
        #: Where it was asked for last, and the picture there.
        self._placed: tuple[Placement, KnownPicture] | None = None
        #: (C,) variance of the columns' light over what was foreseen.
        self._excess = np.ones(inside.shape[0], np.float32)

    def placed(self, placement: Placement | None) -> KnownPicture:
        """The picture on the rows of a frame; itself where the frame shows it where the first one did.

        What is found of the columns' noise belongs to both.
        """
        if placement is None:
            return self
        if self._placed is None or self._placed[0] is not placement:
            self._placed = placement, self._moved(placement)
        return self._placed[1]

    def _moved(self, placement: Placement) -> KnownPicture:
        other = copy(self)
        picture, error = (_resampled(values, placement.picture_row, beyond=False) for values in self.picture())
        other._made = picture, error
        other._inside = placement.inside.astype(np.float32)
        other._system = other._of_one = other._placed = None
        return other

    def learn(self, look: Look, *, forget: bool = True) -> None:
        """Take a frame whose slots are known into the picture; with `forget` those before count a little less."""
        lit, observed = self._update_of(look)
        keep = np.float32(SETTINGS.memory_share if forget else 1.0)
        self._light = self._light * keep + lit
        self._observed = self._observed * keep + observed
        self._system = self._made = self._placed = None

    def without(self, looks: Sequence[Look]) -> KnownPicture:
        """What is known but for some looks, that were learned with nothing forgotten since.

        A picture learned from a frame's own light bears out whatever was decided there, wrong or right.
        """
        other = copy(self)
        for look in looks:
            lit, observed = self._update_of(look)
            other._light, other._observed = other._light - lit, np.maximum(other._observed - observed, 0)
        other._system = other._made = other._placed = None
        other._excess = self._excess.copy()
        return other

    def _update_of(self, look: Look) -> tuple[Float32Array, Float32Array]:
        """Light and light expected of a picture of 1, each weighted with the latter, on the rows of the picture."""
        placement = look.placement
        expected = self._crosstalk @ _with_neighbours(look.slots)
        doubt = self._crosstalk @ (1 - _with_neighbours(look.trust, 1.0))
        inside = self._inside if placement is None else placement.inside
        # Light over what little was expected is no picture: more of it than that may be another slot's.
        power = expected * expected
        told = power / (power + np.float32(SETTINGS.untold_error) + np.float32(SETTINGS.unsure_error) * doubt)
        weighted = expected * (told * told) * np.maximum(1 - np.float32(SETTINGS.doubt_weight) * doubt, 0) * inside
        if look.rows is not None:
            weighted *= look.rows
        lit, observed = weighted * (look.light - self._black_level), weighted * expected
        row = look.frame_row
        if row is None:
            return lit, observed
        return _resampled(lit, row, beyond=True), _resampled(observed, row, beyond=True)

    def solve(self, light: Float32Array) -> ColumnLight:
        """The columns' own light in a frame.

        Args:
            light: (C, S, R).
        """
        return self._solved(light, self._settled())

    def _settled(self) -> _System:
        """The equations of the picture as it is, made when first needed."""
        if self._system is None:
            self._system = self._factor()
        return self._system

    def solve_again(self, light: Float32Array, expected: Float32Array, rows_per_slot: float) -> ColumnLight:
        """The columns' own light once more, strips trusted as far as they show what is expected of other slots nearby.

        Were a slot's own error counted, whatever was decided of it would bear itself out.

        Args:
            light: (C, S, R).
            expected: (C, R) light that the slots decided so far give.
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
        """(C, S, R) inverse of how many rows `_around` adds up."""
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
        """Compare columns with what was decided; they are trusted accordingly, now and, in part, from now on.

        Args:
            observed: as `solve` gave it.
            expected: (C, R) what the decided slots give.
            most: squared error over the variance foreseen, median over the columns, of a frame that fits.
            share: weight of this frame against those before, 0..1.
            rows_per_slot: rows per slot.

        Returns:
            The light with its precision put right; None, and nothing is learned of it, where the frame does not fit.
        """
        error = np.square(observed.value - expected) * observed.precision
        # And one row that errs as foreseen, for columns of which nothing is seen.
        n_seen = np.count_nonzero(observed.precision, axis=1).astype(np.float32)
        ratio = (error.sum(axis=1) + 1) / (n_seen + 1)
        if np.median(ratio) > most:
            return None
        self._excess *= 1 + np.float32(share) * (ratio - 1)
        precision = observed.precision / ratio[:, None]
        precision /= _alike(observed.value - expected, precision, rows_per_slot)[:, None]
        return ColumnLight(observed.value, precision, observed.shrunk)

    def _tempered(self, precision: Float32Array) -> Float32Array:
        """Precisions by what was found of the columns' noise; 0 where next to nothing is seen."""
        tempered = precision / (self._excess[:, None] + np.float32(SETTINGS.common_error**2) * precision)
        tempered[precision <= 1e-3] = 0
        return np.asarray(tempered, np.float32)

    def picture(self) -> tuple[Float32Array, Float32Array]:
        """The picture and its relative variance, (C, S, R) each."""
        if self._made is None:
            self._made = self._make()
        return self._made

    def _make(self) -> tuple[Float32Array, Float32Array]:
        wide, smooth = np.float32(SETTINGS.wide_weight), np.float32(SETTINGS.smooth_weight)
        near = box_sums(self._observed, SETTINGS.around_rows) + wide
        around = (box_sums(self._light, SETTINGS.around_rows) + wide * self._wide()[:, None]) / near
        total = self._observed + smooth
        picture = np.maximum(self._light + smooth * around, 0) / total
        # Light that neighbours spill is no look at a picture: it may be any number of times what was made of it.
        unknown = wide / near
        error = np.float32(SETTINGS.around_error**2) + np.float32(SETTINGS.wide_error**2) * unknown * unknown
        error *= smooth * smooth
        error += np.float32(SETTINGS.seen_error) * self._observed
        error /= total * total
        error += np.float32(SETTINGS.min_error**2)
        return picture, error

    def _wide(self) -> Float32Array:
        """(C, R) mean of the picture over a column's strips and many rows."""
        light, observed = (values.sum(axis=1) for values in (self._light, self._observed))
        usual = light.sum() / max(float(observed.sum()), 1e-6)
        some = np.float32(SETTINGS.wide_weight)
        wide = (box_sums(light, SETTINGS.wide_rows) + some * usual) / (box_sums(observed, SETTINGS.wide_rows) + some)
        return np.asarray(wide, np.float32)

    def _factor(self, measured: Float32Array | None = None) -> _System:
        """Normal equations A m = b of every row, A symmetric with two bands: A = L D L', and the diagonal of A^-1."""
        picture, error = self.picture()
        # Half of what is seen is lit.
        variance = self._noise.through_picture(picture, picture * picture * error, np.full(1, 0.5, np.float32))
        if measured is not None:
            variance += measured
        gain = picture * self._inside / variance
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


def _alike(error: Float32Array, precision: Float32Array, rows_per_slot: float) -> Float32Array:
    """(C,) squared error of the sums over a slot's rows, over what is foreseen of rows that err each for itself.

    Sensor noise does; what an encoder leaves out of a picture lies on all rows of a slot alike. Columns of few slots
    that tell are taken to be as the others.
    """
    n = max(round(rows_per_slot), 1)
    shape = len(error), error.shape[1] // n, n
    weight = precision[:, : shape[1] * n].reshape(shape)
    total = np.einsum("csr,csr->cs", weight, error[:, : shape[1] * n].reshape(shape))
    foreseen = np.einsum("csr->cs", weight)
    told = foreseen > SETTINGS.told_precision
    # Means, not medians: with medians a clip of 4 surely wrong packets of 91 has 19 of 102.
    squared = np.sum(np.square(total) / np.maximum(foreseen, SETTINGS.told_precision), axis=1, where=told)
    count = told.sum(axis=1)
    of_all = squared.sum() / max(int(count.sum()), 1)
    alike = (squared + SETTINGS.like_others_slots * of_all) / (count + SETTINGS.like_others_slots)
    return np.asarray(np.maximum(alike, SETTINGS.min_correlated_error), np.float32)


def _with_neighbours(columns: Float32Array, edge: float = 0.0) -> Float32Array:
    """(C, 3, R): each column between its neighbours."""
    padded = np.pad(columns, ((1, 1), (0, 0)), constant_values=edge)
    return np.stack([padded[:-2], padded[1:-1], padded[2:]], axis=1)


def _around(values: Float32Array, rows_per_slot: float) -> Float32Array:
    """Sum over the slots around, a row's own left out; last axis."""
    near, far = (int(slots * rows_per_slot) for slots in (SETTINGS.own_slots, SETTINGS.error_slots))
    return box_sums(values, far) - box_sums(values, near)


def _resampled(values: Float32Array, rows: Float32Array, *, beyond: bool) -> Float32Array:
    """(C, S, M) values (C, S, N) at the rows (C, M), linearly between; `beyond` the ends there are none."""
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
    diagonal, first, second = middle.copy(), np.zeros_like(middle), np.zeros_like(middle)
    # Of A^-1 the diagonal, and less the band beside it; two more rows, which stay 0, for the ends.
    inverse, near = np.zeros((2, n + 2, middle.shape[1]), np.float32)
    eliminated = beside.copy()
    for i in range(n):
        if i >= 1:
            diagonal[i] -= first[i - 1] * eliminated[i - 1]
            eliminated[i] -= second[i - 1] * eliminated[i - 1]
        if i >= 2:
            diagonal[i] -= second[i - 2] * beyond[i - 2]
        inverse[i] = 1 / diagonal[i]
        first[i], second[i] = eliminated[i] * inverse[i], beyond[i] * inverse[i]
    for i in range(n - 1, -1, -1):
        far = first[i] * near[i + 1] - second[i] * inverse[i + 2]
        near[i] = first[i] * inverse[i + 1] - second[i] * near[i + 1]
        inverse[i] += first[i] * near[i] - second[i] * far
    return diagonal, first, second, np.asarray(1 / inverse[:n], np.float32)


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
