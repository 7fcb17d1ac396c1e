"""Turn posteriors into results: packets with confidence, column status, frame status."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rxcli.protocol import PREAMBLE_SLOTS, bits_per_symbol, indices_to_bits
from rxcli.receiver.decode.confidence import BurstInClip, Quality, clip_quality, confidence_features, still_quality
from rxcli.receiver.decode.settings import SETTINGS
from rxcli.types import (
    BELIEVABLE,
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
    SlotSamples,
)

_HEADERLESS = "no packet header shows where this screen's packets have one; "
_OVEREXPOSED = "the column is overexposed: expose shorter"
_OTHER_SCREEN = "the screen may be another one (--screen auto tries all), or its place wrong (--corners)"
_ECHO = "it shows nothing but the light of the column beside it; show a brighter picture there"


def column_results(
    clock: Clock,
    posteriors: BurstPosteriors,
    snr: Float32Array,
    samples: SlotSamples,
    slot_margin: Float32Array,
    headerless: BoolArray,
    min_confidence: float,
    denoised: frozenset[int] = frozenset(),
) -> tuple[ColumnResult, ...]:
    """Results of every column.

    Args:
        clock: the clock.
        posteriors: of B bursts and C columns.
        snr: (C, N) squared contrast over variance of every slot of the grid.
        samples: the samples, for what was visible.
        slot_margin: (C, N) see `detect.slot_margin`.
        headerless: (C,) columns without packets, see `find_headerless`.
        min_confidence: packets below it are left out.
        denoised: columns that were corrected by the auto-encoder.
    """
    n_observed = slots_observed(samples, clock)
    whole = complete(n_observed)
    was_denoised = np.isin(np.arange(len(snr)), list(denoised))
    by_burst = slot_margin_by_burst(slot_margin, clock)
    quality = still_quality(posteriors, confidence_features(posteriors, by_burst, was_denoised, samples.light.shape[1]))
    snr_db = snr_db_of_columns(snr)
    echoing: BoolArray = np.any(echoes(posteriors, snr_db) & whole, axis=0)
    reported = whole & quality.reported(min_confidence)
    against = [
        _headerless_reason(samples, column) if headerless[column] else _ECHO if echo else None
        for column, echo in enumerate(echoing)
    ]
    withheld = np.where(whole & quality.reported(0.0) & ~reported, quality.confidence, 0.0).max(axis=0)
    shown = reported & [not why for why in against]
    if not (quality.confidence[shown] >= SETTINGS.min_best_confidence).any():
        reported = np.zeros_like(reported)  # Light without data: an isolated packet is chance.
    packets = [_Packets.of(burst, clock, posteriors, counted, quality) for burst, counted in enumerate(n_observed)]
    return tuple(
        _column_result(
            column,
            clock,
            posteriors,
            db,
            n_observed[:, column],
            () if against[column] else _of_column(packets, reported, column),
            against[column],
            _withheld(withheld[column], min_confidence),
            bool(was_denoised[column]),
        )
        for column, db in enumerate(snr_db)
    )


def _of_column(packets: Sequence[_Packets], reported: BoolArray, column: int) -> tuple[PacketResult, ...]:
    """Reported packets of a column; `reported` is (B, C)."""
    return tuple(burst.result(column) for burst, shown in zip(packets, reported[:, column], strict=True) if shown)


def _headerless_reason(samples: SlotSamples, column: int) -> str:
    """Message for a column with slots but without header, which depends on whether it is overexposed."""
    light = samples.light[column][samples.valid[column] > 0]
    overexposed = light.size > 0 and float(np.mean(light >= SETTINGS.white_level)) > SETTINGS.overexposed_share
    return _HEADERLESS + (_OVEREXPOSED if overexposed else _OTHER_SCREEN)


def _withheld(confidence: float, min_confidence: float) -> str | None:
    """Message for a column whose surest packet is below the minimum confidence, or None."""
    if not 0 < confidence < min_confidence:
        return None
    return f"its packet has a confidence of {confidence:.4f}, below the {min_confidence:g} asked for (--min-confidence)"


def clip_results(
    clock: Clock, bursts: Sequence[BurstInClip], going_on: Float32Array, snr: Float32Array, min_confidence: float
) -> tuple[ColumnResult, ...]:
    """Results of every column in a frame of a clip.

    Args:
        clock: the clock.
        bursts: bursts that end in this frame, in time order.
        going_on: (C,) confidence of the best packet that the next frame will report.
        snr: (C, N) squared contrast over variance of every slot of the grid.
        min_confidence: packets below it are left out.
    """
    snr_db = snr_db_of_columns(snr)
    qualities = [clip_quality(burst) for burst in bursts]
    whole = [complete(burst.n_observed[None])[0] for burst in bursts]
    reported = [
        (is_complete & ~echoes(burst.posteriors, snr_db)[0] & quality.reported(min_confidence)[0]).tolist()
        for burst, is_complete, quality in zip(bursts, whole, qualities, strict=True)
    ]
    withheld = np.zeros(len(snr_db))
    for is_complete, quality in zip(whole, qualities, strict=True):
        surest = np.where(is_complete & (quality.ber_hat[0] <= SETTINGS.max_ber_hat), quality.confidence[0], 0.0)
        withheld = np.maximum(withheld, surest)
    own = [replace(clock, burst=np.where(clock.burst == burst.index, 0, 1)) for burst in bursts]
    packets_by_burst = [
        _Packets.of(0, clock, burst.posteriors, burst.n_observed, quality)
        for burst, clock, quality in zip(bursts, own, qualities, strict=True)
    ]
    out = []
    for column, db in enumerate(snr_db):
        packets = tuple(
            each.result(column, burst.number, burst.frames)
            for burst, each, shown in zip(bursts, packets_by_burst, reported, strict=True)
            if shown[column]
        )
        result = _clip_column(column, clock, bursts, float(going_on[column]), db, packets)
        if not packets and result.status != "ok" and (message := _withheld(float(withheld[column]), min_confidence)):
            result = replace(result, message=message)
        out.append(result)
    return tuple(out)


def _clip_column(
    column: int,
    clock: Clock,
    bursts: Sequence[BurstInClip],
    going_on: float,
    snr_db: float | None,
    packets: tuple[PacketResult, ...],
) -> ColumnResult:
    status = _column_status(packets, snr_db)
    if not packets and going_on >= BELIEVABLE:
        status = "ok"
    message = None
    if not packets:
        message = _clip_reason(status, snr_db, [burst.n_observed[column] for burst in bursts])
    return ColumnResult(
        column=column,
        status=status,
        w=_weight_of_best(column, packets, bursts),
        snr_db=snr_db,
        delay_slots=float(clock.delay_slots[column]),
        packets=packets,
        message=message,
    )


def snr_db_of_columns(snr: Float32Array) -> list[float | None]:
    """Median signal-to-noise ratio of each column's visible slots, dB; None where nothing is visible."""
    if (snr > 0).all():
        median = snr[:, 0] if snr.shape[1] == 1 else np.median(snr, axis=1)
        return [float(db) for db in 10 * np.log10(np.maximum(median, 1e-6))]
    return [_snr_db(column) for column in snr]


def _weight_of_best(column: int, packets: Sequence[PacketResult], bursts: Sequence[BurstInClip]) -> int | None:
    """Weight of a column's surest packet, or None: without a packet the weight is not reliable."""
    if not packets:
        return None
    number = max(packets, key=lambda packet: packet.confidence).burst
    return next(int(burst.posteriors.w[column]) for burst in bursts if burst.number == number)


def _clip_reason(status: ColumnStatus, snr_db: float | None, n_observed: list[IntArray]) -> str:
    if status == "ok" or not n_observed:
        return "its burst goes on in the next frame and is reported there"
    return _incomplete_reason(np.stack(n_observed)) or _light_reason(status, snr_db)


def _snr_db(snr: Float32Array) -> float | None:
    lit = snr[snr > 0]
    return float(10 * np.log10(max(float(np.median(lit)), 1e-6))) if lit.size else None


def all_dark(snr: Float32Array) -> bool:
    """Whether no column has enough light; `snr` (C, N) is squared contrast over variance of every slot."""
    return all(db is None or db < SETTINGS.dark_snr_db for db in snr_db_of_columns(snr))


def clip_status(columns: tuple[ColumnResult, ...]) -> FrameStatus:
    """`ok` when every lit column has a packet, here or in a later frame; `partial` when some have none."""
    return "ok" if all(column.status in ("ok", "weak", "dark") for column in columns) else "partial"


def why_no_packet(columns: tuple[ColumnResult, ...]) -> str:
    """Message of a frame without packets: the reason of its clearest column."""
    clearest = max(columns, key=lambda column: -np.inf if column.snr_db is None else column.snr_db)
    return f"no column gave a packet; column {clearest.column} is the clearest: {clearest.message}"


def frame_status(columns: tuple[ColumnResult, ...]) -> FrameStatus:
    """`ok` when every lit column gave a packet, `partial` when some did, `no_signal` when none did."""
    lit = [column for column in columns if column.status != "dark"]
    with_packet = [column for column in columns if column.packets]
    if not with_packet:
        return "no_signal"
    return "ok" if all(column.packets for column in lit) else "partial"


def slots_observed(samples: SlotSamples, clock: Clock) -> IntArray:
    """(B, C, packet) number of copies in which the middle of each slot is on the screen and in the picture."""
    q = samples.samples_per_slot
    shown = samples.valid[..., q // 2 :: q].max(axis=1) > 0
    by_copy = clock.to_copies(shown.astype(np.int64))
    return np.stack([by_copy[:, clock.burst == burst].sum(axis=1) for burst in range(int(clock.burst.max()) + 1)])


def complete(n_observed: IntArray) -> BoolArray:
    """(B, C) whether every payload slot was observed, so that the packet can be reported.

    Args:
        n_observed: (B, C, packet) from `slots_observed`.
    """
    return np.asarray((n_observed[:, :, PREAMBLE_SLOTS:] > 0).all(axis=2))


def _column_result(
    column: int,
    clock: Clock,
    posteriors: BurstPosteriors,
    snr_db: float | None,
    n_observed: IntArray,
    packets: tuple[PacketResult, ...],
    against: str | None,
    withheld: str | None,
    denoised: bool,
) -> ColumnResult:
    sure_of_w = not against and posteriors.w_log_prob[column].max() > np.log(SETTINGS.min_weight_probability)
    status = _column_status(packets, snr_db)
    return ColumnResult(
        column=column,
        status=status,
        w=int(posteriors.w[column]) if packets or sure_of_w else None,
        snr_db=snr_db,
        denoised=denoised,
        delay_slots=float(clock.delay_slots[column]),
        packets=packets,
        message=None
        if packets
        else _incomplete_reason(n_observed) or against or withheld or _light_reason(status, snr_db),
    )


def echoes(posteriors: BurstPosteriors, snr_db: Sequence[float | None]) -> BoolArray:
    """(B, C) whether a column repeats the words of a brighter neighbour that no other column sends.

    A column under a black picture shows its neighbour's light. If all columns send the same, more than two agree.
    """
    words = np.concatenate(
        [np.broadcast_to(posteriors.w[:, None], (*posteriors.index.shape[:2], 1)), posteriors.index], 2
    )
    like_next = (words[:, 1:] == words[:, :-1]).all(axis=2)
    beside = np.zeros(words.shape[:2], bool)
    if not like_next.any():
        return beside
    two = (words[:, :, None] == words[:, None]).all(axis=3).sum(axis=2) == 2
    db = np.array([-np.inf if value is None else value for value in snr_db])
    beside[:, 1:] |= like_next & (db[1:] < db[:-1])
    beside[:, :-1] |= like_next & (db[:-1] < db[1:])
    return np.asarray(two & beside)


def find_headerless(header_llr: FloatArray) -> BoolArray:
    """(C,) columns without a header; all columns if they have none together.

    Args:
        header_llr: (B, C) of bursts, see `BurstPosteriors`.
    """
    # Glare may hide one header; a good one elsewhere outweighs it.
    by_column = np.maximum(header_llr, -SETTINGS.max_header_llr).sum(axis=0)
    together = np.maximum(by_column, -SETTINGS.max_header_llr).sum() > SETTINGS.min_total_header_llr
    return np.asarray(by_column < (SETTINGS.min_header_llr if together else np.inf), bool)


def drop_headerless_packets(columns: tuple[ColumnResult, ...], headerless: BoolArray) -> tuple[ColumnResult, ...]:
    """Drop the packets of the headerless columns (C,) of a clip."""
    message = _HEADERLESS + _OTHER_SCREEN
    return tuple(
        replace(column, packets=(), w=None, status="no_packet", message=message) if out and column.packets else column
        for column, out in zip(columns, headerless, strict=True)
    )


def _column_status(packets: tuple[PacketResult, ...], snr_db: float | None) -> ColumnStatus:
    if packets:
        return "ok" if any(packet.is_believable for packet in packets) else "weak"
    return "dark" if snr_db is None or snr_db < SETTINGS.dark_snr_db else "no_packet"


def _incomplete_reason(n_observed: IntArray) -> str | None:
    """Message for a column without a complete packet, or None; `n_observed` is (B, packet)."""
    missing = int((n_observed[:, PREAMBLE_SLOTS:] == 0).sum(axis=1).min())
    if not missing:
        return None
    return (
        f"no packet is in view as a whole: of {n_observed.shape[1]} slots {missing} are missing; move closer so that "
        "the screen fills more of the height, or take another picture"
    )


def _light_reason(status: ColumnStatus, snr_db: float | None) -> str:
    if status == "dark" or snr_db is None:
        return "too little light under this column; show a brighter picture or raise the exposure"
    return f"too many slots are uncertain at {snr_db:.1f} dB; show a brighter picture or hold the camera closer"


@dataclass(frozen=True, slots=True)
class _Packets:
    """The packets of one burst in all columns, computed together because clips have many."""

    payload: list[str]
    n_bits: list[int]
    copies: list[float]
    first_row: list[float]
    confidence: list[float]
    ber_hat: list[float]
    features: list[list[float]]

    @classmethod
    def of(
        cls, burst: int, clock: Clock, posteriors: BurstPosteriors, n_observed: IntArray, quality: Quality
    ) -> _Packets:
        """Collect the packets of a burst; `n_observed` is (C, packet)."""
        bits = [bits_per_symbol(w) for w in posteriors.w.tolist()]
        copy = int((clock.burst == burst).argmax())
        n_symbols = posteriors.index.shape[2]
        return cls(
            payload=_payloads(posteriors.index[burst], posteriors.w),
            n_bits=[k * n_symbols for k in bits],
            copies=(n_observed.sum(axis=1) / clock.packet_slots).tolist(),
            first_row=_header_rows(copy, clock).tolist(),
            confidence=quality.confidence[burst].tolist(),
            ber_hat=quality.ber_hat[burst].tolist(),
            features=quality.confidence_features[burst].tolist(),
        )

    def result(self, column: int, number: int | None = None, frames: tuple[int, ...] | None = None) -> PacketResult:
        """Result of a column's packet; in clips with its burst number and the frames that show it."""
        return PacketResult(
            first_row=self.first_row[column],
            copies=self.copies[column],
            payload_bits=self.n_bits[column],
            payload=self.payload[column],
            confidence=self.confidence[column],
            ber_hat=self.ber_hat[column],
            burst=number,
            frames=frames,
            confidence_features=tuple(self.features[column]),
        )


def _payloads(index: IntArray, weights: IntArray) -> list[str]:
    """Payload of every column in hex, from codebook indices (C, N) and weights (C,)."""
    payload = [""] * len(index)
    for w in set(weights.tolist()):
        columns = np.flatnonzero(weights == w)
        bits = indices_to_bits(index[columns].ravel(), w).reshape(columns.size, -1)
        for column, packed in zip(columns.tolist(), np.packbits(bits, axis=1), strict=True):
            payload[column] = packed.tobytes().hex()
    return payload


def slot_margin_by_burst(slot_margin: Float32Array, clock: Clock) -> Float32Array:
    """(B, C, N) margins (C, N) of each burst's payload slots, 0 elsewhere on the grid."""
    slot = np.arange(clock.first_slot, clock.first_slot + clock.n_slots)
    payload = slot % clock.packet_slots >= PREAMBLE_SLOTS
    bursts = np.arange(int(clock.burst.max()) + 1)
    payload_of = payload & (clock.burst[slot // clock.packet_slots] == bursts[:, None])
    return np.asarray(payload_of[:, None] * slot_margin)


def with_certainty(
    columns: tuple[ColumnResult, ...], certainty: float, min_confidence: float
) -> tuple[ColumnResult, ...]:
    """Reduce the confidence of packets by the certainty of the column numbers.

    Args:
        columns: results as if their numbers were beyond doubt.
        certainty: probability that they are right.
        min_confidence: packets below it are left out.
    """
    if certainty >= 1:
        return columns
    return tuple(_doubted(column, certainty, min_confidence) for column in columns)


def _doubted(column: ColumnResult, certainty: float, min_confidence: float) -> ColumnResult:
    packets = tuple(replace(packet, confidence=certainty * packet.confidence) for packet in column.packets)
    reported = tuple(packet for packet in packets if packet.confidence >= min_confidence)
    status = column.status
    if status in ("ok", "weak"):
        status = _column_status(reported, column.snr_db)
    return replace(column, packets=reported, status=status)


def _header_rows(copy: int, clock: Clock) -> FloatArray:
    """(C,) sensor row whose exposure starts with the header of `copy`."""
    slots = copy * clock.packet_slots - clock.first_slot + clock.delay_slots + clock.exposure_slots / 2
    return np.asarray(clock.row0 + slots * clock.rows_per_slot)


def in_stored_rows(column: ColumnResult, height: int) -> ColumnResult:
    """The column with rows as stored, where they were counted in readout order."""
    packets = (replace(packet, first_row=height - 1 - packet.first_row) for packet in column.packets)
    return replace(column, packets=tuple(packets))
