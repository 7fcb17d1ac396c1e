"""Live cameras, whose system calls a fake one answers."""

import errno
import json
import os
import pty
import subprocess
import sys
import termios
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import ENVIRONMENT
from fake_camera import FORMATS as FAKE_FORMATS
from fake_camera import OTHERS, Bench

from rxcli.cli.following import Status, format_status
from rxcli.cli.main import run
from rxcli.errors import ExitCode, InputError
from rxcli.ingest.v4l2 import CameraCounts, LiveSource
from rxcli.results.aim import Aim
from rxcli.results.report import wrapped
from rxcli.types import ColumnResult, Frame, FrameResult, PacketResult, ReceivedObject

WIDTH, HEIGHT, N_FRAMES = 96, 64, 10
UNPLUGGED = "vlc-rx: /dev/video0: the camera was unplugged; plug it in again"


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    rows = np.random.default_rng(11).integers(0, 256, (8, HEIGHT, 1), dtype=np.uint8)
    return Bench(tmp_path, np.repeat(rows, WIDTH, axis=2), monkeypatch)


FORMATS = [
    ("GREY", 0, 0, 255),
    ("Y10", 2, 0, 1023),
    ("Y12", 4, 0, 4095),
    ("Y16", 8, 0, 65535),
    ("YUYV", 0, 16, 235),
    ("NV12", 0, 16, 235),
    ("MJPG", 0, 0, 255),
    *((name, 0, 16, 235) for name in ("NV21", "YU12", "YV12", "NM12", "YM12", "YVYU")),
    ("JPEG", 0, 0, 255),
]


@pytest.mark.parametrize("faults", [{}, {"planes": True}], ids=["one plane", "planes"])
@pytest.mark.parametrize(("name", "shift", "black", "white"), FORMATS, ids=[form[0] for form in FORMATS])
def test_luma_arrives_as_sent(
    bench: Bench, name: str, shift: int, black: float, white: float, faults: dict[str, bool]
) -> None:
    seen = bench.read({"pixel_format": name}, faults=faults, formats=tuple(FAKE_FORMATS | OTHERS))
    assert (seen.error, len(seen.frames)) == (None, N_FRAMES)
    sent = bench.luma.astype(int) << shift
    for frame in seen.frames:
        assert np.abs(sent - frame.pixels).max(axis=(1, 2)).min() <= (2 if "JP" in name else 0)
        assert (frame.black, frame.white, frame.metadata.model) == (black, white, "Fake camera")
        assert frame.pixels.dtype == ("uint16" if shift else "uint8")
    assert bench.camera.format.strip() == name


def test_times_are_those_of_the_sensor(bench: Bench) -> None:
    times = [frame.time_s for frame in bench.read({"pixel_format": "GREY"}, n_frames=20).frames]
    steps = np.diff(times) * 60
    assert times[0] == 0
    np.testing.assert_allclose(steps, np.rint(steps), atol=0.01)
    assert (steps > 0.5).all()


def test_best_format_is_taken_and_another_refused(bench: Bench) -> None:
    assert bench.read({}, 1).mode.startswith("Y16 96 x 64")
    assert bench.read({}, 1, formats=["YUYV", "MJPG"]).mode.startswith("YUYV")
    reason = "/dev/video0: does not offer any format 640 x any; it offers GREY 96 x 64 at 60 frames/s"
    assert reason in bench.read({"width": 640}, 1).error
    seen = bench.read({"pixel_format": "YUYV"}, 1, faults={"force_format": "GREY"})
    assert seen.error == "/dev/video0: gives GREY instead of YUYV; ask for another --format"


@pytest.mark.parametrize(
    ("asked", "exposure_s", "controls"),
    [  # manual exposure, its value, gain, automatic gain; a constant frame rate, and gain as it was
        ({}, 1e-4, {0x9A0901: 1, 0x9A0902: 1, 0x9A0903: 0, 0x980913: 16}),
        ({"exposure_s": 0.002, "gain": 99}, 0.002, {0x9A0902: 20, 0x980913: 99, 0x980912: 0}),
    ],
)
def test_exposure_and_gain_as_asked(
    asked: dict[str, Any], exposure_s: float, controls: dict[int, int], bench: Bench
) -> None:
    assert bench.read(asked, 1).frames[0].metadata.exposure_s == pytest.approx(exposure_s)
    assert bench.camera.controls.items() >= controls.items()


def test_slow_receiver_gets_the_newest_and_a_count(bench: Bench) -> None:
    seen = bench.read({"pixel_format": "GREY"}, n_frames=6, pause_s=0.1)
    sensor_frames = round(seen.frames[-1].time_s * 60)
    assert sensor_frames > 20
    assert seen.counts.dropped >= sensor_frames - 5 - 2  # some may come after the last that was taken
    assert np.diff([frame.time_s for frame in seen.frames]).min() > 0.05


def test_a_camera_that_comes_back_is_waited_for(bench: Bench) -> None:
    seen = bench.read({"wait": True}, faults={"unplug_after": 4, "return_s": 0.3})
    assert (seen.error, seen.counts.connections, len(seen.waited)) == (None, 2, 1)
    assert [frame.index for frame in seen.frames] == list(range(N_FRAMES))
    times = [frame.time_s for frame in seen.frames]
    assert times == sorted(times)
    seen = bench.read({"wait": True}, 2, faults={"busy_s": 1})
    assert (seen.error, len(seen.frames), len(seen.waited)) == (None, 2, 1)


@pytest.mark.parametrize(
    ("faults", "reason"),
    [
        ({"busy_s": 100}, "/dev/video0: another program uses the camera; close it"),
        ({"stall_after": 3}, "/dev/video0: the camera sent nothing for 0.3 s"),
        ({"stream_error": errno.ENOSPC}, "/dev/video0: its USB port has no room left for this mode; lower --width"),
    ],
)
def test_a_camera_that_cannot_be_read_says_why(bench: Bench, faults: dict[str, int], reason: str) -> None:
    seen = bench.read({"stall_s": 0.3}, faults=faults)
    assert seen.error.startswith(reason)
    assert len(seen.frames) <= faults.get("stall_after", 0)


def test_a_first_frame_may_be_late(bench: Bench) -> None:
    seen = bench.read({"stall_s": 0.1}, 2, faults={"start_s": 0.5})
    assert (seen.error, len(seen.frames)) == (None, 2)


@pytest.mark.parametrize(
    ("sizes", "asked", "size"),
    [
        ("none", {}, (96, 64)),
        ("none", {"width": 48, "height": 32}, (48, 32)),
        ("range", {}, (96, 64)),
        ("range", {"width": 48, "height": 32}, (48, 32)),
        ("range", {"height": 40}, (96, 40)),
    ],
)
def test_sizes_that_are_not_listed(bench: Bench, sizes: str, asked: dict[str, int], size: tuple[int, int]) -> None:
    seen = bench.read(asked, 2, faults={"sizes": sizes}, formats=("YUYV",))
    assert (seen.error, [(frame.width, frame.height) for frame in seen.frames]) == (None, [size] * 2)


@pytest.mark.parametrize(
    ("sizes", "said"),
    [("none", "gives 96 x 40 instead of 97 x 41; ask for"), ("range", "does not offer any format 97")],
)
def test_sizes_that_cannot_be_had(bench: Bench, sizes: str, said: str) -> None:
    assert said in bench.read({"width": 97, "height": 41}, 2, faults={"sizes": sizes}, formats=("YUYV",)).error


def test_an_exposure_that_the_stream_forgets_is_set_again(bench: Bench) -> None:
    seen = bench.read({"exposure_s": 0.002}, 1, faults={"reset": True})
    assert bench.camera.controls[0x9A0902] == 20
    assert seen.frames[0].metadata.exposure_s == pytest.approx(0.002)


@pytest.mark.parametrize(("asked", "lines"), [({}, 10), ({"exposure_s": 0.002, "gain": 99}, 200)])
def test_an_exposure_in_lines(bench: Bench, asked: dict[str, Any], lines: int) -> None:
    """Of 96 + 32 pixels, 12.8 million a second: 10 us."""
    seen = bench.read(asked, 1, faults={"board": 12_800_000})
    assert bench.camera.controls == {0x980911: lines, 0x9E0903: asked.get("gain", 16)}
    assert seen.frames[0].metadata.exposure_s == pytest.approx(lines * 1e-5)


def test_an_exposure_in_lines_of_unknown_duration(bench: Bench) -> None:
    seen = bench.read({}, 1, faults={"board": None})
    assert (bench.camera.controls[0x980911], seen.frames[0].metadata.exposure_s) == (4, None)
    seen = bench.read({"exposure_s": 0.002}, 1, faults={"board": None})
    assert "counts its exposure in lines of unknown duration; leave --exposure out" in seen.error


def test_a_call_that_fails_now_and_then_is_made_again(bench: Bench) -> None:
    seen = bench.read({"pixel_format": "GREY"}, 30, faults={"fail_every": 7})
    assert (seen.error, len(seen.frames), seen.counts.connections) == (None, 30, 1)
    assert bench.read({"stall_s": 0.3}, faults={"fail_every": 1}).error.endswith(
        "plug it in again; --wait waits for it"
    )


def test_a_camera_that_is_forbidden_says_so(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_path: Path) -> int:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr("rxcli.ingest.v4l2._open", refuse)
    with pytest.raises(InputError, match="this process may not use it; give its container the device"):
        list(LiveSource(Path("/dev/video0")))


@pytest.mark.parametrize("fault", ["damage_every", "short_every"])
def test_damaged_frames_are_left_out_and_counted(bench: Bench, fault: str) -> None:
    seen = bench.read({"pixel_format": "GREY"}, faults={fault: 3})
    assert len(seen.frames) == N_FRAMES
    assert seen.counts.damaged >= 4


@pytest.mark.parametrize("pace", [0, -1])
def test_times_that_do_not_advance_are_counted_in_frames(bench: Bench, pace: float) -> None:
    frames = bench.read({"pixel_format": "GREY"}, pause_s=0.05, faults={"stamp_pace": pace}).frames
    assert [frame.nominal_time for frame in frames] == [False, *[True] * (N_FRAMES - 1)]
    steps = np.diff([frame.time_s for frame in frames]) * 60
    np.testing.assert_allclose(steps, np.rint(steps), atol=0.01)
    assert (steps > 1.5).all()  # some frames passed in each pause


@pytest.mark.parametrize(
    ("arguments", "faults", "code", "last"),
    [
        (["--json", "-"], {"unplug_after": 40}, ExitCode.UNREADABLE, f"{UNPLUGGED}; --wait waits for it"),
        (["--frames", "3"], {}, ExitCode.NOT_RECEIVED, "no screen | columns 0/0"),
        ([], {"interrupt_after": 5}, ExitCode.INTERRUPTED, "vlc-rx: interrupted"),
        # A camera that is busy, sends nothing, or nothing whole: a duration counts from the start, whatever comes.
        *(
            (["--wait", "--duration", "0.5", "--quiet"], faults, ExitCode.NOT_RECEIVED, "")
            for faults in ({}, {"busy_s": 100}, {"stall_after": 0})
        ),
        (["--duration", "0.5"], {"damage_every": 1}, ExitCode.NOT_RECEIVED, "no whole frame yet | dropped "),
    ],
)
def test_how_the_command_ends(
    bench: Bench,
    arguments: list[str],
    faults: dict[str, int],
    code: ExitCode,
    last: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    bench.plug_in(faults=faults)
    assert run(["live", "/dev/video0", *arguments]) == code
    captured = capsys.readouterr()
    lines = captured.err.splitlines() or [""]
    assert lines[-1].startswith(last)
    assert "Traceback" not in captured.err
    statuses = [json.loads(line)["status"] for line in captured.out.splitlines()]
    assert bool(statuses) == ("--json" in arguments)
    assert "ok" not in statuses
    if "damage_every" in faults:
        assert int(lines[-1].rpartition(" ")[2]) > 0


def test_packets_are_shown_until_a_file_has_come(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    columns = (ColumnResult(0, "ok", packets=(PacketResult(0.0, 1.5, 16, "ab12", confidence=1.0, ber_hat=0.0),)),)
    file = ReceivedObject("a.txt", b"sent", 4, "00", 1, 1, "", 2, 0.0)

    def receive(frames: Iterator[Frame], _options: Any) -> Iterator[FrameResult]:
        for frame in frames:
            objects = (file,) if frame.index == 2 else ()
            yield FrameResult(frame.source, frame.index, frame.time_s, "ok", columns=columns, objects=objects)

    monkeypatch.setattr("rxcli.cli.following.receive", receive)
    bench.plug_in()
    assert run(["live", "/dev/video0", "--until-complete", "--out", str(tmp_path / "out")]) == ExitCode.OK
    assert (tmp_path / "out" / "a.txt").read_bytes() == b"sent"
    captured = capsys.readouterr()
    assert captured.out.count("ab12") == 3
    assert "LOCKED | columns 1/1" in captured.err


def test_modes_are_listed(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["live", "/dev/video0", "--list"]) == ExitCode.OK
    assert capsys.readouterr().out.splitlines()[0] == "Y16 96 x 64 at 60 frames/s"


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (["/dev/null", "--exposure", "soon"], ExitCode.USAGE, "'soon' is no time"),
        (["/dev/null", "--format", "RGB3"], ExitCode.USAGE, "--format RGB3 is not known; known are"),
        (["/dev/null"], ExitCode.UNREADABLE, "/dev/null: is no V4L2 device"),
        (["/nowhere/video7"], ExitCode.UNREADABLE, "/nowhere/video7: no such camera; plug it in"),
    ],
)
def test_without_a_camera(arguments: list[str], code: ExitCode, told: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["live", *arguments]) == code
    [line] = capsys.readouterr().err.splitlines()
    assert told in line


def result(status: str, n_packets: int) -> FrameResult:
    packet = PacketResult(0.0, 1.5, 100, "00", confidence=1.0, ber_hat=0.01)
    columns = [ColumnResult(c, "ok" if c < 15 else "dark", packets=(packet,) * (c < n_packets)) for c in range(20)]
    return FrameResult("/dev/video0", 0, 0.0, status, columns=tuple(columns))  # type: ignore[arg-type]


class TestStatus:
    def test_lock_and_its_loss(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """The loss shows at once, with reason and next step."""
        clock = iter([10.0, 10.25, 10.5, 10.75, 11.0, 11.01])
        monkeypatch.setattr("rxcli.cli.following.time.monotonic", lambda: next(clock))
        source = LiveSource(tmp_path)
        source.counts = CameraCounts(dropped=7, damaged=2)
        status = Status(source)
        for _ in range(5):
            status.update(result("partial", 10))
        expected = "LOCKED | columns 15/20 | 4.0 frames/s | 40 packets/s | 4.0 kb/s | BER about 1.0e-02 | "
        assert capsys.readouterr().err.splitlines()[-1] == expected + "dropped 7 | damaged 2"
        assert status.n_packets == 50
        status.update(FrameResult("/dev/video0", 1, 0.1, "no_screen", "it is black; expose longer"))
        line = capsys.readouterr().err.splitlines()[-1]
        assert line.startswith("no screen | columns 0/0")
        assert line.endswith("It is black. Expose longer.")

    def test_light_and_height_are_told(self, tmp_path: Path) -> None:
        status = Status(LiveSource(tmp_path), quiet=True)
        frame = Frame(np.full((100, 200), 255, np.uint8), "/dev/video0")
        corners = np.array([[0, 20], [99, 20], [99, 50], [0, 50]], np.float64)
        for _ in status.watched([frame]):
            status.update(replace(result("ok", 20), corners=corners))
        assert status.state is not None
        assert format_status(status.state, CameraCounts())[1].startswith("light overexposed | screen fills 30 % of the")

    def test_on_a_terminal_a_block_stays_in_place(self) -> None:
        """Three lines that are written over, payloads above them; not a line for every frame."""
        code = (
            "import time; from dataclasses import replace; from pathlib import Path\n"
            "from rxcli.cli.following import _show\n"
            "from test_live import result, LiveSource, Status\n"
            "with Status(LiveSource(Path('x'))) as status:\n"
            "    for _ in range(4):\n"
            "        _show(replace(result('no_screen', 0), link_notes=('payload',)))\n"
            "        status.update(result('ok', 20)); time.sleep(0.25)\n"
        )
        shown, here = bytearray(), Path(__file__).parent
        paths = os.pathsep.join([ENVIRONMENT["PYTHONPATH"], str(here), str(here.parent)])
        told = ENVIRONMENT | {"COLUMNS": "100", "NO_COLOR": "1", "PYTHONPATH": paths}
        leader, follower = pty.openpty()
        termios.tcsetwinsize(follower, (24, 100))
        with subprocess.Popen([sys.executable, "-c", code], stdout=follower, stderr=follower, env=told) as started:
            os.close(follower)
            with suppress(OSError):
                while part := os.read(leader, 65536):
                    shown += part
            assert started.wait() == 0
        os.close(leader)
        text = shown.decode()
        assert text.count("payload\r\n") == 4
        assert text.count("LOCKED | columns 15/20") >= 4
        assert "\x1b[A" in text  # goes back up instead of writing on


@pytest.mark.parametrize("width", [30, 99])
def test_nothing_of_the_status_is_cut_off_by_a_narrow_terminal(width: int) -> None:
    reason = "no area with stripes was found; use the electronic shutter and a short exposure"
    lines = format_status(Aim().update(FrameResult("a", 0, 0.0, "no_screen", reason), 0.0, 1000), CameraCounts())
    fitted = wrapped("\n".join(lines), width).split("\n")
    assert max(map(len, fitted)) <= width
    assert " ".join(fitted).split() == " ".join(lines).split()


@pytest.mark.parametrize(
    ("moved_px", "received", "said"), [(30.0, 2, True), (30.0, 18, False), (3.0, 2, False), (0.0, 0, False)]
)
def test_a_hand_is_told_to_hold_still_only_when_it_matters(moved_px: float, received: int, said: bool) -> None:
    corners = np.array([[100.0, 100.0], [900.0, 100.0], [900.0, 600.0], [100.0, 600.0]])
    columns = tuple(ColumnResult(k, "ok" if k < received else "no_packet") for k in range(20))
    still = FrameResult("camera", 0, 0.0, "ok" if received else "no_signal", corners=corners, columns=columns)
    aim = Aim()
    aim.update(still, 0.0, 1080)
    state = aim.update(replace(still, frame=1, corners=corners + moved_px), 1 / 30, 1080)
    assert ("Hold the camera still." in state.advice) == said
    assert said or not received or not state.reason
