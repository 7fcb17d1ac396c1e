"""Settings of the picture known from earlier frames."""

import msgspec


class KnownPictureSettings(msgspec.Struct, frozen=True):
    """Thresholds, each with its unit and its reason."""

    #: Forgetting factor: share of its weight that a frame keeps with each later frame.
    memory_share: float = 0.95
    #: Weight of the picture of the neighbouring rows relative to one observation of a row at full light.
    smooth_weight: float = 0.05
    #: Squared error of the predicted light of a strip, relative to full light.
    prediction_error: float = 0.01
    #: Rows on each side from which the picture of a row that was never lit is interpolated.
    around_rows: int = 4
    #: Relative error of an interpolated picture, and of a well observed one.
    around_error: float = 0.6
    min_error: float = 0.02
    #: Rows on each side whose mean light provides the picture if the neighbouring rows were not lit either; relative
    #: weight, and relative error, which is common to neighbouring rows.
    wide_rows: int = 40
    wide_weight: float = 0.1
    wide_error: float = 2.0
    #: Squared error of the light of a row, relative to full light, times the rows of a slot, which share it: wrong
    #: decisions, and crosstalk that deviates from the model.
    row_error: float = 0.03
    #: Precision of the prior of a slot's light, whose mean is 0.5.
    prior_precision: float = 4.0
    #: Error of a column's light, relative to full light, that is common to all strips.
    common_error: float = 0.04
    #: Slots on each side whose mean light shows the picture: two symbols.
    level_slots: float = 10.0
    #: Slots on each side over which a strip's error is averaged, and the inner ones that are left out.
    error_slots: float = 20.0
    own_slots: float = 1.3
    #: Correlation of errors within a slot: minimum precision of a slot's light, weight of the mean over all columns in
    #: slots, and lower limit of the ratio to uncorrelated errors.
    min_slot_precision: float = 0.5
    mean_error_slots: float = 20.0
    min_correlated_error: float = 0.9

    #: How far centre, side and offset of a response may be from those without blur, and a clock from the one that is
    #: corrected, slots; and the ridge of their fit.
    max_response: tuple[float, ...] = (0.7, 0.35, 0.2, 0.4)
    response_ridge: float = 1e-4

    #: Distance from the middle of a slot within which rows count for its first decision, slots.
    decision_reach: float = 0.35
    #: Minimum number of header rows, times the precision of the prior, for a header contrast.
    min_header_rows: int = 40

    #: Distance of the blur taps, slots.
    side_slots: float = 0.5


SETTINGS = KnownPictureSettings()
