"""Settings of the screen finder."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FinderSettings:
    """Settings of the screen finder; lengths in column pitches unless the name has a unit."""

    #: Minimum width and height of a picture, pixels.
    min_size_px: int = 96
    #: Strips across the picture, minimum number of strips, windows of rows, and strips across each fifth of a picture
    #: with narrow columns.
    n_strips: int = 200
    min_strips: int = 120
    n_windows: int = 16
    n_fifth_strips: int = 150
    #: Rows that are averaged, as a share of the lag at which the correlation of neighbouring strips falls to half its
    #: value at lag one; their minimum and maximum; number of pairs of strips used.
    short_share: float = 0.8
    min_short_rows: int = 2
    max_short_rows: int = 6
    sampled_strips: int = 25
    #: Share of the strips, the least coherent, that row noise is estimated from; share with the clearest stripes.
    dark_share: float = 0.3
    bright_share: float = 0.2
    #: Columns are narrow if the coherence at the far distance, picture widths, is below this share of that at the near.
    near_widths: float = 0.004
    far_widths: float = 0.01
    narrow_ratio: float = 0.72
    #: Two screens lie apart if strips between them have less than this share of the light, over this many picture
    #: widths; share of the light that each has, and mean coherence of all strips, at least.
    gap_light: float = 0.25
    min_gap_widths: float = 0.015
    min_apart: float = 0.2
    min_apart_light: float = 0.1

    #: Number of columns from which a screen's columns count as narrow.
    narrow_columns: int = 50
    #: Columns across the picture, or across a fifth of it, and their step; maximum turn and maximum changes of pitch
    #: across and along the columns, as shares of the pitch; step of all three at a corner of the picture.
    min_pitch: float = 9.0
    max_pitch: float = 46.0
    pitch_step: float = 0.4
    max_turn: float = 0.12
    max_across: float = 0.2
    max_along: float = 0.3
    corner_step: float = 0.4
    #: Minimum number of strips per column.
    min_column_strips: float = 4.0
    #: Distance of the pairs of strips that show the comb of borders best.
    pair_distance: float = 0.72
    #: Combs that are tried as grids.
    n_combs: int = 8
    #: Minimum height of a comb, standard deviations by chance; contrast of the highest comb, as a share of the light it
    #: explains, from which no further combs are tried.
    min_comb: float = 6.0
    plain_contrast: float = 0.15

    #: Ridge regularisation of the waveforms of faint columns, in strips.
    ridge: float = 0.5
    #: Gain of a fit's steps: they are too short because the waveforms were estimated with the same grid.
    step_gain: float = 2.5
    #: Prior standard deviations of perspective and of radial distortion.
    perspective_sd: float = 0.15
    radial_sd: float = 0.004
    #: Weight of the log-likelihood that borders add, relative to that of the light that waveforms explain.
    contrast_weight: float = 1.5
    #: Steps on some of the windows, and last steps on all windows.
    first_steps: int = 3
    last_steps: int = 2
    #: Factor by which the followed width of a grid of narrow columns grows at a time.
    reach_gain: float = 1.4
    #: Focal length of a camera that no profile describes, picture widths.
    focal_widths: float = 0.8
    #: Gauss-Newton steps with decided slots, and prior standard deviations of the finder's columns: shift and widths in
    #: screen widths, and perspective.
    pose_steps: int = 3
    pose_sd: float = 0.005
    pose_tilt_sd: float = 0.02
    #: Share of the maximum that counts as all of the light.
    nearly_all: float = 0.98
    #: Log-odds relative to the likeliest first column down to which another one is possible.
    min_log_odds: float = -7.0


SETTINGS = FinderSettings()
