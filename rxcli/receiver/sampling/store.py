"""Row profiles that were read already: outlines come back while screens, packets and cameras are compared."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.sampling.rows import sample_rows
from rxcli.receiver.sampling.settings import SETTINGS
from rxcli.types import Frame, Outlines, RowProfiles

#: Readings of one frame that are kept: of few and of many columns, quick and in depth, and some for outlines in doubt.
_MAX_READINGS = 4


@dataclass(frozen=True, slots=True)
class _Reading:
    pixels: NDArray[Any]
    tone: str
    quick: bool
    outlines: Outlines
    profiles: RowProfiles


class RowStore:
    """Reads rows of a frame, each outline once; a lens that bends rows alone does not change what is enclosed."""

    def __init__(self) -> None:
        self._readings: list[_Reading] = []

    def sample(
        self,
        frame: Frame,
        outlines: Outlines,
        tone: str,
        *,
        quick: bool = False,
        noise: tuple[float, float] | None = None,
        first_column: int = 0,
    ) -> RowProfiles:
        """As `sample_rows`, from what was read before where that holds these columns.

        Args:
            frame: the picture.
            outlines: where the strips lie.
            tone: the curve to undo.
            quick: linearise means, not pixels, where the frame is coded.
            noise: floor and slope of the noise model, where they are known.
            first_column: number of the first of the outlined columns.
        """
        self._readings = [reading for reading in self._readings if reading.pixels is frame.pixels]
        for reading in self._readings:
            if (reading.tone, reading.quick) == (tone, quick):
                known = _part_of(reading, outlines, first_column)
                if known is not None:
                    floor, slope = noise or (known.noise_floor, known.noise_slope)
                    return replace(known, sensor_row=outlines.sensor_row, noise_floor=floor, noise_slope=slope)
        profiles = sample_rows(frame, outlines, tone, quick=quick, noise=noise)
        if noise is None:
            # Sensor rows are asked anew: they are what a lens changes.
            reading = _Reading(
                frame.pixels, tone, quick, replace(outlines, sensor_row=None), replace(profiles, sensor_row=None)
            )
            self._readings = [*self._readings[-_MAX_READINGS + 1 :], reading]
        return profiles


def _part_of(reading: _Reading, outlines: Outlines, first_column: int) -> RowProfiles | None:
    """Profiles of the outlined columns where a reading has them, None where it does not."""
    n_columns, n_strips, _ = outlines.inside.shape
    columns = slice(first_column, first_column + n_columns)
    known = reading.outlines
    if known.inside.shape[1:] != outlines.inside.shape[1:] or columns.stop > known.inside.shape[0]:
        return None
    edges = known.edges_x[columns.start * n_strips : columns.stop * n_strips + 1]
    same_rows = np.array_equal(known.rows, outlines.rows)
    if not same_rows or float(np.abs(edges - outlines.edges_x).max()) > SETTINGS.same_edges_px:
        return None
    profiles = reading.profiles
    return replace(
        profiles, light=profiles.light[columns], inside=profiles.inside[columns], count=profiles.count[columns]
    )
