"""Pictures without data, drawn at random: a receiver has to report nothing of them.

Half of the kinds are striped: light that is switched steadily (dimmed screens, lamps), light that says something of its
own (random codes, the same over the whole width), and things that look striped (blinds, keyboards, moire). The others
are what else cameras see: photographs, screens that glow evenly, noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rxcli.lab.simulate.dark_pictures import DARK_KINDS, draw_dark_picture
from rxcli.lab.simulate.pictures import draw_name, load_picture

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
Luma = NDArray[np.uint8]

#: Pixels of the pictures, and rows that a frame of a clip is later than the one before, in heights.
_SIZES, _FRAME_HEIGHTS = ((960, 720), (1280, 960), (1280, 720), (1600, 1200)), (1.1, 2.5)
#: Rows of a period of switched light, and the share of it that is lit: often the first.
_PERIOD_ROWS, _OFTEN, _DUTY = (4.0, 40.0), 0.3, (0.1, 0.7)
#: Points a row on which waveforms are computed.
_FINE = 8
#: Electrons of white; standard deviation of a pixel's own noise, and of a row's, shares of white.
_WHITE_E, _READ_NOISE, _ROW_NOISE = (800.0, 12_000.0), (2e-4, 2e-3), (0.0, 4e-4)
_QUALITY = (75, 97)

#: Light at instants, rows since the first frame's first.
Waveform = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class NoData:
    """A picture or clip without data."""

    kind: str
    #: (height, width) luma of each frame.
    frames: tuple[Luma, ...]
    #: Rows from frame to frame.
    frame_rows: float
    #: What was drawn.
    about: dict[str, float] = field(default_factory=dict)


@dataclass
class _Scene:
    """What is photographed."""

    #: (height, width) what throws back or lets through how much of the striped light, and light of its own.
    lit: Float32Array
    glow: Float32Array
    #: The striped light; None for an even one. Rows by which places of (width,) are later, for stripes that slant.
    waveform: Waveform | None = None
    late: FloatArray | float = 0.0
    exposure_rows: float = 1.0
    #: Whether stripes are things that stand still, not light that changes.
    still: bool = False
    about: dict[str, float] = field(default_factory=dict)


def draw_no_data(kind: str, rng: np.random.Generator, n_frames: int = 1) -> NoData:
    """A picture of one of `NO_DATA_KINDS`, or a clip of it.

    Args:
        kind: which.
        rng: source of all that the kind leaves open.
        n_frames: of the clip.
    """
    width, height = _SIZES[rng.integers(len(_SIZES))]
    scene = _DRAWERS[kind](rng, width, height)
    frame_rows = height * rng.uniform(*_FRAME_HEIGHTS)
    develop = _developer(rng)
    rows = np.arange(height, dtype=np.float64)
    frames = []
    for number in range(n_frames):
        start = 0.0 if scene.still else number * frame_rows
        light = np.ones((height, 1)) if scene.waveform is None else _exposed(scene, rows + start, width)
        frames.append(develop(scene.lit * light.astype(np.float32) + scene.glow))
    return NoData(kind, tuple(frames), frame_rows, scene.about)


def draw_kind(rng: np.random.Generator, striped: bool) -> str:
    """A kind, striped or not."""
    return str(rng.choice(STRIPED_KINDS, p=_SHARES) if striped else rng.choice(EVEN_KINDS))


def _exposed(scene: _Scene, rows: FloatArray, width: int) -> FloatArray:
    """(R, 1) or (R, width) mean light of the rows' exposures."""
    assert scene.waveform is not None
    late = np.broadcast_to(np.asarray(scene.late, np.float64), (width,))
    first, last = rows[0] - late.max() - 1, rows[-1] - late.min() + scene.exposure_rows + 2
    fine = first + np.arange(int((last - first) * _FINE)) / _FINE
    integral = np.concatenate([[0.0], np.cumsum(scene.waveform(fine))]) / _FINE
    knots = first + np.arange(integral.size) / _FINE

    def mean(start: FloatArray) -> FloatArray:
        end = start + scene.exposure_rows
        return np.asarray((np.interp(end, knots, integral) - np.interp(start, knots, integral)) / scene.exposure_rows)

    return mean(rows[:, None] - late) if np.ptp(late) else mean(rows[:, None])


def _developer(rng: np.random.Generator) -> Callable[[Float32Array], Luma]:
    """Noise, tone curve, sharpening, JPEG."""
    import cv2

    electrons, quality = np.exp(rng.uniform(*np.log(_WHITE_E))), int(rng.integers(*_QUALITY))
    read, row, sharpen = rng.uniform(*_READ_NOISE), rng.uniform(*_ROW_NOISE), rng.uniform(0, 0.6)

    def develop(light: Float32Array) -> Luma:
        variance = np.clip(light, 0, None) / electrons + read**2
        noisy = light + rng.standard_normal(light.shape, np.float32) * np.sqrt(variance).astype(np.float32)
        noisy += (row * rng.standard_normal((light.shape[0], 1))).astype(np.float32)
        linear = np.clip(noisy, 0, 1)
        coded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
        coded += sharpen * (coded - cv2.GaussianBlur(coded, (0, 0), 1.2))
        grey = np.asarray(np.clip(255 * coded + 0.5, 0, 255), np.uint8)
        _, file = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, quality])
        return np.asarray(cv2.imdecode(file, cv2.IMREAD_GRAYSCALE), np.uint8)

    return develop


# -- light ---------------------------------------------------------------------------------------------------------


def _switched(rng: np.random.Generator, scene: _Scene) -> _Scene:
    """Steady switching; the exposure is a share of what it leaves of the stripes."""
    period = rng.uniform(*_PERIOD_ROWS)
    duty = _OFTEN if rng.random() < 0.5 else rng.uniform(*_DUTY)
    phase = rng.uniform(0, period)
    scene.exposure_rows = max(float(rng.uniform(0.1, 1.8) * period * min(duty, 1 - duty)), 0.3)
    scene.waveform = lambda t: np.asarray((t + phase) % period < duty * period, np.float64)
    scene.about = {"period_rows": period, "duty": duty, "exposure_rows": scene.exposure_rows}
    return scene


def _coded(rng: np.random.Generator, scene: _Scene) -> _Scene:
    """A random code, the same over the whole width; it may come again."""
    slot, share, length = rng.uniform(2, 16), rng.uniform(0.3, 0.7), int(rng.integers(20, 400))
    bits = (rng.random(length if rng.random() < 0.5 else 100_003) < share).astype(np.float64)
    scene.exposure_rows = slot * rng.uniform(0.2, 1.2)
    scene.waveform = lambda t: bits[np.floor(t / slot).astype(np.int64) % bits.size]
    scene.about = {"slot_rows": slot, "length": float(bits.size), "exposure_rows": scene.exposure_rows}
    return scene


def _rippling(rng: np.random.Generator, scene: _Scene) -> _Scene:
    """A lamp: a rectified sine of the mains, a sawtooth of its driver, or switching."""
    if rng.random() < 0.5:
        return _switched(rng, scene)
    period = np.exp(rng.uniform(*np.log((6.0, 900.0))))
    depth, phase, sine = rng.uniform(0.1, 1.0), rng.uniform(0, period), rng.random() < 0.6
    scene.exposure_rows = period * rng.uniform(0.02, 0.7)

    def waveform(t: FloatArray) -> FloatArray:
        place = (t + phase) / period
        return np.asarray(1 - depth + depth * (np.abs(np.sin(np.pi * place)) if sine else place % 1.0))

    scene.waveform = waveform
    scene.about = {"period_rows": period, "depth": depth, "exposure_rows": scene.exposure_rows}
    return scene


# -- things --------------------------------------------------------------------------------------------------------


def _picture(rng: np.random.Generator, width: int, height: int) -> Float32Array:
    """(height, width) a photograph or drawing, as light."""
    light = _light_of(load_picture(draw_name(rng), width, height))
    return np.ascontiguousarray(light[:, :: rng.choice([-1, 1])])


def _dark_picture(rng: np.random.Generator) -> Float32Array:
    """(384, 683) light of a picture most of which is black."""
    return _light_of(draw_dark_picture(str(rng.choice(DARK_KINDS)), rng, 683, 384))


def _light_of(rgb: NDArray[np.uint8]) -> Float32Array:
    return np.asarray((np.asarray(rgb, np.float32).mean(axis=2) / 255) ** np.float32(2.2), np.float32)


def _on_screen(rng: np.random.Generator, picture: Float32Array, width: int, height: int) -> _Scene:
    """A screen that shows a picture, somewhere in a room."""
    import cv2

    share, panel_h, panel_w = rng.uniform(0.55, 1.05), *picture.shape
    size = np.array([share * width, share * width * panel_h / panel_w])
    if size[1] > 1.1 * height:
        size *= 1.1 * height / size[1]
    middle = np.array([width, height]) / 2 + rng.uniform(-0.5, 0.5, 2) * np.maximum(np.array([width, height]) - size, 0)
    unit = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    corners = middle + unit * size + rng.normal(0, 0.008 * width, (4, 2))
    there = np.array([[0, 0], [panel_w, 0], [panel_w, panel_h], [0, panel_h]], np.float32)
    matrix = cv2.getPerspectiveTransform(there, corners.astype(np.float32))
    lit = cv2.warpPerspective(picture, matrix, (width, height), flags=cv2.INTER_AREA)
    room = _room(rng, width, height)
    off = 1 - cv2.warpPerspective(np.ones_like(picture), matrix, (width, height))
    glow = rng.uniform(0, 0.02) + room * off
    return _Scene(cv2.GaussianBlur(lit, (0, 0), rng.uniform(0.4, 1.5)), np.asarray(glow, np.float32))


def _room(rng: np.random.Generator, width: int, height: int) -> Float32Array:
    """(height, width) light of what is around a screen: mostly dark."""
    level = 10 ** rng.uniform(-4, -0.8)
    if rng.random() < 0.5:
        return np.full((height, width), level, np.float32)
    return np.asarray(level * _picture(rng, width, height), np.float32)


def _even(rng: np.random.Generator) -> Float32Array:
    return np.full((384, 683), rng.uniform(0.08, 0.95), np.float32)


def _pwm(rng: np.random.Generator, width: int, height: int) -> _Scene:
    return _switched(rng, _on_screen(rng, _even(rng), width, height))


def _pwm_textured(rng: np.random.Generator, width: int, height: int) -> _Scene:
    return _switched(rng, _on_screen(rng, _picture(rng, 683, 384), width, height))


def _pwm_dark(rng: np.random.Generator, width: int, height: int) -> _Scene:
    if rng.random() < 0.5:
        dim = _picture(rng, 683, 384) * np.float32(rng.uniform(0.02, 0.2))
        return _switched(rng, _on_screen(rng, dim, width, height))
    return _switched(rng, _on_screen(rng, _dark_picture(rng), width, height))


def _lamp(rng: np.random.Generator, width: int, height: int) -> _Scene:
    """A room in the light of a lamp: stripes over all of it."""
    y, x = np.mgrid[0:height, 0:width] / np.array([height, width])[:, None, None]
    distance = np.hypot(x - rng.uniform(0, 1), y - rng.uniform(0, 1))
    falloff = 1 / (1 + (distance / rng.uniform(0.3, 2)) ** 2)
    things = _picture(rng, width, height) if rng.random() < 0.7 else np.full((height, width), 0.6, np.float32)
    lit = np.asarray(rng.uniform(0.2, 1.2) * falloff * things, np.float32)
    return _rippling(rng, _Scene(lit, np.asarray(rng.uniform(0, 0.3) * things, np.float32)))


def _codes(rng: np.random.Generator, width: int, height: int) -> _Scene:
    picture = _even(rng) if rng.random() < 0.5 else _picture(rng, 683, 384)
    return _coded(rng, _on_screen(rng, picture, width, height))


def _blinds(rng: np.random.Generator, width: int, height: int) -> _Scene:
    """Slats, a little slanted, each of its own brightness."""
    period, share = rng.uniform(8, 70), rng.uniform(0.2, 0.8)
    scene = _on_screen(rng, _even(rng), width, height)
    gains = rng.uniform(1 - rng.uniform(0, 0.6), 1, 4096)

    def waveform(t: FloatArray) -> FloatArray:
        slat = np.floor(t / period).astype(np.int64)
        return np.asarray((t / period % 1.0 < share) * gains[slat % gains.size] + 0.05)

    scene.waveform, scene.still = waveform, True
    scene.late = np.asarray(rng.normal(0, 0.01) * np.arange(width), np.float64)
    scene.exposure_rows = rng.uniform(1, 4)
    scene.about = {"period_rows": period, "duty": share}
    return scene


def _keyboard(rng: np.random.Generator, width: int, height: int) -> _Scene:
    """Keys in rows, light on dark or dark on light, seen at a slant."""
    import cv2

    across, down, gap = int(rng.integers(60, 110)), int(rng.integers(30, 100)), int(rng.integers(4, 16))
    keys, tone = np.full((600, 1400), int(rng.integers(4, 26)), np.uint8), int(rng.integers(50, 200))
    for row in range(600 // down + 1):
        for column in range(-1, 1400 // across + 1):
            left, top = column * across + (row * across) // 3 % across, row * down
            face, letter = int(tone * rng.uniform(0.85, 1.0)), chr(int(rng.integers(65, 91)))
            cv2.rectangle(keys, (left + gap, top + gap), (left + across - gap, top + down - gap), face, -1)
            cv2.putText(keys, letter, (left + gap + 6, top + down - gap - 6), 0, 0.6, tone // 5, 2, cv2.LINE_AA)
    light = (keys / 255).astype(np.float32)
    if rng.random() < 0.5:
        light = (rng.uniform(0.8, 1.0) - light).astype(np.float32)
    return _on_screen(rng, light, width, height)


def _moire(rng: np.random.Generator, width: int, height: int) -> _Scene:
    """The lattice of a screen's pixels against that of the sensor: crossing waves, mostly across the rows."""
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    waves = np.ones((height, width))
    for _ in range(int(rng.integers(1, 4))):
        period, slant = rng.uniform(4, 60), rng.normal(0, 0.15)
        bend = rng.normal(0, 0.05) * np.square(x / width - 0.5) * height
        waves *= 1 + rng.uniform(0.05, 0.6) * np.sin(2 * np.pi * (y + slant * x + bend) / period)
    scene = _on_screen(rng, _even(rng) if rng.random() < 0.5 else _picture(rng, 683, 384), width, height)
    scene.lit = np.asarray(scene.lit * waves, np.float32)
    return scene


def _photo(rng: np.random.Generator, width: int, height: int) -> _Scene:
    zoom = rng.uniform(1.0, 2.5)
    large = _picture(rng, int(zoom * width), int(zoom * height))
    left, top = (int(rng.integers(0, n - m + 1)) for n, m in zip(large.shape[::-1], (width, height), strict=True))
    cut = large[top : top + height, left : left + width] * np.float32(10 ** rng.uniform(-1, 0.2))
    return _Scene(cut, np.zeros_like(cut))


def _glowing(rng: np.random.Generator, width: int, height: int) -> _Scene:
    """A screen without stripes."""
    picture = _dark_picture(rng) if rng.random() < 0.3 else _picture(rng, 683, 384)
    return _on_screen(rng, picture, width, height)


def _noise(rng: np.random.Generator, width: int, height: int) -> _Scene:
    """Nothing but noise, of pixels, rows or blotches."""
    import cv2

    shape = [(height, width), (height, 1), (height // 8, width // 8)][rng.integers(3)]
    noise = rng.standard_normal(shape).astype(np.float32)
    grown = np.broadcast_to(noise, (height, width)) if shape[1] == 1 else cv2.resize(noise, (width, height))
    light = rng.uniform(0.01, 0.6) * (1 + rng.uniform(0.05, 0.5) * grown)
    return _Scene(np.asarray(np.clip(light, 0, None), np.float32), np.zeros((height, width), np.float32))


_DRAWERS: dict[str, Callable[[np.random.Generator, int, int], _Scene]] = {
    "pwm": _pwm,
    "pwm textured": _pwm_textured,
    "pwm dark": _pwm_dark,
    "lamp": _lamp,
    "codes": _codes,
    "blinds": _blinds,
    "keyboard": _keyboard,
    "moire": _moire,
    "photo": _photo,
    "screen": _glowing,
    "noise": _noise,
}
#: Kinds that show stripes, how often each is drawn, and those that show none.
STRIPED_KINDS = ("pwm", "pwm textured", "pwm dark", "lamp", "codes", "blinds", "keyboard", "moire")
_SHARES = (0.22, 0.18, 0.14, 0.14, 0.14, 0.06, 0.06, 0.06)
EVEN_KINDS = ("photo", "screen", "noise")
#: Kinds that `draw_no_data` knows.
NO_DATA_KINDS = tuple(_DRAWERS)
