"""What the benchmark draws: for a seed and a number, the same case every time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import sqrt
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import msgspec
import numpy as np

from rxcli.lab.benchmark.cases import Case
from rxcli.lab.benchmark.media import Medium, camera_path
from rxcli.lab.benchmark.trial import SOURCE, Trial, corners_on_picture, simulate_trial, write_still
from rxcli.lab.simulate.capture import Recording, prepare
from rxcli.lab.simulate.files import write_video
from rxcli.lab.simulate.isp import Isp
from rxcli.lab.simulate.no_data import STRIPED_KINDS, draw_kind, no_data_scene
from rxcli.lab.simulate.optics import Lens, Pose
from rxcli.lab.simulate.pictures import DARK_KINDS, PHOTOS, draw_dark_picture, draw_name
from rxcli.lab.simulate.population import Population, placed
from rxcli.lab.simulate.scenes import Scene, draw_weight, preset, random_scene
from rxcli.lab.simulate.sensor import Sensor
from rxcli.lab.simulate.truth import build_camera_profile
from rxcli.link.encoder import message
from rxcli.options import ReceiverOptions, receiver_options
from rxcli.profiles import ScreenProfile, load_profile, shipped_profiles
from rxcli.protocol import payload_bits
from rxcli.results.truth import Truth, find_truth, load_truth
from rxcli.types import FloatArray, Frame

#: Scenes that are drawn from one number have this many times the run's seed, and on.
SEEDS_A_RUN = 1_000_000
_SCREENS = ("paper-8k65", "paper-17k3", "paper-34k6")
#: Shortest exposure of the cameras, seconds.
_MIN_EXPOSURE_S = 1 / 32000


@dataclass(frozen=True, slots=True)
class Place:
    """Where a case stands in a run: it is drawn from this alone."""

    seed: int
    number: int
    #: Of a scenario's points, this one's values.
    point: Mapping[str, Any]
    #: Where files that are made once are kept.
    folder: Path
    #: Whether to record what the bound needs.
    oracle: bool = False

    @property
    def flat(self) -> int:
        """Seed and number in one."""
        return SEEDS_A_RUN * self.seed + self.number


def _case(trial: Trial, options: ReceiverOptions, *groups: str, **about: Any) -> Case:
    """A simulated photograph, with the facts of its scene."""
    scene, frames = trial.capture.scene, (trial.frame,)
    about |= {"screen": scene.screen.name, "camera": scene.camera_name, "rows_per_slot": scene.rows_per_slot}
    about["picture"] = scene.picture if isinstance(scene.picture, str) else "drawn"
    known: dict[str, Any] = {"truth": trial.truth, "corners": trial.corners, "trials": (trial,)}
    return Case(source=frames, options=options, groups=groups, about=about, **known)


# Pictures and clips as people take them.


#: Photographs of one transmission follow each other so often.
_PHOTOS_HZ = 0.4
_LETTERS = tuple("abcdefghijklmnopqrstuvwxyz 0123456789")


def draw_people(at: Place) -> Iterator[Case]:
    """Files of a population, their camera unknown.

    Point: fields of `Population`; `photos`, taken one after the other; `text_bytes` of a text that the screen sends.
    """
    point: dict[str, Any] = {"photos": 1, "text_bytes": 0, **at.point}
    photos, text_bytes = point.pop("photos"), point.pop("text_bytes")
    rng = np.random.default_rng([at.seed, at.number, 31])
    scene, kind = msgspec.convert(point, Population).draw(rng)
    text = "".join(rng.choice(_LETTERS, text_bytes)) if text_bytes else None
    if text is not None:
        start_slot = rng.uniform(0, 1e5)
        scene = replace(scene, labels=message(text), start_slot=start_slot, w=5)
    options = ReceiverOptions(soft_bits=text is not None)
    groups = ("dark" if kind in DARK_KINDS else "bright",)
    about = {"kind": kind, "exposure_slots": scene.exposure_s * scene.screen.slot_rate_hz}
    about["readout_ms"] = 1e3 * scene.sensor.line_delay_s * scene.sensor.height
    if scene.n_frames > 1:
        recording, rate = prepare(scene, at.flat), _bit_rate(rng, scene, _BITS_PER_PIXEL)
        with filmed(recording, [("h264", "veryfast", rate)]) as (path,):
            clip = _clip(recording, path, True, *groups)
            named = replace(clip.options, corners=clip.corners, soft_bits=options.soft_bits)
            yield replace(clip, options=options, named=named, about=clip.about | about, text=text)
        return
    recording = prepare(replace(scene, n_frames=photos, frame_rate_hz=_PHOTOS_HZ), at.flat)
    trials = [Trial(recording.frame(number, oracle=at.oracle, threads=1), number) for number in range(photos)]
    with TemporaryDirectory() as folder:
        paths = tuple(write_still(trial.capture, Path(folder) / str(trial.index)) for trial in trials)
        case = _case(trials[0], options, *groups, **about)
        truth = msgspec.convert(recording.truth("photographs"), Truth, str_keys=True)
        named = trials[0].options(soft_bits=options.soft_bits)
        case = replace(case, source=paths if photos > 1 else paths[0], truth=truth, named=named, text=text)
        yield replace(case, trials=tuple(trials))


# Phones that nobody has measured.

_PHONE_HEIGHTS_PX, _PHONE_EXPOSURE_SLOTS = (720, 1080, 1440, 1800), (0.4, 0.7, 1.0, 1.5, 2.0)
_PHONE_ROWS_PER_SLOT, _PHONE_READOUT_S, _PHONE_FILL = (1.5, 20.0), (5e-3, 45e-3), (0.75, 0.95)
#: Packets that the screen's height holds, with some room for tilt over the 1.3 that are asked for.
_PHONE_PACKETS = 1.35
#: Noise of a phone's simulation starts from this and the phone's number.
FIRST_SEED = 1000


def draw_phone(at: Place) -> Iterator[Case]:
    """A phone before a screen; the receiver gets the picture and the corners, and nothing else."""
    scene, turned = phone_of(at.seed, at.number)
    trial = simulate_trial(scene, FIRST_SEED + at.number, oracle=at.oracle)
    frame, corners = as_stored(trial, turned)
    groups = ["corrected" if scene.isp.correct_distortion else "uncorrected"]
    groups += ["below 3 rows a slot"] * (scene.rows_per_slot < 3)
    groups += ["exposed above 1.4 slots"] * (scene.exposure_s * scene.screen.slot_rate_hz > 1.4)
    groups += ["star field"] * (scene.picture == "hubble")
    case = _case(trial, ReceiverOptions(cameras=(), corners=corners), *groups, turned=turned)
    yield replace(case, source=(frame,), corners=corners)


def phone_of(seed: int, number: int) -> tuple[Scene, bool]:
    """A random phone before a screen, and whether its picture was turned upside down by software."""
    rng = np.random.default_rng([seed, number])
    screen, sensor, fill = _readout_of(rng)
    focal_widths, k1 = rng.uniform(0.65, 1.2), rng.uniform(-0.15, 0.15)
    k2 = -k1 * rng.uniform(0, 1.2)
    corrected, turned = bool(rng.random() < 0.5), bool(rng.random() < 0.3)
    exposure_s = float(rng.choice(_PHONE_EXPOSURE_SLOTS)) * rng.uniform(0.85, 1.15) / screen.slot_rate_hz
    lens = Lens(focal_widths, (k1, k2, rng.normal(0, 4e-4), rng.normal(0, 4e-4), 0.0))
    roll, yaw, pitch = rng.normal(0, (1.2, 4, 3)).tolist()
    pose = Pose(fill, roll + 180 * turned, yaw, pitch, *rng.normal(0, 0.01, 2).tolist())
    tone: Any = str(rng.choice(["srgb", "bt709"]))
    sharpen, denoise_px = rng.uniform(0, 0.8), rng.uniform(0, 0.6)
    isp = Isp(tone, 2.0, sharpen, denoise_px=denoise_px, correct_distortion=corrected, quality=90)
    picture, w = str(rng.choice(list(PHOTOS))), draw_weight(rng, 0.3, 3)
    light_e_per_s = 1.4e6 / 24000 / exposure_s * 10 ** rng.uniform(-0.3, 0.2)
    base = preset("phone-plain", screen)
    base = replace(base, sensor=sensor, lens=lens, pose=pose, isp=isp, picture=picture, w=w, orientation=1)
    scene = replace(base, exposure_s=exposure_s, light_e_per_s=light_e_per_s, blur_px=rng.uniform(0.5, 1.2))
    return scene, turned


def _readout_of(rng: np.random.Generator) -> tuple[ScreenProfile, Sensor, float]:
    """A screen, a sensor that reads out as fast as a phone's and sees enough packets, and how much the screen fills."""
    screens = {screen.name: screen for screen in shipped_profiles(ScreenProfile)}
    while True:
        screen = screens[str(rng.choice(list(_SCREENS)))]
        rows_per_slot = float(np.exp(rng.uniform(*np.log(_PHONE_ROWS_PER_SLOT))))
        fill = rng.uniform(*_PHONE_FILL)
        height = int(rng.choice(_PHONE_HEIGHTS_PX))
        line_delay_s = 1 / (rows_per_slot * screen.slot_rate_hz)
        rows = height * fill * (4 / 3) / screen.aspect
        enough = rows / rows_per_slot / screen.packet_slots >= _PHONE_PACKETS
        if enough and _PHONE_READOUT_S[0] <= line_delay_s * height <= _PHONE_READOUT_S[1]:
            break
    levels: dict[str, Any] = {"read_noise_e": 2.0, "full_scale_e": 260.0, "black_level": 64, "white_level": 1023}
    return screen, Sensor(height * 4 // 3, height, line_delay_s, "bayer", **levels), fill


def as_stored(trial: Trial, turned: bool) -> tuple[Frame, FloatArray]:
    """The picture without any metadata, as software may have turned it, and the screen's corners on it."""
    pixels, corners = np.asarray(trial.capture.pixels, np.uint8), trial.corners
    if turned:
        height, width = pixels.shape
        pixels, corners = np.ascontiguousarray(pixels[::-1, ::-1]), np.array([width - 1, height - 1]) - corners
    return Frame(pixels, SOURCE), corners


# Screens anywhere in the picture.

#: Share of screens with a hundred columns, and packets that a screen's height holds at least.
_NARROW_SHARE, _SCREEN_PACKETS = 0.12, 1.25


def draw_screen(at: Place) -> Iterator[Case]:
    """A dark or ordinary picture on a screen anywhere in the frame; cameras are typical of users.

    Point: `warped_px`, by how much software has moved the rows of developed pictures, at most.
    """
    scene, kind = screen_of(at.seed, at.number)
    dark = () if kind == "photo" else ("dark",)
    warped_px = at.point.get("warped_px", 0.0)
    if warped_px:
        scene = replace(scene, output="developed")
    trial = simulate_trial(scene, at.number, oracle=at.oracle)
    case = _case(trial, ReceiverOptions(), kind, *dark, kind=kind)
    if warped_px:
        rng = np.random.default_rng([at.seed, at.number, 29])
        case = replace(case, source=(warped(trial.frame, rng, warped_px),))
    yield case


def warped(frame: Frame, rng: np.random.Generator, max_px: float) -> Frame:
    """The frame with its rows moved smoothly, across or along the readout, as software that straightens does."""
    y, x = np.mgrid[: frame.height, : frame.width].astype(np.float32)
    knots = rng.uniform(-1, 1, int(rng.integers(3, 9)))
    places = np.linspace(0, knots.size - 1, frame.height)
    smooth = np.interp(places, np.arange(knots.size), knots)
    smooth = cv2.GaussianBlur(smooth[:, None], (1, 0), 0, sigmaY=frame.height / (4 * knots.size))
    moved = (smooth / np.abs(smooth).max() * rng.uniform(0, max_px)).astype(np.float32)
    x, y = (x + moved, y) if rng.random() < 0.5 else (x, y + moved)
    pixels: Any = cv2.remap(frame.pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return replace(frame, pixels=pixels)


def screen_of(seed: int, number: int) -> tuple[Scene, str]:
    """A screen anywhere in a picture, and what kind of picture it shows."""
    rng = np.random.default_rng([seed, number, 17])
    screens = ("wide-100",) if rng.random() < _NARROW_SHARE else _SCREENS
    while True:
        base = preset(str(rng.choice(["xs10-still", "phone-corrected", "phone-plain"])), str(rng.choice(screens)))
        share = rng.uniform(0.6, 0.97)
        if share * base.sensor.height / base.rows_per_slot >= _SCREEN_PACKETS * base.screen.packet_slots:
            break
    kind = str(rng.choice(DARK_KINDS)) if rng.random() < 0.5 else "photo"
    size = base.screen.width_px, base.screen.height_px
    picture = str(rng.choice(list(PHOTOS))) if kind == "photo" else draw_dark_picture(kind, rng, *size)
    slots = float(rng.choice([0.5, 1.0])) * rng.uniform(0.8, 1.2)
    exposure_s = max(slots / base.screen.slot_rate_hz, _MIN_EXPOSURE_S)
    w = draw_weight(rng, 0.4)
    lit = base.exposed(exposure_s, 10 ** rng.uniform(-0.3, 0.3))
    room = replace(base.room, light_e_per_s=base.light_e_per_s * 10 ** rng.uniform(-3, -1.3))
    blur_px, slot_rate_error_ppm = rng.uniform(0.5, 1.5), rng.uniform(-50, 50)
    scene = replace(lit, picture=picture, w=w, room=room, blur_px=blur_px, n_frames=1)
    angles = (rng.normal(0, 1.5), rng.normal(0, 4), rng.normal(0, 4))
    scene = replace(scene, slot_rate_error_ppm=slot_rate_error_ppm)
    return placed(scene, share, angles, rng.uniform(-0.9, 0.9, 2)), kind


# Small scenes from clean to hopeless, for thousands of packets.

#: Sensor widths of the confidence scenes, pixels; share of frames with few rows a slot, how many, and widths of those.
_WIDTH_PX, _FEW_ROWS_SHARE, _FEW_ROWS, _FEW_ROWS_WIDTH_PX = (100.0, 320.0), 0.4, (1.5, 5.0), (100.0, 900.0)
#: Share of the frames with a hundred columns, in whole pictures, as their screen is searched.
_SEARCHED_SHARE, _SEARCHED_SCREEN = 0.05, "wide-100"
#: Powers of ten of the light against that of the preset: most about where packets begin to fail.
_LIGHT, _SEARCHED_LIGHT = (-1.4, 0.1), (-0.5, 0.4)
#: Size of the panel of small scenes: drawing the picture would otherwise take longer than the reception.
_PANEL_PX = (342, 192)


def draw_confidence(at: Place) -> Iterator[Case]:
    """A small, quick scene of random quality: from clean to hopeless."""
    trial = simulate_trial(confidence_scene(at.flat), at.flat, oracle=at.oracle)
    # How well narrow columns are found is part of how well their packets are received.
    searched = trial.capture.scene.screen.name == _SEARCHED_SCREEN
    yield _case(trial, trial.options(known_outline=not searched))


def confidence_scene(seed: int) -> Scene:
    """The scene of `draw_confidence`."""
    rng = np.random.default_rng([seed, 5])
    searched = np.random.default_rng([seed, 6]).random() < _SEARCHED_SHARE
    base, light = (preset("xs10-still", _SEARCHED_SCREEN), _SEARCHED_LIGHT) if searched else (_small(rng), _LIGHT)
    slots = float(rng.choice([0.5, 1.0, 1.5, 2.0]) * rng.uniform(0.8, 1.2))
    exposure_s = max(slots / base.screen.slot_rate_hz, _MIN_EXPOSURE_S)
    picture, w = draw_name(rng), draw_weight(rng, 0.3)
    fill, roll_deg, yaw_deg = rng.uniform(0.8, 0.97), rng.normal(0, 1.0), rng.normal(0, 4)
    pose = replace(base.pose, fill=fill, roll_deg=roll_deg, yaw_deg=yaw_deg)
    scene = replace(base.exposed(exposure_s, 10 ** rng.uniform(*light)), picture=picture, w=w, pose=pose)
    blur_px, slot_rate_error_ppm = rng.uniform(0.4, 2.5), rng.uniform(-100, 100)
    delay = float(rng.choice([0.0, rng.uniform(0, 2)]))
    isp = replace(base.isp, sharpen=rng.uniform(0, 0.8), denoise_px=rng.uniform(0, 0.6))
    raw = base.sensor.pattern is not None and rng.random() < 0.3
    scene = replace(scene, blur_px=blur_px, slot_rate_error_ppm=slot_rate_error_ppm, column_delay_slots=delay)
    return replace(scene, isp=isp, n_frames=1, output="raw" if raw else "developed")


def _small(rng: np.random.Generator) -> Scene:
    """A screen of twenty columns, each a few pixels wide, before any camera."""
    base = preset(str(rng.choice(["video-1080p", "phone-plain", "xs10-still"])), str(rng.choice(_SCREENS)))
    few_rows = rng.random() < _FEW_ROWS_SHARE
    rows = np.exp(rng.uniform(*np.log(_FEW_ROWS))) / base.rows_per_slot if few_rows else 1.0
    width_px = rng.uniform(*(_FEW_ROWS_WIDTH_PX if few_rows else _WIDTH_PX))
    return base.scaled(width_px / base.sensor.width, float(min(rows, 1.0)), keep_readout=True)


def draw_small(at: Place) -> Iterator[Case]:
    """Any scene on few pixels: a tenth of a second's work that meets every branch of the receiver."""
    rng = np.random.default_rng([at.flat, 10])
    trial = simulate_trial(small_scene(at.flat), at.flat, oracle=at.oracle)
    screens = tuple(load_profile(name, ScreenProfile) for name in _SCREENS) if rng.random() < 0.2 else ()
    options = trial.options(known_outline=bool(rng.random() < 0.7))
    yield _case(trial, replace(options, screens=(*options.screens, *screens)))


def small_scene(seed: int) -> Scene:
    """The scene of `draw_small`, with more electrons: few pixels have to do with what many would gather."""
    rng = np.random.default_rng([seed, 9])
    scene = random_scene(rng)
    width, rows = rng.integers(48, 400), rng.uniform(1.5, 6.0)
    scene, factor = small(scene, float(width), rows), 10 ** rng.uniform(-0.5, 1.5)
    room = replace(scene.room, light_e_per_s=scene.room.light_e_per_s * factor)
    sensor = replace(scene.sensor, full_scale_e=scene.sensor.full_scale_e * factor)
    return replace(scene, light_e_per_s=scene.light_e_per_s * factor, room=room, sensor=sensor)


def small(scene: Scene, width: float, rows_per_slot: float, **changes: Any) -> Scene:
    """A scene of the same time span on few pixels, and a coarse panel."""
    screen = msgspec.structs.replace(scene.screen, width_px=_PANEL_PX[0], height_px=_PANEL_PX[1])
    scene = replace(scene, screen=screen, n_frames=1, **changes)
    shrink = min(rows_per_slot / scene.rows_per_slot, 1.0)
    return scene.scaled(width / scene.sensor.width, shrink, keep_readout=True)


# Clips.

#: Average pixels from frame to frame of the clips from a hand, and their frames.
SPEEDS_PX, _HAND_FRAMES = (0.0, 2.0, 4.0, 8.0), 12
#: Bits per pixel and frame: a phone's or a camera's; and from a starved encoder's on.
_BITS_PER_PIXEL, _ANY_BITS_PER_PIXEL = (0.12, 0.5), (0.09, 0.4)
#: Camera, screen, how often, and most frames of the clips in every encoding. The fastest link has too few rows per slot
#: in 1080p.
_CLIP_KINDS = (
    ("video-1080p", "paper-8k65", 0.42, 9),
    ("video-1080p", "paper-17k3", 0.42, 9),
    ("video-4k", "paper-17k3", 0.08, 5),
    ("video-4k", "paper-34k6", 0.08, 5),
)
_CODECS, _ENCODER_PRESETS = ("h264", "h264", "hevc"), ("ultrafast", "veryfast", "veryfast", "medium")
#: Times that a scene is compressed; shares of clips from a hand and of cameras not named; pixels that a hand moves.
_ENCODINGS, _MOVING, _UNNAMED, _HAND_PX = 3, 0.35, 0.3, (0.5, 6.0)
#: Codec, preset and bits per second.
Encoding = tuple[str, str, int]


def draw_motion(at: Place) -> Iterator[Case]:
    """One scene filmed at every speed, screen and camera named."""
    rng = np.random.default_rng([at.flat, 5])
    base = preset("video-1080p", str(rng.choice(_SCREENS[:2])))
    scene = replace(_filmed_scene(rng, base), n_frames=_HAND_FRAMES)
    encoding = "h264", "veryfast", _bit_rate(np.random.default_rng([at.flat, 6]), scene, _BITS_PER_PIXEL)
    for speed in SPEEDS_PX:
        recording = prepare(replace(scene, hand_px=speed), at.flat)
        with filmed(recording, [encoding]) as (path,):
            yield _clip(recording, path, True, f"{speed:g} pixels a frame")


def draw_clips(at: Place) -> Iterator[Case]:
    """A scene filmed once and compressed several times; half of the pictures dark, some clips from a hand."""
    rng = np.random.default_rng([at.flat, 17])
    name, screen, _, frames = _CLIP_KINDS[rng.choice(len(_CLIP_KINDS), p=[kind[2] for kind in _CLIP_KINDS])]
    scene = _filmed_scene(rng, preset(name, screen))
    size = scene.screen.width_px, scene.screen.height_px
    if dark := bool(rng.random() < 0.5):
        scene = replace(scene, picture=draw_dark_picture(str(rng.choice(DARK_KINDS)), rng, *size))
    hand_px = rng.uniform(*_HAND_PX) if rng.random() < _MOVING else 0.0
    scene = replace(scene, hand_px=hand_px, n_frames=int(rng.integers(3, frames, endpoint=True)))
    named = bool(rng.random() >= _UNNAMED)
    kinds = "dark pictures" if dark else "photographs", "from a hand" if hand_px else "from a tripod"
    groups = name, *kinds, "camera named" if named else "camera unknown"
    encodings = []
    for _ in range(_ENCODINGS):
        codec, speed = str(rng.choice(_CODECS)), str(rng.choice(_ENCODER_PRESETS))
        encodings.append((codec, speed, _bit_rate(rng, scene, _ANY_BITS_PER_PIXEL)))
    recording = prepare(scene, at.flat)
    with filmed(recording, encodings) as paths:
        for path, (codec, _, _) in zip(paths, encodings, strict=True):
            case = _clip(recording, path, named, *groups, codec)
            yield replace(case, options=replace(case.options, screens=ReceiverOptions().screens))


def _filmed_scene(rng: np.random.Generator, base: Scene) -> Scene:
    """A random picture and pose before a camera for clips."""
    exposure_s = float(rng.choice([0.5, 1.0]) * rng.uniform(0.85, 1.15)) / base.screen.slot_rate_hz
    fill, roll_deg, yaw_deg = rng.uniform(0.75, 0.88), rng.normal(0, 1.2), rng.normal(0, 3)
    pose = replace(base.pose, fill=fill, roll_deg=roll_deg, yaw_deg=yaw_deg, pitch_deg=rng.normal(0, 2))
    picture = draw_name(rng)
    w = 5 if rng.random() < 0.6 else int(rng.integers(3, 8))
    lit = base.exposed(exposure_s, 10 ** rng.uniform(-0.5, 0.2))
    return replace(lit, picture=picture, w=w, pose=pose)


def _bit_rate(rng: np.random.Generator, scene: Scene, bits_per_pixel: tuple[float, float]) -> int:
    bits = np.exp(rng.uniform(*np.log(bits_per_pixel)))
    return int(bits * scene.sensor.width * scene.sensor.height * scene.frame_rate_hz)


@contextmanager
def filmed(recording: Recording, encodings: Iterable[Encoding]) -> Iterator[list[Path]]:
    """The clips of a scene in every encoding, as files in a folder that goes away afterwards."""
    pictures = [recording.frame(n, threads=1).rgb for n in range(recording.scene.n_frames)]
    with TemporaryDirectory() as folder:
        paths = []
        for number, (codec, speed, bit_rate) in enumerate(encodings):
            paths.append(Path(folder) / f"{number}.mp4")
            write_video(pictures, paths[-1], codec, recording.scene.frame_rate_hz, bit_rate, speed)
        yield paths


def _clip(recording: Recording, path: Path, camera_named: bool, *groups: str) -> Case:
    scene, exposure = recording.scene, recording.exposure()
    cameras = (build_camera_profile(scene, exposure),) if camera_named else ()
    options = ReceiverOptions(screens=(scene.screen,), cameras=cameras, force_camera=camera_named)
    about = {"screen": scene.screen.name, "camera": scene.camera_name, "hand_px": scene.hand_px}
    whole = recording.truth("clip")
    known: dict[str, Any] = {"truth": msgspec.convert(whole, Truth, str_keys=True), "whole_truth": whole}
    corners = corners_on_picture(exposure.view, True) if scene.isp.correct_distortion else exposure.corners
    return Case(source=path, options=options, groups=groups, about=about, corners=corners, **known)


# Pictures without data.


def draw_nodata(at: Place) -> Iterator[Case]:
    """Frames without data, every other one striped; point: `n_frames`, `camera_named`."""
    rng = np.random.default_rng([at.seed, at.number, 23])
    kind = draw_kind(rng, at.number % 2 == 0)
    scene, about = no_data_scene(kind, rng, at.point.get("n_frames", 1))
    recording = prepare(scene, at.flat)
    captures = [recording.frame(number, threads=1) for number in range(scene.n_frames)]
    frames = tuple(Frame(capture.pixels, SOURCE, capture.frame, capture.time_s) for capture in captures)
    named = bool(at.point.get("camera_named"))
    cameras = (build_camera_profile(scene, captures[0].exposure),) if named else ()
    options = ReceiverOptions(cameras=cameras, force_camera=named)
    groups = (kind, *(("striped",) if kind in STRIPED_KINDS else ()))
    yield Case(source=frames, options=options, groups=groups, about={"kind": kind, **about}, has_data=False)


# Sweeps: one thing varies. Sensors are narrowed by binning: the rows, and with them all that concerns time, stay whole;
# the width shrinks, and every pixel gathers the light of those it stands for. So error rates are near those of the
# whole sensor, and a sweep takes minutes.

#: Width of the binned sensors, pixels for each column of the screen.
_PX_PER_COLUMN = 45.0
_FRAMES_A_SECOND = 60.0
#: Megapixels of the X-S10's sensor.
_XS10_MP = 26.0


def draw_point(at: Place) -> Iterator[Case]:
    """A frame of one place of a sweep, screen, camera and corners handed over; for the point see `scene_at`."""
    trial = simulate_trial(scene_at(**at.point), at.flat, oracle=at.oracle)
    screen = trial.capture.scene.screen
    # As the paper counts it: one payload (w = 5) per column in each of 60 frames a second.
    rate_kbps = screen.columns * payload_bits(5, screen.payload_symbols) * _FRAMES_A_SECOND / 1e3
    yield _case(trial, trial.options(), rate_kbps=rate_kbps)


def scene_at(
    camera: str = "xs10-still",
    picture: str = "coffee",
    light: float = 1.0,
    exposure_slots: float | None = None,
    pose: Mapping[str, Any] | None = None,
    is_binned: bool = True,
    megapixels: float | None = None,
    **clock: Any,
) -> Scene:
    """The scene of a point.

    Args:
        camera: preset.
        picture: name.
        light: against the preset's.
        exposure_slots: None for the preset's.
        pose: fields of the pose that are not the preset's.
        is_binned: False for the sensor as it is.
        megapixels: of a whole picture, which shows the same time at any size.
        clock: fields of the screen's profile.
    """
    screen = load_profile("wide-100" if clock.get("columns") == 100 else "paper-34k6", ScreenProfile)
    screen = msgspec.structs.replace(screen, name="sweep", **clock)
    scene = preset(camera, screen)
    scene = replace(scene, light_e_per_s=scene.light_e_per_s * light, pose=replace(scene.pose, **(pose or {})))
    scene = replace(scene, picture=picture, n_frames=1)
    if exposure_slots is not None:
        scene = scene.metered(exposure_slots / screen.slot_rate_hz)
    if megapixels is not None:
        factor = sqrt(megapixels / _XS10_MP)
        return scene.scaled(factor, keep_readout=True) if factor != 1 else scene
    return binned(scene, screen.columns * _PX_PER_COLUMN / scene.sensor.width) if is_binned else scene


def binned(scene: Scene, share: float) -> Scene:
    """The scene on a sensor of `share` of the width, whose pixels gather the light of those they stand for."""
    if share >= 1:
        return scene
    narrow = scene.scaled(share, 1.0)
    old, light_e_per_s = narrow.sensor, narrow.light_e_per_s / share
    noise: dict[str, Any] = {"row_noise_e": old.row_noise_e / share, "read_noise_e": old.read_noise_e / sqrt(share)}
    sensor = replace(old, full_scale_e=old.full_scale_e / share, prnu=old.prnu * sqrt(share), **noise)
    room = replace(narrow.room, light_e_per_s=narrow.room.light_e_per_s / share)
    return replace(narrow, sensor=sensor, room=room, light_e_per_s=light_e_per_s)


# Files.


def draw_capture(at: Place) -> Iterator[Case]:
    """A photograph or clip without given options, with the truth beside it; point: `path`."""
    path = Path(at.point["path"])
    truth = find_truth(path)
    case = Case(source=path, options=ReceiverOptions(), about={"file": path.name})
    yield case if truth is None else replace(case, truth=load_truth(truth))


def draw_medium(at: Place) -> Iterator[Case]:
    """A file of full size, made once in the folder of results; point: fields of `Medium`."""
    medium = Medium(**at.point)
    # In another process, for the memory of this one is to be that of the reception.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        path = pool.submit(medium.make, at.folder, at.seed).result()
    options = receiver_options(medium.screen, str(camera_path(path))) if medium.named else ReceiverOptions(cameras=())
    yield Case(source=path, options=options, about={"target": medium.target, "frame_rate_hz": medium.frame_rate_hz})


#: What a scenario names as its drawing.
DRAWERS: dict[str, Callable[[Place], Iterator[Case]]] = {
    drawer.__name__.removeprefix("draw_"): drawer
    for drawer in (
        draw_people,
        draw_phone,
        draw_screen,
        draw_confidence,
        draw_small,
        draw_motion,
        draw_clips,
        draw_nodata,
    )
}
DRAWERS |= {"point": draw_point, "capture": draw_capture, "medium": draw_medium}
