"""A receiver without pictures: text files say what becomes of them. Its own module, so that workers import it."""

import json
import os
import random
import signal
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rxcli.errors import InputError, UsageError
from rxcli.options import ReceiverOptions
from rxcli.runs.batch import Decoder
from rxcli.types import ColumnResult, Frame, FrameResult, PacketResult

N_COLUMNS = 3
OPTIONS = ReceiverOptions()
#: Options that the receiver refuses.
WRONG = ReceiverOptions(cae="never")


def open_fake(path: str) -> Iterator[Frame]:
    """Frames as the JSON file `path` orders them; it fails, dies or waits where the file says so."""
    try:
        order: dict[str, Any] = json.loads(Path(path).read_text())
    except (OSError, ValueError):
        raise InputError(f"{path}: no picture", "name another file") from None
    for index in range(order.get("frames", 1)):
        time.sleep(order.get("sleep_s", 0.0))
        if order.get("fail_at") == index:
            raise InputError(f"{path}: breaks off in frame {index}", "copy it again")
        if order.get("bug_at") == index:
            raise ZeroDivisionError("a bug")
        if order.get("kill_at") == index and _may_kill(Path(path), order.get("kills")):
            os.kill(os.getpid(), signal.SIGKILL)
        yield Frame(np.zeros((1, 1), np.uint8), source=path, index=index, time_s=index / 30)


def _may_kill(path: Path, kills: int | None) -> bool:
    """Whether the file has not ended so many processes yet; None: whether it always does."""
    done = path.with_name(path.name + ".kills")
    n = len(done.read_text()) if done.exists() else 0
    done.write_text("x" * (n + 1))
    return kills is None or n < kills


def receive_fake(frames: Iterable[Frame], options: ReceiverOptions) -> Iterator[FrameResult]:
    """One result a frame, one frame late; the payloads follow from the name of the source."""
    if options.cae == "never":
        raise UsageError("the options make no sense", "give others")
    held: FrameResult | None = None
    for frame in frames:
        if held is not None:
            yield held
        held = _result(frame)
    if held is not None:
        yield held


def _result(frame: Frame) -> FrameResult:
    generator = random.Random(f"{Path(frame.source).name} {frame.index}")
    columns = tuple(
        ColumnResult(column, "ok", w=5, snr_db=20.0, packets=(_packet(generator),)) for column in range(N_COLUMNS)
    )
    return FrameResult(frame.source, frame.index, frame.time_s, "ok", columns=columns, timing_ms={"total": 1.0})


def _packet(generator: random.Random) -> PacketResult:
    payload = generator.randbytes(5).hex()
    return PacketResult(10.0, 2.0, 40, payload, confidence=0.99, ber_hat=1e-4)


def fake_decoder(options: ReceiverOptions = OPTIONS) -> Decoder:
    """The decoder to inject."""
    return Decoder(options, open_source=open_fake, receive=receive_fake)
