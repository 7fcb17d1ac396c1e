"""Store the result of a calibration in a camera profile on disk."""

from pathlib import Path

import msgspec

from rxcli.errors import UsageError
from rxcli.outputs import writable, write_whole
from rxcli.profiles import NAME, CameraProfile, LensModel, ReadoutMode, dump_profile, load_profile
from rxcli.types import Metadata


def profile_to_extend(path: Path, metadata: Metadata | None = None) -> CameraProfile:
    """The profile at `path`, or an empty one named after it, for the camera in `metadata`.

    Raises:
        ProfileError: there is a file, but no camera profile in it.
        UsageError: the file's name makes no profile name.
    """
    if path.exists():
        return load_profile(str(path), CameraProfile)
    if not NAME.fullmatch(path.stem):
        reason = f"{path}: {path.stem!r} cannot name a profile"
        raise UsageError(reason, "use letters, digits, dots, dashes and underscores")
    metadata = metadata or Metadata()
    models = (metadata.model.strip(),) if metadata.model else ()
    return CameraProfile(format=1, kind="camera", name=path.stem, make=(metadata.make or "").strip(), models=models)


def with_lens(profile: CameraProfile, lens: LensModel, lens_name: str | None = None) -> CameraProfile:
    """The profile with its lens replaced; `lens_name`, as in metadata of files, is added to its names."""
    names = profile.lens_models
    if lens_name and lens_name not in names:
        names = (*names, lens_name)
    return msgspec.structs.replace(profile, lens=lens, lens_models=names)


def with_mode(profile: CameraProfile, mode: ReadoutMode) -> CameraProfile:
    """The profile with `mode` in place of one of the same name or size, or added.

    What the old mode knows and the new one does not (exposure, frame rate) is kept.
    """
    same = [o for o in profile.modes if o.name == mode.name or (o.width, o.height) == (mode.width, mode.height)]
    for old in same:
        known = {name: getattr(old, name) for name in ("exposure_s", "frame_rate_hz") if getattr(mode, name) is None}
        mode = msgspec.structs.replace(mode, **known)
    return msgspec.structs.replace(profile, modes=(*(old for old in profile.modes if old not in same), mode))


def write_profile(profile: CameraProfile, path: Path) -> None:
    """Write the profile as TOML, its folder too where it is missing.

    Raises:
        InputError: it cannot be written.
    """
    with writable(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, dump_profile(profile))
