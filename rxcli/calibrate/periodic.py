"""A periodic signal of unknown frequency and waveform in one profile: search, maximum-likelihood fit, uncertainty.

The model of a profile is `y(r) = m(r) + e(r) * w(f * r) + noise`: `m` and `e` are slow (light fall-off, vignetting, the
scene), `w` is a harmonic series of the fundamental `f` in cycles per row. All harmonics are fitted jointly, so a
harmonic is no rival of its fundamental, and a sub-harmonic has to explain something that the fundamental does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from rxcli.types import BoolArray, FloatArray

#: Oversampling of the spectrum in the search.
_PAD = 8
#: Harmonics looked at in the search, and numbers of them tried in the fit.
_SEARCH_HARMONICS = 12
_HARMONICS = (1, 2, 3, 5, 7, 10, 14, 20, 28)
#: Slow terms while the number of harmonics is chosen.
_AMPLE_SLOW = 8
#: Highest frequency searched, cycles per row: beyond it a period has too few rows to be told from its alias.
MAX_FREQUENCY = 0.45
#: Share of the variance that a harmonic must explain to pay for itself in the search.
_PRICE = 0.01
#: Power over the continuum from which a line counts: chance reaches it once in e^25 bins.
_LINE_POWER = 25.0
#: Fewest periods that a period is measured from, and where the lines of a spectrum stop running into each other.
MIN_PERIODS = 2.0
FEW_PERIODS = 6
#: Score that so few must reach.
_FEW_SCORE = 0.6
#: What a sub-harmonic must add to the share explained, relative to it, to be taken for the fundamental.
_SUBHARMONIC_SHARE = 0.08


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
    #: First row and number of rows fitted.
    first_row: int
    n_rows: int
    #: Share of the variance about the slow part that the stripes explain.
    explained: float
    #: Sum of squared residuals, number of parameters, and how many independent values the residual is worth.
    rss: float
    n_parameters: int
    #: Terms of the slow mean, and of the envelope.
    n_slow: int
    n_effective: float
    #: (n_rows,) slow mean and envelope of the stripes, profile units.
    mean: FloatArray
    envelope: FloatArray
    #: (n_rows,) derivative of the frequency by the profile's values.
    influence: FloatArray

    @property
    def periods(self) -> float:
        """Periods in the rows fitted."""
        return self.frequency * self.n_rows

    def beats(self, other: PeriodicFit) -> bool:
        """Whether this fit is better by the Bayesian information criterion, as coloured noise allows.

        The richer fit's residual says how many values are independent; counting all of them would let harmonics
        follow slow noise.
        """
        richer = self if self.n_parameters >= other.n_parameters else other
        gain = float(np.log(max(other.rss, 1e-300) / max(self.rss, 1e-300))) * richer.n_effective
        return gain > (self.n_parameters - other.n_parameters) * float(np.log(self.n_rows))

    def waveform(self, rows: FloatArray) -> FloatArray:
        """The periodic part at `rows`, in units of the profile where the envelope is 1."""
        return harmonic_series(self.frequency * (rows - self.origin), self.cosines, self.sines)


def harmonic_series(phase: FloatArray, cosines: FloatArray, sines: FloatArray) -> FloatArray:
    """Sum of harmonics at `phase` (cycles)."""
    angle = 2 * np.pi * np.multiply.outer(phase, np.arange(1, cosines.size + 1))
    return np.asarray(np.cos(angle) @ cosines + np.sin(angle) @ sines)


def whitened_power(profiles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Power spectra over their continuum.

    Args:
        profiles: (k, n) profiles.

    Returns:
        (F,) frequencies in cycles per row, and (k, F) power relative to a continuum `a + b / f^2` (white noise and the
        spectrum of natural scenes), about 1 where there is nothing periodic.
    """
    n = profiles.shape[1]
    taper = np.hanning(n)
    power = np.abs(np.fft.rfft(_detrend(profiles) * taper, _PAD * n)) ** 2
    frequency = np.fft.rfftfreq(_PAD * n)
    low, high = (frequency > 3 / n) & (frequency < max(0.1, 6 / n)), frequency > 0.3
    scene = np.median(power[:, low] * frequency[low] ** 2, axis=1, keepdims=True) / np.log(2)
    white = np.median(power[:, high], axis=1, keepdims=True) / np.log(2)
    floor = np.finfo(float).eps * power.max(axis=1, keepdims=True) + 1e-300
    continuum = white + scene / np.maximum(frequency, 1 / n) ** 2 + floor
    return np.asarray(frequency, np.float64), power / continuum


def _detrend(profiles: FloatArray) -> FloatArray:
    """Profiles less their least-squares cubic."""
    basis, _ = np.linalg.qr(np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, profiles.shape[1]), 3))
    return np.asarray(profiles - (profiles @ basis) @ basis.T)


def search_many(profiles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The most likely fundamental of each profile, of `FEW_PERIODS` periods or more, from the lines of its spectrum.

    Args:
        profiles: (k, n) profiles of at least 24 rows.

    Returns:
        (k,) frequencies in cycles per row, and (k,) scores: the share of the lines' power, less one per cent a
        harmonic; zero where no line stands above the continuum.
    """
    frequency, power = whitened_power(profiles)
    lines = np.where(power > _LINE_POWER, power, 0)
    # A Hann line has an equivalent width of 1.5 bins before the oversampling.
    share = lines / (lines.sum(axis=1, keepdims=True) / (1.5 * _PAD) + _LINE_POWER)
    first, last = FEW_PERIODS * _PAD, int(MAX_FREQUENCY * _PAD * profiles.shape[1])
    grid = np.arange(first, max(last, first) + 1)
    grid = grid[grid < frequency.size]
    total, best = np.zeros((len(profiles), grid.size)), np.zeros((len(profiles), grid.size))
    for harmonic in range(1, _SEARCH_HARMONICS + 1):
        inside = grid * harmonic < frequency.size
        total[:, inside] += share[:, grid[inside] * harmonic] - _PRICE
        best[:, inside] = np.maximum(best[:, inside], total[:, inside])
    at = np.argmax(best, axis=1)
    return frequency[grid[at]], best[np.arange(len(profiles)), at]


def search_few(profiles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same for `MIN_PERIODS` to `FEW_PERIODS` periods, whose lines run into each other.

    Trend and harmonics are fitted jointly, by least squares, to the thinned profiles.
    """
    thin = max(profiles.shape[1] // 256, 1)
    n = profiles.shape[1] // thin
    values = _detrend(profiles[:, : n * thin].reshape(len(profiles), n, thin).mean(axis=2))
    energy = np.sum(values**2, axis=1) + 1e-300
    best, chosen = np.zeros(len(profiles)), np.full(len(profiles), MIN_PERIODS / profiles.shape[1])
    for periods, n_harmonics, basis in _few_bases(n):
        score = np.sum((values @ basis) ** 2, axis=1) / energy - _PRICE * n_harmonics
        chosen = np.where(score > best, periods / (n * thin), chosen)
        best = np.maximum(best, score)
    return chosen, np.where(best > _FEW_SCORE, best, 0)


@lru_cache(maxsize=8)
def _few_bases(n: int) -> list[tuple[float, int, FloatArray]]:
    """Periods, number of harmonics and orthonormal basis (n, k) of every trial of `search_few`."""
    trials = [(float(p), h) for p in np.arange(MIN_PERIODS, FEW_PERIODS + 1, 0.125) for h in (1, 3, 5)]
    bases = []
    for periods, n_harmonics in trials:
        series = _Series.make(n, 4, n_harmonics)
        basis, _ = np.linalg.qr(np.hstack([series.slow, *series.waves(periods / n)]))
        bases.append((periods, n_harmonics, np.asarray(basis)))
    return bases


def fit_fundamental(profile: FloatArray, frequency: float, first_row: int = 0) -> PeriodicFit | None:
    """Fit a profile at the fundamental nearest to `frequency`, its multiples or its parts, whichever explains it.

    Returns:
        The fit of the highest frequency that no lower one betters by much; None where nothing fits.
    """
    n = profile.size
    candidates = sorted((frequency * ratio for ratio in (3, 2, 1, 1 / 2, 1 / 3)), reverse=True)
    # With one limit for all, or the slow part of a fast candidate would follow the stripes themselves.
    most_slow = max(frequency * n, 2.0)
    inside = [f for f in candidates if 1.5 / n <= f <= MAX_FREQUENCY]
    shares = np.array([_rough_share(profile, f) for f in inside])
    likely = [f for f, share in zip(inside, shares, strict=True) if share >= 0.6 * shares.max()]
    fits = [fit_periodic(profile, f, first_row, most_slow) for f in likely]
    best: PeriodicFit | None = None
    for fit in fits:
        if fit is None:
            continue
        if best is None or (fit.beats(best) and fit.explained > best.explained * (1 + _SUBHARMONIC_SHARE)):
            best = fit
    return best


def _rough_share(profile: FloatArray, frequency: float) -> float:
    """Share of the variance about a cubic that five harmonics explain."""
    series = _Series.make(profile.size, 4, 5)
    basis, _ = np.linalg.qr(np.hstack([series.slow, *series.waves(frequency)]))
    parts = (basis.T @ profile) ** 2
    total = float(profile @ profile) - float(parts[:4].sum())
    return float(parts[4:].sum()) / max(total, 1e-300)


def fit_periodic(
    profile: FloatArray, frequency: float, first_row: int = 0, most_slow: float = np.inf
) -> PeriodicFit | None:
    """Maximum-likelihood fit near `frequency`; the numbers of harmonics and of slow terms by information criterion.

    Args:
        profile: (n,) values.
        frequency: cycles per row, right to about a third of a cycle over the profile.
        first_row: row of the profile's first value.
        most_slow: most terms of the slow mean and envelope.
    """
    slow_terms = _slow_terms(min(frequency * profile.size, most_slow))
    # A fall-off that is not followed passes for noise of long memory, in which harmonics drown.
    ample = max(terms for terms in slow_terms if terms <= _AMPLE_SLOW)
    best: PeriodicFit | None = None
    worse = 0
    for n_harmonics in _HARMONICS:
        # One harmonic of a pulse may vanish, two in a row say that there are no more.
        if worse == 2 or (n_harmonics > 1 and n_harmonics * frequency >= 0.5):
            break
        fit = _fit_near(profile, frequency, n_harmonics, ample, first_row)
        if fit is not None and (best is None or fit.beats(best)):
            best, worse = fit, 0
        else:
            worse += 1
    if best is None:
        return None
    fits = [_fit_near(profile, best.frequency, best.cosines.size, terms, first_row) for terms in slow_terms]
    return _with_model_spread(profile, _choose_slow([fit for fit in fits if fit is not None] or [best]))


def _choose_slow(fits: list[PeriodicFit]) -> PeriodicFit:
    """The fit with the best number of slow terms; `fits` has the fewest first."""
    best = fits[0]
    for fit in fits[1:]:
        if fit.beats(best):
            best = fit
    return best


def _with_model_spread(profile: FloatArray, best: PeriodicFit) -> PeriodicFit:
    """The fit with what richer envelopes would say added to its uncertainty.

    Over a few periods the envelope trades against the frequency, and the choice between envelopes is an error that
    the residual does not show.
    """
    if best.periods >= FEW_PERIODS:
        return best
    richer = (best.n_slow + extra for extra in (1, 2))
    fits = [_fit_near(profile, best.frequency, best.cosines.size, terms, best.first_row) for terms in richer]
    spread = max((abs(fit.frequency - best.frequency) for fit in fits if fit is not None), default=0.0)
    return replace(best, frequency_sd=float(np.hypot(best.frequency_sd, spread)))


def _slow_terms(periods: float) -> list[int]:
    """Numbers of Chebyshev terms to try; with two a period the envelope could imitate the stripes."""
    return [terms for terms in (2, 3, 4, 6, 8, 11, 16) if terms <= max(periods, 2)]


def _fit_near(
    profile: FloatArray, frequency: float, n_harmonics: int, n_slow: int, first_row: int
) -> PeriodicFit | None:
    """Gauss-Newton on slow mean, envelope, harmonics and frequency together; None where it runs off."""
    n = profile.size
    series = _Series.make(n, n_slow, n_harmonics)
    state = series.start(profile, frequency)
    model, jacobian = series.evaluate(state)
    rss = float(np.sum((profile - model) ** 2))
    for _ in range(12):
        step = _solve(jacobian, jacobian.T @ (profile - model))
        state, model, jacobian, new_rss = series.descend(profile, state, step, rss)
        converged = rss - new_rss <= 1e-7 * rss
        rss = new_rss
        if converged:
            break
    if abs(state[-1] - frequency) > 0.6 / n:
        return None
    trend = series.slow @ np.linalg.lstsq(series.slow, profile, rcond=None)[0]
    mean, envelope, cosines, sines = series.unpack(state)
    influence = _influence(jacobian)
    return PeriodicFit(
        frequency=float(state[-1]),
        frequency_sd=_noise_sd(influence, profile - model, state.size),
        cosines=cosines,
        sines=sines,
        origin=first_row + (n - 1) / 2,
        first_row=first_row,
        n_rows=n,
        explained=1 - rss / max(float(np.sum((profile - trend) ** 2)), 1e-300),
        rss=rss,
        n_parameters=state.size,
        n_slow=n_slow,
        n_effective=_independent(profile - model),
        mean=mean,
        envelope=envelope,
        influence=influence,
    )


@dataclass(frozen=True, slots=True)
class _Series:
    """The model `slow mean + envelope * harmonics`; its state is (mean, envelope less its constant 1, cosines, sines,
    frequency)."""

    #: (n,) rows about the middle, (n, K) slow functions, (H,) harmonic numbers.
    rows: FloatArray
    slow: FloatArray
    order: FloatArray

    @staticmethod
    def make(n: int, n_slow: int, n_harmonics: int) -> _Series:
        rows = np.arange(n, dtype=np.float64) - (n - 1) / 2
        slow = np.asarray(np.polynomial.chebyshev.chebvander(2 * rows / n, n_slow - 1), np.float64)
        return _Series(rows, slow, np.arange(1, n_harmonics + 1, dtype=np.float64))

    def start(self, profile: FloatArray, frequency: float) -> FloatArray:
        """Least squares with a constant envelope."""
        cosine, sine = self.waves(frequency)
        design = np.hstack([self.slow, cosine, sine])
        linear = _solve(design, design.T @ profile)
        n_slow = self.slow.shape[1]
        return np.concatenate([linear[:n_slow], np.zeros(n_slow - 1), linear[n_slow:], [frequency]])

    def waves(self, frequency: float) -> tuple[FloatArray, FloatArray]:
        """Cosines and sines of the harmonics, (n, H) each."""
        angle = 2 * np.pi * frequency * np.multiply.outer(self.rows, self.order)
        return np.cos(angle), np.sin(angle)

    def unpack(self, state: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Mean (n,), envelope (n,), cosines (H,), sines (H,)."""
        n_slow = self.slow.shape[1]
        envelope = 1 + self.slow[:, 1:] @ state[n_slow : 2 * n_slow - 1]
        cosines, sines = np.split(state[2 * n_slow - 1 : -1], 2)
        return self.slow @ state[:n_slow], envelope, cosines, sines

    def evaluate(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The model (n,) and its Jacobian (n, parameters)."""
        mean, envelope, a, b = self.unpack(state)
        cosine, sine = self.waves(state[-1])
        wave = cosine @ a + sine @ b
        slope = 2 * np.pi * self.rows * (cosine @ (self.order * b) - sine @ (self.order * a))
        e = envelope[:, None]
        by_envelope, by_frequency = self.slow[:, 1:] * wave[:, None], (envelope * slope)[:, None]
        return mean + envelope * wave, np.hstack([self.slow, by_envelope, cosine * e, sine * e, by_frequency])

    def descend(
        self, profile: FloatArray, state: FloatArray, step: FloatArray, rss: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """The step, halved until it does not make things worse; none otherwise. State, model, Jacobian, new RSS."""
        for scale in (1.0, 0.5, 0.25, 0.1, 0.0):
            trial = state + scale * step
            model, jacobian = self.evaluate(trial)
            new_rss = float(np.sum((profile - model) ** 2))
            if new_rss <= rss:
                break
        return trial, model, jacobian, new_rss


def _solve(design: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of the normal equations of `design` for the right-hand side, with columns brought to one scale.

    A trace of damping keeps parameters that hardly matter (the envelope of a vanishing wave) where they are.
    """
    scale = np.linalg.norm(design, axis=0) + 1e-300
    gram = (design / scale).T @ (design / scale)
    gram[np.diag_indices_from(gram)] += 1e-10
    return np.asarray(np.linalg.solve(gram, right / scale) / scale)


def _influence(jacobian: FloatArray) -> FloatArray:
    """(n,) what a unit of noise in each row does to the frequency (the last parameter)."""
    last = np.zeros(jacobian.shape[1])
    last[-1] = 1
    return np.asarray(jacobian @ _solve(jacobian, last))


def _noise_sd(influence: FloatArray, residual: FloatArray, n_parameters: int) -> float:
    """Standard deviation of the frequency under coloured noise.

    The estimate is linear in the noise, so its variance is the integral of the noise's power spectrum over that of the
    influence. Where the noise is not stationary (a scene lit by the stripes is multiplied by them), the sum of
    `influence * residual` over its own neighbourhood may say more.
    """
    n_fft = 4 * residual.size
    freedom = residual.size / max(residual.size - n_parameters, 1)
    weight = np.abs(np.fft.fft(influence, n_fft)) ** 2
    stationary = float(np.sum(noise_spectrum(residual, n_fft) * weight)) / n_fft
    score = influence * residual
    lag = max(int(4 * (residual.size / 100) ** (2 / 9)), 1)
    local = float(np.sum(np.convolve(score, np.bartlett(2 * lag + 3)[1:-1], "same") * score))
    return float(np.sqrt(max(stationary, local) * freedom))


def scatter_sd(influence: FloatArray, profiles: FloatArray) -> float:
    """Standard deviation of the frequency by what parts of a region say one by one.

    The influence is blind to the slow part and to the stripes' own shape, so each part's product with it is that part's
    deviation from the common frequency. Parts see different texture, which the residual's spectrum may not show.

    Args:
        influence: (n,) of the fit of the region's mean profile.
        profiles: (k, n) profiles of its strips, in order across.

    Returns:
        The standard deviation, widened for the few parts that it rests on; zero for fewer than four strips.
    """
    if len(profiles) < 4:
        return 0.0
    parts = np.array([part.mean(axis=0) @ influence for part in np.array_split(profiles, min(8, len(profiles)))])
    sizes = parts.size
    # Student's 97.5 % quantile over the normal one, nearly.
    widening = 1 + 1.5 / (sizes - 2)
    return float(np.std(parts, ddof=1) / np.sqrt(sizes) * widening)


def _independent(residual: FloatArray) -> float:
    """Number of independent values that `residual` is worth (Bartlett).

    Its autocorrelation counts up to where it first vanishes: beyond, a harmonic not yet fitted would pass for noise
    of long memory.
    """
    power = float(residual @ residual)
    if power <= 0:
        return float(residual.size)
    total = 0.0
    for lag in range(1, min(residual.size // 4, 100)):
        correlation = float(residual[lag:] @ residual[:-lag]) / power
        if correlation < 1 / np.sqrt(residual.size):
            break
        total += correlation**2
    return residual.size / (1 + 2 * total)


def noise_spectrum(residual: FloatArray, n_fft: int) -> FloatArray:
    """(n_fft,) power spectrum of the autoregressive process that fits `residual` (Yule-Walker)."""
    order = int(np.clip(residual.size // 20, 1, 12))
    lags = np.array([residual[: residual.size - k] @ residual[k:] for k in range(order + 1)]) / residual.size
    if lags[0] <= 0:
        return np.zeros(n_fft)
    toeplitz = lags[np.abs(np.subtract.outer(np.arange(order), np.arange(order)))]
    coefficients = np.linalg.lstsq(toeplitz, lags[1:], rcond=1e-9)[0]
    innovation = max(lags[0] - coefficients @ lags[1:], 1e-12 * lags[0])
    response = np.fft.fft(np.concatenate([[1.0], -coefficients]), n_fft)
    return np.asarray(innovation / np.abs(response) ** 2)


def explained_share(profiles: FloatArray, template: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How much of each profile a template explains, beyond a straight line.

    Args:
        profiles: (k, n) profiles.
        template: (n,) wave.

    Returns:
        (k,) share of the variance, negative where the template fits upside down; (k,) amplitude.
    """
    basis, _ = np.linalg.qr(np.polynomial.polynomial.polyvander(np.linspace(-1, 1, template.size), 1))
    flat = profiles - (profiles @ basis) @ basis.T
    wave = template - basis @ (basis.T @ template)
    power = float(wave @ wave) + 1e-300
    amplitude = flat @ wave / power
    variance = np.sum(flat**2, axis=1) + 1e-300
    return np.sign(amplitude) * amplitude**2 * power / variance, amplitude


def significant(fit: PeriodicFit) -> bool:
    """Whether a fit is stripes and not a scene: a few waves that fit badly are found in any picture."""
    return fit.explained > float(np.interp(fit.periods, [2, 4, FEW_PERIODS, 2 * FEW_PERIODS], [0.985, 0.97, 0.93, 0.5]))


def longest_block(members: BoolArray) -> tuple[int, int]:
    """The block range [b0, b1) and so the columns of `members` (strips, blocks) with the most information.

    Information on a frequency grows with the number of strips and the cube of the length.
    """
    n_blocks = members.shape[1]
    run = np.concatenate([np.zeros((len(members), 1), int), np.cumsum(members, axis=1)], axis=1)
    best, found = 0.0, (0, 0)
    for b0 in range(n_blocks):
        for b1 in range(b0 + 1, n_blocks + 1):
            strips = int(np.sum(run[:, b1] - run[:, b0] == b1 - b0))
            if strips * (b1 - b0) ** 3 > best:
                best, found = strips * (b1 - b0) ** 3, (b0, b1)
    return found
