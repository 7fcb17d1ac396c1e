"""`vlc-rx encode`: what a transmitter has to send so that a text or a file comes out."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from rxcli.cli.common import claim_outputs, force_argument, options, refuse
from rxcli.cli.sending import sending_of
from rxcli.errors import InputError, UsageError
from rxcli.link.encoder import FileSending, Sending, packet_slots_of, visible_bits_of_burst
from rxcli.outputs import ENCODED, Output
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.results.report import plural

_RATES = {"1/1.5": 0, "1/2": 1, "1/3": 2}
#: Bursts that are computed at a time.
_CHUNK = 256
#: Share of the time that a usual 4K video shows: what a time needed is reckoned with.
_USUAL_READOUT = 0.61


@click.command()
@click.argument("path", type=click.Path(path_type=Path), required=False)
@options(
    ("--text", str, None, "Send this text; one of more than 199 bytes goes as a file."),
    ("--uri", str, None, "Send this URI, of at most 199 bytes."),
    ("--screen", str, "data-34k6", "Screen profile: a name or a TOML file."),
    ("--out", click.Path(dir_okay=False, path_type=Path), None, "Where to write: .npy, or .csv.", {"required": True}),
    ("--bursts", click.IntRange(1), None, "How many bursts. [default: what a receiver needs, and more]"),
    ("--seconds", click.FloatRange(0, min_open=True), None, "How much time of the link, instead."),
    ("--slots", None, False, "Write the slots themselves, bit-packed (.npy), instead of labels."),
    ("--weights", str, "5", "Lit slots of ten: N, a list N,N,..., or a JSON file per burst."),
    ("--mother", tuple(_RATES), "1/3", "Mother rate of a file's code."),
    ("--object-id", click.IntRange(0, 65533), None, "Number of a file. [default: from its content]"),
)
@force_argument
def encode(path: Path | None, out: Path, **options: Any) -> None:
    """Encode the file PATH, a text or a URI as labels, or slots, for a transmitter."""
    screen = load_profile(options["screen"], ScreenProfile)
    is_ambiguous, suffix = options["bursts"] is not None and options["seconds"] is not None, out.suffix
    refuse(
        (is_ambiguous, "--bursts and --seconds exclude each other", "give one of them"),
        (suffix not in (".npy", ".csv"), f"--out must end in .npy or .csv (got {str(out)!r})", "name such a file"),
        (options["slots"] and suffix != ".npy", "--slots are written as .npy only", "name such a file"),
    )
    inputs = [path, Path(options["weights"]) if options["weights"].endswith(".json") else None]
    readme = Output("--slots", _readme_of(out), ENCODED) if options["slots"] else None
    written = [Output("--out", out, ENCODED), readme]
    claim_outputs(written, filter(None, inputs), (options["screen"],), options["force"])
    sending = sending_of(path, options["text"], options["uri"], _RATES[options["mother"]], options["object_id"])
    n_bursts = _n_bursts(options, sending, screen)
    plan = _Plan(sending, screen, _weights(options["weights"], n_bursts, screen.columns), n_bursts, out)
    for row in plan.weights:
        sending.check(row, screen.payload_symbols)
    write = plan.write_csv if suffix == ".csv" else plan.write_slots if options["slots"] else plan.write_labels
    try:
        write()
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror or error})", "name another file") from None
    click.echo(plan.summary(), err=True)


def _readme_of(out: Path) -> Path:
    return out.with_name(out.name + ".README.txt")


def _n_bursts(options: dict[str, Any], sending: Sending, screen: ScreenProfile) -> int:
    burst_s = screen.packet_s * screen.repeats
    if options["bursts"] is not None:
        return int(options["bursts"])
    if options["seconds"] is not None:
        return max(1, ceil(float(options["seconds"]) / burst_s))
    return sending.usual_bursts(screen.columns, screen.payload_symbols)


def _weights(text: str, n_bursts: int, columns: int) -> NDArray[np.int64]:
    """(n_bursts or 1, columns) weights."""
    try:
        values = np.asarray(_weight_values(text), np.int64)
        weights = np.broadcast_to(values, (values.shape[0] if values.ndim == 2 else 1, columns))
    except (ValueError, TypeError, OverflowError):
        raise UsageError(
            f"--weights {text}: no number, list of {columns} numbers, or JSON file of {n_bursts} such lists",
            "give 1..9 for every column",
        ) from None
    n, step = len(weights), f"give {n_bursts}, or --bursts"
    refuse(
        (weights.min() < 1 or weights.max() > 9, f"--weights {text}: weights are 1 to 9", "choose from 1..9"),
        (n not in (1, n_bursts), f"--weights {text} holds {n} bursts, {n_bursts} are sent", step),
    )
    return weights


def _weight_values(text: str) -> Any:
    if not text.endswith(".json"):
        return [int(part) for part in text.split(",")]
    try:
        return json.loads(Path(text).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"--weights {text}: cannot be read ({error.strerror})", "name a JSON file") from None


@dataclass(frozen=True, slots=True)
class _Plan:
    """What is sent, and the file that it is written to."""

    sending: Sending
    screen: ScreenProfile
    #: (n_bursts or 1, columns) lit slots of ten.
    weights: NDArray[np.int64]
    n_bursts: int
    out: Path

    def _chunks(self) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """First burst and labels (bursts, symbols, columns) of some bursts at a time."""
        for start in range(0, self.n_bursts, _CHUNK):
            bursts = np.arange(start, min(start + _CHUNK, self.n_bursts))
            yield start, self.sending.labels(bursts, self.screen.columns, self.screen.payload_symbols)

    def write_labels(self) -> None:
        """Write labels as an array."""
        shape = (self.n_bursts, self.screen.payload_symbols, self.screen.columns)
        target = np.lib.format.open_memmap(self.out, "w+", np.uint8, shape)
        for start, labels in self._chunks():
            target[start : start + len(labels)] = labels
        target.flush()

    def write_csv(self) -> None:
        """Write labels as text, one row a symbol."""
        with self.out.open("w", encoding="utf-8") as file:
            file.write("burst,symbol," + ",".join(f"column_{c}" for c in range(self.screen.columns)) + "\n")
            for start, labels in self._chunks():
                for burst, symbols in enumerate(labels, start):
                    for symbol, row in enumerate(symbols):
                        file.write(f"{burst},{symbol},{','.join(map(str, row))}\n")

    def write_slots(self) -> None:
        """Write slots as an array of bits, and beside it a text file that states their order."""
        screen, out = self.screen, self.out
        burst_slots, width = screen.packet_slots * screen.repeats, -(-screen.columns // 8)
        target = np.lib.format.open_memmap(out, "w+", np.uint8, (self.n_bursts * burst_slots, width))
        for start, labels in self._chunks():
            weights = self.weights if len(self.weights) == 1 else self.weights[start : start + len(labels)]
            packets = np.packbits(packet_slots_of(labels, weights).transpose(0, 2, 1), axis=2)
            repeated = np.tile(packets, (1, screen.repeats, 1)).reshape(-1, width)
            target[start * burst_slots : start * burst_slots + len(repeated)] = repeated
        target.flush()
        _readme_of(out).write_text(
            f"{out.name}: uint8 ({len(target)}, {width}); one row a slot at {screen.slot_rate_hz:g} Hz, first sent "
            f"first; {screen.columns} columns as bits, column 0 (the viewer's leftmost) is the most significant bit of "
            "the first byte; 1 is lit.\n",
            encoding="utf-8",
        )

    def summary(self) -> str:
        """What is sent, and how long a camera needs for a file."""
        screen, weights = self.screen, self.weights
        burst_s = screen.packet_s * screen.repeats
        sent = f"{plural(self.n_bursts, 'burst')} of {screen.name}, {self.n_bursts * burst_s:.3g} s"
        lines = [f"{self.out}: {self.sending.summary}; {sent}"]
        if isinstance(self.sending, FileSending):
            bits = sum(visible_bits_of_burst(row, screen.payload_symbols) for row in weights) / len(weights)
            needed = self.sending.ready_bits / (bits * 31 / 32) * burst_s / _USUAL_READOUT
            lines.append(
                f"a camera that sees all columns for {_USUAL_READOUT:.0%} of the time needs about {needed:.1f} s, and "
                f"an announcement, which comes every {32 * burst_s:.2g} s; send on until it has come"
            )
        return "\n".join(lines)
