"""Turn posteriors into results: packets with confidence, column status, frame status."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rxcli.numerics import TINY
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, bits_per_symbol, indices_to_bits
from rxcli.receiver.decode.confidence import BurstInView, quality_of
from rxcli.receiver.decode.settings import SETTINGS
from rxcli.types import (
    BoolArray,
    BurstPosteriors,
    Clock,
    ColumnResult,
    ColumnStatus,
    Float32Array,
    FloatArray,
    FrameStatus,
    IntArray,
    PacketResult,
    Remark,
    SlotSamples,
)


@dataclass(frozen=True)
class FrameColumns:
    """What is known of a frame's columns beside their packets."""

    clock: Clock
    #: (C, N) squared contrast over variance of every slot of the grid.
    snr: Float32Array
    #: (C,) columns without packets, see `find_headerless`.
    headerless: BoolArray
    #: Packets below it are left out.
    min_confidence: float
    #: Probability that the columns' numbers are right.
    certainty: float = 1.0
    #: (B,) probability that the slots of each burst are one packet; None: certain.
    framing: FloatArray | None = None

    @cached_property
    def snr_db(self) -> list[float | None]:
        """See `snr_db_of_columns`."""
        return snr_db_of_columns(self.snr)


def column_results(
    frame: FrameColumns,
    posteriors: BurstPosteriors,
    n_observed: IntArray,
    confidence_features: FloatArray,
    denoised: frozenset[int] = frozenset(),
) -> tuple[ColumnResult, ...]:
    """Results of every column of a photograph.

    Args:
        frame: the columns.
        posteriors: of B bursts and C columns.
        n_observed: (B, C, packet) see `slots_observed`.
        confidence_features: (B, C, 11) of the packets.
        denoised: columns that were corrected by the auto-encoder.
    """
    bursts = [
        _burst(frame, BurstInView(None, index, posteriors.of_burst(index), observed, None, features))
        for index, (observed, features) in enumerate(zip(n_observed, confidence_features, strict=True))
    ]
    least = SETTINGS.min_best_confidence * frame.certainty
    sure = (burst.possible & ~frame.headerless & (burst.confidence >= least) for burst in bursts)
    if not any(columns.any() for columns in sure):
        # Light without data: an isolated packet is chance.
        bursts = [replace(burst, possible=np.zeros_like(burst.possible)) for burst in bursts]
    columns = _columns(frame, bursts, lambda column: False)
    return tuple(replace(column, denoised=column.column in denoised) for column in columns)


def clip_results(
    frame: FrameColumns, bursts: Sequence[BurstInView], goes_on: Callable[[int], bool]
) -> tuple[ColumnResult, ...]:
    """Results of every column in a frame of a clip.

    Args:
        frame: the columns.
        bursts: bursts that end in this frame, in time order.
        goes_on: whether the next frame will report a packet of a column.
    """
    return _columns(frame, [_burst(frame, burst) for burst in bursts], goes_on)


@dataclass(frozen=True, slots=True)
class _Burst:
    """Packets of one burst in all C columns."""

    packets: list[PacketResult]
    #: (C,) their confidence; weights, and (C, packet) how often each slot was observed.
    confidence: FloatArray
    w: IntArray
    n_observed: IntArray
    #: (C,) whether a column's packet is in view, repeats its neighbour's, and may be reported.
    whole: BoolArray
    echo: BoolArray
    possible: BoolArray


def _burst(frame: FrameColumns, shown: BurstInView) -> _Burst:
    """Packets of a burst."""
    clock, posteriors, n_observed, quality = frame.clock, shown.posteriors, shown.n_observed, quality_of(shown)
    # A sum of probabilities may be rounded to more than 1.
    framing = 1.0 if frame.framing is None else min(float(frame.framing[shown.index]), 1.0)
    confidence = frame.certainty * framing * quality.confidence
    packets = [
        PacketResult(
            first_row=first_row,
            copies=n_copies,
            payload_bits=bits_per_symbol(w) * posteriors.index.shape[2],
            payload=payload,
            confidence=probability,
            ber_hat=ber_hat,
            burst=shown.number,
            frames=shown.frames,
            confidence_features=tuple(features),
        )
        for first_row, n_copies, w, payload, probability, ber_hat, features in zip(
            _header_rows(int((clock.burst == shown.index).argmax()), clock).tolist(),
            (n_observed.sum(axis=1) / clock.packet_slots).tolist(),
            posteriors.w.tolist(),
            _payloads(posteriors.index[0], posteriors.w),
            confidence.tolist(),
            (framing * quality.ber_hat + (1 - framing) / 2).tolist(),
            quality.confidence_features.tolist(),
            strict=True,
        )
    ]
    # In a clip, a later frame shows what is missing.
    whole = complete(n_observed, 0 if shown.frames else SETTINGS.max_missing_slots)
    echo = whole & echoes(posteriors, frame.snr_db)[0]
    possible = whole & ~echo & (quality.ber_hat <= SETTINGS.max_ber_hat)
    return _Burst(packets, confidence, posteriors.w, n_observed, whole, echo, possible)


def _payloads(index: IntArray, weights: IntArray) -> list[str]:
    """Payload of every column in hex, from codebook indices (C, N) and weights (C,)."""
    payload = [""] * len(index)
    for w in set(weights.tolist()):
        columns = np.flatnonzero(weights == w)
        bits = indices_to_bits(index[columns].ravel(), w).reshape(columns.size, -1)
        for column, packed in zip(columns.tolist(), np.packbits(bits, axis=1), strict=True):
            payload[column] = packed.tobytes().hex()
    return payload


def _header_rows(copy: int, clock: Clock) -> FloatArray:
    """(C,) sensor row whose exposure starts with the header of `copy`."""
    slots = copy * clock.packet_slots - clock.first_slot + clock.delay_slots + clock.exposure_slots / 2
    return np.asarray(clock.row0 + slots * clock.rows_per_slot)


def _columns(frame: FrameColumns, bursts: Sequence[_Burst], goes_on: Callable[[int], bool]) -> tuple[ColumnResult, ...]:
    """Results of every column; a column that `goes_on` has packets in the next frame."""
    out, headerless, min_confidence = [], frame.headerless, frame.min_confidence
    for column, db in enumerate(frame.snr_db):
        possible = [burst for burst in bursts if burst.possible[column] and not headerless[column]]
        reported = [burst for burst in possible if burst.packets[column].confidence >= min_confidence]
        packets = tuple(burst.packets[column] for burst in reported)
        confidence = max((burst.packets[column].confidence for burst in possible), default=0.0)
        status = _column_status(packets, db)
        if not packets and not headerless[column] and goes_on(column):
            status = "ok"
        if packets:
            remark = None
        elif status == "ok" or not bursts:
            remark = Remark("goes_on")
        else:
            remark = Remark("echo") if any(burst.echo[column] for burst in bursts) else None
            remark = remark or _withheld(confidence, min_confidence)
            remark = Remark("headerless") if headerless[column] else remark
            if any(burst.whole[column] for burst in bursts):
                remark = remark or _light_reason(status, db)
            else:
                remark = _incomplete_reason(np.stack([burst.n_observed[column] for burst in bursts]))
        out.append(
            ColumnResult(
                column=column,
                status=status,
                # Without a packet the weight is not reliable.
                w=next((int(b.w[column]) for b in reported if b.packets[column].confidence == confidence), None),
                snr_db=db,
                delay_slots=float(frame.clock.delay_slots[column]),
                packets=packets,
                remark=remark,
            )
        )
    return tuple(out)


def _withheld(confidence: float, min_confidence: float) -> Remark | None:
    """Remark on a column whose surest packet is below the minimum confidence, or None."""
    if not 0 < confidence < min_confidence:
        return None
    return Remark("withheld", {"confidence": confidence, "min_confidence": min_confidence})


def _incomplete_reason(n_observed: IntArray) -> Remark:
    """Remark on a column without a complete packet; `n_observed` is (B, packet)."""
    if not n_observed.any():
        return Remark("out_of_view")
    missing = int((n_observed[:, PREAMBLE_SLOTS:] == 0).sum(axis=1).min())
    facts = {"slots": n_observed.shape[1], "missing": missing, "share": float((n_observed > 0).mean(axis=1).max())}
    return Remark("incomplete", facts)


def _light_reason(status: ColumnStatus, snr_db: float | None) -> Remark:
    return Remark("dark") if status == "dark" or snr_db is None else Remark("uncertain", {"snr_db": snr_db})


def _column_status(packets: tuple[PacketResult, ...], snr_db: float | None) -> ColumnStatus:
    if packets:
        return "ok" if any(packet.is_believable for packet in packets) else "weak"
    return "dark" if snr_db is None or snr_db < SETTINGS.dark_snr_db else "no_packet"


def snr_db_of_columns(snr: Float32Array) -> list[float | None]:
    """Median signal-to-noise ratio of each column's visible slots, dB; None where nothing is visible."""
    brightest_first, n_visible = -np.sort(-snr, axis=1), np.count_nonzero(snr > 0, axis=1)
    middle = np.take_along_axis(brightest_first, np.stack([(n_visible - 1) // 2, n_visible // 2], axis=1), axis=1)
    db = 10 * np.log10(np.maximum(middle.mean(axis=1), TINY))
    return [float(value) if n else None for value, n in zip(db.tolist(), n_visible.tolist(), strict=True)]


def all_dark(snr: Float32Array) -> bool:
    """Whether no column has enough light; `snr` (C, N) is squared contrast over variance of every slot."""
    return all(db is None or db < SETTINGS.dark_snr_db for db in snr_db_of_columns(snr))


def clip_status(columns: tuple[ColumnResult, ...]) -> FrameStatus:
    """`ok` when every lit column has a packet, here or in a later frame; `partial` when some have none."""
    return "ok" if all(column.status in ("ok", "weak", "dark") for column in columns) else "partial"


def why_no_packet(columns: tuple[ColumnResult, ...]) -> Remark:
    """Remark on a frame without packets: the reason of its clearest column."""
    clearest = max(columns, key=lambda column: -np.inf if column.snr_db is None else column.snr_db)
    return Remark("no_column", {"column": clearest.column, "why": clearest.remark})


def frame_status(columns: tuple[ColumnResult, ...]) -> FrameStatus:
    """`ok` when every lit column gave a packet, `partial` when some did, `no_signal` when none did."""
    return clip_status(columns) if any(column.packets for column in columns) else "no_signal"


def slots_observed(samples: SlotSamples, clock: Clock) -> IntArray:
    """(B, C, packet) number of copies in which the middle of each slot is on the screen and in the picture."""
    q = samples.samples_per_slot
    shown = samples.valid[..., q // 2 :: q].max(axis=1) > 0
    return clock.by_burst(shown.astype(np.int64))


def in_view(n_observed: IntArray, max_missing: int = 0) -> BoolArray:
    """(..., C, N) whether symbols of the payload were observed, from the counts (..., C, packet) of `slots_observed`.

    They may miss up to `max_missing` slots: their weight is known, so that mostly one word fits the rest.
    """
    missing = n_observed[..., PREAMBLE_SLOTS:] == 0
    return np.asarray(missing.reshape(*missing.shape[:-1], -1, SLOTS_PER_SYMBOL).sum(axis=-1) <= max_missing)


def complete(n_observed: IntArray, max_missing: int = 0) -> BoolArray:
    """(..., C) whether the whole payload was observed, see `in_view`."""
    return np.asarray(in_view(n_observed, max_missing).all(axis=-1))


def echoes(posteriors: BurstPosteriors, snr_db: Sequence[float | None]) -> BoolArray:
    """(B, C) whether a column repeats the words of a brighter neighbour that no other column sends.

    A column under a black picture shows its neighbour's light. If all columns send the same, more agree than a
    column and both its neighbours.
    """
    words = np.concatenate(
        [np.broadcast_to(posteriors.w[:, None], (*posteriors.index.shape[:2], 1)), posteriors.index], 2
    )
    like_next = (words[:, 1:] == words[:, :-1]).all(axis=2)
    beside = np.zeros(words.shape[:2], bool)
    if not like_next.any():
        return beside
    few = (words[:, :, None] == words[:, None]).all(axis=-1).sum(axis=-1) <= 3
    db = np.array([-np.inf if value is None else value for value in snr_db])
    beside[:, 1:] |= like_next & (db[1:] < db[:-1])
    beside[:, :-1] |= like_next & (db[:-1] < db[1:])
    return np.asarray(few & beside)


def find_headerless(header_llr: FloatArray) -> BoolArray:
    """(C,) columns without a header; all columns if they have none together.

    Args:
        header_llr: (B, C) of bursts, see `BurstPosteriors`.
    """
    # Glare may hide one header; a good one elsewhere outweighs it.
    by_column = np.maximum(header_llr, -SETTINGS.max_llr).sum(axis=0)
    together = np.maximum(by_column, -SETTINGS.max_llr).sum() > SETTINGS.max_llr
    return np.asarray(by_column < (SETTINGS.min_header_llr if together else np.inf), bool)


def slot_margin_by_burst(slot_margin: Float32Array, clock: Clock) -> Float32Array:
    """(B, C, N) margins (C, N) of each burst's payload slots, 0 elsewhere on the grid."""
    slot = np.arange(clock.first_slot, clock.first_slot + clock.n_slots)
    payload = slot % clock.packet_slots >= PREAMBLE_SLOTS
    bursts = np.arange(int(clock.burst.max()) + 1)
    payload_of = payload & (clock.burst[slot // clock.packet_slots] == bursts[:, None])
    return np.asarray(payload_of[:, None] * slot_margin)


def in_stored_rows(column: ColumnResult, height: int) -> ColumnResult:
    """The column with rows as stored, where they were counted in readout order."""
    packets = (replace(packet, first_row=height - 1 - packet.first_row) for packet in column.packets)
    return replace(column, packets=tuple(packets))
