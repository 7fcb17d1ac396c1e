"""What a camera hypothesis means for the receiver, the report and the next picture."""

from dataclasses import replace

import numpy as np

from rxcli.profiles import CameraProfile, LensModel, ReadoutMode
from rxcli.receiver.camera.proposals import CameraHypothesis
from rxcli.types import FloatArray, Lens, RowProfiles

_COEFFICIENTS = ("k1", "k2", "p1", "p2")


def lens_of(curvature: FloatArray, width: int, height: int) -> Lens | None:
    """The lens whose distortion a camera took out, see `CameraHypothesis`; None where stripes are straight."""
    if not curvature.any():
        return None
    return Lens(_one_width(width, height), np.append(curvature, 0.0), corrected=True)


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


def summary(hypothesis: CameraHypothesis, slot_rate_hz: float) -> dict[str, tuple[float, float]]:
    """What was estimated: name -> (value, standard deviation)."""
    rows_per_slot, sd = hypothesis.rows_per_slot, hypothesis.rows_per_slot_sd
    line_delay_s = 1 / (rows_per_slot * slot_rate_hz)
    out = {
        "rows_per_slot": (rows_per_slot, sd),
        "line_delay_s": (line_delay_s, line_delay_s * sd / rows_per_slot),
        "readout_reversed": (float(hypothesis.reversed), 0.0),
    }
    if hypothesis.curvature.any():
        values, sds = hypothesis.curvature.tolist(), hypothesis.curvature_sd.tolist()
        out |= {name: (value, sd) for name, value, sd in zip(_COEFFICIENTS, values, sds, strict=True)}
        out["distortion_corrected"] = (1.0, 0.0)
    if hypothesis.exposure_slots_sd > 0:
        out["exposure_s"] = (hypothesis.exposure_slots / slot_rate_hz, hypothesis.exposure_slots_sd / slot_rate_hz)
    return out


def camera_profile(
    estimated: dict[str, tuple[float, float]], name: str, make: str | None, model: str | None, width: int, height: int
) -> CameraProfile:
    """A camera profile of what was estimated, for the next pictures of this camera and size.

    Args:
        estimated: see `summary`; `FrameResult.estimated`.
        name: of the profile.
        make: of the camera, or None.
        model: of the camera, or None.
        width: of the picture.
        height: of the picture.

    Raises:
        KeyError: no line delay among what was estimated.
    """
    lens = None
    if "k1" in estimated:
        top, middle, bottom = (tuple(row) for row in _one_width(width, height).tolist())
        lens = LensModel(
            width=width,
            height=height,
            camera_matrix=(top, middle, bottom),
            dist_coeffs=(*(estimated.get(name, (0.0,))[0] for name in _COEFFICIENTS), 0.0),
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
        description=f"estimated from one picture; line delay to {100 * sd / line_delay_s:.2g} %",
    )
