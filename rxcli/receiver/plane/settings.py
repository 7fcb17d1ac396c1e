"""Settings of colours that blink and of row noise, each with its unit and the reason for it."""

import msgspec


class ColourSettings(msgspec.Struct, frozen=True):
    """Numbers of policy by which red that lags is left out."""

    #: Cells across a picture, their width in pixels, and rows of a block, in which each is dark and lit once.
    n_cells: int = 48
    cell_px: int = 12
    block_rows: int = 96
    #: Light of dark slots over that of lit ones up to which red blinks, or hardly counts.
    plain_dark: float = 0.02
    #: Shares of the stripes and of the rows of a picture in which a contrast of red from `plainly` on shows that it
    #: blinks.
    enough_stripes: float = 0.2
    enough_rows: float = 0.2
    plainly: float = 0.75
    #: Red blinks or not, with a contrast of 1 or 0, whichever is nearer; standard errors that exclude the further one.
    middle: float = 0.5
    sure: float = 3.0
    #: Values of a colour, of the largest one, that are too dark to compare, and from which they may be clipped.
    dark: float = 0.01
    clipped: float = 0.98


class RowNoiseSettings(msgspec.Struct, frozen=True):
    """Numbers of policy by which the noise of sensor rows is found."""

    #: Cells across a picture, and their width in pixels.
    n_cells: int = 96
    cell_px: int = 12
    #: Rows over which octaves of changes reach, and over which the light of a cell is level.
    octaves: tuple[int, ...] = (1, 3, 7, 15, 31)
    level_rows: int = 95
    #: Share of a row's changes that all cells have in common where rows are noisy, and share of the rows, in the middle
    #: of the picture, where it is looked for: they are never bent.
    noisy: float = 0.18
    middle: float = 0.1
    #: Cells that are worth one whose slots are independent of all others; part of the slots' power that columns share.
    cells_a_column: float = 5.0
    common: float = 0.5
    #: Distance of rows whose noise has nothing in common, and correlation at it from which light is no noise.
    distance: int = 3
    white: float = 0.3
    #: Rounds of weighting; largest gain of the noise, where a tone curve raises it; minimum power of a cell, of the
    #: usual.
    rounds: int = 4
    max_gain: float = 3.0
    min_power: float = 0.01
    #: Distances of cells that are compared for the bend of rows, lags in rows, bands, and minimum correlation at a lag.
    steps: tuple[int, ...] = (1, 4, 16)
    lags: int = 6
    bands: int = 16
    min_correlation: float = 0.2


COLOUR, ROW_NOISE = ColourSettings(), RowNoiseSettings()
