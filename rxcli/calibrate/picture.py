"""A picture of a lens calibration's residuals."""

from pathlib import Path

import cv2
import numpy as np

from rxcli.calibrate.lens import LensCalibration, covered_parts
from rxcli.outputs import encode_png, write_whole

#: Length of the residual that the picture draws over a twentieth of its width.
_SCALES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_WIDTH_PX, _LEGEND_PX, _ARROW_PX = 1280, 60, 64


def write_residuals(calibration: LensCalibration, path: Path) -> None:
    """Draw every corner with its residual, enlarged, and shade the parts of the picture without corners.

    Raises:
        InputError: the picture cannot be written.
    """
    model, corners = calibration.model, calibration.corners
    zoom = _WIDTH_PX / model.width
    height = round(model.height * zoom)
    uncovered = np.where(covered_parts(corners, model.width, model.height), 255, 225).astype(np.uint8)
    shaded = cv2.resize(uncovered, (_WIDTH_PX, height), interpolation=cv2.INTER_NEAREST)
    canvas = cv2.cvtColor(np.pad(shaded, ((0, _LEGEND_PX), (0, 0)), constant_values=255), cv2.COLOR_GRAY2BGR)
    length = np.linalg.norm(calibration.residuals, axis=1)
    scale = next((s for s in _SCALES if s >= np.quantile(length, 0.95)), _SCALES[-1])
    starts = (corners + 0.5) * zoom
    ends = starts + calibration.residuals * (_ARROW_PX / scale)
    heat = np.clip(length / scale, 0, 1)[:, None]
    colours = np.rint((1 - heat) * [200, 90, 60] + heat * [0, 0, 250]).tolist()
    for start, end, colour in zip(np.rint(starts).astype(int), np.rint(ends).astype(int), colours, strict=True):
        cv2.line(canvas, start.tolist(), end.tolist(), colour, 1, cv2.LINE_AA)
        cv2.circle(canvas, start.tolist(), 2, colour, -1, cv2.LINE_AA)
    cv2.line(canvas, (20, height + 30), (20 + _ARROW_PX, height + 30), (0, 0, 0), 2)
    found = f"{len(corners)} corners of {len(calibration.accepted)} boards; grey: no corners"
    text = f"{scale:g} px    RMS {calibration.rms_px:.3f} px, {found}"
    cv2.putText(canvas, text, (100, height + 36), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
    write_whole(path, encode_png(canvas))
