"""Hypotheses about a picture, and their results."""

from dataclasses import dataclass, field, replace
from typing import Self

from rxcli.profiles import ScreenProfile
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.camera import FrameCamera
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.passes import Reception
from rxcli.receiver.screen.outline import Outline
from rxcli.types import Clock, RowProfiles, SearchStep


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A hypothesis about a picture. Its clock is found, and its columns are read, only before its initial pass."""

    outline: Outline
    camera: FrameCamera
    screen: ScreenProfile
    #: The screen and others that differ only in the number of copies per burst, largest number first.
    variants: tuple[ScreenProfile, ...]
    log_prior: float
    #: Number of the way to look at the picture that it belongs to, see `propose.ways`.
    way: int = 0
    clock: Clock | None = None
    profiles: RowProfiles | None = field(default=None, repr=False, compare=False)

    @property
    def identity(self) -> tuple[object, ...]:
        """Equal for hypotheses that an initial pass cannot distinguish; also the order of ties."""
        estimate = self.camera.hypothesis
        return (
            self.outline.family,
            # Estimates are numbered in each way by themselves.
            (self.way, estimate.number) if estimate else (0, 0),
            self.camera.reversed,
            self.screen.packet_slots,
            self.screen.columns,
            self.screen.slot_rate_hz,
            self.screen.name,
        )


@dataclass(frozen=True, slots=True)
class Scored:
    """A hypothesis after its initial pass."""

    hypothesis: Hypothesis
    context: FrameContext
    acquisition: Acquisition
    reception: Reception
    #: Log-likelihood ratio of packets over slots of any kind, for a screen of twenty columns.
    evidence: float
    #: Tempered evidence plus log prior: the larger wins.
    score: float

    def with_camera(self, camera: FrameCamera) -> Self:
        """The same with another camera."""
        return replace(self, context=replace(self.context, camera=camera))


@dataclass(frozen=True, slots=True)
class Tried:
    """A hypothesis that was tried; `SearchStep` lists the fates."""

    hypothesis: Hypothesis
    evidence: float
    score: float
    fate: str

    @property
    def step(self) -> SearchStep:
        """The same in words, for a result."""
        own = self.hypothesis
        rows_per_slot = 1 / (own.camera.line_delay_s * own.screen.slot_rate_hz)
        parts = [own.screen.name, f"{rows_per_slot:.4g} rows per slot"]
        parts += ["reversed"] if own.camera.reversed else []
        return SearchStep(", ".join(parts), own.log_prior, self.evidence, self.score, self.fate)


@dataclass(frozen=True, slots=True)
class Found:
    """Result of a search."""

    best: Scored
    #: The outline with the probability that its columns are numbered as the screen's.
    outline: Outline
    tried: tuple[Tried, ...]
    #: All screens that the camera may have seen.
    screens: tuple[ScreenProfile, ...]
    #: Whether the camera is not as profile or file state it; the best that is, if any.
    doubts: bool = False
    stated: Scored | None = None
