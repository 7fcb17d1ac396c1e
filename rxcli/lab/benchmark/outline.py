"""How near the corners of found screens are to the true ones: at any place and size, turned, in any room and picture.

Frames have full size, and take some seconds each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rxcli.lab.benchmark.journal import Record, Task
from rxcli.lab.benchmark.tables import Row
from rxcli.lab.benchmark.trial import Trial, simulate_trial
from rxcli.lab.simulate.optics import View
from rxcli.lab.simulate.pictures import draw_name
from rxcli.lab.simulate.scenes import PRESETS, Scene, preset
from rxcli.receiver.corners import levels_of
from rxcli.receiver.screen.find import find_screen
from rxcli.types import FloatArray

#: Corners are to be as near as this, screen widths.
BOUND = 0.003
_SCREENS = ("paper-8k65", "paper-17k3", "paper-34k6")
#: Pictures with next to no light, and with black along whole sides of the screen.
_DARK, _BLACK_SIDES = ("hubble", "night"), ("bars", "flower", "retina", "rocket")
#: Light of the room against the screen's from which it counts as bright.
_BRIGHT = 0.3


def search_record(task: Task) -> Record:
    """Simulate one frame and look for its screen; what is hard about it, and the error, None where none was found."""
    scene = scene_of(task["seed"])
    error = search(simulate_trial(scene, 1))
    return {"kind": kind_of(scene), "error": None if np.isnan(error) else error}


def kind_of(scene: Scene) -> str:
    """What is hard about the frame."""
    if scene.picture in _DARK:
        return "next to no light"
    if scene.picture in _BLACK_SIDES:
        return "black along a side"
    return "bright room" if scene.room.light_e_per_s > _BRIGHT * scene.light_e_per_s else "other"


def scene_of(seed: int) -> Scene:
    """A screen of 40 to 98 % of the picture's height or width, anywhere in it, turned, tilted and rolled."""
    rng = np.random.default_rng([seed, 8])
    base = preset(str(rng.choice(list(PRESETS))), str(rng.choice(_SCREENS)))
    slots = float(rng.choice([0.25, 0.5, 1.0, 1.5, 2.0])) * rng.uniform(0.8, 1.2)
    exposure_s = max(slots / base.screen.slot_rate_hz, 1 / 32000)
    light = base.light_e_per_s * (base.exposure_s / exposure_s) * 10 ** rng.uniform(-0.7, 0.3)
    lamp = float(rng.choice([0.0, rng.uniform(0, 0.1)]))
    scene = replace(
        base,
        picture=draw_name(rng),
        w="dimming" if rng.random() < 0.3 else int(rng.integers(2, 9)),
        room=replace(base.room, light_e_per_s=light * 10 ** rng.uniform(-3, 0), lamp=lamp),
        exposure_s=exposure_s,
        light_e_per_s=light,
        blur_px=rng.uniform(0.4, 2.5),
        column_delay_slots=float(rng.choice([0.0, rng.uniform(0, 2)])),
        n_frames=1,
        output="raw" if base.sensor.pattern is not None and rng.random() < 0.25 else "developed",
    )
    angles = (rng.uniform(-5, 5), rng.uniform(-10, 10), rng.uniform(-10, 10))
    return placed(scene, rng.uniform(0.4, 0.98), angles, rng.uniform(-0.97, 0.97, 2))


def placed(scene: Scene, share: float, angles: tuple[float, float, float], place: FloatArray) -> Scene:
    """The scene with a screen of a share of the picture, at `place` (-1..1) of the room that is left."""
    sensor = scene.sensor
    size = np.array([sensor.width, sensor.height])
    roll, yaw, pitch = angles
    pose = replace(scene.pose, fill=0.9, roll_deg=roll, yaw_deg=yaw, pitch_deg=pitch, shift_x=0.0, shift_y=0.0)
    for _ in range(12):
        view = View(scene.screen, scene.lens, pose, sensor.width, sensor.height, sensor.pixel_aspect)
        low, high = view.corners.min(axis=0), view.corners.max(axis=0)
        goal = size / 2 + place * np.maximum(size - (high - low), 0) / 2
        x, y = 0.9 * (goal - (low + high) / 2) / size
        fill = pose.fill * min(share * size[1] / (high - low)[1], 0.985 * size[0] / (high - low)[0])
        pose = replace(pose, fill=float(fill), shift_x=pose.shift_x + float(x), shift_y=pose.shift_y + float(y))
    return replace(scene, pose=pose)


def corner_error(found: FloatArray, truth: FloatArray) -> float:
    """Largest distance of a corner in screen widths, whichever comes first in their order."""
    distances = [np.linalg.norm(np.roll(found, turn, axis=0) - truth, axis=1).max() for turn in range(4)]
    return float(min(distances) / np.linalg.norm(truth[1] - truth[0]))


def search(trial: Trial) -> float:
    """`corner_error` of the screen that is found in a trial's frame; NaN where none is."""
    frame = trial.frame
    found = find_screen(frame.pixels, **levels_of(frame))
    return float("nan") if found.corners is None else corner_error(found.corners, trial.corners)


def rows(records: Sequence[Record]) -> list[Row]:
    """A row for every kind of frame, and one for all."""
    kinds = sorted({record["kind"] for record in records})
    found = [_row(kind, [record for record in records if record["kind"] == kind]) for kind in kinds]
    return [*found, _row("all", records)]


def _row(name: str, records: Sequence[Record]) -> Row:
    error = np.array([record["error"] for record in records], np.float64)  # None becomes NaN
    seen = error[~np.isnan(error)]
    return {
        "frames": name,
        "n": error.size,
        "within_0.3_%": float((seen < BOUND).sum() / max(error.size, 1)),
        "none_found": float(1 - seen.size / max(error.size, 1)),
        "median_error": float(np.median(seen)) if seen.size else None,
    }
