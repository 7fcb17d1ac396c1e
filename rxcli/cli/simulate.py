"""`vlc-rx simulate`: captures with truth."""

import json
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

from rxcli import outputs
from rxcli.cli.common import field_table, force_argument, options, output, refuse
from rxcli.cli.kinds import FILE, FOLDER, POSITIVE, Exposure, Numbers
from rxcli.cli.printing import with_progress
from rxcli.cli.sending import payload_bytes, sending_of
from rxcli.errors import UsageError, failure_explained
from rxcli.lab.simulate.capture import Recording, prepare, write_capture
from rxcli.lab.simulate.files import CODECS
from rxcli.lab.simulate.pictures import picture_names
from rxcli.lab.simulate.scenes import PRESETS, Scene, preset, with_fields
from rxcli.lab.simulate.transmitter import PICTURE_FILES, Weights, export_picture
from rxcli.lab.simulate.truth import build_camera_profile
from rxcli.link.slots import WRITERS, read_slots
from rxcli.profiles import ScreenProfile, dump_profile
from rxcli.results.truth import truth_path

_STILLS = ("jpeg", "dng", "dng14", "png", "png16", "tiff", "tiff16")
_FORMATS = (*_STILLS, *CODECS)
_SUFFIXES = {".jpg": "jpeg", ".jpeg": "jpeg", ".dng": "dng", ".png": "png", ".tif": "tiff", ".tiff": "tiff"}
_VIDEO_SUFFIXES = {".mp4": "h264", ".mov": "h264", ".mkv": "h264", ".avi": "mjpeg"}

#: Slots among the files of --waveforms.
_SLOT_FILE = "slots.csv"
_CORNERS, _DELAYS = Numbers("120.5,80,900,80,900,600,120.5,600"), Numbers("0.1,0.25", any_count=True)
#: Options that are fields of the scene by the same name.
_SCENE_OPTIONS = ("picture", "n_frames", "frame_rate_hz", "start_slot", "slot_rate_error_ppm", "hand_px")


def _list(context: click.Context, _parameter: click.Parameter, wanted: bool) -> None:
    """Print the names of pictures and end."""
    if wanted:
        click.echo("\n".join(picture_names()))
        context.exit()


_LIST = {"is_eager": True, "expose_value": False, "callback": _list}


@click.command()
@click.argument("out", type=click.Path(dir_okay=False, path_type=Path))
@options(
    ("--preset=NAME", PRESETS, "xs10-still", f"Kind of camera: {', '.join(PRESETS)}."),
    ("--screen", str, "paper-34k6", "Screen profile: a name or a TOML file."),
    ("--picture", str, "coffee", "Picture shown: a file, or a name (see --list)."),
    ("--film", str, None, "Play a film, as pan:4, cut:12+subtitles or zoom:1.01+window; see docs/simulator.md."),
    ("--payload", str, "random", "'random', 'hex:...', or a file; sent over and over."),
    ("--text", str, None, "Send this text (a longer one as a file), for the link layer to receive."),
    ("--uri", str, None, "Send this URI."),
    ("--file file_path", click.Path(path_type=Path), None, "Send this file."),
    ("--slots", FILE, None, "Send the slots that encode wrote to this file (.csv, .npy, .bin), over and over."),
    ("--seed", click.IntRange(0), 0, "Same seed, same pixels."),
    ("--format=NAME file_format", _FORMATS, None, f"Format of OUT, {', '.join(_FORMATS)}. [default: by its suffix]"),
    ("--weights --w", str, "5", "Lit slots of ten: N, a list N,N,..., or 'dimming'."),
    ("--exposure exposure_s", Exposure(), None, "Exposure in seconds, or as 1/32000.  [default: the preset's]"),
    ("--exposure-slots", POSITIVE, None, "Exposure in slots; the gain follows, as in camera apps."),
    ("--readout readout_s", POSITIVE, None, "Seconds in which all rows are read."),
    ("--electrons", float, None, "Electrons of a green pixel that sees white, in one exposure."),
    ("--roll roll_deg", float, None, "Degrees about the line of sight; 180 for a camera upside down."),
    ("--fill", float, None, "Share of the picture's width that the screen fills, instead of a distance."),
    ("--corners", _CORNERS, None, "The screen's corners x,y,x,y,x,y,x,y on the sensor, instead of a pose."),
    ("--scale", click.FloatRange(0.02, 4), None, "Scale the sensor; rows and time shown scale with it."),
    ("--keep-readout/--keep-line-delay", None, False, "With --scale: keep the time of the whole readout."),
    ("--frames n_frames", click.IntRange(1), None, "Frames of a clip."),
    ("--frame-rate frame_rate_hz", float, None, "Frames per second of a clip."),
    ("--bit-rate", click.IntRange(1), None, "Bits per second of a clip.  [default: constant quality]"),
    ("--hand hand_px", click.FloatRange(0), None, "Hold the camera in a hand: pixels from frame to frame."),
    ("--clock-error slot_rate_error_ppm", float, None, "Error of the slot rate, ppm."),
    ("--column-delays", _DELAYS, None, "Delays of the columns, slots: one each, or one for the largest random delay."),
    ("--start-slot", float, None, "Slot of the link at which row 0 starts.  [default: random]"),
    ("--set fields", [str], None, "A field of the preset, as isp.quality=85; may be given several times."),
    ("--waveforms", FOLDER, None, "Also write what drives a real screen."),
    ("--camera-profile", FILE, None, "Also write a camera profile (TOML) that fits the capture."),
)
@options(("--list", None, False, "Print the names of pictures and exit.", _LIST))
@force_argument
def simulate(out: Path, **options: Any) -> None:
    """Simulate a capture of a mini-LED screen and write it to OUT, with OUT's name .truth.json beside it."""
    if not out.parent.is_dir():
        raise UsageError(f"{out.parent}: no such folder", "create it first")
    file_format = options["file_format"] or _format_of(out)
    _claim(out, options)
    scene = _scene(options, file_format)
    capture = prepare(scene, options["seed"])
    _warn_of_cut_packets(capture)
    _write(capture, out, file_format, options["bit_rate"])
    _write_extras(capture, options)
    click.echo(f"{out} and {truth_path(out).name}: {_summary(capture)}", err=True)


def _claim(out: Path, options: dict[str, Any]) -> None:
    """Refuse to replace a file that is no earlier capture, recognised by the truth beside it."""
    truth = truth_path(out)
    is_ours = truth.is_file() and outputs.TRUTH.search(truth.read_bytes()) is not None
    found = [output("OUT", out, outputs.ANYTHING if is_ours else outputs.NEVER)]
    found.append(output("the truth of OUT", truth, outputs.TRUTH))
    found.append(output("--camera-profile", options["camera_profile"], outputs.SIMULATED_CAMERA))
    if options["waveforms"] is not None:
        outputs.claim_folder("--waveforms", options["waveforms"])
        names = (_SLOT_FILE, *PICTURE_FILES)
        patterns = {name: outputs.PICTURE if name.endswith(".png") else outputs.WAVEFORMS for name in names}
        found += [output("--waveforms", options["waveforms"] / name, ours) for name, ours in patterns.items()]
    inputs = [options["picture"], options["payload"], *filter(None, (options["file_path"], options["slots"]))]
    outputs.claim(found, inputs, (options["screen"],), options["force"])


def _format_of(out: Path) -> str:
    known = _SUFFIXES | _VIDEO_SUFFIXES
    if out.suffix.lower() not in known:
        raise UsageError(f"{out}: no format goes with this suffix", f"use one of {', '.join(known)}, or --format")
    return known[out.suffix.lower()]


def _scene(options: dict[str, Any], file_format: str) -> Scene:
    """The preset with what the options change."""
    scene = preset(options["preset"], options["screen"])
    for text in options["fields"]:
        scene = with_fields(scene, field_table(text))
    sent, given = _sent(options, scene.screen), _given(options, _SCENE_OPTIONS)
    scene = replace(scene, w=_weights(options["weights"]), **sent, **given)
    scene = replace(scene, film=replace(scene.film, shows=options["film"] or scene.film.shows))
    scene = _with_pose(scene, options)
    changes: dict[str, Callable[[Any], Scene]] = {
        "readout_s": lambda seconds: scene.read_in(seconds),
        "exposure_slots": lambda slots: scene.metered(slots),
        "exposure_s": lambda seconds: replace(scene, exposure_s=seconds),
        "electrons": lambda electrons: replace(scene, light_e_per_s=electrons / scene.exposure_s),
        "column_delays": lambda delays: replace(scene, column_delay_slots=_delays(delays, scene.screen.columns)),
        "scale": lambda scale: scene.scaled(scale, keep_readout=options["keep_readout"]),
    }
    for name, value in _given(options, changes).items():
        scene = changes[name](value)
    return _for_format(scene, file_format)


def _sent(options: dict[str, Any], screen: ScreenProfile) -> dict[str, Any]:
    """What the screen sends: the light of a file of slots, what the link layer sends, or payload as it is."""
    given = _given(options, ("file_path", "text", "uri", "slots"))
    if len(given) + (options["payload"] != "random") > 1:
        raise UsageError("--payload, --text, --uri, --file and --slots exclude each other", "give one of them")
    if "slots" in given:
        slots = read_slots(given["slots"], screen).T.astype(np.float64)
        return {"waveform": lambda slot: slots[:, slot.astype(np.int64) % slots.shape[1]]}
    if given:
        return {"labels": sending_of(options["file_path"], options["text"], options["uri"])}
    return {"payload": payload_bytes(options["payload"])}


def _for_format(scene: Scene, file_format: str) -> Scene:
    if file_format.startswith("dng"):
        if scene.sensor.cfa == "rgb":
            raise UsageError("a DNG holds a mosaic, this sensor has none", "add --set sensor.cfa=bayer")
        # LibRaw crops a known Fujifilm model to the area it knows; a synthetic make keeps every pixel.
        if scene.make == "FUJIFILM":
            scene = replace(scene, make="Synthetic", model=scene.camera_name)
        scene = replace(scene, output="raw")
    return replace(scene, n_frames=1) if file_format in _STILLS else scene


def _given(options: dict[str, Any], names: Iterable[str]) -> dict[str, Any]:
    return {name: options[name] for name in names if options[name] is not None}


def _with_pose(scene: Scene, options: dict[str, Any]) -> Scene:
    pose = replace(scene.pose, **_given(options, ("roll_deg", "fill")))
    if pose.fill <= 0:
        raise UsageError(f"--fill must be positive (got {pose.fill})", "give a positive number")
    if options["corners"] is not None:
        values = options["corners"]
        pose = replace(pose, corners=tuple(zip(values[::2], values[1::2], strict=True)))
    is_turned = abs((pose.roll_deg + 180) % 360 - 180) > 90
    return replace(scene, pose=pose, orientation=3 if is_turned else scene.orientation)


def _delays(delays: tuple[float, ...], n_columns: int) -> float | tuple[float, ...]:
    n, step = len(delays), "give one for all, or one each"
    refuse((n not in (1, n_columns), f"--column-delays takes 1 or {n_columns} numbers (got {n})", step))
    return delays if n > 1 else delays[0]


def _weights(text: str) -> Weights:
    if text == "dimming":
        return "dimming"
    step = "give 1..9, a list of them, or 'dimming'"
    with failure_explained(f"--weights: {text!r} is no weight", step, UsageError):
        values = tuple(int(part) for part in text.split(","))
    return values[0] if len(values) == 1 else values


def _warn_of_cut_packets(capture: Recording) -> None:
    """Warn if no frame can show a complete packet."""
    sensor, corners = capture.scene.sensor, capture.exposure(0).view.corners
    top, bottom = max(float(corners[:, 1].min()), 0.0), min(float(corners[:, 1].max()), sensor.height - 1.0)
    shown_s, packet_s = max(bottom - top, 0.0) * sensor.line_delay_s, capture.scene.screen.packet_s
    if shown_s < packet_s:
        shown, packet = f"{1e3 * shown_s:.1f} ms", f"{1e3 * packet_s:.1f} ms"
        reason = f"the screen is read in {shown}, a packet of {capture.scene.screen.name} lasts {packet}"
        click.echo(f"vlc-rx: no packet fits a frame: {reason}; only clips put packets together", err=True)


def _write(capture: Recording, out: Path, file_format: str, bit_rate: int | None) -> None:
    """Write the capture and its truth."""
    progress = partial(with_progress, what=out.name, unit="frames")
    with outputs.replacing(out) as hidden:
        write_capture(capture, hidden, file_format, bit_rate, progress)
    # The payload of a file of slots is in the truth that `encode` wrote.
    unknown: dict[str, Any] = {"payload": {}} if capture.scene.waveform is not None else {}
    outputs.write_whole(truth_path(out), json.dumps(capture.truth(out.name) | unknown, indent=1) + "\n")


def _write_extras(capture: Recording, options: dict[str, Any]) -> None:
    """Camera profile and waveforms, where they are asked for."""
    last = capture.exposure(capture.scene.n_frames - 1)
    if options["camera_profile"] is not None:
        outputs.write_whole(options["camera_profile"], dump_profile(build_camera_profile(capture.scene, last)))
    if options["waveforms"] is not None:
        n_bursts = 1 + int(last.row_start_slots[-1] // capture.link.burst_slots)
        n_slots, folder = n_bursts * capture.link.burst_slots, options["waveforms"]
        with outputs.writable(folder):
            with (folder / _SLOT_FILE).open("wb") as file:
                WRITERS[".csv"](file, [capture.link.slots(0, n_slots).T], n_slots, capture.scene.screen)
            export_picture(capture.drive, folder)


def _summary(capture: Recording) -> str:
    scene, exposure = capture.scene, capture.exposure(0)
    return (
        f"{scene.sensor.width} x {scene.sensor.height}, {scene.rows_per_slot:.2f} rows per slot, "
        f"exposure {exposure.exposure_slots:.2f} slots, {scene.n_frames} frame{'s' * (scene.n_frames > 1)}"
    )
