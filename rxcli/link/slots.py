"""Slots as files for transmitters: arbitrary waveform generators, logic generators, microcontrollers, viewers.

Every format has one row a slot, first sent first. Bits are packed with column 0, the viewer's leftmost, as the most
significant bit of the first byte; 1 is lit.
"""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from rxcli.errors import InputError, UsageError
from rxcli.profiles import ScreenProfile

Slots = NDArray[np.uint8]
_Write = Callable[[IO[bytes], Iterable[Slots], int, ScreenProfile], None]


def order_of(screen: ScreenProfile) -> str:
    """Rate and order of the slots, for people."""
    return (
        f"one row a slot at {screen.slot_rate_hz:g} Hz, first sent first; {screen.columns} columns, column 0 is the "
        "viewer's leftmost; 1 is lit"
    )


def bytes_per_row(screen: ScreenProfile) -> int:
    """Bytes of a row of packed bits."""
    return -(-screen.columns // 8)


def _write_csv(file: IO[bytes], chunks: Iterable[Slots], n_slots: int, screen: ScreenProfile) -> None:
    names = ",".join(f"column_{column}" for column in range(screen.columns))
    file.write(f"# {n_slots} slots; {order_of(screen)}\n{names}\n".encode())
    for slots in chunks:
        text = np.full((len(slots), 2 * screen.columns), ord(","), np.uint8)
        text[:, ::2], text[:, -1] = slots + ord("0"), ord("\n")
        file.write(text.tobytes())


def _write_npy(file: IO[bytes], chunks: Iterable[Slots], n_slots: int, screen: ScreenProfile) -> None:
    header = {"descr": "|u1", "fortran_order": False, "shape": (n_slots, bytes_per_row(screen))}
    np.lib.format.write_array_header_1_0(file, header)
    _write_bin(file, chunks, n_slots, screen)


def _write_bin(file: IO[bytes], chunks: Iterable[Slots], n_slots: int, screen: ScreenProfile) -> None:
    for slots in chunks:
        file.write(np.packbits(slots, axis=1).tobytes())


def _write_header(file: IO[bytes], chunks: Iterable[Slots], n_slots: int, screen: ScreenProfile) -> None:
    width = bytes_per_row(screen)
    file.write(
        f"/* {order_of(screen)};\n   column 0 is the most significant bit of the first byte. */\n#include <stdint.h>\n"
        f"#define VLC_SLOT_RATE_HZ {screen.slot_rate_hz:g}\n#define VLC_COLUMNS {screen.columns}\n"
        f"#define VLC_BYTES {width}\n#define VLC_SLOTS {n_slots}\n"
        "#ifndef VLC_STORAGE\n#define VLC_STORAGE\n#endif\n"
        "static const uint8_t vlc_slots[VLC_SLOTS][VLC_BYTES] VLC_STORAGE = {\n".encode()
    )
    for slots in chunks:
        rows = (",".join(f"0x{byte:02x}" for byte in row) for row in np.packbits(slots, axis=1).tolist())
        file.write("".join(f"{{{row}}},\n" for row in rows).encode())
    file.write(b"};\n")


def _write_vcd(file: IO[bytes], chunks: Iterable[Slots], n_slots: int, screen: ScreenProfile) -> None:
    names = [f"c{column}" for column in range(screen.columns)]
    variables = "".join(f"$var wire 1 {name} column_{name[1:]} $end\n" for name in names)
    file.write(f"$comment {order_of(screen)} $end\n$timescale 1 ns $end\n{variables}$enddefinitions $end\n".encode())
    shown, start = np.full(screen.columns, 2, np.uint8), 0
    for slots in chunks:
        changed = slots != np.concatenate([shown[None], slots[:-1]])
        for number in np.flatnonzero(changed.any(axis=1)).tolist():
            states = "".join(f"{slots[number, column]}{names[column]}\n" for column in np.flatnonzero(changed[number]))
            file.write(f"#{_time_ns(start + number, screen)}\n{states}".encode())
        shown, start = slots[-1], start + len(slots)
    file.write(f"#{_time_ns(n_slots, screen)}\n".encode())


def _time_ns(slot: int, screen: ScreenProfile) -> int:
    return round(slot * 1e9 / screen.slot_rate_hz)


#: Writers by suffix. They take a file open for writing, chunks (n, C) uint8 of 0/1 in order, their sum of n, a screen.
WRITERS: dict[str, _Write] = {
    ".csv": _write_csv,
    ".npy": _write_npy,
    ".bin": _write_bin,
    ".h": _write_header,
    ".vcd": _write_vcd,
}
#: Formats that hold no text: rate and order stand in a file beside them.
WITHOUT_TEXT = (".npy", ".bin")


def read_slots(path: Path, screen: ScreenProfile) -> Slots:
    """Slots (n, C) of a .csv, .npy or .bin file.

    Raises:
        UsageError: another format.
        InputError: it cannot be read, or holds no slots of this screen.
    """
    width = bytes_per_row(screen)
    try:
        if path.suffix == ".csv":
            rows = path.read_text(encoding="ascii").splitlines()[2:]
            slots = np.array([row.split(",") for row in rows], np.uint8)
        elif path.suffix in WITHOUT_TEXT:
            packed = np.load(path) if path.suffix == ".npy" else np.fromfile(path, np.uint8).reshape(-1, width)
            slots = np.unpackbits(packed, axis=1)[:, : screen.columns] if packed.shape[1:] == (width,) else packed
        else:
            raise UsageError(f"{path}: slots are read from .csv, .npy and .bin", "write them in one of these formats")
    except (OSError, ValueError, TypeError) as error:
        reason = getattr(error, "strerror", None) or "no rows of this screen's columns"
        raise InputError(
            f"{path}: cannot be read as slots ({reason})", "name a file of vlc-rx encode --slots"
        ) from None
    if slots.ndim != 2 or slots.shape[1] != screen.columns or len(slots) == 0 or slots.max() > 1:
        reason = f"no slots of {screen.columns} columns, each 0 or 1"
        raise InputError(f"{path}: holds {reason}", f"name the screen that it was written for (not {screen.name})")
    return slots
