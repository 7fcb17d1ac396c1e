"""Scenes to learn from, and others to be judged by: no picture and no camera stands in both."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rxcli.lab.simulate.pictures import draw_dark_picture, draw_part
from rxcli.lab.simulate.population import Population
from rxcli.lab.simulate.scenes import Scene, preset

#: scikit-image's pictures that training may use; the others are for validation.
TRAINING_PHOTOS = ("camera", "coins", "hubble", "moon", "page", "retina")
#: Dark pictures that are drawn without a photograph.
_DRAWN_DARK = ("terminal", "night", "stars")
#: Shares of parts of photographs and of scattered shapes among the pictures; the others are dark ones.
_PHOTOS, _SHAPES = 0.5, 0.35
#: Width of simulated sensors: narrow ones are quick, and lateral pixels are averaged in strips anyway.
_WIDTHS = (800, 2000)
_POPULATION = Population(
    cameras=("xs10-still", "video-4k", "video-1080p", "phone-plain", "phone-video"),
    exposure_slots=(0.25, 2.5),
    readout_s=(8e-3, 40e-3),
    column_delay_slots=(0.01, 2.0),
)

Picture = NDArray[np.uint8]


def random_picture(rng: np.random.Generator, width: int, height: int) -> Picture:
    """A picture to learn from: part of a photograph, scattered shapes, or a dark one.

    Args:
        rng: source of all choices.
        width: pixels.
        height: pixels.

    Returns:
        (height, width, 3) uint8.
    """
    kind = rng.random()
    if kind < _PHOTOS + _SHAPES:
        drawn = (_photo_part if kind < _PHOTOS else _shapes)(rng, width, height)
    else:
        drawn = draw_dark_picture(str(rng.choice(_DRAWN_DARK)), rng, width, height) / 255.0
    tint = rng.uniform(0.5, 1.0, 3) if rng.random() < 0.5 else np.ones(3)
    gamma = np.exp(rng.normal(0.15, 0.5))
    return np.asarray(np.rint(255 * np.clip(drawn, 0, 1) ** gamma * tint), np.uint8)


def _photo_part(rng: np.random.Generator, width: int, height: int) -> NDArray[np.float64]:
    part = draw_part(str(rng.choice(TRAINING_PHOTOS)), rng, width, height, 2.5)
    return np.asarray((255.0 - part if rng.random() < 0.2 else part) / 255.0)


def _shapes(rng: np.random.Generator, width: int, height: int) -> NDArray[np.float64]:
    """Discs and boxes of all sizes, one over the other ("dead leaves"): edges as in natural pictures."""
    import cv2

    picture = np.full((height, width, 3), rng.uniform(0, 1, 3))
    for size in np.sort(height * 0.4 * rng.random(int(rng.integers(40, 500))) ** rng.uniform(1.5, 4))[::-1]:
        x, y = (int(v) for v in (rng.uniform(0, width), rng.uniform(0, height)))
        colour = tuple(float(v) for v in np.clip(rng.uniform(0, 1) + rng.normal(0, 0.15, 3), 0, 1))
        if rng.random() < 0.6:
            cv2.circle(picture, (x, y), max(int(size), 1), colour, -1, cv2.LINE_AA)
        else:
            box = cv2.boxPoints(((x, y), (size * 2, size * rng.uniform(0.1, 2)), rng.uniform(0, 180)))
            cv2.fillPoly(picture, [np.rint(box).astype(np.int32)], colour, cv2.LINE_AA)
    shade = 1 + rng.uniform(-0.5, 0.5) * np.linspace(-1, 1, height)[:, None, None]
    grain = rng.choice([0.0, 0.02, 0.06]) * rng.standard_normal((height, width, 1))
    return np.asarray(picture * shade + grain)


def training_scene(rng: np.random.Generator) -> Scene:
    """A scene to learn from: one of the benchmark's in scarce light, because on easy scenes there is nothing to learn.

    Pictures and noise are drawn anew, so that no picture and no camera of the benchmark is learned.
    """
    base, _ = _POPULATION.draw(rng)
    white_e = 10 ** rng.uniform(0.5, 2.0)
    sensor = replace(
        base.sensor,
        cfa="rgb" if rng.random() < 0.5 else "bayer",
        response=(float(rng.uniform(0.45, 0.7)), 1.0, float(rng.uniform(0.5, 0.75))),
        read_noise_e=float(rng.uniform(1.2, 4.0)),
        row_noise_e=float(rng.uniform(0.0, 0.5)),
        full_scale_e=white_e * float(rng.uniform(2.0, 5.0)),
    )
    scene = replace(
        base,
        picture=random_picture(rng, base.screen.width_px, base.screen.height_px),
        sensor=sensor,
        room=replace(base.room, light_e_per_s=white_e / base.exposure_s * 10 ** rng.uniform(-3, -0.7)),
        isp=replace(base.isp, quality=int(rng.choice([75, 85, 90, 95]))),
        light_e_per_s=white_e / base.exposure_s,
        camera_name="training",
    )
    return scene.scaled(min(rng.uniform(*_WIDTHS) / sensor.width, 1.0), 1.0)


@dataclass(frozen=True)
class SceneClass:
    """One kind of validation scene."""

    name: str
    pictures: tuple[str, ...]
    #: Light against the preset's.
    light: float = 1.0
    quality: int = 93
    #: Exposure in slots; None: the preset's.
    exposure_slots: float | None = None


SCENE_CLASSES = (
    SceneClass("clean", ("sky", "coffee", "astronaut"), 1.5),
    SceneClass("dark", ("flower", "night", "rocket")),
    SceneClass("textured", ("chelsea", "motorcycle", "text")),
    SceneClass("low light", ("coffee", "sky", "astronaut"), 0.25),
    SceneClass("quality 85", ("coffee", "motorcycle", "astronaut"), 0.6, 85),
    SceneClass("long exposure", ("coffee", "chelsea", "sky"), 0.6, 93, 2.0),
)
VALIDATION_CAMERAS = ("xs10-still", "phone-plain")


def validation_scene(kind: SceneClass, screen: str, number: int) -> Scene:
    """The scene with a number of a class: pictures and cameras take turns.

    Args:
        kind: which class.
        screen: name of the screen profile.
        number: from 0.
    """
    scene = preset(VALIDATION_CAMERAS[number % len(VALIDATION_CAMERAS)], screen)
    picture = kind.pictures[number // len(VALIDATION_CAMERAS) % len(kind.pictures)]
    slots = kind.exposure_slots
    exposure_s = scene.exposure_s if slots is None else slots / scene.screen.slot_rate_hz
    isp, sensor = replace(scene.isp, quality=kind.quality), replace(scene.sensor, cfa="bayer")
    scene = replace(scene.exposed(exposure_s, kind.light), picture=picture, isp=isp, sensor=sensor)
    return scene.scaled(0.3, 1.0)
