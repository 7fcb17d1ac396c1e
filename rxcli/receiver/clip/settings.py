"""Numbers of policy of clips: what is carried over from frame to frame, and when it is checked."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ClipSettings:
    """Each with its unit and the reason for it."""

    #: Strips of a column, at most: more tell no more of a picture that is known, and take time.
    max_strips: int = 4
    #: Frames from which a frame is measured without what others that show its bursts have taught of the picture there;
    #: of fewer, too little would be left.
    enough_views: int = 6
    #: Movement that is none: pixels, or standard deviations of what was found.
    still_px: float = 0.3
    still_sds: float = 2.5
    #: Where texture tells little: how well rest is known in screen sizes, and standard deviations of what may be rest;
    #: and how well the place of one that does not rest is known.
    rest_sd: float = 0.0005
    rest_sds: float = 4.0
    moving_sd: float = 0.003
    #: Share of its motion between two looks that a screen is expected to repeat.
    drift_share: float = 0.7
    #: Rows at the screen's ends that are not counted on where a screen moves, least and most, beside one standard
    #: deviation of the corners. A row beyond the end is dark, whatever the known picture expects there.
    min_end_rows: float = 1.0
    max_end_rows: float = 14.0
    #: How often a still outline is looked for where the picture does not tell, and looks that make it still.
    look_every: int = 8
    still_looks: int = 3
    #: In screen widths: how far an outline may be from where the screen was to be there still, and how far it may move
    #: from one frame to the next to be found.
    same_outline: float = 0.005
    outline_reach: float = 0.02
    #: How much of its shape an outline may lose or win between two looks, in screen widths.
    bent_outline: float = 0.012
    #: A screen found anew whose corners are closer than this to where they were, in screen widths, is where it was.
    near_outline: float = 0.06
    #: Frames from which the picture is learned one by one, and how often from then on.
    first_updates: int = 12
    update_every: int = 6
    #: Frames of which the picture is known so little that strips are compared with what is expected of them.
    few_updates: int = 4
    #: Columns decided worse than this many times the foreseen variance do not fit what is known; and of a screen
    #: that is taken to rest: while it does 0.8 to 1.3 times, 2 pixels away 2 times and more.
    misfit: float = 40.0
    rest_misfit: float = 1.5
    #: Contrast of headers, against full, below which nothing is known any more, and contrast of a frame below which
    #: compression has taken much of it.
    min_header: float = 0.3
    faded: float = 0.85
    #: Slots of lateness that are put right, of the clock and of its drift from halfway down to the last row: rows that
    #: are instants drift by 0.02 at most, those that a camera has stretched to hold a picture still by 0.1 to 0.4. How
    #: often such rows are timed anew.
    late_slots: float = 0.03
    retimings: int = 4
    #: Share of a frame's noise, and of its rows per slot, in what is expected of the next.
    frame_share: float = 0.2
    #: Contrast of its headers at which the foretold clock is not doubted.
    good_header: float = 0.6
    #: Contrast of its headers from which a foretold clock needs no shift; and step and number of shifts tried, slots.
    plain_header: float = 0.8
    header_shift: float = 0.3
    max_shifts: int = 5
    #: How much better its headers must show for a clock to be taken instead of the foretold one.
    better_header: float = 0.1
    #: Variance of a strip's light, at least: that of a starved clip's dark parts is none.
    min_variance: float = 1e-7

    #: Frames at the start of a scene that are looked at once more when the picture is known better; how many are waited
    #: for where compression has taken much; and the share of the well lit packets that are then in doubt.
    frames_held: int = 6
    frames_held_long: int = 24
    much_doubt: float = 0.03
    #: Passes over so few frames: what one of them was decided to be tells in the next of the others.
    looks_again: int = 2
    #: Share in doubt, before the frames held are measured again, that this would not mend: it is left out.
    too_much_doubt: float = 0.25
    #: Share of columns that a quick look at a first frame may leave in doubt.
    quick_doubt: float = 0.5
    #: Share of columns in doubt from which a first frame is not explained by the camera that is named, and below which
    #: it is by another.
    unlike_doubt: float = 0.85
    like_doubt: float = 0.65
    #: Pixels of which one is compared with the frame before; least change from row to row, grey levels of 255, and
    #: share of it that a frame shown twice differs from itself.
    same_step: int = 15
    same_contrast: float = 3.0
    same_share: float = 0.25
    #: Frames in a row that may be received like photographs before the picture is learned anew.
    max_unknown_frames: int = 3
    #: How much longer than from one frame to the next a readout may seem to take: time stamps are rounded.
    readout_slack: float = 1.1
    #: Frames that find their clock together where each shows little.
    frames_together: int = 8
    #: Frames that are reported together where nobody asks for results promptly.
    reports_together: int = 4
    #: Frames that may wait until it is clear which copies begin a burst.
    max_waiting_frames: int = 8

    #: A burst of a column all of whose symbols have at least this log probability is not decoded again.
    certain_log_prob: float = -1e-4
    #: Squared contrast over variance of a slot that is well lit, and log probability of a packet in doubt.
    well_lit_snr: float = 10.0
    doubtful_log_prob: float = -0.05
    #: Squared contrast over variance of a slot, at which all copies of a packet together do not give one.
    dark_snr: float = 0.5
    #: Dark columns are tried all the same in every so manieth frame.
    try_dark_every: int = 30

    #: Corners of two searches that differ by less than this, in screen widths, agree; searches where they do not.
    outlines_agree: float = 0.003
    max_searches: int = 5

    #: A frame that shows fewer packets than this finds its clock with others; one that shows more does better alone.
    few_packets: float = 1.05
    #: Lead of the headers' place over the best elsewhere.
    min_lead: float = 1.4


SETTINGS = ClipSettings()
