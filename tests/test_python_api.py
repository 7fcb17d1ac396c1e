"""`import rxcli`: cheap, complete, and the same receiver as the command line's."""

import ast
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import rxcli
from rxcli.errors import ReceiverError
from rxcli.options import SKIPS
from rxcli.profiles import shipped_profiles, usual_screens
from rxcli.receiver.channel.denoise import DenoiserInput
from rxcli.receiver.decode.detect import detect
from rxcli.resources import data_dir

SAMPLES = data_dir("sample_frames")
PHOTO, CLIP = SAMPLES / "xtrans_sky_17k3.dng", SAMPLES / "video1080_chelsea_17k3.mp4"
KNOWN = rxcli.Receiver(screens="paper-17k3", cameras=str(SAMPLES / "xs10-small.toml"), cae="never")


@pytest.fixture(scope="module")
def tapped() -> tuple[rxcli.FrameResult, rxcli.Taps]:
    result, taps = KNOWN.tap(PHOTO)
    assert taps is not None
    return result, taps


def payloads(result: rxcli.FrameResult) -> list[str]:
    return [packet.payload for column in result.columns for packet in column.packets]


def test_import_loads_nothing_heavy() -> None:
    code = "import sys; before = set(sys.modules); import rxcli; print(*sorted(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) <= {"rxcli", "__future__"}


def test_names_are_those_that_type_checkers_know() -> None:
    tree = ast.parse(Path(rxcli.__file__).read_text(encoding="utf-8"))
    [block] = [node for node in tree.body if isinstance(node, ast.If)]
    known = [name.name for node in block.body if isinstance(node, ast.ImportFrom) for name in node.names]
    assert sorted({*known, "__version__"} - {"Any"}) == sorted(rxcli.__all__)
    assert set(rxcli.__all__) <= set(dir(rxcli))
    assert all(getattr(rxcli, name) is not None for name in rxcli.__all__)
    assert (Path(rxcli.__file__).parent / "py.typed").is_file()
    with pytest.raises(AttributeError, match="no attribute 'decoed'"):
        _ = rxcli.decoed  # type: ignore[attr-defined]


def test_defaults_are_the_command_lines() -> None:
    options = rxcli.ReceiverOptions()
    assert rxcli.receiver_options() == options
    assert rxcli.Receiver().options == replace(options, soft_bits=True)
    assert options.screens == usual_screens()
    assert options.cameras == tuple(shipped_profiles(rxcli.CameraProfile))
    assert options.skip == frozenset(SKIPS)


def test_profiles_come_as_names_files_and_values() -> None:
    file = str(SAMPLES / "phone12.toml")
    camera = rxcli.load_profile(file, rxcli.CameraProfile)
    by_name = rxcli.receiver_options("paper-17k3", file)
    by_value = rxcli.receiver_options([rxcli.load_profile("paper-17k3", rxcli.ScreenProfile)], camera)
    assert by_name == by_value
    assert by_name.force_camera
    several = rxcli.receiver_options(cameras=[camera, "auto"])
    assert not several.force_camera
    assert several.cameras == (camera, *shipped_profiles(rxcli.CameraProfile))
    assert rxcli.receiver_options(cameras=()).cameras == ()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cae": "sometimes"}, "cae must be auto, always or never"),
        ({"min_confidence": 1.5}, r"min_confidence must be in 0\.\.1 \(got 1\.5\)"),
        ({"no_skip": ["nothing"]}, "no_skip must be one of"),
        ({"no_skip": None}, "no_skip must be"),
        ({"mirrored": None}, r"mirrored must be True or False \(got None\)"),
        ({"min_confidence": float("nan")}, "min_confidence must be in"),
        ({"file_memory_mb": None}, "file_memory_mb must be"),
        ({"dump_dir": 5}, "dump_dir must be"),
        ({"denoiser": 5}, "denoiser must be"),
        ({"corners": "abc"}, "four positions"),
        ({"corners": [[0, 0], [1]]}, "four positions"),
        ({"screens": None}, "screens must be"),
        ({"screens": []}, "screens must be at least one"),
        ({"cameras": 5}, "cameras must be"),
        ({"cameras": Path("none.toml")}, "no profile 'none.toml' among cameras"),
        ({"corners": [[0, 0], [9, 9], [9, 0], [0, 9]]}, "once round a convex outline"),
        ({"screens": [7]}, "7 is no ScreenProfile"),
        ({"screens": "nope"}, "no profile 'nope' among screens"),
    ],
)
def test_impossible_options_are_told(options: dict[str, object], message: str) -> None:
    with pytest.raises(ReceiverError, match=message):
        rxcli.Receiver(**options)


def test_a_photo_gives_its_packets_from_a_path_or_a_frame(tapped: tuple[rxcli.FrameResult, rxcli.Taps]) -> None:
    result, taps = tapped
    assert result.status == "ok"
    packet = result.columns[5].packets[0]
    assert packet.payload_bytes == bytes.fromhex(packet.payload)
    assert len(packet.payload_bytes) == -(-packet.payload_bits // 8)
    frame = next(iter(rxcli.open_source(PHOTO)))
    assert payloads(KNOWN.decode(frame)) == payloads(next(KNOWN.receive([frame]))) == payloads(result)
    detected = detect(taps.clock.by_burst(taps.llr))  # taps feed the detector
    # But for columns whose slots and picture were detected jointly.
    assert (detected.index == taps.posteriors.index).mean() > 0.9


def test_an_array_is_a_picture() -> None:
    frame = next(iter(rxcli.open_source(SAMPLES / "phone_chelsea_17k3.jpg")))
    receiver = rxcli.Receiver(screens="paper-17k3", cameras=str(SAMPLES / "phone12.toml"), cae="never")
    wide = (frame.pixels.astype(np.uint16) * 257).astype(np.uint16)
    (first,), (second,) = receiver.receive([np.asarray(frame.pixels)]), receiver.receive([wide])
    assert payloads(first)
    assert payloads(first) == payloads(second)


@pytest.mark.parametrize(
    ("picture", "reason"),
    [
        (np.zeros((4, 4, 3), np.uint8), "must be a"),
        (np.zeros((4, 4)), "must be a"),
        (np.zeros(9, np.uint8), "must be a"),
        (CLIP, "more than one frame; use receive"),
        *((picture, r"must be a path, a Frame or .* \(got ") for picture in (None, [], [[1, 2]], 5, b"a")),
        *((np.zeros(shape, np.uint8), "must be a path") for shape in ((0, 0), (0, 9), (9, 0))),
        ("", "must be the path of a file"),
    ],
)
def test_what_is_no_photo_is_refused(picture: Any, reason: str) -> None:
    for call in (KNOWN.decode, KNOWN.tap):
        with pytest.raises(rxcli.UsageError, match=reason) as caught:
            call(picture)
        assert caught.value.hint


GREY, NAN = np.zeros((60, 80), np.uint8), float("nan")
MOSAIC = rxcli.Mosaic(np.zeros((2, 2), np.uint8), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), 255.0)


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        *(
            ({"pixels": pixels}, "must be a path, a Frame")
            for pixels in (None, [[1]], GREY[:0], GREY * 0.5, GREY[None])
        ),
        *(({"white": white}, "white above black") for white in (NAN, None, "1", -1.0, 0.0)),
        *(({"metadata": rxcli.Metadata(exposure_s=s)}, "exposure_s must") for s in (NAN, 0.0, -1.0, float("inf"), "1")),
        ({"metadata": rxcli.Metadata(iso=NAN)}, "iso must be"),
        ({"metadata": rxcli.Metadata(orientation=9)}, "orientation must be"),
        ({"metadata": None}, "metadata must be"),
        ({"source": None}, "source must be"),
        ({"index": -1}, "index must be"),
        ({"time_s": NAN}, "time_s must be"),
        ({"mosaic": 5}, "mosaic must be"),
        ({"mosaic": replace(MOSAIC, pattern=GREY[:0])}, r"mosaic\.pattern must be"),
        ({"mosaic": replace(MOSAIC, pattern=GREY[:2, :2] + 7)}, r"mosaic\.pattern must be"),
        ({"mosaic": replace(MOSAIC, gains=(NAN, 1.0, 1.0))}, r"mosaic\.gains must be"),
        ({"mosaic": replace(MOSAIC, black=(0.0, 0.0, 300.0))}, r"mosaic\.black\[2\] and white must be"),
    ],
)
def test_a_frame_with_impossible_values_is_refused(changed: dict[str, Any], reason: str) -> None:
    frame = replace(rxcli.Frame(GREY, "mine"), **changed)
    with pytest.raises(rxcli.UsageError, match=reason) as caught:
        KNOWN.decode(frame)
    assert caught.value.hint
    with pytest.raises(rxcli.UsageError, match=reason):
        next(KNOWN.receive([frame]))


@pytest.mark.parametrize("source", [None, 5, GREY, rxcli.Frame(GREY, "mine")])
def test_what_is_received_is_a_path_or_several_pictures(source: Any) -> None:
    with pytest.raises(rxcli.UsageError, match="use decode for one picture"):
        KNOWN.receive(source)


@pytest.mark.parametrize(
    "call",
    [
        *(lambda name=name: rxcli.load_profile(name) for name in (None, 5, [], "")),
        lambda: rxcli.load_profile("xs10", int),  # type: ignore[type-var]
        *(lambda path=path: next(iter(rxcli.open_source(path))) for path in (None, 5, [], "")),
        *(lambda bits=bits: rxcli.encode_packet(bits, 5) for bits in (None, "0101010", [2] * 7, [[0] * 7])),
    ],
)
def test_other_arguments_that_are_none_are_refused(call: Callable[[], object]) -> None:
    with pytest.raises(rxcli.UsageError) as caught:
        call()
    assert caught.value.hint


def test_arrays_without_a_screen_are_numbered_and_have_no_taps() -> None:
    dark = np.zeros((60, 80), np.uint8)
    results = list(KNOWN.receive([dark] * 3, frame_rate=50))
    assert [(result.frame, result.time_s) for result in results] == [(0, 0.0), (1, 0.02), (2, 0.04)]
    result, taps = KNOWN.tap(dark)
    assert (result.status, taps) == ("no_screen", None)


@pytest.mark.parametrize("pictures", [[GREY] * 3, [rxcli.Frame(GREY, "mine")] * 3])
def test_several_pictures_without_times_are_refused(pictures: Any) -> None:
    """As a clip of frames at one instant would be received: hardly, and silently."""
    with pytest.raises(rxcli.UsageError, match="have no times") as caught:
        list(KNOWN.receive(pictures))
    assert "frame_rate" in (caught.value.hint or "")
    with pytest.raises(rxcli.UsageError, match="frame_rate must be above 0"):
        KNOWN.receive(pictures, frame_rate=0)


def test_an_option_that_there_is_not_is_named_with_the_one_that_was_meant() -> None:
    with pytest.raises(rxcli.UsageError, match="no option 'screen'") as caught:
        rxcli.decode(GREY, screen="paper-17k3")
    assert "'screens'" in (caught.value.hint or "")


def test_a_result_is_shown_in_a_line_and_in_notebooks_as_a_table(tapped: tuple[rxcli.FrameResult, Any]) -> None:
    result = replace(tapped[0], source="<b>.dng")
    assert len(repr(result)) < 200
    assert "20 packets of 20 columns" in repr(result)
    shown = result._repr_html_()
    assert shown.count("<tr>") == 21
    assert "<b>" not in shown
    assert all(payload in shown for payload in payloads(result))


def test_taps_that_are_none_are_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", corners=np.zeros((4, 2)))
    for name in ("a.npz", "b.npz"):
        with pytest.raises(rxcli.InputError, match="not the taps of a photograph"):
            rxcli.read_taps(tmp_path / name)


class Recorder:
    """A denoiser that corrects nothing and remembers what it was asked."""

    name = "recorder"

    def __init__(self) -> None:
        self.columns: list[int] = []

    def slot_corrections(self, scene: DenoiserInput, columns: NDArray[np.int64]) -> NDArray[np.float32]:
        self.columns += columns.tolist()
        return np.zeros((columns.size, scene.clock.n_slots), np.float32)


def test_a_denoiser_may_be_ones_own() -> None:
    recorder = Recorder()
    own = rxcli.Receiver(
        screens="paper-17k3", cameras=str(SAMPLES / "xs10-small.toml"), cae="always", denoiser=recorder
    )
    result = own.decode(PHOTO)
    assert recorder.columns == list(range(20))
    assert result.denoiser["model"] == "recorder"
