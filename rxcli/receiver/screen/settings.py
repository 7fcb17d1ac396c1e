"""The numbers of the search for the screen."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class FinderSettings:
    """What the search for the screen is set to; lengths in column pitches unless a name says otherwise."""

    #: Smallest picture that is searched, pixels each way.
    min_size_px: int = 96
    #: Strips across the picture, the fewest that tell a grid from noise, windows of rows, and strips across each fifth
    #: of a picture with narrow columns.
    n_strips: int = 200
    min_strips: int = 120
    n_windows: int = 16
    n_fifth_strips: int = 150
    #: Rows that are averaged, as a share of the lag at which strips are half as alike as one row apart, least and most;
    #: one of so many strips is asked.
    short_share: float = 0.8
    min_short_rows: int = 2
    max_short_rows: int = 6
    sampled_strips: int = 8
    #: Share of the strips, the least coherent, that show the sensor's row noise; share that shows the stripes best.
    dark_share: float = 0.3
    bright_share: float = 0.2
    #: Kept rows over which light may be correlated, as those of a slot are.
    max_lag: int = 40
    #: Columns are narrow where coherence this many picture widths apart falls below a share of that nearer by.
    near_widths: float = 0.004
    far_widths: float = 0.02
    narrow_ratio: float = 0.6

    #: Columns from which on a screen's are narrow.
    narrow_columns: int = 50
    #: Columns across the picture, or across a fifth of it, and their step; largest turn and changes of pitch across and
    #: along the columns, as shares of the pitch; step of all three at a corner of the picture.
    min_pitch: float = 9.0
    max_pitch: float = 46.0
    pitch_step: float = 0.4
    max_turn: float = 0.12
    max_across: float = 0.2
    max_along: float = 0.3
    corner_step: float = 0.4
    #: Strips that a column has at least.
    min_column_strips: float = 4.0
    #: Distance of the pairs of strips that show the comb of borders best.
    pair_distance: float = 0.72
    #: Combs that are tried as grids.
    n_combs: int = 8
    #: Height of a comb, standard deviations by chance, below which there is none; and contrast of the highest, as a
    #: share of what it explains, from which on no other is tried.
    min_comb: float = 6.0
    plain_contrast: float = 0.15

    #: Weight against waveforms of columns that hardly show, strips.
    ridge: float = 0.5
    #: Steps of the fit come out too short by this, because waveforms follow the grid that they were estimated with.
    step_gain: float = 2.5
    #: Standard deviations beyond which a strip's offset counts less.
    huber_sd: float = 1.0
    #: Standard deviations of perspective and of radial distortion before anything is seen.
    perspective_sd: float = 0.15
    radial_sd: float = 0.004
    #: Weight of the evidence that borders add, against that of the light that waveforms explain.
    contrast_weight: float = 3.0
    #: Steps on every second window, steps of narrow columns at each reach, and last steps on all windows.
    first_steps: int = 3
    narrow_steps: int = 4
    last_steps: int = 2
    #: How much further a grid of narrow columns is followed at a time.
    reach_gain: float = 1.6
    #: Least contrast, as a share of what is explained times the root of the number of rows.
    min_contrast: float = 0.95
    #: Least contrast of narrow columns in the best part of a picture, a share of what is explained.
    min_part_contrast: float = 0.05
    #: Focal length of a camera that no profile describes, picture widths.
    focal_widths: float = 0.8
    #: Gauss-Newton steps by decided slots, and standard deviations of the finder's columns before: shift and widths in
    #: screen widths, and perspective.
    pose_steps: int = 3
    pose_sd: float = 0.005
    pose_tilt_sd: float = 0.02
    #: Share of the light that is nearly all of it.
    nearly_all: float = 0.98
    #: Log-odds against the likeliest first column down to which another is possible.
    min_log_odds: float = -7.0
    #: Log-odds of the next likely one below which the first column is plain, so that the screen's ends help the grid.
    plain_log_odds: float = -3.0


SETTINGS = FinderSettings()
