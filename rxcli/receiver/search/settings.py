"""Settings of the search: outlines, weight of evidence, end of the search, distance of rivals, light without data."""

import msgspec


class SearchSettings(msgspec.Struct, frozen=True):
    """Settings of the search. Evidence is a log-likelihood ratio for a screen of twenty columns."""

    #: Weight of evidence in the score, because errors of samples are correlated.
    temper: float = 0.08
    #: Weight of headers without symbols relative to packets.
    header_weight: float = 0.18
    #: Evidence that a complete packet adds.
    complete_packet: float = 60.0
    #: Above this evidence nothing further is proposed under a known camera: wrong clocks reach 391.
    plain: float = 400.0
    #: Below this evidence an estimated camera is rejected; above the second no other one is proposed.
    few_packets: float = 40.0
    plain_estimate: float = 100.0
    #: Work on a picture, slots x columns that searches of clocks and initial passes go through, each path of joint
    #: detection by itself; evidence above `plain_estimate` extends it in proportion. Right ones take 300,000 at most.
    work: int = 400_000
    #: Share of the lit columns with a believable packet, from which nothing that is stated is doubted.
    settled_share: float = 0.2
    #: Siblings of a scored hypothesis get a pass if their score could come this near to the best one; log-odds within
    #: which an outline is possible.
    reach: float = 3.0
    #: Minimum header lead (peak over rival) of a clock.
    min_lead: float = 1.6
    #: Log prior lost by each further camera.
    next_camera: float = 0.5
    #: Probability from which a column's number is likely; and from which it is reported as the screen's, that of a
    #: bright part of the picture to be the whole screen, and from which a packet is sure.
    likely_certainty: float = 0.5
    sure_certainty: float = 0.9
    #: Weight of the log-likelihood of packets in outermost columns, as samples err together.
    outer_weight: float = 0.2

    #: Distance, screen widths, within which the sides of two outlines are the same.
    same_sides: float = 0.025
    #: Minimum overlap of a given outline and the picture, as a fraction of either.
    min_overlap: float = 0.002
    #: Minimum number of rows for blind camera estimation.
    min_rows: int = 24
    #: Exposure, in slots of the slowest screen that was tried, from which it is named as the reason for a refusal.
    max_named_slots: float = 3.0
    #: Mean, as a share of white, below which a picture without a screen is reported as dark.
    dark_mean: float = 0.08
    #: Correlation from which columns far apart have the same stripes: of screens on their side 0.66 and more, of
    #: upright ones at most 0.5.
    min_common_light: float = 0.6
    #: Share of their variance that one period explains, from which stripes are even: of lamps and text 0.6 and more, of
    #: packets at most 0.3; and number of stripes from which they may be.
    even_share: float = 0.45
    min_even_stripes: int = 8
    #: Largest size of an outline relative to the picture, beyond which less than one column is visible.
    largest_outline: float = 50.0

    #: Less than a packet in view: fewest symbols, phases of a slot that are tried, clocks that are handed on; fit by
    #: which a start with a part of the header in view must lead, as one dark slot gives 14, and most that a column
    #: takes off; least fit of a clock: noise has 20 times that of a column; fits of outline and camera; lead of a slot
    #: below which a camera may be wrong: by right ones pictures reach 22 to 69, by ones 1 % off 8 to 14.
    cut_symbols: int = 2
    cut_phases: int = 4
    max_cut: int = 4
    cut_start: float = 60.0
    cut_fit: float = -1050.0
    cut_fits: int = 3
    poor_lead: float = 16.0
    #: Fit by which the last clock may be behind the first; and log evidence by which one exposure of the slots excludes
    #: another: right ones lead by -2 to 2100 over half of it, by 1300 and more over twice of it.
    cut_reach: float = 300.0
    #: Least log evidence of a slot against the unlikeliest phase: light without slots has 0.8, cut packets 14 and more.
    cut_lead: float = 2.0
    #: Room light that is tried where no header is in view, relative to its estimate, which counts what is lit in part.
    cut_room_lights: tuple[float, ...] = (1.0, 0.8, 0.6)
    #: Natural logarithm of the ratio of readouts, stated and estimated, up to which they may agree: cameras state that
    #: of the sensor, and a frame may show a part of it.
    near_readouts: float = 0.3

    #: Fits of the exposure; shortest one, slots, that the light shows; standard deviation of its logarithm; and least
    #: log-likelihood, as files may state wrong ones.
    exposure_fits: int = 2
    shortest_exposure: float = 0.35
    exposure_sd: float = 0.25
    min_exposure_llr: float = -4.0

    #: Largest shift of the light of one lamp between columns, slots: blinds may be slanted.
    max_column_shift_slots: int = 10
    #: Detection of switched light without a clock: smoothing and longest period, rows; minimum explained share.
    smooth_rows: int = 2
    max_period_rows: int = 100
    switched_share: float = 0.7


SETTINGS = SearchSettings()
