"""A frame of a clip, as it is seen and as it waits for its result."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from rxcli.receiver.clip.follow import Pose
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.search.framing import Framing
from rxcli.types import BurstPosteriors, Clock, Float32Array, FrameResult, IntArray


def decides_jointly(clock: Clock) -> bool:
    """Whether exposures are so long that slots and what is not known of the picture are decided together."""
    return clock.exposure_slots > SETTINGS.joint_slots


@dataclass(frozen=True, slots=True, eq=False)
class JointSlots:
    """Slots of a long exposure, whose copies were detected together."""

    #: (n_copies,) bursts of the copies.
    burst: IntArray
    posteriors: BurstPosteriors


@dataclass(slots=True, eq=False)
class View:
    """What a frame shows."""

    context: FrameContext
    acquisition: Acquisition
    clock: Clock
    #: (C, N) log-likelihood ratio of every slot being lit.
    llr: Float32Array
    #: (n_copies, C, packet) int: 1 where the slot is on the screen and in the picture.
    shown: IntArray
    #: (C, N) squared contrast over variance of every slot; (C, 1) of a tracked frame.
    snr: Float32Array
    #: Columns that the auto-encoder changed.
    denoised: frozenset[int] = field(default_factory=frozenset)
    #: (C, S, R) light of the strips as tracking samples them; None where that cannot be done.
    light: Float32Array | None = None
    #: Where the strips were then.
    pose: Pose | None = None
    #: Whether the picture was known from other frames.
    tracked: bool = False
    #: Whether the picture had changed since.
    changed: bool = False
    #: Number of the frame's copy 0 in the clip.
    first_copy: int = 0
    #: Of a long exposure; the slots are then those of every copy by itself.
    joint: JointSlots | None = None
    #: (C, copies, symbols, n) see `SlotLikelihoods.words`; None where slots are all that is known.
    words: Float32Array | None = None
    #: How sure the length of packets is by this frame alone; None where the picture was known.
    framing: Framing | None = None
    #: (B,) numbers of the frame's bursts, once known.
    numbers: IntArray | None = None


@dataclass(slots=True, eq=False)
class Waiting:
    """A frame whose result is held back."""

    result: FrameResult
    view: View | None = None
    #: Probability that the screen's columns are numbered right.
    certainty: float = 1.0

    def update(self, **fields: Any) -> None:
        """Set fields of the result."""
        self.result = replace(self.result, **fields)
