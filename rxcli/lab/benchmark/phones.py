"""Phones that nobody has measured: is the camera estimated from the picture, and are the packets right?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rxcli.lab.benchmark.confidence import reported_packets
from rxcli.lab.benchmark.journal import SEEDS_A_RUN, Record, Task
from rxcli.lab.benchmark.tables import Row
from rxcli.lab.benchmark.trial import SOURCE, Trial, score_result, simulate_trial
from rxcli.lab.simulate.isp import Isp
from rxcli.lab.simulate.optics import Lens, Pose
from rxcli.lab.simulate.pictures import PHOTOS
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.lab.simulate.sensor import Sensor
from rxcli.profiles import ScreenProfile, shipped_profiles
from rxcli.receiver.pipeline import ReceiverOptions, receive_frame
from rxcli.types import FloatArray, Frame, FrameResult

#: Rows per slot are to be as near as this; further off than that is a wild guess. Both relative.
BOUND, WILD = 5e-4, 1e-2
_SCREENS = ("paper-8k65", "paper-17k3", "paper-34k6")
_HEIGHTS_PX = (720, 1080, 1440, 1800)
_ROWS_PER_SLOT, _READOUT_S, _FILL = (1.5, 20.0), (5e-3, 45e-3), (0.75, 0.95)
#: Packets that the screen's height holds, with some room for tilt over the 1.3 that are asked for.
_LEAST_PACKETS = 1.35
_FOCAL_WIDTHS, _K1, _K2_SHARE = (0.65, 1.2), 0.15, 1.2
_EXPOSURE_SLOTS = (0.4, 0.7, 1.0, 1.5, 2.0)
_CONFIDENT = (0.9, 0.99)
#: Noise of a scene's simulation starts from this and the phone's number.
FIRST_SEED = 1000


def phone_of(seed: int, number: int) -> tuple[Scene, bool]:
    """A random phone before a screen, and whether its picture was turned upside down by software."""
    rng = np.random.default_rng([seed, number])
    screen, sensor, fill = _readout_of(rng)
    focal, k1 = rng.uniform(*_FOCAL_WIDTHS), rng.uniform(-_K1, _K1)
    k2 = -k1 * rng.uniform(0, _K2_SHARE)
    corrected, turned = bool(rng.random() < 0.5), bool(rng.random() < 0.3)
    base = preset("phone-plain", screen)
    exposure_slots = float(rng.choice(_EXPOSURE_SLOTS)) * rng.uniform(0.85, 1.15)
    lens = Lens(focal, (k1, k2, rng.normal(0, 4e-4), rng.normal(0, 4e-4), 0.0))
    tilt = rng.normal(0, (1.2, 4, 3))
    roll, yaw, pitch = float(tilt[0]) + 180 * turned, float(tilt[1]), float(tilt[2])
    shift_x, shift_y = (float(shift) for shift in rng.normal(0, 0.01, 2))
    tone: Any = str(rng.choice(["srgb", "bt709"]))
    sharpen, denoise_px = rng.uniform(0, 0.8), rng.uniform(0, 0.6)
    scene = replace(
        base,
        sensor=sensor,
        lens=lens,
        pose=Pose(fill, roll, yaw, pitch, shift_x, shift_y),
        isp=Isp(tone, 2.0, sharpen, denoise_px=denoise_px, correct_distortion=corrected, quality=90),
        picture=str(rng.choice(list(PHOTOS))),
        w="dimming" if rng.random() < 0.3 else int(rng.integers(3, 9)),
        exposure_s=exposure_slots / screen.slot_rate_hz,
        light_e_per_s=1.4e6 / 24000 / (exposure_slots / screen.slot_rate_hz) * 10 ** rng.uniform(-0.3, 0.2),
        orientation=1,
        slot_rate_error_ppm=0.0,
        blur_px=rng.uniform(0.5, 1.2),
    )
    return scene, turned


def _readout_of(rng: np.random.Generator) -> tuple[ScreenProfile, Sensor, float]:
    """A screen, a sensor that reads out as fast as a phone's and sees enough packets, and how much the screen fills."""
    screens = {screen.name: screen for screen in shipped_profiles(ScreenProfile)}
    while True:
        screen = screens[str(rng.choice(list(_SCREENS)))]
        rows_per_slot = float(np.exp(rng.uniform(*np.log(_ROWS_PER_SLOT))))
        fill = rng.uniform(*_FILL)
        height = int(rng.choice(_HEIGHTS_PX))
        line_delay_s = 1 / (rows_per_slot * screen.slot_rate_hz)
        rows = height * fill * (4 / 3) / screen.aspect
        enough = rows / rows_per_slot / screen.packet_slots >= _LEAST_PACKETS
        if enough and _READOUT_S[0] <= line_delay_s * height <= _READOUT_S[1]:
            break
    levels: dict[str, Any] = {"read_noise_e": 2.0, "full_scale_e": 260.0, "black_level": 64, "white_level": 1023}
    return screen, Sensor(height * 4 // 3, height, line_delay_s, "bayer", **levels), fill


def packets_of(task: Task) -> Record:
    """Simulate and receive one phone's picture blindly; what was estimated, and what was reported of every packet."""
    seed, number = divmod(task["seed"], SEEDS_A_RUN)
    scene, turned = phone_of(seed, number)
    trial = simulate_trial(scene, FIRST_SEED + number)
    frame, corners = as_stored(trial, turned)
    options = ReceiverOptions(cameras=(), corners=corners, cae=task["cae"])
    result, _ = score_result(receive_frame(frame, options), trial.truth)
    about = {
        "screen": scene.screen.name,
        "picture": scene.picture,
        "rows_per_slot": scene.rows_per_slot,
        "exposure_slots": scene.exposure_s * scene.screen.slot_rate_hz,
        "corrected": scene.isp.correct_distortion,
        "turned": turned,
        "k1": scene.lens.distortion[0] / scene.lens.focal_widths**2,
    }
    return {**about, **_found(result, trial)}


def as_stored(trial: Trial, turned: bool) -> tuple[Frame, FloatArray]:
    """The picture without any metadata, as software may have turned it, and the screen's corners on it."""
    pixels, corners = np.asarray(trial.capture.pixels, np.uint8), trial.corners
    if turned:
        height, width = pixels.shape
        pixels, corners = np.ascontiguousarray(pixels[::-1, ::-1]), np.array([width - 1, height - 1]) - corners
    return Frame(pixels, SOURCE), corners


def _found(result: FrameResult, trial: Trial) -> Record:
    rows_per_slot, sd = result.estimated.get("rows_per_slot", (None, None))
    return {
        "status": result.status,
        "message": result.message,
        "screen_hat": result.screen_profile,
        "rows_per_slot_hat": rows_per_slot,
        "rows_per_slot_sd": sd,
        "packets": reported_packets(result, trial.truth.w),
    }


#: Kinds of phones that the table tells apart.
_KINDS: tuple[tuple[str, Callable[[Record], bool]], ...] = (
    ("all", lambda record: True),
    ("uncorrected", lambda record: not record["corrected"]),
    ("corrected", lambda record: bool(record["corrected"])),
    ("below 3 rows a slot", lambda record: bool(record["rows_per_slot"] < 3)),
    ("exposed above 1.4 slots", lambda record: bool(record["exposure_slots"] > 1.4)),
    ("star field", lambda record: bool(record["picture"] == "hubble")),
)


def rows(records: Sequence[Record]) -> list[Row]:
    """How many of each kind of phone were estimated, how well, and what became of their packets."""
    return [_row(name, [record for record in records if of_kind(record)]) for name, of_kind in _KINDS]


def _row(name: str, records: Sequence[Record]) -> Row:
    error = np.array([_error(record) for record in records], np.float64)
    sd = np.array([(record["rows_per_slot_sd"] or np.nan) / record["rows_per_slot"] for record in records], np.float64)
    off = np.abs(error / sd)[np.abs(error) < WILD]
    packets = [packet for record in records for packet in record["packets"]]
    row: Row = {
        "phones": name,
        "n": len(records),
        "within": int((np.abs(error) < BOUND).sum()),
        "none": int(np.isnan(error).sum()),
        "wild": int((np.abs(error) >= WILD).sum()),
        "in_1_sd": float((off < 1).mean()) if off.size else None,
        "in_2_sd": float((off < 2).mean()) if off.size else None,
        "packets": len(packets),
        "right": sum(packet["bit_errors"] == 0 for packet in packets),
    }
    for least in _CONFIDENT:
        sure = [packet["bit_errors"] > 0 for packet in packets if packet["confidence"] >= least]
        row |= {f"at_{least:g}": len(sure), f"wrong_at_{least:g}": sum(sure)}
    return row


def _error(record: Record) -> float:
    """Relative error of rows per slot; NaN where none was estimated."""
    found = record["rows_per_slot_hat"]
    return np.nan if found is None else float(found / record["rows_per_slot"] - 1)


def missed(records: Sequence[Record]) -> list[Row]:
    """The phones whose rows per slot are further off than the bound, with what may be the reason."""
    return [
        {
            "number": number,
            "picture": record["picture"],
            "rows_per_slot": record["rows_per_slot"],
            "exposure_slots": record["exposure_slots"],
            "corrected": record["corrected"],
            "k1": record["k1"],
            "error_percent": None if np.isnan(_error(record)) else 100 * _error(record),
            "status": record["status"],
        }
        for number, record in enumerate(records)
        if not abs(_error(record)) < BOUND
    ]
