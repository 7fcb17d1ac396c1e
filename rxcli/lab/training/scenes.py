"""Scenes to learn from, and others to be judged by: no picture and no camera stands in both."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rxcli.lab.simulate.camera import Room
from rxcli.lab.simulate.isp import Isp
from rxcli.lab.simulate.optics import Lens, Pose
from rxcli.lab.simulate.pictures import load_picture
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.lab.simulate.sensor import Sensor

#: scikit-image's pictures that training may use; the others are for validation.
TRAINING_PHOTOS = ("camera", "coins", "hubble", "moon", "page", "retina")
VALIDATION_PICTURES = ("astronaut", "chelsea", "coffee", "motorcycle", "rocket", "flower", "sky", "text", "night")
_SCREENS, _SCREEN_SHARES = ("paper-34k6", "paper-17k3", "paper-8k65"), (0.45, 0.4, 0.15)
#: Width of simulated sensors: narrow ones are quick, and lateral pixels are averaged in strips anyway.
_WIDTHS = (800, 1400)
_MIN_EXPOSURE_S = 1 / 32000

Picture = NDArray[np.uint8]


def random_picture(rng: np.random.Generator, width: int, height: int) -> Picture:
    """A picture to learn from: part of a photograph, clouds, or scattered shapes, often darkened.

    Args:
        rng: source of all choices.
        width: pixels.
        height: pixels.

    Returns:
        (height, width, 3) uint8.
    """
    kind = rng.random()
    if kind < 0.4:
        drawn = _photo_part(rng, width, height)
    elif kind < 0.6:
        drawn = _clouds(rng, width, height)
    else:
        drawn = _shapes(rng, width, height)
    if rng.random() < 0.3:
        drawn = np.minimum(drawn, _writing(rng, width, height))
    tint = rng.uniform(0.5, 1.0, 3) if rng.random() < 0.5 else np.ones(3)
    gamma = np.exp(rng.normal(0.15, 0.5))
    return np.asarray(np.rint(255 * np.clip(drawn, 0, 1) ** gamma * tint), np.uint8)


def _photo_part(rng: np.random.Generator, width: int, height: int) -> NDArray[np.float64]:
    import cv2

    whole = load_picture(str(rng.choice(TRAINING_PHOTOS)), width, height)
    zoom = rng.uniform(1.0, 2.5)
    w, h = int(width / zoom), int(height / zoom)
    left, top = rng.integers(0, width - w + 1), rng.integers(0, height - h + 1)
    part = cv2.resize(whole[top : top + h, left : left + w], (width, height), interpolation=cv2.INTER_LINEAR)
    part = part[:: rng.choice([1, -1]), :: rng.choice([1, -1])]
    negative = rng.random() < 0.2
    return np.asarray((255.0 - part if negative else part) / 255.0)


def _clouds(rng: np.random.Generator, width: int, height: int) -> NDArray[np.float64]:
    """Gaussian noise of a random power law, smooth to rough."""
    fy, fx = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None]
    amplitude = 1 / np.maximum(np.hypot(fy, fx), 1 / width) ** rng.uniform(0.6, 2.2)
    phase = np.exp(2j * np.pi * rng.random((height, fx.size)))
    field = np.fft.irfft2(amplitude * phase, (height, width))
    field = (field - field.mean()) / field.std()
    return np.repeat((rng.uniform(0.1, 0.6) + rng.uniform(0.05, 0.3) * field)[..., None], 3, axis=2)


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


def _writing(rng: np.random.Generator, width: int, height: int) -> NDArray[np.float64]:
    import cv2

    page = np.full((height, width, 3), 255, np.uint8)
    size, ink = rng.uniform(0.4, 1.6), int(rng.integers(0, 128))
    for top in range(int(30 * size), height, int(rng.uniform(24, 60) * size)):
        text = "".join(chr(c) for c in rng.integers(33, 122, 90))
        cv2.putText(page, text, (int(rng.integers(0, 60)), top), 0, size, (ink, ink, ink), 1, cv2.LINE_AA)
    return page / 255.0


def training_scene(rng: np.random.Generator) -> Scene:
    """A scene to learn from; mostly hard, because on easy ones there is nothing to learn."""
    screen = preset("xs10-still", str(rng.choice(_SCREENS, p=_SCREEN_SHARES))).screen
    exposure_slots = rng.uniform(0.4, 1.6) if rng.random() < 0.7 else rng.uniform(1.6, 2.6)
    exposure_s = max(exposure_slots / screen.slot_rate_hz, _MIN_EXPOSURE_S)
    white_e = 10 ** rng.uniform(0.5, 2.0)
    width, height = int(rng.integers(*_WIDTHS)), int(rng.integers(2600, 4200))
    readout_s = rng.uniform(17e-3, 25e-3)
    sensor = Sensor(
        width,
        height,
        readout_s / height,
        "rgb" if rng.random() < 0.5 else "bayer",
        response=(float(rng.uniform(0.45, 0.7)), 1.0, float(rng.uniform(0.5, 0.75))),
        read_noise_e=float(rng.uniform(1.2, 4.0)),
        row_noise_e=float(rng.uniform(0.0, 0.5)),
        full_scale_e=white_e * float(rng.uniform(2.0, 5.0)),
        pixel_aspect=width / height / 1.45,
    )
    return Scene(
        screen,
        picture=random_picture(rng, screen.width_px, screen.height_px),
        w="dimming" if rng.random() < 0.3 else int(rng.choice([2, 3, 4, 5, 5, 5, 6, 7, 8])),
        sensor=sensor,
        lens=Lens(float(rng.uniform(0.75, 3.0)), (float(rng.normal(0, 0.04)), 0.0, 0.0, 0.0, 0.0)),
        pose=_random_pose(rng),
        room=Room(light_e_per_s=white_e / exposure_s * 10 ** rng.uniform(-3, -0.7)),
        isp=_random_isp(rng),
        exposure_s=exposure_s,
        light_e_per_s=white_e / exposure_s,
        blur_px=float(rng.uniform(0.3, 1.5)),
    )


def _random_pose(rng: np.random.Generator) -> Pose:
    return Pose(
        fill=float(rng.uniform(0.85, 0.96)),
        roll_deg=float(rng.normal(0, 0.7)),
        yaw_deg=float(rng.normal(0, 3)),
        pitch_deg=float(rng.normal(0, 2)),
    )


def _random_isp(rng: np.random.Generator) -> Isp:
    return Isp(
        tone="srgb" if rng.random() < 0.5 else "bt709",
        gain=float(rng.uniform(1.2, 3.0)),
        sharpen=float(rng.choice([0.0, rng.uniform(0, 1.0)])),
        denoise_px=float(rng.uniform(0, 0.7)),
        quality=int(rng.choice([75, 85, 90, 95])),
        subsampling="420",
    )


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
    camera = VALIDATION_CAMERAS[number % len(VALIDATION_CAMERAS)]
    picture = kind.pictures[number // len(VALIDATION_CAMERAS) % len(kind.pictures)]
    scene = preset(camera, screen)
    slots = kind.exposure_slots
    exposure_s = scene.exposure_s if slots is None else slots / scene.screen.slot_rate_hz
    scene = replace(
        scene,
        picture=picture,
        light_e_per_s=scene.light_e_per_s * kind.light * scene.exposure_s / exposure_s,
        exposure_s=exposure_s,
        isp=replace(scene.isp, quality=kind.quality),
        sensor=replace(scene.sensor, cfa="bayer"),
    )
    return scene.scaled(0.3, 1.0)
