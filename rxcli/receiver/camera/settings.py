"""Numbers of policy of the estimate of an unknown camera."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Each with its unit and the reason for it."""

    #: Strips that a column keeps while its camera is unknown.
    most_strips: int = 2
    #: Sides are straight up to so many standard deviations, where these are small enough to tell; bowed from so many
    #: on.
    straight_sds: float = 1.5
    telling_sd: float = 0.03
    bowed_sds: float = 3.0
    #: Of light that is nothing but rounding.
    least_variance: float = 1e-10

    #: Rows per slot that are considered.
    least_rows_per_slot: float = 1.2
    most_rows_per_slot: float = 60.0
    #: Rows per slot, at one octave's reduction, that its window of this many reduced rows serves.
    octave_rows_per_slot: tuple[float, float] = (2.4, 4.8)
    octave_rows: int = 76
    #: Lag, in slots, at which a column is half as like itself: from short exposures to those of three slots.
    half_width_slots: tuple[float, float] = (0.5, 1.8)
    #: Copies further apart than this many slots are not compared: the grid of rows per slot would have to be too fine.
    scan_slots: int = 700
    #: Steps of the scan, slots over the picture.
    scan_step: float = 2.0
    #: Most that the slots' line in the edges' power counts, nats; and its places a slot over the picture.
    most_for_line: float = 30.0
    line_fine: int = 4
    #: A nat of it, and of copies that are alike, beside the height of the headers.
    say_of_rest: float = 0.03
    #: Rows per slot this close, relative, are one hypothesis.
    same_rows_per_slot: float = 0.015
    #: Hypotheses that are tried: so many of different clocks or packets, and so many of different clocks.
    scan_trials: int = 12
    #: The same of the short list; lines and peaks that an octave has on it, those of every length of packet; and slots
    #: over the picture by which a period is off.
    short_trials: int = 5
    short_lines: int = 4
    short_peaks: int = 3
    short_off_slots: tuple[float, ...] = (-1.0, 0.0, 1.0)

    #: Exposure that slots are read through while none is known, slots.
    read_exposure_slots: float = 1.2
    #: Share of the slots of headers and dimming symbols that may read wrongly, and the most that a slot says, nats.
    wrong_preamble: float = 0.02
    most_slot_nats: float = 6.0
    #: Slots before the first row, so that a clock that is put right leaves none out.
    slots_before: int = 2
    #: Below this evidence, nats, levels are tried that a weight of five would give: stars and lamps spoil the skewness.
    levels_in_doubt: float = 90.0

    #: Log-likelihood ratio of header and weights, over chance, that a clock must reach.
    least_evidence: float = 45.0
    #: Share of the light's local variance that slots must explain; those of wrong clocks on random stripes reach a
    #: fifth.
    least_explained: float = 0.22
    #: An estimate with this evidence has no rivals but those of its own slots in packets of another length.
    beyond_doubt_nats: float = 250.0
    #: A bend that fits this many nats better than none is tried; from the second on, it alone: stripes of pictures
    #: whose sides are bowed reach 12.
    bend_gains: tuple[float, float] = (5.0, 25.0)
    #: Readings that are refined, and the share of the best one's evidence that another needs.
    refined_readings: int = 3
    close_evidence: float = 0.3
    #: Evidence of a reading below which all periods are looked at, as a clock that is somewhat off reads at less; and
    #: below which not even its neighbours are.
    nothing_read_nats: float = 150.0
    hopeless_nats: float = 50.0
    #: Clocks of the short list, or of all periods, that are read; and by how many slots neighbours of the best, which
    #: are read too, are off by the end of the picture.
    readings: int = 4
    around_slots: tuple[float, ...] = (-1.2, -0.6, 0.6, 1.2)
    #: What doubling the length of a packet costs, nats.
    longer_packet_nats: float = 3.0

    #: Slots over which levels are taken, and weight of a column's own level there.
    level_slots: int = 31
    gain_prior: float = 0.05
    #: Log-odds of known slots; and the say of a sample, as samples of a slot err alike.
    known_log_odds: float = 6.0
    sample_information: float = 0.5
    #: Share of slots that are read freely which may be lit.
    free_duty: tuple[float, float] = (0.15, 0.85)
    #: Noise that is expected of levelled light before any is known.
    first_power: float = 0.3
    #: Rounds of weights and how many columns have them.
    sharing_rounds: int = 5
    #: Slots over which the light of a strip may be taken as constant.
    local_slots: int = 15

    #: Samples of a slot and strips of a column err alike: so many of them say what one would.
    samples_as_one: float = 10.0
    #: Slots that are wrong are wrong in neighbouring columns alike: the spread between columns says this much too
    #: little.
    understated_spread: float = 3.0
    #: Rounds of slots and clock, at most and at least; those before which the exposure is estimated.
    refine_steps: int = 8
    least_steps: int = 3
    exposure_steps: tuple[int, int] = (0, 2)
    #: Steps in which the clock alone moves, where no bend is known: slots that are wrong yet would bend it.
    rigid_steps: int = 2
    #: Steps that are this share of the one before, or more, are extrapolated, up to so many times.
    slow: float = 0.2
    most_extrapolated: float = 3.0
    #: Slots that were read on a clock further off than this, slots, are read anew; so many readings at most.
    far_slots: float = 0.4
    most_readings: int = 4
    #: A reading of this evidence, nats, is of the right clock: right ones have 254 and more nearly always, wrong ones
    #: 68.
    read_surely_nats: float = 200.0
    #: Packets of another length, which may be as plausible where less than two packets are in view, are estimates too
    #: where they are less likely by no more than this, nats.
    another_length_nats: float = 60.0
    #: The descent, and the refit, end when no row moves by more slots than this.
    converged_slots: float = 0.03
    #: Share of what a row leaves that is its own; and the least of the mean spread that is left anywhere.
    own_row_share: float = 1e-3
    least_spread: float = 0.2
    #: How far the light per unit of the wave differs from its usual share of the mean light.
    gain_sd: float = 0.5

    refit_steps: int = 6
    #: Exposure and rows are fitted anew after so many slots.
    rows_anew_slots: float = 0.1
    #: Slots over which the picture is taken as constant.
    picture_slots: float = 25.0
    #: Rows by which the picture's texture in a row is foretold.
    texture_order: int = 4
    #: Slots that explain less of the light's local variance were decoded on a wrong clock.
    refit_least_explained: float = 0.1
    #: The share is of weights that go with the residuals: it may fall a little where the fit is better.
    not_less_share: float = 0.97

    kernel_sd: float = 0.3
    #: Shutter times that are tried, as shares of the exposure that is seen: the mix of rows adds to it.
    shutter_shares: tuple[float, ...] = (0.35, 0.5, 0.65, 0.8, 0.9, 1.0, 1.1)
    kernel_rounds: int = 2

    #: Lenses bend back further out: k2 is about -k1 for such a focal length, give or take so much.
    bend_back_sd: float = 0.2
    #: Distances of compared strips, in columns; a column's light reaches over its neighbours.
    bend_distances: tuple[float, ...] = (0.5, 1.0, 2.0)
    #: Lags looked at, rows; windows of rows; rows over which light is levelled.
    bend_lags: int = 24
    bend_windows: int = 20
    bend_level_rows: int = 100
    #: Climbing ends where a step gains less, nats.
    least_gain: float = 0.01

    #: Rows over which the edges' power is levelled.
    edge_level_rows: int = 41
    #: Nats of a line beyond doubt: wrong periods reach 5, right ones 46 and more where the line is seen at all.
    line_beyond_doubt_nats: float = 20.0

    #: Share of slots that are taken for lit when dark, or the other way, by the extremes around them.
    wrong_slots: float = 0.04
    #: A column has at least this share of its slots lit, and of them dark.
    least_share: float = 0.1
    #: Share of the symbols in which any number of slots is as likely: something covers them.
    spoiled_symbols: float = 0.05
    #: Most that repeated packets count, nats. Errors come in runs and columns share light: so many slots say what one
    #: does.
    most_for_repeats_nats: float = 40.0
    slots_as_one: int = 3

    #: Curves of a smaller exponent are nearer to none at all than to sRGB.
    linear_below: float = 1.5
    #: How far the bend of a picture whose curve is known is off: textures, sharpening and slots that are wrong.
    tone_bend_sd: float = 0.25
    #: Half of the light is never more than so near to none, whatever the bend.
    least_half: float = 0.05

    #: Likeness of neighbouring strips, over the light's own variance, below which a picture has no stripes.
    striped_likeness: float = 0.25
    #: Share of the screen's height that must be striped.
    striped_share: float = 0.7
    likeness_bands: int = 16


SETTINGS = CameraSettings()
