"""Red that lags: the phosphors of many backlights go on glowing for milliseconds, so that red does not blink.

Such a picture is read from green and blue alone. Differences between neighbouring rows decide it: relative to the
light, they are as large in red as in green, or red has none. Stripes are wider than a cell of pixels, so that noise is
left out by comparing with green in the cells beside.
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rxcli.receiver.plane.row_noise import RowNoise
from rxcli.receiver.plane.rows import light_of, tone_to_light
from rxcli.receiver.plane.settings import COLOUR
from rxcli.types import Float32Array, Frame, LightPlane, Mosaic

#: Gain of a colour of the mosaic that is left out.
_LEFT_OUT = float("inf")


def may_lag(plane: LightPlane) -> float:
    """Share of a picture's rows, from the top, that is enough to see whether red lags.

    They show a part of the stripes, and so not the texture above the screen alone. 0 where the dark slots leave less
    luma than red that lags.
    """
    n_cells = len(plane.sums) - 1
    width, n_blocks = max(COLOUR.cell_px // plane.cell_px, 1), plane.height // COLOUR.block_rows
    if n_cells < width or not n_blocks:
        return 0.0
    left = np.linspace(0, n_cells - width, COLOUR.n_cells).astype(int)
    rows = slice(n_blocks * COLOUR.block_rows)
    values = (plane.sums[left + width, rows] - plane.sums[left, rows]) / np.float32(width * plane.cell_px)
    blocks = light_of(plane, values, "srgb").reshape(COLOUR.n_cells, n_blocks, -1)
    dark, lit = blocks.min(axis=2), np.maximum(blocks.max(axis=2), np.float32(COLOUR.plain_dark**2))
    if np.median((dark / lit)[lit >= np.median(lit)]) <= COLOUR.plain_dark:
        return 0.0
    steps = np.diff(values)
    stripes = np.maximum((steps[1:] * steps[:-1]).sum(axis=0), 0).cumsum()
    share = float(np.searchsorted(stripes, COLOUR.enough_stripes * stripes[-1]) + COLOUR.block_rows) / plane.height
    return max(share, COLOUR.enough_rows)


def in_blinking_colours(frame: Frame, contrast: tuple[float, float] | None) -> Frame:
    """The frame in green and blue alone if its `red_contrast` shows that red lags, else as it is."""
    if contrast is None or contrast[0] > COLOUR.middle:
        return frame
    if frame.mosaic is not None:
        return replace(frame, mosaic=replace(frame.mosaic, gains=(_LEFT_OUT, 1.0, _LEFT_OUT)), red_contrast=contrast)
    pixels = frame.pixels if frame.colours is None else frame.colours.without_red()
    return replace(frame, pixels=pixels, red_contrast=contrast) if pixels.shape == frame.pixels.shape else frame


def in_one_mix(frames: Iterable[Frame]) -> Iterator[Frame]:
    """The frames of a clip in the colours that blink in its first frame with slots."""
    contrast = None
    for frame in frames:
        contrast = contrast or red_contrast(frame)
        yield in_blinking_colours(frame, contrast)


def red_contrast(frame: Frame, share: float = 1.0, noise: RowNoise | None = None) -> tuple[float, float] | None:
    """Contrast of the slots in red relative to green, with its standard deviation.

    None if neither light that blinks nor light that does not is ruled out: without colours, or without slots. If this
    share of a picture's rows shows that red blinks, the others are not read. Noise of rows is in both colours.
    """
    if frame.mosaic is not None:
        return _contrast(_thinned(frame, frame.mosaic), noise)
    if frame.colours is None:
        return None
    if noise is None and share < 1 and frame.colours.first_rows is not None:
        of_part = _contrast(frame.colours.first_rows(share))
        if of_part is not None and of_part[0] > COLOUR.plainly:
            return of_part
    thinned: NDArray[np.floating] = frame.colours.thinned()
    if noise is not None and not frame.linear:
        thinned = tone_to_light("srgb", thinned.astype(np.float64))
    return _contrast(thinned, noise)


def _contrast(thinned: NDArray[np.floating], noise: RowNoise | None = None) -> tuple[float, float] | None:
    if thinned.shape[1] < COLOUR.n_cells or len(thinned) < 2:
        return None
    import cv2

    cells = cv2.resize(thinned, (COLOUR.n_cells, len(thinned)), interpolation=cv2.INTER_AREA)
    if noise is not None:
        x = (np.arange(COLOUR.n_cells) + 0.5) / COLOUR.n_cells - 0.5
        cells = np.stack([noise.removed(np.ascontiguousarray(colour.T), x).T for colour in np.moveaxis(cells, 2, 0)], 2)
    mean = (cells[1:] + cells[:-1]) / 2
    red, green, _ = np.moveaxis(np.diff(cells, axis=0) / np.maximum(mean, COLOUR.dark), 2, 0)
    faintest, brightest = mean[..., :2].min(axis=-1), np.maximum(cells[1:], cells[:-1]).max(axis=-1)
    weight = np.square(faintest) * (faintest > COLOUR.dark) * (brightest < COLOUR.clipped)
    beside = np.zeros_like(green)
    beside[:, 1:] += green[:, :-1]
    beside[:, :-1] += green[:, 1:]
    shared, own = (np.einsum("rc,rc,rc->c", weight, values, beside) for values in (red, green))
    total = float(own.sum())
    if total <= 0:
        return None
    contrast = float(shared.sum()) / total
    error = float(np.sqrt(np.square(shared - contrast * own).sum())) / total
    return (contrast, error) if COLOUR.middle + abs(contrast - COLOUR.middle) > COLOUR.sure * error else None


def _thinned(frame: Frame, mosaic: Mosaic) -> Float32Array:
    """(rows, cells, 3) mean of every colour of a mosaic, in cells of one period's rows, 0 black to 1 white."""
    period, width = mosaic.pattern.shape
    n_rows, n_pixels = frame.height // period, max(COLOUR.cell_px // width, 1) * width
    cells = []
    for left in np.linspace(0, (frame.width - n_pixels) // width, COLOUR.n_cells).astype(int) * width:
        part = frame.pixels[: n_rows * period, left : left + n_pixels].reshape(n_rows, period, -1, width)
        by_place = part.mean(axis=2, dtype=np.float32)
        cells.append([by_place[:, mosaic.pattern == colour].mean(axis=1) for colour in range(3)])
    black = np.array(mosaic.black, np.float32)
    return np.asarray((np.array(cells, np.float32).transpose(2, 0, 1) - black) / (mosaic.white - black), np.float32)
