"""`vlc-rx calibrate`: lens and shutter of a camera, into a camera profile."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rxcli.cli.common import claim_outputs, force_argument, json_output, options, write_json
from rxcli.cli.groups import SuggestingGroup
from rxcli.errors import InputError, UsageError

if TYPE_CHECKING:
    from rxcli.calibrate.lens import Board, GrayImage, LensCalibration, Rejected
    from rxcli.calibrate.shutter import ShutterCalibration
    from rxcli.profiles import CameraProfile, LensModel, ReadoutMode
    from rxcli.types import Frame, Metadata

_FILE = click.Path(dir_okay=False, path_type=Path)
_PATHS = click.argument("paths", nargs=-1, required=True, type=click.Path(path_type=Path))
#: Where what was found goes: the options that `_Results` takes.
_RESULTS = (
    ("--save", _FILE, None, "Camera profile to write, or to add to."),
    ("--name", str, None, "Keep it as the camera NAME, for --camera NAME from anywhere."),
    ("--json=FILE|- json_path", click.Path(allow_dash=True), None, "Write the result as JSON."),
)


@click.group(cls=SuggestingGroup)
def calibrate() -> None:
    """Measure a camera's lens or shutter and keep it in a camera profile."""


@calibrate.command(short_help="A lens, from pictures of a chessboard.")
@_PATHS
@options(
    ("--board board_size", str, "9x6", "Inner corners, across x down."),
    ("--square square_mm", float, 25.0, "Side of a square, mm."),
    ("--charuco=DICT dictionary", str, None, "ChArUco board of this dictionary (DICT_5X5_100, ...)."),
    ("--marker marker_ratio", float, 0.75, "Marker over square side."),
    ("--every", click.IntRange(1), 10, "Use every Nth frame of a clip."),
    ("--picture", _FILE, None, "Draw the residuals into this PNG."),
    *_RESULTS,
)
@force_argument
def lens(
    paths: tuple[Path, ...],
    board_size: str,
    square_mm: float,
    dictionary: str | None,
    marker_ratio: float,
    every: int,
    picture: Path | None,
    **results: Any,
) -> None:
    """Lens model from PATHS: pictures of a chessboard or ChArUco board, folders of them, or clips.

    Pictures are taken as stored, never rotated. Fill the field out to its corners and tilt the board both ways.
    """
    from rxcli.calibrate.lens import calibrate_lens, find_boards
    from rxcli.calibrate.saving import with_lens

    board = _board(board_size, square_mm, dictionary, marker_ratio)
    wanted, files = _Results(**results), _files(paths)
    wanted.claim(files, ("rms_px", "camera_matrix"), picture=picture)
    reader = _BoardReader(every)
    found, width, height = find_boards(reader.read(files), board)
    result = calibrate_lens([*reader.unreadable, *found], width, height)
    if picture is not None:
        from rxcli.calibrate.picture import write_residuals

        write_residuals(result, picture)
    lens_name = reader.metadata.lens if reader.metadata else None
    wanted.extend(reader.metadata, lambda profile: with_lens(profile, result.model, lens_name))
    wanted.tell(_lens_record(result), _lens_lines(result))


def _board(size: str, square_mm: float, dictionary: str | None, marker_ratio: float) -> Board:
    from rxcli.calibrate.lens import Board

    found = re.fullmatch(r"(\d{1,3})[xX](\d{1,3})", size)
    if not found:
        raise UsageError(f"--board {size!r} is not COLUMNSxROWS of inner corners", "write it as 9x6")
    return Board(int(found[1]), int(found[2]), square_mm, dictionary, marker_ratio)


class _Results:
    """The profile that a command extends, and the JSON that it writes.

    Args:
        save: file of the profile.
        name: of the profile, in place of a file.
        json_path: file of the JSON, "-" for stdout; None: text on stdout.
        force: replace files that others wrote.

    Raises:
        UsageError: both say where the profile goes, or the name is none.
    """

    def __init__(self, save: Path | None, name: str | None, json_path: str | None, force: bool) -> None:
        self._json_path, self._force = json_path, force
        if name is not None and save is not None:
            raise UsageError("--save and --name both say where the profile goes", "give one of them")
        self._target = save if name is None else _file_of(name)

    def claim(
        self, read: list[Path], json_keys: tuple[str, ...], screen: str | None = None, picture: Path | None = None
    ) -> None:
        """Refuse outputs that would destroy something; the profile may be added to.

        Args:
            read: files that the command reads.
            json_keys: what an earlier JSON of it holds.
            screen: name or file of a profile that it reads.
            picture: that it writes.
        """
        from rxcli import outputs

        found = [json_output(self._json_path, *json_keys)]
        if self._target is not None:
            found.append(outputs.Output("--save", self._target, outputs.CAMERA, makes_folder=True))
        if picture is not None:
            found.append(outputs.Output("--picture", picture, outputs.PICTURE))
        claim_outputs(found, read, (screen,), self._force)

    def extend(self, metadata: Metadata | None, extended: Callable[[CameraProfile], CameraProfile]) -> None:
        """Write the profile, where one is asked for: that of the camera in `metadata`, extended."""
        from rxcli.calibrate.saving import profile_to_extend, write_profile

        if self._target is not None:
            write_profile(extended(profile_to_extend(self._target, metadata)), self._target)

    def tell(self, record: dict[str, Any], lines: Iterable[str]) -> None:
        """Write what was found as JSON, and as lines unless that went to stdout."""
        if self._json_path is not None:
            write_json({**record, "profile": None if self._target is None else str(self._target)}, self._json_path)
        if self._json_path != "-":
            click.echo("\n".join([*lines, *([] if self._target is None else [f"written     {self._target}"])]))


def _file_of(name: str) -> Path:
    """The user's camera profile of a name."""
    from rxcli.profiles import NAME
    from rxcli.resources import user_dir

    if not NAME.fullmatch(name):
        raise UsageError(f"--name {name!r} cannot name a profile", "use letters, digits, dots, dashes and underscores")
    return user_dir() / "cameras" / f"{name}.toml"


def _model_record(model: LensModel) -> dict[str, Any]:
    return {
        "camera_matrix": [list(row) for row in model.camera_matrix],
        "dist_coeffs": list(model.dist_coeffs),
        "width": model.width,
        "height": model.height,
    }


def _distortion(model: LensModel) -> str:
    return "distortion  " + " ".join(f"{value:.5f}" for value in model.dist_coeffs) + "  (k1 k2 p1 p2 k3)"


class _BoardReader:
    """Reads board pictures one by one; remembers what could not be read and the first camera's metadata."""

    def __init__(self, every: int) -> None:
        self._every = every
        self.unreadable: list[Rejected] = []
        self.metadata: Metadata | None = None

    def read(self, paths: list[Path]) -> Iterator[tuple[str, GrayImage]]:
        from rxcli.calibrate.frames import gray_of
        from rxcli.calibrate.lens import Rejected
        from rxcli.ingest import open_source

        for path in paths:
            try:
                for frame in islice(open_source(path), 0, None, self._every):
                    self.metadata = self.metadata or frame.metadata
                    yield (f"{path}#{frame.index}" if frame.index else str(path)), gray_of(frame)
            except InputError as error:
                self.unreadable.append(Rejected(str(path), error.message.removeprefix(f"{path}: ")))


def _files(paths: tuple[Path, ...]) -> list[Path]:
    """The files named, and those of known suffix in the folders named."""
    from rxcli.ingest import KNOWN_SUFFIXES

    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            files += sorted(p for p in path.rglob("*") if p.is_file() and p.suffix.lower() in KNOWN_SUFFIXES)
        else:
            files.append(path)
    if not files:
        raise InputError(f"{', '.join(map(str, paths))}: no pictures or clips", "name files or another folder")
    return files


def _lens_lines(result: LensCalibration) -> Iterator[str]:
    matrix = result.model.camera_matrix
    yield f"RMS         {result.rms_px:.3f} px ({result.detector} corners of {len(result.accepted)} boards)"
    yield f"fx fy       {matrix[0][0]:.2f} {matrix[1][1]:.2f} px (+- {result.intrinsic_sd_px[0]:.2f})"
    yield f"cx cy       {matrix[0][2]:.2f} {matrix[1][2]:.2f} px (+- {result.intrinsic_sd_px[2]:.2f})"
    yield _distortion(result.model)
    yield from (f"rejected    {rejected.name}: {rejected.reason}" for rejected in result.rejected)
    if result.uncovered:
        yield f"no corners  {', '.join(result.uncovered)}"


def _lens_record(result: LensCalibration) -> dict[str, Any]:
    return {
        "rms_px": result.rms_px,
        **_model_record(result.model),
        "detector": result.detector,
        "accepted": [{"name": name, "rms_px": rms} for name, rms in result.accepted.items()],
        "rejected": [{"name": r.name, "reason": r.reason} for r in result.rejected],
        "uncovered": list(result.uncovered),
        "intrinsic_sd_px": list(result.intrinsic_sd_px),
    }


@calibrate.command(short_help="Readout and line delay, from a blinking lamp.")
@_PATHS
@options(
    ("--frequency=HZ frequencies", [float], None, "Lamp; may be repeated."),
    ("--screen=NAME|FILE", str, None, "Screen profile, whose slot rate is known, instead of a lamp."),
    ("--axis", ("auto", "rows", "columns"), "auto", "Readout axis."),
    ("--region=X,Y,W,H", str, None, "Look at this part of the pictures only, stored pixels."),
    ("--exposure exposure_s", float, None, "Exposure in seconds, where the files do not tell it."),
    ("--frames", click.IntRange(1), 8, "Frames used of a clip."),
    ("--mode mode_name", str, None, "Name of the readout mode to save.  [default: by the size, as 1920x1080]"),
    *_RESULTS,
)
@force_argument
def shutter(
    paths: tuple[Path, ...],
    frequencies: tuple[float, ...],
    screen: str | None,
    axis: str,
    region: str | None,
    exposure_s: float | None,
    frames: int,
    mode_name: str | None,
    **results: Any,
) -> None:
    """Line delay and readout from PATHS: pictures or clips, of one readout mode, of blinking lamps.

    Let the lamp fill much of the frame, out of focus, with an exposure well below half a period.
    """
    from rxcli.calibrate.saving import with_mode

    if bool(frequencies) == bool(screen):
        raise UsageError("either --frequency or --screen is needed", "say what the lamp blinks at, as --frequency 1000")
    _check_positive(frequencies, exposure_s)
    wanted, window, files = _Results(**results), _window(region), _files(paths)
    wanted.claim(files, ("readout_s", "line_delay_s"), screen)
    chosen = [frame for path in files for frame in _some_frames(path, frames)]
    result = _measure(chosen, frequencies, screen, axis, window, exposure_s)
    wanted.extend(chosen[0].metadata, lambda profile: with_mode(profile, _mode(result, mode_name)))
    for warning in result.warnings:
        click.echo(f"vlc-rx: {warning}", err=True)
    wanted.tell(_shutter_record(result), _shutter_lines(result))


def _check_positive(frequencies: tuple[float, ...], exposure_s: float | None) -> None:
    for frequency in frequencies:
        if not (0 < frequency < 1e7):
            raise UsageError(f"--frequency must be above 0 and below 1e7 Hz (got {frequency:g})", "give it in hertz")
    if exposure_s is not None and not (0 < exposure_s < 1):
        raise UsageError(f"--exposure must be above 0 and below 1 s (got {exposure_s:g})", "give it in seconds")


def _window(region: str | None) -> tuple[int, int, int, int] | None:
    """X, Y, W, H of the part looked at."""
    if region is None:
        return None
    found = re.fullmatch(r"(\d{1,6}),(\d{1,6}),(\d{1,6}),(\d{1,6})", region)
    if not found or min(int(found[3]), int(found[4])) < 24:
        raise UsageError(f"--region {region!r} is not X,Y,W,H of at least 24 x 24 pixels", "write it as 100,80,640,400")
    return int(found[1]), int(found[2]), int(found[3]), int(found[4])


def _some_frames(path: Path, n: int) -> list[Frame]:
    """A still's frame, or up to `n` frames of a clip, five apart, so that each shows the lamp anew."""
    from rxcli.ingest import open_source

    return list(islice(open_source(path), 0, 5 * n, 5))


def _measure(
    frames: list[Frame],
    frequencies: tuple[float, ...],
    screen: str | None,
    axis: str,
    window: tuple[int, int, int, int] | None,
    exposure_s: float | None,
) -> ShutterCalibration:
    from rxcli.calibrate.frames import light_of
    from rxcli.calibrate.shutter import calibrate_shutter

    sizes = {(frame.width, frame.height) for frame in frames}
    if len(sizes) > 1:
        shown = ", ".join(f"{w}x{h}" for w, h in sorted(sizes))
        raise UsageError(f"the pictures are of different sizes ({shown})", "calibrate one readout mode at a time")
    if screen is not None:
        return _measure_screen(frames, screen, axis, window)
    known = exposure_s if exposure_s is not None else frames[0].metadata.exposure_s
    along = None if axis == "auto" else axis
    if frames[0].mosaic is not None:
        along = "rows"  # a RAW file's rows are the sensor's
    return calibrate_shutter(
        [light_of(frame) for frame in frames],
        frequencies,
        axis=along,  # type: ignore[arg-type]  # one of the choices
        exif_exposure_s=known,
        window=window,
        tone_known=frames[0].mosaic is not None or frames[0].linear,
    )


def _measure_screen(
    frames: list[Frame], screen: str, axis: str, window: tuple[int, int, int, int] | None
) -> ShutterCalibration:
    from rxcli.calibrate.bent import calibrate_bent
    from rxcli.calibrate.frames import light_of
    from rxcli.calibrate.slots import calibrate_slots
    from rxcli.profiles import ScreenProfile, load_profile

    if window is not None:
        raise UsageError("--region goes with --frequency only", "leave it out")
    profile = load_profile(screen, ScreenProfile)
    along: Any = "rows" if axis == "auto" else axis
    bent = calibrate_bent(frames, profile) if along == "rows" else None
    return bent or calibrate_slots(
        [light_of(frame) for frame in frames], profile.slot_rate_hz, profile.packet_slots, along
    )


def _mode(result: ShutterCalibration, name: str | None) -> ReadoutMode:
    """The readout mode that was measured."""
    from rxcli.profiles import NAME, ReadoutMode

    if result.axis == "columns":
        raise UsageError(
            "the readout runs along the columns: the stored picture was rotated, and profiles hold stored rows",
            "calibrate with an unrotated picture",
        )
    if name is not None and not NAME.fullmatch(name):
        raise UsageError(f"--mode {name!r} cannot name a mode", "use letters, digits, dots, dashes and underscores")
    height, width = result.shape
    return ReadoutMode(name=name or f"{width}x{height}", width=width, height=height, line_delay_s=result.line_delay_s)


def _shutter_lines(result: ShutterCalibration) -> Iterator[str]:
    low, high = result.readout_interval_s
    yield (
        f"readout     {result.readout_s * 1e3:.4f} ms over {result.n_lines} {result.axis} "
        f"(95 %: {low * 1e3:.4f} to {high * 1e3:.4f})"
    )
    low, high = result.line_delay_interval_s
    yield f"line delay  {result.line_delay_s * 1e6:.5f} us (95 %: {low * 1e6:.5f} to {high * 1e6:.5f})"
    yield f"periods     {result.periods:.2f}"
    exposure = "unknown" if result.exposure_s is None else f"{result.exposure_s * 1e6:.1f} us"
    yield f"exposure    {exposure} ({result.exposure_note})"
    for lamp in result.lamps:
        frequency = "unknown frequency" if lamp.frequency_hz is None else f"{lamp.frequency_hz:g} Hz"
        yield f"lamp        {frequency} at {lamp.stripes.bounds}, period {lamp.stripes.period_px:.3f} px"


def _shutter_record(result: ShutterCalibration) -> dict[str, Any]:
    return {
        "readout_s": result.readout_s,
        "readout_interval_s": list(result.readout_interval_s),
        "line_delay_s": result.line_delay_s,
        "line_delay_interval_s": list(result.line_delay_interval_s),
        "periods": result.periods,
        "axis": result.axis,
        "width": result.shape[1],
        "height": result.shape[0],
        "exposure_s": result.exposure_s,
        "exposure_interval_s": list(result.exposure_interval_s) if result.exposure_interval_s else None,
        "exposure_note": result.exposure_note,
        "lamps": [
            {
                "picture": lamp.picture,
                "bounds": list(lamp.stripes.bounds),
                "frequency_hz": lamp.frequency_hz,
                "period_px": lamp.stripes.period_px,
                "period_sd_px": lamp.stripes.period_sd_px,
                "periods": lamp.stripes.periods,
                "line_delay_s": lamp.line_delay_s,
                "explained": lamp.stripes.explained,
            }
            for lamp in result.lamps
        ],
        "warnings": list(result.warnings),
    }


@calibrate.command(short_help="A lens that the lensfun database knows.")
@click.argument("path", type=click.Path(path_type=Path))
@options(
    ("--make", str, None, "Camera maker, where the file does not tell it."),
    ("--camera-model model", str, None, "Camera model, where the file does not tell it."),
    ("--lens lens_name", str, None, "Lens as lensfun names it, where the file does not tell it."),
    ("--focal-length focal_mm", click.FloatRange(0, 5000, min_open=True), None, "Millimetres."),
    *_RESULTS,
)
@force_argument
def lensfun(
    path: Path, make: str | None, model: str | None, lens_name: str | None, focal_mm: float | None, **results: Any
) -> None:
    """Lens model of the picture PATH from the lensfun database, by camera, lens and focal length (extra [lensfun])."""
    from dataclasses import replace

    from rxcli.calibrate.lensfun import lens_from_database
    from rxcli.calibrate.saving import with_lens
    from rxcli.ingest import open_source

    wanted = _Results(**results)
    wanted.claim([path], ("camera", "lens", "camera_matrix"))
    frame = next(open_source(path))
    told = frame.metadata
    metadata = replace(
        told,
        make=make or told.make,
        model=model or told.model,
        lens=lens_name or told.lens,
        focal_length_mm=focal_mm or told.focal_length_mm,
    )
    found = lens_from_database(metadata, frame.width, frame.height)
    wanted.extend(metadata, lambda profile: with_lens(profile, found.lens, metadata.lens))
    names = {"camera": found.camera_name, "lens": found.lens_name}
    lines = [
        f"camera      {found.camera_name}",
        f"lens        {found.lens_name} at {metadata.focal_length_mm:g} mm",
        f"focal       {found.lens.camera_matrix[0][0]:.1f} px",
        _distortion(found.lens),
        f"conversion  within {found.worst_px:.2f} px of lensfun's own",
    ]
    wanted.tell({**names, **_model_record(found.lens), "worst_px": found.worst_px}, lines)


@calibrate.command(short_help="A lens from a Gyroflow profile; its readout, checked.")
@click.argument("path", type=click.Path(path_type=Path))
@options(
    ("--size=WxH", str, None, "Size of the pictures it is for. [default: as calibrated]"),
    ("--photo", click.Path(path_type=Path), None, "Check the readout with this picture of a screen."),
    ("--screen=NAME|FILE", str, None, "The screen of --photo."),
    *_RESULTS,
)
@force_argument
def gyroflow(path: Path, size: str | None, photo: Path | None, screen: str | None, **results: Any) -> None:
    """Lens model from PATH, a lens profile of the Gyroflow community (.json).

    The readout in such a profile is what some user told. It is written only where a picture of a known screen (--photo
    and --screen) bears it out, and then as the picture measures it.
    """
    from rxcli.calibrate.gyroflow import load_gyroflow
    from rxcli.calibrate.saving import with_lens, with_mode
    from rxcli.types import Metadata

    if (photo is None) != (screen is None):
        raise UsageError("--photo and --screen belong together", "give both, or neither")
    wanted = _Results(**results)
    wanted.claim([path] if photo is None else [path, photo], ("camera", "lens", "camera_matrix"), screen)
    found = load_gyroflow(path, _size(size))
    measured = None if photo is None else _measure(_some_frames(photo, 8), (), screen, "auto", None, None)
    notes = [*found.notes, *([] if measured is None else [_agreement(found.readout_s, measured.readout_s)])]

    def extended(profile: CameraProfile) -> CameraProfile:
        profile = with_lens(profile, found.lens, found.lens_name or None)
        return profile if measured is None else with_mode(profile, _mode(measured, None))

    wanted.extend(Metadata(make=found.make or None, model=found.model or None), extended)
    record = {
        "camera": f"{found.make} {found.model}".strip(),
        "lens": found.lens_name,
        **_model_record(found.lens),
        "worst_px": found.worst_px,
        "readout_told_s": found.readout_s,
        "readout_measured_s": measured.readout_s if measured else None,
        "reversed": found.reversed,
        "notes": notes,
    }
    lines = [
        f"camera      {record['camera'] or 'not told'}",
        f"lens        {found.lens_name or 'not told'}, {found.lens.width} x {found.lens.height}",
        f"focal       {found.lens.camera_matrix[0][0]:.1f} px",
        _distortion(found.lens),
        f"conversion  within {found.worst_px:.2f} px of the fisheye model",
    ]
    wanted.tell(record, [*lines, *(f"readout     {note}" for note in notes)])


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    found = re.fullmatch(r"([1-9]\d{0,4})[xX]([1-9]\d{0,4})", text)
    if not found:
        raise UsageError(f"--size {text!r} is not WIDTHxHEIGHT", "write it as 3840x2160")
    return int(found[1]), int(found[2])


def _agreement(told_s: float | None, measured_s: float) -> str:
    """What the picture says of the readout that the profile tells."""
    if told_s is None:
        return f"the picture says {measured_s * 1e3:.2f} ms"
    apart = told_s / measured_s - 1
    verdict = "agrees with" if abs(apart) < 0.01 else f"is {100 * abs(apart):.0f} % {'above' if apart > 0 else 'below'}"
    return f"the readout told ({told_s * 1e3:.2f} ms) {verdict} what the picture says ({measured_s * 1e3:.2f} ms)"
