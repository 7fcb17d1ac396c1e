"""What the benchmark draws: for a seed and a number, the same case every time."""

from collections.abc import Callable, Iterator, Mapping
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
from numpy.typing import NDArray

from rxcli.lab.benchmark.cases import Case
from rxcli.lab.benchmark.media import Medium, camera_path
from rxcli.lab.benchmark.trial import Trial, known_camera, known_corners, write_still
from rxcli.lab.simulate.capture import prepare
from rxcli.lab.simulate.files import Encoding, encode_jpeg, write_video
from rxcli.lab.simulate.no_data import STRIPED_KINDS, draw_kind, no_data_scene
from rxcli.lab.simulate.pictures import DARK_KINDS
from rxcli.lab.simulate.population import Population, Range, log_uniform
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.link.encoder import message
from rxcli.options import ReceiverOptions, receiver_options
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.results.truth import Truth, load_truth, truth_for

#: Scenes that are drawn from one number have this many times the run's seed, and on.
SEEDS_A_RUN = 1_000_000


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


# Pictures and clips as people take them.

#: Photographs of one transmission follow each other so often.
_PHOTOS_HZ = 0.4
_LETTERS = tuple("abcdefghijklmnopqrstuvwxyz 0123456789")
_ENCODING = Encoding("h264", 8_000_000)


class People(Population, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A population, and what becomes of its captures."""

    #: Photographs of one transmission, taken one after the other.
    photos: int = 1
    #: Bytes of a text that the screen sends.
    text_bytes: int = 0
    #: Whether screen, camera and corners are named to the receiver.
    named: bool = False
    #: By how much software moves the rows of photographs, at most.
    warped_px: float = 0.0
    #: Encoders of clips, how hard they work, and bits per pixel and frame.
    codecs: tuple[str, ...] = ("h264",)
    efforts: tuple[str, ...] = ("veryfast",)
    bits_per_pixel: Range = (0.12, 0.5)

    def encoding(self, scene: Scene, rng: np.random.Generator) -> Encoding:
        """How a clip is compressed."""
        bits = log_uniform(rng, self.bits_per_pixel) * scene.sensor.width * scene.sensor.height
        codec, preset = (str(rng.choice(some)) for some in (self.codecs, self.efforts))
        return Encoding(codec, int(bits * scene.frame_rate_hz), preset)


def draw_people(at: Place) -> Iterator[Case]:
    """Files of a population, their camera unknown; point: fields of `People`."""
    people, rng = msgspec.convert(at.point, People), np.random.default_rng([at.seed, at.number, 31])
    scene, kind = people.draw(rng)
    text = "".join(rng.choice(_LETTERS, people.text_bytes)) if people.text_bytes else None
    if text is not None:
        scene = replace(scene, labels=message(text), start_slot=rng.uniform(0, 1e5), w=5)
    groups = ("dark", kind) if kind in DARK_KINDS else ("bright",)
    about = {"kind": kind, "exposure_slots": scene.exposure_s * scene.screen.slot_rate_hz}
    about["readout_ms"] = 1e3 * scene.sensor.line_delay_s * scene.sensor.height
    with recorded(scene, at, people.photos, people.encoding(scene, rng)) as case:
        for path, trial in zip(case.source, case.trials, strict=False):
            if people.warped_px and isinstance(path, Path) and not scene.is_mosaic:
                path.write_bytes(encode_jpeg(warped(trial.capture.rgb, rng, people.warped_px), scene))
        named = replace(case.options, soft_bits=text is not None)
        options = named if people.named else ReceiverOptions(soft_bits=text is not None)
        yield replace(case, options=options, named=named, groups=groups, about=case.about | about, text=text)


@contextmanager
def recorded(scene: Scene, at: Place, photos: int = 1, encoding: Encoding = _ENCODING) -> Iterator[Case]:
    """A scene as files in a folder that goes away afterwards; screen, camera and corners are named to the receiver."""
    if scene.n_frames == 1 < photos:
        scene = replace(scene, frame_rate_hz=_PHOTOS_HZ)
    recording = prepare(replace(scene, n_frames=max(scene.n_frames, photos)), at.flat)
    exposure, whole = recording.exposure(), recording.truth("drawn")
    frames = (recording.frame(n, oracle=at.oracle, threads=1) for n in range(recording.scene.n_frames))
    with TemporaryDirectory() as folder:
        trials = [] if scene.n_frames > 1 else [Trial(frame, frame.frame) for frame in frames]
        paths = [write_still(trial.capture, Path(folder) / str(trial.index)) for trial in trials]
        if not trials:
            paths = [Path(folder) / "0.mp4"]
            write_video((frame.rgb for frame in frames), paths[0], encoding, scene.frame_rate_hz, scene.orientation)
        about = {"screen": scene.screen.name, "camera": scene.camera_name, "rows_per_slot": scene.rows_per_slot}
        known: dict[str, Any] = {"truth": msgspec.convert(whole, Truth, str_keys=True), "whole_truth": whole}
        corners, cameras = known_corners(exposure), (known_camera(exposure),)
        named = ReceiverOptions(screens=(scene.screen,), cameras=cameras, force_camera=True, corners=corners)
        yield Case(source=tuple(paths), options=named, about=about, corners=corners, trials=tuple(trials), **known)


def warped(pixels: NDArray[Any], rng: np.random.Generator, max_px: float) -> NDArray[Any]:
    """A picture with its rows moved smoothly, across or along the readout, as software that straightens does."""
    height, width = pixels.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float32)
    knots = rng.uniform(-1, 1, int(rng.integers(3, 9)))
    places = np.linspace(0, knots.size - 1, height)
    smooth = np.interp(places, np.arange(knots.size), knots)
    smooth = cv2.GaussianBlur(smooth[:, None], (1, 0), 0, sigmaY=height / (4 * knots.size))
    moved = (smooth / np.abs(smooth).max() * rng.uniform(0, max_px)).astype(np.float32)
    x, y = (x + moved, y) if rng.random() < 0.5 else (x, y + moved)
    return np.asarray(cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


# Pictures without data.


def draw_nodata(at: Place) -> Iterator[Case]:
    """Frames without data, every other one striped; point: `n_frames`, `camera_named`."""
    rng = np.random.default_rng([at.seed, at.number, 23])
    kind = draw_kind(rng, at.number % 2 == 0)
    scene, about = no_data_scene(kind, rng, at.point.get("n_frames", 1))
    groups = (kind, *(("striped",) if kind in STRIPED_KINDS else ()))
    with recorded(scene, at) as case:
        options = ReceiverOptions(cameras=case.options.cameras, force_camera=True)
        options = options if at.point.get("camera_named") else ReceiverOptions(cameras=())
        case = replace(case, options=options, about={"kind": kind, **about}, truth=None, whole_truth=None)
        yield replace(case, groups=groups, has_data=False)


# Sweeps: one thing varies. Sensors are narrowed by binning: the rows, and with them all that concerns time, stay whole;
# the width shrinks, and every pixel gathers the light of those it stands for. So error rates are near those of the
# whole sensor, and a sweep takes minutes.

#: Width of the binned sensors, pixels for each column of the screen.
_PX_PER_COLUMN = 45.0


def draw_point(at: Place) -> Iterator[Case]:
    """A frame of one place of a sweep, screen, camera and corners handed over; for the point see `scene_at`."""
    with recorded(scene_at(**at.point), at) as case:
        yield case


def scene_at(
    camera: str = "xs10-still",
    picture: str = "coffee",
    light: float = 1.0,
    exposure_slots: float | None = None,
    pose: Mapping[str, Any] | None = None,
    is_binned: bool = True,
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
        clock: fields of the screen's profile.
    """
    screen = load_profile("wide-100" if clock.get("columns") == 100 else "paper-34k6", ScreenProfile)
    screen = msgspec.structs.replace(screen, name="sweep", **clock)
    scene = preset(camera, screen)
    scene = replace(scene, light_e_per_s=scene.light_e_per_s * light, pose=replace(scene.pose, **(pose or {})))
    scene = replace(scene, picture=picture, n_frames=1)
    if exposure_slots is not None:
        scene = scene.metered(exposure_slots / screen.slot_rate_hz)
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
    truth = truth_for(path, "auto")
    case = Case(source=(path,), options=ReceiverOptions(), about={"file": path.name})
    yield case if truth is None else replace(case, truth=load_truth(truth))


def draw_medium(at: Place) -> Iterator[Case]:
    """A file of full size, made once in the folder of results; point: fields of `Medium`."""
    medium = Medium(**at.point)
    # In another process, for the memory of this one is to be that of the reception.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        path = pool.submit(medium.make, at.folder, at.seed).result()
    options = receiver_options(medium.screen, str(camera_path(path))) if medium.named else ReceiverOptions(cameras=())
    yield Case(source=(path,), options=options, about={"target": medium.target, "frame_rate_hz": medium.frame_rate_hz})


#: What a scenario names as its drawing.
DRAWERS: dict[str, Callable[[Place], Iterator[Case]]] = {
    drawer.__name__.removeprefix("draw_"): drawer
    for drawer in (draw_people, draw_nodata, draw_point, draw_capture, draw_medium)
}
