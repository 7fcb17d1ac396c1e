"""Slots of a frame by the light of its columns, once the picture on the screen is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rxcli.receiver.channel import known_picture
from rxcli.receiver.channel.known_picture import ColumnLight, PlacedPicture
from rxcli.receiver.clip.follow import Pose
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.types import BoolArray, Clock, Float32Array, FloatArray, IntArray


@dataclass(frozen=True)
class Observed:
    """Light of a frame."""

    #: Where it was read; (C, S, R) light of the strips there.
    pose: Pose
    light: Float32Array
    #: The picture as far as it is known before any slot is decided.
    picture: PlacedPicture
    #: Whether the picture was found to have changed.
    changed: bool = False

    @cached_property
    def columns(self) -> ColumnLight:
        """The columns' own light, by the picture."""
        return self.picture.solve(self.light)

    def header_contrast(self, clock: Clock) -> float:
        """Contrast of the headers on a clock, 1 full, 0 none."""
        return known_picture.header_contrast(self.columns, known_picture.row_positions(self.pose.rows, clock), clock)


@dataclass(frozen=True, slots=True)
class Measured:
    """Slots by the light of a frame."""

    clock: Clock
    #: (C, N) log-likelihood ratio of every slot, and (C, 1) squared contrast over variance of a slot.
    llr: Float32Array
    snr: Float32Array
    #: (C, R) light of the columns by the decided slots.
    expected: Float32Array
    #: (C, copies, symbols, n) see `SlotLikelihoods.words`.
    words: Float32Array | None = None


def measured_by(
    observed: Observed, clock: Clock, lit: Float32Array | None, max_misfit: float, isi_memory: int, adapts: bool
) -> Measured | None:
    """Correct clock, response and noise of a frame by its decided slots `lit` (C, N); then likelihoods.

    If it `adapts`, the picture is adapted to the frame by its decided slots. None where the light does not fit the
    decisions: another scene, or something in front of the screen.
    """
    rows, picture, columns = observed.pose.rows, observed.picture, observed.columns
    positions = known_picture.row_positions(rows, clock)
    if lit is None:
        lit = known_picture.first_decision(columns, positions, clock)
    fit = known_picture.fit_response(columns, lit, positions, clock.exposure_slots)
    # Where compression took contrast, noise of the rows is measured by what is expected of this frame.
    if adapts or fit.centre < SETTINGS.faded:
        expected = known_picture.expected_light(lit, positions, clock.exposure_slots, isi_memory, fit)
        if adapts:
            picture = picture.adapted(observed.light, expected.light, clock.rows_per_slot)
        columns = picture.solve_again(observed.light, expected.light, clock.rows_per_slot)
        if adapts:
            lit = known_picture.first_decision(columns, positions, clock)
        fit = known_picture.fit_response(columns, lit, positions, clock.exposure_slots)
    if abs(fit.late) > SETTINGS.late_slots:
        clock = replace(clock, row0=clock.row0 - fit.late * clock.rows_per_slot)
        positions = known_picture.row_positions(rows, clock)
        fit = known_picture.fit_response(columns, lit, positions, clock.exposure_slots)
    expected = known_picture.expected_light(lit, positions, clock.exposure_slots, isi_memory, fit)
    judged = picture.judge(columns, expected.light, max_misfit, SETTINGS.frame_share, clock.rows_per_slot)
    if judged is None:
        return None
    found = known_picture.slot_likelihoods(judged, expected, clock, isi_memory)
    return Measured(clock, found.llr, found.snr, expected.light, found.words)


def shown_slots(inside: BoolArray, positions: FloatArray, clock: Clock) -> IntArray:
    """(n_copies, C, packet) 1 where the middle of a slot is on the screen."""
    on_screen = np.asarray(inside.any(axis=1))
    columns = np.arange(on_screen.shape[0]) % positions.shape[0]
    start = positions[columns, on_screen.argmax(axis=1)][:, None]
    end = positions[columns, on_screen.shape[1] - 1 - on_screen[:, ::-1].argmax(axis=1)][:, None]
    middles = np.arange(clock.n_slots) + 0.5
    shown = (middles >= start) & (middles <= end) & np.asarray(on_screen.any(axis=1))[:, None]
    return np.asarray(clock.to_copies(shown.astype(np.float32)), np.int64).transpose(1, 0, 2)
