"""Settings of the registration of clips, each with its unit and the reason for it."""

import msgspec


class ScreenSettings(msgspec.Struct, frozen=True):
    """Numbers of policy of the registration of a clip's frames by the texture of the screen.

    A screen's size is its width, or the width that its height implies.
    """

    #: Cells down and across the screen whose texture is known; cells of a coarse cell down and across, and smoothing of
    #: the coarse texture in such cells; minimum number of rows read in a cell.
    cells: tuple[int, int] = (108, 360)
    coarse: tuple[int, int] = (2, 4)
    coarse_blur: float = 0.8
    rows_read: int = 3
    #: Screen sizes around the expected screen that are searched; share of the size beyond its sides that is texture:
    #: the sides help to locate it.
    reach: float = 0.06
    margin: float = 0.02
    #: Cells across over whose mean light is texture.
    neighbours: int = 7
    #: Standard deviation of a cell's light, as a share of white, against that of the stripes that remain in the
    #: texture; least light that divides it, of white; percentile of the light that a dark column shows.
    noise_ratio: float = 0.11
    min_light: float = 1e-4
    dark_percent: float = 8.0
    #: Power of the noise of a gradient of the texture; cells around over which both are averaged.
    gradient_noise: float = 0.0042
    local_cells: int = 15
    #: Steps of a fit at most, and motion of the corners, cells, after which it ends. Fine detail makes a whole
    #: Gauss-Newton step too long.
    max_steps: int = 8
    converged: float = 0.2
    step_share: float = 0.7
    #: Standard deviations beyond which a cell is an outlier: a hand, a reflection.
    outlier: float = 2.5
    #: Number of neighbouring cells whose errors are fully correlated, as those of the stripes that remain.
    correlated_cells: float = 8.0
    #: Standard deviations of a prediction in screen sizes: shift, affine modes, perspective modes.
    shift_sd: float = 0.008
    affine_sd: float = 0.0027
    perspective_sd: float = 0.0004
    #: Maximum standard deviation of the corners in screen sizes, and minimum correlation of the textures, of a certain
    #: position.
    max_sd: float = 0.0012
    min_correlation: float = 0.35
    #: Interval of updates of the texture after as many first ones, and maximum weight of the earlier ones, frames.
    learn_every: int = 8
    max_weight: float = 40.0


SETTINGS = ScreenSettings()
