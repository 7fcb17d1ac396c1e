"""Options of the receiver."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec
import numpy as np

from rxcli.errors import UsageError, shortened
from rxcli.profiles import CameraProfile, ScreenProfile, known_profiles, load_profile, shipped_profiles, usual_screens
from rxcli.types import FILE_MEMORY_MB, Denoiser, FloatArray

CaeMode = Literal["auto", "always", "never"]
#: Names of shortcuts for `ReceiverOptions.skip`; the report counts each use.
SKIPS = ("no_screen", "unlikely", "no_packets", "dark_columns", "certain_columns", "tracking")
#: Instead of a profile's name: try all known profiles and let the picture decide.
AUTO = "auto"
_Profile = TypeVar("_Profile", ScreenProfile, CameraProfile)


@dataclass(frozen=True, slots=True)
class ReceiverOptions:
    """Options of the receiver; picklable for worker processes."""

    #: Screens to try, by default all known ones; the best one is used.
    screens: tuple[ScreenProfile, ...] = field(default_factory=usual_screens)
    #: Cameras to choose from by make, model and size, by default all known ones; empty: estimate every camera.
    cameras: tuple[CameraProfile, ...] = field(default_factory=lambda: tuple(shipped_profiles(CameraProfile)))
    #: Use `cameras[0]` for every file, regardless of its metadata.
    force_camera: bool = False
    #: (4, 2) image pixels, top-left first, clockwise as a viewer sees the screen; None: find them.
    corners: FloatArray | None = None
    #: The picture is mirrored, so columns count from its right; `corners` are those of the mirrored picture.
    mirrored: bool = False
    cae: CaeMode = "auto"
    #: Packets below this confidence are not reported.
    min_confidence: float = 0.0
    #: Enabled shortcuts.
    skip: frozenset[str] = field(default_factory=lambda: frozenset(SKIPS))
    #: Skip frames of a clip that show only bursts that are already certain.
    stop_when_certain: bool = False
    #: Report the first frames of a clip early instead of waiting for a better picture, as for a camera that is being
    #: aimed.
    prompt: bool = False
    #: Replacement of the shipped auto-encoder; see `rxcli.types.Denoiser`.
    denoiser: Denoiser | None = None
    #: Folder for the arrays of every stage boundary, or None.
    dump_dir: Path | None = None
    #: Whether results contain soft bits for the link layer.
    soft_bits: bool = False
    #: Memory limit of all incomplete files, 2^20 bytes; the least complete are dropped.
    file_memory_mb: int = FILE_MEMORY_MB


def receiver_options(
    screens: ScreenProfile | str | Path | Sequence[ScreenProfile | str | Path] = AUTO,
    cameras: CameraProfile | str | Path | Sequence[CameraProfile | str | Path] = AUTO,
    corners: Any = None,
    *,
    mirrored: bool = False,
    cae: CaeMode = "auto",
    min_confidence: float = 0.0,
    no_skip: str | Sequence[str] = (),
    stop_when_certain: bool = False,
    denoiser: Denoiser | None = None,
    dump_dir: str | Path | None = None,
    soft_bits: bool = False,
    file_memory_mb: int = FILE_MEMORY_MB,
) -> ReceiverOptions:
    """Build the receiver's options from names, files or profiles.

    A single named camera is used for every file. If there are several cameras, or "auto", each file uses the one that
    matches its make, model and size.

    Args:
        screens: profile, name of one, TOML file, or several of these; "auto": all shipped ones and the user's own.
        cameras: likewise; an empty sequence: estimate every camera from its picture.
        corners: (4, 2) stored pixels, top-left first, clockwise as a viewer sees the screen; None: find them.
        mirrored: count columns from the right of the picture, as front cameras may show them.
        cae: when the auto-encoder runs.
        min_confidence: packets below it are not reported.
        no_skip: shortcuts to switch off, of `SKIPS`.
        stop_when_certain: skip frames of a clip that show only packets that are already certain.
        denoiser: replacement of the shipped auto-encoder.
        dump_dir: folder for the arrays of every stage boundary.
        soft_bits: whether results contain soft bits for the link layer.
        file_memory_mb: memory limit of all incomplete files, 2^20 bytes; the least complete are dropped.

    Raises:
        ProfileError: a profile is missing or malformed.
        UsageError: the corners are no convex quadrilateral, or a value is impossible.
    """
    named, names = _listed("cameras", cameras), _listed("no_skip", no_skip)
    flags = {"mirrored": mirrored, "stop_when_certain": stop_when_certain, "soft_bits": soft_bits}
    check_values(
        *((name, value, isinstance(value, bool), "True or False") for name, value in flags.items()),
        ("cae", cae, isinstance(cae, str) and cae in ("auto", "always", "never"), "auto, always or never"),
        ("min_confidence", min_confidence, is_number(min_confidence, 0) and min_confidence <= 1, "in 0..1"),
        ("file_memory_mb", file_memory_mb, isinstance(file_memory_mb, int) and file_memory_mb > 0, "whole megabytes"),
        ("denoiser", denoiser, denoiser is None or hasattr(denoiser, "slot_corrections"), "a denoiser, or None"),
        *(("no_skip", name, name in SKIPS, f"one of {', '.join(SKIPS)}") for name in names),
        ("dump_dir", dump_dir, dump_dir is None or isinstance(dump_dir, (str, Path)), "the path of a folder, or None"),
    )
    return ReceiverOptions(
        screens=_profiles(_listed("screens", screens), ScreenProfile),
        cameras=_profiles(named, CameraProfile),
        force_camera=len(named) == 1 and named[0] != AUTO,
        corners=None if corners is None else _checked_corners(corners),
        cae=cae,
        min_confidence=min_confidence,
        skip=frozenset(SKIPS) - set(names),
        denoiser=denoiser,
        # Absolute, since workers may run in other folders.
        dump_dir=None if dump_dir is None else Path(dump_dir).absolute(),
        file_memory_mb=file_memory_mb,
        **flags,
    )


def check_values(*rules: tuple[str, Any, bool, str]) -> None:
    """Refuse values that make no sense: a rule is a name, its value, whether that is right, and what it must be.

    Raises:
        UsageError: of the first rule that does not hold.
    """
    for name, value, is_right, wanted in rules:
        if not is_right:
            shown = shortened(" ".join(repr(value).split()))
            raise UsageError(f"{name} must be {wanted} (got {shown})", "correct it, or leave it out")


def is_number(value: Any, min_value: float = -math.inf) -> bool:
    """Whether a value is a finite number of at least `min_value`."""
    is_real = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    return bool(is_real and math.isfinite(value) and value >= min_value)


def _listed(option: str, given: Any) -> tuple[Any, ...]:
    """One thing or several, as a tuple."""
    several = isinstance(given, Iterable) and not isinstance(given, (str, Path))
    is_one = isinstance(given, (str, Path, ScreenProfile, CameraProfile))
    check_values((option, given, is_one or several, "a name or several; docs/python.md lists what it takes"))
    found = tuple(given) if several else (given,)
    check_values((option, given, bool(found) or option != "screens", "at least one"))
    return found


def _profiles(named: tuple[Any, ...], kind: type[_Profile]) -> tuple[_Profile, ...]:
    found: list[_Profile] = []
    for name in named:
        if isinstance(name, kind):
            # Rebuilt, so that a profile changed by `msgspec.structs.replace` is checked too.
            found.append(kind(**msgspec.structs.asdict(name)))
        elif not isinstance(name, (str, Path)):
            reason = f"{shortened(repr(name))} is no {kind.__name__}"
            raise UsageError(reason, "give a profile of this kind, its name, or a TOML file")
        elif name != AUTO:
            found.append(load_profile(name, kind))
    known: list[_Profile] = [profile for profile, _, _ in known_profiles(kind)] if AUTO in named else []
    return tuple(found + [profile for profile in known if not getattr(profile, "only_named", False)])


def _checked_corners(corners: Any) -> FloatArray:
    """Check that the corners form a convex quadrilateral in the right order."""
    try:
        found: FloatArray = np.array(corners, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        found = np.empty(0)
    is_right = found.shape == (4, 2) and bool(np.all(np.isfinite(found)))
    check_values(("corners", corners, is_right, "four positions (x, y) in stored pixels"))
    edges = np.roll(found, -1, axis=0) - found
    following = np.roll(edges, -1, axis=0)
    turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
    if not (np.all(turns > 0) or np.all(turns < 0)):
        raise UsageError(
            "corners must go once round a convex outline: top-left, top-right, bottom-right, bottom-left",
            "check their order and the numbers",
        )
    return found
