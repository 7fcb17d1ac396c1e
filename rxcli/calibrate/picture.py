"""A picture of a lens calibration's residuals."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rxcli.calibrate.lens import LensCalibration, covered_parts
from rxcli.outputs import encode_png, write_whole

#: Length of the residual that the picture draws over a tenth of its width.
_SCALES = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)


def write_residuals(calibration: LensCalibration, path: Path) -> None:
    """Draw every corner with its residual, enlarged, and shade the parts of the field without corners.

    Raises:
        InputError: the picture cannot be written.
    """
    write_whole(path, encode_png(_draw(calibration)))


def _draw(calibration: LensCalibration) -> np.ndarray:
    """(H, W, 3) BGR picture, 1280 pixels wide with a legend below."""
    import cv2

    model = calibration.model
    zoom = 1280 / model.width
    height = round(model.height * zoom)
    canvas = np.full((height + 60, 1280, 3), 255, np.uint8)
    _shade_uncovered(canvas[:height], calibration, zoom)
    length = np.linalg.norm(calibration.residuals, axis=1)
    typical = float(np.quantile(length, 0.95)) if length.size else 0.1
    scale = next((s for s in _SCALES if s >= typical), _SCALES[-1])
    start = (calibration.corners + 0.5) * zoom
    end = start + calibration.residuals * (64 / scale)
    for a, b, error in zip(start, end, length, strict=True):
        heat = float(np.clip(error / scale, 0, 1))
        colour = (round(200 * (1 - heat)), round(90 * (1 - heat)), round(60 + 190 * heat))
        cv2.line(canvas, _pixel(a), _pixel(b), colour, 1, cv2.LINE_AA)
        cv2.circle(canvas, _pixel(a), 2, colour, -1, cv2.LINE_AA)
    _legend(canvas, height, scale, calibration)
    return canvas


def _pixel(point: np.ndarray) -> tuple[int, int]:
    return round(float(point[0])), round(float(point[1]))


def _shade_uncovered(canvas: np.ndarray, calibration: LensCalibration, zoom: float) -> None:
    """Grey where the 5 x 5 parts of the field hold no corner."""
    height, width = canvas.shape[:2]
    covered = covered_parts(calibration.corners, calibration.model.width, calibration.model.height)
    for y, x in np.argwhere(~covered):
        canvas[y * height // 5 : (y + 1) * height // 5, x * width // 5 : (x + 1) * width // 5] = 225


def _legend(canvas: np.ndarray, top: int, scale: float, calibration: LensCalibration) -> None:
    import cv2

    cv2.line(canvas, (20, top + 30), (84, top + 30), (0, 0, 0), 2)
    text = (
        f"{scale:g} px    RMS {calibration.rms_px:.3f} px, {calibration.corners.shape[0]} corners of "
        f"{len(calibration.accepted)} boards; grey: no corners"
    )
    cv2.putText(canvas, text, (100, top + 36), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
