"""Files of full size that receptions are timed on, and their bare decode, which the times are compared with."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import av
import cv2
import numpy as np
import rawpy
import simplejpeg

from rxcli.ingest.sniff import HEAD_BYTES, read_bytes, sniff
from rxcli.lab.simulate.capture import prepare, write_capture
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.lab.simulate.truth import build_camera_profile
from rxcli.outputs import write_whole
from rxcli.profiles import dump_profile
from rxcli.protocol import payload_bits
from rxcli.results.truth import truth_path

#: Width of what fills a photograph, in widths of it.
_BEYOND_EDGES = 1.6


@dataclass(frozen=True, kw_only=True)
class Medium:
    """One kind of file."""

    file: str
    camera: str
    screen: str
    picture: str = "coffee"
    #: Light against the preset's.
    light: float = 1.0
    #: In slots; None for the preset's. The gain follows.
    exposure_slots: float | None = None
    #: False for the picture itself in steady light, beyond the edges of the photograph.
    is_screen: bool = True
    #: Width and height against the preset's.
    scale: float = 1.0
    #: Whether camera and screen are given.
    named: bool = True
    #: Clips: frames to simulate, times that they are written, and bursts from one frame to the next, together a whole
    #: number, so that the clip may be repeated.
    n_frames: int = 1
    times: int = 1
    bursts_a_frame: float | None = None
    bit_rate: int | None = None
    #: What a reception may take of the bare decode on one thread.
    target: float | None = None

    @property
    def scene(self) -> Scene:
        """The scene of a photograph, or of a clip whose payload comes again after its last frame."""
        scene = preset(self.camera, self.screen)
        scene = replace(scene, picture=self.picture, light_e_per_s=scene.light_e_per_s * self.light)
        scene = scene.metered(self.exposure_slots)
        if not self.is_screen:
            pose = replace(scene.pose, fill=_BEYOND_EDGES)
            scene = replace(scene, waveform=np.ones_like, dimming="none", panel=0.0, pose=pose)
        scene = scene.scaled(self.scale, self.scale, keep_readout=True) if self.scale != 1 else scene
        if self.bursts_a_frame is None:
            return scene
        screen = scene.screen
        n_bits = round(self.bursts_a_frame * self.n_frames) * screen.columns * payload_bits(5, screen.payload_symbols)
        frame_slots = screen.packet_slots * screen.repeats * self.bursts_a_frame
        payload, frame_rate_hz = np.random.default_rng(0).bytes(n_bits // 8), screen.slot_rate_hz / frame_slots
        return replace(scene, payload=payload, n_frames=self.n_frames, frame_rate_hz=frame_rate_hz)

    @property
    def frame_rate_hz(self) -> float | None:
        """Frames a second of a clip; None for a photograph."""
        return None if self.bursts_a_frame is None else self.scene.frame_rate_hz

    def make(self, folder: Path, seed: int) -> Path:
        """The file in `folder` beside its camera profile; simulated unless it is there already."""
        path = folder / self.file
        if path.exists() and camera_path(path).exists():
            return path
        once = path if self.times == 1 else path.with_stem(path.stem + "-once")
        write_known(self.scene, once, seed, self.bit_rate)
        if self.times > 1:
            repeat_clip(once, path, self.times)
            camera_path(once).replace(camera_path(path))
        return path


def camera_path(path: Path) -> Path:
    """Where the camera profile of a file lies."""
    return path.with_name(path.stem + ".camera.toml")


def write_known(scene: Scene, path: Path, seed: int, bit_rate: int | None = None) -> None:
    """Simulate a JPEG, DNG or clip, with its truth and its camera profile beside it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    file_format = {".jpg": "jpeg", ".dng": "dng", ".mp4": "h264"}[path.suffix]
    recording = prepare(replace(scene, output="raw" if file_format == "dng" else "developed"), seed)
    write_capture(recording, path, file_format, bit_rate)
    write_whole(truth_path(path), json.dumps(recording.truth(path.name), indent=1) + "\n")
    profile = build_camera_profile(recording.scene, recording.exposure())
    camera_path(path).write_text(dump_profile(profile), encoding="utf-8")


def repeat_clip(short: Path, out: Path, times: int) -> None:
    """Write the packets of a clip several times over, one time after the other, without encoding them again."""
    with av.open(str(out), "w") as target:
        stream = None
        for turn in range(times):
            with av.open(str(short)) as source:
                video = source.streams.video[0]
                stream = stream or target.add_stream_from_template(video)
                for packet in source.demux(video):
                    if packet.dts is None or packet.pts is None:
                        continue  # the empty packet at the end
                    packet.pts += turn * video.duration
                    packet.dts += turn * video.duration
                    packet.stream = stream
                    target.mux(packet)


def bare_decode(path: Path) -> Callable[[], int] | None:
    """A function that decodes the file, nothing else, and gives the number of frames; None for other kinds of files."""
    kind = sniff(read_bytes(path, HEAD_BYTES), path.suffix.lower())
    decoder = _DECODERS.get(kind or "")
    return None if decoder is None else lambda: decoder(path)


def _raw(path: Path) -> int:
    with rawpy.imread(str(path)) as raw:
        return int(raw.raw_image.ndim > 0)


def _video(path: Path) -> int:
    """Decode every luma plane as a view, on as many threads as FFmpeg takes; returns the number of frames."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type, stream.codec_context.thread_count = "FRAME", 0
        return sum(np.frombuffer(frame.planes[0], np.uint8).size > 0 for frame in container.decode(stream))


#: Kind of a file -> what decodes it and gives the number of frames.
_DECODERS: dict[str, Callable[[Path], int]] = {
    "jpeg": lambda path: int(simplejpeg.decode_jpeg(path.read_bytes(), colorspace="GRAY").ndim > 0),
    "png": lambda path: int(cv2.imread(str(path), cv2.IMREAD_UNCHANGED) is not None),
    "raw": _raw,
    "tiff": _raw,
    "video": _video,
}
