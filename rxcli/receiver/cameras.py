"""Camera of a frame from its profile. Part of the wiring."""

from __future__ import annotations

from rxcli.options import ReceiverOptions
from rxcli.profiles import match_camera
from rxcli.receiver.context import DEFAULT_TONE, Camera, Failure
from rxcli.receiver.screen import geometry
from rxcli.types import Frame, Lens


def known_camera(frame: Frame, options: ReceiverOptions) -> Camera | Failure | None:
    """Camera from the matching profile, or None."""
    meta = frame.metadata
    profile = (
        options.cameras[0]
        if options.force_camera
        else match_camera(options.cameras, meta.make, meta.model, frame.width, frame.height)
    )
    if profile is None:
        return None
    mode = profile.mode_for(frame.width, frame.height)
    if mode is None:
        return Failure(
            "no_signal",
            f"camera profile {profile.name} has no readout mode for {frame.width} x {frame.height}; add one with "
            "vlc-rx calibrate shutter, or leave the camera to be estimated with --camera auto",
        )
    lens = geometry.lens_for(profile.lens, frame.width, frame.height) if profile.lens else None
    tone = DEFAULT_TONE if profile.tone == "auto" else profile.tone
    exposure_s = meta.exposure_s or mode.exposure_s or 5 * mode.line_delay_s
    return Camera(profile.name, mode.line_delay_s, exposure_s, lens, tone)


def known_lens(frame: Frame, options: ReceiverOptions) -> Lens | None:
    """Lens from the matching camera profile, or None."""
    known = known_camera(frame, options)
    return known.lens if isinstance(known, Camera) else None
