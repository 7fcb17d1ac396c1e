"""The stripes of a picture before its camera is known: their width, and the lines of slots of any exposure.

Whatever the exposure, light turns between slots only: where a slot comes in, and the other way where it leaves. So its
turns have a spectral line at the rate of the slots, and in the right row-time map they are in phase.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rxcli.numerics import TINY, local_mean, peak_offset, waves_of
from rxcli.protocol import SLOTS_PER_SYMBOL
from rxcli.receiver.camera.curvature import LENS_PRECISION, UNIT_BEND, curvature_terms, tried_bends
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import ColumnStrips, joined, levelled
from rxcli.receiver.light import LONG_EXPOSURE_SLOTS, MAX_EXPOSURE_SLOTS
from rxcli.types import Float32Array, FloatArray

#: Bins of a spectrum to a line's width.
FINE = 4


class SlotLine(NamedTuple):
    """Rows of a slot by the line of the slots in the light of all rows."""

    rows: float
    #: (4,) k1 k2 p1 p2, see `CameraHypothesis`.
    curvature: FloatArray
    #: How far the line stands out: about twice a log-likelihood ratio.
    strength: float


@dataclass(frozen=True, eq=False)
class Stripes:
    """What the strips of a picture show before its camera is known; each is found once.

    Attributes:
        strips: of the picture as it is stored.
    """

    strips: ColumnStrips
    _turns: dict[int, tuple[Float32Array, ...]] = field(default_factory=dict)

    @cached_property
    def half_width(self) -> float:
        """Rows of the lag at which strips are half as like the one beside as a row later; 0 where there are no stripes.

        Neighbours have no noise in common. Texture that is wider than the stripes counts as well, so that levels follow
        what was found.
        """
        strips, width = self.strips, SETTINGS.rows_per_width
        for _ in range(SETTINGS.width_rounds):
            level = levelled(strips.light, strips.inside, round(SETTINGS.level_widths * width))
            width = half_width(autocorrelation(level[:-1:2], level[1::2]))
            if width <= 0:
                break
        return width

    @cached_property
    def coarse(self) -> tuple[ColumnStrips, Float32Array]:
        """The strips on rows that are as few as their stripes allow, and their levelled light."""
        coarse = joined(self.strips, max(1, int(self.half_width / SETTINGS.rows_per_width)))
        window = round(SETTINGS.level_widths * self.half_width / coarse.pitch)
        return coarse, levelled(coarse.light, coarse.inside, window)

    @cached_property
    def long_lines(self) -> list[SlotLine]:
        """Lines of the slots by the turns of the light, in phase over the picture, strongest first."""
        lines = self._spectral_lines()
        # Lines of noise have a strength of 2 on average.
        least = max(2 + SETTINGS.min_slot_line, SETTINGS.min_line_share * max((line[1] for line in lines), default=0.0))
        lines = [(rows, strength) for rows, strength in lines if strength >= least]
        # Of light that is exposed for half a slot more than whole ones the line is at twice the rate.
        tried = [self.in_phase(order * rows, SETTINGS.off_line) for order in (1, 2) for rows, _ in lines]
        few_rows = [SlotLine(rows, np.zeros(4), power) for rows, power in lines if rows <= SETTINGS.min_phase_rows]
        found = sorted((line for line in (*tried, *few_rows) if line), key=lambda line: -line.strength)
        return [
            line
            for number, line in enumerate(found)
            if line.strength >= SETTINGS.min_line_share * found[0].strength
            and not _is_among(line.rows, (stronger.rows for stronger in found[:number]))
        ]

    def _spectral_lines(self) -> list[tuple[float, float]]:
        """Rows of a slot and how far its line in the spectrum of the turns stands out, strongest first."""
        import cv2

        found: list[tuple[float, float]] = []
        for lag in SETTINGS.turn_lags:
            parts = self._turns_over(lag)
            if not parts:
                continue
            product, turns = parts
            size = cv2.getOptimalDFTSize(FINE * turns.shape[1])
            # Together, and each column by itself, since the stripes of corrected pictures are bent.
            own = product.sum(axis=0, keepdims=True), product, turns
            spectrum = np.asarray(sum(_line_spectrum(part, lag, size) for part in own))
            frequency = np.arange(spectrum.size) / size
            # The mosaic shows as periods of two and of four rows.
            mosaic = np.minimum(np.abs(frequency - 0.25), np.abs(frequency - 0.5)) < SETTINGS.mosaic_line
            fewest, most = (lag * lags for lags in SETTINGS.slot_lags)
            inside = (frequency > 1 / most) & (frequency < 1 / fewest) & ~mosaic
            places = peaks(np.where(inside, spectrum, 0.0), SETTINGS.n_peaks, 2 * FINE)
            found += [(float(spectrum[round(place)]), size / place) for place in places.tolist() if place > 0]
        distinct: list[tuple[float, float]] = []
        for strength, rows in sorted(found, reverse=True):
            if len(distinct) < SETTINGS.n_peaks and not _is_among(rows, (line[0] for line in distinct)):
                distinct.append((rows, strength))
        return distinct

    def in_phase(self, rows: float, reach: float) -> SlotLine | None:
        """Rows a slot, and bend, by which the turns of the light in the whole picture are in phase.

        Both are sought on a grid and then by Newton's method, with the lens as it is before the picture is seen. None
        if they stand out no more than by chance.

        Args:
            rows: a slot, about.
            reach: how far they may be off, relatively.
        """
        lag = min(SETTINGS.turn_lags, key=lambda lag: abs(np.log(rows / lag / np.prod(SETTINGS.slot_lags) ** 0.5)))
        parts = self._turns_over(lag) if rows > SETTINGS.min_phase_rows else ()
        if not parts:
            return None
        phases, bends = _Phases.of(self.strips, parts, lag, rows), tried_bends(self.strips) * UNIT_BEND
        off = np.arange(-reach, reach, SETTINGS.step_off)
        score = phases.score(rows, off, bends)
        # Mosaic and JPEG show as periods of 4, 8 / 3 and 2 rows.
        eighths = 8 * (1 + off) / rows
        score[:, (np.abs(eighths - np.rint(eighths)) < 16 / self.strips.rows.size) & (eighths > 1.5)] = 0
        by_bend = score.max(axis=1)
        best, straight = int(by_bend.argmax()), len(bends) // 2
        if by_bend[best] < 2 * SETTINGS.min_slot_line:
            return None
        may_bend = bool(by_bend[best] >= by_bend[straight] + SETTINGS.min_slot_line)
        best = best if may_bend else straight
        rate, curvature = phases.refined((1 + off[score[best].argmax()]) / rows, bends[best], may_bend=may_bend)
        return SlotLine(1 / rate, curvature, float(by_bend[best]))

    @cached_property
    def _log_light(self) -> Float32Array:
        black = np.percentile(self.strips.light, SETTINGS.dark_percent)
        return np.asarray(np.log(np.maximum(self.strips.light - np.float32(black), np.float32(SETTINGS.min_light))))

    def _turns_over(self, lag: int) -> tuple[Float32Array, ...]:
        if lag not in self._turns:
            self._turns[lag] = _turns(self._log_light, self.strips.n_columns, lag)
        return self._turns[lag]


def half_width(correlation: FloatArray) -> float:
    """Lag at which an autocorrelation is half of that at lag 1; 0 where there is none."""
    top = correlation[1] if correlation.size > 2 else 0.0
    below = np.flatnonzero(correlation[1:] < top / 2)
    if top <= 0 or below.size == 0:
        return 0.0
    lag = int(below[0]) + 1
    return float(lag - (top / 2 - correlation[lag]) / max(correlation[lag - 1] - correlation[lag], TINY))


def autocorrelation(columns: Float32Array, later: Float32Array | None = None) -> FloatArray:
    """(R,) sum over columns (C, R) of the product with the same columns later, or with others."""
    import cv2

    n = columns.shape[1]
    size = cv2.getOptimalDFTSize(2 * n)
    spectrum = np.fft.rfft(columns, size, axis=1)
    beside = spectrum if later is None else np.fft.rfft(later, size, axis=1)
    return np.asarray(np.fft.irfft((spectrum * beside.conj()).real.sum(axis=0), size)[:n])


def own_light(columns: Float32Array) -> Float32Array:
    """What columns (C, R) do not have in common, as headers, unless all of them send the same."""
    own = columns - columns.mean(axis=0)
    return own if np.square(own).mean() > np.square(columns).mean() / 2 else columns


def peaks(values: FloatArray, n: int, distance: int) -> FloatArray:
    """Places of the `n` highest peaks, by parabolas; none nearer to a higher one than `distance`."""
    inner = np.flatnonzero((values[1:-1] > values[:-2]) & (values[1:-1] >= values[2:])) + 1
    chosen: list[int] = []
    for at in inner[np.argsort(-values[inner])].tolist():
        if len(chosen) < n and all(abs(at - higher) >= distance for higher in chosen):
            chosen.append(at)
    at = np.array(chosen, np.int64)
    return np.asarray(at + peak_offset(values[at - 1], values[at], values[at + 1]))


def _is_among(rows: float, known: Iterable[float]) -> bool:
    return any(abs(np.log(rows / near)) < SETTINGS.same_clock for near in known)


def _turns(log_light: Float32Array, n_columns: int, lag: int) -> tuple[Float32Array, ...]:
    """What has a line at the rate of the slots: products (C, n) of turns of the light over `lag` rows, and their size.

    The product of the turns where a slot comes in and where it leaves has a line even of exposures that are not whole
    slots. Nothing where too few rows are in view.
    """
    fewest, most = (lag * lags for lags in SETTINGS.slot_lags)
    nearest, furthest = int(LONG_EXPOSURE_SLOTS * fewest), int(MAX_EXPOSURE_SLOTS * most)
    if log_light.shape[1] < 2 * furthest:
        return ()
    smooth = local_mean(log_light, max(lag // 2, 1))
    turn = smooth[:, 2 * lag :] - 2 * smooth[:, lag:-lag] + smooth[:, : -2 * lag]
    turn /= np.median(np.abs(turn), axis=1, keepdims=True) + np.float32(TINY)
    turn = np.clip(turn, -SETTINGS.max_turn, SETTINGS.max_turn)
    n = turn.shape[1]
    columns, turns = (part.reshape(n_columns, -1, n).mean(axis=1) for part in (turn, np.abs(turn)))
    columns = own_light(columns)
    likeness = autocorrelation(columns)[nearest:furthest] / np.arange(n, 0, -1)[nearest:furthest]
    exposure = nearest + int(likeness.argmin())
    product = np.zeros_like(columns)
    product[:, exposure:] = -columns[:, :-exposure] * columns[:, exposure:]
    return product, turns


def _line_spectrum(values: Float32Array, lag: int, size: int) -> FloatArray:
    """Power of values (C, n) over what is usual at such frequencies; places are cycles in `size` values."""
    values = values - local_mean(values, SLOTS_PER_SYMBOL**2 * lag)
    n = values.shape[1]
    power = np.square(np.abs(np.fft.rfft(values * np.hanning(n).astype(np.float32), size, axis=1)))
    spectrum = (power / (power.mean(axis=1, keepdims=True) + TINY)).sum(axis=0)
    return np.asarray(spectrum / (local_mean(spectrum[None].astype(np.float32), SETTINGS.line_bins)[0] + TINY))


@dataclass(frozen=True, slots=True)
class _Phases:
    """Phases of turns at the rate of the slots, in blocks of a few slots of each column."""

    #: (N,) rows of the blocks' middles.
    middle: FloatArray
    #: (4, C, N) rows by which a unit of k1 k2 p1 p2 moves each block.
    terms: FloatArray
    #: Multiples of the rate, each with the phasors (C, N) of the blocks at it, of norm 1 together.
    blocks: list[tuple[int, NDArray[np.complex128]]]

    @classmethod
    def of(cls, strips: ColumnStrips, parts: tuple[Float32Array, ...], lag: int, rows: float) -> _Phases:
        """From what has a line at the rate of slots of `rows` rows, `_turns` over a lag."""
        size = max(round(SETTINGS.block_slots * rows), 1)
        n = parts[0].shape[1] // size
        middle = lag + (np.arange(n) + 0.5) * size - 0.5
        x = strips.x.reshape(strips.n_columns, -1, strips.rows.size).mean(axis=1)
        at = np.rint(middle).astype(int)
        terms = curvature_terms(x[:, at], strips.rows[at], strips.width, strips.height) / strips.pitch
        place_in_block = (np.arange(size) - (size - 1) / 2) / rows
        blocks = []
        for part in parts:
            changes = (part - local_mean(part, SLOTS_PER_SYMBOL**2 * lag))[:, : n * size].reshape(len(part), n, size)
            # Of light exposed for half a slot more than whole ones the line is at twice the rate.
            for order in (1, 2):
                block = changes @ np.exp(-2j * np.pi * order * place_in_block)
                blocks.append((order, block / np.linalg.norm(block)))
        return cls(middle, terms, blocks)

    def score(self, rows: float, off: FloatArray, bends: FloatArray) -> FloatArray:
        """(B, K) power of the blocks in phase under each bend (B, 4), at slots off `rows` by relative rates (K,).

        Less what the bend costs before the picture is seen.
        """
        places = self.middle + np.tensordot(bends, self.terms, 1), np.outer(self.middle, off)
        waves = {order: [waves_of(place * -order / rows) for place in places] for order in (1, 2)}
        blocks = ((*waves[order], block.astype(np.complex64)) for order, block in self.blocks)
        sums = ((bent * block).sum(axis=1) @ nearby for bent, nearby, block in blocks)
        power = sum(np.square(each.view(np.float32)) for each in sums)
        cost = np.einsum("bi,ij,bj->b", bends, LENS_PRECISION, bends)[:, None] / 2
        return np.asarray(power[:, ::2] + power[:, 1::2] - cost)

    def refined(self, rate: float, curvature: FloatArray, *, may_bend: bool) -> tuple[float, FloatArray]:
        """Rate, slots a row, and bend (4,) by Newton's method; the bend is kept unless it `may_bend`."""
        values = np.append(rate, curvature)
        prior, free = np.zeros((5, 5)), slice(0, 5 if may_bend else 1)
        prior[1:, 1:] = LENS_PRECISION
        for _ in range(SETTINGS.line_steps):
            place = self.middle + np.tensordot(values[1:], self.terms, 1)
            slopes = 2 * np.pi * np.concatenate([place[None], self.terms * values[0]])[free].reshape(-1, place.size)
            normal, pull = prior[free, free].copy(), -(prior @ values)[free]
            for order, block in self.blocks:
                turned = (block * np.exp(-2j * np.pi * order * place * values[0])).ravel()
                turned *= 2 * order * turned.sum().conj()
                around = slopes - (slopes @ turned.real / turned.real.sum())[:, None]
                normal += order * (around * np.maximum(turned.real, 0)) @ around.T
                pull += around @ turned.imag
            values[free] += np.linalg.solve(normal, pull)
        return float(values[0]), values[1:]
