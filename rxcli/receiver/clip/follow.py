"""Where the strips of a screen are read in every frame of a clip, and where the picture on it is."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.profiles import ScreenProfile
from rxcli.receiver.clip.place import ScreenPlace
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.light import Crosstalk
from rxcli.receiver.plane import tracked
from rxcli.receiver.plane.rows import strips_per_column, tone_to_light
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.registration import Registration, ScreenTexture
from rxcli.types import BoolArray, Float32Array, FloatArray, Frame, Outlines


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Where the light of a screen is read in a frame, and where its picture is."""

    #: (4, 2) pixels each, the viewer's top-left first.
    read: FloatArray
    picture: FloatArray
    map: tracked.StripMap
    #: The strips on whose rows the picture is known.
    home: tracked.StripMap
    #: Of the strips where they are read.
    crosstalk: Crosstalk
    #: (C, R) row of the known picture at each row of the frame; None where the screen is where it was first.
    picture_row: Float32Array | None = None
    #: Columns by which the strips lie to the right of their places, and whole strips by which the picture has moved to
    #: the right on the screen.
    offset: float = 0.0
    shift: int = 0

    @property
    def rows(self) -> FloatArray:
        """(R,) sensor rows that are read."""
        return self.map.rows


class Follower:
    """Follows a screen by the texture of its picture, and by its columns.

    Args:
        context: the frame that it begins with.
        screen: the columns.
        tails: of the crosstalk.
        log_odds: that the picture moves on the screen.
        named: whether the user gave the corners.
        unsure_rows: rows at the top and at the bottom of the outline that may not be on the screen.
    """

    def __init__(
        self,
        context: FrameContext,
        screen: ScreenProfile,
        tails: float,
        log_odds: float,
        named: bool,
        unsure_rows: tuple[int, int] | None,
    ) -> None:
        frame, corners, tone = context.frame, context.sampled_corners, context.camera.tone
        self._lens, self._screen, self._tails, self._named = context.camera.lens, screen, tails, named
        column_px = float(np.linalg.norm(corners[1] - corners[0])) / screen.columns
        self.n_strips = min(strips_per_column(column_px), SETTINGS.max_strips)
        self._end_rows = unsure_rows or (SETTINGS.end_rows, SETTINGS.end_rows)
        outlines = self._outlines(frame, corners, are_ends_cut=unsure_rows is not None)
        strips = tracked.map_strips(outlines, frame, lambda coded: tone_to_light(tone, coded))
        #: Where the screen is, and where the strips are read; the picture is known on the rows where it was first.
        self.place = ScreenPlace.at(corners, screen.columns, self._lens, log_odds)
        self.pose = self.origin = Pose(corners, corners, strips, strips, self._crosstalk_at(0.0))
        self._texture = ScreenTexture(frame, corners, self._lens)
        #: Searches in a row that found the screen where it was, and frames since the last one.
        self._n_rested = self._n_unlooked = 0

    def rests(self) -> bool:
        """Whether the screen is taken to be where it was in the next frame, for some frames in a row."""
        self._n_unlooked += 1
        return self._n_rested >= SETTINGS.still_looks and self._n_unlooked < SETTINGS.look_every

    def find(self, frame: Frame) -> Registration | None:
        """Find where the screen is in a frame, by the picture on it; None if it shows another picture."""
        self._n_unlooked = 0
        found = self._texture.find(frame)
        if not found.fits and (self.place.is_film or (found.is_precise and not self._named)):
            return None
        if (self._named and not found.is_precise) or _is_still(found.corners - self.pose.picture, found.sd_px):
            found = replace(found, corners=self.pose.picture)
            self._n_rested += 1
        else:
            self.place = self.place.after(self.pose.picture, found.corners)
            self.move(frame, found)
            self._n_rested = 0
        self._texture.learn(frame, found)
        return found

    def move(self, frame: Frame, found: Registration) -> None:
        """Move the strips to the screen, near whole strips of the picture on it."""
        origin, at, n_columns = self.origin, self.place.likelier, self._screen.columns
        moved = float(self.place.off(found.corners, at).mean())
        shift = round(moved * self.n_strips)
        offset = moved - shift / self.n_strips
        read = geometry.beside(at.corners, offset / n_columns, self._lens)
        strips = tracked.moved_map(origin.map, self._outlines(frame, read, are_ends_cut=True))
        row = self._rows_between(strips.rows, found.corners, origin.picture, shift) - np.float32(origin.map.first_row)
        self.pose = Pose(read, found.corners, strips, origin.map, self._crosstalk_at(offset), row, offset, shift)

    def frame_row(self, pose: Pose) -> Float32Array | None:
        """(C, P) row of a frame at each row of the picture; None where the screen is where it was first."""
        if pose.picture_row is None:
            return None
        rows = self._rows_between(self.origin.rows, self.origin.picture, pose.picture, pose.shift)
        return rows - np.float32(pose.map.first_row)

    def slope(self) -> Float32Array:
        """(S, 3) change of the crosstalk with the place of the strips, per column."""
        step = 1 / 16 / self.n_strips
        near, far = (self._crosstalk_at(self.pose.offset + each).shares for each in (-step, step))
        return ((far - near) / (2 * step)).astype(np.float32)

    def measured(self, off: FloatArray, covariance: FloatArray) -> None:
        """Correct the screen's place: its left and right (2,) lie `off` columns beside where they were read."""
        self.place = self.place.measured(self.pose.read, self.pose.offset + off, covariance)

    def _rows_between(self, rows: FloatArray, here: FloatArray, there: FloatArray, shift: int) -> Float32Array:
        """(C, R) rows of a picture at corners `there` (4, 2) at the rows of one at corners `here`."""
        return geometry.rows_elsewhere(rows, self._middles(here, shift), self._middles(there, shift))

    def _middles(self, corners: FloatArray, shift: int) -> FloatArray:
        """Rows down the middles of the columns that a picture at `corners` has under it, moved by some strips."""
        n_columns = self._screen.columns
        under = geometry.beside(corners, -shift / (n_columns * self.n_strips), self._lens)
        return geometry.column_middles(under, n_columns, self._lens)

    def _outlines(self, frame: Frame, corners: FloatArray, *, are_ends_cut: bool) -> Outlines:
        n_columns, size = self._screen.columns, (frame.width, frame.height)
        outlines = geometry.column_outlines(corners, n_columns, self.n_strips, *size, self._lens)
        return replace(outlines, inside=_without_ends(outlines.inside, *self._end_rows)) if are_ends_cut else outlines

    def _crosstalk_at(self, offset: float) -> Crosstalk:
        """Crosstalk of strips that lie `offset` columns to the right of their places."""
        return Crosstalk.of(self.n_strips, self._screen.light_spread, self._tails, offset)


def _without_ends(inside: BoolArray, top: int, bottom: int) -> BoolArray:
    """(C, S, R) strips on the screen, without some rows at its ends, where the corners' error may reach."""
    left = np.zeros_like(inside)
    left[..., top:-bottom] = inside[..., top + bottom :] & inside[..., : -top - bottom]
    return left


def _is_still(moved: FloatArray, sd_px: float) -> bool:
    """Whether corners (4, 2) that seem to have moved may be where they were."""
    shift, each = np.abs(moved.mean(axis=0)).max(), float(np.sqrt(np.square(moved).mean()))
    return bool(
        shift < max(SETTINGS.still_px, SETTINGS.still_sds * sd_px / 2)
        and each < max(SETTINGS.still_px, SETTINGS.still_sds * sd_px)
    )
