"""Further attempts at a photograph that gives few packets: none where the first one leaves no doubt of its camera."""

import numpy as np
import pytest

from rxcli.options import ReceiverOptions
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.camera import FrameCamera
from rxcli.receiver.frame.result import Received
from rxcli.receiver.search import attempts
from rxcli.receiver.search.attempts import receive_either_way
from rxcli.types import ColumnResult, Frame, FrameResult, PacketResult

PROFILE = FrameCamera("mine", 6e-6, 1e-4, None, "srgb")


@pytest.mark.parametrize(("n_packets", "n_attempts"), [(0, 2), (1, 2), (9, 2), (10, 1), (20, 1)])
def test_a_profile_is_doubted_by_packets_of_few_columns(
    n_packets: int, n_attempts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def receive(_: FrameCache, options: ReceiverOptions) -> Received:
        asked.append(len(options.cameras))
        packets = (PacketResult(0.0, 1.0, 8, "00", 0.9, 0.0),)
        columns = tuple(ColumnResult(number, "ok", packets=packets * (number < n_packets)) for number in range(20))
        return Received(FrameResult("photo", 0, 0.0, "ok", columns=columns, message=attempts.STEADY_LIGHT), {})

    monkeypatch.setattr(attempts, "known_camera", lambda *_: PROFILE)
    receive_either_way(FrameCache(Frame(np.zeros((8, 8), np.uint8), "photo")), ReceiverOptions(), receive)
    assert len(asked) == n_attempts
    assert asked[1:] == [0] * (n_attempts - 1)
