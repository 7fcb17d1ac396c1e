"""What the benchmark draws: for a seed and a number, the same case every time."""

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from math import inf, sqrt
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np

from rxcli.lab.benchmark.cases import Case
from rxcli.lab.benchmark.media import Medium, camera_path
from rxcli.lab.benchmark.trial import Trial, known_options
from rxcli.lab.simulate.capture import Recording, prepare
from rxcli.lab.simulate.files import Encoding, write_video
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
    #: Whether to record what the bound needs, and whether to draw the twin of every case.
    oracle: bool = False
    twin: bool = False

    @property
    def flat(self) -> int:
        """Seed and number in one."""
        return SEEDS_A_RUN * self.seed + self.number


# Pictures and clips as people take them.

#: Photographs of one transmission follow each other so often.
_PHOTOS_HZ = 0.4
_LETTERS = tuple("abcdefghijklmnopqrstuvwxyz 0123456789")
_ENCODING = Encoding("h264", 8_000_000)
#: Rows of the table that pairs of a case and its twin are counted in, by exposure in slots.
_EXPOSURES = {"up to 1.5 slots": (0.0, 1.5), "1.5 to 3 slots": (1.5, 3.0), "3 slots and more": (3.0, inf)}


class People(Population, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A population, and what becomes of its captures."""

    #: Photographs of one transmission, taken one after the other.
    photos: int = 1
    #: Bytes of a text that the screen sends.
    text_bytes: int = 0
    #: Whether screen, camera and corners are named to the receiver.
    named: bool = False
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
    people = msgspec.convert(at.point, People)
    upright, rng = (np.random.default_rng([at.seed, at.number, 31]) for _ in range(2))
    scene, kind = people.draw(rng)
    text = "".join(rng.choice(_LETTERS, people.text_bytes)) if people.text_bytes else None
    if text is not None:
        scene = replace(scene, labels=message(text), start_slot=rng.uniform(0, 1e5), w=5)
    if people.photos > 1:
        scene = replace(scene, n_frames=people.photos, frame_rate_hz=_PHOTOS_HZ)
    exposure_slots, encoding = scene.exposure_s * scene.screen.slot_rate_hz, people.encoding(scene, rng)
    groups: tuple[str, ...] = ("dark", kind) if kind in DARK_KINDS else ("bright",)
    groups += tuple(name for name, (low, high) in _EXPOSURES.items() if at.twin and low < exposure_slots <= high)
    about = {"kind": kind, "film": scene.film.shows, "exposure_slots": exposure_slots}
    about["readout_ms"] = 1e3 * scene.sensor.line_delay_s * scene.sensor.height

    def unnamed(case: Case, twin: Case | None = None) -> Case:
        named = replace(case.options, soft_bits=text is not None)
        options = named if people.named else ReceiverOptions(soft_bits=text is not None)
        known: dict[str, Any] = {"groups": groups, "about": case.about | about, "text": text, "twin": twin}
        return replace(case, options=options, named=named, **known)

    plain = msgspec.structs.replace(people, tilt_deg=(0.0,) * 3).draw(upright)[0] if at.twin else scene
    twin = prepare(replace(scene, pose=plain.pose), at.flat).plain
    files = partial(recorded, at=at, encoding=encoding, photos=people.n_frames == 1)
    with files(prepare(scene, at.flat)) as case, files(twin) if at.twin else nullcontext() as twin_case:
        yield unnamed(case, twin_case and unnamed(twin_case))


@contextmanager
def recorded(
    recording: Recording, at: Place, encoding: Encoding = _ENCODING, *, photos: bool = False
) -> Iterator[Case]:
    """A recording as files in a folder that goes away; screen, camera and corners are named to the receiver."""
    scene, exposure, whole = recording.scene, recording.exposure(), recording.truth("drawn")
    photos = photos or scene.n_frames == 1
    with TemporaryDirectory() as folder:
        frames = (recording.frame(n, oracle=at.oracle, threads=1) for n in range(scene.n_frames if photos else 0))
        trials = [Trial(frame) for frame in frames]
        suffix = ".dng" if scene.is_mosaic else ".jpg"
        paths = [Path(folder) / f"{trial.capture.frame}{suffix}" for trial in trials] or [Path(folder) / "0.mp4"]
        for trial, path in zip(trials, paths, strict=False):
            trial.capture.write(path, "dng" if scene.is_mosaic else "jpeg")
        if not photos:
            write_video(recording.pictures(), paths[0], encoding, scene.frame_rate_hz, scene.orientation)
        about = {"screen": scene.screen.name, "camera": scene.camera_name, "rows_per_slot": scene.rows_per_slot}
        known: dict[str, Any] = {"truth": msgspec.convert(whole, Truth, str_keys=True), "whole_truth": whole}
        named, sources = known_options(exposure), dict[str, Any](source=tuple(paths), trials=tuple(trials))
        yield Case(options=named, about=about, corners=named.corners, **sources, **known)


# Pictures without data.


def draw_nodata(at: Place) -> Iterator[Case]:
    """Frames without data, every other one striped; point: `n_frames`, `camera_named`."""
    rng = np.random.default_rng([at.seed, at.number, 23])
    kind = draw_kind(rng, at.number % 2 == 0)
    scene, about = no_data_scene(kind, rng, at.point.get("n_frames", 1))
    groups = (kind, *(("striped",) if kind in STRIPED_KINDS else ()))
    with recorded(prepare(scene, at.flat), at) as case:
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
    with recorded(prepare(scene_at(**at.point), at.flat), at) as case:
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
    scene = replace(scene, picture=picture, n_frames=1).metered(exposure_slots)
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
