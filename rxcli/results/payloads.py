"""Every packet as a row of CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO

from rxcli.outputs import unwritable
from rxcli.results.columns import packet_rows
from rxcli.results.report import csv_cell, printable_name
from rxcli.types import FrameResult

#: Of `packet_rows`, between the source and the confidence, and the names of all columns.
_KEYS = ("frame", "column", "burst", "payload_bits", "payload")
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
        source = csv_cell(printable_name(result.source))
        self._write((source, *(row[key] for key in _KEYS), f"{row['confidence']:.6f}") for row in packet_rows(result))

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
