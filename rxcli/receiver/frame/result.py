"""The end of a reception without packets, and the result that states it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.screen.outline import Outline
from rxcli.types import BELIEVABLE, FrameResult, PacketResult, Reason, Remark


@dataclass(frozen=True, slots=True)
class Failure:
    """End of a reception without packets: reason, what was measured of it, and status."""

    remark: Remark
    status: Literal["no_screen", "no_signal"] = "no_signal"
    #: Estimates of the camera: name -> (value, standard deviation).
    estimated: dict[str, tuple[float, float]] = field(default_factory=dict)
    #: The best outline and camera.
    outline: Outline | None = None
    context: FrameContext | None = None
    #: Every hypothesis that was scored, see `search.Tried`.
    tried: tuple[Any, ...] = ()

    @property
    def reason(self) -> Reason:
        """Why nothing was received."""
        return self.remark.reason


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

    def with_remark(self, remark: Remark | None) -> Received:
        """The same with a remark before the others, if there is one."""
        return self if remark is None else self.with_remarks(remark, *self.result.remarks)

    def with_remarks(self, *remarks: Remark) -> Received:
        """The same with other remarks."""
        return self._replace(result=replace(self.result, remarks=remarks))


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
        remarks=(failure.remark,),
        skipped={"no_screen": 1} if failure.status == "no_screen" else {},
        estimated=failure.estimated or result.estimated,
    )
