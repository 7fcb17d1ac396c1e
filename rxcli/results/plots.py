"""The light of columns over the rows, and the slots that were decided under it: what `inspect` draws."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rxcli.profiles import ScreenProfile
from rxcli.protocol import bits_per_symbol, encode_packet, hex_to_bits
from rxcli.receiver import camera as blind
from rxcli.receiver.decode import assemble
from rxcli.types import ColumnResult, FloatArray, Frame, FrameResult, PacketResult, RowProfiles


def in_time_order(
    frame: Frame, result: FrameResult, profiles: RowProfiles
) -> tuple[RowProfiles, tuple[ColumnResult, ...]]:
    """Row profiles and columns with rows counted as they were read out, not as software may have turned them."""
    if not result.estimated.get("readout_reversed", (0.0, 0.0))[0]:
        return profiles, result.columns
    columns = tuple(assemble.in_stored_rows(column, frame.height) for column in result.columns)
    return blind.in_time_order(profiles, frame.height), columns


def column_light(profiles: RowProfiles, column: int) -> tuple[FloatArray, FloatArray]:
    """Sensor rows (n,) and mean light (n,) of one column, where it is on the screen."""
    inside = profiles.inside[column]
    on_screen = inside.any(axis=0)
    light = (profiles.light[column] * inside).sum(axis=0)[on_screen] / inside.sum(axis=0)[on_screen]
    rows = profiles.rows.astype(np.float64) if profiles.sensor_row is None else profiles.sensor_row[column].mean(axis=0)
    return rows[on_screen], light.astype(np.float64)


def decided_slots(
    column: ColumnResult, screen: ScreenProfile, rows_per_slot: float, rows: FloatArray
) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """What each packet of a column says the slots were, over the copies that are visible.

    Args:
        column: the column.
        screen: its screen.
        rows_per_slot: sensor rows of a slot.
        rows: sensor rows on which the column is seen.

    Yields:
        Sensor row where the first slot starts, and the slots, 0 or 1.
    """
    if column.w is None or rows.size == 0 or not column.packets:
        return
    ends = [packet.first_row for packet in column.packets[1:]] + [float(rows.max())]
    for packet, end in zip(column.packets, ends, strict=True):
        slots = packet_slots_of(packet, column.w, screen)
        if slots is None:
            continue
        # Behind the copies that were counted, another burst may begin of which too little is seen.
        hidden = max(float(rows.min()) - packet.first_row, 0.0) / rows_per_slot
        longest = min(hidden + packet.copies * slots.size, screen.repeats * slots.size)
        n_slots = math.ceil(min((end - packet.first_row) / rows_per_slot, longest))
        if n_slots > 0:
            yield packet.first_row, np.resize(slots, n_slots)


def packet_slots_of(packet: PacketResult, w: int, screen: ScreenProfile) -> NDArray[np.uint8] | None:
    """The slots that would send `packet`, None where it is no packet of that weight and screen."""
    if packet.payload_bits != bits_per_symbol(w) * screen.payload_symbols:
        return None
    return encode_packet(hex_to_bits(packet.payload, packet.payload_bits), w)
