"""Settings of the observation model that neither physics nor the picture determine."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ChannelSettings:
    """Thresholds, each with its unit and its reason."""

    #: Effective number of independent samples per slot and strip, since their errors are correlated. The confidence
    #: model was fitted with it.
    slot_information: float = 0.64
    #: Largest light above black, relative to white, of a sample that counts as dark when noise is measured.
    dark_light: float = 0.002
    #: Log-likelihood ratio of a slot of full contrast in the initial metrics, and the number of strips of full contrast
    #: at which it is reached.
    initial_llr: float = 8.0
    initial_full_strips: float = 3.0

    #: Slots on each side from which the picture is predicted, fine texture to plain sky; and the scales of the initial
    #: pass, which suit most pictures.
    picture_scales: tuple[int, ...] = (1, 2, 5, 12)
    initial_scales: tuple[int, ...] = (2, 5)
    #: Slots over which the error of a prediction is averaged, and limits of its relative variance: the lower limit
    #: covers the uncertainty of the crosstalk.
    error_slots: int = 28
    texture_bounds: tuple[float, float] = (0.003, 2.0)

    #: Slots on each side over which the local mean light is taken; the network was trained with this value.
    level_slots: int = 10

    #: Row noise is estimated from every n-th strip, since errors of the strips of a column are correlated.
    row_strips: int = 2
    #: Limit of the residuals in the estimate of row noise, standard deviations.
    row_sigmas: float = 3.0


SETTINGS = ChannelSettings()
