"""Scenes: everything that one capture depends on, presets, and random ones."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from math import sqrt
from pathlib import Path
from typing import Any, Literal, Self, TypeVar, get_type_hints

import msgspec
import numpy as np
from numpy.typing import NDArray

from rxcli.errors import UsageError, failure_explained
from rxcli.lab.simulate.film import Film
from rxcli.lab.simulate.isp import Isp
from rxcli.lab.simulate.optics import Lens, Pose, View
from rxcli.lab.simulate.sensor import Sensor
from rxcli.lab.simulate.transmitter import Dimming, LabelSource, Waveform, Weights
from rxcli.profiles import ScreenProfile, load_profile

Output = Literal["raw", "developed"]


@dataclass(frozen=True)
class Room:
    """Light that does not come from the screen, in electrons per second of a green pixel seeing white paper."""

    light_e_per_s: float = 0.0
    #: Mains flicker: twice 50 or 60 Hz, and its depth 0..1.
    flicker_hz: float = 100.0
    flicker_depth: float = 0.3
    #: Share of the room's light that the dark panel throws back.
    panel_reflectance: float = 0.12
    wall_reflectance: float = 0.3
    bezel_reflectance: float = 0.03
    #: A lamp mirrored in the panel: its strength against white paper, its place (u, v) and size (in screen widths), and
    #: the exponent of its outline: 2 for a Gaussian, 20 for a window.
    lamp: float = 0.0
    lamp_place: tuple[float, float] = (0.7, 0.3)
    lamp_size: float = 0.12
    lamp_edge: float = 2.0
    #: Share of the screen's width that a person covers who stands before it, and the place (u, v) of their head's top.
    person: float = 0.0
    person_place: tuple[float, float] = (0.5, -0.4)
    #: Share of the screen's light that a glossy desk at its foot mirrors.
    desk: float = 0.0


@dataclass(frozen=True)
class Change:
    """What a camera does to a clip from some frame on."""

    frame: int
    #: Exposure or gain set anew: factor of the light.
    light: float = 1.0
    #: Focus set anew: standard deviation of the blur, pixels; None for the scene's.
    blur_px: float | None = None


@dataclass(frozen=True)
class Scene:
    """Screen, payload, camera and light of a capture; what a field leaves open is drawn from the caller's generator."""

    screen: ScreenProfile
    #: Name or path of the picture shown, or (height, width, 3) uint8.
    picture: str | NDArray[np.uint8] = "coffee"
    film: Film = field(default_factory=Film)
    w: Weights = 5
    dimming: Dimming = "max"
    #: Sent over and over; None for random bits.
    payload: bytes | None = None
    #: Gives labels to send instead, as the link layer has them.
    labels: LabelSource | None = None
    #: Light 0..1 by slot, (n,) of all columns or (columns, n), instead of packets.
    waveform: Waveform | None = None
    sensor: Sensor = field(default_factory=Sensor)
    lens: Lens = field(default_factory=Lens)
    pose: Pose = field(default_factory=Pose)
    room: Room = field(default_factory=Room)
    isp: Isp = field(default_factory=Isp)
    #: What a frame is in memory: the sensor's numbers, or luma after the ISP.
    output: Output = "developed"
    exposure_s: float = 1 / 32000
    #: Electrons per second of a green pixel that sees white at the screen's full average light.
    light_e_per_s: float = 0.95e6
    #: Standard deviation of the focus blur, pixels.
    blur_px: float = 1.0
    #: Depth of the panel's pixel structure; 1: colours side by side, black between the rows of pixels.
    panel: float = 0.5
    #: Time to 1/e of the share of the red light that lags, as phosphors do; 0 for red that blinks as the others.
    red_lag_s: float = 0.0
    red_lag_share: float = 0.9
    #: Share of a segment's light that spreads beyond the Gaussian of the screen's profile: 0.39 for 20 % of the light
    #: one segment away and 3 % two away.
    spread_tails: float = 0.0
    #: Share of the whole picture's light that lens and filters scatter evenly over every row.
    glare: float = 0.0
    vignetting: float = 0.15
    #: Slot at which row 0 of the first frame starts; None: anywhere in burst 0.
    start_slot: float | None = None
    slot_rate_error_ppm: float = 0.0
    #: Delay of every column, slots: one for all, or the largest of random ones as a `float`.
    column_delay_slots: float | tuple[float, ...] = 0.0
    n_frames: int = 1
    frame_rate_hz: float = 60.0
    #: How far a hand moves the picture from frame to frame, pixels on average; rows skew meanwhile.
    hand_px: float = 0.0
    #: Whether the camera turns and crops its frames so that the hand's motion does not show.
    stabilised: bool = False
    #: Share of the width and of the height by which its software moves rows of each frame smoothly, at most.
    warp: tuple[float, float] = (0.0, 0.0)
    #: Noise reduction over time: share of the frame before in each frame of a clip, and whether that one is mixed too.
    averaged: float = 0.0
    averages_again: bool = False
    #: In ascending order of frames; each rules until the next.
    changes: tuple[Change, ...] = ()
    #: EXIF orientation written to files.
    orientation: int = 1
    camera_name: str = "camera"
    make: str = "Example"
    model: str = "Camera"
    iso: int = 3200

    def __post_init__(self) -> None:
        """Refuse values that have no meaning."""
        for name in ("exposure_s", "light_e_per_s", "frame_rate_hz"):
            value = getattr(self, name)
            if not value > 0:
                raise UsageError(f"{name} must be positive (got {value})", "give a positive number")
        if self.n_frames < 1:
            raise UsageError(f"n_frames must be at least 1 (got {self.n_frames})", "ask for one frame or more")

    @property
    def is_mosaic(self) -> bool:
        """Whether a frame in memory is the sensor's mosaic; a sensor without filter array is always developed."""
        return self.output == "raw" and self.sensor.cfa != "rgb"

    @property
    def is_corrected(self) -> bool:
        """Whether the lens's distortion is taken out of a frame in memory; of a mosaic it never is."""
        return self.isp.correct_distortion and not self.is_mosaic

    @property
    def view(self) -> View:
        """How the camera sees the screen."""
        return View(self.screen, self.lens, self.pose, self.sensor.width, self.sensor.height, self.sensor.pixel_aspect)

    @property
    def real_slot_rate_hz(self) -> float:
        """Slots per second of the camera's clock."""
        return self.screen.slot_rate_hz * (1 + self.slot_rate_error_ppm * 1e-6)

    @property
    def rows_per_slot(self) -> float:
        """Sensor rows read during one slot."""
        return 1 / (self.sensor.line_delay_s * self.screen.slot_rate_hz)

    def exposed(self, exposure_s: float, factor: float = 1.0) -> Self:
        """The scene at another exposure, with as many electrons as before times `factor`."""
        light_e_per_s = self.light_e_per_s * (self.exposure_s / exposure_s) * factor
        return replace(self, exposure_s=exposure_s, light_e_per_s=light_e_per_s)

    def metered(self, slots: float | None) -> Self:
        """The scene at another exposure, the gain set by it: white stays white, and electrons grow with the time."""
        exposure_s = self.exposure_s if slots is None else slots / self.screen.slot_rate_hz
        ratio = exposure_s / self.exposure_s
        sensor = replace(self.sensor, full_scale_e=self.sensor.full_scale_e * ratio)
        return replace(self, exposure_s=exposure_s, sensor=sensor, iso=max(round(self.iso / ratio), 25))

    def read_in(self, readout_s: float) -> Self:
        """The scene before a sensor that reads all its rows in another time."""
        return replace(self, sensor=replace(self.sensor, line_delay_s=readout_s / self.sensor.height))

    def scaled(self, x: float, y: float | None = None, *, keep_readout: bool = False) -> Self:
        """The same view on a smaller sensor, for quick sweeps.

        Args:
            x: factor of the width.
            y: factor of the height; None for the same as `x`.
            keep_readout: keep the time of a whole readout (rows per slot change) instead of the line delay (the frame
                then shows less time).
        """
        y = x if y is None else y
        sensor = replace(
            self.sensor,
            width=max(round(self.sensor.width * x), 8),
            height=max(round(self.sensor.height * y), 8),
            line_delay_s=self.sensor.line_delay_s / (y if keep_readout else 1),
            pixel_aspect=self.sensor.pixel_aspect * x / y,
        )
        corners = self.pose.corners
        if corners is not None:
            corners = tuple(((a + 0.5) * x - 0.5, (b + 0.5) * y - 0.5) for a, b in corners)
        return replace(
            self,
            sensor=sensor,
            pose=replace(self.pose, corners=corners),
            blur_px=self.blur_px * sqrt(x * y),
            hand_px=self.hand_px * sqrt(x * y),
        )


#: Names of presets, in order.
PRESETS = ("xs10-still", "video-4k", "video-1080p", "phone-corrected", "phone-plain", "phone-video")


@lru_cache(maxsize=1)
def _presets() -> dict[str, dict[str, Any]]:
    """Fields of the scene by preset, from `presets.toml`."""
    text = Path(__file__).with_name("presets.toml").read_text(encoding="utf-8")
    found: dict[str, dict[str, Any]] = {}
    for name, table in tomllib.loads(text).items():
        found[name] = {**found.get(table.pop("like", ""), {}), **table}
    return found


def preset(name: str, screen: str | ScreenProfile = "paper-34k6") -> Scene:
    """A ready scene of one kind of camera.

    Args:
        name: one of `PRESETS`.
        screen: profile, or the name or path of one.

    Raises:
        UsageError: no such preset.
        ProfileError: no such screen.
    """
    if name not in PRESETS:
        raise UsageError(f"no preset {name!r}", f"choose from: {', '.join(PRESETS)}")
    profile = screen if isinstance(screen, ScreenProfile) else load_profile(screen, ScreenProfile)
    return with_fields(Scene(profile), _presets()[name])


Part = TypeVar("Part")


def with_fields(part: Part, table: Mapping[str, Any], place: str = "") -> Part:
    """A scene, or a part of one, with some fields set; those of a scene's parts stand in tables of their own.

    Args:
        part: scene, film, sensor, lens, pose, room or isp.
        table: fields as TOML has them.
        place: the part's name and a dot; nothing for a scene.

    Raises:
        UsageError: no such field, or no such value for it.
    """
    kinds, values = get_type_hints(type(part)), dict[str, Any]()
    for name, value in table.items():
        if name not in kinds:
            raise UsageError(f"{place}{name}: no such field", f"choose from: {', '.join(kinds)}")
        with failure_explained(f"{place}{name} = {value!r}", "see docs/simulator.md", UsageError):
            is_part, old = isinstance(value, dict), getattr(part, name)
            values[name] = with_fields(old, value, f"{name}.") if is_part else msgspec.convert(value, kinds[name])
    changed: Part = replace(part, **values)  # type: ignore[type-var]
    return changed
