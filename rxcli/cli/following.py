"""What `vlc-rx live` does: receive from the camera, show its state, write what comes."""

import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any, Self

import click

from rxcli.cli.common import output, receiver_options
from rxcli.cli.printing import is_terminal, print_line, print_text
from rxcli.errors import ExitCode, UsageError, printable
from rxcli.ingest.v4l2 import PIXEL_FORMATS, CameraCounts, CameraSettings, LiveSource, list_modes
from rxcli.link.collector import Collector
from rxcli.link.saving import save_objects
from rxcli.outputs import JOURNAL, Taken, claim, claim_folder
from rxcli.receiver.receive import receive
from rxcli.results.aim import Aim, AimState, Brightness, brightness_of
from rxcli.results.reasons import explained
from rxcli.results.record import to_json_line
from rxcli.results.report import format_frame, format_link, wrapped
from rxcli.runs.journal import Journal
from rxcli.types import Frame, FrameResult, ObjectProgress

#: How often the status is written: on a terminal over itself, elsewhere line by line.
_TERMINAL_S, _LOG_S = 0.2, 1.0
#: Characters of a progress bar.
_BAR = 20


def run(device: Path, options: dict[str, Any]) -> ExitCode:
    """Receive from the camera `device` with the options that were given."""
    if options["list_only"]:
        click.echo("\n".join(map(str, list_modes(device))))
        return ExitCode.OK
    configured = replace(receiver_options(options, soft_bits=True), prompt=True)
    taken = _claim(device, options)
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
        frames = islice(stack.enter_context(closing(iter(source))), options["n_frames"])
        collector = Collector(configured.screens, configured.file_memory_mb)
        for received in receive(status.watched(frames), configured):
            result = explained(collector.add(received))
            if options["out"] is not None:
                result = save_objects(result, options["out"], options["force"], _say, taken)
            write(result)
            status.update(result, collector.progress)
            if options["until_complete"] and (result.messages or result.objects):
                break
    return ExitCode.OK if status.n_packets or status.n_complete else ExitCode.NOT_RECEIVED


def _claim(device: Path, options: dict[str, Any]) -> Taken:
    """Refuse to write over what is there; returns the files of the run."""
    if options["out"] is not None:
        claim_folder("--out", options["out"])
    way_on = "name another file, or replace it with --force"
    journal = output("--json", options["json_path"], JOURNAL, way_on=way_on)
    return claim([journal], (device,), (*options["screens"], *options["cameras"]), options["force"])


def _settings(options: dict[str, Any]) -> CameraSettings:
    name = options["pixel_format"] and options["pixel_format"].upper()
    if name is not None and name not in PIXEL_FORMATS:
        raise UsageError(f"--format {options['pixel_format']} is not known", f"known are {', '.join(PIXEL_FORMATS)}")
    same = {field: options[field] for field in ("width", "height", "fps", "exposure_s", "gain", "wait")}
    return CameraSettings(pixel_format=name, **same)


def _writer(json_path: str | None, stack: ExitStack) -> Callable[[FrameResult], None]:
    """What is done with a result: a JSON line for each frame, or a table for those with packets."""
    if json_path is None:
        return _show
    put = print_line if json_path == "-" else stack.enter_context(closing(Journal(Path(json_path)))).append
    return lambda result: put(to_json_line(result))


def _show(result: FrameResult) -> None:
    """Print to stdout, above the block of the status where one stays on the terminal."""
    lines = [*format_link(result), *([format_frame(result)] if result.packets else [])]
    if lines:
        from tqdm import tqdm

        with tqdm.external_write_mode():
            print_text("\n".join(lines))


@dataclass
class Status:
    """Status on stderr: lock, light and rates; a context manager that ends it properly.

    On a terminal a block of lines stays in place and payloads scroll above it; elsewhere a line comes now and then.
    """

    source: LiveSource
    quiet: bool = False
    n_packets: int = 0
    #: Messages and files that came whole.
    n_complete: int = 0
    _files: list[ObjectProgress] = field(default_factory=list)
    #: Of the newest frame.
    state: AimState | None = None
    _aim: Aim = field(default_factory=Aim)
    _light: Brightness | None = None
    _height: int = 1
    _bars: list[Any] = field(default_factory=list)
    _shown_s: float = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.state is not None or self.source.counts.damaged:
            self._show()
        for bar in self._bars:
            bar.close()

    def watched(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """The frames, whose light and height are looked at as they pass."""
        for frame in frames:
            self._light, self._height = brightness_of(frame), frame.height
            yield frame

    def update(self, result: FrameResult, files: Sequence[ObjectProgress] = ()) -> None:
        """Take a frame's result into account, and show the state if it is time."""
        now_s = time.monotonic()
        before, self.state = self.state, self._aim.update(result, now_s, self._height, self._light)
        self._files = list(files)
        self.n_complete += len(result.messages) + len(result.objects)
        self.n_packets += len(result.packets)
        self.show_if_due(now_s, changed=before is None or before.word != self.state.word)

    def show_if_due(self, now_s: float | None = None, changed: bool = False) -> None:
        """Show the state if it is time, also where no whole frame comes."""
        now_s = time.monotonic() if now_s is None else now_s
        if changed or now_s - self._shown_s >= (_TERMINAL_S if is_terminal(sys.stderr) else _LOG_S):
            self._shown_s = now_s
            self._show()

    def _show(self) -> None:
        if self.quiet:
            return
        lines = [*format_status(self.state, self.source.counts), " | ".join(map(format_file, self._files))]
        if not is_terminal(sys.stderr):
            _say(" | ".join(filter(None, lines)))
            return
        from tqdm import tqdm

        lines = wrapped("\n".join(lines), max(shutil.get_terminal_size().columns - 1, 20)).split("\n")
        form = {"bar_format": "{desc}", "dynamic_ncols": True, "leave": True, "file": sys.stderr}
        while len(self._bars) < len(lines):
            self._bars.append(tqdm(position=len(self._bars), **form))
        lines[0] = _coloured(lines[0], self.state is not None and self.state.locked)
        for place, bar in enumerate(self._bars):
            bar.set_description_str(lines[place] if place < len(lines) else "")


def format_status(state: AimState | None, counts: CameraCounts) -> list[str]:
    """The state of reception in three lines: lock and rates; light, size and losses; why there is no lock, and what to
    do about it.

    Args:
        state: of the newest frame; None where no whole one has come yet.
        counts: what became of the camera's frames so far.
    """
    lost = [f"dropped {counts.dropped}", f"damaged {counts.damaged}"]
    if state is None:
        return ["no whole frame yet", " | ".join(lost), ""]
    rates = [
        state.word.upper() if state.locked else state.word,
        f"columns {state.n_received}/{state.n_columns}",
        f"{state.frames_per_s:.1f} frames/s",
        f"{state.packets_per_s:.0f} packets/s",
        f"{state.bits_per_s / 1e3:.1f} kb/s",
    ]
    if state.ber_hat is not None:
        rates.append(f"BER about {state.ber_hat:.1e}")
    facts = [] if state.light is None else [f"light {state.light.word}"]
    if state.height_share is not None:
        facts.append(f"screen fills {100 * state.height_share:.0f} % of the height")
    return [" | ".join(rates), " | ".join(facts + lost), " ".join(filter(None, (state.reason, state.advice)))]


def format_file(progress: ObjectProgress) -> str:
    """A file under way: bar, share, rate, time left."""
    filled = int(_BAR * progress.share)
    parts = [f"[{'#' * filled}{'.' * (_BAR - filled)}] {100 * progress.share:.0f} %"]
    left = progress.seconds_left
    if left is not None and progress.share < 1:
        missing = 8 * progress.container_bytes * (1 - progress.share)
        parts += [f"{missing / max(left, 1e-3) / 1e3:.0f} kb/s", f"{left:.0f} s left"]
    return " ".join(parts)


def _coloured(line: str, locked: bool) -> str:
    """The first word in colour, unless NO_COLOR is set."""
    if os.environ.get("NO_COLOR"):
        return line
    word, bar, rest = line.partition(" |")
    return click.style(word, fg="green" if locked else "red", bold=True) + bar + rest


def _say(line: str) -> None:
    click.echo(printable(line), err=True)
