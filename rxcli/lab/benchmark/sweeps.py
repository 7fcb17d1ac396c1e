"""Run time against error over what a scene can vary in, with both yardsticks beside it on the same frames.

The sensors are narrowed by binning: the rows, and with them all that concerns time, stay whole; the width shrinks, and
every pixel gathers the light of those it stands for. So error rates are near those of the whole sensor, and a sweep
takes minutes. Times are those of the narrow frames; `rxcli.lab.benchmark.speed` measures whole ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from math import sqrt
from time import perf_counter
from typing import Any

from rxcli.lab.benchmark.journal import SEEDS_A_RUN, Record, Run, Task
from rxcli.lab.benchmark.statistics import cluster_interval, pareto_front, wilson
from rxcli.lab.benchmark.trial import Trial, simulate_trial
from rxcli.lab.benchmark.yardsticks import bound_score, paper_score
from rxcli.lab.simulate.scenes import PRESETS, Scene, preset
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.protocol import packet_slots, payload_bits
from rxcli.receiver.pipeline import SKIPS, ReceiverOptions
from rxcli.results.truth import Score

#: Names of the yardsticks among the methods.
BOUND, PAPER = "bound", "paper"
#: Bit error rate that the paper's forward error correction takes (its Fig. 11).
FEC_THRESHOLD = 3.8e-3
#: Slot rates: the paper's three, then beyond; and payload symbols that keep one payload a frame at 60 frames a second.
SLOT_RATES: dict[float, int] = {8650.0: 5, 17300.0: 11, 34600.0: 24, 51900.0: 37, 69200.0: 50}
#: Width of the binned sensors, pixels for each column of the screen.
_PX_PER_COLUMN = 45.0
_FRAMES_A_SECOND = 60.0


@dataclass(frozen=True)
class Point:
    """One place of a sweep: what the scene is, and where it stands on the sweep's axis."""

    sweep: str
    #: Place on the axis, as it is printed.
    label: str
    #: Place on the axis as a number, None where the axis has names.
    x: float | None = None
    camera: str = "xs10-still"
    columns: int = 20
    slot_rate_hz: float = 34600.0
    payload_symbols: int = 24
    repeats: int = 3
    picture: str = "coffee"
    #: Light against the preset's.
    light: float = 1.0
    #: Exposure in slots; None for the preset's.
    exposure_slots: float | None = None
    roll_deg: float | None = None
    yaw_deg: float | None = None
    pitch_deg: float | None = None
    #: Names of `RECEIVERS` that are run.
    receivers: tuple[str, ...] = ("receiver",)
    #: False for the sensor as it is.
    binned: bool = True

    @property
    def rate_kbps(self) -> float:
        """Data rate as the paper counts it: one payload (w = 5) per column in each of 60 frames a second."""
        return self.columns * payload_bits(5, self.payload_symbols) * _FRAMES_A_SECOND / 1e3

    @property
    def free_rate_kbps(self) -> float:
        """Payload bits a second that the free-running screen sends."""
        bursts = self.slot_rate_hz / (packet_slots(self.payload_symbols) * self.repeats)
        return self.columns * payload_bits(5, self.payload_symbols) * bursts / 1e3


def _without(*skips: str) -> dict[str, Any]:
    return {"skip": frozenset(SKIPS) - set(skips)}


#: Receivers: name -> fields of `ReceiverOptions`, and whether the outline is handed over.
RECEIVERS: dict[str, tuple[dict[str, Any], bool]] = {
    "receiver": ({}, True),
    "outline searched": ({}, False),
    "no auto-encoder": ({"cae": "never"}, True),
    "auto-encoder always": ({"cae": "always"}, True),
    **{f"no skip of {name}": (_without(name), True) for name in SKIPS},
    "no skip at all": (_without(*SKIPS), True),
}
_VARIANTS = tuple(name for name in RECEIVERS if name != "outline searched")


#: What of `Point` the slot rate of 17.3 kHz asks for.
_MIDDLE: dict[str, Any] = {"slot_rate_hz": 17300.0, "payload_symbols": 11}
_FLAT = Point("tilt", "none", 0.0, roll_deg=0.0, yaw_deg=0.0, pitch_deg=0.0)


def _at_rate(point: Point, what: str) -> Point:
    """The point, placed on its sweep's axis by one of its rates."""
    return replace(point, x=getattr(point, what))


def _tilted(about: str, angle: float) -> Point:
    told: dict[str, Any] = {f"{about}_deg": angle}
    return replace(_FLAT, label=f"{about} {angle:g}", x=angle, **told)


#: Sweep -> its points, in order.
SWEEPS: dict[str, tuple[Point, ...]] = {
    "rate": tuple(
        _at_rate(
            Point("rate", f"{shown} {rate / 1e3:g} kHz", picture=shown, slot_rate_hz=rate, payload_symbols=symbols),
            "rate_kbps",
        )
        for shown in ("sky", "flower")
        for rate, symbols in SLOT_RATES.items()
    ),
    "light": tuple(
        Point("light", f"x {light:g}", light, light=light) for light in (0.01, 0.03, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0)
    ),
    "exposure": tuple(
        Point("exposure", f"{slots:g} slots", slots, exposure_slots=slots, **_MIDDLE)
        for slots in (0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0)
    ),
    "picture": tuple(
        Point("picture", shown, picture=shown)
        for shown in ["white", "sky", "text", "chelsea", "astronaut", "coffee", "rocket", "flower", "hubble", "night"]
    ),
    "tilt": (
        _FLAT,
        *(_tilted("roll", angle) for angle in (0.5, 1.0, 2.0, 5.0)),
        *(_tilted(about, angle) for angle in (15.0, 30.0) for about in ("yaw", "pitch")),
    ),
    "camera": tuple(Point("camera", name, camera=name, **_MIDDLE) for name in PRESETS),
    "variants": tuple(
        Point("variants", f"{shown} x {light:g}", picture=shown, light=light, receivers=_VARIANTS)
        for shown, light in (("coffee", 1.0), ("coffee", 0.2), ("flower", 1.0), ("sky", 0.1))
    ),
    "search": tuple(
        Point("search", name, camera=name, receivers=("receiver", "outline searched"), binned=False, **_MIDDLE)
        for name in ("video-1080p", "video-4k", "phone-plain")
    ),
    "table4": tuple(
        _at_rate(
            Point("table4", f"{columns} columns, {repeats} x", columns=columns, repeats=repeats, picture="sky"),
            "free_rate_kbps",
        )
        for columns in (20, 100)
        for repeats in (3, 2, 1)
    ),
}


def screen_of(point: Point) -> ScreenProfile:
    """The screen of a point: a shipped profile, with the point's clock and packet."""
    import msgspec

    base = load_profile("wide-100" if point.columns == 100 else "paper-34k6", ScreenProfile)
    return msgspec.structs.replace(
        base,
        name=f"{point.columns}-columns-{point.slot_rate_hz / 1e3:g}k-{point.repeats}x",
        columns=point.columns,
        slot_rate_hz=point.slot_rate_hz,
        payload_symbols=point.payload_symbols,
        repeats=point.repeats,
    )


def scene_of(point: Point) -> Scene:
    """The scene of a point."""
    scene = preset(point.camera, screen_of(point))
    angles = {name: getattr(point, name) for name in ("roll_deg", "yaw_deg", "pitch_deg")}
    pose = replace(scene.pose, **{name: angle for name, angle in angles.items() if angle is not None})
    scene = replace(
        scene, picture=point.picture, light_e_per_s=scene.light_e_per_s * point.light, pose=pose, n_frames=1
    )
    if point.exposure_slots is not None:
        scene = exposed(scene, point.exposure_slots / point.slot_rate_hz)
    return binned(scene, point.columns * _PX_PER_COLUMN / scene.sensor.width) if point.binned else scene


def exposed(scene: Scene, exposure_s: float) -> Scene:
    """The scene at another exposure, its gain turned so that white stays white."""
    ratio = exposure_s / scene.exposure_s
    sensor = replace(scene.sensor, full_scale_e=scene.sensor.full_scale_e * ratio)
    return replace(scene, exposure_s=exposure_s, sensor=sensor)


def binned(scene: Scene, share: float) -> Scene:
    """The scene on a sensor of `share` of the width, whose pixels gather the light of those they stand for."""
    if share >= 1:
        return scene
    narrow = scene.scaled(share, 1.0)
    sensor = replace(
        narrow.sensor,
        full_scale_e=narrow.sensor.full_scale_e / share,
        read_noise_e=narrow.sensor.read_noise_e / sqrt(share),
        row_noise_e=narrow.sensor.row_noise_e / share,
        prnu=narrow.sensor.prnu * sqrt(share),
    )
    room = replace(narrow.room, light_e_per_s=narrow.room.light_e_per_s / share)
    return replace(narrow, sensor=sensor, room=room, light_e_per_s=narrow.light_e_per_s / share)


@dataclass(frozen=True)
class Outcome:
    """What one method made of one frame."""

    score: Score
    #: Packets reported, false ones included.
    reported: int
    #: Wall time by stage, milliseconds; empty for the bound.
    timing_ms: dict[str, float] = field(default_factory=dict)

    @classmethod
    def from_record(cls, record: Record) -> Outcome:
        """The inverse of `asdict`."""
        return cls(Score(**record["score"]), record["reported"], record["timing_ms"])


def frame_of(task: Task) -> Record:
    """Simulate one frame of a point and run the yardsticks and receivers on it: method -> outcome."""
    values = {**task["point"], "receivers": tuple(task["point"]["receivers"])}
    point = Point(**values)
    trial = simulate_trial(scene_of(point), task["seed"], oracle=True)
    start = perf_counter()
    paper = paper_score(trial)
    paper_ms = 1e3 * (perf_counter() - start)
    bound = bound_score(trial)
    outcomes = {name: _receive(trial, name) for name in point.receivers}
    outcomes[BOUND] = Outcome(bound, _received(bound))
    outcomes[PAPER] = Outcome(paper, _received(paper), {"total": paper_ms})
    return {name: asdict(outcome) for name, outcome in outcomes.items()}


def _received(score: Score) -> int:
    return score.expected - score.lost + score.extra + score.false


def _receive(trial: Trial, name: str) -> Outcome:
    more, known = RECEIVERS[name]
    options: ReceiverOptions = trial.options(known_outline=known, **more)
    result, score = trial.receive(options)
    return Outcome(score, len(result.packets), result.timing_ms)


def _packet_clusters(scores: Sequence[Score]) -> tuple[list[float], list[float]]:
    """Wrong bits and bits of every packet, as far as scores tell: those that are neither lost nor right are alike."""
    errors: list[float] = []
    sizes: list[float] = []
    for score in scores:
        if score.expected:
            wrong = score.expected - score.lost - score.error_free
            errors += [score.lost_bits / 2 / max(score.lost, 1)] * score.lost + [0.0] * score.error_free
            errors += [score.bit_errors / max(wrong, 1)] * wrong
            sizes += [score.bits / score.expected] * score.expected
    return errors, sizes


@dataclass(frozen=True)
class Summary:
    """What one method made of all frames of a point."""

    point: Point
    method: str
    outcomes: tuple[Outcome, ...]

    @property
    def score(self) -> Score:
        """Sum over the frames."""
        return sum((outcome.score for outcome in self.outcomes), Score())

    @property
    def ber_interval(self) -> tuple[float, float]:
        """Wilson interval of the bit error rate.

        Bits of a packet hang together, and so may packets of a frame: the wider of the two intervals that take packets
        and frames as clusters.
        """
        scores = [outcome.score for outcome in self.outcomes]
        errors = [score.bit_errors + score.lost_bits / 2 for score in scores]
        by_frame = cluster_interval(errors, [score.bits for score in scores], self.score.expected)
        by_packet = cluster_interval(*_packet_clusters(scores), self.score.expected)
        return min(by_frame[0], by_packet[0]), max(by_frame[1], by_packet[1])

    def median_ms(self, stage: str = "total") -> float | None:
        """Median over the frames of the wall time of one stage; None where no frame ran it."""
        from statistics import median

        times = [o.timing_ms[stage] for o in self.outcomes if stage in o.timing_ms]
        return median(times) if times else None

    def as_row(self) -> dict[str, Any]:
        """The table's row."""
        score, point = self.score, self.point
        reported = sum(outcome.reported for outcome in self.outcomes)
        return {
            "sweep": point.sweep,
            "point": point.label,
            "method": self.method,
            "frames": len(self.outcomes),
            "packets": score.expected,
            "ber": score.ber,
            "ber95": self.ber_interval,
            "error_free": score.error_free / score.expected if score.expected else None,
            "error_free95": wilson(score.error_free, score.expected),
            "lost": score.lost,
            "extra": score.extra_error_free,
            # The genie decides whatever it sees, sure or not.
            "false": None if self.method == BOUND else score.false,
            "false95": None if self.method == BOUND else wilson(score.false, reported),
            "ms": self.median_ms(),
        }

    def details(self) -> dict[str, Any]:
        """What programs may want beside the row."""
        stages = sorted({stage for outcome in self.outcomes for stage in outcome.timing_ms})
        return {
            "point": asdict(self.point),
            "method": self.method,
            "rate_kbps": self.point.rate_kbps,
            "free_rate_kbps": self.point.free_rate_kbps,
            "score": asdict(self.score),
            "median_ms": {stage: self.median_ms(stage) for stage in stages},
        }


def points_of(names: Iterable[str]) -> list[Point]:
    """The points of some sweeps, in order."""
    return [point for name in names for point in SWEEPS[name]]


def run(points: Sequence[Point], n_frames: int, how: Run) -> list[Summary]:
    """Run every point on `n_frames` frames; one summary per point and method, receivers first."""
    seeds = range(SEEDS_A_RUN * how.seed, SEEDS_A_RUN * how.seed + n_frames)
    tasks = [{"point": asdict(point), "seed": seed} for point in points for seed in seeds]
    records = how.tasks("sweep", tasks, frame_of)
    summaries = []
    for number, point in enumerate(points):
        mine = records[number * n_frames : (number + 1) * n_frames]
        for method in (*point.receivers, BOUND, PAPER):
            outcomes = tuple(Outcome.from_record(record[method]) for record in mine)
            summaries.append(Summary(point, method, outcomes))
    return summaries


@dataclass(frozen=True)
class PlanePoint:
    """One method in the plane of run time and error."""

    method: str
    ms: float
    ber: float
    on_front: bool


def run_time_plane(summaries: Sequence[Summary]) -> list[PlanePoint]:
    """Run time (mean of the points' medians) against bit error rate (over all points) of every method.

    Args:
        summaries: of points on which all the methods ran; a method that did not run on all of them is left out.
    """
    n_points = len({summary.point for summary in summaries})
    costs: dict[str, tuple[float, float]] = {}
    for method in dict.fromkeys(summary.method for summary in summaries):
        mine = [summary for summary in summaries if summary.method == method]
        times = [ms for summary in mine if (ms := summary.median_ms()) is not None]
        ber = sum((summary.score for summary in mine), Score()).ber
        if len(times) == n_points and ber is not None:
            costs[method] = (sum(times) / len(times), ber)
    front = pareto_front(list(costs.values()))
    return [PlanePoint(m, *cost, on) for (m, cost), on in zip(costs.items(), front, strict=True)]
