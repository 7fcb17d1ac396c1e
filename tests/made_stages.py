"""What a stage hands to the next, made by hand: a test states what it is about, the rest is usual."""

from typing import Any

import numpy as np

from rxcli.receiver.camera.proposals import CameraHypothesis
from rxcli.types import BurstPosteriors, Clock, FloatArray, RowProfiles


def clock_of(n_columns: int, **known: Any) -> Clock:
    """A clock of columns without delay."""
    usual = {
        "rows_per_slot": 5.0,
        "exposure_slots": 1.0,
        "packet_slots": 70,
        "row0": 0.0,
        "n_slots": 70,
        "first_slot": 0,
    }
    usual |= {"burst": np.zeros(1, np.int64), "delay_slots": np.zeros(n_columns), "header_peak_ratio": 9.0}
    return Clock(**usual | {"header_peak_ratio": 9.0} | known)


def profiles_of(light: FloatArray, noise_floor: float = 1e-4, **known: Any) -> RowProfiles:
    """Profiles of strips (C, S, R) that lie on the screen from end to end."""
    usual = {"light": light.astype(np.float32), "inside": np.ones(light.shape, bool), "rows": np.arange(light.shape[2])}
    usual |= {"sensor_row": None, "count": np.ones(light.shape[:2], np.float32), "noise_slope": 0.0}
    return RowProfiles(noise_floor=noise_floor, **usual | known)


def posteriors_of(n_bursts: int, n_columns: int, n_symbols: int, **known: Any) -> BurstPosteriors:
    """Posteriors of weight 5 that say nothing."""
    shape = (n_bursts, n_columns)
    usual = {"w": np.full(n_columns, 5), "w_log_prob": np.zeros((n_columns, 9)), "log_evidence": np.zeros(n_columns)}
    usual |= {
        "lit": np.zeros((*shape, 20 + 10 * n_symbols), np.float32),
        "index": np.zeros((*shape, n_symbols), np.int64),
    }
    usual |= {"log_prob": np.zeros((*shape, n_symbols)), "bit_llr": np.zeros((*shape, n_symbols, 7))}
    usual["words"] = np.full((*shape, n_symbols, 128), 1 / 128, np.float32)
    return BurstPosteriors(header_llr=known.pop("header_llr", np.zeros(shape)), **usual | known)


def hypothesis_of(rows_per_slot: float, **known: Any) -> CameraHypothesis:
    """A camera that was proposed, of straight stripes."""
    usual = {"packet_slots": 130, "reversed": False, "curvature": np.zeros(4), "exposure_slots": 0.5, "score": 300.0}
    usual |= {"rows_per_slot_sd": 0.001, "curvature_sd": np.full(4, 1e-3)}
    return CameraHypothesis(rows_per_slot, **usual | known)
