"""Live cameras, through the system calls of a real V4L2 device that umockdev answers for a fake one."""

from __future__ import annotations

import json
import os
import pty
import shutil
import signal
import subprocess
import sys
import termios
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray

from rxcli.cli.live import Status, fit_lines, format_status
from rxcli.cli.main import run
from rxcli.errors import ExitCode, InputError
from rxcli.ingest import open_source
from rxcli.ingest.v4l2 import CameraCounts, CameraLost, LiveSource
from rxcli.profiles import ScreenProfile, dump_profile, load_profile
from rxcli.results.aim import Aim
from rxcli.types import ColumnResult, Frame, FrameResult, PacketResult

FAKE = Path(__file__).parents[1] / "fake_v4l2"
SYSTEM_PYTHON = "/usr/bin/python3"
WIDTH, HEIGHT, N_FRAMES = 96, 64, 10
PROBE = "import gi; gi.require_version('UMockdev', '1.0'); from gi.repository import UMockdev"


def _umockdev_is_there() -> bool:
    if shutil.which(SYSTEM_PYTHON) is None:
        return False
    return subprocess.run([SYSTEM_PYTHON, "-c", PROBE], capture_output=True, check=False).returncode == 0


needs_umockdev = pytest.mark.skipif(
    not _umockdev_is_there(), reason="needs Debian's umockdev, gir1.2-umockdev-1.0 and python3-gi"
)


class Bench:
    """A fake camera's scene, and commands run in front of it."""

    def __init__(self, folder: Path, luma: NDArray[np.uint8]) -> None:
        self.luma = luma
        self._scene = folder / "scene.json"
        luma.tofile(folder / "frames.luma")
        jpegs = []
        for number, picture in enumerate(luma):
            data = simplejpeg.encode_jpeg(
                picture[:, :, None].copy(), quality=100, colorspace="GRAY", colorsubsampling="Gray"
            )
            (folder / f"{number}.jpg").write_bytes(data)
            jpegs.append(str(folder / f"{number}.jpg"))
        height, width = luma.shape[1:]
        self._options: dict[str, Any] = {"width": width, "height": height, "luma": str(folder / "frames.luma")}
        self._options["jpegs"] = jpegs

    def command(self, *command: str, **scene: Any) -> list[str]:
        """The command line that runs `command` in front of the camera."""
        self._scene.write_text(json.dumps(self._options | scene))
        return [SYSTEM_PYTHON, str(FAKE / "serve.py"), str(self._scene), *command]

    def client(self, settings: dict[str, Any], n_frames: int = N_FRAMES, pause_s: float = 0.0, **scene: Any) -> Any:
        """What the receiver's reader saw."""
        command = [sys.executable, str(FAKE / "client.py"), json.dumps(settings), str(n_frames), str(pause_s)]
        done = subprocess.run(
            self.command(*command, **scene), capture_output=True, text=True, timeout=60, check=True, env=environment()
        )
        return json.loads(done.stdout)

    def vlc_rx(self, *arguments: str, **scene: Any) -> subprocess.CompletedProcess[str]:
        """Run the command line in front of the camera."""
        command = self.command(*VLC_RX, *arguments, **scene)
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, env=environment())

    def state(self) -> Any:
        """The camera's last state."""
        return json.loads(self._scene.with_suffix(".state.json").read_text())


VLC_RX = (sys.executable, "-c", "from rxcli.cli.main import main; main()")


def environment() -> dict[str, str]:
    return dict(os.environ, PYTHONPATH=str(Path(__file__).resolve().parents[2]))


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    rows = np.random.default_rng(11).integers(0, 256, (8, HEIGHT, 1), dtype=np.uint8)
    return Bench(tmp_path, np.repeat(rows, WIDTH, axis=2))


FORMATS = [
    ("GREY", 0, 0, 255),
    ("Y10", 2, 0, 1023),
    ("Y12", 4, 0, 4095),
    ("Y16", 8, 0, 65535),
    ("YUYV", 0, 16, 235),
    ("NV12", 0, 16, 235),
    ("MJPG", 0, 0, 255),
]


@needs_umockdev
class TestFormats:
    @pytest.mark.parametrize(("name", "shift", "black", "white"), FORMATS, ids=[form[0] for form in FORMATS])
    def test_luma_arrives_as_sent(self, bench: Bench, name: str, shift: int, black: float, white: float) -> None:
        seen = bench.client({"pixel_format": name})
        assert seen["error"] is None
        assert len(seen["frames"]) == N_FRAMES
        sent = bench.luma[:, :, 0].astype(int) << shift
        for frame in seen["frames"]:
            error = np.abs(sent - np.array(frame["rows"])).max(axis=1).min()
            assert error <= (2 if name == "MJPG" else 0)
            assert frame["levels"] == [black, white]
            assert frame["dtype"] == ("uint16" if shift else "uint8")
            assert frame["model"] == "Fake camera"
        assert bench.state()["format"].strip() == name

    def test_times_are_those_of_the_sensor(self, bench: Bench) -> None:
        times = [frame["time_s"] for frame in bench.client({"pixel_format": "GREY"}, n_frames=20)["frames"]]
        steps = np.diff(times) * 60
        assert times[0] == 0
        np.testing.assert_allclose(steps, np.rint(steps), atol=0.01)
        assert (steps > 0.5).all()

    def test_best_format_is_taken_and_another_refused(self, bench: Bench) -> None:
        assert bench.client({}, 1)["mode"].startswith("Y16 96 x 64")
        assert bench.client({}, 1, formats=["YUYV", "MJPG"])["mode"].startswith("YUYV")
        seen = bench.client({"width": 640}, 1)
        assert (
            "/dev/video0: does not offer any format 640 x any; it offers GREY 96 x 64 at 60 frames/s" in seen["error"]
        )
        seen = bench.client({"pixel_format": "YUYV"}, 1, faults={"force_format": "GREY"})
        assert seen["error"] == "/dev/video0: gives GREY instead of YUYV; ask for another --format"


@needs_umockdev
class TestControls:
    def test_shortest_exposure_and_no_automatics(self, bench: Bench) -> None:
        assert bench.client({}, 1)["frames"][0]["exposure_s"] == pytest.approx(1e-4)
        controls = bench.state()["controls"]
        assert controls["0x9a0901"] == 1  # manual
        assert controls["0x9a0902"] == 1
        assert controls["0x9a0903"] == 0  # constant frame rate
        assert controls["0x980913"] == 16  # gain as it was

    def test_exposure_and_gain_as_asked(self, bench: Bench) -> None:
        assert bench.client({"exposure_s": 0.002, "gain": 99}, 1)["frames"][0]["exposure_s"] == pytest.approx(0.002)
        controls = bench.state()["controls"]
        assert controls["0x9a0902"] == 20
        assert controls["0x980913"] == 99
        assert controls["0x980912"] == 0


@needs_umockdev
class TestFaults:
    def test_slow_receiver_gets_the_newest_and_a_count(self, bench: Bench) -> None:
        seen = bench.client({"pixel_format": "GREY"}, n_frames=6, pause_s=0.1)
        sensor_frames = round(seen["frames"][-1]["time_s"] * 60)
        assert sensor_frames > 20
        assert seen["dropped"] >= sensor_frames - 5 - 2  # some may come after the last that was taken
        steps = np.diff([frame["time_s"] for frame in seen["frames"]])
        assert steps.min() > 0.05

    def test_unplugged(self, bench: Bench) -> None:
        seen = bench.client({}, faults={"unplug_after": 4})
        assert len(seen["frames"]) <= 4
        assert seen["error"] == "/dev/video0: the camera was unplugged; plug it in again; --wait waits for it"

    def test_waits_for_a_camera_that_comes_back(self, bench: Bench) -> None:
        seen = bench.client({"wait": True}, faults={"unplug_after": 4, "return_s": 0.3})
        assert seen["error"] is None
        assert [frame["index"] for frame in seen["frames"]] == list(range(N_FRAMES))
        times = [frame["time_s"] for frame in seen["frames"]]
        assert times == sorted(times)
        assert seen["connections"] == 2
        assert len(seen["waited"]) == 1

    def test_busy(self, bench: Bench) -> None:
        error = bench.client({}, faults={"busy_s": 100})["error"]
        assert error.startswith("/dev/video0: another program uses the camera; close it")
        seen = bench.client({"wait": True}, 2, faults={"busy_s": 1})
        assert (seen["error"], len(seen["frames"]), len(seen["waited"])) == (None, 2, 1)

    def test_silent(self, bench: Bench) -> None:
        seen = bench.client({"stall_s": 0.3}, faults={"stall_after": 3})
        assert 1 <= len(seen["frames"]) <= 3
        assert "the camera sent nothing for 0.3 s" in seen["error"]

    def test_damaged_frames_are_left_out(self, bench: Bench) -> None:
        seen = bench.client({"pixel_format": "GREY"}, faults={"damage_every": 3})
        assert len(seen["frames"]) == N_FRAMES
        assert seen["damaged"] >= 4


@needs_umockdev
class TestCommand:
    def test_modes(self, bench: Bench) -> None:
        done = bench.vlc_rx("live", "/dev/video0", "--list")
        assert done.returncode == ExitCode.OK
        assert done.stdout.splitlines()[0] == "Y16 96 x 64 at 60 frames/s"

    def test_unplugged(self, bench: Bench) -> None:
        done = bench.vlc_rx("live", "/dev/video0", "--json", "-", faults={"unplug_after": 5})
        assert done.returncode == ExitCode.UNREADABLE
        assert "vlc-rx: /dev/video0: the camera was unplugged" in done.stderr
        assert "Traceback" not in done.stderr
        assert all(json.loads(line)["status"] != "ok" for line in done.stdout.splitlines())

    def test_nothing_received(self, bench: Bench) -> None:
        done = bench.vlc_rx("live", "/dev/video0", "--json", "-", "--frames", "3")
        assert done.returncode == ExitCode.NOT_RECEIVED
        assert [json.loads(line)["frame"] for line in done.stdout.splitlines()] == [0, 1, 2]
        assert "columns 0/0" in done.stderr

    def test_duration(self, bench: Bench) -> None:
        done = bench.vlc_rx("live", "/dev/video0", "--duration", "0.3", "--quiet")
        assert (done.returncode, done.stderr) == (ExitCode.NOT_RECEIVED, "")

    @pytest.mark.parametrize("faults", [{"busy_s": 100}, {"stall_after": 0}, {"damage_every": 1}], ids=str)
    def test_duration_counts_from_the_start_whatever_comes(self, bench: Bench, faults: dict[str, int]) -> None:
        """A camera that is busy, sends nothing, or nothing whole: without a duration it would be waited for."""
        done = bench.vlc_rx("live", "/dev/video0", "--wait", "--duration", "0.5", "--json", "-", faults=faults)
        assert done.returncode == ExitCode.NOT_RECEIVED, done.stderr
        assert done.stdout == ""

    def test_damaged_frames_alone_have_a_status_line(self, bench: Bench) -> None:
        done = bench.vlc_rx("live", "/dev/video0", "--duration", "0.5", faults={"damage_every": 1})
        assert done.returncode == ExitCode.NOT_RECEIVED
        last = done.stderr.splitlines()[-1]
        assert last.startswith("no whole frame yet | dropped ")
        assert int(last.rpartition(" ")[2]) > 0

    def test_interrupt(self, bench: Bench) -> None:
        command = bench.command(*VLC_RX, "live", "/dev/video0")
        process = subprocess.Popen(
            command, stderr=subprocess.PIPE, text=True, env=environment(), start_new_session=True
        )
        assert process.stderr is not None
        first = process.stderr.readline()
        os.killpg(process.pid, signal.SIGINT)
        rest = process.communicate(timeout=30)[1]
        assert "columns 0/0" in first
        assert process.returncode == ExitCode.INTERRUPTED
        assert rest.splitlines()[-1] == "vlc-rx: interrupted"
        assert "Traceback" not in rest


@needs_umockdev
def test_payloads_of_a_simulated_screen(tmp_path: Path) -> None:
    """Simulated frames go through the system calls of a camera, and their payloads come out.

    The camera shows one picture over and over, whichever frames are dropped: the screen sends one burst a frame time,
    and the same payload in each.
    """
    screen, clip = tmp_path / "loop.toml", tmp_path / "clip.avi"
    paper = load_profile("paper-17k3", ScreenProfile)
    loop = msgspec.structs.replace(paper, name="loop", slot_rate_hz=18000.0, payload_symbols=8)
    screen.write_text(dump_profile(loop))
    payload = np.random.default_rng(5).bytes(20 * 8 * 7 // 8)
    scene = ["--preset", "video-1080p", "--screen", str(screen), "--picture", "sky", "--frames", "1", "--seed", "3"]
    sent = ["--payload", f"hex:{payload.hex()}", "--start-slot", "40"]
    assert run(["simulate", str(clip), *scene, *sent]) == ExitCode.OK
    truth = json.loads((tmp_path / "clip.truth.json").read_text())
    bench = Bench(tmp_path, np.stack([frame.pixels for frame in open_source(clip)]))
    known = [f"{x},{y}" for x, y in truth["corners_sensor_px"]]
    receiver = ["--screen", str(screen), "--camera", "xs10", "--corners", *known]
    done = bench.vlc_rx("live", "/dev/video0", "--format", "GREY", "--frames", "2", "--json", "-", *receiver)
    assert done.returncode == ExitCode.OK, done.stderr
    assert "LOCKED" in done.stderr
    right = [
        packet["payload"] == payload[7 * column["column"] :][:7].hex()
        for line in done.stdout.splitlines()
        for column in json.loads(line)["columns"]
        for packet in column["packets"]
    ]
    assert len(right) >= 36  # one a column and frame
    assert np.mean(right) > 0.95


class TestWithoutCamera:
    def test_missing(self, tmp_path: Path) -> None:
        with pytest.raises(CameraLost, match="no such camera; plug it in"):
            next(iter(LiveSource(tmp_path / "video0")))

    def test_no_camera(self) -> None:
        with pytest.raises(InputError, match="/dev/null: is no V4L2 device"):
            next(iter(LiveSource(Path("/dev/null"))))

    @pytest.mark.parametrize("arguments", [["--exposure", "soon"], ["--exposure", "0"], ["--format", "RGB3"]])
    def test_bad_usage(self, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
        assert run(["live", "/dev/null", *arguments]) == ExitCode.USAGE
        assert len(capsys.readouterr().err.splitlines()) == 1

    def test_no_device(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert run(["live", str(tmp_path / "video7")]) == ExitCode.UNREADABLE
        assert capsys.readouterr().err.startswith(f"vlc-rx: {tmp_path / 'video7'}: no such camera; plug it in")


def result(status: str, n_packets: int) -> FrameResult:
    packet = PacketResult(0.0, 1.5, 100, "00", confidence=1.0, ber_hat=0.01)
    columns = [ColumnResult(c, "ok" if c < 15 else "dark", packets=(packet,) * (c < n_packets)) for c in range(20)]
    return FrameResult("/dev/video0", 0, 0.0, status, columns=tuple(columns))  # type: ignore[arg-type]


class TestStatus:
    def test_line(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        clock = iter([10.0, 10.25, 10.5, 10.75, 11.0])
        monkeypatch.setattr("rxcli.cli.live.time.monotonic", lambda: next(clock))
        source = LiveSource(tmp_path)
        source.counts = CameraCounts(dropped=7, damaged=2)
        with Status(source) as status:
            for _ in range(5):
                status.update(result("partial", 10))
        line = capsys.readouterr().err.splitlines()[-1]
        expected = "LOCKED | columns 15/20 | 4.0 frames/s | 40 packets/s | 4.0 kb/s | BER about 1.0e-02 | "
        assert line == expected + "dropped 7 | damaged 2"
        assert status.n_packets == 50

    def test_loss_of_lock_shows_at_once_with_reason_and_next_step(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        status = Status(LiveSource(tmp_path))
        status.update(result("ok", 20))
        lost = FrameResult("/dev/video0", 1, 0.1, "no_screen", "no screen found: it is black; expose longer")
        status.update(lost)
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

    def test_on_a_terminal_a_block_stays_in_place(self, tmp_path: Path) -> None:
        """Three lines that are written over, payloads above them; not a line for every frame."""
        code = (
            "import sys, time; from pathlib import Path; sys.path.insert(0, sys.argv[1]);"
            "from test_live import result, LiveSource, Status; from rxcli.cli.live import _print_above\n"
            "with Status(LiveSource(Path('x'))) as status:\n"
            "    for _ in range(4):\n"
            "        _print_above('payload'); status.update(result('ok', 20)); time.sleep(0.25)\n"
        )
        shown = bytearray()
        told = environment() | {"COLUMNS": "100", "NO_COLOR": "1"}
        leader, follower = pty.openpty()
        termios.tcsetwinsize(follower, (24, 100))
        path = [str(Path(__file__).parent)]
        with subprocess.Popen(
            [sys.executable, "-c", code, *path], stdout=follower, stderr=follower, env=told
        ) as started:
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


@pytest.mark.parametrize("width", [30, 59, 99])
def test_nothing_of_the_status_is_cut_off_by_a_narrow_terminal(width: int) -> None:
    reason = "no screen found: no area with stripes was found; use the electronic shutter and a short exposure"
    result = FrameResult("camera", 0, 0.0, "no_screen", reason)
    lines = format_status(Aim().update(result, 0.0, 1000), CameraCounts())
    fitted = fit_lines(lines, width)
    assert max(map(len, fitted)) <= width
    assert " ".join(fitted).split() == " ".join(lines).split()
    assert fit_lines(["", "a"], width) == ["", "a"]


@pytest.mark.parametrize(
    ("moved_px", "received", "said"), [(30.0, 2, True), (30.0, 18, False), (3.0, 2, False), (0.0, 0, False)]
)
def test_a_hand_is_told_to_hold_still_only_when_it_matters(moved_px: float, received: int, said: bool) -> None:
    corners = np.array([[100.0, 100.0], [900.0, 100.0], [900.0, 600.0], [100.0, 600.0]])
    columns = tuple(ColumnResult(k, "ok" if k < received else "no_packet") for k in range(20))
    aim = Aim()
    for frame in range(2):
        at = corners + frame * moved_px
        result = FrameResult("camera", frame, 0.0, "ok" if received else "no_signal", corners=at, columns=columns)
        state = aim.update(result, frame / 30, 1080)
    assert ("Hold the camera still." in state.advice) == said
    if received and not said:
        assert not state.reason
