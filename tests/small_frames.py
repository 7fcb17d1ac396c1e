"""Small pictures of a screen with ten columns, for tests of what is around the receiver: they decode in no time."""

import json
from pathlib import Path

import cv2
import numpy as np

from rxcli.protocol import bits_to_hex, encode_packet, payload_bits

N_COLUMNS, N_SYMBOLS, W = 10, 5, 5
ROWS_PER_SLOT = 6
HEIGHT, WIDTH = 620, 340
LEFT, TOP, RIGHT, BOTTOM = 10, 10, 329, 609
N_SLOTS = 20 + 10 * N_SYMBOLS
SCREEN = f"""
format = 1
kind = "screen"
name = "small"
columns = {N_COLUMNS}
slot_rate_hz = 10000.0
payload_symbols = {N_SYMBOLS}
width_mm = 320.0
height_mm = 600.0
light_spread = 0.45
"""
CAMERA = f"""
format = 1
kind = "camera"
name = "pinhole"
tone = "linear"

[[modes]]
name = "still"
width = {WIDTH}
height = {HEIGHT}
line_delay_s = {1e-4 / ROWS_PER_SLOT}
exposure_s = 1e-5
"""


def write_profiles(folder: Path) -> list[str]:
    """Write screen and camera; returns the options that name them, and the screen's corners."""
    (folder / "screen.toml").write_text(SCREEN)
    (folder / "camera.toml").write_text(CAMERA)
    corners = [f"{x},{y}" for x, y in ((LEFT, TOP), (RIGHT, TOP), (RIGHT, BOTTOM), (LEFT, BOTTOM))]
    names = ["--screen", str(folder / "screen.toml"), "--camera", str(folder / "camera.toml")]
    return [*names, "--corners", *corners]


def write_frame(path: Path, seed: int) -> list[str]:
    """Write a picture with its truth beside it; returns the payloads, hex by column."""
    rng = np.random.default_rng(seed)
    bits = [rng.integers(0, 2, payload_bits(W, N_SYMBOLS), dtype=np.uint8) for _ in range(N_COLUMNS)]
    burst = np.stack([np.tile(encode_packet(column, W), 3) for column in bits])
    first = int(rng.integers(0, N_SLOTS))
    light = np.repeat(burst[:, first : first + N_SLOTS * 2], ROWS_PER_SLOT, axis=1)[:, : BOTTOM + 1 - TOP].T
    picture = np.full((HEIGHT, WIDTH), 8.0)
    picture[TOP : BOTTOM + 1, LEFT : RIGHT + 1] = 20 + 180 * np.repeat(light, (RIGHT + 1 - LEFT) // N_COLUMNS, axis=1)
    picture += rng.normal(0, 2, picture.shape)
    cv2.imwrite(str(path), np.clip(np.round(picture), 0, 255).astype(np.uint8))
    payloads = [bits_to_hex(column) for column in bits]
    truth = {"capture": path.name, "columns": N_COLUMNS, "payload_symbols": N_SYMBOLS, "w": [W] * N_COLUMNS}
    truth |= {"payload_bits": [payload_bits(W, N_SYMBOLS)] * N_COLUMNS, "payload": {"0": payloads}}
    truth |= {"frames": [{"frame": 0, "bursts": [{"burst": 0, "visible_slots": 100.0}]}]}
    path.with_name(path.stem + ".truth.json").write_text(json.dumps(truth))
    return payloads
