"""Numbers of policy of the estimate of an unknown camera."""

import msgspec


class EstimateSettings(msgspec.Struct, frozen=True):
    """Each with its unit and the reason for it."""

    #: Strips that a column keeps.
    strips_per_column: int = 2
    #: Limit of levelled light, standard deviations.
    bounded_sigmas: float = 3.0
    #: Root mean square of levelled light that is nothing but rounding.
    min_soft_sign: float = 0.02

    #: Rounds of estimating the half width of the columns' autocorrelation.
    width_rounds: int = 3
    #: Window of the levels, in half widths of the stripes.
    level_widths: float = 16.0
    #: Rows that a half width has before anything is known, and that it keeps when rows are joined.
    rows_per_width: float = 4.0
    #: Half width of the autocorrelation, slots: from the shortest exposures to those of three slots.
    half_width_slots: tuple[float, float] = (0.45, 1.8)
    #: Rows that demosaicing, denoising and the lens mix, as the width of a box; and the least exposure that makes a
    #: difference, slots.
    mixed_rows: float = 2.0
    min_exposure_slots: float = 0.4
    #: Rows of the shortest slot that is separable from its neighbours.
    min_rows_per_slot: float = 1.15

    #: Largest bend that is tried: k1 for a focal length of one picture width.
    max_bend: float = 0.25
    #: Peaks that are tried of the slots' line, and of the columns' copies for every length of packet.
    n_peaks: int = 4
    #: Maximum weight of the slots' line, log-likelihood.
    max_line: float = 30.0
    #: Strength of the slots' line that noise reaches in one of ten pictures, ln(10 * 2000 bins).
    min_slot_line: float = 9.9
    #: Bends that are tried by the lines of the slots, the middle one none; by the likeness of columns, every second.
    n_bends: int = 25
    #: Clocks this close, relative, are one; hypotheses that are proposed; and the score that further ones need, as most
    #: of noise have 30 to 45, and right ones 60 and more where a whole packet is in view.
    same_clock: float = 4e-3
    n_proposed: int = 3
    min_score: float = 40.0
    #: The same of long exposures, whose passes are costly: photographs without a screen reach 40 to 76, mostly, and
    #: right ones with packets 77 and more.
    min_long_score: float = 75.0

    #: Error of a period over the picture, slots: by the copies of packets, and by the line of a long exposure.
    period_error: tuple[float, float] = (0.25, 0.0625)
    #: Step between the exposures that are compared, slots.
    exposure_step: float = 0.1
    #: Least strength of a line that is looked at, as a share of the strongest.
    min_line_share: float = 0.5
    #: Rows over which turns of the light are taken, and rows a slot for which each lag serves, in lags; limit of a
    #: turn, in medians.
    turn_lags: tuple[int, ...] = (1, 2, 4, 8)
    slot_lags: tuple[float, float] = (1.6, 7.0)
    max_turn: float = 4.0
    #: Percentile of the light that counts as black; least light above it.
    dark_percent: float = 0.5
    min_light: float = 1e-4
    #: Slots of a block whose phase is that of its middle; fewest rows of a slot whose phase shows; relative distances
    #: of rows a slot from their line, and from the clock of a short exposure, up to which they are sought, and between
    #: two that are tried; steps from there.
    block_slots: float = 6.0
    min_phase_rows: float = 3.0
    off_line: float = 0.08
    off_clock: float = 0.012
    step_off: float = 5e-4
    line_steps: int = 12
    #: Bins around a line that it is compared with; distance of the mosaic's line, cycles a row.
    line_bins: int = 801
    mosaic_line: float = 5e-3
    #: Slots over which the picture is taken as constant.
    picture_slots: float = 25.0
    #: Fits at most, and slots by which a fit moves the clock, anywhere, from which on a frame with plain packets is
    #: received with it again.
    max_fits: int = 2
    matters_slots: float = 0.2
    #: Steps of the fit, and how far the last one may move any row, slots.
    settle_steps: int = 4
    converged_slots: float = 0.03
    #: Exposures that are compared with the one known: this share of it, and the one that it is this share of.
    exposure_ratio: float = 0.75
    #: Number of samples equivalent to an independent one, since errors within a slot and column are correlated.
    samples_per_independent: float = 10.0
    #: Least share of the light's local variance that a fit must explain.
    min_explained: float = 0.1
    #: Ratio of errors to the scatter of the columns' contributions, since neighbours share their light.
    sd_scale: float = 1.6

    #: Bands of rows, whose strips are compared; likeness of neighbouring strips, 0..1, below which a band has no
    #: stripes; share of bands that must have stripes.
    likeness_bands: int = 16
    striped_likeness: float = 0.25
    striped_share: float = 0.7


SETTINGS = EstimateSettings()
