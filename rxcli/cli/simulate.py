"""`vlc-rx simulate`: captures with truth."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from math import isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rxcli.cli.common import claim_outputs, force_argument, options
from rxcli.cli.kinds import FILE, FOLDER, Exposure
from rxcli.errors import UsageError

if TYPE_CHECKING:
    from rxcli.lab.simulate.capture import Take
    from rxcli.lab.simulate.scenes import Scene
    from rxcli.lab.simulate.transmitter import Weights
    from rxcli.link.encoder import Sending

_STILLS = ("jpeg", "dng", "dng14", "png", "png16", "tiff", "tiff16")
_CODECS = ("h264", "h264-10", "hevc", "hevc-10", "mjpeg")
_FORMATS = (*_STILLS, *_CODECS)
_SUFFIXES = {".jpg": "jpeg", ".jpeg": "jpeg", ".dng": "dng", ".png": "png", ".tif": "tiff", ".tiff": "tiff"}
_VIDEO_SUFFIXES = {".mp4": "h264", ".mov": "h264", ".mkv": "h264", ".avi": "mjpeg"}
_PRESETS = ("xs10-still", "video-4k", "video-1080p", "phone-corrected", "phone-plain")

#: Options that are fields of the scene by the same name.
_SCENE_OPTIONS = (
    *("picture", "dimming", "stabilised", "n_frames", "frame_rate_hz", "start_slot", "slot_rate_error_ppm"),
    *("blur_px", "lcd_grid", "hand_px", "iso", "make", "model", "camera_name"),
)


@click.command()
@click.argument("out", type=click.Path(dir_okay=False, path_type=Path))
@options(
    ("--preset", _PRESETS, "xs10-still", "Kind of camera."),
    ("--screen", str, "paper-34k6", "Screen profile: a name or a TOML file."),
    ("--picture", str, "coffee", "Picture shown: a file, or a name (see --list)."),
    ("--payload", str, "random", "'random', 'hex:...', or a file; sent over and over."),
    ("--text", str, None, "Send this text (a longer one as a file), for the link layer to receive."),
    ("--uri", str, None, "Send this URI."),
    ("--file file_path", click.Path(path_type=Path), None, "Send this file."),
    ("--seed", click.IntRange(0), 0, "Same seed, same pixels."),
    ("--format=NAME file_format", _FORMATS, None, f"Format of OUT, {', '.join(_FORMATS)}. [default: by its suffix]"),
    ("--w weights", str, "5", "Lit slots of ten: N, a list N,N,..., or 'dimming'."),
    ("--dimming", ("max", "none"), "max", "Local dimming."),
    ("--exposure exposure_s", Exposure(), None, "Exposure in seconds, or as 1/32000.  [default: the preset's]"),
    ("--electrons", float, None, "Electrons of a green pixel that sees white, in one exposure."),
    ("--iso", click.IntRange(1), None, "ISO written to the file; has no effect on the pixels."),
    ("--roll roll_deg", float, None, "Degrees about the line of sight; 180 for a camera upside down."),
    ("--yaw yaw_deg", float, None, "Degrees about the vertical."),
    ("--pitch pitch_deg", float, None, "Degrees about the horizontal."),
    ("--distance distance_mm", float, None, "Distance of the screen in millimetres."),
    ("--fill", float, None, "Share of the picture's width that the screen fills, instead of a distance."),
    ("--focal focal_widths", float, None, "Focal length in picture widths."),
    ("--distortion", str, None, "Lens distortion k1,k2,p1,p2,k3."),
    ("--corners", str, None, "The screen's corners x,y,x,y,x,y,x,y on the sensor, instead of a pose."),
    ("--orientation", click.IntRange(1, 8), None, "EXIF orientation.  [default: 1, or 3 for a roll of 180]"),
    ("--blur blur_px", float, None, "Focus blur, standard deviation in pixels."),
    ("--lcd-grid", click.FloatRange(0, 1), None, "Depth of the panel's pixel structure."),
    ("--room-light room_e", float, None, "Electrons of a green pixel that sees white paper by the room's light."),
    ("--flicker flicker_hz", float, None, "Flicker of the room's light in Hz (100 or 120)."),
    ("--reflection lamp", float, None, "A lamp mirrored in the panel, against white paper."),
    ("--scale", click.FloatRange(0.02, 4), None, "Scale the sensor; rows and time shown scale with it."),
    ("--keep-readout/--keep-line-delay", None, False, "With --scale: keep the time of the whole readout."),
    ("--cfa", ("bayer", "xtrans", "rgb"), None, "Colour filter array."),
    ("--tone", ("srgb", "bt709", "gamma", "linear"), None, "Tone curve of developed pictures."),
    ("--quality", click.IntRange(1, 100), None, "JPEG quality."),
    ("--subsampling", ("444", "422", "420"), None, "JPEG colour subsampling."),
    ("--sharpen", click.FloatRange(0, 5), None, "Strength of sharpening."),
    ("--denoise denoise_px", click.FloatRange(0, 10), None, "Noise reduction, pixels."),
    ("--correct/--no-correct correct_distortion", None, None, "Take the lens's distortion out in the camera."),
    ("--frames n_frames", click.IntRange(1), None, "Frames of a clip."),
    ("--frame-rate frame_rate_hz", float, None, "Frames per second of a clip."),
    ("--bit-rate", click.IntRange(1), None, "Bits per second of a clip.  [default: constant quality]"),
    ("--hand hand_px", click.FloatRange(0), None, "Hold the camera in a hand: pixels from frame to frame."),
    ("--stabilised", None, False, "With --hand: frames are turned back and cropped, as phones do."),
    ("--clock-error slot_rate_error_ppm", float, None, "Error of the slot rate, ppm."),
    ("--column-delays", str, None, "Delays of the columns in slots: one each, or one for the largest random delay."),
    ("--start-slot", float, None, "Slot of the link at which row 0 starts.  [default: random]"),
    ("--make", str, None, "Camera make written to the file."),
    ("--model", str, None, "Camera model written to the file."),
    ("--waveforms", FOLDER, None, "Also write what drives a real screen."),
    ("--camera-name", str, None, "Name of the camera in truth and camera profile."),
    ("--camera-profile", FILE, None, "Also write a camera profile (TOML) that fits the capture."),
)
@click.option(
    "--list",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=lambda context, _parameter, wanted: _list(context, wanted),
    help="Print the names of pictures and exit.",
)
@force_argument
def simulate(out: Path, **options: Any) -> None:
    """Simulate a capture of a mini-LED screen and write it to OUT, with OUT's name .truth.json beside it."""
    from rxcli.lab.simulate.capture import prepare

    if not out.parent.is_dir():
        raise UsageError(f"{out.parent}: no such folder", "create it first")
    file_format = options["file_format"] or _format_of(out)
    _claim(out, options)
    scene = _scene(options, file_format)
    take = prepare(scene, options["seed"])
    _warn_of_cut_packets(take)
    try:
        truth = _write(take, out, file_format, options["bit_rate"])
        _write_extras(take, options)
    except OSError as error:
        where = error.filename or out
        raise UsageError(f"{where}: cannot be written ({error.strerror or error})", "choose another place") from None
    click.echo(f"{out} and {truth.name}: {_summary(take)}", err=True)


def _claim(out: Path, options: dict[str, Any]) -> None:
    """Refuse to write over what is no earlier capture of ours, which its truth beside it tells."""
    from rxcli import outputs
    from rxcli.lab.simulate.transmitter import WAVEFORM_FILES
    from rxcli.lab.simulate.truth import truth_path

    truth = truth_path(out)
    ours = truth.is_file() and outputs.TRUTH.search(truth.read_bytes()) is not None
    found = [outputs.Output("OUT", out, outputs.ANYTHING if ours else outputs.NEVER)]
    found.append(outputs.Output("the truth of OUT", truth, outputs.TRUTH))
    if options["camera_profile"] is not None:
        found.append(outputs.Output("--camera-profile", options["camera_profile"], outputs.SIMULATED_CAMERA))
    if options["waveforms"] is not None:
        outputs.claim_folder("--waveforms", options["waveforms"])
        for name in WAVEFORM_FILES:
            look = outputs.PICTURE if name.endswith(".png") else outputs.WAVEFORMS
            found.append(outputs.Output("--waveforms", options["waveforms"] / name, look))
    inputs = [options["picture"], options["payload"], *([options["file_path"]] if options["file_path"] else [])]
    claim_outputs(found, inputs, (options["screen"],), options["force"])


def _list(context: click.Context, wanted: bool) -> None:
    """Print the names of pictures and end."""
    if wanted:
        from rxcli.lab.simulate.pictures import picture_names

        click.echo("\n".join(picture_names()))
        context.exit()


def _format_of(out: Path) -> str:
    known = _SUFFIXES | _VIDEO_SUFFIXES
    if out.suffix.lower() not in known:
        raise UsageError(f"{out}: no format goes with this suffix", f"use one of {', '.join(known)}, or --format")
    return known[out.suffix.lower()]


def _scene(options: dict[str, Any], file_format: str) -> Scene:
    """The preset with what the options change."""
    from rxcli.lab.simulate.scenes import preset

    scene = preset(options["preset"], options["screen"])
    sent: dict[str, Any] = {
        "w": _weights(options["weights"]),
        "payload": _payload(options["payload"]),
        "labels": _labels(options),
    }
    scene = replace(scene, **_given(options, _SCENE_OPTIONS), **sent)
    scene = _with_light(_with_pose(scene, options), options)
    isp = _given(options, ("tone", "quality", "subsampling", "sharpen", "denoise_px", "correct_distortion"))
    sensor = _given(options, ("cfa",))
    scene = replace(scene, isp=replace(scene.isp, **isp), sensor=replace(scene.sensor, **sensor))
    if options["column_delays"] is not None:
        delays = _numbers(options["column_delays"], "--column-delays", (1, scene.screen.columns))
        scene = replace(scene, column_delay_slots=delays if len(delays) > 1 else delays[0])
    if options["scale"] is not None:
        scene = scene.scaled(options["scale"], keep_readout=options["keep_readout"])
    return _for_format(scene, file_format, options)


def _for_format(scene: Scene, file_format: str, options: dict[str, Any]) -> Scene:
    if file_format.startswith("dng"):
        if scene.sensor.cfa == "rgb":
            raise UsageError("a DNG holds a mosaic, this sensor has none", "add --cfa bayer or --cfa xtrans")
        # LibRaw crops a known Fujifilm model to the area it knows; a synthetic make keeps every pixel.
        scene = replace(
            scene, output="raw", make=options["make"] or "Synthetic", model=options["model"] or scene.camera_name
        )
    if file_format in _STILLS:
        scene = replace(scene, n_frames=1)
    return scene


def _given(options: dict[str, Any], names: tuple[str, ...]) -> dict[str, Any]:
    return {name: options[name] for name in names if options[name] is not None}


def _with_pose(scene: Scene, options: dict[str, Any]) -> Scene:
    lens, pose = scene.lens, scene.pose
    if options["focal_widths"] is not None:
        lens = replace(lens, focal_widths=options["focal_widths"])
    if options["distortion"] is not None:
        k1, k2, p1, p2, k3 = _numbers(options["distortion"], "--distortion", (5,))
        lens = replace(lens, distortion=(k1, k2, p1, p2, k3))
    pose = replace(pose, **_given(options, ("roll_deg", "yaw_deg", "pitch_deg", "fill")))
    if options["distance_mm"] is not None:
        pose = replace(pose, fill=lens.focal_widths * scene.screen.width_mm / options["distance_mm"])
    if pose.fill <= 0 or lens.focal_widths <= 0:
        raise UsageError("--fill, --distance and --focal must be positive", "give positive numbers")
    if options["corners"] is not None:
        values = _numbers(options["corners"], "--corners", (8,))
        pose = replace(pose, corners=tuple(zip(values[::2], values[1::2], strict=True)))
    turned = abs((pose.roll_deg + 180) % 360 - 180) > 90
    orientation = options["orientation"] or (3 if turned else 1)
    return replace(scene, lens=lens, pose=pose, orientation=orientation)


def _with_light(scene: Scene, options: dict[str, Any]) -> Scene:
    if options["exposure_s"] is not None:
        scene = replace(scene, exposure_s=options["exposure_s"])
    if options["electrons"] is not None:
        scene = replace(scene, light_e_per_s=options["electrons"] / scene.exposure_s)
    room = _given(options, ("flicker_hz", "lamp"))
    if options["room_e"] is not None:
        room["light_e_per_s"] = options["room_e"] / scene.exposure_s
    return replace(scene, room=replace(scene.room, **room))


def _numbers(text: str, option: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = (nan,)
    if not all(map(isfinite, values)):
        raise UsageError(f"{option}: {text!r} is no list of numbers", "separate numbers by commas")
    if len(values) not in counts:
        wanted = " or ".join(str(count) for count in counts)
        raise UsageError(f"{option} takes {wanted} numbers (got {len(values)})", "separate numbers by commas")
    return values


def _weights(text: str) -> Weights:
    if text == "dimming":
        return "dimming"
    try:
        values = tuple(int(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--w: {text!r} is no weight", "give 1..9, a list of them, or 'dimming'") from None
    return values[0] if len(values) == 1 else values


def _labels(options: dict[str, Any]) -> Sending | None:
    """What the link layer sends; None for payload as it is."""
    from rxcli.cli.sending import sending_of

    given = [name for name in ("text", "uri", "file_path") if options[name] is not None]
    if not given:
        return None
    if len(given) > 1 or options["payload"] != "random":
        raise UsageError("--payload, --text, --uri and --file exclude each other", "give one of them")
    return sending_of(options["file_path"], options["text"], options["uri"])


def _warn_of_cut_packets(take: Take) -> None:
    """Say so where no frame can show a packet as a whole."""
    sensor, corners = take.scene.sensor, take.exposure(0).view.corners
    top, bottom = max(float(corners[:, 1].min()), 0.0), min(float(corners[:, 1].max()), sensor.height - 1.0)
    shown_s, packet_s = max(bottom - top, 0.0) * sensor.line_delay_s, take.scene.screen.packet_s
    if shown_s < packet_s:
        click.echo(
            f"vlc-rx: no packet fits a frame: the screen is read in {1e3 * shown_s:.1f} ms, a packet of "
            f"{take.scene.screen.name} lasts {1e3 * packet_s:.1f} ms; only clips put packets together",
            err=True,
        )


def _payload(text: str) -> bytes | None:
    if text == "random":
        return None
    try:
        data = bytes.fromhex(text[4:]) if text.startswith("hex:") else Path(text).read_bytes()
    except ValueError:
        raise UsageError(f"--payload: {text!r} holds no hex", "give an even number of hex digits") from None
    except OSError as error:
        raise UsageError(
            f"--payload: {text}: cannot be read ({error.strerror})", "give 'random', 'hex:...' or a file"
        ) from None
    if not data:
        raise UsageError(f"--payload: {text!r} is empty", "give at least one byte")
    return data


def _write(take: Take, out: Path, file_format: str, bit_rate: int | None) -> Path:
    """Write the capture and its truth; returns the truth's path."""
    from tqdm import tqdm

    from rxcli.lab.simulate.capture import write_capture
    from rxcli.lab.simulate.truth import write_truth
    from rxcli.outputs import replacing

    progress = partial(tqdm, desc=out.name, unit="frame", leave=False, disable=None)
    with replacing(out) as hidden:
        write_capture(take, hidden, file_format, bit_rate, progress)
    return write_truth(take.truth(out.name), out)


def _write_extras(take: Take, options: dict[str, Any]) -> None:
    """Camera profile and waveforms, where they are asked for."""
    from rxcli.lab.simulate.transmitter import export_waveforms
    from rxcli.lab.simulate.truth import build_camera_profile
    from rxcli.outputs import write_whole
    from rxcli.profiles import dump_profile

    last = take.exposure(take.scene.n_frames - 1)
    if options["camera_profile"] is not None:
        write_whole(options["camera_profile"], dump_profile(build_camera_profile(take.scene, last)))
    if options["waveforms"] is not None:
        n_bursts = 1 + int(last.row_start_slots[-1] // take.link.burst_slots)
        export_waveforms(take.drive, take.link, n_bursts, options["waveforms"])


def _summary(take: Take) -> str:
    scene, first = take.scene, take.exposure(0)
    return (
        f"{scene.sensor.width} x {scene.sensor.height}, {scene.rows_per_slot:.2f} rows per slot, "
        f"exposure {first.exposure_slots:.2f} slots, {scene.n_frames} frame{'s' * (scene.n_frames > 1)}"
    )
