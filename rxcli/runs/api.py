"""What `import rxcli` calls: one source, received by a function."""

import math
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import replace
from difflib import get_close_matches
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError, UsageError
from rxcli.ingest import open_source
from rxcli.options import check_values, is_number, receiver_options
from rxcli.receiver.receive import receive as receive_frames
from rxcli.receiver.receive import receive_frame
from rxcli.results.dump import Taps, taps_of, taps_writer
from rxcli.runs.batch import Decoder
from rxcli.types import Frame, FrameResult, Metadata, Mosaic

#: A picture: a file, an array of grey values, or a frame with what is known of it.
Picture = str | Path | NDArray[Any] | Frame


class Receiver:
    """A receiver that keeps its options: `Receiver(screens="paper-17k3", cameras="mycam.toml")`.

    Args:
        options: see `rxcli.options.receiver_options`: screens, cameras, corners, cae, min_confidence and more. None is
            needed.

    Raises:
        ProfileError: a profile is missing or malformed.
        UsageError: an option is impossible.
    """

    def __init__(self, **options: Any) -> None:
        known = signature(receiver_options).parameters
        for name in options.keys() - known.keys():
            like = get_close_matches(name, known, 1)
            step = f"did you mean {like[0]!r}?" if like else f"options are {', '.join(known)}"
            raise UsageError(f"there is no option {name!r}", step)
        self.options = receiver_options(**{"soft_bits": True, **options})

    def decode(self, picture: Picture) -> FrameResult:
        """Receive one photograph.

        Args:
            picture: path of a photograph or RAW file; or (height, width) array of grey values as the camera stores
                them, uint8 or uint16; or a `Frame` with exposure, levels and whether values are proportional to light.

        Returns:
            Its result. A failed reception is a status with a message, not an exception.

        Raises:
            InputError: the file cannot be read.
            UsageError: the file is a clip, the array is no picture, or the frame is impossible.
        """
        on_taps = taps_writer(self.options.dump_dir)
        (result,) = self._with_messages(iter([receive_frame(_frame_of(picture), self.options, on_taps)]))
        return result

    def receive(self, source: str | Path | Iterable[Picture], frame_rate: float | None = None) -> Iterator[FrameResult]:
        """Receive a clip, a device, a photograph, or frames in order of time; one result a frame, in order.

        Results are delayed by some frames, because later frames improve earlier ones. A packet is reported in the last
        frame that shows it.

        Args:
            source: path of a file or V4L2 device; or arrays or `Frame`s of one camera.
            frame_rate: frames per second of arrays, or of `Frame`s without `time_s`.

        Raises:
            InputError: the file cannot be read, or, after the results before the break, it breaks off.
            UsageError: an array is no picture, a frame is impossible, or there are several without times.
        """
        check_values(("frame_rate", frame_rate, frame_rate is None or is_number(frame_rate, 1e-3), "above 0"))
        several = isinstance(source, Iterable) and not (isinstance(source, np.ndarray) and source.ndim < 3)
        if not several and not isinstance(source, Path):
            reason = f"what is received must be a path, or several pictures (got {type(source).__name__})"
            raise UsageError(reason, "give a path or a list of pictures; use decode for one picture")
        frames = open_source(source) if isinstance(source, (str, Path)) else _numbered(source, frame_rate)
        return self._with_messages(receive_frames(frames, self.options, taps_writer(self.options.dump_dir)))

    def _with_messages(self, results: Iterator[FrameResult]) -> Iterator[FrameResult]:
        """Results with the texts and files that they complete; the last one with what is left of others."""
        return Decoder(self.options).linked(results)

    def tap(self, picture: Picture) -> tuple[FrameResult, Taps | None]:
        """Receive one photograph and keep the arrays of every stage boundary; None where reception ended before.

        Raises:
            InputError: the file cannot be read.
            UsageError: the file is a clip, or the array is no picture.
        """
        stages: dict[str, Any] = {}
        received = receive_frame(_frame_of(picture), self.options, lambda _source, _frame, of: stages.update(of))
        (result,) = self._with_messages(iter([received]))
        return result, taps_of(stages) if stages else None


def decode(picture: Picture, **options: Any) -> FrameResult:
    """Receive one photograph: `Receiver(**options).decode(picture)`."""
    return Receiver(**options).decode(picture)


def receive(
    source: str | Path | Iterable[Picture], frame_rate: float | None = None, **options: Any
) -> Iterator[FrameResult]:
    """Receive a clip, a device, or frames in order of time: `Receiver(**options).receive(source, frame_rate)`."""
    return Receiver(**options).receive(source, frame_rate)


def tap(picture: Picture, **options: Any) -> tuple[FrameResult, Taps | None]:
    """Receive one photograph and keep the arrays of every stage: `Receiver(**options).tap(picture)`."""
    return Receiver(**options).tap(picture)


def _frame_of(picture: Picture) -> Frame:
    if isinstance(picture, Frame):
        _check_frame(picture)
        return picture
    if not isinstance(picture, (str, Path)):
        return frame_of_array(picture)
    frames = open_source(picture)
    with closing(frames):
        frame = next(frames, None)
        if frame is None:
            raise InputError(f"{picture}: no frame in it", "check the file")
        if next(frames, None) is not None:
            raise UsageError(f"{picture}: more than one frame", "use receive, which takes clips")
    return frame


def frame_of_array(pixels: NDArray[Any]) -> Frame:
    """A frame of grey values as a camera stores them, rows in the order of readout.

    Raises:
        UsageError: not (height, width) of uint8 or uint16, or empty.
    """
    is_array = isinstance(pixels, np.ndarray)
    if not is_array or pixels.ndim != 2 or not pixels.size or pixels.dtype not in (np.uint8, np.uint16):
        shown = f"{pixels.shape} of {pixels.dtype}" if is_array else type(pixels).__name__
        reason = f"a picture must be a path, a Frame or a (height, width) array of uint8 or uint16 (got {shown})"
        raise UsageError(reason, "of a colour picture take the green channel or luma; convert lists to such an array")
    return Frame(pixels, "array", white=float(np.iinfo(pixels.dtype).max))


def _check_frame(frame: Frame) -> None:
    """Refuse a frame whose values are impossible.

    Raises:
        UsageError: of the first such value.
    """
    frame_of_array(frame.pixels)
    about, mosaic = frame.metadata, frame.mosaic
    check_values(
        ("metadata", about, isinstance(about, Metadata), "Metadata"),
        ("mosaic", mosaic, mosaic is None or isinstance(mosaic, Mosaic), "a Mosaic, or None"),
        ("source", frame.source, isinstance(frame.source, str), "a text that names the picture"),
        ("index", frame.index, is_number(frame.index, 0), "a number from 0"),
        ("time_s", frame.time_s, is_number(frame.time_s), "finite seconds"),
    )
    lengths = {name: getattr(about, name) for name in ("exposure_s", "iso", "focal_length_mm", "focal_length_35mm")}
    check_values(
        *((name, value, value is None or is_number(value, 1e-12), "above 0") for name, value in lengths.items()),
        ("orientation", about.orientation, about.orientation in range(1, 9), "in 1..8"),
    )
    levels = {"black": (frame.black, frame.white)}
    if mosaic is not None:
        colours, gains, black = np.asarray(mosaic.pattern), mosaic.gains, mosaic.black
        is_pattern = colours.ndim == 2 and colours.size > 0 and bool(np.isin(colours, range(3)).all())
        are_gains = np.shape(gains) == (3,) and all(is_number(gain, 1e-12) for gain in gains)
        check_values(
            ("mosaic.pattern", mosaic.pattern, is_pattern, "a (h, w) array of the colours 0, 1, 2"),
            ("mosaic.gains", gains, are_gains, "three positive numbers"),
            ("mosaic.black", black, np.shape(black) == (3,), "three numbers"),
        )
        levels = {f"mosaic.black[{n}]": (level, mosaic.white) for n, level in enumerate(black)}
    for of, pair in levels.items():
        are_right = all(map(is_number, pair)) and pair[0] < pair[1]
        check_values((f"{of} and white", pair, are_right, "numbers, white above black"))


def _numbered(pictures: Iterable[Picture], frame_rate: float | None) -> Iterator[Frame]:
    """Frames at their own times, or at those of a frame rate."""
    first_s = math.nan
    for number, picture in enumerate(pictures):
        frame = _frame_of(picture)
        if frame_rate is not None or not isinstance(picture, Frame):
            frame = replace(frame, index=number, time_s=number / frame_rate if frame_rate else frame.time_s)
        if number == 1 and frame.time_s == first_s:
            reason = "the pictures have no times, which burst each shows is not known"
            raise UsageError(reason, "give frame_rate=, in frames a second, or Frames with time_s")
        first_s = frame.time_s if number == 0 else first_s
        yield frame
