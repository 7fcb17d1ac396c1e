"""Scenes without data, drawn at random: a receiver has to report nothing of them.

A scene shows things in a light. The light is steady, switched (dimmed screens, lamps), or carries a code of its own,
the same over the whole width. Some of the things look striped: blinds, keyboards, moire.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np

from rxcli.lab.simulate.optics import FloatArray, Pose
from rxcli.lab.simulate.pictures import DARK_KINDS, draw_dark_picture, draw_name, load_picture
from rxcli.lab.simulate.scenes import Scene, preset

Generator = np.random.Generator

#: Panel pixels of the things, and widths of the sensors.
_PANEL_PX, _SENSOR_WIDTHS_PX = (683, 384), (960, 1280, 1600)
_CAMERAS = ("xs10-still", "video-4k", "phone-corrected", "phone-plain")
#: Time from frame to frame of a clip, in readouts; width of the screen, and of things that fill the picture, in widths.
_FRAME_HEIGHTS, _FILL, _FILL_WHOLE = (1.1, 2.5), (0.55, 1.05), (1.4, 1.9)
#: Rows of a period of switched light, and the share of it that is lit: often the first.
_PERIOD_ROWS, _OFTEN, _DUTY = (4.0, 40.0), 0.3, (0.1, 0.7)
#: Points a row on which the light is sampled.
_FINE = 8


@dataclass(frozen=True)
class _Light:
    """How bright the light is at a time (rows), 0..1, and what was drawn of it."""

    waveform: Callable[[FloatArray], FloatArray] = np.ones_like
    exposure_rows: float = 2.0
    about: dict[str, float] = field(default_factory=dict)


def no_data_scene(kind: str, rng: Generator, n_frames: int = 1) -> tuple[Scene, dict[str, float]]:
    """A scene of one of `_KINDS`, and what was drawn.

    Args:
        kind: which.
        rng: source of all that the kind leaves open.
        n_frames: of a clip.
    """
    things, lamp, whole = _KINDS[kind]
    picture, light = np.clip(255 * things(rng), 0, 255), lamp(rng)
    base = preset(str(rng.choice(_CAMERAS)), "paper-17k3")
    base = base.scaled(rng.choice(_SENSOR_WIDTHS_PX) / base.sensor.width, keep_readout=True)
    row_s, height = base.sensor.line_delay_s, base.sensor.height
    width_px, height_px = _PANEL_PX
    # A slot of this screen is one sample of the light.
    slots = {"slot_rate_hz": _FINE / row_s, "width_px": width_px, "height_px": height_px}
    fill = rng.uniform(*(_FILL_WHOLE if whole else _FILL))
    shift = rng.uniform(-0.5, 0.5, 2) * max(1 - fill, 0)
    pose = Pose(fill, *rng.normal(0, (1.0, 3.0, 3.0)).tolist(), *shift.tolist())
    scene = replace(
        base.exposed(light.exposure_rows * row_s, 10 ** rng.uniform(-0.4, 0.6)),
        screen=msgspec.structs.replace(base.screen, **slots),
        picture=np.asarray(np.broadcast_to(np.atleast_3d(picture), (height_px, width_px, 3)), np.uint8),
        dimming="none" if whole else "max",
        waveform=lambda slot: light.waveform((slot + 0.5) / _FINE),
        pose=pose,
        room=replace(base.room, light_e_per_s=base.light_e_per_s * 10 ** rng.uniform(-4, -0.8)),
        start_slot=rng.uniform(0, 1e5),
        n_frames=n_frames,
        frame_rate_hz=1 / (height * row_s * rng.uniform(*_FRAME_HEIGHTS)),
        output="developed",
    )
    return scene, {**light.about, "exposure_rows": light.exposure_rows}


def draw_kind(rng: Generator, striped: bool) -> str:
    """A kind, striped or not."""
    return str(rng.choice(STRIPED_KINDS, p=_SHARES) if striped else rng.choice(EVEN_KINDS))


# -- light ---------------------------------------------------------------------------------------------------------


def _steady(rng: Generator) -> _Light:
    return _Light()


def _switched(rng: Generator) -> _Light:
    """Steady switching; the exposure is a share of what it leaves of the stripes."""
    period, duty = rng.uniform(*_PERIOD_ROWS), _OFTEN if rng.random() < 0.5 else rng.uniform(*_DUTY)
    exposure_rows = max(float(rng.uniform(0.1, 1.8) * period * min(duty, 1 - duty)), 0.3)
    about = {"period_rows": period, "duty": duty}
    return _Light(lambda t: np.asarray(t % period < duty * period, np.float64), exposure_rows, about)


def _coded(rng: Generator) -> _Light:
    """A random code, the same over the whole width; it may come again."""
    slot, share, length = rng.uniform(2, 16), rng.uniform(0.3, 0.7), int(rng.integers(20, 400))
    bits = (rng.random(length if rng.random() < 0.5 else 100_003) < share).astype(np.float64)
    about = {"slot_rows": slot, "length": float(bits.size)}
    return _Light(lambda t: bits[np.floor(t / slot).astype(np.int64) % bits.size], slot * rng.uniform(0.2, 1.2), about)


def _rippling(rng: Generator) -> _Light:
    """A lamp: a rectified sine of the mains, a sawtooth of its driver, or switching."""
    if rng.random() < 0.5:
        return _switched(rng)
    period, depth, is_sine = np.exp(rng.uniform(*np.log((6.0, 900.0)))), rng.uniform(0.1, 1.0), rng.random() < 0.6

    def waveform(t: FloatArray) -> FloatArray:
        place = t / period
        return np.asarray(1 - depth + depth * (np.abs(np.sin(np.pi * place)) if is_sine else place % 1.0))

    return _Light(waveform, period * rng.uniform(0.02, 0.7), {"period_rows": period, "depth": depth})


# -- things, as grey or coloured values 0..1 of the panel's pixels -------------------------------------------------


def _even(rng: Generator) -> FloatArray:
    return np.full(_PANEL_PX[::-1], rng.uniform(0.3, 1.0))


def _photo(rng: Generator) -> FloatArray:
    return np.asarray(load_picture(draw_name(rng), *_PANEL_PX) / 255)


def _dark(rng: Generator) -> FloatArray:
    if rng.random() < 0.5:
        return _photo(rng) * rng.uniform(0.15, 0.5)
    return np.asarray(draw_dark_picture(str(rng.choice(DARK_KINDS)), rng, *_PANEL_PX) / 255)


def _even_or_photo(rng: Generator) -> FloatArray:
    return _even(rng) if rng.random() < 0.5 else _photo(rng)


def _any(rng: Generator) -> FloatArray:
    return _dark(rng) if rng.random() < 0.3 else _photo(rng)


def _places() -> tuple[FloatArray, FloatArray]:
    """Pixels across and down."""
    y, x = np.mgrid[: _PANEL_PX[1], : _PANEL_PX[0]].astype(np.float64)
    return x, y


def _blinds(rng: Generator) -> FloatArray:
    """Slats, a little slanted, each of its own brightness."""
    (x, y), period, share = _places(), rng.uniform(4, 35), rng.uniform(0.2, 0.8)
    place = (y + rng.normal(0, 0.01) * x) / period + 1
    gains = rng.uniform(rng.uniform(0.4, 1.0), 1, 400)
    return np.asarray((place % 1 < share) * gains[place.astype(np.int64)] + 0.05)


def _keyboard(rng: Generator) -> FloatArray:
    """Keys in rows, light on dark or dark on light."""
    (x, y), across, down, gap = _places(), rng.integers(30, 55), rng.integers(15, 50), rng.integers(2, 8)
    row = y // down
    column, left = np.divmod(x + row * across / 3, across)
    faces = rng.uniform(0.5, 1.0) * rng.uniform(0.85, 1.0, (40, 60))[row.astype(np.int64), column.astype(np.int64)]
    keys = faces * (y % down >= gap) * (left >= gap)
    return np.asarray(keys if rng.random() < 0.5 else 1 - keys)


def _moire(rng: Generator) -> FloatArray:
    """The lattice of a screen's pixels against that of the sensor: crossing waves, mostly across the rows."""
    (x, y), waves = _places(), np.ones(_PANEL_PX[::-1])
    for _ in range(int(rng.integers(1, 4))):
        slanted = y + rng.normal(0, 0.15) * x + rng.normal(0, 0.05) * np.square(x / x.max() - 0.5) * y.max()
        waves *= 1 + rng.uniform(0.05, 0.6) * np.sin(2 * np.pi * slanted / rng.uniform(3, 30))
    return np.asarray(np.atleast_3d(_even_or_photo(rng)) * waves[..., None] / waves.max())


def _noise(rng: Generator) -> FloatArray:
    """Nothing but noise, of pixels, rows or blotches."""
    shape = [(384, 683), (384, 1), (48, 86)][rng.integers(3)]
    times = (-(-384 // shape[0]), -(-683 // shape[1]))
    noise = np.kron(rng.standard_normal(shape), np.ones(times))[:384, :683]
    return np.asarray(rng.uniform(0.1, 0.6) * (1 + rng.uniform(0.05, 0.5) * noise))


#: Kind -> what is shown, in what light, and whether it fills the picture.
_KINDS: dict[str, tuple[Callable[[Generator], FloatArray], Callable[[Generator], _Light], bool]] = {
    "pwm": (_even, _switched, False),
    "pwm textured": (_photo, _switched, False),
    "pwm dark": (_dark, _switched, False),
    "lamp": (_photo, _rippling, True),
    "codes": (_even_or_photo, _coded, False),
    "blinds": (_blinds, _steady, False),
    "keyboard": (_keyboard, _steady, False),
    "moire": (_moire, _steady, False),
    "photo": (_photo, _steady, True),
    "screen": (_any, _steady, False),
    "noise": (_noise, _steady, True),
}
#: Kinds with stripes and their frequencies; kinds without stripes.
STRIPED_KINDS = ("pwm", "pwm textured", "pwm dark", "lamp", "codes", "blinds", "keyboard", "moire")
_SHARES = (0.22, 0.18, 0.14, 0.14, 0.14, 0.06, 0.06, 0.06)
EVEN_KINDS = ("photo", "screen", "noise")
