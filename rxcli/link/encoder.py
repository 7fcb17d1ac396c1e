"""Encoder for transmitters: messages and files to labels, and labels to slots."""

import zlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import UsageError
from rxcli.link import ldpc
from rxcli.link.formats import Announcement, beacon_body, pack_container, protect, protect_beacon
from rxcli.link.layout import (
    ANNOUNCEMENT_PERIOD,
    BLOCK_BYTES,
    LABEL_BITS,
    BeaconLayout,
    FileLayout,
    Places,
    announcement_layout,
    beacon_layout,
)
from rxcli.protocol import HEADER, bits_per_symbol, bits_to_hex, bits_to_indices, codebook, dimming_symbol, payload_bits
from rxcli.types import MessageKind

#: Information at which one photo suffices for a beacon, relative to its bits.
BEACON_NEED = 1.2
_LABEL_WEIGHTS = 1 << np.arange(LABEL_BITS - 1, -1, -1)
#: Blocks per encoding batch.
_BATCH = 64
#: Bursts of random payload or of a counter, unless more are asked for.
_RAW_BURSTS = 64

Labels = NDArray[np.uint8]


def _bits(data: bytes) -> NDArray[np.uint8]:
    return np.unpackbits(np.frombuffer(data, np.uint8))


def _labels(layout: BeaconLayout, protected: bytes, bursts: Places) -> Labels:
    """(n, N, C) uint8 labels of bursts `bursts` (n,) of a beacon or an announcement."""
    buffer = ldpc.encode(layout.code, _bits(protected)[None])[0]
    return np.asarray(buffer[layout.places[bursts % layout.period]] @ _LABEL_WEIGHTS, np.uint8)


@dataclass(frozen=True, slots=True)
class MessageSending:
    """A short message, sent as a beacon."""

    kind: MessageKind
    body: bytes

    def labels(self, bursts: Places, columns: int, payload_symbols: int) -> Labels:
        """(n, N, C) uint8 labels of bursts `bursts` (n,)."""
        return _labels(beacon_layout(len(self.body), columns, payload_symbols), protect_beacon(self.body), bursts)

    def check(self, weights: NDArray[np.int64], payload_symbols: int) -> None:
        """Refuse a message that a round of bursts cannot carry with these weights (C,).

        Raises:
            UsageError: the columns' weights leave too few bits.
        """
        layout = beacon_layout(len(self.body), len(weights), payload_symbols)
        bits, need = layout.period * visible_bits_of_burst(weights, payload_symbols), BEACON_NEED * layout.code.k
        if bits < need:
            raise UsageError(
                f"a message of this length needs {need:.0f} bits a round, these weights send {bits}",
                "shorten the message, brighten the columns towards w = 5, or send it as a file",
            )

    def usual_bursts(self, columns: int, payload_symbols: int) -> int:
        """Bursts of a round, after which the message repeats."""
        return beacon_layout(len(self.body), columns, payload_symbols).period

    @property
    def summary(self) -> str:
        """One line for people."""
        return f"a {self.kind} message in a beacon of {len(self.body)} bytes"


def message(text: str | bytes, kind: MessageKind = "text") -> MessageSending:
    """Create a beacon from a text, a URI or raw bytes.

    Raises:
        UsageError: it is empty, too long, or a text with a zero byte.
    """
    return MessageSending(kind, beacon_body(kind, text.encode("utf-8") if isinstance(text, str) else text))


class FileSending:
    """A file, with an announcement every 32 bursts.

    Args:
        container: the packed file.
        object_id: 0..0xFFFD.
        mother: 0, 1, 2 for mother rates 1/1.5, 1/2, 1/3.
        name: name in messages.

    Raises:
        UsageError: the object id is reserved or the container too long to announce.
    """

    def __init__(self, container: bytes, object_id: int, mother: int, name: str) -> None:
        if not 0 <= object_id < 0xFFFE:
            raise UsageError(f"an object id is 0 to 65533 (got {object_id})", "give another")
        if len(container) >= 1 << 32:
            raise UsageError(f"{name} has {len(container)} bytes; a file must stay below 4 GiB", "send parts of it")
        self.container, self.object_id, self.mother, self.name = container, object_id, mother, name
        self._crc = zlib.crc32(container)

    def layout(self, columns: int, payload_symbols: int) -> FileLayout:
        """Layout of the bits on a screen."""
        return FileLayout(self.object_id, len(self.container), self.mother, columns, payload_symbols)

    def labels(self, bursts: Places, columns: int, payload_symbols: int) -> Labels:
        """(n, N, C) uint8 labels of bursts `bursts` (n,)."""
        layout = self.layout(columns, payload_symbols)
        out = np.empty((len(bursts), payload_symbols, columns), np.uint8)
        announcing = bursts % ANNOUNCEMENT_PERIOD == 0
        for place in np.flatnonzero(announcing):
            burst = int(bursts[place])
            announcement = Announcement(self.mother, self.object_id, len(self.container), burst, self._crc)
            of_announcements = announcement_layout(columns, payload_symbols)
            out[place] = _labels(of_announcements, announcement.protected(), np.zeros(1, int))
        if not announcing.all():
            blocks, bits = layout.places(bursts[~announcing])
            packed = self._coded[blocks[..., None], bits >> 3]
            out[~announcing] = ((packed >> (7 - (bits & 7)).astype(np.uint8)) & 1) @ _LABEL_WEIGHTS
        return out

    def check(self, weights: NDArray[np.int64], payload_symbols: int) -> None:
        """Refuse a screen whose single bursts cannot carry an announcement with these weights (C,).

        Raises:
            UsageError: the columns' weights leave too few bits.
        """
        bits = visible_bits_of_burst(weights, payload_symbols)
        layout = announcement_layout(len(weights), payload_symbols)
        need = BEACON_NEED * layout.code.k
        if min(bits, layout.n_bits) < need:
            n_columns = int(np.ceil(need / max(bits / len(weights), 1)))
            raise UsageError(
                f"a file's announcement needs {need:.0f} bits in one burst, this screen sends {bits}",
                f"use at least {n_columns} such columns, longer packets, or brighter columns",
            )

    def usual_bursts(self, columns: int, payload_symbols: int) -> int:
        """Bursts of one pass, in which every coded bit is sent once."""
        layout = self.layout(columns, payload_symbols)
        data = -(-layout.n_blocks * layout.n_labels // (columns * payload_symbols))
        return data - (-data // (ANNOUNCEMENT_PERIOD - 1))

    @property
    def ready_bits(self) -> float:
        """Bits of information that a receiver needs for the complete file."""
        layout = self.layout(1, 1)
        return layout.ready * layout.n_blocks

    @cached_property
    def _coded(self) -> NDArray[np.uint8]:
        """(B, bytes) every block's coded bits, packed."""
        layout, size = self.layout(1, 1), min(len(self.container), BLOCK_BYTES)
        pieces = [self.container[i : i + size].ljust(size, b"\0") for i in range(0, len(self.container), size)]
        bits = [_bits(protect(piece, self.object_id, number)) for number, piece in enumerate(pieces)]
        batches = (np.stack(bits[i : i + _BATCH]) for i in range(0, len(bits), _BATCH))
        coded = (ldpc.encode(layout.code, batch)[:, : layout.n_bits] for batch in batches)
        return np.concatenate([np.packbits(batch, axis=1) for batch in coded])

    @property
    def summary(self) -> str:
        """One line for people."""
        layout = self.layout(1, 1)
        return (
            f"file {self.name}, container of {len(self.container)} bytes in {layout.n_blocks} "
            f"block{'s' * (layout.n_blocks > 1)}"
        )


@dataclass(frozen=True, slots=True, eq=False)
class RawSending:
    """Raw payload, as the paper sends it: burst by burst, within it column by column, over and over."""

    #: What is sent; None for random bits, or for a counter.
    content: bytes | None
    #: (n, C) lit slots of ten in bursts that take turns.
    weights: NDArray[np.int64]
    #: Seed of random bits; None: the number of the burst in 16 bits, over and over, in every column.
    seed: int | None = 0
    #: Whether all columns send the same.
    same: bool = False

    def labels(self, bursts: Places, columns: int, payload_symbols: int) -> Labels:
        """(n, N, C) uint8 labels of bursts `bursts` (n,)."""
        out = np.empty((len(bursts), payload_symbols, columns), np.uint8)
        for place, burst in enumerate(bursts.tolist()):
            weights = self.weights[burst % len(self.weights)].tolist()
            for column, (bits, w) in enumerate(zip(self._payload(burst, payload_symbols), weights, strict=True)):
                out[place, :, column] = bits_to_indices(bits, w) << (LABEL_BITS - bits_per_symbol(w))
        return out

    def _payload(self, burst: int, payload_symbols: int) -> list[NDArray[np.uint8]]:
        """Payload bits of a burst, by column."""
        sizes = self._sizes(burst, payload_symbols)
        total = self._burst_bits(burst, payload_symbols)
        if self.content is not None:
            turns = [self._burst_bits(turn, payload_symbols) for turn in range(len(self.weights))]
            start = burst // len(turns) * sum(turns) + sum(turns[: burst % len(turns)])
            bits = np.take(_bits(self.content), np.arange(start, start + total), mode="wrap")
        elif self.seed is not None:
            rng = np.random.Generator(np.random.Philox(np.random.SeedSequence([self.seed, burst])))
            bits = rng.integers(0, 2, total, dtype=np.uint8)
        else:
            number = _bits((burst % (1 << 16)).to_bytes(2, "big"))
            return [np.resize(number, size) for size in sizes]
        return [bits[:size] for size in sizes] if self.same else np.split(bits, np.cumsum(sizes)[:-1])

    def _sizes(self, burst: int, payload_symbols: int) -> list[int]:
        """Bits of a burst, by column."""
        return [payload_bits(int(w), payload_symbols) for w in self.weights[burst % len(self.weights)]]

    def _burst_bits(self, burst: int, payload_symbols: int) -> int:
        """Different bits of a burst."""
        return (max if self.same else sum)(self._sizes(burst, payload_symbols))

    def usual_bursts(self, columns: int, payload_symbols: int) -> int:
        """Bursts after which the payload begins anew; of random bits and a counter some."""
        if self.content is None or len(self.weights) > 1:
            return _RAW_BURSTS if len(self.weights) == 1 else len(self.weights)
        return -(-8 * len(self.content) // self._burst_bits(0, payload_symbols))

    @property
    def summary(self) -> str:
        """One line for people."""
        kind = "a counter" if self.content is None and self.seed is None else "raw payload"
        return f"{kind}, the same in all columns" if self.same or kind == "a counter" else kind


@dataclass(frozen=True, slots=True)
class TestLight:
    """Light without packets: of every four slots some lit ones, then dark ones."""

    n_lit: int

    def slots(self, n: int) -> NDArray[np.bool_]:
        """(n,) whether slots are lit."""
        return np.arange(n) % 4 < self.n_lit

    def usual_bursts(self, columns: int, payload_symbols: int) -> int:
        """Two, which have a multiple of four slots on any screen."""
        return 2

    @property
    def summary(self) -> str:
        """One line for people."""
        return f"light without packets, {self.n_lit} of four slots lit"


#: A continuous transmission.
Sending = MessageSending | FileSending | RawSending


def file_object(name: str, data: bytes, object_id: int | None = None, mother: int = 2) -> FileSending:
    """Create a file transmission; the default id is derived from its content.

    Raises:
        UsageError: the name or the id cannot be sent.
    """
    container = pack_container(name, data)
    if object_id is None:
        object_id = zlib.crc32(container) % 0xFFFE
    return FileSending(container, object_id, mother, name)


def payload_hex(labels: Labels, weights: NDArray[np.int64]) -> list[list[str]]:
    """Payload of every packet in hex, by burst and column, from labels (n, N, C) and weights (n or 1, C)."""
    sent = np.unpackbits(np.left_shift(labels, 1, dtype=np.uint8)[..., None], axis=-1)
    rows = np.broadcast_to(weights, (len(labels), weights.shape[-1]))
    return [
        [bits_to_hex(burst[:, column, : bits_per_symbol(int(w))].ravel()) for column, w in enumerate(row)]
        for burst, row in zip(sent, rows, strict=True)
    ]


# -- slots -------------------------------------------------------------------------------------------------------------


def packet_slots_of(labels: Labels, weights: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Slots of packets: header, dimming symbol and payload.

    Args:
        labels: (n, N, C) labels.
        weights: (n, C) or (C,) weight of every column, 1..9.

    Returns:
        (n, C, 20 + 10 N) uint8 of 0/1.

    Raises:
        ValueError: a weight is not in 1..9.
    """
    n, payload_symbols, columns = labels.shape
    weights = np.broadcast_to(weights, (n, columns))
    out = np.empty((n, columns, 2 + payload_symbols, len(HEADER)), np.uint8)
    out[:, :, 0] = HEADER
    for w in np.unique(weights):
        burst, column = np.nonzero(weights == w)
        index = labels[burst, :, column] >> (LABEL_BITS - bits_per_symbol(int(w)))
        out[burst, column, 1] = dimming_symbol(int(w))
        out[burst, column, 2:] = codebook(int(w))[index]
    return out.reshape(n, columns, -1)


# -- what can work -----------------------------------------------------------------------------------------------------


def visible_bits_of_burst(weights: NDArray[np.int64], payload_symbols: int) -> int:
    """Payload bits of one burst over all columns with weights (C,)."""
    return sum(payload_bits(int(w), payload_symbols) for w in weights)
