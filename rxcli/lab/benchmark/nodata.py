"""Pictures and clips without data: is anything reported of them?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rxcli.lab.benchmark.journal import SEEDS_A_RUN, Record, Task
from rxcli.lab.benchmark.tables import Row
from rxcli.lab.simulate.no_data import STRIPED_KINDS, NoData, draw_kind, draw_no_data
from rxcli.options import ReceiverOptions
from rxcli.profiles import CameraProfile, ReadoutMode
from rxcli.receiver.pipeline import receive
from rxcli.types import Frame

#: Confidences from which packets are counted.
LEVELS = (0.0, 0.5, 0.9, 0.99)
#: Time that a camera that is told takes to read a picture out, and rows that it exposes: such as are, whatever the
#: picture shows.
_READOUT_S, _EXPOSURE_ROWS = (10e-3, 40e-3), (0.5, 12.0)
SOURCE = "no data"


@dataclass(frozen=True)
class Drawn:
    """Frames without data, and the camera that is said to have taken them."""

    made: NoData
    frames: tuple[Frame, ...]
    options: ReceiverOptions


def draw(seed: int, number: int, camera: str = "unknown", n_frames: int = 1) -> Drawn:
    """Frames that a seed and a number stand for.

    Args:
        seed: of the run.
        number: in the run.
        camera: "unknown", or "known" for one whose profile is told.
        n_frames: more than one for a clip.
    """
    rng = np.random.default_rng([seed, number, 23])
    made = draw_no_data(draw_kind(rng, number % 2 == 0), rng, n_frames)
    height, width = made.frames[0].shape
    line_delay_s = float(np.exp(rng.uniform(*np.log(_READOUT_S)))) / height
    step_s = made.frame_rows * line_delay_s
    frames = tuple(Frame(pixels, SOURCE, index, index * step_s) for index, pixels in enumerate(made.frames))
    if camera == "unknown":
        return Drawn(made, frames, ReceiverOptions(cameras=()))
    exposure_s = line_delay_s * float(rng.uniform(*_EXPOSURE_ROWS))
    mode = ReadoutMode(name="whole", width=width, height=height, line_delay_s=line_delay_s, exposure_s=exposure_s)
    profile = CameraProfile(format=1, kind="camera", name="said", modes=(mode,))
    return Drawn(made, frames, ReceiverOptions(cameras=(profile,), force_camera=True))


def packets_of(task: Task) -> Record:
    """Draw and receive one picture or clip; what was reported of it."""
    seed, number = divmod(task["seed"], SEEDS_A_RUN)
    drawn = draw(seed, number, task["camera"], task["n_frames"])
    results = list(receive(drawn.frames, drawn.options))
    confidences = [packet.confidence for result in results for packet in result.packets]
    return {
        "number": number,
        "kind": drawn.made.kind,
        "striped": drawn.made.kind in STRIPED_KINDS,
        "about": drawn.made.about,
        "status": results[0].status,
        "screen": results[0].screen_profile,
        "message": results[0].message,
        "confidences": confidences,
        "ms": sum(r.timing_ms.get("total", 0.0) for r in results),
    }


def rows(records: Sequence[Record]) -> list[Row]:
    """A row for every kind, for the striped ones, and for all."""
    kinds = sorted({record["kind"] for record in records})
    out = [_row(kind, [r for r in records if r["kind"] == kind]) for kind in kinds]
    return [*out, _row("striped", [r for r in records if r["striped"]]), _row("all", list(records))]


def _row(name: str, records: Sequence[Record]) -> Row:
    confidences = np.array([c for record in records for c in record["confidences"]])
    counts = {f"packets_{level:g}" if level else "packets": int((confidences >= level).sum()) for level in LEVELS}
    gave = sum(bool(record["confidences"]) for record in records)
    return {"pictures": name, "n": len(records), "gave_packets": gave, **counts}


def offenders(records: Sequence[Record]) -> list[Row]:
    """Those that gave packets, by number: the same number and seed draw them again."""
    return [
        {
            "number": record["number"],
            "kind": record["kind"],
            "screen": record["screen"],
            "packets": len(record["confidences"]),
            "surest": max(record["confidences"]),
            "drawn": " ".join(f"{name} {round(value, 2)}" for name, value in record["about"].items()),
        }
        for record in records
        if record["confidences"]
    ]
