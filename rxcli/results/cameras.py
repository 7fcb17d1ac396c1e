"""With which screen and camera a frame was received."""

from rxcli.profiles import CameraProfile, ScreenProfile
from rxcli.receiver.camera.camera import camera_profile
from rxcli.types import Frame, FrameResult


def camera_of(frame: Frame, result: FrameResult, cameras: tuple[CameraProfile, ...]) -> CameraProfile | None:
    """The camera that a frame was received with: the profile that is named, or the one that was estimated."""
    named = next((camera for camera in cameras if camera.name == result.camera_profile), None)
    is_named = named is not None or "line_delay_s" not in result.estimated
    return named if is_named else estimated_camera(frame, result, "estimated")


def estimated_camera(frame: Frame, result: FrameResult, name: str) -> CameraProfile:
    """A profile of the camera that was estimated from a frame."""
    size = (frame.height, frame.width) if result.quarter_turns else (frame.width, frame.height)
    return camera_profile(result.estimated, name, frame.metadata.make, frame.metadata.model, *size)


def screen_of(result: FrameResult, screens: tuple[ScreenProfile, ...]) -> ScreenProfile | None:
    """The screen that a frame was received of; None where none was found."""
    return next((screen for screen in screens if screen.name == result.screen_profile), None)
