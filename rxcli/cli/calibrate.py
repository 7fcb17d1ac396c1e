"""`vlc-rx calibrate`: lens and shutter of a camera, into a camera profile."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import click

from rxcli.calibrate.fitting import ConvertedLens
from rxcli.calibrate.frames import frame_light
from rxcli.calibrate.gyroflow import load_gyroflow
from rxcli.calibrate.lens import Board, GrayImage, Rejected, calibrate_lens, find_boards
from rxcli.calibrate.lensfun import lens_from_database
from rxcli.calibrate.picture import write_residuals
from rxcli.calibrate.saving import profile_to_extend, with_lens, with_mode, write_profile
from rxcli.calibrate.shutter import ShutterCalibration, calibrate_shutter
from rxcli.calibrate.slots import REVERSED, calibrate_slots
from rxcli.cli.common import force_argument, json_output, options, output, refuse, write_json
from rxcli.cli.groups import SuggestingGroup
from rxcli.cli.kinds import FILE, Numbers
from rxcli.errors import InputError, UsageError, printable
from rxcli.ingest import KNOWN_SUFFIXES, open_source
from rxcli.outputs import CAMERA, PICTURE, Output, claim, json_with
from rxcli.profiles import NAME, CameraProfile, LensModel, ReadoutMode, ScreenProfile, load_profile
from rxcli.resources import user_dir
from rxcli.results.undistort import grey_levels
from rxcli.runs.batch import collect_sources
from rxcli.types import Frame, Metadata

_PATH = click.Path(path_type=Path)
_PATHS = click.argument("paths", nargs=-1, required=True, type=_PATH)
_between_0_and = partial(click.FloatRange, 0, min_open=True, max_open=True)
_NAME_HINT = "use letters, digits, dots, dashes and underscores"
#: Where the result goes: the options that `_Results` takes.
_RESULTS = (
    ("--save", FILE, None, "Camera profile to write, or to add to."),
    ("--name", str, None, "Keep it as the camera NAME, for --camera NAME from anywhere."),
    ("--json=FILE|- json_path", click.Path(allow_dash=True), None, "Write the result as JSON."),
)


@click.group(cls=SuggestingGroup)
def calibrate() -> None:
    """Measure a camera's lens or shutter and keep it in a camera profile."""


class _Results:
    """The profile that a command extends, and the JSON that it writes.

    Args:
        given: options of a command; those of `_RESULTS` and `force_argument` are taken out.

    Raises:
        UsageError: both --save and --name are given, or the name is impossible.
    """

    def __init__(self, given: dict[str, Any]) -> None:
        save, name, self._json_path, self._force = (given.pop(key) for key in ("save", "name", "json_path", "force"))
        is_wrong = name is not None and not NAME.fullmatch(name)
        refuse(
            (None not in (name, save), "--save and --name both name the profile to write", "give one of them"),
            (is_wrong, f"--name {name!r} cannot name a profile", _NAME_HINT),
        )
        self._target: Path | None = save if name is None else user_dir() / "cameras" / f"{name}.toml"

    def claim(self, read: list[Path], *json_keys: str, screen: str | None = None, more: Output | None = None) -> None:
        """Refuse outputs that would destroy something; the profile may be added to.

        Args:
            read: files that the command reads.
            json_keys: keys of an earlier JSON of the command.
            screen: name or file of a profile that it reads.
            more: a further output.
        """
        profile = output("--save", self._target, CAMERA, makes_folder=True)
        claim([json_output(self._json_path, *json_keys), profile, more], read, (screen,), self._force)

    def write(
        self,
        record: dict[str, Any],
        lines: list[tuple[str, str]],
        metadata: Metadata | None,
        extend: Callable[[CameraProfile], CameraProfile],
        doubts: tuple[str, ...] = (),
    ) -> None:
        """Write the result.

        Args:
            record: of the JSON.
            lines: label and text each, for people; not printed where the JSON goes to stdout.
            metadata: the camera of a new profile.
            extend: adds the result to a profile.
            doubts: why a profile should not be written.

        Raises:
            UsageError: a profile of a doubtful result is asked for without --force.
        """
        if self._target is not None:
            if doubts and not self._force:
                raise UsageError(f"no profile was written: {doubts[0]}", "use another lamp, or insist with --force")
            write_profile(extend(profile_to_extend(self._target, metadata)), self._target)
            lines = [*lines, ("written", str(self._target))]
        write_json({**record, "profile": self._target and str(self._target)}, self._json_path)
        if self._json_path != "-":
            click.echo("\n".join(f"{label:11} {printable(text)}" for label, text in lines))


def _files(paths: tuple[Path, ...]) -> list[Path]:
    """The files named, and those of known suffix in the folders named."""
    sources = collect_sources(map(str, paths), KNOWN_SUFFIXES)
    for source in sources:
        if source.problem:
            raise InputError(source.problem)
    return [Path(source.path) for source in sources]


def _lens_record(model: LensModel) -> dict[str, Any]:
    return {key: getattr(model, key) for key in ("camera_matrix", "dist_coeffs", "width", "height")}


def _distortion(model: LensModel) -> tuple[str, str]:
    return "distortion", " ".join(f"{value:.5f}" for value in model.dist_coeffs) + "  (k1 k2 p1 p2 k3)"


def _converted_report(found: ConvertedLens, at: str, source: str) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """The record and the lines of a lens model that was converted from another; `at` follows the lens's name."""
    camera, name, model = found.camera, found.lens_name, found.lens
    return {"camera": camera, "lens": name, **_lens_record(model), "worst_px": found.worst_px}, [
        ("camera", camera or "not named"),
        ("lens", f"{name or 'not named'}{at}"),
        ("focal", f"{model.camera_matrix[0][0]:.1f} px"),
        _distortion(model),
        ("conversion", f"within {found.worst_px:.2f} px of {source}"),
    ]


def _board_pictures(
    paths: list[Path], every: int, unreadable: list[Rejected], metadata: list[Metadata]
) -> Iterator[tuple[str, GrayImage]]:
    """Name and grey picture of each board picture; the lists get the unreadable files, and what all others state."""
    for path in paths:
        try:
            for frame in islice(open_source(path), 0, None, every):
                metadata.append(frame.metadata)
                yield (f"{path}#{frame.index}" if frame.index else str(path)), grey_levels(frame)
        except InputError as error:
            unreadable.append(Rejected(str(path), error.message.removeprefix(f"{path}: ")))


@calibrate.command(short_help="A lens, from pictures of a chessboard.")
@_PATHS
@options(
    ("--board board_size", Numbers("9x6"), "9x6", "Inner corners, across x down."),
    ("--square square_mm", float, 25.0, "Side of a square, mm."),
    ("--charuco=DICT dictionary", str, None, "ChArUco board of this dictionary (DICT_5X5_100, ...)."),
    ("--marker marker_ratio", float, 0.75, "Marker over square side."),
    ("--every", click.IntRange(1), 10, "Use every Nth frame of a clip."),
    ("--picture", FILE, None, "Draw the residuals into this PNG."),
    *_RESULTS,
)
@force_argument
def lens(paths: tuple[Path, ...], board_size: tuple[int, int], every: int, picture: Path | None, **given: Any) -> None:
    """Lens model from PATHS: pictures of a chessboard or ChArUco board, folders of them, or clips.

    Pictures are taken as stored, never rotated. Fill the frame out to its corners and tilt the board both ways.
    """
    wanted = _Results(given)
    board, files = Board(*board_size, **given), _files(paths)
    wanted.claim(files, "rms_px", "camera_matrix", more=output("--picture", picture, PICTURE))
    unreadable, metadata = list[Rejected](), list[Metadata]()
    found, width, height = find_boards(_board_pictures(files, every, unreadable, metadata), board)
    result = calibrate_lens([*unreadable, *found], width, height)
    if picture is not None:
        write_residuals(result, picture)
    (fx, _, cx), (_, fy, cy), _ = result.model.camera_matrix
    sd = result.intrinsic_sd_px
    lines = [
        ("RMS", f"{result.rms_px:.3f} px (corners of {len(result.accepted)} boards)"),
        ("fx fy", f"{fx:.2f} {fy:.2f} px (+- {sd[0]:.2f})"),
        ("cx cy", f"{cx:.2f} {cy:.2f} px (+- {sd[2]:.2f})"),
        _distortion(result.model),
        *(("rejected", f"{rejected.name}: {rejected.reason}") for rejected in result.rejected),
        *([("no corners", ", ".join(result.uncovered))] if result.uncovered else []),
    ]
    record = {
        "rms_px": result.rms_px,
        **_lens_record(result.model),
        "accepted": [{"name": name, "rms_px": rms} for name, rms in result.accepted.items()],
        "rejected": [asdict(rejected) for rejected in result.rejected],
        "uncovered": result.uncovered,
        "intrinsic_sd_px": sd,
    }
    camera = next(iter(metadata), Metadata())
    wanted.write(record, lines, camera, lambda profile: with_lens(profile, result.model, camera.lens))


@calibrate.command(short_help="Readout and line delay, from a blinking lamp.")
@_PATHS
@options(
    ("--frequency=HZ frequencies", [_between_0_and(1e7)], None, "Lamp; may be repeated."),
    ("--screen=NAME|FILE", str, None, "Screen profile, whose slot rate is known, instead of a lamp."),
    ("--axis", ("auto", "rows", "columns"), "auto", "Readout axis."),
    ("--region=X,Y,W,H", Numbers("100,80,640,400"), None, "Search this part of the pictures only, stored pixels."),
    ("--exposure exposure_s", _between_0_and(1), None, "Exposure in seconds, where the files do not hold it."),
    ("--frames", click.IntRange(1), 8, "Frames used of a clip."),
    ("--mode", str, None, "Name of the readout mode to save.  [default: by the size, as 1920x1080]"),
    ("--export", FILE, None, "Write the readout as a JSON record for other programs."),
    *_RESULTS,
)
@force_argument
def shutter(paths: tuple[Path, ...], frequencies: tuple[float, ...], screen: str | None, **given: Any) -> None:
    """Line delay and readout from PATHS: pictures or clips, of one readout mode, of blinking lamps.

    Let the lamp fill much of the frame, out of focus, with an exposure well below half a period.
    """
    lamp = "give the frequency of the lamp, as --frequency 1000"
    refuse((bool(frequencies) == bool(screen), "either --frequency or --screen is needed", lamp))
    axis, window, exposure_s = given["axis"], given["region"], given["exposure_s"]
    refuse((screen and window, "--region goes with --frequency only", "leave it out"))
    wanted, files = _Results(given), _files(paths)
    export: Path | None = given["export"]
    exchanged = output("--export", export, json_with("format", "line_delay_s"))
    wanted.claim(files, "readout_s", "line_delay_s", screen=screen, more=exchanged)
    chosen = _frames(files, given["frames"])
    raw = chosen[0].mosaic is not None  # its rows are the sensor's
    along: Any = "rows" if raw or (screen and axis == "auto") else None if axis == "auto" else axis
    if screen:
        result = calibrate_slots(chosen, load_profile(screen, ScreenProfile), along)
    else:
        lights, tone_known = [frame_light(frame) for frame in chosen], raw or chosen[0].linear
        known_s = chosen[0].metadata.exposure_s if exposure_s is None else exposure_s
        result = calibrate_shutter(lights, frequencies, along, known_s, window, tone_known)
    for warning in (*result.warnings, *result.doubts):
        click.echo(f"vlc-rx: {warning}", err=True)
    record, lines = _shutter_report(result)
    name = given["mode"]
    if export is not None:
        write_json(_exchanged(result, record, chosen[0].metadata, name), str(export))
    wanted.write(record, lines, chosen[0].metadata, lambda profile: _with_shutter(profile, result, name), result.doubts)


def _exchanged(
    result: ShutterCalibration, record: dict[str, Any], camera: Metadata, mode: str | None
) -> dict[str, Any]:
    """The readout of one mode for other programs; a lamp does not show the direction of the readout."""
    return {
        "format": "rolling-shutter-readout/1",
        "make": camera.make,
        "model": camera.model,
        "mode": mode or f"{record['width']}x{record['height']}",
        "direction": None if result.lamps else "upwards" if REVERSED in result.warnings else "downwards",
        "lines": result.n_lines,
        **{key: record[key] for key in ("width", "height", "axis", "line_delay_s", "readout_s", "warnings")},
        **{f"{key}_interval95_s": record[f"{key}_interval_s"] for key in ("line_delay", "readout")},
    }


def _frames(paths: list[Path], n: int) -> list[Frame]:
    """Stills, and up to `n` frames of each clip, five apart, so that each shows the lamp anew; all of one size."""
    frames = [frame for path in paths for frame in islice(open_source(path), 0, 5 * n, 5)]
    sizes = sorted({f"{frame.width}x{frame.height}" for frame in frames})
    if len(sizes) > 1:
        reason = f"the pictures are of different sizes ({', '.join(sizes)})"
        raise UsageError(reason, "calibrate one readout mode at a time")
    return frames


def _with_shutter(profile: CameraProfile, result: ShutterCalibration, name: str | None = None) -> CameraProfile:
    """The profile with the readout mode that was measured, and the lens that was estimated with it."""
    if result.axis == "columns":
        reason = "the readout runs along the columns: the stored picture was rotated, and profiles hold stored rows"
        raise UsageError(reason, "calibrate with an unrotated picture")
    if name is not None and not NAME.fullmatch(name):
        raise UsageError(f"--mode {name!r} cannot name a mode", _NAME_HINT)
    height, width = result.shape
    name = name or f"{width}x{height}"
    mode = ReadoutMode(name=name, width=width, height=height, line_delay_s=result.line_delay_s)
    profile = with_mode(profile, mode)
    return profile if result.lens is None else with_lens(profile, result.lens)


def _shutter_report(result: ShutterCalibration) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """The record of the JSON, and the lines for people."""
    keys = ("readout_s", "readout_interval_s", "line_delay_s", "line_delay_interval_s", "periods", "axis")
    of_lamp = ("picture", "bounds", "frequency_hz", "period_px", "period_sd_px", "line_delay_s")
    of_fit = ("periods", "explained")
    exposure = result.exposure
    record: dict[str, Any] = {key: getattr(result, key) for key in keys}
    record["warnings"] = [*result.warnings, *result.doubts]
    record |= {"height": result.shape[0], "width": result.shape[1], "exposure_s": exposure.exposure_s}
    record |= {"exposure_interval_s": exposure.interval_s, "exposure_note": exposure.comment}
    record["lens"] = None if result.lens is None else _lens_record(result.lens)
    record["lamps"] = [
        {key: getattr(lamp, key) for key in of_lamp} | {key: getattr(lamp.fit, key) for key in of_fit}
        for lamp in result.lamps
    ]
    readout, *interval = (f"{value * 1e3:.4f}" for value in (result.readout_s, *result.readout_interval_s))
    delay, *around = (f"{value * 1e6:.5f}" for value in (result.line_delay_s, *result.line_delay_interval_s))
    exposed = "unknown" if exposure.exposure_s is None else f"{exposure.exposure_s * 1e6:.1f} us"
    lines = [
        ("readout", f"{readout} ms over {result.n_lines} {result.axis} (95 %: {' to '.join(interval)})"),
        ("line delay", f"{delay} us (95 %: {' to '.join(around)})"),
        ("periods", f"{result.periods:.2f}"),
        ("exposure", f"{exposed} ({exposure.comment})"),
        *([] if result.lens is None else [_distortion(result.lens)]),
    ]
    for lamp in result.lamps:
        frequency = "unknown frequency" if lamp.frequency_hz is None else f"{lamp.frequency_hz:g} Hz"
        lines.append(("lamp", f"{frequency} at {lamp.bounds}, period {lamp.period_px:.3f} px"))
    return record, lines


@calibrate.command(short_help="A lens that the lensfun database knows.")
@click.argument("path", type=_PATH)
@options(
    ("--make", str, None, "Camera maker, where the file does not hold it."),
    ("--camera-model model", str, None, "Camera model, where the file does not hold it."),
    ("--lens", str, None, "Lens as lensfun names it, where the file does not hold it."),
    ("--focal-length focal_length_mm", click.FloatRange(0, 5000, min_open=True), None, "Millimetres."),
    *_RESULTS,
)
@force_argument
def lensfun(path: Path, **given: Any) -> None:
    """Lens model of the picture PATH from the lensfun database, by camera, lens and focal length (extra [lensfun])."""
    wanted = _Results(given)
    wanted.claim([path], "camera", "lens", "camera_matrix")
    frame = next(open_source(path))
    metadata = replace(frame.metadata, **{key: value for key, value in given.items() if value})
    found = lens_from_database(metadata, frame.width, frame.height)
    at = f" at {metadata.focal_length_mm:g} mm"
    record, lines = _converted_report(found, at, "lensfun's own")
    wanted.write(record, lines, metadata, lambda profile: with_lens(profile, found.lens, metadata.lens))


@calibrate.command(short_help="A lens from a Gyroflow profile; its readout, checked.")
@click.argument("path", type=_PATH)
@options(
    ("--size=WxH", Numbers("3840x2160"), None, "Size of the pictures it is for. [default: as calibrated]"),
    ("--photo", _PATH, None, "Check the readout with this picture of a screen."),
    ("--screen=NAME|FILE", str, None, "The screen of --photo."),
    *_RESULTS,
)
@force_argument
def gyroflow(path: Path, size: tuple[int, int] | None, photo: Path | None, screen: str | None, **given: Any) -> None:
    """Lens model from PATH, a lens profile of the Gyroflow community (.json).

    A user typed in the readout of such a profile. It is written only where it is measured on a picture of a known
    screen (--photo and --screen), and then as measured.
    """
    if (photo is None) != (screen is None):
        raise UsageError("--photo and --screen belong together", "give both, or neither")
    wanted = _Results(given)
    wanted.claim([path, *([photo] if photo else [])], "camera", "lens", "camera_matrix", screen=screen)
    found, measured = load_gyroflow(path, size), None
    if photo and screen:
        measured = calibrate_slots(_frames([photo], 8), load_profile(screen, ScreenProfile))
    notes = [*found.notes, *([_agreement(found.readout_s, measured.readout_s)] if measured else [])]

    def extended(profile: CameraProfile) -> CameraProfile:
        return with_lens(_with_shutter(profile, measured) if measured else profile, found.lens, found.lens_name or None)

    at = f", {found.lens.width} x {found.lens.height}"
    record, lines = _converted_report(found, at, "the fisheye model")
    record |= {"readout_told_s": found.readout_s, "reversed": found.reversed, "notes": notes}
    record["readout_measured_s"] = measured.readout_s if measured else None
    lines += [("readout", warning) for warning in notes]
    wanted.write(record, lines, Metadata(make=found.make or None, model=found.model or None), extended)


def _agreement(profile_s: float | None, measured_s: float) -> str:
    """Compare the readout in the profile with the one in the picture."""
    if profile_s is None:
        return f"the picture gives {measured_s * 1e3:.2f} ms"
    error = profile_s / measured_s - 1
    verdict = "agrees with" if abs(error) < 0.01 else f"is {100 * abs(error):.0f} % {'above' if error > 0 else 'below'}"
    return f"the profile's readout ({profile_s * 1e3:.2f} ms) {verdict} the picture's ({measured_s * 1e3:.2f} ms)"
