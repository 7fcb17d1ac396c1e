"""Scenes: everything that one capture depends on, presets, and random ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import sqrt
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import UsageError
from rxcli.lab.simulate.camera import Room
from rxcli.lab.simulate.isp import Isp
from rxcli.lab.simulate.optics import Lens, Pose
from rxcli.lab.simulate.pictures import draw_name
from rxcli.lab.simulate.sensor import Sensor
from rxcli.lab.simulate.transmitter import Dimming, LabelSource, Weights
from rxcli.profiles import ScreenProfile, load_profile

Output = Literal["raw", "developed"]


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
    w: Weights = 5
    dimming: Dimming = "max"
    #: Sent over and over; None for random bits.
    payload: bytes | None = None
    #: Gives labels to send instead, as the link layer has them.
    labels: LabelSource | None = None
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
    lcd_grid: float = 0.5
    vignetting: float = 0.15
    #: Slot at which row 0 of the first frame starts; None: anywhere in burst 0.
    start_slot: float | None = None
    slot_rate_error_ppm: float = 0.0
    #: Delay of every column, slots: one for all, or the largest of random ones as a `float`.
    column_delay_slots: float | tuple[float, ...] = 0.0
    n_frames: int = 1
    frame_rate_hz: float = 60.0
    #: Amplitude of the hand's shake, pixels.
    shake_px: float = 0.0
    #: How far a hand moves the picture from frame to frame, pixels on average; rows skew meanwhile.
    hand_px: float = 0.0
    #: Whether the camera turns and crops its frames so that the hand's motion does not show.
    stabilised: bool = False
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
    def rows_per_slot(self) -> float:
        """Sensor rows read during one slot."""
        return 1 / (self.sensor.line_delay_s * self.screen.slot_rate_hz)

    def scaled(self, x: float, y: float | None = None, *, keep_readout: bool = False) -> Scene:
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
            shake_px=self.shake_px * sqrt(x * y),
            hand_px=self.hand_px * sqrt(x * y),
        )


def _xs10_still(screen: ScreenProfile) -> Scene:
    return Scene(
        screen,
        lens=Lens(19000 / 6240, (-0.06, 0.02, 0.0005, -0.0003, 0.0)),
        pose=Pose(fill=0.965, roll_deg=0.35, yaw_deg=2.0, pitch_deg=-1.0),
        room=Room(light_e_per_s=8e4),
        isp=Isp(tone="srgb", gain=1.6, denoise_px=0.35, denoise_colour_px=1.0, subsampling="422", quality=93),
        camera_name="xs10",
        make="FUJIFILM",
        model="X-S10",
    )


def _xs10_video(screen: ScreenProfile, width: int, height: int, readout_s: float, name: str) -> Scene:
    return replace(
        _xs10_still(screen),
        sensor=Sensor(width, height, readout_s / height, "rgb", full_scale_e=400.0, read_noise_e=3.0),
        lens=Lens(2.5, (-0.05, 0.02, 0.0, 0.0002, 0.0)),
        pose=Pose(fill=0.86, roll_deg=0.3, yaw_deg=1.0, pitch_deg=0.5),
        room=Room(light_e_per_s=3e5),
        isp=Isp(tone="bt709", gain=1.3, sharpen=0.3, denoise_px=0.6),
        blur_px=0.7,
        camera_name=name,
    )


def _video_4k(screen: ScreenProfile) -> Scene:
    scene = _xs10_video(screen, 3840, 2160, 20.35e-3, "video4k")
    return replace(scene, n_frames=24, frame_rate_hz=30000 / 1001, light_e_per_s=2.4e6, shake_px=1.5)


def _video_1080p(screen: ScreenProfile) -> Scene:
    scene = _xs10_video(screen, 1920, 1080, 12.74e-3, "video1080")
    return replace(
        scene, n_frames=48, frame_rate_hz=60000 / 1001, light_e_per_s=2.4e6, exposure_s=1 / 16000, shake_px=1.0
    )


def _phone_corrected(screen: ScreenProfile) -> Scene:
    return Scene(
        screen,
        sensor=Sensor(
            4032, 3024, 5.6e-6, "bayer", full_scale_e=260.0, read_noise_e=2.0, black_level=64, white_level=1023
        ),
        lens=Lens(0.78, (0.07, -0.09, 0.0004, 0.0006, 0.0)),
        pose=Pose(fill=0.92, roll_deg=1.2, yaw_deg=3.0, pitch_deg=-2.0),
        room=Room(light_e_per_s=1.2e5),
        isp=Isp(tone="bt709", gain=2.0, sharpen=0.8, denoise_px=0.5, correct_distortion=True, quality=90),
        exposure_s=1 / 24000,
        light_e_per_s=1.7e6,
        camera_name="phone12",
        model="Phone 12MP",
    )


def _phone_plain(screen: ScreenProfile) -> Scene:
    return replace(
        _phone_corrected(screen),
        sensor=Sensor(
            4000, 3000, 7.1e-6, "bayer", full_scale_e=220.0, read_noise_e=2.4, black_level=256, white_level=4095
        ),
        lens=Lens(0.82, (-0.03, 0.01, 0.0, 0.0, 0.0)),
        isp=Isp(tone="srgb", gain=1.8, sharpen=0.5, denoise_px=0.4, quality=93),
        exposure_s=1 / 20000,
        camera_name="phone12b",
        model="Phone 12MP B",
    )


PRESETS: dict[str, Callable[[ScreenProfile], Scene]] = {
    "xs10-still": _xs10_still,
    "video-4k": _video_4k,
    "video-1080p": _video_1080p,
    "phone-corrected": _phone_corrected,
    "phone-plain": _phone_plain,
}


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
    return PRESETS[name](profile)


def random_scene(rng: np.random.Generator) -> Scene:
    """A scene that a person might meet: any preset, screen, picture, pose, light and exposure."""
    base = preset(str(rng.choice(list(PRESETS))), str(rng.choice(["paper-8k65", "paper-17k3", "paper-34k6"])))
    exposure_slots = float(rng.choice([0.25, 0.5, 1.0, 1.5, 2.0])) * rng.uniform(0.8, 1.2)
    exposure_s = max(exposure_slots / base.screen.slot_rate_hz, 1 / 32000)
    upside_down = rng.random() < 0.15
    pose = replace(
        base.pose,
        fill=rng.uniform(0.6, 0.97),
        roll_deg=rng.normal(0, 1.5) + 180 * upside_down,
        yaw_deg=rng.normal(0, 6),
        pitch_deg=rng.normal(0, 5),
        shift_x=rng.normal(0, 0.02),
        shift_y=rng.normal(0, 0.02),
    )
    return replace(
        base,
        picture=draw_name(rng),
        w="dimming" if rng.random() < 0.3 else int(rng.integers(2, 9)),
        pose=pose,
        room=replace(
            base.room,
            light_e_per_s=base.light_e_per_s * 10 ** rng.uniform(-3, -0.5),
            flicker_hz=float(rng.choice([100, 120])),
            lamp=float(rng.choice([0.0, rng.uniform(0, 0.05)])),
        ),
        exposure_s=exposure_s,
        light_e_per_s=base.light_e_per_s * (base.exposure_s / exposure_s) * 10 ** rng.uniform(-0.7, 0.3),
        blur_px=rng.uniform(0.4, 3.0),
        slot_rate_error_ppm=rng.uniform(-100, 100),
        column_delay_slots=float(rng.choice([0.0, rng.uniform(0, 2)])),
        n_frames=1,
        orientation=3 if upside_down else 1,
        output="raw" if rng.random() < 0.3 else "developed",
    )
