"""Every packet as a row of CSV."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TextIO

from rxcli.errors import InputError
from rxcli.results.report import printable
from rxcli.types import FrameResult

_NAMES = ("source", "frame", "column", "burst", "bits", "hex", "confidence")


class PayloadWriter:
    """A file with one row a packet; a context manager.

    Args:
        path: the file.
        resume: go on behind what is there.

    Raises:
        InputError: it cannot be written.
    """

    def __init__(self, path: Path, resume: bool = False) -> None:
        go_on = resume and path.is_file() and path.stat().st_size > 0
        try:
            self._file: TextIO = path.open("a" if go_on else "w", newline="", encoding="utf-8")
        except OSError as error:
            raise InputError(f"{path}: cannot be written ({error.strerror})", "name another file") from None
        self._rows = csv.writer(self._file)
        if not go_on:
            self._rows.writerow(_NAMES)

    def __enter__(self) -> PayloadWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, result: FrameResult) -> None:
        """Write the packets of a frame."""
        for column in result.columns:
            for packet in column.packets:
                burst = "" if packet.burst is None else packet.burst
                self._rows.writerow(
                    (
                        printable(result.source),
                        result.frame,
                        column.column,
                        burst,
                        packet.payload_bits,
                        packet.payload,
                        f"{packet.confidence:.6f}",
                    )
                )
