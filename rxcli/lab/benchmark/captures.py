"""Captures with truth beside twins of them that the simulator makes: is either easier?

A twin shows the same picture to the same camera from the same place, at the same slot rate, weights, exposure and part
of a burst, as the capture's truth tells; payload and noise are new. What the truth does not tell (light, noise,
development) is that of the preset for the camera. Both are decoded alike, with the camera that the truth describes,
and the outline searched.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from rxcli.errors import InputError
from rxcli.lab.benchmark.delivered import Delivered, delivered
from rxcli.lab.benchmark.journal import Journal, Record, Task, run_tasks
from rxcli.lab.benchmark.statistics import wilson
from rxcli.lab.benchmark.trial import corners_on_picture, frame_of
from rxcli.lab.benchmark.yardsticks import genie_score
from rxcli.lab.simulate.camera import Exposure
from rxcli.lab.simulate.capture import Capture, Take, prepare
from rxcli.lab.simulate.optics import Lens, Pose
from rxcli.lab.simulate.pictures import picture_names
from rxcli.lab.simulate.scenes import PRESETS, Scene, preset
from rxcli.profiles import CameraProfile, ScreenProfile, check_profile, load_profile
from rxcli.receiver.pipeline import ReceiverOptions, receive
from rxcli.receiver.screen import geometry
from rxcli.results.truth import TRUTH_SUFFIX, Score, Scorer, Truth, load_truth
from rxcli.types import FloatArray, Frame

#: Presets of the cameras that truth files name; a camera of another name gets the one of its kind.
_CAMERAS = {"xs10": "xs10-still", "phone12": "phone-corrected", "video4k": "video-4k", "video1080": "video-1080p"}
#: Shown where a capture's picture is not at hand.
_SUBSTITUTE = "coffee"
#: Least share of a file's light that the genie must explain for its decisions to be a bound.
EXPLAINED = 0.95
#: Uncertainty of a start that the truth tells to a tenth of a slot, in slots.
_START_TOLERANCE = 0.5
_CLIPS = (".mp4", ".mov", ".mkv", ".avi")


@dataclass(frozen=True)
class Reference:
    """A capture and its truth."""

    path: Path
    #: Folder of pictures by name, asked before the simulator's own.
    pictures: Path | None = None

    @cached_property
    def raw(self) -> dict[str, Any]:
        """The truth file as it stands."""
        content: dict[str, Any] = json.loads(_truth_of(self.path).read_bytes())
        return content

    @cached_property
    def truth(self) -> Truth:
        """The truth, checked."""
        return load_truth(_truth_of(self.path))

    @property
    def is_clip(self) -> bool:
        """Whether it is a clip."""
        return self.path.suffix.lower() in _CLIPS

    @property
    def is_raw(self) -> bool:
        """Whether it is the sensor's mosaic."""
        return self.path.suffix.lower() == ".dng"

    @cached_property
    def picture(self) -> str | None:
        """Name or path of the picture on the screen, by the words of the file's name; None where none is at hand."""
        for word in self.path.stem.split("_"):
            for suffix in (".png", ".jpg"):
                if self.pictures is not None and (self.pictures / f"{word}{suffix}").is_file():
                    return str(self.pictures / f"{word}{suffix}")
            if word in picture_names():
                return word
        return None

    @cached_property
    def screen(self) -> ScreenProfile:
        """The screen that was seen."""
        return load_profile(str(self.truth.screen), ScreenProfile)

    @cached_property
    def camera(self) -> CameraProfile:
        """The camera as the truth describes it."""
        camera = self.raw["camera"]
        size = {"width": camera["width"], "height": camera["height"]}
        mode = {"name": "capture", **size, "line_delay_s": camera["line_delay_s"], "exposure_s": camera["exposure_s"]}
        lens = {key: camera[key] for key in ("camera_matrix", "dist_coeffs", "distortion_already_corrected")}
        content = {"format": 1, "kind": "camera", "name": camera["name"], "modes": [mode], "lens": {**size, **lens}}
        return check_profile(content, CameraProfile, str(_truth_of(self.path)))

    @property
    def options(self) -> ReceiverOptions:
        """Options of the receiver for the capture and its twins."""
        return ReceiverOptions(screens=(self.screen,), cameras=(self.camera,), force_camera=True)

    @cached_property
    def scene(self) -> Scene:
        """The scene of the twins."""
        camera = self.raw["camera"]
        base = preset(self._preset(camera), self.screen)
        (focal, _, _), _, _ = camera["camera_matrix"]
        sensor = replace(
            base.sensor, width=camera["width"], height=camera["height"], line_delay_s=camera["line_delay_s"]
        )
        return replace(
            base,
            picture=self.picture or _SUBSTITUTE,
            w=self.truth.w,
            sensor=sensor,
            lens=Lens(focal / camera["width"], tuple(camera["dist_coeffs"])),
            pose=Pose(corners=tuple((x, y) for x, y in self.raw["corners_sensor_px"])),
            isp=replace(base.isp, correct_distortion=camera["distortion_already_corrected"]),
            exposure_s=camera["exposure_s"],
            n_frames=len(self.truth.frames),
            frame_rate_hz=camera["frame_rate_hz"],
            orientation=self._orientation,
            camera_name=camera["name"],
            output="raw" if self.is_raw else "developed",
        )

    @property
    def _orientation(self) -> int:
        """EXIF orientation of the file, which says which way the screen's top is."""
        from rxcli.ingest import open_source

        return next(iter(open_source(self.path))).metadata.orientation

    def _preset(self, camera: dict[str, Any]) -> str:
        name = str(camera["name"])
        if name in PRESETS | _CAMERAS:
            return _CAMERAS.get(name, name)
        kinds = ("video-1080p", "phone-corrected", "xs10-still")
        return kinds[0 if self.is_clip else 1 if camera["distortion_already_corrected"] else 2]

    @cached_property
    def starts(self) -> tuple[float, float]:
        """First and last slot at which row 0 of frame 0 may have begun, by the bursts that it shows."""
        frame = self.truth.frames[0]
        slots_per_row = self.scene.sensor.line_delay_s * self.screen.slot_rate_hz
        top = max(np.floor(np.array(self.raw["corners_sensor_px"])[:, 1].min()), 0) * slots_per_row
        length = self.screen.packet_slots * self.screen.repeats
        first = frame.bursts[0]
        latest = (first.burst + 1) * length - first.visible_slots - top
        if len(frame.bursts) > 1:
            return latest - _START_TOLERANCE, latest + _START_TOLERANCE
        return max(first.burst * length - top, 0.0), latest

    @property
    def message(self) -> bytes:
        """The payload of all bursts up to the last that is known, as the simulator sends it."""
        from rxcli.protocol import hex_to_bits

        bits = [np.zeros(0, np.uint8)]
        for burst in range(max(self.truth.payload) + 1):
            sent = self.truth.payload.get(burst, ("00" * 256,) * self.truth.columns)
            bits += [hex_to_bits(text, n) for text, n in zip(sent, self.truth.payload_bits, strict=True)]
        return np.packbits(np.concatenate(bits)).tobytes()


def _truth_of(path: Path) -> Path:
    return path.with_name(path.stem + TRUTH_SUFFIX)


def find_captures(folder: Path, pictures: Path | None = None) -> list[Reference]:
    """The captures of a folder that have a truth, in order of name.

    Raises:
        InputError: there are none.
    """
    truths = sorted(folder.glob(f"*{TRUTH_SUFFIX}"))
    names = [json.loads(path.read_bytes()).get("capture", "") for path in truths]
    found = [Reference(folder / name, pictures) for name in names if name and (folder / name).is_file()]
    if not found:
        raise InputError(f"{folder}: holds no capture with its NAME{TRUTH_SUFFIX}", "name a folder that does")
    return found


@dataclass(frozen=True)
class Look:
    """What came of one capture or one twin."""

    score: Score
    #: Error-free packets of the genie on the sensor's electrons, and on the developed file; None where not known.
    sensor_bound: int | None
    delivered_bound: int | None
    #: Share of the file's light that the genie explains.
    explained: float | None
    #: Mean linear light of the screen.
    light: float | None

    def as_record(self) -> Record:
        """As JSON values."""
        return asdict(self)

    @classmethod
    def from_record(cls, record: Record) -> Look:
        """The inverse of `as_record`."""
        return cls(**{**record, "score": Score(**record["score"])})


def look(reference: Reference, seed: int | None) -> Look:
    """Decode the capture, or one twin of it.

    Args:
        reference: which capture.
        seed: of the twin; None for the capture itself.
    """
    if seed is None:
        return _look_at_file(reference)
    low, high = reference.starts
    if high - low <= 2 * _START_TOLERANCE:
        low = high = (low + high) / 2
    start = float(np.random.default_rng([seed, 14]).uniform(low, high))
    take = prepare(replace(reference.scene, start_slot=start), seed)
    return _look_at_twin_clip(reference, take) if reference.is_clip else _look_at_twin(reference, take)


def _look_at_file(reference: Reference) -> Look:
    from rxcli.ingest import open_source

    score = _score(open_source(reference.path), reference.options, reference.truth)
    if reference.is_clip or reference.is_raw or reference.picture is None:
        return Look(score, None, None, None, None)
    frame = next(iter(open_source(reference.path)))
    scene = replace(reference.scene, payload=reference.message, start_slot=max(reference.starts))
    exposure = prepare(scene, 0).exposure()
    found = []
    for tone in ("srgb", "bt709"):  # the truth does not tell
        isp = replace(scene.isp, tone=tone)
        corners, lens = _geometry(exposure, isp.correct_distortion, reference)
        found.append(delivered(frame, exposure, isp, corners, lens, reference.starts))
    best = max(found, key=lambda one: one.explained)
    return Look(score, None, *_bound(best, reference.truth, score), best.light)


def _geometry(exposure: Exposure, corrected: bool, reference: Reference) -> tuple[FloatArray, Any]:
    model = reference.camera.lens
    assert model is not None, "the truth always tells the lens"
    lens = geometry.lens_for(model, exposure.sensor.width, exposure.sensor.height)
    return corners_on_picture(exposure.view, corrected), lens


def _bound(found: Delivered, truth: Truth, received: Score) -> tuple[int | None, float]:
    """Error-free packets of the genie, and what it explains of the light.

    None where it does not know the picture: it explains too little, or decides worse than the receiver.
    """
    bound = genie_score(found.oracle, truth).error_free
    knows = found.explained >= EXPLAINED and bound >= received.error_free
    return bound if knows else None, found.explained


def _look_at_twin(reference: Reference, take: Take) -> Look:
    capture = take.frame(0, oracle=True)
    truth = _truth_in_memory(capture)
    frame = frame_of(capture)
    score = _score([frame], reference.options, truth)
    assert capture.oracle is not None, "it was asked for"
    sensor = genie_score(capture.oracle, truth).error_free
    if reference.is_raw:
        return Look(score, sensor, None, None, None)
    isp = take.scene.isp
    corners, lens = _geometry(capture.exposure, isp.correct_distortion, reference)
    found = delivered(frame, capture.exposure, isp, corners, lens)
    return Look(score, sensor, *_bound(found, truth, score), found.light)


def _truth_in_memory(capture: Capture) -> Truth:
    import msgspec

    return msgspec.convert(
        {**capture.truth, "payload": {int(k): v for k, v in capture.truth["payload"].items()}}, Truth
    )


def _look_at_twin_clip(reference: Reference, take: Take) -> Look:
    from rxcli.ingest import open_source
    from rxcli.lab.simulate.truth import write_truth
    from rxcli.lab.simulate.video import write_video

    scene = take.scene
    bit_rate = round(8 * reference.path.stat().st_size * scene.frame_rate_hz / scene.n_frames)
    with TemporaryDirectory(prefix="vlc-rx-") as folder:
        path = Path(folder) / "twin.mp4"
        frames = (take.frame(number, threads=1).rgb for number in range(scene.n_frames))
        write_video(frames, path, "h264", scene.frame_rate_hz, bit_rate)
        truth = load_truth(write_truth(take.truth(path.name), path))
        return Look(_score(open_source(path), reference.options, truth), None, None, None, None)


def _score(frames: Iterable[Frame], options: ReceiverOptions, truth: Truth) -> Score:
    scorer = Scorer(truth)
    for result in receive(frames, options):
        scorer.add(result)
    return scorer.score()


def look_record(task: Task) -> Record:
    """One look, as a task of the journal."""
    pictures = task["pictures"]
    reference = Reference(Path(task["capture"]), Path(pictures) if pictures else None)
    return look(reference, task["seed"]).as_record()


def run(
    references: Sequence[Reference],
    n_twins: int,
    journal: Journal,
    *,
    seed: int = 0,
    jobs: int = 1,
    quiet: bool = False,
) -> list[dict[str, Any]]:
    """Look at every capture and at `n_twins` twins of each; a table of two rows a capture."""
    seeds = [None, *(1_000_000 * seed + n for n in range(n_twins))]
    tasks = [
        {
            "capture": str(reference.path),
            "size": reference.path.stat().st_size,
            "pictures": str(reference.pictures) if reference.pictures else None,
            "seed": number,
        }
        for reference in references
        for number in seeds
    ]
    records = run_tasks(tasks, look_record, journal, jobs=jobs, label="captures", quiet=quiet)
    table = []
    for number, reference in enumerate(references):
        looks = [Look.from_record(record) for record in records[number * len(seeds) : (number + 1) * len(seeds)]]
        table += [_row(reference, "capture", looks[:1]), _row(reference, "twins", looks[1:])]
    return table


def _row(reference: Reference, what: str, looks: Sequence[Look]) -> dict[str, Any]:
    score = sum((one.score for one in looks), Score())
    shown = Path(reference.picture).stem if reference.picture else None
    return {
        "capture": reference.path.name,
        "what": what,
        "picture": shown if what == "capture" else shown or _SUBSTITUTE,
        "expected": score.expected,
        "error_free": score.error_free,
        "share": score.error_free / score.expected if score.expected else None,
        "share95": wilson(score.error_free, score.expected),
        "sensor_bound": _share([one.sensor_bound for one in looks], score.expected),
        "delivered_bound": _share([one.delivered_bound for one in looks], score.expected),
        "explained": _mean([one.explained for one in looks]),
        "light": _mean([one.light for one in looks]),
        "false": score.false,
    }


def _share(counts: Sequence[int | None], expected: int) -> float | None:
    known = [count for count in counts if count is not None]
    return sum(known) / expected if known and len(known) == len(counts) and expected else None


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
