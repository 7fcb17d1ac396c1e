"""Frames read ahead: the same ones in the same order, and whoever brings them is told when nobody takes them."""

import threading
from collections.abc import Generator
from contextlib import closing
from itertools import islice

import numpy as np
import pytest

from rxcli import ingest
from rxcli.errors import InputError
from rxcli.ingest import ahead
from rxcli.types import Frame


def frames(n: int, log: list[int] | None = None, error: Exception | None = None) -> Generator[Frame, None, None]:
    """Frames of 100 bytes; -1 is logged when they are closed or at their end."""
    log = [] if log is None else log
    try:
        for index in range(n):
            log.append(index)
            yield Frame(np.full((10, 10), index, np.uint8), "a.mp4", index)
        if error:
            raise error
    finally:
        log.append(-1)


def is_over() -> bool:
    return all(thread.name != "read-ahead" for thread in threading.enumerate())


def test_all_frames_come_in_order_and_then_the_error() -> None:
    source = ahead.read_ahead(frames(50, error=InputError("a.mp4: breaks off", "copy it again")))
    got = [(frame.index, int(frame.pixels[0, 0])) for frame in islice(source, 50)]
    assert got == [(index, index) for index in range(50)]
    with pytest.raises(InputError, match="breaks off"):
        next(source)
    assert is_over()


@pytest.mark.parametrize(("max_bytes", "waiting"), [(10**9, 16), (1000, 10), (1, 2)])
def test_no_more_wait_than_there_is_room_for(monkeypatch: pytest.MonkeyPatch, max_bytes: int, waiting: int) -> None:
    """At most so many bytes, or two frames, beside the one that is looked at and the one that waits for room."""
    monkeypatch.setattr(ahead, "_MAX_BYTES", max_bytes)
    log: list[int] = []
    lead = []
    for frame in ahead.read_ahead(frames(200, log)):
        threading.Event().wait(0.0005)
        lead.append(len([entry for entry in log if entry >= 0]) - frame.index - 1)
    assert 2 <= max(lead) <= waiting + 1


def test_leaving_early_closes_the_source() -> None:
    log: list[int] = []
    with closing(ahead.read_ahead(frames(10**6, log))) as source:
        assert next(source).index == 0
    assert log[-1] == -1
    assert is_over()


def test_a_photo_that_was_begun_is_read_once_and_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []

    def opened(path: str) -> Generator[Frame, None, None]:
        read.append(threading.current_thread().name)
        if path == "cut.jpg":
            raise InputError("cut.jpg: cut", "copy it again")
        yield from frames(1)

    monkeypatch.setattr(ingest, "open_source", opened)
    photo = ingest.begun("a.jpg")
    for path, n_read in (("a.jpg", 1), ("b.jpg", 2), ("a.jpg", 3)):
        assert [frame.index for frame in photo(path)] == [0]
        assert len(read) == n_read
    assert read[0] != threading.current_thread().name == read[1]
    with pytest.raises(InputError, match="cut"):
        list(ingest.begun("cut.jpg")("cut.jpg"))
