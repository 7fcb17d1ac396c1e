"""Fit the weights of the numbering: `python models/numbering/fit.py --help`. Prints weights and calibration.

Scenes are drawn at random: any camera, screen, picture, place and room. Of each only the features of the first columns
are kept, of the whole picture and of two that were cut. An eighth of the scenes at a time is held out.
"""

from __future__ import annotations

import argparse
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from rxcli.lab.benchmark.trial import simulate_trial
from rxcli.lab.simulate.population import Population
from rxcli.lab.simulate.scenes import Scene
from rxcli.receiver.plane.read import read_plane
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.bright import bright_parts
from rxcli.receiver.screen.find import ColumnLayout, find_screens
from rxcli.receiver.screen.grid import columns_at
from rxcli.receiver.screen.numbering import (
    WEIGHTS,
    LightProfile,
    first_column_features,
    light_profile,
    numbering_weights,
)
from rxcli.receiver.screen.waveforms import predicted_light

ANY = {"cameras": ("xs10-still", "phone-plain"), "screens": ("paper-8k65", "paper-17k3", "paper-34k6", "wide-100")}
DARK = Population(**ANY, exposure_slots=(0.4, 1.2), aim=1.7, dark=1.0)
WIDE_AIM = Population(**ANY, exposure_slots=(0.4, 2.0), aim=2.2, dark=0.85, fill=(0.45, 1.1), lighted=0.4)
BRIGHT = Population(**ANY, exposure_slots=(0.4, 1.2), aim=1.7, dark=0.0)
#: Seed, population, number of scenes drawn, and the only kind of picture that is kept.
SCENES = (
    (2101, DARK, 119, ""),
    (2102, BRIGHT, 48, ""),
    (2103, WIDE_AIM, 120, ""),
    (2104, DARK, 59, ""),
    (2106, DARK, 225, "night"),
)
LAYOUTS = {20: ColumnLayout(20, 0.45, 16 / 9), 100: ColumnLayout(100, 0.5, 16 / 9)}
#: A grid counts if its columns are this near to the true ones: mean and largest distance.
NEAR = (0.2, 0.6)
#: Weight of the pull towards the weights of before, and those that are fitted.
PULL, FREE = 0.5, ("hidden_unlit", "faint_on_border", "part_between", "part_in_middle")
#: Share of pictures that are taken to leave out columns of one side, and their maximum share of the screen; parts of
#: the scenes that are held out in turn.
CUT_SHARE, MAX_CUT, FOLDS = 0.1, 0.25, 8
#: Features (F, 11) of the first columns of a picture, and the index of the true one.
Features = tuple[np.ndarray, int]


def on_fewer_pixels(scene: Scene, n_pixels: float) -> Scene:
    """The scene on a smaller sensor, whose pixels gather the light of those they stand for."""
    share = n_pixels / (scene.sensor.width * scene.sensor.height)
    share = max(share, (2.2 / scene.rows_per_slot) ** 2)
    if share >= 1:
        return scene
    scene, root = scene.scaled(share**0.5, keep_readout=True), share**0.5
    sensor, room = scene.sensor, replace(scene.room, light_e_per_s=scene.room.light_e_per_s / share)
    row_noise_e, read_noise_e = sensor.row_noise_e / share, sensor.read_noise_e / root
    full = {"full_scale_e": sensor.full_scale_e / share, "prnu": sensor.prnu * root}
    sensor = replace(sensor, **full, row_noise_e=row_noise_e, read_noise_e=read_noise_e)
    return replace(scene, sensor=sensor, room=room, light_e_per_s=scene.light_e_per_s / share)


def features_of(scene: Scene, number: int) -> list[Features]:
    """Features of the whole picture of a scene, then of two that were cut; none without its grid."""
    n = scene.screen.columns
    pixels = np.random.default_rng(number).uniform(0.9e6, 1.4e6) * (1 if n == 20 else 2)
    trial = simulate_trial(on_fewer_pixels(scene, pixels), number)
    plane = read_plane(trial.frame)
    parts = [part for part in bright_parts(plane) if part is not None]
    screens = find_screens(plane, [LAYOUTS[n]], None, parts)
    outline = screens[0][0] if screens else None
    if outline is None or outline.grid is None or outline.strips is None:
        return []
    u, v = np.meshgrid(np.linspace(0.02, 0.98, 15), np.linspace(0.02, 0.98, 9), indexing="ij")
    corners = geometry.viewer_order(trial.corners, scene.orientation)
    points = geometry.screen_to_picture(np.stack([u, v], -1), corners, None)
    inside = ((points > 0) & (points < (plane.width, plane.height))).all(axis=-1)
    off = (outline.grid.columns_at(points) - n * u)[inside]
    first = round(float(np.median(off)))
    distance = np.abs(off - first)
    if distance.mean() > NEAR[0] or distance.max() > NEAR[1]:
        return []
    strips, grid = outline.strips, outline.grid
    predicted = predicted_light(strips, columns_at(grid.coefficients, strips.x, strips.y), LAYOUTS[n].sigma)
    light, rng = light_profile(strips, predicted, grid, parts), np.random.default_rng([number, 5])
    found = []
    for one in (light, cut(light, first, n, rng), cut(light, first, n, rng)):
        starts, terms, _ = first_column_features(one, n, LAYOUTS[n].aspect)
        found += [(terms, int(index)) for index in np.flatnonzero(starts == first)]
    return found


def cut(light: LightProfile, first: int, n: int, rng: np.random.Generator) -> LightProfile:
    """The profile of a picture that leaves out some columns of a screen on one side."""
    left_out, shown = rng.uniform(0, MAX_CUT * n), light.place[light.in_picture]
    low, high = (first + left_out, shown.max()) if rng.random() < 0.5 else (shown.min(), first + n - left_out)
    inside = (light.place > low) & (light.place < high)
    values = {name: getattr(light, name) * inside for name in ("in_picture", "coherent", "level", "steady", "faint")}
    whole = (light.sides[:, 0] > low) & (light.sides[:, 1] < high)
    parts = {"sides": light.sides[whole], "heights": light.heights[whole]}
    middle = (max(low, shown.min()) + min(high, shown.max())) / 2
    return replace(light, **values, is_faint=light.is_faint & inside, picture_middle=middle, **parts)


def fitted(scenes: list[list[Features]]) -> np.ndarray:
    """Weights that make the true first columns likeliest among the others of their scenes."""
    shipped = numbering_weights()
    scale = np.maximum(np.abs(shipped), 1)

    def cost(weights: np.ndarray) -> float:
        doubt = 0.0
        for whole, *parts in scenes:
            shares = [1 - CUT_SHARE, *[CUT_SHARE / len(parts) for _ in parts]]
            odds = [(terms @ weights, true) for terms, true in (whole, *parts)]
            doubt += sum(
                share * (np.logaddexp.reduce(own) - own[true]) for share, (own, true) in zip(shares, odds, strict=True)
            )
        return float(doubt + PULL * np.square((weights - shipped) / scale).sum())

    bounds = [(None, None) if name in FREE else (own, own) for name, own in zip(WEIGHTS, shipped, strict=True)]
    return np.asarray(minimize(cost, shipped, bounds=bounds).x)


def calibration(cases: list[tuple[Features, np.ndarray]]) -> str:
    """How often the likeliest first column is the true one, by its certainty under given weights."""
    odds = [(terms @ weights, true) for (terms, true), weights in cases]
    certainty = np.array([1 / np.exp(own - own.max()).sum() for own, _ in odds])
    right = np.array([own.argmax() == true for own, true in odds])
    lines = [f"{right.size} pictures, right {right.mean():.3f}, mean certainty {certainty.mean():.3f}"]
    bins = np.searchsorted([0.5, 0.7, 0.9, 0.98], certainty, side="right")
    for number in np.unique(bins):
        mine = bins == number
        lines.append(f"{mine.sum():5d}  certainty {certainty[mine].mean():.3f}  right {right[mine].mean():.3f}")
    return "\n".join(lines)


def kept(path: Path, seed: int, people: Population, count: int, kind: str) -> list[list[Features]]:
    """Features of scenes, from a file if they were drawn before."""
    if not path.exists():
        drawn = [people.draw(np.random.default_rng([seed, number, 49])) for number in range(count)]
        found = [features_of(scene, n) for n, (scene, own) in enumerate(drawn) if own != "stars" and kind in ("", own)]
        path.write_bytes(pickle.dumps([one for one in found if one]))
    return list(pickle.loads(path.read_bytes()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Fit the weights of the numbering.")
    parser.add_argument("--out", type=Path, default=Path("numbering-fit"), help="folder of the features")
    given = parser.parse_args()
    given.out.mkdir(exist_ok=True)
    scenes = [scene for drawn in SCENES for scene in kept(given.out / f"{drawn[0]}.pickle", *drawn)]
    print("\n".join(f"{name} = {weight:.3g}" for name, weight in zip(WEIGHTS, fitted(scenes), strict=True)))
    by_turn = [fitted([own for number, own in enumerate(scenes) if number % FOLDS != turn]) for turn in range(FOLDS)]
    held_out = [(scene, by_turn[number % FOLDS]) for number, scene in enumerate(scenes)]
    print("whole:", calibration([(scene[0], weights) for scene, weights in held_out]))
    print("cut:", calibration([(part, weights) for scene, weights in held_out for part in scene[1:]]))
