"""`vlc-rx encode`: what a transmitter has to send so that a text, a file or raw payload comes out."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil
from operator import mul
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from rxcli.cli.common import force_argument, options, output, refuse
from rxcli.cli.kinds import FILE, POSITIVE
from rxcli.cli.sending import LIGHT, raw_sending, sending_of
from rxcli.errors import UsageError, failure_explained
from rxcli.link.encoder import FileSending, Sending, TestLight, packet_slots_of, payload_hex, visible_bits_of_burst
from rxcli.link.slots import WITHOUT_TEXT, WRITERS, bytes_per_row, order_of
from rxcli.outputs import ENCODED, TRUTH, claim, writable, write_whole
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.protocol import payload_bits
from rxcli.results.report import plural

#: Bursts that are computed at a time.
_CHUNK = 256
#: Share of the time that a usual 4K video shows: what a time needed is reckoned with.
_USUAL_READOUT = 0.61
_OUT_HELP = "Where to write: .npy or .csv; slots also as .bin, .h or .vcd; - for stdout, as .csv."


@click.command()
@click.argument("path", type=click.Path(path_type=Path), required=False)
@options(
    ("--text", str, None, "Send this text; one of more than 199 bytes goes as a file."),
    ("--uri", str, None, "Send this URI, of at most 199 bytes."),
    ("--payload", str, None, "Send raw payload: random, counter, hex:..., or a file; or no packets: lit, half."),
    ("--same", None, False, "Of --payload: all columns send the same."),
    ("--only-column=N only_column", click.IntRange(0), None, "Let one column alone send; the others stay dark."),
    ("--seed", click.IntRange(0), 0, "Of random payload."),
    ("--screen", str, "data-34k6", "Screen profile: a name or a TOML file."),
    ("--out", click.Path(dir_okay=False, path_type=Path), None, _OUT_HELP, {"required": True}),
    ("--bursts", click.IntRange(1), None, "How many bursts. [default: what a receiver needs, and more]"),
    ("--seconds", POSITIVE, None, "How much time of the link, instead."),
    ("--slots", None, False, "Write the slots themselves instead of labels; so do --payload, .bin, .h and .vcd."),
    ("--truth", FILE, None, "Also write what is sent (JSON), for decode --truth."),
    ("--weights --w", str, "5", "Lit slots of ten: N, a list N,N,..., or a JSON file per burst."),
)
@force_argument
def encode(path: Path | None, out: Path, **options: Any) -> None:
    """Encode the file PATH, a text, a URI or raw payload as labels, or slots, for a transmitter."""
    screen, payload, only = load_profile(options["screen"], ScreenProfile), options["payload"], options["only_column"]
    suffix = ".csv" if str(out) == "-" else out.suffix
    has_slots = options["slots"] or payload is not None or suffix not in (".npy", ".csv")
    is_ambiguous = options["bursts"] is not None and options["seconds"] is not None
    known, n = ", ".join(WRITERS), screen.columns
    refuse(
        (is_ambiguous, "--bursts and --seconds exclude each other", "give one of them"),
        (suffix not in WRITERS, f"--out must end in {known}, or be - (got {str(out)!r})", "name such a file"),
        (options["same"] and payload is None, "--same belongs to --payload", "add --payload random, or leave it out"),
        (only is not None and not has_slots, "--only-column needs slots", "add --slots"),
        (only is not None and only >= n, f"--only-column {only}: {screen.name} has {n} columns", "count from 0"),
        (options["truth"] and payload in LIGHT, f"--payload {payload} sends no packets", "leave out --truth"),
    )
    files = [path, *(Path(name) for name in (options["weights"], payload) if name and Path(name).is_file())]
    readme = _readme_of(out) if has_slots and suffix in WITHOUT_TEXT else None
    written = [output("--out", out, ENCODED), output("--slots", readme, ENCODED)]
    written.append(output("--truth", options["truth"], TRUTH))
    claim(written, filter(None, files), (options["screen"],), options["force"])
    plan = _plan(path, screen, options)
    with writable(out):
        if has_slots:
            _write_slots(plan, out, suffix)
        else:
            plan.write_csv(out) if suffix == ".csv" else plan.write_labels(out)
    if options["truth"]:
        write_whole(options["truth"], json.dumps(plan.truth(), indent=1) + "\n")
    click.echo(f"{out}: {plan.summary()}", err=True)


def _plan(path: Path | None, screen: ScreenProfile, options: dict[str, Any]) -> _Plan:
    given, text = (path, options["text"], options["uri"]), options["weights"]
    weights = _weights(text, screen.columns)
    sending: Sending | TestLight
    if options["payload"] is None:
        sending = sending_of(*given)
        for row in weights:
            sending.check(row, screen.payload_symbols)
    else:
        is_both = any(value is not None for value in given)
        refuse((is_both, "--payload excludes PATH, --text and --uri", "give one of them"))
        sending = raw_sending(options["payload"], weights, options["seed"], options["same"])
    usual, seconds, n = sending.usual_bursts(screen.columns, screen.payload_symbols), options["seconds"], len(weights)
    n_bursts = options["bursts"] or (ceil(seconds / (screen.packet_s * screen.repeats)) if seconds else usual)
    reason = f"--weights {text} holds {n} bursts, {n_bursts} are sent"
    refuse((n not in (1, n_bursts), reason, f"give {n_bursts}, or --bursts"))
    return _Plan(sending, screen, weights, n_bursts, options["only_column"])


def _write_slots(plan: _Plan, out: Path, suffix: str) -> None:
    """Write slots in the format of a suffix; beside those without text a file that states rate and order."""
    screen, n_slots = plan.screen, plan.n_bursts * plan.burst_slots
    with click.open_file(str(out), "wb") as file:
        WRITERS[suffix](file, plan.slots(), n_slots, screen)
    if suffix in WITHOUT_TEXT:
        shape, bits = (n_slots, bytes_per_row(screen)), "column 0 is the most significant bit of the first byte"
        _readme_of(out).write_text(f"{out.name}: uint8 {shape}; {order_of(screen)}; {bits}.\n", encoding="utf-8")


def _readme_of(out: Path) -> Path:
    return out.with_name(out.name + ".README.txt")


def _weights(text: str, columns: int) -> NDArray[np.int64]:
    """(n, columns) weights of bursts that take turns."""
    data = None
    if text.endswith(".json"):
        with failure_explained(f"--weights {text}: cannot be read", "name a JSON file"):
            data = Path(text).read_bytes()
    reason = f"--weights {text}: no number, list of {columns} numbers, or JSON file of such lists"
    with failure_explained(reason, "give 1..9 for every column", UsageError):
        found = [int(part) for part in text.split(",")] if data is None else json.loads(data)
        values = np.asarray(found).astype(np.int64, casting="safe")
        weights = np.broadcast_to(values, (values.shape[0] if values.ndim == 2 else 1, columns))
    refuse((weights.min() < 1 or weights.max() > 9, f"--weights {text}: weights are 1 to 9", "choose from 1..9"))
    return weights


@dataclass(frozen=True, slots=True)
class _Plan:
    """What is sent."""

    sending: Sending | TestLight
    screen: ScreenProfile
    #: (n_bursts or 1, columns) lit slots of ten.
    weights: NDArray[np.int64]
    n_bursts: int
    #: The only column that sends; None for all.
    only_column: int | None

    @property
    def burst_slots(self) -> int:
        return self.screen.packet_slots * self.screen.repeats

    def _chunks(self) -> Iterator[tuple[NDArray[np.int64], NDArray[np.uint8]]]:
        """Numbers and labels (bursts, symbols, columns) of some bursts at a time."""
        assert not isinstance(self.sending, TestLight)
        for bursts in np.split(np.arange(self.n_bursts), range(_CHUNK, self.n_bursts, _CHUNK)):
            yield bursts, self.sending.labels(bursts, self.screen.columns, self.screen.payload_symbols)

    def write_labels(self, out: Path) -> None:
        """Write labels as an array."""
        shape = (self.n_bursts, self.screen.payload_symbols, self.screen.columns)
        target = np.lib.format.open_memmap(out, "w+", np.uint8, shape)
        for bursts, labels in self._chunks():
            target[bursts] = labels
        target.flush()

    def write_csv(self, out: Path) -> None:
        """Write labels as text, one row a symbol."""
        with click.open_file(str(out), "w", encoding="utf-8") as file:
            file.write("burst,symbol," + ",".join(f"column_{c}" for c in range(self.screen.columns)) + "\n")
            for bursts, labels in self._chunks():
                for index in np.ndindex(labels.shape[:2]):
                    file.write(f"{bursts[index[0]]},{index[1]},{','.join(map(str, labels[index]))}\n")

    def slots(self) -> Iterator[NDArray[np.uint8]]:
        """(slots, columns) 0/1 of some bursts at a time."""
        sends = np.array(self._sends, np.uint8)
        if isinstance(self.sending, TestLight):
            yield self.sending.slots(self.n_bursts * self.burst_slots)[:, None] * sends
            return
        for bursts, labels in self._chunks():
            weights = self.weights if len(self.weights) == 1 else self.weights[bursts]
            packets = packet_slots_of(labels, weights).transpose(0, 2, 1)
            yield np.tile(packets, (1, self.screen.repeats, 1)).reshape(-1, sends.size) * sends

    @property
    def _sends(self) -> list[bool]:
        """Which columns send."""
        return [self.only_column in (None, column) for column in range(self.screen.columns)]

    def truth(self) -> dict[str, Any]:
        """What is sent, as `decode --truth` reads it: bursts without frames."""
        screen, sends = self.screen, self._sends
        refuse((len(self.weights) > 1, "--truth needs one weight per column, for all bursts", "give --weights N"))
        rows = (row for _, labels in self._chunks() for row in payload_hex(labels, self.weights))
        bits = [payload_bits(int(w), screen.payload_symbols) for w in self.weights[0]]
        return {
            "screen": screen.name,
            **{name: getattr(screen, name) for name in ("columns", "slot_rate_hz", "payload_symbols", "repeats")},
            "w": self.weights[0].tolist(),
            "payload_bits": [*map(mul, bits, sends)],
            "frames": [],
            "payload": {burst: [*map(mul, row, sends)] for burst, row in enumerate(rows)},
            "written_by": "vlc-rx encode",
        }

    def summary(self) -> str:
        """What is sent, and how long a camera needs for a file."""
        screen, weights = self.screen, self.weights
        burst_s, n_bursts = screen.packet_s * screen.repeats, plural(self.n_bursts, "burst")
        sent = f"{self.sending.summary}; {n_bursts} of {screen.name}, {self.n_bursts * burst_s:.3g} s"
        if not isinstance(self.sending, FileSending):
            return sent
        bits = sum(visible_bits_of_burst(row, screen.payload_symbols) for row in weights) / len(weights)
        needed = self.sending.ready_bits / (bits * 31 / 32) * burst_s / _USUAL_READOUT
        return (
            f"{sent}\na camera that sees all columns for {_USUAL_READOUT:.0%} of the time needs about {needed:.1f} s, "
            f"and an announcement, which comes every {32 * burst_s:.2g} s; send on until it has come"
        )
