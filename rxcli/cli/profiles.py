"""`vlc-rx profiles`: known screens and cameras, and which a file would get."""

import logging
from pathlib import Path
from typing import Any

import click
import msgspec

from rxcli.cli.common import force_argument, json_output, options, write_json
from rxcli.cli.groups import SuggestingGroup
from rxcli.cli.kinds import CAMERA
from rxcli.cli.printing import print_text
from rxcli.errors import ExitCode, InputError, ReceiverError, UsageError, printable, worst
from rxcli.ingest import open_source
from rxcli.outputs import claim
from rxcli.profiles import CameraProfile, ScreenProfile, dump_profile, known_profiles, load_profile, match_camera
from rxcli.resources import user_dir
from rxcli.types import Frame

log = logging.getLogger(__name__)
_JSON = options(("--json=FILE|- json_path", click.Path(allow_dash=True), None, "Write JSON."))


@click.group(cls=SuggestingGroup, invoke_without_command=True)
@click.pass_context
def profiles(context: click.Context) -> None:
    """Screen and camera profiles: list, show, validate, and which one a file would get."""
    if context.invoked_subcommand is None:
        context.invoke(list_profiles, json_path=None, force=False)


@profiles.command("list")
@_JSON
@force_argument
def list_profiles(json_path: str | None, force: bool) -> None:
    """List the known profiles. They go by their names: the user's own and the shipped ones."""
    claim([json_output(json_path, "screens", "cameras")], force=force)
    known, listed = _known(), {"screens": list[Any](), "cameras": list[Any]()}
    for profile, origin, path in known:
        listed[f"{profile.kind}s"].append({**msgspec.to_builtins(profile), "origin": origin, "path": str(path)})
    write_json(listed, json_path)
    if json_path == "-":
        return
    for profile, origin, _ in known:
        described = f"; {profile.description}" if profile.description else ""
        print_text(printable(f"{profile.kind}  {profile.name:<16} {origin:<8} {_about(profile)}{described}"))
    click.echo(f"\nuser profiles lie in {user_dir()} (cameras/, screens/); `profiles show NAME` prints one")


def _known() -> list[tuple[ScreenProfile | CameraProfile, str, Path]]:
    """Screens, then cameras, each with its origin and its file."""
    return [*known_profiles(ScreenProfile), *known_profiles(CameraProfile)]


def _about(profile: ScreenProfile | CameraProfile) -> str:
    """What a profile holds, in a few words."""
    if isinstance(profile, ScreenProfile):
        return f"{profile.columns} columns, {profile.slot_rate_hz:g} Hz"
    modes = ", ".join(f"{mode.name} {mode.width}x{mode.height}" for mode in profile.modes) or "no readout modes"
    return modes + ("; lens" if profile.lens else "")


@profiles.command()
@click.argument("name")
@_JSON
@force_argument
def show(name: str, json_path: str | None, force: bool) -> None:
    """Show the profile NAME, one that is known or a TOML file."""
    claim([json_output(json_path, "format", "kind", "name")], profiles=(name,), force=force)
    profile = load_profile(name)
    write_json(msgspec.to_builtins(profile), json_path)
    if json_path != "-":
        click.echo(dump_profile(profile), nl=False)


@profiles.command()
@click.argument("names", nargs=-1, metavar="[NAME|FILE]...")
def validate(names: tuple[str, ...]) -> int:
    """Check profiles: those named, or all that are known. Exit code 2 where one is wrong."""
    codes = []
    for name in names or [profile.name for profile, _, _ in _known()]:
        try:
            profile = load_profile(name)
        except ReceiverError as error:
            log.error("%s", error)
            codes.append(error.exit_code)
        else:
            click.echo(printable(f"{name}: valid {profile.kind} profile {profile.name!r}"))
    return worst(codes)


@profiles.command()
@click.argument("paths", nargs=-1, required=True, type=click.Path(path_type=Path))
@options(("--camera=NAME|FILE cameras", [CAMERA], None, "A camera to choose from. [default: all that are known]"))
@_JSON
@force_argument
def which(paths: tuple[Path, ...], cameras: tuple[str, ...], json_path: str | None, force: bool) -> int:
    """Show which camera profile each file would get, and why."""
    claim([json_output(json_path, "source", "camera", "reason")], paths, cameras, force)
    known = [load_profile(name, CameraProfile) for name in cameras]
    known = known or [profile for profile, _, _ in known_profiles(CameraProfile)]
    records, codes = [], [ExitCode.OK]
    for path in paths:
        try:
            records.append(_choice(_first_frame(path), path, known))
        except InputError as error:
            log.error("%s", error)
            codes.append(error.exit_code)
    write_json(records, json_path)
    if json_path != "-":
        for record in records:
            click.echo(printable(f"{record['source']}: {record['camera'] or 'no profile'} ({record['reason']})"))
    return worst(codes)


def _first_frame(path: Path) -> Frame:
    if path.is_dir():
        raise UsageError(f"{path} is a folder", "name the files in it")
    frame = next(open_source(path), None)
    if frame is None:
        raise InputError(f"{path}: no frame in it", "check the file")
    return frame


def _choice(frame: Frame, path: Path, cameras: list[CameraProfile]) -> dict[str, Any]:
    """The profile that the file gets and the reason, with what decided it."""
    metadata, width, height = frame.metadata, frame.width, frame.height
    found = match_camera(cameras, metadata.make, metadata.model, width, height)
    mode = found.mode_for(width, height) if found else None
    return {
        "source": str(path),
        **{name: getattr(metadata, name) for name in ("make", "model", "lens")},
        "width": width,
        "height": height,
        "camera": found.name if found else None,
        "mode": mode.name if mode else None,
        "line_delay_s": mode.line_delay_s if mode else None,
        "reason": _reason(frame, cameras, found),
    }


def _reason(frame: Frame, cameras: list[CameraProfile], found: CameraProfile | None) -> str:
    metadata, size = frame.metadata, f"{frame.width}x{frame.height}"
    camera = " ".join(part for part in (metadata.make, metadata.model) if part)
    same = [profile for profile in cameras if profile.matches(metadata.make, metadata.model)]
    if metadata.model is None:
        return "the file states no camera model; name a profile with --camera, or all is estimated"
    if found is not None:
        return f"{camera}, size {size}"
    if not same:
        return f"no profile of {camera}; all is estimated, or use `vlc-rx calibrate shutter`"
    sizes = ", ".join(f"{mode.width}x{mode.height}" for profile in same for mode in profile.modes) or "none"
    return f"{same[0].name} is this camera but has no readout mode of {size} (it has {sizes})"
