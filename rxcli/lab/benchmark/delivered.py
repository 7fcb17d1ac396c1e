"""The bound on the delivered picture: what is left in the developed file for a genie.

The genie of `lab.simulate.bound` decides from the sensor's electrons. This one is handed the file that the receiver
is handed, read as the receiver reads it (linear light of the strips of every column, row by row), and knows outline,
clock, picture, light spread and all other slots. The picture comes from the simulator: the same scene without noise,
all columns lit. A gain for every column and an offset for every strip are fitted to the file, because its white, room
light and vignetting are not the simulator's; how much of the file's light is then explained is told, and where that is
little, the genie does not know the picture and the figure is no bound.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from rxcli.lab.simulate.bound import Oracle
from rxcli.lab.simulate.camera import Exposure, bands, render_band
from rxcli.lab.simulate.isp import Isp, correct_distortion, luma, tone_curve
from rxcli.lab.simulate.transmitter import Link, light_spread
from rxcli.receiver import sampling
from rxcli.receiver.screen import geometry
from rxcli.types import Float32Array, FloatArray, Frame, Lens, Outlines, RowProfiles

if TYPE_CHECKING:
    from rxcli.lab.simulate.isp import Tone

#: Slots over which gain and offset of the picture are fitted.
_FIT_SLOTS = 150
#: Columns whose light a strip sees, counted from its own.
_OFFSETS = np.arange(-3, 4)
#: Rows on which the shares of the columns' light are computed.
_KNOTS = 65
#: Shares of the full light at which the strips' light is known, clipped pixels and all.
_LEVELS = np.array([0.25, 0.5, 0.75, 1.0], np.float32)
#: Steps, in slots, in which the start of the clock is sought, coarse and fine.
_COARSE_STEP, _FINE_STEP = 0.25, 0.02
#: One row in so many slots is looked at while the clock is sought.
_ROWS_PER_SLOT = 4.0
#: Slots over which the noise is measured, and the least variance of a strip's row: an eighth of a grey level, squared.
_NOISE_SLOTS = 40
_LEAST_VARIANCE = (0.125 / 255) ** 2 / 12.92**2


@dataclass(frozen=True, slots=True)
class Delivered:
    """What the file says to one who knows nearly everything."""

    oracle: Oracle
    #: Share of the variance of the file's light that the known picture explains, 0..1.
    explained: float
    #: Mean linear light of the screen, white is 1.
    light: float


class _AlwaysLit(Link):
    """A link all of whose columns are lit all the time."""

    def slots(self, first: int, stop: int) -> NDArray[np.uint8]:
        """(columns, stop - first) ones."""
        return np.ones((self.screen.columns, stop - first), np.uint8)


def delivered(
    frame: Frame,
    exposure: Exposure,
    isp: Isp,
    corners: FloatArray,
    lens: Lens | None,
    starts: tuple[float, float] | None = None,
) -> Delivered:
    """The genie's statistics of a developed file.

    Args:
        frame: the file as it was read.
        exposure: the scene that it shows, sent slots included.
        isp: how the file was developed: tone curve, and whether its distortion was corrected.
        corners: (4, 2) of the screen on the stored picture.
        lens: of the stored picture.
        starts: first and last slot at which row 0 may have begun: the one at which the file's light agrees best with
            what was sent is taken; None: the exposure knows it.
    """
    outlines = _outlines(corners, exposure.link.screen.columns, frame, lens)
    profiles = sampling.sample_rows(frame, outlines, _tone(isp))
    return _Known(exposure, isp, outlines, profiles, starts).delivered()


def _outlines(corners: FloatArray, n_columns: int, frame: Frame, lens: Lens | None) -> Outlines:
    column_px = float(np.linalg.norm(corners[1] - corners[0])) / n_columns
    n_strips = sampling.strips_per_column(column_px)
    return geometry.column_outlines(corners, n_columns, n_strips, frame.width, frame.height, lens)


def _tone(isp: Isp) -> str:
    return isp.tone if isp.tone in ("linear", "bt709") else "srgb"


def full_light(exposure: Exposure, isp: Isp) -> NDArray[np.uint16]:
    """The developed picture without noise and room light, all columns lit; (height, width) uint16, linear luma.

    Luma is taken after the tone curve, as in a file, and made linear again: that is how colours weigh in it. It is
    scaled to the whole range of its numbers.
    """
    sensor = replace(exposure.sensor, cfa="rgb")
    room = replace(exposure.room, light_e_per_s=0.0)
    link = exposure.link
    always = _AlwaysLit(link.screen, link.weights, link.seed, link.message)
    lit = replace(exposure, sensor=sensor, room=room, link=always)
    to_panel = np.linalg.inv(sensor.colour_matrix).astype(np.float32)
    light = np.empty((sensor.height, sensor.width), np.float32)
    for top, bottom in bands(sensor.height):
        light[top:bottom] = _effective_luma(render_band(lit, top, bottom).mean_e, to_panel, isp.tone)
    if isp.correct_distortion:
        light = correct_distortion(light, exposure.view)
    return np.asarray(np.rint(light * np.float32(65535 / max(float(light.max()), 1e-9))), np.uint16)


def _effective_luma(mean_e: Float32Array, to_panel: Float32Array, tone: Tone) -> Float32Array:
    """(rows, width) linear light of what the luma of coloured electrons (rows, width, 3) stands for."""
    import cv2

    planes = np.maximum(cv2.transform(mean_e, to_panel), 0)
    top = np.maximum(planes.max(axis=2), np.float32(1e-6))
    coded = luma(tone_curve(planes / top[..., None], tone))
    back = sampling.tone_to_light("srgb" if tone == "gamma" else tone, coded.astype(np.float64))
    return np.asarray(back * top, np.float32)


class _Known:
    """A file's strips, and what the genie knows of them."""

    def __init__(
        self,
        exposure: Exposure,
        isp: Isp,
        outlines: Outlines,
        profiles: RowProfiles,
        starts: tuple[float, float] | None,
    ) -> None:
        self._exposure = exposure
        self._profiles = profiles
        self._outlines = outlines
        shape = profiles.light.shape
        rows = outlines.rows.astype(np.float64)
        self._sensor_rows = np.broadcast_to(rows, shape) if outlines.sensor_row is None else outlines.sensor_row
        self._shares = _shares(exposure, outlines, isp.correct_distortion)
        slots_per_row = exposure.sensor.line_delay_s * exposure.slot_rate_hz
        self._window = round(_FIT_SLOTS / slots_per_row)
        self._step = max(round(1 / (slots_per_row * _ROWS_PER_SLOT)), 1)
        full = full_light(exposure, isp)
        linear = self._sampled(full)
        self._curve: Float32Array = np.stack([linear * level for level in _LEVELS])
        if starts is not None:
            self._exposure = replace(exposure, start_slot=self._best_start(*starts))
        self._curve = self._clipped(full)

    def _clipped(self, full: NDArray[np.uint16]) -> Float32Array:
        """(levels, C, S, R) light of the strips at `_LEVELS` of the full light, pixels clipped where the file's are."""
        fit = self._fitted(self._expected(self._lit_shares(self._exposure)))
        cap = 65535 * float((1 - np.median(fit.offset)) / max(float(np.median(fit.gain)), 1e-9))
        curve = [
            self._sampled(np.minimum(full, min(cap / level, 65535)).astype(np.uint16)) * level for level in _LEVELS
        ]
        return np.asarray(np.stack(curve), np.float32)

    def _sampled(self, picture: NDArray[np.uint16]) -> Float32Array:
        return sampling.sample_rows(
            Frame(picture, "full light", white=65535.0, linear=True), self._outlines, "linear"
        ).light

    def _best_start(self, low: float, high: float) -> float:
        """The start of the clock at which the known picture explains most of the light."""
        coarse = self._best_of(np.arange(low, high + _COARSE_STEP, _COARSE_STEP))
        return self._best_of(coarse + np.arange(-_COARSE_STEP, _COARSE_STEP + _FINE_STEP, _FINE_STEP))

    def _best_of(self, starts: FloatArray) -> float:
        some = slice(None, None, self._step)
        inside = self._profiles.inside[..., some]
        left = []
        for start in starts:
            expected = self._expected(self._lit_shares(replace(self._exposure, start_slot=float(start)), some), some)
            fit = self._fitted(expected, some)
            left.append(float((self._residual(expected, fit, some)[inside] ** 2).sum()))
        return float(starts[int(np.argmin(left))])

    def _lit_shares(self, exposure: Exposure, some: slice = slice(None)) -> Float32Array:
        """(C, S, R) share of the full light that the sent slots give the strips."""
        lit = self._lit(exposure, some)
        return np.asarray((self._shares[..., some] * lit).sum(axis=0), np.float32)

    def _lit(self, exposure: Exposure, some: slice = slice(None)) -> Float32Array:
        """(offsets, C, S, R) lit share of the columns around each one, during the exposure of its strips' rows."""
        sensor_rows = self._sensor_rows[..., some]
        rows = np.arange(exposure.sensor.height, dtype=np.float64)
        out = np.zeros((_OFFSETS.size, *sensor_rows.shape), np.float32)
        for number, offset in enumerate(_OFFSETS):
            for column in _having(int(offset), sensor_rows.shape[0]):
                out[number, column] = np.interp(sensor_rows[column], rows, exposure.lit[:, column + offset])
        return out

    def _expected(self, shares: Float32Array, some: slice = slice(None)) -> Float32Array:
        """(C, S, R) light of strips that get `shares` of their full light."""
        place = np.clip(shares / _LEVELS[0] - 1, 0, _LEVELS.size - 1.0)
        left = np.minimum(place.astype(np.int64), _LEVELS.size - 2)
        curve = self._curve[..., some]
        low, high = (np.take_along_axis(curve, (left + step)[None], axis=0)[0] for step in (0, 1))
        above = low + (high - low) * (place - left)
        return np.asarray(np.where(shares < _LEVELS[0], curve[0] * (shares / _LEVELS[0]), above), np.float32)

    def _fitted(self, expected: Float32Array, some: slice = slice(None)) -> _Fit:
        window = self._window // (self._step if some.step else 1)
        return _fitted(self._profiles.light[..., some], expected, self._profiles.inside[..., some], window)

    def _residual(self, expected: Float32Array, fit: _Fit, some: slice = slice(None)) -> Float32Array:
        light, inside = self._profiles.light[..., some], self._profiles.inside[..., some]
        return np.where(inside, light - fit.gain * expected - fit.offset, np.float32(0))

    def delivered(self) -> Delivered:
        """The genie's statistics: those of `rxcli.lab.simulate.bound.Oracle`, from strips instead of pixels."""
        profiles, exposure = self._profiles, self._exposure
        light, inside = profiles.light, profiles.inside
        lit = self._lit(exposure)
        shares = (self._shares * lit).sum(axis=0)
        expected = self._expected(shares)
        fit = self._fitted(expected)
        residual = self._residual(expected, fit)
        varies = light[inside] - light[inside].mean()
        explained = 1 - float((residual[inside] ** 2).sum()) / max(float((varies**2).sum()), 1e-30)
        precision = inside / _noise(residual, inside, round(self._window * _NOISE_SLOTS / _FIT_SLOTS))
        height, n_columns = exposure.sensor.height, exposure.lit.shape[1]
        information, matched = np.zeros((height, n_columns)), np.zeros((height, n_columns))
        rows = np.clip(np.rint(self._sensor_rows), 0, height - 1).astype(np.int64)
        for number, offset in enumerate(_OFFSETS):
            dark = shares - self._shares[number] * lit[number]
            own = fit.gain * (self._expected(dark + self._shares[number]) - self._expected(dark))
            for column in _having(int(offset), n_columns):
                sender = column + int(offset)
                np.add.at(information[:, sender], rows[column], own[column] ** 2 * precision[column])
                np.add.at(matched[:, sender], rows[column], own[column] * residual[column] * precision[column])
        matched += information * exposure.lit
        return Delivered(Oracle(exposure, information, matched), explained, float(light[inside].mean()))


def _having(offset: int, n_columns: int) -> range:
    """Columns that have another one `offset` columns to their right."""
    return range(max(-offset, 0), n_columns - max(offset, 0))


def _shares(exposure: Exposure, outlines: Outlines, corrected: bool) -> Float32Array:
    """(offsets, C, S, R) share of a strip's light, all columns lit, that comes from the column so far to the right.

    It is smooth: it is taken at the strips' middles on some rows, and interpolated.
    """
    screen, view = exposure.link.screen, exposure.view
    n_columns, n_strips, n_rows = outlines.inside.shape
    knots = np.unique(np.linspace(0, n_rows - 1, _KNOTS).round().astype(np.int64))
    x = (outlines.edges_x[1:, knots] + outlines.edges_x[:-1, knots]).astype(np.float64) / 2
    pixels = np.stack([x, np.broadcast_to(outlines.rows[knots].astype(np.float64), x.shape)], axis=-1)
    if corrected:
        matrix = view.camera_matrix
        pixels = view.ideal_to_pixels((pixels - matrix[:2, 2]) / matrix[[0, 1], [0, 1]])
    place = view.pixels_to_screen(pixels)
    light = light_spread(place[..., 1], screen.segment_rows, screen.light_spread) @ exposure.drive.lit_light
    light *= light_spread(place[..., 0], screen.columns, screen.light_spread)
    light /= np.maximum(light.sum(axis=-1, keepdims=True), 1e-12)
    by_strip = light.astype(np.float32).reshape(n_columns, n_strips, knots.size, n_columns)
    near = np.zeros((_OFFSETS.size, n_columns, n_strips, knots.size), np.float32)
    for number, offset in enumerate(_OFFSETS):
        for column in _having(int(offset), n_columns):
            near[number, column] = by_strip[column, :, :, column + offset]
    place_of = np.interp(np.arange(n_rows), knots, np.arange(knots.size))
    left = np.minimum(place_of.astype(np.int64), knots.size - 2)
    part = (place_of - left).astype(np.float32)
    return np.asarray(near[..., left] * (1 - part) + near[..., left + 1] * part, np.float32)


@dataclass(frozen=True, slots=True)
class _Fit:
    """Gain (C, 1, R) and offset (C, S, R) of the known picture."""

    gain: Float32Array
    offset: Float32Array


def _fitted(light: Float32Array, expected: Float32Array, inside: NDArray[np.bool_], window: int) -> _Fit:
    """Least squares of `light` on `expected` over `window` rows: one gain for a column, an offset for every strip."""

    def mean(values: Float32Array | NDArray[np.bool_]) -> FloatArray:
        return _box(np.where(inside, values, 0), window) / np.maximum(_box(inside, window), 1e-6)

    mean_x, mean_y = mean(expected), mean(light)
    covariance = (mean(expected * light) - mean_x * mean_y).sum(axis=1, keepdims=True)
    variance = (mean(expected**2) - mean_x**2).sum(axis=1, keepdims=True)
    gain = np.maximum(covariance, 0) / np.maximum(variance, 1e-12)
    return _Fit(gain.astype(np.float32), (mean_y - gain * mean_x).astype(np.float32))


def _box(values: NDArray[Any], window: int) -> FloatArray:
    """(C, S, R) means over `window` rows, by running sums; rows beyond the ends count as zero."""
    half = window // 2
    n = values.shape[2]
    total = np.concatenate([np.zeros((*values.shape[:2], 1)), np.cumsum(values, axis=2, dtype=np.float64)], axis=2)
    rows = np.arange(n)
    return np.asarray(total[..., np.minimum(rows + half + 1, n)] - total[..., np.maximum(rows - half, 0)]) / window


def _noise(residual: Float32Array, inside: NDArray[np.bool_], window: int) -> FloatArray:
    """(C, S, R) variance of the strips around every row, from what the known picture leaves unexplained.

    Measured strip by strip: noise differs with the light, and what is not known of the picture differs from place to
    place, by orders of magnitude where dark areas lie beside bright ones.
    """
    variance = _box(np.where(inside, residual**2, 0), window) / np.maximum(_box(inside, window), 1e-6)
    return np.maximum(variance, _LEAST_VARIANCE)
