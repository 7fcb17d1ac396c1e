"""Further attempts at a photograph that gives few packets: none where the first one leaves no doubt of its camera."""

import numpy as np
import pytest

from rxcli.options import ReceiverOptions
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.result import Received
from rxcli.receiver.search import attempts
from rxcli.receiver.search.attempts import receive_either_way
from rxcli.types import ColumnResult, Frame, FrameResult, Metadata, PacketResult, SearchStep


@pytest.mark.parametrize(
    ("evidence", "n_packets", "confidence", "wanted"),
    [
        (500.0, 2, 0.9, [-np.inf]),  # plain, however few of its columns are lit
        (500.0, 1, 0.9, [-np.inf, 500.0]),  # one packet is no evidence
        (500.0, 2, 0.8, [-np.inf, 500.0]),  # of a wrong exposure some are believed
        (300.0, 2, 0.9, [-np.inf, 300.0]),
        (300.0, 10, 0.9, [-np.inf]),
    ],
)
def test_an_exposure_is_doubted_by_few_packets_of_little_evidence(
    evidence: float, n_packets: int, confidence: float, wanted: list[float]
) -> None:
    asked: list[float] = []

    def receive(cache: FrameCache, _: ReceiverOptions, least: float) -> Received:
        asked.append(least)
        packets = (PacketResult(0.0, 1.0, 8, "00", confidence, 0.0),)
        columns = tuple(ColumnResult(number, "ok", packets=packets * (number < n_packets)) for number in range(20))
        step = SearchStep("", 0.0, evidence, evidence, "won")
        return Received(FrameResult("photo", 0, 0.0, "ok", columns=columns, search=(step,)), {})

    frame = Frame(np.zeros((8, 8), np.uint8), "photo", metadata=Metadata(exposure_s=1e-4))
    receive_either_way(FrameCache(frame), ReceiverOptions(), receive)
    assert asked == wanted


@pytest.mark.parametrize(
    ("screen", "stated_us", "found_us", "is_another"),
    [
        ("paper-8k65", 100, 100, False),
        ("paper-8k65", 100, 130, False),  # Nearer to its own slots than to those of another rate.
        ("paper-8k65", 100, 200, True),  # As many slots as it lasts at 17.3 kHz.
        ("paper-17k3", 100, 50, True),
        ("paper-8k65", None, 200, False),
        ("paper-8k65", 100, None, False),
        (None, 100, 200, False),
    ],
)
def test_an_exposure_may_be_that_of_a_screen_of_another_rate(
    screen: str | None, stated_us: float | None, found_us: float | None, is_another: bool
) -> None:
    frame = Frame(np.zeros((2, 2), np.uint8), "photo", metadata=Metadata(exposure_s=stated_us and stated_us * 1e-6))
    estimated = FrameResult("photo", 0, 0.0, "ok", screen_profile=screen, exposure_s=found_us and found_us * 1e-6)
    assert attempts._is_exposure_of_another(estimated, frame, ReceiverOptions()) == is_another
