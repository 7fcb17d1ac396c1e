"""What was sent and how it was seen, in the format that lies beside a capture as `NAME.truth.json`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from rxcli.profiles import CameraProfile, LensModel, ReadoutMode
from rxcli.protocol import bits_to_hex

if TYPE_CHECKING:
    from rxcli.lab.simulate.camera import Exposure
    from rxcli.lab.simulate.scenes import Scene


#: Recognised in files that may be replaced (`rxcli.outputs`).
_AUTHOR = "vlc-rx simulate"


def visible_bursts(exposure: Exposure) -> list[dict[str, Any]]:
    """Bursts on the rows between the screen's highest and lowest corner, with the visible slots of each."""
    heights, sensor = exposure.corners[:, 1], exposure.scene.sensor
    top, bottom = max(int(np.floor(heights.min())), 0), min(int(np.ceil(heights.max())), sensor.height - 1)
    if top >= bottom:
        return []
    rate = sensor.line_delay_s * exposure.slot_rate_hz
    begin, end = exposure.start_slot + top * rate, exposure.start_slot + bottom * rate
    length = exposure.link.burst_slots
    bursts = []
    for burst in range(max(int(begin // length), 0), int(end // length) + 1):
        visible = min(end, (burst + 1) * length) - max(begin, burst * length)
        if visible > 0:
            bursts.append({"burst": burst, "visible_slots": round(float(visible), 1)})
    return bursts


def build_truth(scene: Scene, exposures: list[Exposure], capture: str) -> dict[str, Any]:
    """Build the truth of a capture.

    Args:
        scene: what was simulated.
        exposures: one per frame.
        capture: name of the capture's file.
    """
    initial, screen = exposures[0], scene.screen
    frames = [
        {
            "frame": number,
            "bursts": visible_bursts(exposure),
            "corners_sensor_px": exposure.corners.tolist(),
            "start_slot": exposure.start_slot,
        }
        for number, exposure in enumerate(exposures)
    ]
    bursts = sorted({entry["burst"] for frame in frames for entry in frame["bursts"]})
    weights = [initial.link.weights_in(burst).tolist() for burst in bursts]
    profile = build_camera_profile(scene, initial)
    camera = msgspec.to_builtins(profile.modes[0]) | msgspec.to_builtins(profile.lens) | {"name": profile.name}
    return {
        "capture": capture,
        "screen": screen.name,
        **{name: getattr(screen, name) for name in ("columns", "slot_rate_hz", "payload_symbols", "repeats")},
        "camera": camera,
        "w": weights[0] if weights else initial.link.weights.tolist(),
        "payload_bits": initial.link.bits_per_column(bursts[0] if bursts else 0),
        "corners_sensor_px": initial.corners.tolist(),
        "frames": frames,
        "payload": {str(burst): [bits_to_hex(bits) for bits in initial.link.payload(burst)] for burst in bursts},
        **({"w_of_burst": dict(zip(map(str, bursts), weights, strict=True))} if initial.link.weights_of else {}),
        "orientation": scene.orientation,
        "tone_curve": "linear" if scene.is_mosaic else scene.isp.tone,
        "slot_rate_error_ppm": scene.slot_rate_error_ppm,
        "column_delay_slots": initial.delays.tolist(),
        "written_by": _AUTHOR,
    }


def build_camera_profile(scene: Scene, exposure: Exposure) -> CameraProfile:
    """A camera profile that fits the captures of a scene: what a calibration would find, without its errors."""
    sensor, lens = scene.sensor, scene.lens.distortion
    size: dict[str, int] = {"width": sensor.width, "height": sensor.height}
    timing: dict[str, Any] = {"line_delay_s": sensor.line_delay_s, "exposure_s": scene.exposure_s}
    mode = ReadoutMode(name="simulated", **size, **timing, frame_rate_hz=scene.frame_rate_hz)
    matrix: Any = tuple(map(tuple, exposure.view.camera_matrix.tolist()))
    model = LensModel(**size, camera_matrix=matrix, dist_coeffs=lens, distortion_already_corrected=scene.is_corrected)
    named: dict[str, Any] = {"name": scene.camera_name, "make": scene.make, "models": (scene.model,)}
    about = f"written by {_AUTHOR}"
    return CameraProfile(format=1, kind="camera", **named, modes=(mode,), lens=model, description=about)
