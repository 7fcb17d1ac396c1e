"""Pictures for the screen: files, the ones that scikit-image ships, generated ones, and random dark ones."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError, UsageError, failure_explained

Picture = NDArray[np.uint8]
#: Pictures that come inside scikit-image's own package, without a download, and their files.
_FILES = (
    *("astronaut.png", "camera.png", "chelsea.png", "coffee.png", "coins.png", "hubble_deep_field.jpg", "moon.png"),
    *("motorcycle_left.png", "page.png", "retina.jpg", "rocket.jpg"),
)
PHOTOS = {re.split("[._]", file)[0]: file for file in _FILES}


def draw_name(rng: np.random.Generator) -> str:
    """Draw the name of a picture that is not black."""
    return str(rng.choice([name for name in picture_names() if name != "black"]))


def picture_names() -> tuple[str, ...]:
    """Names that `load_picture` knows."""
    return (*PHOTOS, *_GENERATED)


def load_picture(name: str, width: int, height: int) -> Picture:
    """A picture cut and scaled to fill the screen.

    Args:
        name: one of `picture_names`, or the path of a picture file.
        width: of the screen, pixels.
        height: of the screen, pixels.

    Returns:
        (height, width, 3) uint8, red first.

    Raises:
        UsageError: no such name or file.
        InputError: a file that is no picture.
    """
    if name in _GENERATED:
        return _generate(name, width, height)
    path = _photo_path(name) if name in PHOTOS else Path(name)
    return _fill(_read(path), width, height)


def _photo_path(name: str) -> Path:
    from importlib.util import find_spec

    spec = find_spec("skimage")
    if spec is None or spec.origin is None:
        reason = f"picture {name!r} comes with scikit-image, which is not installed"
        raise InputError(reason, "install it, or give a file")
    return Path(spec.origin).parent / "data" / PHOTOS[name]


def _read(path: Path) -> Picture:
    from PIL import Image, ImageOps

    if not path.exists():
        raise UsageError(f"{path}: no such picture", f"name a file or one of: {', '.join(picture_names())}")
    with (
        failure_explained(f"{path}: not a picture that can be read", "give a PNG or JPEG"),
        Image.open(path) as picture,
    ):
        return np.asarray(ImageOps.exif_transpose(picture).convert("RGB"), np.uint8)


def _fill(picture: Picture, width: int, height: int) -> Picture:
    scale = max(width / picture.shape[1], height / picture.shape[0])
    size = (max(width, round(picture.shape[1] * scale)), max(height, round(picture.shape[0] * scale)))
    scaled = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    left, top = (size[0] - width) // 2, (size[1] - height) // 2
    return np.ascontiguousarray(scaled[top : top + height, left : left + width], np.uint8)


def _generate(name: str, width: int, height: int) -> Picture:
    y, x = np.mgrid[0:height, 0:width]
    drawn = _GENERATED[name]((x + 0.5) / width, (y + 0.5) / height)
    rgb = np.broadcast_to(np.atleast_3d(drawn), (height, width, 3))
    return np.asarray(np.rint(255 * np.clip(rgb, 0, 1)), np.uint8)


def _sky(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    haze = 0.04 * np.sin(7 * u + 3 * v) * np.sin(5 * v - 2 * u)
    fall = 1 - 0.35 * v + haze
    return np.stack([0.55 * fall, 0.72 * fall, 0.95 * fall], axis=-1)


def _bars(u: NDArray[np.float64]) -> NDArray[np.float64]:
    """Eight bars of colours, white to black, as of a test card; `u` is the place across, 0..1."""
    index = np.minimum((u * 8).astype(np.int64), 7)
    return 0.75 * np.stack([~index & 1, ~(index >> 1) & 1, ~(index >> 2) & 1], axis=-1) + 0.1


def _text(u: NDArray[np.float64], _v: NDArray[np.float64]) -> NDArray[np.float64]:
    page = np.full(u.shape, 238, np.uint8)
    lines = (
        "The quick brown fox jumps over the lazy dog 0123456789",
        "Light is sent by columns, time is told by rows.",
    )
    for i, top in enumerate(range(30, len(page), 28)):
        cv2.putText(page, f"{i:02d} {lines[i % 2]} {lines[(i + 1) % 2]}", (16, top), 0, 0.62, 25, 1, cv2.LINE_AA)
    return page / 255.0


def _flower(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    dx, dy = (u - 0.5) * u.shape[1] / u.shape[0], v - 0.5
    radius, angle = np.hypot(dx, dy), np.arctan2(dy, dx)
    petals = 0.28 + 0.16 * np.cos(6 * angle)
    inside = 1 / (1 + np.exp((radius - petals) * 60))
    shade = inside * (0.35 + 0.65 * np.clip(radius / 0.4, 0, 1))
    heart = np.exp(-((radius / 0.09) ** 2))
    leaves = 0.12 * np.clip(np.sin(9 * dx + 4 * dy) * np.sin(5 * dy - 3 * dx), 0, 1) + 0.02
    red, green = 0.95 * shade + 0.4 * heart + leaves * 0.3, 0.35 * shade + 0.5 * heart + leaves
    return np.stack([red, green, 0.6 * shade], axis=-1)


def _night(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    moon = 0.9 / (1 + np.exp((np.hypot((u - 0.72) * 1.78, v - 0.3) - 0.1) * 150))
    windows = ((np.sin(u * 190) > 0.8) & (np.sin(v * 120) > 0.7) & (v > 0.65)) * 0.6
    base = 0.015 + 0.03 * v
    return np.stack([base + moon + windows, base + moon + 0.8 * windows, 1.6 * base + moon + 0.3 * windows], axis=-1)


#: Name of a generated picture -> its values 0..1 at places 0..1 across and down.
_GENERATED: dict[str, Callable[[NDArray[np.float64], NDArray[np.float64]], Any]] = {
    "white": lambda u, v: 1.0,
    "grey": lambda u, v: 0.5,
    "sky": _sky,
    "gradient": lambda u, v: 0.1 + 0.45 * (u + v),
    "bars": lambda u, v: _bars(u),
    "noise": lambda u, v: np.random.default_rng(7).uniform(0, 1, (*u.shape, 3)),
    "checker": lambda u, v: 0.15 + 0.8 * ((np.floor(28 * u) + np.floor(16 * v)) % 2),
    "text": _text,
    "flower": _flower,
    "night": _night,
    "black": lambda u, v: 0.0,
}


# Random pictures that are mostly black: films with bars, windows on dark desktops, night, stars. They hide
# a screen's sides from a camera: no light, no edge.

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
    return _DARK[kind](rng, width, height)


def draw_part(name: str, rng: np.random.Generator, width: int, height: int, max_zoom: float = 1.5) -> Picture:
    """Part of a picture, perhaps mirrored either way; (height, width, 3) uint8, red first."""
    whole = load_picture(name, width, height)
    zoom = rng.uniform(1.0, max_zoom)
    w, h = int(width / zoom), int(height / zoom)
    left, top = rng.integers(0, width - w + 1), rng.integers(0, height - h + 1)
    part = cv2.resize(whole[top : top + h, left : left + w], (width, height), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(part[:: rng.choice([1, -1]), :: rng.choice([1, -1])], np.uint8)


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
    out = np.full((height, width, 3), int(rng.choice([0, 12, 24])), np.uint8)
    step, letters = int(rng.integers(16, 26)), np.array(list("abcdefghijklmnopqrstuvwxyz0123456789/-_.:=      "))
    colour = [int(c) for c in rng.integers(120, 256, 3)]
    for top in range(step, height, step):
        if rng.random() < 0.9:
            text = "".join(rng.choice(letters, int(rng.integers(8, 110))))
            cv2.putText(out, text, (6, top), 0, step / 40, colour, 1, cv2.LINE_AA)
    return out


def _lit_night(rng: np.random.Generator, width: int, height: int) -> Picture:
    v, u = np.mgrid[0:height, 0:width] / np.array([height, width])[:, None, None]
    light = np.full((height, width, 3), 0.0) + (rng.uniform(0.003, 0.03) + rng.uniform(0, 0.05) * v)[..., None]
    for _ in range(int(rng.integers(3, 14))):
        x, y, size = rng.uniform(0, 1), rng.uniform(0.1, 1), rng.uniform(0.008, 0.09)
        lamp = np.exp(-(((u - x) * width / height) ** 2 + (v - y) ** 2) / (2 * size**2))
        light += lamp[..., None] * rng.uniform(0.3, 1.2) * rng.uniform(0.5, 1.0, 3)
    return np.asarray(255 * np.clip(light, 0, 1) ** (1 / 1.4), np.uint8)


def _stars(rng: np.random.Generator, width: int, height: int) -> Picture:
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


_DARK: dict[str, Callable[[np.random.Generator, int, int], Picture]] = {
    "letterbox": _letterbox,
    "pillarbox": _pillarbox,
    "window": _window,
    "terminal": _terminal,
    "night": _lit_night,
    "stars": _stars,
    "dark sides": _dark_sides,
}
#: Kinds that `draw_dark_picture` knows.
DARK_KINDS = tuple(_DARK)
