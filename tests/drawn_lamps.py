"""Pictures of lamps that blink, by rolling-shutter cameras: what `vlc-rx measure` is tried on.

A lamp lights its part of the picture, in every row by its mean over the row's exposure. Out of focus it is a disk; a
lamp that fills the picture lights a scene.
"""

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rxcli.lab.simulate.isp import Isp, tone_curve
from rxcli.lab.simulate.pictures import draw_name, load_picture
from rxcli.lab.simulate.scenes import preset

FloatArray = NDArray[np.float64]
#: Cameras, and the size of their pictures relative to the sensor.
CAMERAS = {"xs10-still": 0.5, "video-4k": 0.5, "phone-corrected": 0.7, "phone-plain": 0.7}
#: Electrons of a pixel at white; noise of a pixel and of a row, electrons.
_FULL_E, _READ_E, _ROW_E = 1500.0, 3.0, 0.3
#: Fewest rows of a period; frequencies, hertz; readouts, seconds; stripes over the whole picture.
_MIN_ROWS, _FREQUENCIES_HZ, _READOUTS_S, _STRIPES = 3.5, (100.0, 40e3), (5e-3, 33e-3), (2.0, 400.0)


@dataclass(frozen=True)
class Lamp:
    """A lamp that is switched, or a sine where `duty` is None."""

    frequency_hz: float
    duty: float | None = 0.5
    #: (brightest - darkest) / (brightest + darkest) of its light.
    depth: float = 1.0
    #: Middle and radius of its disk, picture heights and widths; None: it lights the whole picture.
    disk: tuple[float, float, float] | None = None
    phase: float = 0.0

    def light(self, start_s: FloatArray, exposure_s: float) -> FloatArray:
        """Mean over exposures, 1 is the brightest instant."""
        darkest = (1 - self.depth) / (1 + self.depth)
        if self.duty is None:
            middle = 2 * np.pi * (self.frequency_hz * (start_s + exposure_s / 2) + self.phase)
            share = 0.5 + 0.5 * np.sinc(self.frequency_hz * exposure_s) * np.sin(middle)
        else:
            begin, length = self.frequency_hz * start_s + self.phase, self.frequency_hz * exposure_s
            lit = [np.floor(t) * self.duty + np.minimum(t % 1, self.duty) for t in (begin + length, begin)]
            share = (lit[0] - lit[1]) / length
        return np.asarray(darkest + (1 - darkest) * share)


@dataclass(frozen=True)
class LampScene:
    """A picture of lamps: camera, exposure, and all that is drawn of it."""

    camera: str
    shape: tuple[int, int]
    line_delay_s: float
    exposure_s: float
    lamps: tuple[Lamp, ...]
    axis: str = "rows"
    #: Name of the lit scene; None for an even one.
    picture: str | None = None
    #: Light that does not blink, and brightness of the lamps, 1 is white.
    ambient: float = 0.02
    gain: float = 0.6
    #: Blur across the rows by the camera's development, standard deviation in rows.
    blur_rows: float = 0.6
    isp: Isp = field(default_factory=Isp)

    def render(self, rng: np.random.Generator) -> NDArray[np.uint8]:
        """The developed picture, as stored; (height, width)."""
        height, width = self.shape
        y, x = np.mgrid[0:height, 0:width]
        scene = np.ones(self.shape)
        if self.picture is not None:
            colours = load_picture(self.picture, width, height).astype(np.float64)
            scene = 0.1 + 0.9 * (colours.mean(axis=2) / 255) ** 2.2
        light = self.ambient * scene
        for lamp in self.lamps:
            rows = lamp.light(np.arange(height, dtype=np.float64) * self.line_delay_s, self.exposure_s)[:, None]
            if lamp.disk is None:
                place = scene * (1 - 0.3 * ((x / width - 0.4) ** 2 + (y / height - 0.5) ** 2))
            else:
                at_x, at_y, radius = lamp.disk
                distance = np.hypot(x - at_x * width, y - at_y * height) / (radius * height)
                place = 1 / (1 + np.exp(np.minimum((distance - 1) * 30, 50)))
            light += self.gain * rows * place
        electrons = _FULL_E * _blurred(light, self.blur_rows)
        noise = np.sqrt(electrons + _READ_E**2) * rng.standard_normal(self.shape)
        electrons += noise + _ROW_E * rng.standard_normal((height, 1))
        values = tone_curve(np.asarray(np.clip(electrons / _FULL_E, 0, 1), np.float32), self.isp.tone)
        pixels = np.round(255 * values).astype(np.uint8)
        return pixels if self.axis == "rows" else np.ascontiguousarray(pixels.T)

    def truth(self) -> dict[str, Any]:
        """What was drawn, as plain data."""
        return {name: getattr(self, name) for name in ("camera", "line_delay_s", "exposure_s", "axis", "picture")}


def _blurred(light: FloatArray, sigma: float) -> FloatArray:
    return np.asarray(cv2.GaussianBlur(light, (1, 2 * int(4 * sigma + 1) + 1), 1e-6, sigmaY=sigma))


def draw_lamps(rng: np.random.Generator) -> LampScene:
    """A random scene of one to three lamps."""
    camera = str(rng.choice(list(CAMERAS)))
    base = preset(camera, "paper-17k3").scaled(CAMERAS[camera], keep_readout=True)
    height, readout_s = base.sensor.height, float(np.exp(rng.uniform(*np.log(_READOUTS_S))))
    lowest, highest = (hz * readout_s for hz in _FREQUENCIES_HZ)
    bounds = max(_STRIPES[0], lowest), min(_STRIPES[1], height / _MIN_ROWS, highest)
    n_lamps = int(rng.choice([1, 2, 3], p=[0.6, 0.25, 0.15]))
    disks = n_lamps > 1 or rng.random() < 0.4
    lamps = []
    for number in range(n_lamps):
        stripes = float(np.exp(rng.uniform(*np.log(bounds))))
        duty = float(rng.uniform(0.01, 0.95)) if rng.random() < 0.85 else None
        depth = float(rng.uniform(0.5, 1.0)) if rng.random() < 0.4 else 1.0
        place = (number + 0.5 + rng.uniform(-0.1, 0.1)) / n_lamps, rng.uniform(0.35, 0.65)
        radius = rng.uniform(0.15, 0.4) * min(1.0, 1.6 * base.sensor.width / height / n_lamps)
        disk = (float(place[0]), float(place[1]), float(radius)) if disks else None
        lamps.append(Lamp(stripes / readout_s, duty, depth, disk, float(rng.random())))
    fastest_hz = max(lamp.frequency_hz for lamp in lamps)
    exposure_s = float(np.clip(rng.uniform(0.05, 0.7) / fastest_hz, 1 / 32000, 1 / 200))
    return LampScene(
        camera,
        (height, base.sensor.width),
        readout_s / height,
        exposure_s,
        tuple(lamps),
        str(rng.choice(["rows", "columns"], p=[0.7, 0.3])),
        None if disks or rng.random() < 0.5 else draw_name(rng),
        float(rng.choice([0.003, 0.02, 0.1])),
        float(rng.uniform(0.3, 0.9)),
        float(rng.uniform(0.2, 1.2)),
        base.isp,
    )
