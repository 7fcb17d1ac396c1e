"""What commands show: texts and tables on stdout, lines of JSON and CSV, progress on stderr."""

import os
import re
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from threading import Event, Lock, Thread
from typing import Any, Self, TextIO, TypeVar

import click

from rxcli.results import report
from rxcli.results.summary import SourceSummary, format_clip
from rxcli.types import FrameResult

_T = TypeVar("_T")
#: Seconds between two lines of progress where stderr is no terminal.
_EVERY_S = 10.0
#: Seconds after which a terminal gets a bar.
_DELAY_S = 0.5
_COLOURS = {"ok": "green", "partial": "yellow", "weak": "yellow", "dark": "bright_black"}
_COLOURS |= dict.fromkeys(("no_packet", "no_screen", "no_signal", "unreadable"), "red")
#: A state stands in a heading between bars, or in a table behind the column's number.
_STATE = re.compile(rf"(?<= \| )({'|'.join(_COLOURS)})(?= \||$)|(?<=\d  )({'|'.join(_COLOURS)})(?=\*? )", re.MULTILINE)


class Table:
    """Prints texts and files first; then a photo's packets as a table, and a clip in one line.

    Args:
        packets: whether clips have a table, too.
    """

    #: Whether a table was shown, which a legend explains.
    has_table = False

    def __init__(self, packets: bool) -> None:
        self._packets = packets
        self._scored = self._clip = self._has_header = False

    def begin(self, _source: str, scored: bool) -> None:
        """Begin a source, whose packets are `scored` against the truth."""
        self._scored, self._clip, self._has_header = scored, False, False

    def write(self, result: FrameResult, last: bool) -> None:
        """Print what came with the frame."""
        self._clip |= not last
        for line in report.format_link(result):
            print_text(line)
        if not self._clip:
            self.has_table |= bool(result.packets)
            print_text(report.format_frame(result) + "\n")
        elif self._packets and result.packets:
            print_text("\n".join(report.packet_table(result, True, self._scored, not self._has_header)))
            self.has_table = self._has_header = True

    def end(self, summary: SourceSummary) -> None:
        """Print the line of a clip."""
        if self._clip:
            print_text(format_clip(summary) + "\n")


def print_line(line: str) -> None:
    """Print a line of data and flush it."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def print_text(text: str, err: bool = False) -> None:
    """Text for people: on a terminal, lines end between words, and states have colours unless NO_COLOR is set."""
    stream = sys.stderr if err else sys.stdout
    if is_terminal(stream):
        text = coloured(report.wrapped(text, shutil.get_terminal_size().columns), bool(os.environ.get("NO_COLOR")))
    click.echo(text, err=err)


def is_terminal(stream: TextIO) -> bool:
    """Whether people read a stream as it is written."""
    return stream is not None and stream.isatty()


def coloured(text: str, plain: bool = False) -> str:
    """States of frames and columns in their colours."""
    return text if plain else _STATE.sub(lambda found: click.style(found[0], fg=_COLOURS[found[0]]), text)


def with_progress(items: Sequence[_T], what: str, unit: str) -> Iterator[_T]:
    """The items, with progress on stderr: a bar on a terminal, elsewhere a line every ten seconds."""
    from tqdm import tqdm

    said_s, prints = time.monotonic(), not is_terminal(sys.stderr)
    for number, item in enumerate(tqdm(items, desc=what, unit=f" {unit}", leave=False, disable=None)):
        if prints and time.monotonic() - said_s >= _EVERY_S:
            said_s = time.monotonic()
            click.echo(f"vlc-rx: {what}: {number} of {len(items)} {unit}", err=True)
        yield item


class Progress:
    """How far a run is, on stderr: a bar on a terminal, elsewhere a line every ten seconds; a context manager.

    A thread shows it while a picture is searched. The bar counts sources, or the frames of a single one.

    Args:
        n_total: sources of the run.
        n_done: sources completed by an earlier run.
        quiet: show nothing.
    """

    def __init__(self, n_total: int, n_done: int, quiet: bool) -> None:
        self._total, self._done, self._before = n_total, n_done, n_done
        self._counts = [0, 0, 0]  # frames, packets, files and texts
        self._start_s = self._said_s = time.monotonic()
        self._prints = not quiet and not is_terminal(sys.stderr)
        self._hidden = quiet or self._prints
        #: What is being received, and the frames of it so far.
        self._source, self._n_frames = "", 0
        self._lock, self._ended = Lock(), Event()
        self._watch = Thread(target=self._keep_showing, daemon=True)
        #: Made when it has something to show: one photo is decoded before its package is loaded.
        self.bar: Any = None

    def __enter__(self) -> Self:
        if self._prints or not self._hidden:
            self._watch.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._watch.is_alive():
            self._watch.join()
        if self.bar is not None:
            self.bar.close()

    def _keep_showing(self) -> None:
        with suppress(OSError, ValueError):  # stderr was closed
            while not self._ended.wait(_DELAY_S):
                self._show_in_time()

    @contextmanager
    def hidden(self) -> Iterator[None]:
        """While others may write to the terminal."""
        with self._lock, nullcontext() if self.bar is None else self.bar.external_write_mode():
            yield

    def begin(self, source: str) -> None:
        """A source is received."""
        self._source, self._n_frames = report.printable_name(source), 0

    def add(self, result: FrameResult, last: bool) -> None:
        """Count a result, the last of its source or not."""
        came = len(result.messages) + len(result.objects)
        received = sum(packet.is_believable for packet in result.packets)
        self._counts = [sum(pair) for pair in zip(self._counts, (1, received, came), strict=True)]
        self._done += last
        self._n_frames += 1
        self._show_in_time()

    def _show_in_time(self) -> None:
        """Print the line or draw the bar, if it is time."""
        with self._lock:
            now_s = time.monotonic()
            if self._prints and now_s - self._said_s >= _EVERY_S:
                self._said_s = now_s
                click.echo(f"vlc-rx: {self.line(now_s - self._start_s)}", err=True)
            if not self._hidden and self._done < self._total and now_s - self._start_s > _DELAY_S:
                self._show()

    def _show(self) -> None:
        """Draw the bar."""
        from tqdm import tqdm

        is_one = self._total == 1
        n, form = self._n_frames if is_one else self._done, {"file": sys.stderr, "leave": False, "initial": self._done}
        if self.bar is None:
            self.bar = tqdm(**form, **({"unit": " frames"} if is_one else {"unit": "source", "total": self._total}))
        self.bar.set_postfix_str(self._so_far(), refresh=False)
        self.bar.update(n - self.bar.n)
        self.bar.refresh()

    def _so_far(self) -> str:
        frames, packets, came = self._counts
        counts = f"{report.plural(frames, 'frame')}, {report.plural(packets, 'packet')}, {came} texts and files"
        doing = f"frame {self._n_frames}" if self._n_frames else "searching"
        return f"{counts}; {self._source}: {doing}" if self._source else counts

    def line(self, passed_s: float) -> str:
        """How far it is after some seconds, and when it will end."""
        done = self._done - self._before
        parts = [f"{self._done} of {self._total} photos and clips", self._so_far()]
        if done:
            left_s = passed_s * (self._total - self._done) / done
            parts += [f"{done / passed_s:.2g} a second", f"{left_s:.0f} s left"]
        return "; ".join(parts)
