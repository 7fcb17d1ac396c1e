"""Frames read ahead: the same ones in the same order, and whoever brings them is told when nobody takes them."""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import closing

import numpy as np
import pytest

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


def threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name == "read-ahead"]


def test_all_frames_come_in_order_and_the_thread_ends() -> None:
    got = [(frame.index, int(frame.pixels[0, 0])) for frame in ahead.read_ahead(frames(50))]
    assert got == [(index, index) for index in range(50)]
    assert not threads()


def test_an_error_comes_after_the_frames_before_it() -> None:
    source = ahead.read_ahead(frames(3, error=InputError("a.mp4: breaks off", "copy it again")))
    assert [next(source).index for _ in range(3)] == [0, 1, 2]
    with pytest.raises(InputError, match="breaks off"):
        next(source)
    assert not threads()


@pytest.mark.parametrize(("max_bytes", "waiting"), [(10**9, 16), (1000, 10), (150, 2), (1, 2)])
def test_no_more_wait_than_there_is_room_for(monkeypatch: pytest.MonkeyPatch, max_bytes: int, waiting: int) -> None:
    """At most so many bytes, or two frames, beside the one that is looked at and the one that waits for room."""
    monkeypatch.setattr(ahead, "_MAX_BYTES", max_bytes)
    log: list[int] = []
    lead = []
    for frame in ahead.read_ahead(frames(200, log)):
        threading.Event().wait(0.0005)
        lead.append(len([entry for entry in log if entry >= 0]) - frame.index - 1)
    assert max(lead) <= waiting + 1
    assert max(lead) >= 2


def test_leaving_early_closes_the_source() -> None:
    log: list[int] = []
    source = ahead.read_ahead(frames(10**6, log))
    with closing(source):
        assert next(source).index == 0
    assert log[-1] == -1
    assert not threads()
