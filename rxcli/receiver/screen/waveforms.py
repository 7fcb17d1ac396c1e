"""A grid by what its columns send: each strip's light is a mix of the waveforms of the columns beside it.

The coherence of pairs takes columns for independent of one another, which some ten slots in a window of rows are not.
Here the waveforms themselves are estimated from one half of the strips, and predict the other half, and the other way
round. How a mix changes with the place is known, so that all strips together correct the grid; and how much of the
strips' light the right grid explains, and how much less with its borders half a column further, tells it from others.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from rxcli.receiver.screen.coherence import Coherence
from rxcli.receiver.screen.grid import Grid, columns_at, grid_prior, grid_slopes, strip_places
from rxcli.types import Float32Array, FloatArray, Lens

#: Waveforms follow the grid that they are estimated with and have noise in them, so that steps come out too short.
_ROUNDS, _LONGER = 10, 2.5
#: Movement of the strips, columns on average, below which nothing more is to be expected.
_SETTLED = 0.003
#: Weight against waveforms of columns that hardly show, strips.
_RIDGE = 0.5
#: Strips whose mixes are further off than so many standard deviations count less.
_ROBUST = 2.0
#: Largest step of a grid's numbers.
LARGEST_STEP = np.array([0.1, 0.3, 0.3, 0.04, 0.04, 0.02])
#: Columns on either side of the middle beyond which strips are not told apart: a plane seen nearly edge-on counts any.
_REACH = 100.0
#: Places of the borders at which light is explained, columns.
_PHASES = 4
#: Columns from which on a picture is worked on in blocks, columns of a block, and how far beyond it strips are asked
#: for waveforms, columns: further ones tell nothing of them.
_MANY_COLUMNS, _BLOCK_COLUMNS, _BESIDE_COLUMNS = 40, 12, 3
_ALL = slice(None)
_TINY = np.float32(1e-6)
#: Logarithm of the least share of a column: smaller numbers, and their products, would take many times the time.
LEAST_SHARE = np.float32(-30)


@dataclass(frozen=True, slots=True)
class StripLight:
    """The light of a picture's strips, W windows by S strips, laid out for mixing; see `Coherence`."""

    #: (W, S / 2, rows) changes of the even and of the odd strips, and (W, S / 2, 1) roots of what is light in them.
    halves: tuple[Float32Array, Float32Array]
    weights: tuple[Float32Array, Float32Array]
    #: (W, S) offsets of the strips from the picture's middle, a known lens taken off, see `grid`.
    x: FloatArray
    y: FloatArray
    #: (W, S) mean light of the strips, values of a pixel.
    level: Float32Array
    #: Light spread of the screen, column pitches.
    sigma: float
    #: Independent rows of one window, and half of its height as a share of the picture's width.
    n_rows: float
    half_height: float

    @classmethod
    def of(cls, coherence: Coherence, sigma: float, lens: Lens | None) -> StripLight:
        """The light of the strips of a picture that was taken through a known lens, or through none."""
        changes, weight = coherence.changes.transpose(0, 2, 1), np.sqrt(coherence.lit)[..., None]
        even, odd = (np.ascontiguousarray(changes[:, half::2]) for half in (0, 1))
        x, y = strip_places(coherence, lens)
        half_height = float(np.ptp(coherence.rows[0])) / 2 / coherence.width
        return cls(
            (even, odd), (weight[:, ::2], weight[:, 1::2]), x, y, coherence.level, sigma, coherence.n_rows, half_height
        )

    def thinned(self, every: int) -> StripLight:
        """One of so many windows."""
        (even, odd), (more, less) = self.halves, self.weights
        return replace(
            self,
            halves=(even[::every], odd[::every]),
            weights=(more[::every], less[::every]),
            x=self.x[::every],
            y=self.y[::every],
            level=self.level[::every],
        )

    def between(self, first: int, last: int) -> StripLight:
        """Strips from an even one to before another."""
        (even, odd), (more, less), half = self.halves, self.weights, slice(first // 2, (last + 1) // 2)
        odds = slice(first // 2, last // 2)
        return replace(
            self,
            halves=(even[:, half], odd[:, odds]),
            weights=(more[:, half], less[:, odds]),
            x=self.x[:, first:last],
            y=self.y[:, first:last],
            level=self.level[:, first:last],
        )


def _mixes(u: FloatArray, sigma: float) -> tuple[Float32Array, Float32Array]:
    """(W, S, K) shares of the columns in every strip's light, and how far off its middle each column lies."""
    middle = float(np.median(u))
    u = np.clip(u, middle - _REACH, middle + _REACH)
    centres = np.arange(int(np.floor(u.min())), int(np.ceil(u.max())) + 1) + 0.5
    apart = u.astype(np.float32)[..., None] - centres.astype(np.float32)
    share = np.square(apart)
    share *= np.float32(-0.5 / sigma**2)
    np.exp(np.maximum(share, LEAST_SHARE, out=share), out=share)
    share /= np.sqrt(_dot(share, share))[..., None]
    return share, apart


def _slopes(share: Float32Array, apart: Float32Array, sigma: float) -> Float32Array:
    """(W, S, K) slopes of the shares with the strips' places, columns."""
    slope = share * apart
    slope *= np.float32(-1 / sigma**2)
    slope -= share * _dot(slope, share)[..., None]
    return slope


def _dot(one: Float32Array, other: Float32Array) -> Float32Array:
    """(W, S) sums of products over the last axis."""
    return np.asarray(np.einsum("wsk,wsk->ws", one, other), np.float32)


def _waveforms(strips: Float32Array, share: Float32Array, weight: Float32Array) -> Float32Array:
    """(W, K, rows) waveforms of the columns from some of the strips."""
    weighted = share * weight
    turned = weighted.transpose(0, 2, 1)
    normal = np.matmul(turned, weighted) + np.float32(_RIDGE) * np.eye(share.shape[2], dtype=np.float32)
    return np.asarray(np.matmul(np.linalg.inv(normal), np.matmul(turned, strips)), np.float32)


@dataclass(frozen=True, slots=True)
class _Predicted:
    """What the waveforms (W, K, rows) of one half of the strips say of the other half, by products of columns.

    A strip that is some share of every column is the same share of its products; and there are fewer columns than rows.
    """

    #: (W, K, K) of waveforms with one another, (W, S / 2, K) of strips with waveforms, (W, S / 2) of strips alone.
    waves: Float32Array
    strips: Float32Array
    power: Float32Array

    @classmethod
    def of(cls, light: StripLight, share: Float32Array, known: int) -> _Predicted:
        """What the even strips (0) say of the odd ones, or these (1) of them."""
        waves = _waveforms(light.halves[known], share[:, known::2], light.weights[known])
        turned, asked = waves.transpose(0, 2, 1), light.halves[1 - known]
        return cls(np.matmul(waves, turned), np.matmul(asked, turned), _dot(asked, asked))

    def of_strips(self, strips: slice) -> _Predicted:
        """What is said of some of the strips."""
        return _Predicted(self.waves, self.strips[:, strips], self.power[:, strips])


@dataclass(frozen=True, slots=True)
class _Block:
    """Neighbouring strips of a picture and those around them, which tell their columns' waveforms."""

    strips: StripLight
    #: (W, S) columns at the strips, counted from any whole one in each window.
    u: FloatArray
    #: First strip, an even one, and the one after the last, of those that the block is for; and their number before it.
    first: int
    last: int
    offset: int

    @property
    def halves(self) -> tuple[slice, slice]:
        """The even and the odd strips that the block is for."""
        even, odd = (slice((self.first + 1 - half) // 2, (self.last + 1 - half) // 2) for half in (0, 1))
        return even, odd

    @property
    def asked(self) -> slice:
        """Its strips' places in the picture."""
        return slice(self.offset, self.offset + self.last - self.first)


def _blocks(strips: StripLight, u: FloatArray) -> Iterator[_Block]:
    """The strips of a picture with columns (W, S), in blocks where there are many columns.

    A column's waveform is told by the strips next to it, so that a block's cost is that of its own columns.
    """
    n = u.shape[1]
    n_columns = float(np.ptp(u.mean(axis=0)))
    if not _MANY_COLUMNS < n_columns < n:
        yield _Block(strips, u, 0, n, 0)
        return
    size, beside = (2 * int(np.ceil(columns * n / n_columns / 2)) for columns in (_BLOCK_COLUMNS, _BESIDE_COLUMNS))
    for start in range(0, n, size):
        end, first, last = min(start + size, n), max(start - beside, 0), min(start + size + beside, n)
        own = u[:, first:last]
        counted = own - np.floor(own.min(axis=1, keepdims=True))
        yield _Block(strips.between(first, last), counted, start - first, end - first, start)


def explained_light(strips: StripLight, share: Float32Array, of: tuple[slice, slice] = (_ALL, _ALL)) -> float:
    """How much of the strips' light the other strips' waveforms explain, nats.

    Args:
        strips: of the picture.
        share: (W, S, K) shares of the columns in every strip's light.
        of: those of the even and of the odd strips that are asked for.
    """
    total = 0.0
    for known, asked in ((0, 1), (1, 0)):
        predicted, own = _Predicted.of(strips, share, known).of_strips(of[asked]), share[:, asked::2][:, of[asked]]
        power = _dot(np.matmul(own, predicted.waves), own) * predicted.power + _TINY
        alike = np.maximum(_dot(own, predicted.strips), 0) ** 2 / power
        total -= 0.5 * strips.n_rows * float(np.log1p(-np.minimum(alike, np.float32(0.999))).sum())
    return total


def predicted_light(strips: StripLight, u: FloatArray) -> Float32Array:
    """(W, S, rows) products of every strip's changes with what the other strips' waveforms predict."""
    out = np.empty((*u.shape, strips.halves[0].shape[2]), np.float32)
    for block in _blocks(strips, u):
        own, there = block.strips, out[:, block.asked]
        share, _ = _mixes(block.u, strips.sigma)
        for known, asked in ((0, 1), (1, 0)):
            waves, of = _waveforms(own.halves[known], share[:, known::2], own.weights[known]), block.halves[asked]
            np.multiply(np.matmul(share[:, asked::2][:, of], waves), own.halves[asked][:, of], out=there[:, asked::2])
    return out


def with_light(strips: StripLight, grid: Grid) -> Grid:
    """A grid, its borders moved to where they explain most of the light, with how much that is; see `Grid`."""
    u = columns_at(grid.numbers, strips.x, strips.y)
    places = np.arange(_PHASES) / _PHASES
    light = np.zeros(_PHASES)
    for block in _blocks(strips, u):
        for number, place in enumerate(places.tolist()):
            share, _ = _mixes(block.u + place, strips.sigma)
            light[number] += explained_light(block.strips, share, block.halves)
    wave = complex((light * np.exp(-2j * np.pi * places)).sum()) * 2 / _PHASES
    moved = grid.shifted(float(np.angle(wave)) / (2 * np.pi))
    return replace(moved, explained=float(light.mean()) + abs(wave), contrast=2 * abs(wave))


def refine_by_waveforms(strips: StripLight, grid: Grid, rounds: int = _ROUNDS) -> Grid:
    """The grid that explains the strips' light best as mixes of their columns' waveforms, and how much; see `Grid`.

    Args:
        strips: of the picture.
        grid: right to some tenths of a column.
        rounds: steps that it may take.
    """
    return with_light(strips, moved_by_waveforms(strips, grid, rounds))


def moved_by_waveforms(strips: StripLight, grid: Grid, rounds: int = _ROUNDS, settled: float = _SETTLED) -> Grid:
    """The grid moved until its columns' waveforms say no more of where the strips lie; how much light it explains then
    is not asked.

    Args:
        strips: of the picture.
        grid: right to some tenths of a column.
        rounds: steps that it may take.
        settled: movement of the strips, columns on average, below which nothing more is to be expected.
    """
    numbers, prior = grid.numbers, grid_prior(grid.bent)
    for _ in range(rounds):
        off, weight = (values.ravel() for values in _offsets(strips, columns_at(numbers, strips.x, strips.y)))
        if not weight.any():
            break  # A black picture: nothing says where the borders are.
        flat = grid_slopes(numbers, strips.x, strips.y).reshape(numbers.size, -1)
        normal = (flat * weight) @ flat.T
        gradient = flat @ (weight * off) - prior * numbers
        damped = normal + np.diag(prior + 1e-3 * np.diag(normal))
        step = np.clip(_LONGER * np.linalg.solve(damped, gradient), -LARGEST_STEP, LARGEST_STEP)
        numbers = numbers + step
        if step @ normal @ step < settled**2 * weight.sum():
            break
    return replace(grid, numbers=numbers)


def _offsets(strips: StripLight, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """As `strip_offsets`, with columns (W, S) at the strips."""
    off, weight = np.empty(u.shape), np.empty(u.shape)
    for block in _blocks(strips, u):
        own = strip_offsets(block.strips, *_mixes(block.u, strips.sigma))
        off[:, block.asked], weight[:, block.asked] = (values[:, block.first : block.last] for values in own)
    return off, weight


def strip_offsets(strips: StripLight, share: Float32Array, apart: Float32Array) -> tuple[FloatArray, FloatArray]:
    """(W, S) how far each strip lies from where a grid has it, columns, and what that counts.

    Args:
        strips: of the picture.
        share: (W, S, K) shares of the columns in every strip's light.
        apart: (W, S, K) how far each strip lies from the columns' middles.
    """
    off, precision = np.zeros(strips.x.shape), np.zeros(strips.x.shape)
    turned, n = _slopes(share, apart, strips.sigma), strips.halves[0].shape[2]
    for known, asked in ((0, 1), (1, 0)):
        predicted = _Predicted.of(strips, share, known)
        off[:, asked::2], precision[:, asked::2] = _asked(predicted, share[:, asked::2], turned[:, asked::2], n)
    precision *= strips.n_rows / n
    limit = _ROBUST / np.sqrt(np.maximum(precision, 1e-9))
    return off, precision / np.maximum(np.abs(off) / limit, 1.0)


def _asked(
    predicted: _Predicted, share: Float32Array, slope: Float32Array, n_rows: int
) -> tuple[Float32Array, Float32Array]:
    """How far strips of some shares lie off, and how precise that is: by light and its slope, of whatever strength."""
    model = np.matmul(share, predicted.waves)
    power = _dot(model, share) + _TINY
    gain = _dot(predicted.strips, share) / power
    shared = _dot(model, slope) / power
    told = np.maximum(_dot(np.matmul(slope, predicted.waves), slope) - shared * shared * power, _TINY)
    left = _dot(predicted.strips, slope) - shared * gain * power
    noise = np.maximum(predicted.power - gain * gain * power, 0) / np.float32(n_rows) + _TINY
    lit = np.maximum(gain, np.float32(0))
    return left / (np.maximum(lit, np.float32(0.05)) * told), lit * lit * told / noise
