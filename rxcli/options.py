"""What the user asks of the receiver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import msgspec
import numpy as np

from rxcli.errors import UsageError
from rxcli.profiles import CameraProfile, ScreenProfile, known_profiles, load_profile, shipped_profiles
from rxcli.types import FILE_MEMORY_MB, FloatArray

if TYPE_CHECKING:
    from rxcli.receiver.channel.denoise import Denoiser

CaeMode = Literal["auto", "always", "never"]
#: Names of the shortcuts that `ReceiverOptions.skip` may hold; every one is counted in the report.
SKIPS = ("no_screen", "no_packets", "dark_columns", "certain_columns", "tracking")
#: In place of a profile's name: all that are known, of which the picture decides.
AUTO = "auto"
_Profile = TypeVar("_Profile", ScreenProfile, CameraProfile)


@dataclass(frozen=True, slots=True)
class ReceiverOptions:
    """What the user asks of the receiver; picklable, so that worker processes can have it."""

    #: Screens to try, all shipped ones by default; the one whose clock fits best is taken.
    screens: tuple[ScreenProfile, ...] = field(default_factory=lambda: tuple(shipped_profiles(ScreenProfile)))
    #: Cameras to choose from by make, model and size, all shipped ones by default; empty: every camera is estimated.
    cameras: tuple[CameraProfile, ...] = field(default_factory=lambda: tuple(shipped_profiles(CameraProfile)))
    #: Take `cameras[0]` whatever the file says of itself.
    force_camera: bool = False
    #: (4, 2) image pixels, top-left first, clockwise as a viewer sees the screen; None: find them.
    corners: FloatArray | None = None
    #: The picture is mirrored: columns count from its right. Nothing is turned back; `corners` are as they are seen.
    mirrored: bool = False
    cae: CaeMode = "auto"
    #: Packets below this confidence are not reported.
    min_confidence: float = 0.0
    #: Shortcuts in use.
    skip: frozenset[str] = field(default_factory=lambda: frozenset(SKIPS))
    #: Pass over frames of a clip all of whose bursts are certain already.
    stop_when_certain: bool = False
    #: Give the results of a clip's first frames after some frames even where more would leave less doubt: for cameras
    #: that somebody aims.
    prompt: bool = False
    #: In place of the shipped auto-encoder; see `rxcli.receiver.channel.denoise.Denoiser`.
    denoiser: Denoiser | None = None
    #: Folder for the arrays of every stage boundary; None: none are written.
    dump_dir: Path | None = None
    #: Whether results carry the payload's soft bits, for the link layer.
    soft_bits: bool = False
    #: Memory of all files under way, 2^20 bytes; the least complete are dropped.
    file_memory_mb: int = FILE_MEMORY_MB


def receiver_options(
    screens: ScreenProfile | str | Sequence[ScreenProfile | str] = AUTO,
    cameras: CameraProfile | str | Sequence[CameraProfile | str] = AUTO,
    corners: Any = None,
    *,
    mirrored: bool = False,
    cae: CaeMode = "auto",
    min_confidence: float = 0.0,
    no_skip: Sequence[str] = (),
    stop_when_certain: bool = False,
    denoiser: Denoiser | None = None,
    dump_dir: str | Path | None = None,
    soft_bits: bool = False,
    file_memory_mb: int = FILE_MEMORY_MB,
) -> ReceiverOptions:
    """The receiver's options from names, files or profiles.

    A single camera that is named, not "auto", is taken whatever a file says of itself; of several, and of the shipped
    ones, each file takes the one that matches its make, model and size.

    Args:
        screens: profile, name of one, TOML file, or several of these; "auto": all shipped ones and the user's own.
        cameras: likewise; an empty sequence: estimate every camera from its picture.
        corners: (4, 2) stored pixels, top-left first, clockwise as a viewer sees the screen; None: find them.
        mirrored: count columns from the right of the picture, as front cameras may show them.
        cae: when the auto-encoder runs.
        min_confidence: packets below it are not reported.
        no_skip: shortcuts to switch off, of `SKIPS`.
        stop_when_certain: pass over frames of a clip all of whose packets are certain already.
        denoiser: in place of the shipped auto-encoder.
        dump_dir: folder for the arrays of every stage boundary.
        soft_bits: whether results carry the payload's soft bits, for the link layer.
        file_memory_mb: memory of all files under way, 2^20 bytes; the least complete are dropped.

    Raises:
        ProfileError: a profile is missing or malformed.
        UsageError: the corners are no convex quadrilateral, or a value is impossible.
    """
    named = (cameras,) if isinstance(cameras, (str, CameraProfile)) else tuple(cameras)
    _check_choices(cae, min_confidence, no_skip)
    return ReceiverOptions(
        screens=_profiles(screens, ScreenProfile),
        cameras=_profiles(cameras, CameraProfile),
        force_camera=len(named) == 1 and named[0] != AUTO,
        corners=None if corners is None else _checked_corners(corners),
        mirrored=mirrored,
        cae=cae,
        min_confidence=min_confidence,
        skip=frozenset(SKIPS) - set(no_skip),
        stop_when_certain=stop_when_certain,
        denoiser=denoiser,
        # Absolute, for workers may stand in other folders.
        dump_dir=None if dump_dir is None else Path(dump_dir).absolute(),
        soft_bits=soft_bits,
        file_memory_mb=file_memory_mb,
    )


def _profiles(
    named: ScreenProfile | CameraProfile | str | Sequence[ScreenProfile | CameraProfile | str], kind: type[_Profile]
) -> tuple[_Profile, ...]:
    names: tuple[Any, ...] = (named,) if isinstance(named, (str, ScreenProfile, CameraProfile)) else tuple(named)
    found: list[_Profile] = []
    for name in names:
        if isinstance(name, kind):
            # Made anew, so that one changed by `msgspec.structs.replace` is checked too.
            found.append(kind(**msgspec.structs.asdict(name)))
        elif not isinstance(name, str):
            raise UsageError(f"{name!r} is no {kind.__name__}", "give a profile of this kind, its name, or a TOML file")
        elif name != AUTO:
            found.append(load_profile(name, kind))
    return (*found, *([profile for profile, _, _ in known_profiles(kind)] if AUTO in names else ()))


def _check_choices(cae: str, min_confidence: float, no_skip: Sequence[str]) -> None:
    if cae not in ("auto", "always", "never"):
        raise UsageError(f"cae must be auto, always or never (got {cae!r})")
    if not 0 <= min_confidence <= 1:
        raise UsageError(f"min_confidence must be in 0..1 (got {min_confidence})")
    for name in no_skip:
        if name not in SKIPS:
            raise UsageError(f"no_skip: {name!r} is not one of {', '.join(SKIPS)}")


def _checked_corners(corners: Any) -> FloatArray:
    """The corners, where going round them always turns the same way, as it does round a screen seen by a camera."""
    found: FloatArray = np.array(corners, dtype=np.float64)
    if found.shape != (4, 2) or not np.all(np.isfinite(found)):
        raise UsageError(f"corners must be four positions (x, y) in stored pixels (got shape {found.shape})")
    edges = np.roll(found, -1, axis=0) - found
    following = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
    if not (np.all(turns > 0) or np.all(turns < 0)):
        raise UsageError(
            "corners must go once round a convex outline: top-left, top-right, bottom-right, bottom-left",
            "check their order and the numbers",
        )
    return found
