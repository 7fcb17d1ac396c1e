"""A screen whose clock was found, with its sampled columns; and screens that a picture does not distinguish."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rxcli.profiles import ScreenProfile
from rxcli.receiver.light import MIN_VARIANCE
from rxcli.receiver.sync import clock as sync
from rxcli.types import Clock, IntArray, RowProfiles

#: Columns that are enough to rank a hypothesis.
_MAX_BRIGHT = 10


@dataclass(frozen=True)
class Acquisition:
    """A screen whose clock was found."""

    screen: ScreenProfile
    #: Of the screen's columns.
    profiles: RowProfiles
    clock: Clock
    #: The screen, and screens that differ from it only in the number of copies; the copies decide.
    variants: tuple[ScreenProfile, ...]

    @cached_property
    def binned(self) -> RowProfiles:
        """The profiles with strips binned in pairs, for an initial pass."""
        return sync.binned_strips(self.profiles)

    @property
    def repeats(self) -> tuple[int, ...]:
        """Possible numbers of copies of a burst."""
        return tuple(screen.repeats for screen in self.variants)

    def variant(self, repeats: int) -> ScreenProfile:
        """The screen that sends a packet `repeats` times."""
        return next((screen for screen in self.variants if screen.repeats == repeats), self.screen)

    @cached_property
    def bright_columns(self) -> IntArray:
        """Numbers of half of the columns, ten at most, side by side and without the outermost: those of most light."""
        profiles, n_columns = self.profiles, self.screen.columns
        n, start = min(n_columns - 2 * (n_columns // 4), _MAX_BRIGHT), min(n_columns // 4, 1)
        n_inside = np.maximum(profiles.inside.sum(axis=(1, 2)), 1)
        light = ((profiles.light * profiles.inside).sum(axis=(1, 2)) / n_inside)[start : n_columns - start]
        return start + int(np.convolve(light, np.ones(n), "valid").argmax()) + np.arange(n)

    def of_columns(self, part: IntArray | slice) -> Acquisition:
        """The acquisition of some columns."""
        clock = replace(self.clock, delay_slots=self.clock.delay_slots[part])
        return replace(self, profiles=self.profiles.of_columns(part), clock=clock)


def noise_of(profiles: RowProfiles) -> float:
    """Standard deviation of a dark row of a strip."""
    return float(np.sqrt(max(profiles.noise_floor / max(float(np.median(profiles.count)), 1.0), MIN_VARIANCE)))


def distinct_screens(screens: Sequence[ScreenProfile]) -> list[ScreenProfile]:
    """One screen of each group that differs only in the number of copies: the one with the most."""
    return [screen for screen in screens if variants_of(screen, screens)[0] is screen]


def variants_of(screen: ScreenProfile, screens: Sequence[ScreenProfile]) -> tuple[ScreenProfile, ...]:
    """The screen and its variants with other numbers of copies, the one with the most copies first."""
    candidates = reversed((screen, *screens))
    by_repeats = {candidate.repeats: candidate for candidate in candidates if candidate.packets == screen.packets}
    return tuple(by_repeats[repeats] for repeats in sorted(by_repeats, reverse=True))
