"""Settings of clips: what is carried over from frame to frame, and when it is checked."""

import msgspec


class ClipSettings(msgspec.Struct, frozen=True):
    """Each with its unit and the reason for it."""

    #: Exposure in slots from which slots and what is not known of the picture are decided together.
    joint_slots: float = 1.7
    #: Share of the slots of such an exposure that are wrong where a copy is detected by itself.
    wrong_slots: float = 0.08
    #: Maximum number of strips of a column: more do not improve a known picture, and take time.
    max_strips: int = 4
    #: Log-odds before anything is seen that the picture moves on the screen, probabilities that it begins or
    #: ends to do so in a frame, and limit of the log-odds.
    film_log_odds: float = -3.0
    film_begins: float = 0.003
    film_ends: float = 0.03
    max_log_odds: float = 20.0
    #: Standard deviation of the columns that were found, and of what errors of the light model add where slots
    #: show, in columns; share of the picture's motion that is uncertain.
    place_sd: float = 0.05
    columns_sd: float = 0.01
    unsteady_share: float = 0.3
    #: Movement that is none: pixels, or standard deviations of what was found.
    still_px: float = 0.3
    still_sds: float = 2.5
    #: Rows at the ends of a moving screen that are not used: beyond the end it is dark, whatever the picture is there.
    end_rows: int = 2
    #: Slots by which the outline of a long exposure may be too long; not used where frames do not show its end.
    end_slots: float = 3.0
    #: Interval of searches for a screen at rest, and searches that establish rest.
    look_every: int = 8
    still_looks: int = 3
    #: Inverse of the variance of a row's slots at which the row is not used for the picture.
    doubt_weight: float = 8.0
    #: Number of frames from which the picture is learned one by one, and of frames between any two later ones.
    first_updates: int = 12
    #: Columns decided worse than this many times the foreseen variance do not fit what is known; and of a screen
    #: that is taken to rest: while it does 0.8 to 1.3 times, 2 pixels away 2 times and more.
    misfit: float = 40.0
    rest_misfit: float = 1.5
    #: Contrast of headers, against full, below which nothing is known any more, and contrast of a frame below which
    #: compression has taken much of it.
    min_header: float = 0.3
    faded: float = 0.85
    #: Minimum lateness of the clock that is corrected, slots.
    late_slots: float = 0.03
    #: Change of the exposure from which light is scaled to that of the picture; weights change it by up to 0.15.
    exposure_change: float = 0.3
    #: Share of a frame's noise in what is expected of the next.
    frame_share: float = 0.2
    #: Contrast of its headers at which the predicted clock is accepted; lead of one that replaces it below that; and
    #: steps of the search near it, slots.
    good_header: float = 0.6
    header_lead: float = 0.1
    clock_step: float = 0.5
    #: Most slots by which the clock of a long exposure is moved in a frame.
    long_step: float = 0.25

    #: First frames whose mean shows the texture of the picture, and little of their slots.
    n_for_texture: int = 16
    #: Which of them are searched without it, from the first to the last, until more than a few show packets and two of
    #: these agree.
    searched_frames: tuple[float, ...] = (0.0, 0.5, 1.0, 0.25, 0.75, 0.125)
    few_frames: int = 2
    #: First frames that are taken together: for the clock where each shows little, for the phase of the bursts and for
    #: the picture; number where these leave doubt; and share of well lit packets in doubt.
    first_frames: int = 6
    frames_in_doubt: int = 24
    much_doubt: float = 0.03
    #: An estimated camera that gives this many times the evidence of packets replaces the named one.
    unlike_evidence: float = 4.0
    #: Points across and down the screen that are compared with the frame before; least change from row to row, in units
    #: of white; and shares of it, and of the level, by which a repeated frame may differ.
    same_points: int = 32
    min_contrast: float = 0.01
    same_share: float = 0.25
    same_level_share: float = 0.05
    #: How much longer than from one frame to the next a readout may seem to take: time stamps are rounded.
    readout_slack: float = 1.1

    #: A burst of a column all of whose symbols have at least this log probability is not decoded again.
    certain_log_prob: float = -1e-4
    #: Squared contrast over variance of a slot that is well lit, and log probability of a packet in doubt.
    well_lit_snr: float = 10.0
    doubtful_log_prob: float = -0.05

    #: A frame that shows fewer packets than this finds its clock with others; one that shows more does better alone.
    few_packets: float = 1.05
    #: Probability of the length of packets from which a frame's clock needs no other frames.
    sure_framing: float = 0.99
    #: Share of frames whose clock contradicts the link's time although that is right.
    wrong_clocks: float = 0.05
    #: Lead of the headers' place over the best elsewhere.
    min_lead: float = 1.4
    #: Evidence of a screen that has moved, times that of where it was, from which it is believed.
    moved_gain: float = 2.0


SETTINGS = ClipSettings()
