"""Screen and camera profiles: versioned TOML, strictly checked.

An unknown key, a missing one or an impossible value is a `ProfileError` that names file, key, bound and value.
Times in seconds, lengths in pixels of the stored picture (integer coordinates are pixel centres).
"""

import json
import logging
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, overload

import msgspec
from msgspec import Meta

from rxcli.errors import ProfileError, UsageError, failure_explained, shortened
from rxcli.protocol import packet_slots
from rxcli.resources import data_dir, profile_dirs, read_limited

log = logging.getLogger(__name__)

PositiveInt = Annotated[int, Meta(gt=0, le=1_000_000)]
#: Valid names of profiles and modes.
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
Name = Annotated[str, Meta(pattern=f"^{NAME.pattern}$")]
#: Range of line delays and exposures, seconds.
Seconds = Annotated[float, Meta(ge=1e-9, lt=1)]
#: Longest profile file, bytes.
_MAX_BYTES = 1 << 18
#: Names of the tone curves that `rxcli.receiver.sampling.rows.tone_to_light` can undo.
ToneName = Literal["linear", "srgb", "bt709", "auto"]
#: Focal length and centre of a picture, pixels; the other numbers of a camera matrix; distortion coefficients:
#: calibrations give smaller ones.
Focal = Annotated[float, Meta(gt=0, le=1e9)]
Centre = Annotated[float, Meta(ge=-1e9, le=1e9)]
Zero = Annotated[float, Meta(ge=0, le=0)]
Unit = Annotated[float, Meta(ge=1, le=1)]
Coefficient = Annotated[float, Meta(ge=-1e3, le=1e3)]
#: Largest focal length and centre, and least focal length, picture sizes.
_FARTHEST = 1e3


class _Checked(msgspec.Struct, frozen=True):
    """Base of profiles, which checks values from files and from Python and converts NumPy types.

    Raises:
        ProfileError: a value is impossible.
    """

    def __post_init__(self) -> None:
        for field in msgspec.structs.fields(type(self)):
            value = msgspec.to_builtins(getattr(self, field.name), enc_hook=_as_builtin)
            try:
                msgspec.structs.force_setattr(self, field.name, msgspec.convert(value, field.type))
            except (msgspec.ValidationError, OverflowError) as error:
                place, text = f"`$.{field.name}", str(error)
                message = text.replace("`$", place) if "`$" in text else f"{text} - at {place}`"
                reason = _explain(message, {field.name: value})
                raise ProfileError(f"{type(self).__name__}: {reason}", "correct the value") from None


def _as_builtin(value: Any) -> Any:
    """Convert NumPy scalars and arrays to numbers, and anything else to text, which fails the check."""
    return value.tolist() if hasattr(value, "tolist") else repr(value)


class ScreenProfile(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A screen and its signal (air interface, section 3)."""

    format: Literal[1] = 1
    kind: Literal["screen"] = "screen"
    name: Name
    # Beyond any screen; the time and memory of the receiver grow with them.
    columns: Annotated[int, Meta(ge=1, le=200)]
    slot_rate_hz: Annotated[float, Meta(ge=500, le=1e6)]
    payload_symbols: Annotated[int, Meta(ge=1, le=64)]
    repeats: Annotated[int, Meta(ge=1, le=32)] = 3
    width_mm: Annotated[float, Meta(ge=10, le=1e4)] = 309.4
    height_mm: Annotated[float, Meta(ge=10, le=1e4)] = 173.95
    width_px: Annotated[int, Meta(ge=1, le=4096)] = 1366
    height_px: Annotated[int, Meta(ge=1, le=4096)] = 768
    segment_rows: Annotated[int, Meta(ge=1, le=32)] = 8
    #: Standard deviation of the Gaussian light profile of a segment, segment pitches.
    light_spread: Annotated[float, Meta(ge=0, le=10)] = 0.45
    #: Not among the screens that are tried if none is named: the start of a long packet looks like a short one.
    only_named: bool = False
    description: str = ""

    @property
    def packet_slots(self) -> int:
        """Slots of one packet."""
        return packet_slots(self.payload_symbols)

    @property
    def packets(self) -> tuple[float, int, int]:
        """What screens have in common that send the same packets, each of its own number of times."""
        return self.slot_rate_hz, self.packet_slots, self.columns

    @property
    def packet_s(self) -> float:
        """Duration of one packet in seconds."""
        return self.packet_slots / self.slot_rate_hz

    @property
    def aspect(self) -> float:
        """Width over height of the active area."""
        return self.width_mm / self.height_mm


class ReadoutMode(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Readout of one picture format of a camera."""

    name: Name
    width: PositiveInt
    height: PositiveInt
    #: Time between the exposure starts of two adjacent rows.
    line_delay_s: Seconds
    #: Exposure of files of this mode that state none.
    exposure_s: Seconds | None = None
    frame_rate_hz: Annotated[float, Meta(gt=0, le=1e5)] | None = None


class LensModel(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """OpenCV's pinhole model with radial and tangential distortion, for pictures of `width` x `height`."""

    width: PositiveInt
    height: PositiveInt
    camera_matrix: tuple[tuple[Focal, Zero, Centre], tuple[Zero, Focal, Centre], tuple[Zero, Zero, Unit]]
    #: k1 k2 p1 p2 k3, then up to k6, s1..s4, tx ty as OpenCV orders them.
    dist_coeffs: Annotated[tuple[Coefficient, ...], Meta(min_length=4, max_length=14)]
    #: True if the camera corrects the distortion of its pictures.
    distortion_already_corrected: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        (fx, _, cx), (_, fy, cy), _ = self.camera_matrix
        size = max(self.width, self.height)
        if max(fx, fy, abs(cx), abs(cy)) > _FARTHEST * size or min(fx, fy) < size / _FARTHEST:
            reason = f"camera_matrix does not fit a picture of {self.width} x {self.height} pixels"
            matrix = [list(row) for row in self.camera_matrix]
            raise ProfileError(f"lens: {reason} (got {matrix})", "correct it, or calibrate again")


class CameraProfile(_Checked, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A camera body (its readout modes), a lens, or both."""

    format: Literal[1] = 1
    kind: Literal["camera"] = "camera"
    name: Name
    #: Matched against the file's make, and its model, without regard to case; empty matches any.
    make: str = ""
    models: tuple[str, ...] = ()
    lens_models: tuple[str, ...] = ()
    modes: tuple[ReadoutMode, ...] = ()
    lens: LensModel | None = None
    tone: ToneName = "auto"
    description: str = ""

    def mode_for(self, width: int, height: int) -> ReadoutMode | None:
        """The readout mode of a picture of `width` x `height`, or None."""
        return next((mode for mode in self.modes if (mode.width, mode.height) == (width, height)), None)

    def matches(self, make: str | None, model: str | None) -> bool:
        """Whether a file of camera `make` `model` (None: unknown) is of this camera."""
        if model is None or not self.models:
            return False
        if self.make and make and self.make.casefold() not in make.casefold():
            return False
        return model.strip().casefold() in {name.casefold() for name in self.models}


_Profile = TypeVar("_Profile", ScreenProfile, CameraProfile)
_KINDS: dict[type[Any], str] = {ScreenProfile: "screens", CameraProfile: "cameras"}


def _parsed(text: str, source: str) -> dict[str, Any]:
    with failure_explained(f"{source}: not valid TOML", "correct the file, or name a shipped profile", ProfileError):
        return tomllib.loads(text)


def _kind_of(raw: dict[str, Any], source: str) -> type[Any]:
    kind = raw.get("kind")
    if kind not in ("screen", "camera"):
        raise ProfileError(f"{source}: kind must be 'screen' or 'camera' (got {kind!r})", "correct the file")
    return CameraProfile if kind == "camera" else ScreenProfile


def check_profile(raw: dict[str, Any], kind: type[_Profile], source: str) -> _Profile:
    """Check a profile that is already parsed.

    Raises:
        ProfileError: an unknown or missing key, or an impossible value.
    """
    for key in ("format", "kind"):  # required in files, though optional in Python
        if key not in raw:
            raise ProfileError(f"{source}: Object missing required field `{key}`", "correct the file")
    try:
        return msgspec.convert(raw, kind, strict=True)
    except (msgspec.ValidationError, OverflowError, RecursionError) as error:
        raise ProfileError(f"{source}: {_explain(str(error), raw)}", "correct the file") from None
    except ProfileError as error:
        raise ProfileError(f"{source}: {error.message}", error.hint) from None


def _explain(message: str, raw: dict[str, Any]) -> str:
    """msgspec's message with the value that it speaks of."""
    found = re.search(r" - at `\$\.?(.*)`$", message)
    if not found or not found.group(1):
        return message
    path = found.group(1)
    value: Any = raw
    for part in re.findall(r"[^.\[\]]+", path):
        try:
            value = value[int(part)] if isinstance(value, (list, tuple)) else value[part]
        except (KeyError, IndexError, ValueError, TypeError):
            return f"{path}: {message[: found.start()]}"
    return f"{path}: {message[: found.start()]} (got {shortened(repr(value))})"


@overload
def load_profile(name_or_path: str | Path) -> ScreenProfile | CameraProfile: ...


@overload
def load_profile(name_or_path: str | Path, kind: type[_Profile]) -> _Profile: ...


def load_profile(name_or_path: str | Path, kind: type[Any] | None = None) -> Any:
    """Load a profile by name, the user's own before shipped ones, or a TOML file by path.

    Args:
        name_or_path: such as "paper-17k3", "xs10" or "mine.toml".
        kind: `ScreenProfile` or `CameraProfile`; None: whichever it is.

    Raises:
        ProfileError: no such profile, unreadable, or malformed.
        UsageError: that is no name, or no kind.
    """
    name = str(name_or_path)
    kinds = tuple(_KINDS) if kind is None else (kind,)
    if not isinstance(name_or_path, (str, Path)) or not name or not set(kinds) <= set(_KINDS):
        step = "give a name or a TOML file, and ScreenProfile or CameraProfile as the kind"
        raise UsageError(f"no profile is called {shortened(repr(name_or_path))} (of kind {kind})", step)
    named = (path for kind in kinds for _, path in _profile_files(kind) if path.stem == name)
    path = next(named, Path(name)) if NAME.fullmatch(name) else Path(name)
    with failure_explained(f"{name}: cannot be read as a profile", "name a TOML file", ProfileError):
        try:
            text = read_limited(path, _MAX_BYTES).decode("utf-8")
        except FileNotFoundError:
            known = ", ".join(sorted({path.stem for kind in kinds for _, path in _profile_files(kind)}))
            among = " and ".join(_KINDS[kind] for kind in kinds)
            raise ProfileError(f"no profile {name!r} among {among}", f"name a TOML file or one of: {known}") from None
    raw = _parsed(text, name)
    return check_profile(raw, kind or _kind_of(raw, name), name)


def _profile_files(kind: type[Any]) -> list[tuple[str, Path]]:
    """Files of named profiles with their origin: the user's, then the shipped ones."""
    found: dict[str, tuple[str, Path]] = {}
    for origin, folder in profile_dirs():
        for path in sorted((folder / _KINDS[kind]).glob("*.toml")):
            found.setdefault(path.stem, (origin, path))
    return list(found.values())


def known_profiles(kind: type[_Profile]) -> list[tuple[_Profile, str, Path]]:
    """All named profiles of one kind with origin and file: the user's first, then the shipped ones.

    A broken profile of the user is skipped with a warning, since most runs do not need it.
    """
    known = []
    for origin, path in _profile_files(kind):
        try:
            known.append((load_profile(path, kind), origin, path))
        except ProfileError as error:
            if origin == "shipped":
                raise
            log.warning("%s; passed over", error)
    return known


def shipped_profiles(kind: type[_Profile]) -> list[_Profile]:
    """All shipped profiles of one kind, by name."""
    folder = data_dir("calibration") / _KINDS[kind]
    return [load_profile(str(path), kind) for path in sorted(folder.glob("*.toml"))]


def usual_screens() -> tuple[ScreenProfile, ...]:
    """The shipped screens that are tried if none is named."""
    return tuple(screen for screen in shipped_profiles(ScreenProfile) if not screen.only_named)


def dump_profile(profile: ScreenProfile | CameraProfile) -> str:
    """Write the profile as TOML text, which knows no null: what is unknown is left out."""
    import tomli_w

    def known(table: dict[str, Any]) -> dict[str, Any]:
        return {key: value for key, value in table.items() if value is not None}

    return tomli_w.dumps(json.loads(msgspec.json.encode(profile), object_hook=known))


def match_camera(
    cameras: Iterable[CameraProfile], make: str | None, model: str | None, width: int, height: int
) -> CameraProfile | None:
    """The first camera that matches make and model and has a readout mode for the size, or None.

    A body without a lens takes the lens of the first profile of the same camera that has one for this size.
    """
    fitting = [camera for camera in cameras if camera.matches(make, model)]
    body = next((camera for camera in fitting if camera.mode_for(width, height)), None)
    if body is None or body.lens is not None:
        return body
    lenses = (camera.lens for camera in fitting if camera.lens is not None)
    lens = next((lens for lens in lenses if (lens.width, lens.height) == (width, height)), None)
    return msgspec.structs.replace(body, lens=lens)
