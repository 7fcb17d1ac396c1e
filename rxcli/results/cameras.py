"""With which screen and camera a frame was received."""

from __future__ import annotations

from dataclasses import dataclass, replace

from rxcli.options import ReceiverOptions
from rxcli.profiles import CameraProfile, ScreenProfile
from rxcli.receiver.camera.camera import camera_profile
from rxcli.receiver.plane.orientation import as_received
from rxcli.types import Frame, FrameResult


@dataclass(frozen=True, slots=True)
class Reception:
    """A frame, what became of it, and the screen and the camera that it was received with."""

    frame: Frame
    result: FrameResult
    #: None where none was found.
    screen: ScreenProfile | None
    #: The profile that is named, or the one that was estimated.
    camera: CameraProfile | None

    @classmethod
    def of(cls, frame: Frame, result: FrameResult, options: ReceiverOptions) -> Reception:
        """The reception of a frame with options."""
        screen = next((screen for screen in options.screens if screen.name == result.screen_profile), None)
        return cls(frame, result, screen, camera_of(frame, result, options.cameras))

    @property
    def turned(self) -> Reception:
        """The same with the frame and the corners turned as they were received."""
        frame, result = as_received(self.frame, self.result)
        return replace(self, frame=frame, result=result)


def camera_of(frame: Frame, result: FrameResult, cameras: tuple[CameraProfile, ...]) -> CameraProfile | None:
    """The camera that a frame was received with: the profile that is named, or the one that was estimated."""
    named = next((camera for camera in cameras if camera.name == result.camera_profile), None)
    is_named = named is not None or "line_delay_s" not in result.estimated
    return named if is_named else estimated_camera(frame, result, "estimated")


def estimated_camera(frame: Frame, result: FrameResult, name: str) -> CameraProfile:
    """A profile of the camera that was estimated from a frame."""
    size = (frame.height, frame.width) if result.quarter_turns else (frame.width, frame.height)
    return camera_profile(result.estimated, name, frame.metadata.make, frame.metadata.model, *size)
