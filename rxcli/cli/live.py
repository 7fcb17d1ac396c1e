"""`vlc-rx live`: a V4L2 camera, its lock and its payloads as they come."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Generator
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import click

from rxcli.cli.common import claim_outputs, force_argument, receiver_arguments, receiver_options
from rxcli.errors import ExitCode, UsageError

if TYPE_CHECKING:
    from rxcli.ingest.v4l2 import CameraCounts, LiveSource
    from rxcli.types import Frame, FrameResult

#: Rates and states are those of the last so many seconds.
_WINDOW_S = 1.0
#: How often the status is written: on a terminal over itself, elsewhere line by line.
_TERMINAL_S, _LOG_S = 0.2, 1.0
_LOCKED = ("ok", "partial")


class Exposure(click.ParamType[float]):
    """Seconds, as a number or a fraction."""

    name = "seconds"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        numerator, _, denominator = str(value).partition("/")
        try:
            seconds = float(numerator) / float(denominator or 1)
        except (ValueError, ZeroDivisionError):
            self.fail(f"{value!r} is neither seconds nor a fraction such as 1/8000", param, ctx)
        if not 0 < seconds < 10:
            self.fail(f"{value} must be between 0 and 10 seconds", param, ctx)
        return seconds


@click.command()
@click.argument("device", type=click.Path(path_type=Path))
@click.option("--width", type=click.IntRange(1), help="Pixels across. [default: the largest that is fast enough]")
@click.option("--height", type=click.IntRange(1), help="Rows. [default: the largest that is fast enough]")
@click.option("--fps", type=click.FloatRange(0, min_open=True), help="Frames a second. [default: the camera's most]")
@click.option("--format", "pixel_format", metavar="FOURCC", help="GREY, Y10, Y12, Y16, NV12, YUYV, UYVY or MJPG.")
@click.option("--exposure", type=Exposure(), help="Seconds, or 1/8000. [default: as short as the camera can]")
@click.option("--gain", type=int, help="In the camera's own units. [default: as it is]")
@click.option("--wait", is_flag=True, help="Wait for a camera that is missing, busy or unplugged.")
@click.option("--list", "list_only", is_flag=True, help="Show the camera's modes and leave.")
@click.option("--frames", "n_frames", type=click.IntRange(1), help="Stop after this many frames.")
@click.option("--duration", type=click.FloatRange(0, min_open=True), metavar="SECONDS", help="Stop after this time.")
@click.option("--json", "json_path", metavar="FILE|-", help="Write one JSON object a frame, instead of tables.")
@click.option("--quiet", is_flag=True, help="No status line.")
@receiver_arguments
@force_argument
def live(device: Path, **options: Any) -> int:
    """Receive from the V4L2 camera DEVICE, such as /dev/video0, until Ctrl-C."""
    if options["list_only"]:
        return _show_modes(device)
    names = ("screens", "cameras", "corners", "cae", "min_confidence", "no_skip")
    configured = receiver_options(**{name: options[name] for name in names})
    _claim(device, options)
    from rxcli.ingest.v4l2 import LiveSource
    from rxcli.receiver.pipeline import receive

    source = LiveSource(
        device,
        _settings(options),
        on_lost=lambda reason: _say(f"waiting: {reason}"),
        duration_s=options["duration"],
        on_idle=lambda: status.show_if_due(),
    )
    status = Status(source, quiet=options["quiet"])
    with ExitStack() as stack:
        write = _writer(options["json_path"], stack)
        stack.enter_context(status)
        frames = stack.enter_context(closing(_limited(source, options["n_frames"])))
        for result in receive(frames, configured):
            write(result)
            status.update(result)
    return ExitCode.OK if status.n_packets else ExitCode.NOT_RECEIVED


def _claim(device: Path, options: dict[str, Any]) -> None:
    """Refuse to write over what is no earlier output."""
    from rxcli.outputs import JOURNAL, Output

    if options["json_path"] not in (None, "-"):
        output = Output("--json", Path(options["json_path"]), JOURNAL)
        claim_outputs([output], (device,), (*options["screens"], *options["cameras"]), options["force"])


def _settings(options: dict[str, Any]) -> Any:
    from rxcli.ingest.v4l2 import PIXEL_FORMATS, CameraSettings

    name = options["pixel_format"] and options["pixel_format"].upper()
    if name is not None and name not in PIXEL_FORMATS:
        raise UsageError(f"--format {options['pixel_format']} is not known", f"known are {', '.join(PIXEL_FORMATS)}")
    return CameraSettings(
        width=options["width"],
        height=options["height"],
        fps=options["fps"],
        pixel_format=name,
        exposure_s=options["exposure"],
        gain=options["gain"],
        wait=options["wait"],
    )


def _show_modes(device: Path) -> int:
    from rxcli.ingest.v4l2 import list_modes

    for mode in list_modes(device):
        click.echo(str(mode))
    return ExitCode.OK


def _limited(source: LiveSource, n_frames: int | None) -> Generator[Frame, None, None]:
    """Frames of the camera up to a number."""
    with closing(iter(source)) as frames:
        for number, frame in enumerate(frames, 1):
            yield frame
            if number == n_frames:
                return


def _writer(json_path: str | None, stack: ExitStack) -> Callable[[FrameResult], None]:
    """What is done with a result: a JSON line for each frame, or a table for those with packets."""
    from rxcli.results.report import format_frame, to_json_line

    def show(result: FrameResult) -> None:
        if any(column.packets for column in result.columns):
            click.echo(format_frame(result))

    if json_path is None:
        return show
    file = sys.stdout if json_path == "-" else stack.enter_context(_open(json_path))

    def write(result: FrameResult) -> None:
        file.write(to_json_line(result).rstrip("\n") + "\n")
        file.flush()

    return write


def _open(path: str) -> TextIO:
    try:
        return Path(path).open("w", encoding="utf-8")
    except OSError as error:
        raise UsageError(f"--json {path}: {error.strerror}", "name another file") from None


@dataclass(frozen=True, slots=True)
class _Moment:
    """What one frame brought."""

    time_s: float
    status: str
    n_alive: int
    n_columns: int
    bits: int
    wrong_bits: float


@dataclass
class Status:
    """The line on stderr: lock, columns alive, rates, and what was lost; a context manager that ends it properly."""

    source: LiveSource
    quiet: bool = False
    n_packets: int = 0
    _recent: deque[_Moment] = field(default_factory=deque)
    _shown_s: float = 0.0
    _width: int = 0

    def __enter__(self) -> Status:
        return self

    def __exit__(self, *_: object) -> None:
        if self._recent or self.source.counts.damaged:
            self._show(final=True)

    def update(self, result: FrameResult) -> None:
        """Take a frame's result into account, and show the state if it is time."""
        now = time.monotonic()
        self._recent.append(_moment(result, now))
        self.n_packets += sum(len(column.packets) for column in result.columns)
        while self._recent[0].time_s < now - _WINDOW_S:
            self._recent.popleft()
        self.show_if_due(now)

    def show_if_due(self, now: float | None = None) -> None:
        """Show the state if it is time, also where no whole frame comes."""
        now = time.monotonic() if now is None else now
        if now - self._shown_s >= (_TERMINAL_S if sys.stderr.isatty() else _LOG_S):
            self._shown_s = now
            self._show()

    def _show(self, final: bool = False) -> None:
        if self.quiet:
            return
        line = format_status(list(self._recent), self.source.counts)
        if not sys.stderr.isatty():
            _say(line)
            return
        padded, self._width = line.ljust(self._width), len(line)
        click.echo(f"\r{padded}", err=True, nl=final)


def format_status(recent: list[_Moment], counts: CameraCounts) -> str:
    """The state of reception in one line.

    Args:
        recent: what the frames of the last second brought; none where no whole frame has come yet.
        counts: what became of the camera's frames so far.
    """
    lost = [f"dropped {counts.dropped}", f"damaged {counts.damaged}"]
    if not recent:
        return " | ".join(["no whole frame yet", *lost])
    last = recent[-1]
    span_s = max(last.time_s - recent[0].time_s, 1e-3)
    bits = sum(moment.bits for moment in recent)
    new_bits = sum(moment.bits for moment in recent[1:])  # those of the span; the first frame only starts it
    lock = "LOCKED" if last.status in _LOCKED else last.status.replace("_", " ")
    parts = [f"{lock:<9}", f"columns {last.n_alive}/{last.n_columns}"]
    if len(recent) > 1:
        parts += [f"{(len(recent) - 1) / span_s:.1f} frames/s", f"{new_bits / span_s / 1e3:.1f} kb/s"]
    if bits:
        parts.append(f"BER about {sum(moment.wrong_bits for moment in recent) / bits:.1e}")
    return " | ".join(parts + lost)


def _moment(result: FrameResult, now: float) -> _Moment:
    packets = [packet for column in result.columns for packet in column.packets]
    return _Moment(
        time_s=now,
        status=result.status,
        n_alive=sum(column.status in ("ok", "weak") for column in result.columns),
        n_columns=len(result.columns),
        bits=sum(packet.payload_bits for packet in packets),
        wrong_bits=sum(packet.payload_bits * packet.ber_hat for packet in packets),
    )


def _say(line: str) -> None:
    click.echo(line, err=True)
