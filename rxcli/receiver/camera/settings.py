"""Numbers of policy of the estimate of an unknown camera."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Each with its unit and the reason for it."""

    #: Strips that a column keeps.
    strips_per_column: int = 2
    #: Variance of light that is nothing but rounding.
    min_variance: float = 1e-10
    #: Levelled light, in root mean squares, at which a column counts as plainly lit or dark; and the least of it.
    soft_sign: float = 0.5
    min_soft_sign: float = 0.02

    #: Half width of the columns' autocorrelation before anything is known, rows; rounds of estimating it; and the
    #: window that light is levelled over meanwhile, in half widths.
    first_width_rows: int = 4
    width_rounds: int = 3
    scale_widths: float = 10.0
    #: Window of the levels, in half widths of the columns' autocorrelation: the first, and a wider one for columns
    #: with long runs of lit or dark slots.
    level_widths: tuple[float, float] = (16.0, 24.0)
    #: Rows that a half width keeps when rows are joined.
    rows_per_width: float = 4.0
    #: Half width of the autocorrelation, slots: from the shortest exposures to those of three slots.
    half_width_slots: tuple[float, float] = (0.45, 1.8)
    #: Rows that demosaicing, denoising and the lens mix, as the width of a box; and the least exposure that makes a
    #: difference, slots.
    mixed_rows: float = 2.0
    min_exposure_slots: float = 0.4
    #: Rows of the shortest slot that is separable from its neighbours.
    min_rows_per_slot: float = 1.15

    #: Lags between strips that are looked at, rows (and their minimum after joining); and windows of rows.
    bend_lag_rows: int = 8
    min_bend_lags: int = 4
    bend_windows: int = 20
    #: k1 of corrected lenses, for a focal length of one picture width: standard deviation; and -k2 / k1 of usual ones.
    k1_sd: float = 0.3
    k2_shares: tuple[float, float, float] = (0.4, 1.1, 2.0)
    k1_steps: int = 61
    #: Weight of all correlations between strips together, log-likelihood.
    bend_weight: float = 4000.0
    #: Gains of a bend over none, log-likelihood: from which it is proposed, and from which it alone is.
    bend_gains: tuple[float, float] = (3.0, 40.0)

    #: Rows over which the power of edges is levelled.
    edge_level_rows: int = 41
    #: Peaks that are looked at: of the slots' line, and of the columns' copies for every length of packet.
    n_lines: int = 4
    n_copies: int = 3
    #: The most that the slots' line counts, log-likelihood; the least score of a hypothesis.
    max_line: float = 30.0
    min_score: float = 35.0
    #: Clocks this close, relative, are one.
    same_clock: float = 4e-3
    #: Hypotheses that are proposed with either window of levels.
    n_proposed: tuple[int, int] = (5, 3)

    #: Slots over which the picture is taken as constant.
    picture_slots: float = 25.0
    #: Fits at most; slots by which a fit moves the clock, anywhere, from which on the frame is received with it again;
    #: and the share of the evidence that must stay.
    max_fits: int = 2
    matters_slots: float = 0.05
    kept_evidence: float = 0.9
    #: Steps of the fit, and how far the last one may move any row, slots.
    settle_steps: int = 4
    converged_slots: float = 0.03
    #: Exposures around the one known that are compared, as factors.
    exposure_factors: tuple[float, ...] = (0.75, 1.0, 1.33)
    #: Number of samples equivalent to an independent one, since errors within a slot and column are correlated.
    samples_per_independent: float = 10.0
    #: A fit that explains less of the light's local variance, or moves any row by more slots, is none.
    min_explained: float = 0.1
    max_moved_slots: float = 20.0
    #: Ratio of errors to the scatter of the columns' contributions, since neighbours share their light.
    sd_scale: float = 1.6
    #: Chi-square of the four coefficients from which stripes are bent beyond doubt.
    bent_chi_square: float = 40.0

    #: Exponents below this are nearer to no tone curve than to sRGB.
    linear_below: float = 1.5
    #: Error of the bend of light over shares of slots, from textures, sharpening and wrong slots; and the least of half
    #: the light, whatever the bend.
    tone_bend_sd: float = 0.25
    min_half: float = 0.05

    #: Rows over which light is levelled to compare strips; likeness of neighbouring strips, 0..1, below which a band of
    #: rows has no stripes; bands; share of them that must have stripes.
    likeness_rows: int = 100
    striped_likeness: float = 0.25
    likeness_bands: int = 16
    striped_share: float = 0.7


SETTINGS = CameraSettings()
