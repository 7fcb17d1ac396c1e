"""What an estimate means for the receiver, the report and the next picture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rxcli.profiles import CameraProfile, LensModel, ReadoutMode
from rxcli.receiver.camera.estimates import BlindEstimate
from rxcli.receiver.camera.tone import is_linear
from rxcli.types import FloatArray, Lens, RowProfiles


def lens_of(estimate: BlindEstimate, width: int, height: int) -> Lens | None:
    """The lens model of a picture; None where neither sides nor stripes were seen to be bent."""
    if estimate.corrected:
        return Lens(_one_width(width, height), np.append(estimate.curvature, 0.0), corrected=True)
    return curving_lens(estimate.side_curvature, width, height)


def curving_lens(side_curvature: tuple[float, float] | None, width: int, height: int) -> Lens | None:
    """The lens that bows the sides of the screen; None where they are not bowed."""
    if side_curvature is None:
        return None
    return Lens(
        _one_width(width, height), np.array([side_curvature[0], -side_curvature[0], 0.0, 0.0, 0.0]), corrected=False
    )


def _one_width(width: int, height: int) -> FloatArray:
    """The camera matrix of a focal length of one picture width."""
    return np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1.0]])


def in_time_order(profiles: RowProfiles, height: int) -> RowProfiles:
    """Row profiles of a picture whose rows run against the readout, with rows counted from the first one read.

    Args:
        profiles: C columns, S strips, R rows.
        height: rows of the picture.
    """
    sensor_row = None if profiles.sensor_row is None else height - 1 - profiles.sensor_row[..., ::-1]
    return replace(
        profiles,
        light=np.ascontiguousarray(profiles.light[..., ::-1]),
        inside=np.ascontiguousarray(profiles.inside[..., ::-1]),
        rows=height - 1 - profiles.rows[::-1],
        sensor_row=sensor_row,
    )


def summary(estimate: BlindEstimate, slot_rate_hz: float) -> dict[str, tuple[float, float]]:
    """What was estimated: name -> (value, standard deviation)."""
    line_delay_s = 1 / (estimate.rows_per_slot * slot_rate_hz)
    relative = estimate.rows_per_slot_sd / estimate.rows_per_slot
    out = summary_of_rows(estimate)
    out["line_delay_s"] = (line_delay_s, line_delay_s * relative)
    out["readout_reversed"] = (float(estimate.reversed), 0.0)
    if estimate.exposure_slots_sd > 0:
        out["exposure_s"] = (estimate.exposure_slots / slot_rate_hz, estimate.exposure_slots_sd / slot_rate_hz)
    if estimate.tone:
        out["tone_exponent"] = estimate.tone
    return out


def _coefficients(estimated: dict[str, tuple[float, float]]) -> tuple[float, ...]:
    """k1 k2 p1 p2 of what was estimated."""
    return tuple(estimated.get(name, (0.0, 0.0))[0] for name in ("k1", "k2", "p1", "p2"))


def summary_of_rows(estimate: BlindEstimate) -> dict[str, tuple[float, float]]:
    """What of it needs no screen's slot rate: name -> (value, standard deviation)."""
    out = {"rows_per_slot": (estimate.rows_per_slot, estimate.rows_per_slot_sd)}
    if estimate.corrected:
        names = ("k1", "k2", "p1", "p2")
        out |= {
            n: (float(v), float(sd)) for n, v, sd in zip(names, estimate.curvature, estimate.curvature_sd, strict=True)
        }
        out["distortion_corrected"] = (1.0, 0.0)
    elif estimate.side_curvature:
        k1, sd = estimate.side_curvature
        out |= {"k1": (k1, sd), "k2": (-k1, sd), "distortion_corrected": (0.0, 0.0)}
    return out


def camera_profile(
    estimated: dict[str, tuple[float, float]], name: str, make: str | None, model: str | None, width: int, height: int
) -> CameraProfile:
    """A camera profile of what was estimated, for the next pictures of this camera and size.

    Args:
        estimated: see `summary`; `FrameResult.estimated`.
        name: of the profile.
        make: of the camera, None where the file does not tell it.
        model: of the camera, None where the file does not tell it.
        width: of the picture.
        height: of the picture.

    Raises:
        KeyError: no line delay among what was estimated.
    """
    lens = None
    if "k1" in estimated:
        k = _coefficients(estimated)
        top, middle, bottom = (tuple(row) for row in _one_width(width, height).tolist())
        lens = LensModel(
            width=width,
            height=height,
            camera_matrix=(top, middle, bottom),
            dist_coeffs=(*k, 0.0),
            distortion_already_corrected=bool(estimated["distortion_corrected"][0]),
        )
    line_delay_s, sd = estimated["line_delay_s"]
    mode = ReadoutMode(
        name=f"{width}x{height}",
        width=width,
        height=height,
        line_delay_s=line_delay_s,
        exposure_s=estimated["exposure_s"][0] if "exposure_s" in estimated else None,
    )
    return CameraProfile(
        format=1,
        kind="camera",
        name=name,
        make=make or "",
        models=(model,) if model else (),
        modes=(mode,),
        lens=lens,
        tone="linear" if is_linear(estimated.get("tone_exponent")) else "auto",
        description=f"estimated from one picture; line delay to {100 * sd / line_delay_s:.2g} %",
    )
