"""Read frames from /dev/video0 with the receiver's own reader, and say what came: `client.py SETTINGS N PAUSE_S`."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from rxcli.errors import InputError
from rxcli.ingest.v4l2 import CameraSettings, LiveSource


def main(settings: dict[str, Any], n_frames: int, pause_s: float) -> dict[str, Any]:
    """What `n_frames` frames showed, how many were lost, and the error that ended them."""
    reasons: list[str] = []
    source = LiveSource(Path("/dev/video0"), CameraSettings(**settings), on_lost=reasons.append)
    frames, error = [], None
    try:
        for frame in source:
            even = bool((frame.pixels == frame.pixels[:, :1]).all())
            frames.append(
                {
                    "index": frame.index,
                    "time_s": frame.time_s,
                    "nominal_time": frame.nominal_time,
                    "dtype": str(np.dtype(frame.pixels.dtype)),
                    "rows": frame.pixels[:, 0].tolist() if even else None,
                    "levels": [frame.black, frame.white],
                    "exposure_s": frame.metadata.exposure_s,
                    "model": frame.metadata.model,
                }
            )
            if len(frames) == n_frames:
                break
            time.sleep(pause_s)
    except InputError as failure:
        error = str(failure)
    counts = source.counts
    return {
        "frames": frames,
        "error": error,
        "waited": reasons,
        "mode": str(source.mode),
        "dropped": counts.dropped,
        "damaged": counts.damaged,
        "connections": counts.connections,
    }


if __name__ == "__main__":
    print(json.dumps(main(json.loads(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))))
