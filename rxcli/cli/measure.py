"""`vlc-rx measure`: what blinks in a photo or clip, how fast, how long it is lit and how deeply it dims."""

from dataclasses import asdict
from itertools import islice
from pathlib import Path
from typing import Any

import click

from rxcli.calibrate.frames import frame_light
from rxcli.calibrate.measure import Lamp, Timing, draw_lamps, measure_lamp
from rxcli.calibrate.shutter import Stripes, find_stripes, not_found
from rxcli.cli.common import force_argument, json_output, options, output, refuse, write_json
from rxcli.cli.kinds import CAMERA, FILE, Exposure
from rxcli.errors import InputError, ReceiverError
from rxcli.ingest import open_source
from rxcli.outputs import PICTURE, claim, encode_png, write_whole
from rxcli.profiles import CameraProfile, known_profiles, load_profile, match_camera
from rxcli.results.record import plain
from rxcli.results.report import format_table
from rxcli.types import Frame

#: Relative standard deviation of line delays: of a profile or an option, and as files state the readout.
_EXACT, _STATED = 0.0, 0.03
_TITLE = ("lamp at", "stripes", "frequency", "lit share", "depth", "no stripes at exposures of", "stand still at")
_OF_DOUBT = ("bounds", "period_px", "period_sd_px", "lean")


@click.command()
@click.argument("path", type=click.Path(path_type=Path))
@options(
    ("--camera=NAME|FILE", CAMERA, None, "Camera profile with the readout of such pictures. [default: by the file]"),
    ("--line-delay line_delay_s", click.FloatRange(1e-9, 1), None, "Seconds from one row to the next."),
    ("--readout readout_s", click.FloatRange(1e-6, 1), None, "Seconds from the first row to the last."),
    ("--exposure exposure_s", Exposure(), None, "Exposure, where the file does not hold it."),
    ("--axis", ("auto", "rows", "columns"), "auto", "Readout axis."),
    ("--frame", click.IntRange(0), 0, "Frame of a clip."),
    ("--picture", FILE, None, "Draw lamps and waveforms into this PNG."),
    ("--json=FILE|- json_path", click.Path(allow_dash=True), None, "Write the result as JSON."),
)
@force_argument
def measure(path: Path, frame: int, axis: str, picture: Path | None, force: bool, **given: Any) -> None:
    """Measure every light that blinks in the photo or clip PATH: frequency, lit share, depth of modulation, waveform.

    It needs stripes: a rolling shutter and a short exposure. Without the camera's timing, ratios are printed.
    """
    n_stated = sum(given[name] is not None for name in ("camera", "line_delay_s", "readout_s"))
    refuse((n_stated > 1, "--camera, --line-delay and --readout all state the camera's timing", "give one of them"))
    json_path = given["json_path"]
    drawn = output("--picture", picture, PICTURE)
    claim([json_output(json_path, "axis", "lamps"), drawn], [path], (given["camera"],), force)
    frames = list(islice(open_source(path), frame, frame + 2))
    if not frames:
        raise InputError(f"{path}: has no frame {frame}", "choose a lower --frame")
    shown, light = frames[0], frame_light(frames[0])
    asked: Any = "rows" if shown.mosaic is not None else None if axis == "auto" else axis
    exposure_s = given["exposure_s"] or shown.metadata.exposure_s
    along, found = find_stripes(light, asked)
    n_rows = shown.height if along == "rows" else shown.width
    timing = _timing(shown, n_rows, given)
    found.sort(key=lambda stripes: -stripes.area_px)
    linear = shown.mosaic is not None or shown.linear
    lamps = [measure_lamp(stripes, timing, exposure_s, linear) for stripes in found if stripes.is_lamp]
    doubtful = [stripes for stripes in found if not stripes.is_lamp]
    if not lamps:
        if doubtful:
            raise ReceiverError(f"no stripes surely of a blinking lamp in {path}", _doubt(doubtful))
        raise not_found(str(path), [light])
    notes = _notes(frames, lamps, timing, n_rows) + ([_doubt(doubtful)] if doubtful else [])
    for sentence in dict.fromkeys([*notes, *(text for lamp in lamps for text in lamp.notes)]):
        click.echo(f"vlc-rx: {sentence}", err=True)
    if picture is not None:
        write_whole(picture, encode_png(draw_lamps(light, lamps, [", ".join(_cells(x, lamps)[2:5]) for x in lamps])))
    record = {"source": str(path), "axis": along, "width": shown.width, "height": shown.height}
    record |= {"line_delay_s": timing and timing.line_delay_s, "timing": timing and timing.source, "notes": notes}
    record["exposure_s"] = exposure_s
    record["doubtful"] = [plain({key: getattr(stripes, key) for key in _OF_DOUBT}) for stripes in doubtful]
    record["lamps"] = [plain(asdict(lamp) | _avoided(lamp)) for lamp in lamps]
    write_json(record, json_path)
    if json_path != "-":
        click.echo(format_table(_TITLE, [_cells(lamp, lamps) for lamp in lamps]))


def _doubt(doubtful: list[Stripes]) -> str:
    largest = doubtful[0]
    where = f"of {largest.period_px:.4g} px at {largest.bounds[0]},{largest.bounds[1]}"
    count = f"{len(doubtful)} region{'s' * (len(doubtful) > 1)} of stripes ({where})"
    return f"{count} may be texture, no lamp; in a second picture, exposed otherwise, a lamp's stripes are elsewhere"


def _timing(frame: Frame, n_rows: int, given: dict[str, Any]) -> Timing | None:
    """Line delay by the options, the profile that is named or fits the file, or what the file states."""
    if given["line_delay_s"]:
        return Timing(given["line_delay_s"], _EXACT, "--line-delay")
    if given["readout_s"]:
        return Timing(given["readout_s"] / n_rows, _EXACT, "--readout")
    named = given["camera"] not in (None, "auto")
    known = [] if named else [profile for profile, _, _ in known_profiles(CameraProfile)]
    size, metadata = (frame.width, frame.height), frame.metadata
    camera = load_profile(given["camera"], CameraProfile) if named else None
    camera = camera or match_camera(known, metadata.make, metadata.model, *size)
    mode = camera and (camera.mode_for(*size) or camera.mode_for(*size[::-1]))
    if camera and mode:
        return Timing(mode.line_delay_s, _EXACT, f"camera {camera.name}")
    sizes = f"{size[0]}x{size[1]}"
    refuse((named, f"--camera {given['camera']}: has no readout mode of {sizes}", "name another, or give --readout"))
    if metadata.readout_s:
        return Timing(metadata.readout_s / n_rows, _STATED, "the file")
    return None


def _notes(frames: list[Frame], lamps: list[Lamp], timing: Timing | None, n_rows: int) -> list[str]:
    """How far the frequencies are known."""
    if timing:
        return []
    options = "give --camera, --readout or --line-delay"
    if len(frames) > 1 and (step_s := frames[1].time_s - frames[0].time_s) > 0:
        lowest = n_rows / lamps[0].period_px / step_s
        known = f"a frame takes {1e3 * step_s:.1f} ms at most, so lamp 1 blinks at {lowest:.4g} Hz or more"
        return [f"the camera's readout is not known: {known}; {options} for hertz"]
    return [f"the camera's readout is not known: frequencies are ratios to lamp 1; {options}"]


def _avoided(lamp: Lamp) -> dict[str, Any]:
    return {"no_stripes_exposures_s": lamp.exposures_s(), "standing_frame_rates_hz": lamp.frame_rates_hz()}


def _cells(lamp: Lamp, lamps: list[Lamp]) -> list[str]:
    """One row of the table."""
    left, top, right, bottom = lamp.bounds
    if lamp.frequency_hz and lamp.frequency_interval_hz:
        error = (lamp.frequency_interval_hz[1] - lamp.frequency_interval_hz[0]) / 2
        frequency = f"{lamp.frequency_hz:.6g} +- {error:.2g} Hz"
    else:
        frequency = f"{lamps[0].period_px / lamp.period_px:.5g} x lamp 1"
    duty = "open" if lamp.duty is None or lamp.duty_interval is None else _percent(lamp.duty, lamp.duty_interval)
    exposures = " ".join(f"1/{1 / seconds:.4g}" for seconds in lamp.exposures_s()) or "-"
    rates = " ".join(f"{hz:.4g}" for hz in lamp.frame_rates_hz()) or "-"
    place = f"{left},{top} {right - left}x{bottom - top}"
    depth = _percent(lamp.depth, lamp.depth_interval)
    return [place, f"{lamp.periods:.1f}", frequency, duty, depth, exposures + " s", rates + " fps"]


def _percent(value: float, interval: tuple[float, float]) -> str:
    return f"{100 * value:.1f} % ({100 * interval[0]:.1f} to {100 * interval[1]:.1f})"
