"""Cameras that were estimated beyond doubt, kept for the next pictures: of the run, of other workers, of later runs.

A file a camera, in a folder of its own: whoever receives a picture reads what is there, and replaces it as a whole. So
nothing is locked, and what is lost where two write at once is one picture's say.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path

import msgspec
import numpy as np

from rxcli.receiver import camera as blind
from rxcli.receiver.context import DEFAULT_TONE, Camera
from rxcli.receiver.settings import SETTINGS
from rxcli.types import Frame

#: Values that are averaged over pictures, weighed by their variances.
_AVERAGED = ("line_delay_s", "k1", "k2", "p1", "p2", "tone_exponent")
_FORMAT = 1


class RememberedCamera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What pictures of one camera, in one mode, told of it."""

    format: int
    make: str
    model: str
    width: int
    height: int
    pictures: int
    #: Name -> (value, standard deviation); see `camera.summary`. What depends on the screen is left out.
    estimated: dict[str, tuple[float, float]]

    def camera(self, frame: Frame) -> Camera:
        """The camera, as far as it does not depend on the picture."""
        line_delay_s = self.estimated["line_delay_s"][0]
        exposure_s = frame.metadata.exposure_s or self.estimated.get("exposure_s", (0.0, 0.0))[0]
        return Camera(
            profile=None,
            line_delay_s=line_delay_s,
            exposure_s=exposure_s or SETTINGS.exposed_rows * line_delay_s,
            lens=blind.lens_of_summary(self.estimated, self.width, self.height),
            tone="linear" if blind.is_linear(self.estimated.get("tone_exponent")) else DEFAULT_TONE,
            reversed=bool(self.estimated["readout_reversed"][0]),
            estimated=self.estimated,
            remembered=True,
        )


def recall(folder: Path | None, frame: Frame) -> RememberedCamera | None:
    """What is remembered of the camera of a frame; None where nothing is, or the file does not tell its camera."""
    path = _path_of(folder, frame)
    if path is None:
        return None
    try:
        found = msgspec.json.decode(path.read_bytes(), type=RememberedCamera)
    except (OSError, msgspec.MsgspecError):
        return None
    values = [value for pair in found.estimated.values() for value in pair]
    sound = found.format == _FORMAT and (found.width, found.height) == (frame.width, frame.height)
    line_delay_s = found.estimated.get("line_delay_s", (0.0, 0.0))[0]
    sound = sound and line_delay_s > 0 and "readout_reversed" in found.estimated
    return found if sound and bool(np.isfinite(values).all()) else None


def remember(folder: Path | None, frame: Frame, camera: Camera) -> None:
    """Keep what a picture told of its camera, averaged with what others did; a cache that cannot be written is none."""
    path = _path_of(folder, frame)
    if path is None:
        return
    meta = frame.metadata
    told = {name: pair for name, pair in camera.estimated.items() if name != "rows_per_slot"}
    fresh = RememberedCamera(_FORMAT, meta.make or "", meta.model or "", frame.width, frame.height, 1, told)
    before = recall(folder, frame)
    kept = fresh if before is None or not _one_camera(before, fresh) else _averaged(before, fresh)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f"{path.name}.{os.getpid()}")
        temporary.write_bytes(msgspec.json.encode(kept))
        temporary.replace(path)
    except OSError:
        return


def forget(folder: Path) -> int:
    """Forget all cameras; how many those were.

    Raises:
        OSError: a file cannot be removed.
    """
    files = sorted(folder.glob("*.json")) if folder.is_dir() else []
    for path in files:
        path.unlink(missing_ok=True)
    return len(files)


def _path_of(folder: Path | None, frame: Frame) -> Path | None:
    """The file of the camera and mode of a frame; None without a folder, or where the file does not name a model."""
    meta = frame.metadata
    if folder is None or not meta.model:
        return None
    # Phones take pictures of one size with several lenses.
    mode = (meta.make, meta.model, meta.lens, meta.focal_length_mm, meta.focal_length_35mm, frame.width, frame.height)
    mosaic = frame.mosaic is not None
    digest = hashlib.sha256(repr((*mode, mosaic)).encode()).hexdigest()[:12]
    name = re.sub(r"[^A-Za-z0-9]+", "-", f"{meta.make or ''} {meta.model}").strip("-")[:40]
    return folder / f"{name}-{frame.width}x{frame.height}-{digest}.json"


def _one_camera(before: RememberedCamera, fresh: RememberedCamera) -> bool:
    names = ("readout_reversed", "distortion_corrected")
    if any(before.estimated.get(name) != fresh.estimated.get(name) for name in names):
        return False
    (one, one_sd), (other, other_sd) = before.estimated["line_delay_s"], fresh.estimated["line_delay_s"]
    return abs(one - other) < max(
        SETTINGS.same_camera_sds * float(np.hypot(one_sd, other_sd)), SETTINGS.same_camera_share * other
    )


def _averaged(before: RememberedCamera, fresh: RememberedCamera) -> RememberedCamera:
    # A picture's errors go together, so that all its values have one weight: that of its line delay.
    weight = np.array([one.estimated["line_delay_s"][1] ** -2 for one in (before, fresh)])
    weight /= weight.sum()
    estimated = dict(fresh.estimated)
    for name in _AVERAGED:
        if name in before.estimated and name in fresh.estimated:
            (one, one_sd), (other, other_sd) = before.estimated[name], fresh.estimated[name]
            sd = max(float(np.hypot(weight[0] * one_sd, weight[1] * other_sd)), other_sd / SETTINGS.most_pictures**0.5)
            estimated[name] = (float(weight @ [one, other]), sd)
    return msgspec.structs.replace(fresh, pictures=before.pictures + 1, estimated=estimated)
