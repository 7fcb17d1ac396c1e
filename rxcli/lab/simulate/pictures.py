"""Pictures for the screen: files, the ones that scikit-image ships, and generated ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError, UsageError

#: Pictures that come inside scikit-image's own package, without a download.
PHOTOS: dict[str, str] = {
    "astronaut": "astronaut.png",
    "camera": "camera.png",
    "chelsea": "chelsea.png",
    "coffee": "coffee.png",
    "coins": "coins.png",
    "hubble": "hubble_deep_field.jpg",
    "moon": "moon.png",
    "motorcycle": "motorcycle_left.png",
    "page": "page.png",
    "retina": "retina.jpg",
    "rocket": "rocket.jpg",
}
GENERATED = ("white", "grey", "sky", "gradient", "bars", "noise", "checker", "text", "flower", "night", "black")


def draw_name(rng: np.random.Generator) -> str:
    """The name of a picture that shows something."""
    return str(rng.choice([name for name in picture_names() if name != "black"]))


def picture_names() -> tuple[str, ...]:
    """Names that `load_picture` knows."""
    return (*PHOTOS, *GENERATED)


def load_picture(name: str, width: int, height: int) -> NDArray[np.uint8]:
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
    if name in GENERATED:
        return _generate(name, width, height)
    path = _photo_path(name) if name in PHOTOS else Path(name)
    return _fill(_read(path), width, height)


def _photo_path(name: str) -> Path:
    from importlib.util import find_spec

    spec = find_spec("skimage")
    if spec is None or spec.origin is None:
        raise InputError(
            f"picture {name!r} comes with scikit-image, which is not installed", "install it, or give a file"
        )
    return Path(spec.origin).parent / "data" / PHOTOS[name]


def _read(path: Path) -> NDArray[np.uint8]:
    from PIL import Image, ImageOps, UnidentifiedImageError

    try:
        with Image.open(path) as picture:
            return np.asarray(ImageOps.exif_transpose(picture).convert("RGB"), np.uint8)
    except FileNotFoundError:
        raise UsageError(f"{path}: no such picture", f"name a file or one of: {', '.join(picture_names())}") from None
    except (UnidentifiedImageError, OSError, ValueError) as error:
        raise InputError(f"{path}: not a picture that can be read ({error})", "give a PNG or JPEG") from None


def _fill(picture: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    import cv2

    scale = max(width / picture.shape[1], height / picture.shape[0])
    size = (max(width, round(picture.shape[1] * scale)), max(height, round(picture.shape[0] * scale)))
    scaled = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    left, top = (size[0] - width) // 2, (size[1] - height) // 2
    return np.ascontiguousarray(scaled[top : top + height, left : left + width], np.uint8)


def _generate(name: str, width: int, height: int) -> NDArray[np.uint8]:
    y, x = np.mgrid[0:height, 0:width]
    drawn = _draw(name, (x + 0.5) / width, (y + 0.5) / height)
    rgb = drawn if drawn.ndim == 3 else np.repeat(drawn[..., None], 3, axis=2)
    return np.asarray(np.rint(255 * np.clip(rgb, 0, 1)), np.uint8)


def _draw(name: str, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Grey or coloured picture values 0..1 at the places (u, v) of all pixels."""
    height, width = u.shape
    flat = {"white": 1.0, "grey": 0.5, "black": 0.0}
    drawers: dict[str, Callable[[], NDArray[np.float64]]] = {
        "sky": lambda: _sky(u, v),
        "gradient": lambda: 0.1 + 0.45 * (u + v),
        "bars": lambda: _bars(u),
        "noise": lambda: np.random.default_rng(7).uniform(0, 1, (height, width, 3)),
        "checker": lambda: 0.15 + 0.8 * ((np.floor(28 * u) + np.floor(16 * v)) % 2),
        "text": lambda: _text(width, height),
        "flower": lambda: _flower(u * width / height, v, width / height),
        "night": lambda: _night(u, v),
    }
    return np.full(u.shape, flat[name]) if name in flat else drawers[name]()


def _sky(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    haze = 0.04 * np.sin(7 * u + 3 * v) * np.sin(5 * v - 2 * u)
    fall = 1 - 0.35 * v + haze
    return np.stack([0.55 * fall, 0.72 * fall, 0.95 * fall], axis=-1)


def _bars(u: NDArray[np.float64]) -> NDArray[np.float64]:
    index = np.minimum((u * 8).astype(np.int64), 7)
    return 0.75 * np.stack([~index & 1, ~(index >> 1) & 1, ~(index >> 2) & 1], axis=-1) + 0.1


def _text(width: int, height: int) -> NDArray[np.float64]:
    import cv2

    page = np.full((height, width), 238, np.uint8)
    lines = (
        "The quick brown fox jumps over the lazy dog 0123456789",
        "Light is sent by columns, time is told by rows.",
    )
    for i, top in enumerate(range(30, height, 28)):
        cv2.putText(page, f"{i:02d} {lines[i % 2]} {lines[(i + 1) % 2]}", (16, top), 0, 0.62, 25, 1, cv2.LINE_AA)
    return page / 255.0


def _flower(x: NDArray[np.float64], y: NDArray[np.float64], aspect: float) -> NDArray[np.float64]:
    dx, dy = x - 0.5 * aspect, y - 0.5
    radius, angle = np.hypot(dx, dy), np.arctan2(dy, dx)
    petals = 0.28 + 0.16 * np.cos(6 * angle)
    inside = 1 / (1 + np.exp((radius - petals) * 60))
    shade = inside * (0.35 + 0.65 * np.clip(radius / 0.4, 0, 1))
    heart = np.exp(-((radius / 0.09) ** 2))
    leaves = 0.12 * np.clip(np.sin(9 * dx + 4 * dy) * np.sin(5 * dy - 3 * dx), 0, 1) + 0.02
    return np.stack(
        [0.95 * shade + 0.4 * heart + leaves * 0.3, 0.35 * shade + 0.5 * heart + leaves, 0.6 * shade], axis=-1
    )


def _night(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    moon = 0.9 / (1 + np.exp((np.hypot((u - 0.72) * 1.78, v - 0.3) - 0.1) * 150))
    windows = ((np.sin(u * 190) > 0.8) & (np.sin(v * 120) > 0.7) & (v > 0.65)) * 0.6
    base = 0.015 + 0.03 * v
    return np.stack([base + moon + windows, base + moon + 0.8 * windows, 1.6 * base + moon + 0.3 * windows], axis=-1)
