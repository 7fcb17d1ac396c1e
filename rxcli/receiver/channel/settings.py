"""Settings of the observation model that neither physics nor the picture determine."""

import msgspec


class ChannelSettings(msgspec.Struct, frozen=True):
    """Thresholds, each with its unit and its reason."""

    #: Effective number of independent samples per slot and strip, since their errors are correlated. The confidence
    #: model was fitted with it.
    slot_information: float = 0.64

    #: Slots on each side from which the picture is predicted, fine texture to plain sky. The initial pass leaves out
    #: the finest.
    picture_scales: tuple[int, ...] = (1, 2, 8)
    #: Minimum relative variance of a prediction, which covers the uncertainty of the crosstalk.
    min_texture: float = 0.002
    #: Tails of the crosstalk: relative deviation of light from its local mean by texture; standard deviation of the
    #: tails of displays around their profile; standard deviations of an estimate from which it is used. Exponent of
    #: light that is bent. Least probability of right slots of a column that counts.
    tails_texture: float = 0.2
    tails_sd: float = 0.3
    sure_tails: float = 3.0
    bent: float = 1.1
    min_trust: float = 0.1
    #: Joint detection of slots and picture: least local light, standard deviations of a dark sample; relative error of
    #: the light beyond its noise.
    min_level_sigmas: float = 0.3
    relative_error: float = 0.02


SETTINGS = ChannelSettings()
