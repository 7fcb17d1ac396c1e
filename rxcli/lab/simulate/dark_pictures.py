"""Pictures most of which are black, drawn at random: films with bars, windows on dark desktops, night, stars.

They are what hides a screen's sides from a camera: no light, no edge.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rxcli.lab.simulate.pictures import load_picture

Picture = NDArray[np.uint8]
_BRIGHT = ("astronaut", "chelsea", "coffee", "motorcycle", "rocket", "sky", "gradient", "page", "flower", "hubble")
_FILM_SHAPES, _OLD_SHAPES = (2.0, 2.39), (1.0, 4 / 3)


def draw_dark_picture(kind: str, rng: np.random.Generator, width: int, height: int) -> Picture:
    """A picture of one of `DARK_KINDS`.

    Args:
        kind: which.
        rng: source of all that the kind leaves open.
        width: of the screen, pixels.
        height: of the screen, pixels.

    Returns:
        (height, width, 3) uint8, red first.
    """
    return _DRAWERS[kind](rng, width, height)


def _photo(rng: np.random.Generator, width: int, height: int) -> Picture:
    picture = load_picture(str(rng.choice(_BRIGHT)), width, height)
    return np.ascontiguousarray(picture[:, ::-1] if rng.random() < 0.5 else picture)


def _set_in(picture: Picture, left: int, top: int, width: int, height: int, ground: int = 0) -> Picture:
    out = np.full((height, width, 3), ground, np.uint8)
    out[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return out


def _letterbox(rng: np.random.Generator, width: int, height: int) -> Picture:
    inner = round(width / rng.uniform(*_FILM_SHAPES))
    return _set_in(_photo(rng, width, inner), 0, (height - inner) // 2, width, height)


def _pillarbox(rng: np.random.Generator, width: int, height: int) -> Picture:
    inner = round(height * rng.uniform(*_OLD_SHAPES))
    return _set_in(_photo(rng, inner, height), (width - inner) // 2, 0, width, height)


def _window(rng: np.random.Generator, width: int, height: int) -> Picture:
    w, h = round(width * rng.uniform(0.35, 0.85)), round(height * rng.uniform(0.4, 0.85))
    left, top = int(rng.integers(0, width - w + 1)), int(rng.integers(0, height - h + 1))
    page = _photo(rng, w, h) if rng.random() < 0.5 else np.full((h, w, 3), int(rng.integers(140, 250)), np.uint8)
    return _set_in(page, left, top, width, height, int(rng.choice([0, 8, 20, 32])))


def _terminal(rng: np.random.Generator, width: int, height: int) -> Picture:
    import cv2

    out = np.full((height, width, 3), int(rng.choice([0, 12, 24])), np.uint8)
    step, letters = int(rng.integers(16, 26)), np.array(list("abcdefghijklmnopqrstuvwxyz0123456789/-_.:=      "))
    colour = [int(c) for c in rng.integers(120, 256, 3)]
    for top in range(step, height, step):
        if rng.random() < 0.9:
            text = "".join(rng.choice(letters, int(rng.integers(8, 110))))
            cv2.putText(out, text, (6, top), 0, step / 40, colour, 1, cv2.LINE_AA)
    return out


def _night(rng: np.random.Generator, width: int, height: int) -> Picture:
    v, u = np.mgrid[0:height, 0:width] / np.array([height, width])[:, None, None]
    light = np.full((height, width, 3), 0.0) + (rng.uniform(0.003, 0.03) + rng.uniform(0, 0.05) * v)[..., None]
    for _ in range(int(rng.integers(3, 14))):
        x, y, size = rng.uniform(0, 1), rng.uniform(0.1, 1), rng.uniform(0.008, 0.09)
        lamp = np.exp(-(((u - x) * width / height) ** 2 + (v - y) ** 2) / (2 * size**2))
        light += lamp[..., None] * rng.uniform(0.3, 1.2) * rng.uniform(0.5, 1.0, 3)
    return np.asarray(255 * np.clip(light, 0, 1) ** (1 / 1.4), np.uint8)


def _stars(rng: np.random.Generator, width: int, height: int) -> Picture:
    import cv2

    sky = np.zeros((height, width), np.float32)
    n = int(rng.integers(150, 1200))
    sky[rng.integers(0, height, n), rng.integers(0, width, n)] = rng.pareto(1.5, n).clip(0, 30)
    sky = cv2.GaussianBlur(sky, (0, 0), float(rng.uniform(0.8, 2.0)))
    haze = cv2.resize(rng.random((4, 6)).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    light = 2 * sky + rng.uniform(0, 0.06) * np.clip(haze, 0, 1) ** 2
    return np.repeat(np.asarray(255 * np.clip(light, 0, 1), np.uint8)[..., None], 3, axis=2)


def _dark_sides(rng: np.random.Generator, width: int, height: int) -> Picture:
    """A photograph in a round or slanted light that leaves sides and corners dark."""
    v, u = np.mgrid[0:height, 0:width] / np.array([height, width])[:, None, None]
    x, y, angle = rng.uniform(0.3, 0.7), rng.uniform(0.3, 0.7), rng.uniform(0, 2 * np.pi)
    along = (u - x) * np.cos(angle) + (v - y) * np.sin(angle)
    radius = np.hypot((u - x) * width / height, v - y)
    shade = 1 / (1 + np.exp((radius - rng.uniform(0.35, 0.6)) * 18 if rng.random() < 0.5 else along * 14))
    return np.asarray(_photo(rng, width, height) * shade[..., None], np.uint8)


_DRAWERS: dict[str, Callable[[np.random.Generator, int, int], Picture]] = {
    "letterbox": _letterbox,
    "pillarbox": _pillarbox,
    "window": _window,
    "terminal": _terminal,
    "night": _night,
    "stars": _stars,
    "dark sides": _dark_sides,
}
#: Kinds that `draw_dark_picture` knows.
DARK_KINDS = tuple(_DRAWERS)
