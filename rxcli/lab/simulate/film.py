"""Films: what the screen shows over time, and what its panel makes of it.

A refresh writes the panel from top to bottom: refresh `k` writes the row at height `v` at `k + v * scan` refreshes. The
cells follow exponentially. So a tear runs through a camera's frames, where rows show the last refresh and rows the one
before. The backlight follows the picture from burst to burst.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from rxcli.errors import UsageError
from rxcli.lab.simulate.pictures import DARK_KINDS, PHOTOS, Picture, draw_dark_picture, draw_part, load_picture
from rxcli.lab.simulate.transmitter import PANEL_LEAKAGE, Drive, Float32Array

#: Refreshes that a cell remembers.
_HISTORY = 4
#: Refreshes before a clip: cuts and strokes have begun.
_LEAD = 600
#: Refreshes of a zoom in or out, of a scroll with its rest, and of a subtitle; largest zoom.
_ZOOM_TURN, _STROKE, _SUBTITLE = 90, 45, 50
FilmKind = Literal["pan", "zoom", "cut", "scenes", "scroll", "window", "subtitles", "pointer"]
_LETTERS = tuple("abcdefghijklmnopqrstuvwxyz ,.   ")


@dataclass(frozen=True)
class Film:
    """What a screen shows over time, and how its panel follows."""

    #: Parts joined by "+", each with numbers after ":", such as "pan:4,-2", "cut:12+subtitles", "zoom:1.01+window";
    #: see `PARTS`. Nothing for a picture at rest.
    shows: str = ""
    #: Pictures of the film a second, and writings of the panel.
    content_hz: float = 60.0
    refresh_hz: float = 60.0
    #: Share of a refresh in which the panel is written.
    scan: float = 0.95
    #: Time to 1/e in which cells follow.
    response_s: float = 4e-3
    #: Whether every other refresh is black.
    black: bool = False

    def __post_init__(self) -> None:
        """Refuse values that have no meaning."""
        for name in ("content_hz", "refresh_hz", "scan", "response_s"):
            value = getattr(self, name)
            if not value > 0:
                raise UsageError(f"film.{name} must be positive (got {value})", "give a positive number")
        _ = self.parts

    @cached_property
    def parts(self) -> list[tuple[str, tuple[float, ...]]]:
        """Names and numbers of the parts, in order."""
        parts = []
        for part in filter(None, self.shows.split("+")):
            name, _, numbers = part.partition(":")
            try:
                values = tuple(float(number) for number in numbers.split(",") if number)
            except ValueError:
                values = (np.nan,)
            allowed = range(*PARTS[name][1]) if name in PARTS else ()
            if len(values) not in allowed or not np.isfinite(values).all() or (name in _POSITIVE and values[0] <= 0):
                reason = f"film {self.shows!r}: {part!r} is no part of a film"
                raise UsageError(reason, "give pan:X[,Y], zoom:FACTOR, cut:N, scroll:Y, window, subtitles, pointer")
            parts.append((name, values))
        return parts


@dataclass(frozen=True)
class Player:
    """Plays the film of one clip.

    Args:
        film: what is shown.
        start: picture that the film begins with.
        drive_for: drives the screen for a picture.
        seed: of all that the film leaves open.
        burst_0_s: time of the clip at which burst 0 starts.
        burst_s: time from burst to burst.
    """

    film: Film
    start: Picture
    drive_for: Callable[[Picture], Drive]
    seed: int
    burst_0_s: float
    burst_s: float

    @cached_property
    def _phase(self) -> float:
        return _LEAD + float(np.random.default_rng([self.seed, 29]).random())

    @cached_property
    def drive(self) -> Callable[[int], Drive]:
        """The drive for a picture of the film, by its number."""
        return lru_cache(maxsize=6)(lambda number: self.drive_for(self.picture(number)))

    def drive_in(self, burst: int) -> Drive:
        """The drive of the backlight in a burst: for the picture that is written when it starts."""
        return self.drive(self.number(int(self.refreshes(self.burst_0_s + burst * self.burst_s))))

    @cached_property
    def weights_in(self) -> Callable[[int], NDArray[np.int64]]:
        """Lit slots per symbol of a burst, as the picture dims the columns."""
        return lru_cache(maxsize=None)(lambda burst: self.drive_in(burst).weights)

    @cached_property
    def start_number(self) -> int:
        """Number of the picture that is written when the clip starts."""
        return self.number(int(self.refreshes(0.0)))

    def refreshes(self, time_s: NDArray[np.float64] | float, height: Any = 0.0) -> NDArray[np.float64]:
        """Number of the last refresh of rows at a height 0..1 at times of the clip, and refreshes since then."""
        return np.asarray(time_s * self.film.refresh_hz + self._phase - self.film.scan * height)

    def number(self, refresh: int) -> int:
        """Number of the picture that a refresh writes."""
        return int(refresh * self.film.content_hz / self.film.refresh_hz + 1e-6)

    def picture(self, number: int) -> Picture:
        """A picture of the film; (height, width, 3) uint8."""
        refresh, picture = number * self.film.refresh_hz / self.film.content_hz, self.start
        for turn, (name, values) in enumerate(self.film.parts):
            picture = PARTS[name][0](picture, refresh, [self.seed, turn], *values)
        return picture

    def panel(self, refresh: int) -> tuple[Float32Array, Float32Array]:
        """(height, width, 3) transmittance that a refresh writes, and the one that it finds."""
        keep = np.float32(np.exp(-1 / (self.film.refresh_hz * self.film.response_s)))
        before = self._written(refresh - _HISTORY)
        for number in range(refresh - _HISTORY + 1, refresh):
            written = self._written(number)
            before = written + keep * (before - written)
        return self._written(refresh), before

    def _written(self, refresh: int) -> Float32Array:
        light = self.drive(self.number(refresh)).transmittance
        return np.full_like(light, PANEL_LEAKAGE) if self.film.black and refresh % 2 else light


# Parts of a film: picture, refreshes since its start, seed, numbers -> picture.

Seed = list[int]


def _moved(picture: Picture, x: float, y: float, zoom: float = 1.0) -> Picture:
    """The picture zoomed about its middle and moved on a ground of its mirror images."""
    height, width = picture.shape[:2]
    middle = np.array([width - 1, height - 1]) / 2
    back = np.column_stack([np.eye(2) / zoom, middle - middle / zoom - [x, y]])
    how = {"flags": cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, "borderMode": cv2.BORDER_REFLECT}
    return np.asarray(cv2.warpAffine(picture, back, (width, height), **how), np.uint8)


def _zoom(picture: Picture, refresh: float, seed: Seed, factor: float) -> Picture:
    turn = refresh % (2 * _ZOOM_TURN)
    return _moved(picture, 0, 0, max(factor, 1 / factor) ** min(turn, 2 * _ZOOM_TURN - turn))


def _cut(picture: Picture, refresh: float, seed: Seed, every: float) -> Picture:
    return _photo(np.random.default_rng([*seed, int(refresh / every)]), picture)


def _photo(rng: np.random.Generator, picture: Picture) -> Picture:
    """Part of a photograph, as large as the picture."""
    return draw_part(str(rng.choice(list(PHOTOS))), rng, picture.shape[1], picture.shape[0])


def _scroll(picture: Picture, refresh: float, seed: Seed, step: float) -> Picture:
    """A page moved in strokes of a wheel or finger, with rests."""
    stroke, since = divmod(refresh, _STROKE)
    page = load_picture("text", picture.shape[1], 2 * picture.shape[0])
    scrolled = round(step * (stroke * _STROKE / 2 + min(since, _STROKE / 2)))
    return np.ascontiguousarray(np.roll(page, -scrolled, axis=0)[: picture.shape[0]])


def _window(picture: Picture, refresh: float, seed: Seed) -> Picture:
    """The film so far in a window of a desktop at rest."""
    rng, (height, width) = np.random.default_rng(seed), picture.shape[:2]
    kind = str(rng.choice([*DARK_KINDS, *["photo"] * len(DARK_KINDS)]))
    desk = _photo(rng, picture) if kind == "photo" else draw_dark_picture(kind, rng, width, height)
    share = rng.uniform(0.4, 0.85)
    size = round(width * share), round(height * share)
    left, top = int(rng.integers(0, width - size[0] + 1)), int(rng.integers(0, height - size[1] + 1))
    desk = desk.copy()
    desk[top : top + size[1], left : left + size[0]] = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    return desk


def _subtitles(picture: Picture, refresh: float, seed: Seed) -> Picture:
    number, since = divmod(refresh, _SUBTITLE)
    if since > 0.8 * _SUBTITLE:
        return picture
    rng, (height, width), out = np.random.default_rng([*seed, int(number)]), picture.shape[:2], picture.copy()
    text = "".join(rng.choice(_LETTERS, int(rng.integers(12, 40))))
    size = height / 700
    place = (round((width - 19 * size * len(text)) / 2), round(0.92 * height))
    for colour, weight in (((0, 0, 0), 6), ((235, 235, 235), 2)):
        cv2.putText(out, text, place, 0, size, colour, max(round(weight * size), 1), cv2.LINE_AA)
    return out


def _pointer(picture: Picture, refresh: float, seed: Seed) -> Picture:
    """An arrow on its way around the screen."""
    height, width = picture.shape[:2]
    angle = refresh * 2 * np.pi / 150 + np.random.default_rng(seed).uniform(0, 2 * np.pi, 2)
    tip = np.array([width, height]) * (0.5 + 0.35 * np.sin(angle * [1.0, 1.3]))
    arrow = np.rint(tip + np.array([[0, 0], [0, 17], [5, 13], [12, 12]]) * height / 700).astype(np.int32)
    return np.asarray(cv2.fillPoly(picture.copy(), [arrow], (250, 250, 250), cv2.LINE_AA), np.uint8)


#: Name of a part -> what draws it, and how many numbers it takes (a range). Those of `_POSITIVE` are positive.
PARTS: dict[str, tuple[Callable[..., Picture], tuple[int, int]]] = {
    "pan": (lambda picture, refresh, _seed, x, y=0.0: _moved(picture, -x * refresh, -y * refresh), (1, 3)),
    "zoom": (_zoom, (1, 2)),
    "cut": (_cut, (1, 2)),
    "scroll": (_scroll, (1, 2)),
    "window": (_window, (0, 1)),
    "subtitles": (_subtitles, (0, 1)),
    "pointer": (_pointer, (0, 1)),
}
_POSITIVE = ("zoom", "cut")


def draw_film(kind: FilmKind, rng: np.random.Generator) -> Film:
    """A film of one of `FILM_KINDS`, with what people's screens differ in."""
    content_hz, black = float(rng.choice([24.0, 30.0, 60.0])), bool(rng.random() < _BLACK)
    panel = {"scan": rng.uniform(*_SCAN), "response_s": float(np.exp(rng.uniform(*_RESPONSE)))}
    return Film(FILM_KINDS[kind](rng), content_hz, black=black, **panel)


def _drawn_pan(rng: np.random.Generator) -> str:
    """Mostly across, often along the rows alone."""
    speed, angle = float(np.exp(rng.uniform(*_PAN))), rng.choice([0.0, rng.normal(0, 0.5)]) + np.pi * rng.integers(2)
    return f"pan:{speed * np.cos(angle):.2f},{speed * np.sin(angle):.2f}"


def _drawn_any(rng: np.random.Generator) -> str:
    drawn: FilmKind = rng.choice(["pan", "zoom", "cut"])
    return FILM_KINDS[drawn](rng)


#: Logarithms of cells' response (seconds) and of a pan's speed (panel pixels a refresh); share of a refresh that is
#: written; share of screens with black frames.
_RESPONSE, _PAN, _SCAN, _BLACK = (np.log(1e-3), np.log(12e-3)), (np.log(0.5), np.log(16.0)), (0.5, 0.98), 0.1
#: Kinds that `draw_film` knows.
FILM_KINDS: dict[FilmKind, Callable[[np.random.Generator], str]] = {
    "pan": _drawn_pan,
    "zoom": lambda rng: f"zoom:{1 + np.exp(rng.uniform(-7, -3.5)):.4f}",
    "cut": lambda rng: f"cut:{rng.integers(4, 60)}",
    "scenes": lambda rng: f"cut:{rng.integers(10, 60)}+{_drawn_pan(rng)}",
    "scroll": lambda rng: f"scroll:{rng.integers(2, 25)}",
    "window": lambda rng: f"{_drawn_any(rng)}+window",
    "subtitles": lambda rng: "+".join([*([_drawn_any(rng)] if rng.random() < 0.5 else []), "subtitles"]),
    "pointer": lambda rng: "+".join([*([_drawn_any(rng) + "+window"] if rng.random() < 0.5 else []), "pointer"]),
}
