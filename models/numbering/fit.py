"""Fit the weights of the numbering: `python models/numbering/fit.py --help`. Prints weights and calibration.

Scenes are drawn at random, as wide as people aim: any camera, screen, picture, place and room. Of each only the
features of the first columns are kept. The scenes of the check have another seed and recipe, that of the benchmark.
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
from rxcli.receiver.plane import read_plane
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.find import ColumnLayout, find_screens
from rxcli.receiver.screen.grid import columns_at
from rxcli.receiver.screen.numbering import WEIGHTS, first_column_features, light_profile, numbering_weights
from rxcli.receiver.screen.waveforms import predicted_light

#: The fit's captures: of any camera, as wide as people aim. The check's: those of the benchmark `dark`.
ANY = {"cameras": ("xs10-still", "phone-plain"), "screens": ("paper-8k65", "paper-17k3", "paper-34k6", "wide-100")}
FIT = Population(**ANY, exposure_slots=(0.4, 2.0), aim=2.2, dark=0.85, fill=(0.45, 1.1), lighted=0.4)
CHECK = Population(**ANY, exposure_slots=(0.4, 1.2), aim=1.7, dark=1.0)
LAYOUTS = {20: ColumnLayout(), 100: ColumnLayout(100, 0.5)}
#: A grid counts if its columns are this near to the true ones: mean and largest distance.
NEAR = (0.2, 0.6)
#: Weight of the pull towards 0, and the weights that are fitted. The others stay as shipped: some scenes of their fit
#: went on outside the picture, and this population has none such.
PULL, FREE = 0.03, ("faint_on_border",)


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


def features_of(scene: Scene, number: int) -> tuple[np.ndarray, int] | None:
    """Features (F, 10) of the first columns of a scene's grid, and the index of the true one; None without its grid."""
    n = scene.screen.columns
    pixels = np.random.default_rng(number).uniform(0.9e6, 1.4e6) * (1 if n == 20 else 2)
    trial = simulate_trial(on_fewer_pixels(scene, pixels), number)
    plane = read_plane(trial.frame)
    screens = find_screens(plane, [LAYOUTS[n]])
    outline = screens[0][0] if screens else None
    if outline is None or outline.grid is None or outline.strips is None:
        return None
    u, v = np.meshgrid(np.linspace(0.02, 0.98, 15), np.linspace(0.02, 0.98, 9), indexing="ij")
    corners = geometry.viewer_order(trial.corners, scene.orientation)
    points = geometry.screen_to_picture(np.stack([u, v], -1), corners, None)
    inside = ((points > 0) & (points < (plane.width, plane.height))).all(axis=-1)
    off = (outline.grid.columns_at(points) - n * u)[inside]
    first = round(float(np.median(off)))
    distance = np.abs(off - first)
    if distance.mean() > NEAR[0] or distance.max() > NEAR[1]:
        return None
    strips, grid = outline.strips, outline.grid
    light = predicted_light(strips, columns_at(grid.coefficients, strips.x, strips.y), LAYOUTS[n].sigma)
    starts, terms, _ = first_column_features(light_profile(strips, light, grid), n)
    true = np.flatnonzero(starts == first)
    return (terms, int(true[0])) if true.size else None


def fitted(scenes: list[tuple[np.ndarray, int]]) -> np.ndarray:
    """Weights that make the true first columns likeliest among the others of their scenes."""

    def cost(weights: np.ndarray) -> float:
        odds = [terms @ weights for terms, _ in scenes]
        doubt = sum(np.logaddexp.reduce(own) - own[true] for own, (_, true) in zip(odds, scenes, strict=True))
        return float(doubt + PULL * weights @ weights)

    shipped = numbering_weights()
    bounds = [(None, None) if name in FREE else (own, own) for name, own in zip(WEIGHTS, shipped, strict=True)]
    return np.asarray(minimize(cost, shipped, bounds=bounds).x)


def calibration(scenes: list[tuple[np.ndarray, int]], weights: np.ndarray) -> str:
    """How often the likeliest first column is the true one, by its certainty."""
    odds = [terms @ weights for terms, _ in scenes]
    certainty = np.array([1 / np.exp(own - own.max()).sum() for own in odds])
    right = np.array([own.argmax() == true for own, (_, true) in zip(odds, scenes, strict=True)])
    lines = [f"{right.size} scenes, right {right.mean():.3f}, mean certainty {certainty.mean():.3f}"]
    bins = np.searchsorted([0.5, 0.7, 0.9, 0.98], certainty, side="right")
    for number in np.unique(bins):
        mine = bins == number
        lines.append(f"{mine.sum():5d}  certainty {certainty[mine].mean():.3f}  right {right[mine].mean():.3f}")
    return "\n".join(lines)


def kept(path: Path, people: Population, seed: int, count: int) -> list[tuple[np.ndarray, int]]:
    """Features of scenes, from a file if they were drawn before."""
    if not path.exists():
        drawn = (people.draw(np.random.default_rng([seed, number, 49]))[0] for number in range(count))
        found = [features_of(scene, number) for number, scene in enumerate(drawn)]
        path.write_bytes(pickle.dumps([one for one in found if one is not None]))
    return list(pickle.loads(path.read_bytes()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Fit the weights of the numbering.")
    parser.add_argument("--count", type=int, default=260, help="scenes of the fit; a third as many check it")
    parser.add_argument("--seed", type=int, default=4900, help="of the fit; the next one is the check's")
    parser.add_argument("--out", type=Path, default=Path("numbering-fit"), help="folder of the features")
    given = parser.parse_args()
    given.out.mkdir(exist_ok=True)
    fit_to = kept(given.out / "fit.pickle", FIT, given.seed, given.count)
    weights = fitted(fit_to)
    print("\n".join(f"{name} = {weight:.3g}" for name, weight in zip(WEIGHTS, weights, strict=True)))
    check = kept(given.out / "check.pickle", CHECK, given.seed + 1, given.count // 3)
    print(f"fit: {calibration(fit_to, weights)}\ncheck: {calibration(check, weights)}")
