"""The end of a reception without packets, and the result that states it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.screen.outline import Outline
from rxcli.types import BELIEVABLE, FrameResult, PacketResult


@dataclass(frozen=True, slots=True)
class Failure:
    """End of a reception without packets: status, reason and next step."""

    status: Literal["no_screen", "no_signal"]
    message: str
    #: Estimates of the camera: name -> (value, standard deviation).
    estimated: dict[str, tuple[float, float]] = field(default_factory=dict)
    #: The best outline and camera.
    outline: Outline | None = None
    context: FrameContext | None = None
    #: Every hypothesis that was scored, see `search.Tried`.
    tried: tuple[Any, ...] = ()


def is_received(packet: PacketResult, result: FrameResult) -> bool:
    """Whether a packet is believable, whatever its column's number: numbers are not the camera's."""
    return packet.confidence >= BELIEVABLE * result.column_certainty


class Received(NamedTuple):
    """Result of a frame, and its arrays at the stage boundaries; none where reception ended before."""

    result: FrameResult
    taps: dict[str, Any]

    @property
    def n_believable(self) -> int:
        """Number of packets that are believable."""
        return sum(is_received(packet, self.result) for packet in self.result.packets)

    def with_remark(self, remark: str | None) -> Received:
        """The same with a remark before the message, if there is one."""
        return self.with_message("; ".join(filter(None, (remark, self.result.message))) or None)

    def with_message(self, message: str | None) -> Received:
        """The same with another message."""
        return self._replace(result=replace(self.result, message=message))


def failed(result: FrameResult, failure: Failure) -> FrameResult:
    """Result of a failed reception with its reason."""
    # An estimated camera without packets is not reliable.
    context = failure.context if failure.context and failure.context.camera.hypothesis is None else None
    facts = {**(failure.outline.result_fields if failure.outline else {}), **(context.result_fields if context else {})}
    result = replace(result, **facts)
    return replace(
        result,
        search=tuple(tried.step for tried in failure.tried),
        status=failure.status,
        message=failure.message,
        skipped={"no_screen": 1} if failure.status == "no_screen" else {},
        estimated=failure.estimated or result.estimated,
    )
