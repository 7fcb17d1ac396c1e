"""Populations: captures as people take them, drawn from what differs between phones, screens, rooms and hands."""

from dataclasses import replace
from math import inf
from typing import Any

import msgspec
import numpy as np

from rxcli.lab.simulate.film import FilmKind, draw_film
from rxcli.lab.simulate.isp import Isp
from rxcli.lab.simulate.optics import FloatArray, Lens, Pose
from rxcli.lab.simulate.pictures import DARK_KINDS, PHOTOS, draw_dark_picture, draw_part
from rxcli.lab.simulate.scenes import Scene, preset, with_fields

Generator = np.random.Generator
Range = tuple[float, float]
#: Photographs that light most of a screen.
_BRIGHT = tuple(sorted(set(PHOTOS) - {"hubble", "moon", "retina"}))
#: Light of a white screen (electrons a second and pixel), and how far above it a picture's white lies.
_LIGHT, _HEADROOM = (0.9e6, 2.2e6), (1.6, 2.4)
#: Light of a dark room and of a lighted one against a white screen, powers of ten.
_DARK_ROOM, _LIGHTED_ROOM = (-4.0, -2.5), (-2.0, -0.8)
#: Standard deviations of roll, yaw and pitch, degrees, and of the place (1: at the picture's edge) with an aim of 1.
_ANGLES_DEG, _PLACE = (1.2, 4.0, 3.0), 0.35
#: Narrower sensors see a panel of fewer pixels: drawing the picture would take longer than its reception.
_NARROW_PX, _SMALL_PANEL_PX = 700, (342, 192)
#: Share of films whose segments follow the picture; those of others are lit evenly.
_SEGMENTS_DIMMED = 0.7
#: Share of pictures that a camera held upside down takes, and of screens whose columns light by the picture.
_UPSIDE_DOWN, _DIMMED = 0.15, 0.3


class Population(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What is drawn; ranges are (lowest, highest), those of times and exposures even on a logarithmic scale."""

    #: Presets of cameras. Those called "phone..." get a lens and a development of their own.
    cameras: tuple[str, ...] = ("phone-plain",)
    screens: tuple[str, ...] = ("paper-8k65", "paper-17k3", "paper-34k6")
    #: As camera apps and people choose them; the gain follows, so that white stays white.
    exposure_slots: Range = (0.4, 10.0)
    #: Time in which a phone reads its rows; bodies keep their own.
    readout_s: Range = (10e-3, 31e-3)
    #: Packet lengths in view.
    packets: Range = (1.25, inf)
    #: Share of the picture's height that the screen takes, as far as its width allows.
    fill: Range = (0.6, 0.97)
    #: How far people's aim strays; 0 for a camera straight before the screen.
    aim: float = 1.0
    #: Roll, yaw and pitch of a camera held at will, degrees either way, and the share that is drawn of each.
    tilt_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tilt_share: tuple[float, float] = (1.0, 1.0)
    #: Share of dark pictures, and of lighted rooms.
    dark: float = 0.0
    lighted: float = 0.5
    #: Width of the sensor in pixels, and share of its rows, in the same time; None for the camera's own width.
    width_px: Range | None = None
    rows: Range = (1.0, 1.0)
    #: Electrons against what the exposure should give, and how far columns may be late, slots.
    light: Range = (1.0, 1.0)
    column_delay_slots: Range = (0.0, 0.0)
    #: Share of mosaics among photographs.
    raw: float = 0.0
    #: Of clips; a photograph has one.
    n_frames: int = 1
    frame_rate_hz: float = 29.97
    #: Pixels by which a hand moves the picture from frame to frame.
    hand_px: Range = (0.0, 0.0)
    #: Kinds of films that screens show, of `FILM_KINDS`; none for pictures at rest.
    films: tuple[FilmKind, ...] = ()
    #: Fields of the scene that are set at last, as in `vlc-rx simulate --set`.
    scene: dict[str, Any] = {}

    def draw(self, rng: Generator) -> tuple[Scene, str]:
        """A scene of this population, and what its screen shows: a photograph's name or one of `DARK_KINDS`."""
        while True:
            scene = self._taken(rng)
            heights = np.clip(scene.view.corners[:, 1], 0, scene.sensor.height - 1)
            packets = np.ptp(heights) / scene.rows_per_slot / scene.screen.packet_slots
            if self.packets[0] <= packets <= self.packets[1]:
                return self._shown(scene, rng)

    def _taken(self, rng: Generator) -> Scene:
        """Draw camera, screen, exposure and place."""
        name, screen = str(rng.choice(self.cameras)), str(rng.choice(self.screens))
        scene, readout_s = preset(name, screen), log_uniform(rng, self.readout_s)
        if name.startswith("phone"):
            scene = _as_phone(scene, readout_s, rng)
        width_px = scene.sensor.width if self.width_px is None else round(_within(rng, self.width_px))
        scene = scene.scaled(width_px / scene.sensor.width, _within(rng, self.rows), keep_readout=True)
        if width_px < _NARROW_PX:
            panel = dict(zip(("width_px", "height_px"), _SMALL_PANEL_PX, strict=True))
            scene = replace(scene, screen=msgspec.structs.replace(scene.screen, **panel))
        exposure_slots = log_uniform(rng, self.exposure_slots)
        light_e_per_s = log_uniform(rng, _LIGHT)
        full_scale_e = light_e_per_s * scene.exposure_s * scene.isp.gain * rng.uniform(*_HEADROOM)
        sensor = replace(scene.sensor, full_scale_e=full_scale_e)
        scene = replace(scene, light_e_per_s=light_e_per_s * _within(rng, self.light), sensor=sensor)
        roll, yaw, pitch = self.aim * rng.normal(0, _ANGLES_DEG)
        turned = rng.random() < _UPSIDE_DOWN
        scene = replace(scene.metered(exposure_slots), orientation=3 if turned else 1)
        place = np.clip(self.aim * rng.normal(0, _PLACE, 2), -1, 1)
        return placed(scene, rng.uniform(*self.fill), (roll + 180 * turned, yaw, pitch), place)

    def _shown(self, scene: Scene, rng: Generator) -> tuple[Scene, str]:
        """Add picture, weights and room to a scene; also return the kind of picture."""
        size = scene.screen.width_px, scene.screen.height_px
        dark = rng.random() < self.dark
        kind = str(rng.choice(DARK_KINDS if dark else _BRIGHT))
        picture = draw_dark_picture(kind, rng, *size) if dark else draw_part(kind, rng, *size)
        room_light = 10 ** rng.uniform(*(_LIGHTED_ROOM if rng.random() < self.lighted else _DARK_ROOM))
        room = replace(scene.room, light_e_per_s=scene.light_e_per_s * room_light)
        drawn: dict[str, Any] = {"n_frames": self.n_frames, "frame_rate_hz": self.frame_rate_hz}
        drawn |= {"blur_px": rng.uniform(0.5, 1.3), "slot_rate_error_ppm": rng.uniform(-50, 50)}
        drawn |= {name: _within(rng, getattr(self, name)) for name in ("hand_px", "column_delay_slots")}
        drawn["w"] = "dimming" if rng.random() < _DIMMED else int(rng.integers(3, 9))
        scene = replace(scene, picture=picture, room=room, **drawn)
        if self.raw and rng.random() < self.raw and scene.sensor.pattern is not None:
            # LibRaw crops the models that it knows.
            scene = replace(scene, output="raw", make="Synthetic", model=scene.camera_name)
        if self.films:
            film, is_dimmed = draw_film(self.films[rng.integers(len(self.films))], rng), rng.random() < _SEGMENTS_DIMMED
            scene = replace(scene, film=film, dimming="max" if is_dimmed else "none")
        if any(self.tilt_deg):
            tilt = np.array(self.tilt_deg) * rng.uniform(*self.tilt_share, 3) * rng.choice([-1, 1], 3)
            upright = np.array([scene.pose.roll_deg, scene.pose.yaw_deg, scene.pose.pitch_deg])
            scene = placed(scene, rng.uniform(*self.fill), (upright + tilt).tolist(), np.zeros(2))
        return with_fields(scene, self.scene), kind


def log_uniform(rng: Generator, limits: Range) -> float:
    """A number between two, even on a logarithmic scale."""
    return float(np.exp(rng.uniform(*np.log(limits))))


def _within(rng: Generator, limits: Range) -> float:
    """As `log_uniform`; equal limits take no random number, so that what is drawn after them stays the same."""
    return limits[0] if limits[0] == limits[1] else log_uniform(rng, limits)


def _as_phone(scene: Scene, readout_s: float, rng: Generator) -> Scene:
    """Another phone: readout, lens and development that nobody has measured."""
    k1 = rng.uniform(-0.12, 0.12)
    lens = Lens(rng.uniform(0.68, 1.1), (k1, -k1 * rng.uniform(0, 1.2), *rng.normal(0, 4e-4, 2).tolist(), 0.0))
    tone: Any = str(rng.choice(["srgb", "bt709"]))
    corrected, quality = bool(rng.random() < 0.5), int(rng.integers(86, 97))
    noise: dict[str, Any] = {"denoise_px": rng.uniform(0, 0.6), "denoise_colour_px": rng.uniform(0.5, 2.5)}
    isp = Isp(tone, 2.0, rng.uniform(0, 0.8), correct_distortion=corrected, quality=quality, **noise)
    return replace(scene.read_in(readout_s), lens=lens, isp=isp)


def placed(scene: Scene, share: float, angles: tuple[float, float, float], place: FloatArray) -> Scene:
    """The scene with a screen of a share of the picture, at `place` (-1..1) of the room that is left."""
    size = np.array([scene.sensor.width, scene.sensor.height])
    scene = replace(scene, pose=Pose(0.9, *angles))
    for _ in range(12):
        pose, corners = scene.pose, scene.view.corners
        low, high = corners.min(axis=0), corners.max(axis=0)
        goal = size / 2 + place * np.maximum(size - (high - low), 0) / 2
        x, y = 0.9 * (goal - (low + high) / 2) / size
        fill = pose.fill * min(share * size[1] / (high - low)[1], 0.985 * size[0] / (high - low)[0])
        pose = replace(pose, fill=float(fill), shift_x=pose.shift_x + float(x), shift_y=pose.shift_y + float(y))
        scene = replace(scene, pose=pose)
    return scene
