"""Sampled columns, and the acquired screen with its clock. Part of the wiring."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rxcli.profiles import ScreenProfile
from rxcli.receiver import camera as blind
from rxcli.receiver import sampling, sync
from rxcli.receiver.context import FrameContext
from rxcli.receiver.screen import geometry
from rxcli.receiver.sync.settings import SETTINGS as sync_settings
from rxcli.types import Clock, FloatArray, IntArray, RowProfiles


@dataclass(frozen=True, slots=True)
class ColumnSampler:
    """Row profiles of a screen's columns, and a function that reads more of them."""

    profiles: RowProfiles
    #: Whether strips were read in pairs, as for an initial pass.
    is_binned: bool = False
    #: Reads all strips of some columns pixel by pixel, given the noise model; None if the profiles are complete.
    read: Callable[[slice, tuple[float, float]], RowProfiles] | None = None

    @property
    def n_binned_strips(self) -> int:
        """Strips of a column in the initial pass, see `sync.binned_strips`."""
        n_strips: int = self.profiles.light.shape[1]
        return n_strips if self.is_binned or n_strips % 2 else n_strips // 2

    def binned(self) -> RowProfiles:
        """The profiles with strips binned in pairs."""
        return self.profiles if self.is_binned else sync.binned_strips(self.profiles)

    def in_depth(self, columns: NDArray[np.int64]) -> ColumnSampler:
        """Read some columns pixel by pixel, strip by strip."""
        if self.read is None or not columns.size:
            return self
        every = sync.unbinned_strips(self.profiles) if self.is_binned else self.profiles
        names = [name for name in ("light", "inside", "count", "sensor_row") if getattr(every, name) is not None]
        arrays = {name: getattr(every, name).copy() for name in names}
        for run in np.split(columns, np.flatnonzero(np.diff(columns) > 1) + 1):
            part = slice(int(run[0]), int(run[-1]) + 1)
            read = self.read(part, (every.noise_floor, every.noise_slope))
            for name, array in arrays.items():
                array[part] = getattr(read, name)
        return ColumnSampler(replace(every, **arrays), read=self.read)


@dataclass(frozen=True, slots=True)
class Acquisition:
    """A screen whose clock was found."""

    screen: ScreenProfile
    sampler: ColumnSampler
    clock: Clock
    #: The screen, and screens that differ from it only in the number of copies; the copies decide.
    variants: tuple[ScreenProfile, ...] = ()
    #: (n_copies,) burst of every copy; None if it is still to be estimated.
    burst: IntArray | None = None

    @property
    def profiles(self) -> RowProfiles:
        return self.sampler.profiles

    @property
    def repeats(self) -> tuple[int, ...]:
        """Possible numbers of copies of a burst."""
        return tuple(screen.repeats for screen in self.variants) or (self.screen.repeats,)

    def variant(self, repeats: int) -> ScreenProfile:
        """The screen that sends a packet `repeats` times."""
        return next((screen for screen in self.variants if screen.repeats == repeats), self.screen)

    def binned(self) -> Acquisition:
        """The acquisition with strips binned in pairs."""
        return replace(self, sampler=ColumnSampler(self.sampler.binned(), is_binned=True))

    def middle(self) -> Acquisition:
        """The acquisition of the middle half of the columns."""
        n_columns, profiles, rows = self.screen.columns, self.profiles, self.profiles.sensor_row
        part = slice(n_columns // 4, n_columns - n_columns // 4)
        middle = replace(
            profiles,
            light=profiles.light[part],
            inside=profiles.inside[part],
            count=profiles.count[part],
            sensor_row=None if rows is None else rows[part],
        )
        clock = replace(self.clock, delay_slots=self.clock.delay_slots[part])
        return replace(self, sampler=ColumnSampler(middle, self.sampler.is_binned), clock=clock)

    def as_one_column(self) -> Acquisition:
        """The acquisition with every column as a strip of a single one."""
        profiles, rows = self.profiles, self.profiles.sensor_row
        weight = profiles.inside.astype(np.float32)
        light = (profiles.light * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1)
        strips = replace(
            profiles,
            light=np.asarray(light[None], np.float32),
            inside=np.any(profiles.inside, axis=1)[None],
            count=np.asarray(profiles.count.sum(axis=1)[None], np.float32),
            sensor_row=None if rows is None else rows.mean(axis=1)[None],
        )
        clock = replace(self.clock, delay_slots=np.zeros(1))
        return replace(self, sampler=ColumnSampler(strips, is_binned=True), clock=clock)

    def in_depth(self, columns: NDArray[np.int64]) -> Acquisition:
        """Read some columns pixel by pixel, strip by strip."""
        sampler = self.sampler.in_depth(columns)
        return self if sampler is self.sampler else replace(self, sampler=sampler)


def n_strips_of(corners: FloatArray, n_columns: int) -> int:
    """Number of lateral strips of a column, from its width."""
    return sampling.strips_per_column(float(np.linalg.norm(corners[1] - corners[0])) / n_columns)


def sample_columns(context: FrameContext, n_columns: int, *, quick: bool = False) -> ColumnSampler:
    """Sample the row profiles of a screen of `n_columns` columns in order of time.

    With `quick`, columns of developed pictures are read pixel by pixel only on request, see `ColumnSampler.in_depth`.
    """
    frame, camera = context.frame, context.camera
    quick = quick and sampling.is_coded(frame)
    n_strips = n_strips_of(context.corners, n_columns)
    is_binned = quick and n_strips >= sync_settings.min_binned_strips and n_strips % 2 == 0

    def read(
        columns: slice, noise: tuple[float, float] | None, n_strips: int = n_strips, quick: bool = False
    ) -> RowProfiles:
        outlines = geometry.column_outlines(
            context.corners, n_columns, n_strips, frame.width, frame.height, camera.lens, columns
        )
        profiles = context.timer.rows.sample(
            frame, outlines, camera.tone, quick=quick, noise=noise, first_column=columns.start
        )
        return blind.in_time_order(profiles, frame.height) if camera.reversed else profiles

    with context.timer("sampling"):
        profiles = read(slice(0, n_columns), None, n_strips // 2 if is_binned else n_strips, quick)
    return ColumnSampler(profiles, is_binned, read if quick else None)


def noise_of(profiles: RowProfiles) -> float:
    """Standard deviation of a dark row of a strip."""
    return float(np.sqrt(profiles.noise_floor / max(float(np.median(profiles.count)), 1.0)))


def distinct_screens(screens: Sequence[ScreenProfile]) -> list[ScreenProfile]:
    """One screen of each group that differs only in the number of copies: the one with the most."""
    return [screen for screen in screens if variants_of(screen, screens)[0] is screen]


def variants_of(screen: ScreenProfile, screens: Sequence[ScreenProfile]) -> tuple[ScreenProfile, ...]:
    """The screen and its variants with other numbers of copies, the one with the most copies first."""
    candidates = reversed((screen, *screens))
    by_repeats = {candidate.repeats: candidate for candidate in candidates if _shape(candidate) == _shape(screen)}
    return tuple(by_repeats[repeats] for repeats in sorted(by_repeats, reverse=True))


def _shape(screen: ScreenProfile) -> tuple[float, int, int]:
    return screen.slot_rate_hz, screen.packet_slots, screen.columns
