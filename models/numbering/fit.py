"""Fit the weights of the numbering: `python models/numbering/fit.py --help`. Prints weights and calibration.

Scenes are drawn at random, as wide as people aim: any camera, screen, picture, place and room. Of each only the
features of the first columns are kept. The scenes of the check have another seed and other recipes, those of the
benchmark.
"""

from __future__ import annotations

import argparse
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from rxcli.lab.benchmark.draw import phone_of, placed, screen_of
from rxcli.lab.benchmark.trial import simulate_trial
from rxcli.lab.simulate.pictures import DARK_KINDS, draw_dark_picture, draw_name
from rxcli.lab.simulate.scenes import Scene, draw_weight, preset, random_scene
from rxcli.receiver.plane import read_plane
from rxcli.receiver.screen import geometry
from rxcli.receiver.screen.find import ColumnLayout, find_screens
from rxcli.receiver.screen.grid import columns_at
from rxcli.receiver.screen.numbering import WEIGHTS, first_column_features, light_profile
from rxcli.receiver.screen.waveforms import predicted_light

CAMERAS = ("xs10-still", "phone-corrected", "phone-plain", "video-4k")
SLOW, SCREENS = ("paper-8k65", "paper-17k3"), ("paper-8k65", "paper-17k3", "paper-34k6")
LAYOUTS = {20: ColumnLayout(), 100: ColumnLayout(100, 0.5)}
#: A grid counts if its columns are this near to the true ones: mean and largest distance.
NEAR = (0.2, 0.6)
#: Weight of the pull towards 0; unit of steady light, whose weight is large.
PULL, STEADY_UNIT = 0.003, 20.0


def picture_of(rng: np.random.Generator, scene: Scene, dark: float) -> Scene:
    """The scene with a photograph, or with one of the dark pictures; few star fields, which are hardly ever found."""
    kinds = [kind for kind in DARK_KINDS if kind != "stars" or rng.random() < 0.05]
    if rng.random() < dark:
        size = scene.screen.width_px, scene.screen.height_px
        return replace(scene, picture=draw_dark_picture(str(rng.choice(kinds)), rng, *size))
    return replace(scene, picture=draw_name(rng))


def scene_to_fit(seed: int, number: int) -> Scene:
    """Any scene; one in seven is larger than the picture or goes on outside of it."""
    rng = np.random.default_rng([seed, number, 49])
    screens = ("wide-100",) if rng.random() < 0.06 else (*SLOW, *SLOW, *SCREENS)
    while True:
        base = preset(str(rng.choice(CAMERAS)), str(rng.choice(screens)))
        share = rng.uniform(0.45, 1.0) if rng.random() < 0.85 else rng.uniform(1.0, 1.3)
        if min(share, 1) * base.sensor.height / base.rows_per_slot >= 0.9 * base.screen.packet_slots:
            break
    base = picture_of(rng, base, 0.8)
    slots, weight = float(rng.choice([0.4, 0.7, 1.0, 1.5, 2.0])) * rng.uniform(0.8, 1.2), draw_weight(rng, 0.5)
    lit = base.exposed(max(slots / base.screen.slot_rate_hz, 1 / 32000), 10 ** rng.uniform(-0.6, 0.3))
    room_light = base.light_e_per_s * 10 ** (rng.uniform(-4, -2) if rng.random() < 0.6 else rng.uniform(-2, -0.7))
    wall, bezel = np.exp(rng.uniform(*np.log((0.03, 0.6)))), rng.uniform(0.02, 0.2)
    room = replace(base.room, light_e_per_s=room_light, wall_reflectance=float(wall), bezel_reflectance=bezel)
    room = replace(room, lamp=float(rng.choice([0, 0, rng.uniform(0, 0.05)])))
    scene = replace(lit, w=weight, room=room, blur_px=rng.uniform(0.5, 2.0), n_frames=1, output="developed")
    scene = replace(scene, slot_rate_error_ppm=rng.uniform(-50, 50))
    roll, yaw, pitch = rng.normal(0, 1.5), rng.normal(0, 5), rng.normal(0, 4)
    if share <= 1:
        place = rng.uniform(-1, 1, 2) if rng.random() < 0.5 else np.clip(rng.normal(0, 0.4, 2), -1, 1)
        return placed(scene, share, (roll, yaw, pitch), place)
    fill, x, y = share * rng.uniform(0.7, 1), rng.uniform(-0.3, 0.3), rng.uniform(-0.1, 0.1)
    pose = replace(scene.pose, fill=fill, roll_deg=roll, yaw_deg=yaw, pitch_deg=pitch, shift_x=x, shift_y=y)
    return replace(scene, pose=pose)


def scene_to_check(seed: int, number: int) -> Scene:
    """A screen of `benchmark screens`, a phone of `benchmark phones`, or any scene; three in four dark."""
    rng = np.random.default_rng([seed, number, 50])
    if number % 3 == 0:
        return replace(screen_of(seed, number)[0], output="developed")
    scene = phone_of(seed, number)[0] if number % 3 == 1 else random_scene(rng)
    scene = picture_of(rng, scene, 0.75)
    x, y = rng.normal(0, (0.045, 0.035))
    pose = replace(scene.pose, roll_deg=rng.normal(0, 1.5), shift_x=x, shift_y=y)
    if number % 3 == 1:
        pose = replace(pose, fill=rng.uniform(0.6, 0.9))
        room = replace(scene.room, light_e_per_s=scene.light_e_per_s * 10 ** rng.uniform(-3.5, -1))
        return replace(scene, pose=pose, room=room)
    return replace(scene, pose=pose, output="developed", orientation=1)


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
    """Features (F, 9) of the first columns of a scene's grid, and the index of the true one; None without its grid."""
    n = scene.screen.columns
    pixels = np.random.default_rng(number).uniform(0.9e6, 1.4e6) * (1 if n == 20 else 2)
    trial = simulate_trial(on_fewer_pixels(scene, pixels), number)
    plane = read_plane(trial.frame)
    screens = find_screens(plane, [LAYOUTS[n]])
    outline = screens[0][0] if screens else None
    if outline is None or outline.grid is None or outline.strips is None:
        return None
    u, v = np.meshgrid(np.linspace(0.02, 0.98, 15), np.linspace(0.02, 0.98, 9), indexing="ij")
    points = geometry.screen_to_picture(np.stack([u, v], -1), trial.corners, None)
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
    unit = np.where(np.array(WEIGHTS) == "steady_inside", STEADY_UNIT, 1.0)

    def cost(weights: np.ndarray) -> float:
        odds = [(terms * unit) @ weights for terms, _ in scenes]
        doubt = sum(np.logaddexp.reduce(own) - own[true] for own, (_, true) in zip(odds, scenes, strict=True))
        return float(doubt + PULL * weights @ weights)

    return np.asarray(minimize(cost, np.zeros(unit.size)).x * unit)


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


def kept(path: Path, draw, seed: int, count: int) -> list[tuple[np.ndarray, int]]:
    """Features of scenes, from a file if they were drawn before."""
    if not path.exists():
        found = [features_of(draw(seed, number), number) for number in range(count)]
        path.write_bytes(pickle.dumps([one for one in found if one is not None]))
    return list(pickle.loads(path.read_bytes()))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Fit the weights of the numbering.")
    parser.add_argument("--count", type=int, default=600, help="scenes of the fit; a third as many check it")
    parser.add_argument("--seed", type=int, default=4900, help="of the fit; the next one is the check's")
    parser.add_argument("--out", type=Path, default=Path("numbering-fit"), help="folder of the features")
    given = parser.parse_args()
    given.out.mkdir(exist_ok=True)
    fit_to = kept(given.out / "fit.pickle", scene_to_fit, given.seed, given.count)
    weights = fitted(fit_to)
    print("\n".join(f"{name} = {weight:.3g}" for name, weight in zip(WEIGHTS, weights, strict=True)))
    check = kept(given.out / "check.pickle", scene_to_check, given.seed + 1, given.count // 3)
    print(f"fit: {calibration(fit_to, weights)}\ncheck: {calibration(check, weights)}")
