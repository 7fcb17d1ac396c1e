"""Numbers of policy of a picture that is known from earlier frames."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class KnownPictureSettings:
    """Each with its unit and the reason for it."""

    #: Share of its weight that a frame keeps with every frame after it.
    memory_share: float = 0.95
    #: Weight of the picture around a row against one frame's look at the row itself at full light.
    smooth_weight: float = 0.05
    #: Share of a strip's light in doubt, inverse, from which it says nothing of the picture.
    doubt_weight: float = 1.4
    #: Squared error of the light expected of a strip, in parts of full light, and more of it per doubt.
    untold_error: float = 0.01
    unsure_error: float = 0.125
    #: Rows around, in each direction, from which the picture of a row that was never lit is taken.
    around_rows: int = 4
    #: Relative error of a picture taken from the rows around, and of one that was looked at well.
    around_error: float = 0.6
    min_error: float = 0.02
    #: Rows in each direction, all strips of a column together, from which the picture is taken where those around were
    #: not lit either; its weight against theirs, and its relative error, which neighbouring rows have in common.
    wide_rows: int = 60
    wide_weight: float = 0.1
    wide_error: float = 2.0
    #: Squared error of what a row is taken to see, in parts of full light, times the rows of a slot, which have it in
    #: common: a slot decided wrongly, or spilled light that is not as the model has it.
    seen_error: float = 0.03
    #: A slot's light is at 0.5 with this precision before anything is seen.
    prior_precision: float = 4.0
    #: Error of a column's light, in parts of full light, that no pooling removes.
    common_error: float = 0.04
    #: Slots around, in each direction, over which a strip's error is averaged, and those of them left out as its own.
    error_slots: float = 20.0
    own_slots: float = 1.3
    #: Precision of a slot's light from which its error tells how alike rows err; slots of all columns that count beside
    #: a column's own; and the least squared error against rows that err each for itself.
    told_precision: float = 0.5
    like_others_slots: float = 20.0
    min_correlated_error: float = 0.9

    #: What is possible of a response in the middle, at a side, and of its offset; and how much less is likelier.
    response_bounds: tuple[tuple[float, float], ...] = ((0.3, 1.3), (-0.1, 0.35), (-0.2, 0.2))
    response_ridge: float = 1e-4
    #: Largest correction of the clock at a time, slots.
    max_shift_slots: float = 0.4

    #: Rows of a strip, over all frames, from which its light where nothing is lit is known.
    min_dark_rows: int = 12
    #: Rows of a single column's header that must show, that it be judged.
    min_header_rows: int = 40

    #: Slots to each side that a blur reaches.
    side_slots: float = 0.5
    #: A slot that is lit, or dark, but for this probability is sure.
    sure_probability: float = 1e-4

    #: Every so manieth row tells enough of a column's signal-to-noise ratio.
    snr_every_row: int = 5


SETTINGS = KnownPictureSettings()
