"""A periodic signal of unknown frequency and waveform in one profile: search, maximum-likelihood fit, uncertainty.

The model of a profile is `y(r) = m(r) + e(r) * w(f * r) + noise`: `m` and `e` are slow (light fall-off, vignetting, the
scene), `w` is a harmonic series of the fundamental `f` in cycles per row. All harmonics are fitted jointly, so that a
harmonic is not mistaken for the fundamental.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.numerics import Z95
from rxcli.types import BoolArray, FloatArray

#: Oversampling of the spectrum in the search.
_PAD = 8
#: Harmonics in the search, and numbers of them tried in the fit.
_SEARCH_HARMONICS = 12
_HARMONICS = (1, 2, 3, 5, 7, 10, 14, 20, 28)
#: Numbers of slow terms tried, and the most of them while the number of harmonics is chosen.
_SLOW_TERMS, _AMPLE_SLOW = (2, 3, 4, 6, 8, 11, 16), 8
#: Highest frequency searched, cycles per row: beyond it a period is not distinguishable from its alias.
MAX_FREQUENCY = 0.45
#: Share of the variance that a harmonic must explain to pay for itself in the search.
_PRICE = 0.01
#: Power over the continuum from which a line counts: chance reaches it once in e^25 bins.
_LINE_POWER = 25.0
#: Minimum number of periods, and the number from which the lines of a spectrum are separate.
MIN_PERIODS, FEW_PERIODS = 2.0, 6
#: Fewest strips whose scatter is a measure of an error.
MIN_PARTS = 4
#: Minimum score of fewer periods.
_FEW_SCORE = 0.6
#: Minimum explained share of fits of some numbers of periods: the fewer, the better a scene can be fitted.
_MIN_EXPLAINED = (2, 4, FEW_PERIODS, 2 * FEW_PERIODS), (0.98, 0.95, 0.9, 0.7)
#: Most steps of a fit.
_MAX_STEPS = 25
#: Relative gain of explained variance at which a sub-harmonic is taken for the fundamental.
_SUBHARMONIC_SHARE = 0.08
#: Fewest periods of a candidate, whose frequency is not exact yet; and share of the strongest candidate's power from
#: which one is fitted.
_CANDIDATE_PERIODS, _CANDIDATE_SHARE = 1.5, 0.6


@dataclass(frozen=True, slots=True)
class PeriodicFit:
    """A fitted profile."""

    #: Cycles per row, and its standard deviation.
    frequency: float
    frequency_sd: float
    #: (H,) cosine and sine amplitudes of harmonics 1..H at row `origin`.
    cosines: FloatArray
    sines: FloatArray
    origin: float
    #: First row fitted.
    first_row: int
    #: Share of the variance about the slow part that the stripes explain.
    explained: float
    #: Terms of the slow mean, and of the envelope.
    n_slow: int
    #: (n,) slow mean and envelope of the stripes, and what the fit leaves, profile units.
    mean: FloatArray
    envelope: FloatArray
    residual: FloatArray
    #: (n,) derivative of the frequency by the profile's values.
    influence: FloatArray

    @property
    def periods(self) -> float:
        """Periods in the rows fitted."""
        return self.frequency * self.mean.size

    @property
    def n_parameters(self) -> int:
        """Parameters of the model."""
        return 2 * self.n_slow + 2 * self.cosines.size

    def beats(self, rival: PeriodicFit) -> bool:
        """Whether this fit is better, by `_gain`."""
        pairs = ((fit.residual, fit.n_parameters) for fit in (self, rival))
        return _gain(*pairs) > 0

    def waveform(self, rows: FloatArray) -> FloatArray:
        """The periodic part at `rows`, in units of the profile where the envelope is 1."""
        cosine, sine = _waves(rows - self.origin, self.frequency, self.cosines.size)
        return np.asarray(cosine @ self.cosines + sine @ self.sines)

    @property
    def significant(self) -> bool:
        """Whether the fit is stripes and not a scene, in which a few waves can always be fitted badly."""
        return self.periods >= MIN_PERIODS and self.explained > float(np.interp(self.periods, *_MIN_EXPLAINED))


def _waves(rows: FloatArray, frequency: float, n_harmonics: int) -> tuple[FloatArray, FloatArray]:
    """Cosines and sines of the harmonics at `rows` (n,), (n, H) each."""
    turn = np.exp(2j * np.pi * frequency * rows)[:, None]
    waves = np.cumprod(np.broadcast_to(turn, (rows.size, n_harmonics)), axis=1)
    return waves.real, waves.imag


def _rows_and_slow(n: int, n_slow: int) -> tuple[FloatArray, FloatArray]:
    """Rows about the middle (n,), and slow functions of them (n, n_slow)."""
    rows = np.arange(n, dtype=np.float64) - (n - 1) / 2
    return rows, np.asarray(np.polynomial.chebyshev.chebvander(2 * rows / n, n_slow - 1), np.float64)


def _detrend(profiles: FloatArray, n_terms: int) -> FloatArray:
    """Profiles (..., n) less their least-squares polynomial of `n_terms` terms; a cubic has four."""
    basis = np.linalg.qr(_rows_and_slow(profiles.shape[-1], n_terms)[1])[0]
    return np.asarray(profiles - (profiles @ basis) @ basis.T)


def search(profiles: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """The most likely fundamental of each profile, from the lines of its spectrum.

    Of many periods, lines are measured against a continuum `a + b / f^2`: white noise and the spectrum of natural
    scenes. Few periods leave no continuum: their lines are measured against the whole power.

    Args:
        profiles: (k, n) profiles of at least 24 rows.

    Returns:
        For `FEW_PERIODS` periods or more and then for fewer, (k,) frequencies in cycles per row, and (k,) scores: the
        share of the lines' power, less one per cent a harmonic; zero where no line stands out.
    """
    n = profiles.shape[1]
    power = np.abs(np.fft.rfft(_detrend(profiles, 4) * np.hanning(n), _PAD * n)) ** 2 + 1e-300
    frequency = np.fft.rfftfreq(_PAD * n)
    low, high = (frequency > 3 / n) & (frequency < max(0.1, 6 / n)), frequency > 0.3
    scene = np.median(power[:, low] * frequency[low] ** 2, axis=1, keepdims=True) / np.log(2)
    white = np.median(power[:, high], axis=1, keepdims=True) / np.log(2)
    rounding = np.finfo(float).eps * power.max(axis=1, keepdims=True)
    whitened = power / (white + scene / np.maximum(frequency, 1 / n) ** 2 + rounding)
    few = power / power.max(axis=1, keepdims=True) * 1e9
    border, last = FEW_PERIODS * _PAD, min(int(MAX_FREQUENCY * _PAD * n), frequency.size - 1)
    many, lowest = np.where(whitened > _LINE_POWER, whitened, 0), int(MIN_PERIODS * _PAD)
    return [_best_harmonics(many, n, border, last, 0.0), _best_harmonics(few, n, lowest, border, _FEW_SCORE)]


def _best_harmonics(lines: FloatArray, n: int, low: int, high: int, min_score: float) -> tuple[FloatArray, FloatArray]:
    """Frequency (k,) between two bins whose harmonics hold most of the power of `lines` (k, F), and its score (k,).

    The lines are those of profiles of `n` rows.
    """
    # A Hann line has an equivalent width of 1.5 bins before the oversampling.
    share = lines / (lines.sum(axis=1, keepdims=True) / (1.5 * _PAD) + _LINE_POWER)
    grid = np.arange(low, min(max(high, low) + 1, lines.shape[1]))
    total, best = np.zeros((len(lines), grid.size)), np.zeros((len(lines), grid.size))
    for harmonic in range(1, _SEARCH_HARMONICS + 1):
        inside = grid * harmonic < lines.shape[1]
        total[:, inside] += share[:, grid[inside] * harmonic] - _PRICE
        best = np.maximum(best, np.where(inside, total, 0))
    score = best.max(axis=1)
    return grid[np.argmax(best, axis=1)] / (_PAD * n), np.where(score > min_score, score, 0)


def fit_fundamental(profile: FloatArray, frequency: float, first_row: int = 0) -> PeriodicFit | None:
    """Fit a profile at the fundamental nearest to `frequency`, its multiples or its parts, whichever explains it.

    Returns:
        The fit of the highest frequency that no lower one betters by much; None where nothing fits.
    """
    n = profile.size
    # With one limit for all, or the slow part of a fast candidate would follow the stripes themselves.
    max_slow = max(frequency * n, 2.0)
    candidates = (frequency * ratio for ratio in (3, 2, 1, 1 / 2, 1 / 3))
    inside = [f for f in candidates if _CANDIDATE_PERIODS / n <= f <= MAX_FREQUENCY]
    (rows, slow), flat = _rows_and_slow(n, 4), _detrend(profile, 4)
    # The power of five harmonics beside a cubic.
    bases = (np.linalg.qr(np.hstack([slow, *_waves(rows, f, 5)]))[0] for f in inside)
    shares = [float(np.sum((flat @ basis[:, 4:]) ** 2)) for basis in bases]
    best: PeriodicFit | None = None
    for candidate, share in zip(inside, shares, strict=True):
        if share < _CANDIDATE_SHARE * max(shares):
            continue
        fit = fit_periodic(profile, candidate, first_row, max_slow)
        if fit and (best is None or (fit.beats(best) and fit.explained > best.explained * (1 + _SUBHARMONIC_SHARE))):
            best = fit
    return best


def fit_periodic(
    profile: FloatArray, frequency: float, first_row: int = 0, max_slow: float = np.inf
) -> PeriodicFit | None:
    """Maximum-likelihood fit near `frequency`; the numbers of harmonics and of slow terms by information criterion.

    Args:
        profile: (n,) values.
        frequency: cycles per row, right to about a third of a cycle over the profile.
        first_row: row of the profile's first value.
        max_slow: maximum number of terms of the slow mean and envelope.
    """
    # With two terms a period the envelope could imitate the stripes.
    slow_terms = [n for n in _SLOW_TERMS if n <= max(min(frequency * profile.size, max_slow), 2)]
    # A fall-off that is not followed passes for noise of long memory, in which harmonics drown.
    ample = max(terms for terms in slow_terms if terms <= _AMPLE_SLOW)
    best: PeriodicFit | None = None
    for n_harmonics in (1, 3):
        if n_harmonics == 1 or n_harmonics * frequency < 0.5:
            start = best.frequency if best else frequency
            best = _fit_near(profile, start, n_harmonics, ample, first_row) or best
    if best is None:
        return None
    rows, slow = _rows_and_slow(profile.size, max(slow_terms))
    highest = max([n for n in _HARMONICS if n * best.frequency < 0.5 and 2 * n + 2 * ample < profile.size / 2] or [1])
    waves = np.stack(_waves(rows, best.frequency, highest), axis=2).reshape(rows.size, -1) * best.envelope[:, None]
    n_harmonics = _best_order(profile, slow[:, :ample], waves, [n for n in _HARMONICS if n <= highest], patience=2)
    shape = best = _fit_near(profile, best.frequency, n_harmonics, ample, first_row) or best
    wave = shape.waveform(rows + shape.origin)
    slow_pairs = np.stack([slow, slow * wave[:, None]], axis=2).reshape(rows.size, -1)
    orders = [n for n in slow_terms if 2 * n < profile.size / 2] or slow_terms[:1]
    n_slow = _best_order(profile, slow_pairs[:, :0], slow_pairs, orders)
    if n_slow != ample:
        best = _fit_near(profile, shape.frequency, shape.cosines.size, n_slow, first_row) or shape
    if best.periods >= FEW_PERIODS:
        return best
    # Over a few periods the envelope trades against the frequency, an error that the residual does not show.
    richer = (
        _fit_near(profile, best.frequency, shape.cosines.size, best.n_slow + extra, first_row) for extra in (1, 2)
    )
    deviation = max((abs(fit.frequency - best.frequency) for fit in richer if fit), default=0.0)
    return replace(best, frequency_sd=float(np.hypot(best.frequency_sd, deviation)))


def _best_order(profile: FloatArray, fixed: FloatArray, pairs: FloatArray, orders: list[int], patience: int = 9) -> int:
    """How many pairs of columns (n, 2 k) pay for themselves beside fixed ones, of some numbers in ascending order.

    One harmonic of a pulse may vanish; `patience` such numbers in a row mean that there are no more.
    """
    basis = np.linalg.qr(np.hstack([fixed, pairs[:, : 2 * orders[-1]]]))[0]
    product, n_fixed = basis.T @ profile, fixed.shape[1]
    best, misses = (0, np.empty(0)), 0
    for order in orders:
        used = n_fixed + 2 * order
        residual = profile - basis[:, :used] @ product[:used]
        if not best[0] or _gain((residual, used), (best[1], n_fixed + 2 * best[0])) > 0:
            best, misses = (order, residual), 0
        elif (misses := misses + 1) == patience:
            break
    return best[0]


def _gain(candidate: tuple[FloatArray, int], rival: tuple[FloatArray, int]) -> float:
    """What a fit (residual, number of parameters) gains over a rival, by the Bayesian information criterion.

    The richer fit's residual gives the number of independent values; counting all of them would let harmonics follow
    slow noise.
    """
    richer = max(candidate, rival, key=lambda fit: fit[1])
    ours, theirs = (float(residual @ residual) + 1e-300 for residual, _ in (candidate, rival))
    gain = float(np.log(theirs / ours)) * _n_independent(richer[0])
    return gain - (candidate[1] - rival[1]) * float(np.log(candidate[0].size))


def _fit_near(
    profile: FloatArray, frequency: float, n_harmonics: int, n_slow: int, first_row: int
) -> PeriodicFit | None:
    """Slow mean, envelope less its constant 1, harmonics and frequency, fitted together; None where it runs off."""
    from scipy.optimize import least_squares

    n, order = profile.size, np.arange(1, n_harmonics + 1)
    if 2 * (n_slow + n_harmonics) >= n:
        return None
    rows, slow = _rows_and_slow(n, n_slow)
    borders = np.cumsum([n_slow, n_slow - 1, n_harmonics, n_harmonics])

    def parts(state: FloatArray) -> tuple[FloatArray, ...]:
        mean, envelope, cosines, sines, _ = np.split(state, borders)
        return slow @ mean, 1 + slow[:, 1:] @ envelope, cosines, sines, *_waves(rows, state[-1], n_harmonics)

    def residual_of(state: FloatArray) -> FloatArray:
        mean, envelope, a, b, cosine, sine = parts(state)
        return np.asarray(mean + envelope * (cosine @ a + sine @ b) - profile)

    def jacobian_of(state: FloatArray) -> FloatArray:
        _, envelope, a, b, cosine, sine = parts(state)
        wave, slope = cosine @ a + sine @ b, 2 * np.pi * rows * (cosine @ (order * b) - sine @ (order * a))
        waves = np.hstack([cosine, sine, slope[:, None]]) * envelope[:, None]
        return np.hstack([slow, slow[:, 1:] * wave[:, None], waves])

    flat = np.hstack([slow, *_waves(rows, frequency, n_harmonics)])
    linear = np.linalg.lstsq(flat, profile, rcond=None)[0]
    start = np.concatenate([linear[:n_slow], np.zeros(n_slow - 1), linear[n_slow:], [frequency]])
    fitted = least_squares(residual_of, start, jacobian_of, method="lm", x_scale="jac", ftol=1e-6, max_nfev=_MAX_STEPS)
    state, left, jacobian = fitted.x, fitted.fun, fitted.jac
    if not abs(state[-1] - frequency) <= 0.6 / n:
        return None
    mean, envelope, cosines, sines, *_ = parts(state)
    trend = _detrend(profile, n_slow)
    scaled = jacobian / (np.linalg.norm(jacobian, axis=0) + 1e-300)
    influence = scaled @ np.linalg.pinv(scaled.T @ scaled, hermitian=True)[-1] / np.linalg.norm(jacobian[:, -1])
    return PeriodicFit(
        frequency=float(state[-1]),
        frequency_sd=_noise_sd(influence, left, state.size),
        cosines=cosines,
        sines=sines,
        origin=first_row + (n - 1) / 2,
        first_row=first_row,
        explained=1 - float(left @ left) / max(float(trend @ trend), 1e-300),
        n_slow=n_slow,
        mean=mean,
        envelope=envelope,
        residual=left,
        influence=influence,
    )


def _noise_sd(influence: FloatArray, residual: FloatArray, n_parameters: int) -> float:
    """Standard deviation of the frequency under coloured noise.

    The estimate is linear in the noise, so its variance is the integral of the noise's power spectrum over that of the
    influence. Where the noise is not stationary (a scene lit by the stripes is multiplied by them), the sum of
    `influence * residual` over its own neighbourhood may be larger.
    """
    n_fft = 4 * residual.size
    freedom = residual.size / max(residual.size - n_parameters, 1)
    weight = np.abs(np.fft.fft(influence, n_fft)) ** 2
    stationary = float(noise_spectrum(residual, n_fft) @ weight) / n_fft
    score, lag = influence * residual, max(int(4 * (residual.size / 100) ** (2 / 9)), 1)
    local = float(np.convolve(score, np.bartlett(2 * lag + 3)[1:-1], "same") @ score)
    return float(np.sqrt(max(stationary, local) * freedom))


def scatter_sd(influence: FloatArray, profiles: FloatArray) -> float:
    """Standard deviation of the frequency from the scatter between parts of a region.

    The influence is blind to the slow part and to the stripes' own shape, so each part's product with it is that part's
    deviation from the common frequency. Parts see different texture, which the residual's spectrum may not show.

    Args:
        influence: (n,) of the fit of the region's mean profile.
        profiles: (k, n) profiles of its strips, in order across.

    Returns:
        The standard deviation, widened for its few parts; zero for fewer than `MIN_PARTS` strips.
    """
    if len(profiles) < MIN_PARTS:
        return 0.0
    parts = np.array([part.mean(axis=0) @ influence for part in np.array_split(profiles, min(8, len(profiles)))])
    # Student's 97.5 % quantile over the normal one, nearly.
    widening = 1 + 1.5 / (parts.size - 2)
    return float(np.std(parts, ddof=1) / np.sqrt(parts.size) * widening)


def lean_bound(fit: PeriodicFit, profiles: FloatArray, width_px: float) -> float:
    """How much stripes may lean against the rows, rows per pixel across: the far end of the 95 % interval.

    Args:
        fit: of the region's mean profile.
        profiles: (k, n) profiles of its strips, in order across.
        width_px: of a strip.
    """
    if len(profiles) < 2 * MIN_PARTS:
        return np.inf
    across = np.linspace(-1, 1, len(profiles))
    rows = fit.first_row + np.arange(fit.mean.size, dtype=np.float64)
    slope = (fit.waveform(rows + 0.25) - fit.waveform(rows - 0.25)) / 0.5
    shapes = np.column_stack([fit.waveform(rows), slope]) * fit.envelope[:, None]
    slow = _rows_and_slow(rows.size, fit.n_slow)[1]
    depth, shift = np.linalg.lstsq(np.hstack([slow, shapes]), profiles.T, rcond=None)[0][-2:]
    # The shift in rows is `shift / depth`; the edges of a round lamp, and a lens, bend both sides equally.
    terms = depth[:, None] * across[:, None] ** np.arange(3)
    bent = np.linalg.lstsq(terms, shift, rcond=None)[0]
    left, freedom = shift - terms @ bent, len(profiles) - 3
    sd = float(np.sqrt(np.linalg.pinv(terms.T @ terms)[1, 1] * (left @ left) / freedom)) * (1 + 1.5 / freedom)
    return float(abs(bent[1]) + Z95 * sd) / ((len(profiles) - 1) * width_px / 2)


def _n_independent(residual: FloatArray) -> float:
    """Number of independent values in `residual` (Bartlett).

    Its autocorrelation counts up to where it first vanishes: beyond, a harmonic not yet fitted would pass for noise
    of long memory.
    """
    lags = np.array([residual[: residual.size - k] @ residual[k:] for k in range(min(residual.size // 4, 100))])
    correlation = lags / max(lags[0], 1e-300)
    positive = np.logical_and.accumulate(correlation >= 1 / np.sqrt(residual.size))
    return residual.size / max(2 * float(np.sum(correlation[positive] ** 2)) - 1, 1)


def noise_spectrum(residual: FloatArray, n_fft: int) -> FloatArray:
    """(n_fft,) power spectrum of the autoregressive process that fits `residual` (Yule-Walker)."""
    order = int(np.clip(residual.size // 20, 1, 12))
    lags = np.array([residual[: residual.size - k] @ residual[k:] for k in range(order + 1)]) / residual.size
    toeplitz = lags[np.abs(np.subtract.outer(np.arange(order), np.arange(order)))]
    coefficients = np.linalg.lstsq(toeplitz, lags[1:], rcond=1e-9)[0]
    innovation = max(lags[0] - coefficients @ lags[1:], 1e-12 * lags[0])
    response = np.fft.fft(np.concatenate([[1.0], -coefficients]), n_fft)
    return np.asarray(innovation / np.abs(response) ** 2)


def explained_share(profiles: FloatArray, template: FloatArray) -> FloatArray:
    """How much of each profile a template explains, beyond a straight line.

    Args:
        profiles: (k, n) profiles.
        template: (n,) wave.

    Returns:
        (k,) share of the variance, negative where the template fits upside down.
    """
    flat, wave = _detrend(profiles, 2), _detrend(template, 2)
    product = flat @ wave
    return np.asarray(np.sign(product) * product**2 / (float(wave @ wave) * np.sum(flat**2, axis=1) + 1e-300))


def longest_block(members: BoolArray) -> tuple[int, int]:
    """The range [b0, b1) of the blocks of `members` (strips, blocks) with the most information on a frequency.

    It grows with the number of strips that hold all of the range and with the cube of the range's length.
    """
    ends = range(members.shape[1] + 1)
    ranges = [(0, 0)] + [(b0, b1) for b0 in ends for b1 in ends if b1 > b0]
    return max(ranges, key=lambda r: int(members[:, r[0] : r[1]].all(axis=1).sum()) * (r[1] - r[0]) ** 3)


def harmonic_waves(fit: PeriodicFit, n_harmonics: int) -> FloatArray:
    """(n, 2 K) cosines, then sines of the harmonics of a fit at its rows, under its envelope."""
    rows = fit.first_row - fit.origin + np.arange(fit.mean.size, dtype=np.float64)
    return np.hstack(_waves(rows, fit.frequency, n_harmonics)) * fit.envelope[:, None]
