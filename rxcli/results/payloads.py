"""Every packet as a row of CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

from rxcli.outputs import unwritable
from rxcli.results.report import csv_cell, printable_name
from rxcli.types import FrameResult

_NAMES = ("source", "frame", "column", "burst", "bits", "hex", "confidence")


class PayloadWriter:
    """A file with one row a packet, that grows with the run; a context manager.

    Args:
        path: the file.

    Raises:
        OutputError: it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file: BinaryIO = path.open("wb", buffering=0)
        except OSError as error:
            raise unwritable(path, error) from None
        try:
            self._write([_NAMES])
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> PayloadWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, result: FrameResult) -> None:
        """Write the packets of a frame."""
        self._write(
            (
                csv_cell(printable_name(result.source)),
                result.frame,
                column.column,
                "" if packet.burst is None else packet.burst,
                packet.payload_bits,
                packet.payload,
                f"{packet.confidence:.6f}",
            )
            for column in result.columns
            for packet in column.packets
        )

    def _write(self, rows: Iterable[tuple[object, ...]]) -> None:
        text = io.StringIO(newline="")
        csv.writer(text).writerows(rows)
        rest = memoryview(text.getvalue().encode())
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except BrokenPipeError:
            raise
        except OSError as error:
            raise unwritable(self._path, error) from None
