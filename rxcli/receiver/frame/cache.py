"""A frame with the plane that was read of it and the row profiles that were sampled from the plane."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from rxcli.receiver.frame.timer import Timer
from rxcli.receiver.plane.colour import in_blinking_colours, may_lag, red_contrast
from rxcli.receiver.plane.read import read_plane
from rxcli.receiver.plane.row_noise import RowNoise, find_row_noise, without_row_noise
from rxcli.receiver.plane.rows import sample_rows, strips_per_column
from rxcli.receiver.screen import geometry
from rxcli.types import Float32Array, FloatArray, Frame, Lens, LightPlane, Metadata, Outlines, RowProfiles

_Found = TypeVar("_Found")
#: Cached row profiles: of layouts with few and with many columns, and of uncertain outlines; and cached outlines.
_MAX_SAMPLED, _MAX_OUTLINES = 6, 12


def key_of(lens: Lens | None) -> Hashable:
    """A key that is equal for lenses with the same distortion."""
    return lens and (lens.camera_matrix.tobytes(), lens.dist_coeffs.tobytes(), lens.corrected)


class FrameCache:
    """Reads a frame once, and samples each outline once while screens, packets and cameras are compared.

    Args:
        frame: the picture.
        timer: counts the time of each stage; a new one if left out.
    """

    def __init__(self, frame: Frame, timer: Timer | None = None) -> None:
        self.frame, self.timer = frame, timer or Timer()
        self._sampled: list[tuple[str, Float32Array, RowProfiles]] = []
        self._outlines: dict[tuple[Any, ...], Outlines] = {}
        self._found: dict[Hashable, Any] = {}

    def in_blinking_colours(self) -> FrameCache:
        """The same picture, in green and blue alone if its red lags behind the slots."""
        with self.timer("geometry"):
            share = may_lag(self.plane)
            contrast = red_contrast(self.frame, share, self._read[1]) if share else None
            frame = in_blinking_colours(self.frame, contrast)
        return self if frame is self.frame else FrameCache(frame, self.timer)

    def with_metadata(self, metadata: Metadata) -> FrameCache:
        """The same picture with other metadata; what was read of it is kept."""
        changed = copy(self)
        changed.frame = replace(self.frame, metadata=metadata)
        return changed

    def once(self, key: Hashable, find: Callable[[], _Found]) -> _Found:
        """What `find` finds on the plane, which no metadata change; it is called once for a key."""
        if key not in self._found:
            self._found[key] = find()
        found: _Found = self._found[key]
        return found

    @cached_property
    def plane(self) -> LightPlane:
        """The plane of the frame, without the noise of its rows."""
        return self._read[0]

    @cached_property
    def _read(self) -> tuple[LightPlane, RowNoise | None]:
        plane = read_plane(self.frame)
        noise = find_row_noise(plane)
        return plane if noise is None else without_row_noise(plane, noise), noise

    def outlines(self, corners: FloatArray, n_columns: int, lens: Lens | None) -> Outlines:
        """Outlines of the strips of a screen's columns; as many strips as its pixels allow."""
        key = (corners.tobytes(), n_columns, key_of(lens))
        found = self._outlines.pop(key, None)  # and entered again, as the last one used
        if found is None:
            n_strips = strips_per_column(float(np.linalg.norm(corners[1] - corners[0])) / n_columns)
            found = geometry.column_outlines(corners, n_columns, n_strips, self.frame.width, self.frame.height, lens)
            if len(self._outlines) >= _MAX_OUTLINES:
                del self._outlines[next(iter(self._outlines))]
        self._outlines[key] = found
        return found

    def sample(self, outlines: Outlines, tone: str) -> RowProfiles:
        """Cached `sample_rows`; sensor rows are those of `outlines`, as a lens model may change them alone."""
        for place, (known_tone, edges, profiles) in enumerate(self._sampled):
            same = known_tone == tone and profiles.light.shape == outlines.inside.shape
            same = same and edges[0, 0] == outlines.edges_x[0, 0] and np.array_equal(profiles.rows, outlines.rows)
            if same and np.array_equal(edges, outlines.edges_x):
                self._sampled.append(self._sampled.pop(place))  # as the last one used
                return replace(profiles, sensor_row=outlines.sensor_row)
        profiles = replace(sample_rows(self.plane, outlines, tone), has_row_noise=self._read[1] is not None)
        self._sampled = [*self._sampled[-_MAX_SAMPLED + 1 :], (tone, outlines.edges_x, profiles)]
        return profiles
