"""Camera of a frame from its profile, and what to try where profile or file are wrong. Part of the wiring."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from rxcli.options import ReceiverOptions
from rxcli.profiles import match_camera
from rxcli.receiver.context import DEFAULT_TONE, Camera, Failure
from rxcli.receiver.screen import geometry
from rxcli.types import Frame, FrameResult, Lens

#: Relative difference of line delays up to which an estimate agrees with a profile, and confidence of a sure packet.
_SAME_LINE_DELAY, _SURE = 0.01, 0.9


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


def with_estimates(frame: Frame, options: ReceiverOptions) -> Iterator[tuple[Frame, ReceiverOptions]]:
    """The frame without its camera profile, then without its stated exposure as well: both are estimated."""
    estimated = replace(options, cameras=(), force_camera=False)
    if known_camera(frame, options) is not None:
        yield frame, estimated
    if frame.metadata.exposure_s is not None:
        yield replace(frame, metadata=replace(frame.metadata, exposure_s=None)), estimated


def is_credible(estimated: FrameResult, frame: Frame, options: ReceiverOptions) -> bool:
    """Whether a result with an estimated camera outweighs a profile; one with another line delay needs sure packets.

    Under a screen that is not the one in the picture, an estimate of the camera may fit what a profile rules out.
    """
    known, line_delay_s = known_camera(frame, options), estimated.line_delay_s
    if not isinstance(known, Camera) or line_delay_s is None:
        return True
    if abs(line_delay_s / known.line_delay_s - 1) < _SAME_LINE_DELAY:
        return True
    lit = [column for column in estimated.columns if column.status != "dark"]
    n_sure = sum(any(p.confidence > _SURE for p in column.packets) for column in lit)
    return 2 * n_sure > len(lit)


def difference(
    frame: Frame, options: ReceiverOptions, stated: FrameResult, estimated: FrameResult, *, is_exposure: bool
) -> str:
    """Message of a result with an estimated camera: what was stated, and what was estimated.

    Args:
        frame: the picture.
        options: those with the stated camera.
        stated: result with the stated camera.
        estimated: result with the estimate.
        is_exposure: whether the exposure was estimated as well.
    """
    known, exposure_s = known_camera(frame, options), frame.metadata.exposure_s if is_exposure else None
    if isinstance(known, Failure):
        return known.message
    before, after, check = [], [], "check what wrote the file's exposure"
    if known is not None:
        before.append(f"camera profile {known.profile} ({1e6 * known.line_delay_s:.3f} us a row)")
        after.append(f"{1e6 * (estimated.line_delay_s or 0.0):.3f} us a row")
        check = f"leave out or replace that profile, or {check}" if exposure_s else "leave out or replace that profile"
    if exposure_s is not None:
        before.append(f"the stated exposure ({1e6 * exposure_s:.0f} us)")
        after.append(f"an exposure of {1e6 * (estimated.exposure_s or 0.0):.0f} us")
    n_stated, n_estimated = (sum(p.is_believable for p in result.packets) for result in (stated, estimated))
    return (
        f"{' and '.join(before)} gave {n_stated} packets, an estimate ({', '.join(after)}) {n_estimated}, which are "
        f"reported; {check}"
    )
