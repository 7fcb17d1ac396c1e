"""Screens that are searched, against true corners: packets, wrong column numbers, packets wrong though confident.

Half of the pictures are dark in one of the ways of `lab.simulate.dark_pictures`, and one screen of eight has a hundred
columns; the screen stands anywhere in the picture, turned and tilted. Cameras are those that a user has: the X-S10 by
its profile, phones without one.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rxcli.lab.benchmark.journal import SEEDS_A_RUN, Record, Task
from rxcli.lab.benchmark.outline import placed
from rxcli.lab.benchmark.statistics import wilson
from rxcli.lab.benchmark.tables import Row
from rxcli.lab.benchmark.trial import Trial, score_result, simulate_trial
from rxcli.lab.simulate.dark_pictures import DARK_KINDS, draw_dark_picture
from rxcli.lab.simulate.pictures import PHOTOS
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.options import ReceiverOptions
from rxcli.receiver.pipeline import receive_frame
from rxcli.types import FrameResult

#: From this confidence on a packet counts as confident.
CONFIDENT = 0.99
_SCREENS, _MANY_COLUMNS, _MANY = ("paper-8k65", "paper-17k3", "paper-34k6"), ("wide-100",), 0.12
_PRESETS = ("xs10-still", "phone-corrected", "phone-plain")
#: Packets that the screen's height holds at least.
_LEAST_PACKETS = 1.25
#: A wrong packet is right under a neighbouring number when so many columns of the frame say the same shift.
_SHIFTED = 2
#: A screen can be found where the true corners give so many packets.
_SHOWN = 5


def scene_of(seed: int, number: int) -> tuple[Scene, str]:
    """A screen anywhere in a picture, and what kind of picture it shows."""
    rng = np.random.default_rng([seed, number, 17])
    screens = _MANY_COLUMNS if rng.random() < _MANY else _SCREENS
    while True:
        base = preset(str(rng.choice(_PRESETS)), str(rng.choice(screens)))
        share = rng.uniform(0.6, 0.97)
        rows = share * base.sensor.height / base.rows_per_slot
        if rows >= _LEAST_PACKETS * base.screen.packet_slots:
            break
    kind = str(rng.choice(DARK_KINDS)) if rng.random() < 0.5 else "photo"
    size = base.screen.width_px, base.screen.height_px
    picture = str(rng.choice(list(PHOTOS))) if kind == "photo" else draw_dark_picture(kind, rng, *size)
    slots = float(rng.choice([0.5, 1.0])) * rng.uniform(0.8, 1.2)
    exposure_s = max(slots / base.screen.slot_rate_hz, 1 / 32000)
    scene = replace(
        base,
        picture=picture,
        w="dimming" if rng.random() < 0.4 else int(rng.integers(2, 9)),
        exposure_s=exposure_s,
        light_e_per_s=base.light_e_per_s * (base.exposure_s / exposure_s) * 10 ** rng.uniform(-0.3, 0.3),
        room=replace(base.room, light_e_per_s=base.light_e_per_s * 10 ** rng.uniform(-3, -1.3)),
        blur_px=rng.uniform(0.5, 1.5),
        slot_rate_error_ppm=rng.uniform(-50, 50),
        orientation=1,
        n_frames=1,
        output="developed",
    )
    angles = (rng.normal(0, 1.5), rng.normal(0, 4), rng.normal(0, 4))
    return placed(scene, share, angles, rng.uniform(-0.9, 0.9, 2)), kind


def options_of(trial: Trial, corners: bool) -> ReceiverOptions:
    """What a user would tell: nothing but, perhaps, the corners."""
    return ReceiverOptions(corners=trial.corners if corners else None)


def packets_of(task: Task) -> Record:
    """Simulate one frame and receive it with the screen searched and with true corners."""
    seed, number = divmod(task["seed"], SEEDS_A_RUN)
    scene, kind = scene_of(seed, number)
    trial = simulate_trial(scene, number)
    out: dict[str, Any] = {"kind": kind, "camera": scene.camera_name, "screen": scene.screen.name}
    for name, corners in (("searched", False), ("given", True)):
        result, score = score_result(receive_frame(trial.frame, options_of(trial, corners)), trial.truth)
        confident = [packet for packet in result.packets if packet.confidence >= CONFIDENT]
        out[name] = {
            "status": result.status,
            "error_free": score.error_free,
            "confident": len(confident),
            "confident_wrong": sum(p.bit_errors != 0 for p in confident),
            "shift": shift_of(result, trial),
            "numbered": result.column_offset is not None,
            "ms": result.timing_ms.get("total", 0.0),
        }
    return {**task, **out}


def shift_of(result: FrameResult, trial: Trial) -> int:
    """By how many columns right packets stand under a wrong number; 0 where they stand under their own."""
    sent = {
        (payload, column)
        for burst in trial.truth.payload.values()
        for column, payload in enumerate(burst)
        if len(payload) > 2
    }
    received = ((column.column, packet.payload) for column in result.columns for packet in column.packets)
    votes = Counter(column - own for column, payload in received for this, own in sent if this == payload)
    best = max(votes, key=votes.__getitem__, default=0)
    return best if votes[best] >= _SHIFTED and votes[best] > votes[0] else 0


def rows(records: Sequence[Record]) -> list[Row]:
    """A row for every kind of picture, for the dark ones, and for all."""
    kinds = sorted({record["kind"] for record in records})
    out = [_row(kind, [r for r in records if r["kind"] == kind]) for kind in kinds]
    return [*out, _row("dark", [r for r in records if r["kind"] != "photo"]), _row("all", list(records))]


def _row(name: str, records: Sequence[Record]) -> Row:
    def total(which: str, what: str) -> int:
        return sum(int(record[which][what]) for record in records)

    given = total("given", "error_free")
    shown = [r for r in records if r["given"]["error_free"] >= _SHOWN]
    confident, wrong = total("searched", "confident"), total("searched", "confident_wrong")
    return {
        "pictures": name,
        "n": len(records),
        "searched": total("searched", "error_free"),
        "corners_given": given,
        "share": total("searched", "error_free") / given if given else None,
        "not_found": sum(r["searched"]["status"] == "no_screen" for r in shown),
        "of": len(shown),
        # Columns that are said to be counted from elsewhere are not numbered wrong.
        "numbered_wrong": sum(r["searched"]["shift"] != 0 and r["searched"]["numbered"] for r in records),
        "shifted": sum(r["searched"]["shift"] != 0 for r in records),
        f"confident_{CONFIDENT:g}": confident,
        "wrong": wrong,
        "wrong_at_most": wilson(wrong, confident)[1] if confident else None,
    }
