"""Numbers of policy of the observation model: what physics and the picture at hand do not tell."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ChannelSettings:
    """Each with its unit and the reason for it."""

    #: Samples of one slot and strip err alike: together they count as so many independent ones, however many they are.
    #: Confidences were fitted with it.
    slot_information: float = 0.64
    #: Light over black, parts of white, up to which a sample counts as dark when noise is measured.
    dark_light: float = 0.002
    #: Log-likelihood ratio that the first guess gives a slot seen at full contrast, and strips of full contrast from
    #: which on it does.
    initial_llr: float = 8.0
    initial_full_strips: float = 3.0

    #: Slots on a side from which the picture is predicted, fine texture to plain sky; a first pass takes those that
    #: suit most.
    picture_scales: tuple[int, ...] = (1, 2, 5, 12)
    initial_scales: tuple[int, ...] = (2, 5)
    #: Slots over which the error of a prediction is averaged, and bounds of its variance, relative to the picture's
    #: square: the least keeps a plain picture from being sure beyond what crosstalk is known to.
    error_slots: int = 28
    texture_bounds: tuple[float, float] = (0.003, 2.0)

    #: Slots on either side over which the mean light around is taken; the network has learned with as many.
    level_slots: int = 10
    #: Kinds of picture behind a word, smooth to rough: relative standard deviation about the mean light, and slots
    #: after which it is another one (Ornstein-Uhlenbeck).
    picture_kinds: tuple[tuple[float, float], ...] = ((0.06, 0.7), (0.25, 2.0), (0.7, 3.0))
    #: Slots on either side that a word is weighed with.
    around_slots: int = 3

    #: A row's own light is told by one strip in so many: strips of a column err alike.
    row_strips: int = 2
    #: Largest residual in it, standard deviations.
    row_sigmas: float = 3.0


SETTINGS = ChannelSettings()
