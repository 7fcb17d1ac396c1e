"""From a scene to captures in memory: the entry points of the simulator."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rxcli.lab.simulate.bound import Oracle
from rxcli.lab.simulate.camera import Exposure, take_picture
from rxcli.lab.simulate.files import CODECS, Encoding, encode_jpeg, write_dng, write_png, write_tiff, write_video
from rxcli.lab.simulate.film import Film, Player
from rxcli.lab.simulate.isp import develop
from rxcli.lab.simulate.motion import HandMotion, turned
from rxcli.lab.simulate.optics import FloatArray, View, homography
from rxcli.lab.simulate.pictures import load_picture
from rxcli.lab.simulate.scenes import Change, Scene
from rxcli.lab.simulate.transmitter import Drive, Link, drive_screen
from rxcli.lab.simulate.truth import build_truth

#: Slots before the first row, so that delayed columns already send.
_LEAD_SLOTS = 8


@dataclass(frozen=True)
class Capture:
    """One frame in memory, with all that is known of it."""

    scene: Scene
    exposure: Exposure
    frame: int
    #: (height, width) uint16 mosaic, or (height, width, 3) where the sensor has no filter array.
    raw: NDArray[np.uint16]
    #: Data for the genie-aided bound; None unless requested.
    oracle: Oracle | None = None

    @cached_property
    def rgb(self) -> NDArray[np.uint8]:
        """(height, width, 3) uint8 developed picture, red first, before any compression."""
        return np.asarray(self.developed(), np.uint8)

    def developed(self, bits: int = 8) -> NDArray[Any]:
        """(height, width, 3) developed picture of 8 or 16 `bits`, red first."""
        picture = develop(self.raw, self.scene.sensor, self.scene.isp, self.exposure.view, bits)
        picture = stabilised(picture, self.exposure) if self.scene.stabilised else picture
        return warped(picture, np.random.default_rng([self.exposure.link.seed, self.frame, 37]), self.scene.warp)

    @cached_property
    def jpeg(self) -> bytes:
        """The developed picture as a JPEG file with metadata."""
        return encode_jpeg(self.rgb, self.scene)

    @cached_property
    def pixels(self) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """(height, width) what a receiver is given: luma of the JPEG, or the mosaic of a raw scene."""
        if self.scene.is_mosaic:
            return self.raw
        import simplejpeg

        return np.asarray(simplejpeg.decode_jpeg(self.jpeg, colorspace="GRAY")[..., 0], np.uint8)

    def write(self, path: Path, file_format: str) -> None:
        """Write the frame as jpeg, dng, dng14, png, png16, tiff or tiff16."""
        if file_format == "jpeg":
            path.write_bytes(self.jpeg)
        elif file_format.startswith("dng"):
            write_dng(self.raw, self.scene, path, 14 if file_format == "dng14" else 16)
        else:
            rgb = self.developed(16 if file_format.endswith("16") else 8)
            write_png(rgb, path) if file_format.startswith("png") else write_tiff(rgb, self.scene, path)

    @cached_property
    def truth(self) -> dict[str, Any]:
        """The truth of this frame alone, as in `NAME.truth.json`; its frame number is 0."""
        return build_truth(self.scene, [self.exposure], f"memory-{self.frame}")


@dataclass(frozen=True)
class Recording:
    """A scene with all that was open decided: frames can be taken from it in any order."""

    scene: Scene
    drive: Drive
    link: Link
    seed: int
    start_slot: float
    delays: FloatArray
    player: Player | None = None

    @property
    def plain(self) -> "Recording":
        """The twin: the same payloads, noise and view; a film rests, frames stay as their rows saw them.

        Nobody stands before the screen, and nothing is mirrored.
        """
        room = replace(self.scene.room, person=0.0, desk=0.0, lamp=0.0)
        scene = replace(self.scene, film=Film(), stabilised=False, warp=(0.0, 0.0), averaged=0.0, room=room)
        return replace(self, scene=scene, link=replace(self.link, weights_of=None), player=None)

    def exposure(self, frame: int = 0) -> Exposure:
        """What frame number `frame` is about to see."""
        scene, time_s = self.scene, frame / self.scene.frame_rate_hz
        change = max((c for c in scene.changes if c.frame <= frame), key=lambda c: c.frame, default=Change(0))
        blur_px = scene.blur_px if change.blur_px is None else change.blur_px
        scene = replace(scene, light_e_per_s=scene.light_e_per_s * change.light, blur_px=blur_px)
        start_slot, motion = self.start_slot + time_s * scene.real_slot_rate_hz, self._motion(scene.view)
        clock = start_slot, scene.real_slot_rate_hz, self.delays, time_s
        return Exposure(scene, scene.view, self.drive, self.link, *clock, motion=motion, player=self.player)

    def _motion(self, view: View) -> HandMotion | None:
        if not self.scene.hand_px:
            return None
        focal = view.camera_matrix[0, 0]
        speed = self.scene.hand_px * self.scene.frame_rate_hz / focal
        return HandMotion(self.seed, speed, view.width / 2 / focal)

    def frame(self, frame: int = 0, *, oracle: bool = False, threads: int = 2) -> Capture:
        """Take frame number `frame`."""
        exposure = self.exposure(frame)
        genie = Oracle(exposure) if oracle else None
        seed = int(np.random.SeedSequence([self.seed, frame]).generate_state(1, np.uint64)[0])
        raw = take_picture(exposure, seed, threads, genie.visit if genie else None)
        return Capture(self.scene, exposure, frame, raw, genie)

    def pictures(self, bits: int = 8, progress: Callable[..., Any] = iter) -> Iterator[NDArray[Any]]:
        """The developed frames of the scene, mixed over time where its camera does so; see `Capture.developed`."""
        share, before = self.scene.averaged, None
        for number in progress(range(self.scene.n_frames)):
            developed = self.frame(number).developed(bits)
            picture = developed if before is None else cv2.addWeighted(developed, 1 - share, before, share, 0)
            before = picture if self.scene.averages_again else developed
            yield np.asarray(picture)

    def truth(self, capture: str) -> dict[str, Any]:
        """The truth of all frames of the scene."""
        return build_truth(self.scene, [self.exposure(n) for n in range(self.scene.n_frames)], capture)


#: Range of the knots of a warp along the rows.
_WARP_KNOTS = (3, 9)
#: Enlargement after which a stabilised frame shows no border.
_STABILISED_ZOOM = 1.06


def stabilised(picture: NDArray[Any], exposure: Exposure) -> NDArray[Any]:
    """A developed picture turned back by what the camera had moved in the middle of it, enlarged and cropped.

    Its rows are no instants any more: switch this off on a phone that does so by default.
    """
    if exposure.motion is None:
        return picture
    sensor, matrix = exposure.scene.sensor, exposure.view.camera_matrix
    middle_s = exposure.start_s + sensor.height / 2 * sensor.line_delay_s
    square = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]) * 0.2
    shifted = turned(square, exposure.motion.at(np.full(4, middle_s)))
    to_pixels = matrix[[0, 1], [0, 1]]
    target = square * _STABILISED_ZOOM
    map_back = homography(shifted * to_pixels + matrix[:2, 2], target * to_pixels + matrix[:2, 2])
    return np.asarray(cv2.warpPerspective(picture, map_back, (sensor.width, sensor.height), flags=cv2.INTER_CUBIC))


def warped(picture: NDArray[Any], rng: np.random.Generator, share: tuple[float, float]) -> NDArray[Any]:
    """A picture with its rows moved smoothly, as software that steadies or straightens does.

    Args:
        picture: (height, width[, colours]).
        rng: of the warp.
        share: of the width and of the height by which rows are moved, at most.
    """
    if not any(share):
        return picture
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]].astype(np.float32)
    for axis, (places, size) in enumerate(((x, picture.shape[1]), (y, picture.shape[0]))):
        knots = rng.uniform(-1, 1, int(rng.integers(*_WARP_KNOTS)))
        smooth = np.interp(np.linspace(0, knots.size - 1, picture.shape[0]), np.arange(knots.size), knots)
        smooth = cv2.GaussianBlur(smooth[:, None], (1, 0), 0, sigmaY=picture.shape[0] / (4 * knots.size))
        places += (smooth / np.abs(smooth).max() * rng.uniform(0, share[axis]) * size).astype(np.float32)
    return np.asarray(cv2.remap(picture, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def prepare(scene: Scene, rng: np.random.Generator | int) -> Recording:
    """Decide all that a scene leaves open.

    Args:
        scene: what to simulate.
        rng: source of randomness, or a seed; equal ones give equal pixels.
    """
    rng = np.random.default_rng(rng)
    link_seed, noise_seed = (int(s) for s in rng.integers(0, 2**62, 2))
    screen, rate_hz = scene.screen, scene.real_slot_rate_hz
    burst_slots = screen.packet_slots * screen.repeats
    start = float(rng.uniform(_LEAD_SLOTS, burst_slots) if scene.start_slot is None else scene.start_slot)
    picture = scene.picture
    if isinstance(picture, str):
        picture = load_picture(picture, screen.width_px, screen.height_px)

    def drive_for(picture: NDArray[np.uint8]) -> Drive:
        return drive_screen(screen, picture, scene.w, scene.dimming, scene.spread_tails)

    drive, player, weights_of = drive_for(picture), None, None
    if scene.film.shows:
        player = Player(scene.film, picture, drive_for, noise_seed, -start / rate_hz, burst_slots / rate_hz)
        drive, weights_of = player.drive(player.start_number), player.weights_in if scene.w == "dimming" else None
    link = Link(screen, drive.weights, link_seed, scene.payload, scene.labels, scene.waveform, weights_of)
    return Recording(scene, drive, link, noise_seed, start, _delays(scene, rng), player)


def _delays(scene: Scene, rng: np.random.Generator) -> FloatArray:
    columns = scene.screen.columns
    drawn = rng.uniform(-1, 1, columns)
    if isinstance(scene.column_delay_slots, tuple):
        return np.broadcast_to(np.array(scene.column_delay_slots, np.float64), columns).copy()
    return drawn * scene.column_delay_slots


def write_capture(
    recording: Recording, path: Path, file_format: str, bit_rate: int | None = None, progress: Callable[..., Any] = iter
) -> None:
    """Write a still or clip of a scene.

    Args:
        recording: whose frames are written, of a still the first.
        path: of the file.
        file_format: of `Capture.write`, or a codec of `write_video`.
        bit_rate: of clips, bits per second; None for the encoder's constant quality.
        progress: wraps the numbers of the frames.
    """
    scene = recording.scene
    if file_format in CODECS:
        bits = 16 if file_format.endswith("-10") else 8
        pictures, encoding = recording.pictures(bits, progress), Encoding(file_format, bit_rate)
        write_video(pictures, path, encoding, scene.frame_rate_hz, scene.orientation)
    else:
        recording.frame().write(path, file_format)
