"""The wave of a lamp from its stripes: lit share of the period, depth, exposure and blur of the picture.

A lamp that is lit for a share `a` of every period, through an exposure of `t` periods and a Gaussian blur of `s`
periods, has the harmonics `2 h sin(pi k a) / (pi k) * sinc(k t) * exp(-2 (pi k s)^2)` about the middle of its lit part;
`h` is the step of its light. The likelihood is computed over a grid of `a`, `t` and `s`, so that an interval holds
whatever the stripes leave open.
"""

from dataclasses import dataclass

import numpy as np

from rxcli.calibrate.periodic import PeriodicFit, harmonic_waves, noise_spectrum
from rxcli.numerics import Z95
from rxcli.types import FloatArray

#: Most harmonics; places of the middle of the lit part, in half a period; points of the noise's spectrum.
_MAX_HARMONICS, _PLACES, _N_FFT = 40, 1440, 4096
#: Share of the wave that a switched lamp explains at least.
_MIN_EXPLAINED = 0.992
#: Lit shares, and blurs in rows: the development of a picture and its size change blur by some rows.
_SHARES, BLURS_ROWS = np.linspace(0.005, 0.995, 199), (0.0, 0.3, 0.5, 0.7, 0.9, 1.1, 1.3, 1.5, 1.8, 2.2)
#: The second, finer grid of shares, about the likeliest.
_FINE_SHARES = 5e-4 * np.arange(-10, 11)
#: Error of every harmonic, as a share of the largest over the root of its order: tone curve, uneven lamps.
_MODEL_ERROR = 0.005
#: More exposures than these are a search, and more harmonics ring.
_FEW = 3
#: Least attenuation of a harmonic by the exposure that can be undone, and points of a waveform.
_MIN_ATTENUATION, POINTS = 0.15, 64


@dataclass(frozen=True, slots=True)
class Wave:
    """The harmonics of a lamp's stripes."""

    #: (K,) complex amplitudes about row `origin` of the fit, relative to the mean light, and standard deviations.
    amplitudes: FloatArray
    sds: FloatArray
    #: Cycles per row.
    frequency: float


@dataclass(frozen=True, slots=True)
class Switched:
    """A switched lamp: cells of a grid that the stripes allow at 95 %, the likeliest first."""

    #: (n,) lit share of the period, exposure in periods, and step of the light relative to the mean light.
    share: FloatArray
    exposure: FloatArray
    step: FloatArray
    #: Whether a switched lamp explains the stripes.
    fits: bool

    @property
    def depth(self) -> FloatArray:
        """(n,) (brightest - darkest) / (brightest + darkest)."""
        darkest = np.maximum(1 - self.share * self.step, 0)
        return np.asarray(self.step / (2 * darkest + self.step))


def lamp_wave(fit: PeriodicFit, profile: FloatArray) -> Wave:
    """Harmonics of a region's profile, by least squares about its slow part."""
    n = profile.size
    n_harmonics = int(max(min(_MAX_HARMONICS, 0.5 / fit.frequency - 0.5, n / 6), 1))
    waves, power = harmonic_waves(fit, n_harmonics), float(fit.envelope @ fit.envelope)
    amplitudes = np.linalg.lstsq(waves.T @ waves, waves.T @ (profile - fit.mean), rcond=1e-9)[0]
    spectrum = noise_spectrum(fit.residual, _N_FFT)
    bins = np.rint(fit.frequency * np.arange(1, n_harmonics + 1) * _N_FFT).astype(int)
    mean = max(float(fit.envelope @ fit.mean) / power, 1e-9)
    sds = np.sqrt(2 * np.maximum(spectrum[bins], 1e-3 * spectrum.mean()) / power) + 1e-9
    cosines, sines = amplitudes.reshape(2, -1)
    return Wave((cosines - 1j * sines) / mean, sds / mean, fit.frequency)


def fit_switched(wave: Wave, exposures: FloatArray, blurs_rows: tuple[float, ...] = BLURS_ROWS) -> Switched:
    """Compare the wave with those of switched lamps.

    Args:
        wave: of the stripes.
        exposures: (n,) exposures to try, periods, ascending; of more than three, those shorter than flash and pause
            count.
        blurs_rows: blurs to try, standard deviations in rows.
    """
    order = np.arange(1, wave.sds.size + 1)
    turns = np.exp(2j * np.pi * np.outer(np.arange(_PLACES) / (2 * _PLACES), order))
    rotated = turns * wave.amplitudes
    even = rotated[np.argmax((rotated.real**2 / wave.sds**2).sum(axis=1))]
    odd, even = even.imag, even.real
    variance = wave.sds**2 + (_MODEL_ERROR * np.abs(even).max()) ** 2 / order
    blurs = np.array(blurs_rows) * wave.frequency
    coarse = _cells(even, variance, exposures, blurs, _SHARES)
    best = int(np.argmin(coarse[3]))
    shares, near = np.clip(coarse[0][best] + _FINE_SHARES, 0.002, 0.998), coarse[1][best]
    # Between the neighbours of the likeliest exposure, where several were given.
    at = np.searchsorted(exposures, near)
    beside = exposures[max(at - 1, 0)], exposures[min(at + 1, exposures.size - 1)]
    fine = _cells(even, variance, np.linspace(*beside, 13), blurs, shares)
    share, exposure, step, cost = (np.concatenate(pair) for pair in zip(coarse, fine, strict=True))
    inflation = max(float(cost.min()) / max(order.size - 3, 1), 1.0)
    limit = float(cost.min()) + Z95**2 * inflation
    allowed = np.argsort(cost)[: int(np.sum(cost <= limit))]
    left = max(float(np.sum(odd**2 / variance)) + float(cost.min()) - 2 * order.size, 0.0)
    if exposures.size > _FEW:  # an exposure that is not known is shorter than flash and pause
        shorter = exposure[allowed] <= np.minimum(share[allowed], 1 - share[allowed]) + 1e-3
        allowed = allowed[shorter] if shorter.any() else allowed
    explained = 1 - left / float(np.sum(np.abs(wave.amplitudes) ** 2 / variance))
    return Switched(share[allowed], exposure[allowed], step[allowed], explained > _MIN_EXPLAINED)


def _cells(
    even: FloatArray, variance: FloatArray, exposures: FloatArray, blurs: FloatArray, shares: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Share, exposure, step and cost of every cell of a grid, flat."""
    k = np.arange(1, even.size + 1)
    lit = 2 * np.sin(np.pi * np.outer(shares, k)) / (np.pi * k)
    response = np.sinc(np.outer(exposures, k))[:, None] * np.exp(-2 * (np.pi * np.outer(blurs, k)) ** 2)
    weighted = even / variance
    product = (response * weighted) @ lit.T
    power = (response**2 / variance) @ (lit**2).T + 1e-300
    step = product / power
    cost = float(even @ weighted) - product**2 / power
    # A step downwards is one upwards half a period later.
    share = np.where(step > 0, shares, 1 - shares)
    exposure = np.broadcast_to(exposures[:, None, None], step.shape)
    return share.ravel(), exposure.ravel(), np.abs(step).ravel(), cost.ravel()


def light_curve(wave: Wave, exposure: float) -> tuple[FloatArray, float]:
    """(POINTS,) light over one period relative to its mean, the exposure's attenuation undone, and its deviation."""
    order = np.arange(1, wave.sds.size + 1)
    attenuation = np.sinc(order * exposure)
    clear = (np.abs(wave.amplitudes) > 3 * wave.sds) & (np.abs(attenuation) > _MIN_ATTENUATION)
    phase = np.exp(2j * np.pi * np.outer(np.arange(POINTS) / POINTS, order[clear]))
    # Lanczos' factors, against the ringing of a series that ends.
    highest = int(order[clear].max(initial=0))
    damping = np.sinc(order[clear] / (highest + 1)) if highest > _FEW else 1.0
    curve = 1 + (phase @ (wave.amplitudes[clear] / attenuation[clear] * damping)).real
    return np.asarray(curve), float(np.sqrt(np.sum((wave.sds[clear] / attenuation[clear]) ** 2)))
