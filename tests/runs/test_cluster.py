"""A real Dask scheduler with two worker processes on the loopback interface."""

import gc
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from commands import ENVIRONMENT
from fake_receiver import fake_decoder
from small_frames import write_frame, write_profiles

from rxcli.cli.main import run
from rxcli.errors import OutputError, UsageError
from rxcli.results.record import to_json_line
from rxcli.runs import cluster
from rxcli.runs.batch import Source, decode_here
from rxcli.runs.cluster import decode_on_cluster
from rxcli.types import Frame, FrameResult

pytest.importorskip("distributed", reason="dask.distributed is not installed (extra cluster)")

QUIET = {"DASK_DISTRIBUTED__SCHEDULER__DASHBOARD__ENABLED": "False", "DASK_DISTRIBUTED__COMM__TIMEOUTS__CONNECT": "5s"}


@contextmanager
def process(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """`python -m distributed...`, killed at the end."""
    command = [sys.executable, "-W", "ignore", "-m", *arguments]
    started = subprocess.Popen(command, env=ENVIRONMENT | QUIET, stderr=subprocess.PIPE, text=True)
    try:
        yield started
    finally:
        started.kill()
        started.wait()
        started.stderr.close()


def wait_for(started: subprocess.Popen[str], pattern: str) -> re.Match[str]:
    for line in started.stderr:
        found = re.search(pattern, line)
        if found:
            return found
    raise AssertionError(f"ended without saying {pattern!r}")


@contextmanager
def worker(address: str, folder: Path, name: str) -> Iterator[subprocess.Popen[str]]:
    options = ("--no-nanny", "--nthreads", "1", "--no-dashboard", "--local-directory", str(folder), "--name", name)
    with process("distributed.cli.dask_worker", address, *options) as started:
        wait_for(started, "Registered to")
        yield started


def write_orders(folder: Path) -> list[Source]:
    orders = {f"{i:02}.jpg": {"sleep_s": 0.05} for i in range(30)}
    orders["clip.mp4"] = {"frames": 5, "sleep_s": 0.05}
    orders["cut.mp4"] = {"frames": 5, "fail_at": 2}
    for name, order in orders.items():
        (folder / name).write_text(json.dumps(order))
    return [Source(str(folder / name), str(folder / name)) for name in orders]


def test_a_run_is_complete_and_in_order_though_a_worker_is_killed(tmp_path: Path) -> None:
    sources = write_orders(tmp_path)
    alone = [to_json_line(result) for _, results in decode_here(sources, fake_decoder()) for result in results]
    scheduler_options = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard")
    with process("distributed.cli.dask_scheduler", *scheduler_options) as scheduler:
        address = wait_for(scheduler, r"Scheduler at:\s*(tcp://[0-9.:]+)").group(1)
        with worker(address, tmp_path, "first") as first, worker(address, tmp_path, "second") as second:
            lines = []
            for number, (_, results) in enumerate(decode_on_cluster(sources, fake_decoder(), address)):
                lines += [to_json_line(result) for result in results]
                if number == 5:
                    first.send_signal(signal.SIGKILL)
            assert first.wait() == -signal.SIGKILL
            assert second.poll() is None
    assert lines == alone


UNSEEING = """
import os, sys
from distributed.cli.dask_worker import main
share, access = sys.argv.pop(1), os.access
os.access = lambda path, mode: not str(path).startswith(share) and access(path, mode)
main()
"""


@pytest.mark.parametrize("n_seeing", [1, 0])
def test_what_a_worker_without_the_share_does_not_see_goes_to_another(
    tmp_path: Path, n_seeing: int, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "share").mkdir()
    sources = write_orders(tmp_path / "share")[:8]
    sources.append(Source("missing", str(tmp_path / "share" / "missing")))
    alone = [to_json_line(result) for _, results in decode_here(sources, fake_decoder()) for result in results]
    scheduler_options = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard")
    options = ("--no-nanny", "--nthreads", "1", "--no-dashboard", "--local-directory", str(tmp_path))
    with ExitStack() as stack:
        scheduler = stack.enter_context(process("distributed.cli.dask_scheduler", *scheduler_options))
        address = wait_for(scheduler, r"Scheduler at:\s*(tcp://[0-9.:]+)").group(1)
        (tmp_path / "unseeing.py").write_text(UNSEEING)
        stack.enter_context(pytest.MonkeyPatch.context()).setitem(ENVIRONMENT, "PYTHONPATH", path_with(tmp_path))
        for module, *more in [("unseeing", str(tmp_path / "share"))] + [("distributed.cli.dask_worker",)] * n_seeing:
            wait_for(stack.enter_context(process(module, *more, address, *options)), "Registered to")
        decoded = [result for _, results in decode_on_cluster(sources, fake_decoder(), address) for result in results]
    if n_seeing:
        assert [to_json_line(result) for result in decoded] == alone
    else:
        assert {(result.status, result.retry) for result in decoded[:-1]} == {("unreadable", True)}
        assert "no worker sees it; give them the folder under the same path" in decoded[0].message
        assert "no picture" in decoded[-1].message
    assert len([record for record in caplog.records if "does not see" in record.getMessage()]) <= 1


def path_with(folder: Path) -> str:
    return os.pathsep.join([ENVIRONMENT["PYTHONPATH"], str(folder)])


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_taps_land_where_the_user_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Workers write nothing but scratch files of their own; the command writes what comes back."""
    (tmp_path / "profiles").mkdir()
    names = write_profiles(tmp_path / "profiles")
    with (tmp_path / "profiles" / "camera.toml").open("a") as file:
        file.write("[lens]\nwidth = 340\nheight = 620\n")
        file.write(
            "camera_matrix = [[300.0, 0, 169.5], [0, 300.0, 309.5], [0, 0, 1]]\ndist_coeffs = [0.01, 0, 0, 0, 0]\n"
        )
    for name in ("a", "b"):
        (tmp_path / "in" / name).mkdir(parents=True)
        write_frame(tmp_path / "in" / name / "x.png", 1)
    monkeypatch.chdir(tmp_path)
    command = ["decode", "in", *names, "--quiet"]
    assert run([*command, "--dump-dir", "here/taps", "--save-undistorted", "here/straight"]) == 0
    written = []
    monkeypatch.setattr("rxcli.runs.cluster._write", lambda taps, _decoder: written.extend(taps))
    scheduler_options = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard")
    with process("distributed.cli.dask_scheduler", *scheduler_options) as scheduler:
        address = wait_for(scheduler, r"Scheduler at:\s*(tcp://[0-9.:]+)").group(1)
        with worker(address, tmp_path, "only"):
            options = ["--dump-dir", "there/taps", "--save-undistorted", "there/straight", "--cluster", address]
            assert run([*command, *options]) == 0, capsys.readouterr().err
            assert contents(tmp_path / "there") == {}
            assert len(written) == 4
            monkeypatch.undo()
            monkeypatch.chdir(tmp_path)
            assert run([*command, *options]) == 0, capsys.readouterr().err
    here, there = contents(tmp_path / "here"), contents(tmp_path / "there")
    assert sorted(there) == sorted(here) == [f"{kind}/{n}/x.png{end}" for kind, end in KINDS for n in "ab"]
    assert all(there[name] == data for name, data in here.items() if name.endswith(".png"))


KINDS = (("straight", ".00000.png"), ("taps", "-000000.npz"))


@dataclass(frozen=True)
class Writer:
    """Writes 3 MB for every frame, and a line when its result comes."""

    folder: Path

    def __call__(self, frame: Frame, subfolder: str) -> None:
        self.folder.mkdir()
        (self.folder / "a.png").write_bytes(bytes(3 << 20))

    def finish(self, result: FrameResult, subfolder: str) -> None:
        (self.folder / "b.png").write_bytes(b"late")


def test_taps_come_back_with_the_results_unless_they_are_too_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    writer = Writer(tmp_path / "there")
    source, decoder = write_orders(tmp_path)[0], replace(fake_decoder(), tap=writer, after=writer.finish)
    results, taps = cluster._decode(decoder, source)
    assert [result.status for result in results] == ["ok"]
    assert taps == [("--save-undistorted/a.png", bytes(3 << 20)), ("--save-undistorted/b.png", b"late")]
    assert not (tmp_path / "there").exists()
    monkeypatch.setattr(cluster, "_MAX_TAPPED", 1 << 20)
    with pytest.raises(OutputError, match=r"00\.jpg: its taps take 3 MB; a cluster sends at most 1 MB"):
        cluster._decode(decoder, source)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:1", "tcp://127.0.0.1:99999", "silent", "nonsense://x", "", "\0"])
def test_a_scheduler_that_is_not_there(address: str, tmp_path: Path) -> None:
    """Nothing of the attempt is left to the garbage collector: within a later connection it would lock that one up."""
    from distributed import Client

    server, is_silent = socket.create_server(("127.0.0.1", 0)), address == "silent"
    if is_silent:
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
    gc.collect()
    gc.disable()
    try:
        with server, pytest.raises(UsageError, match=re.escape(f"no Dask scheduler answers at {address!r}")):
            next(decode_on_cluster(write_orders(tmp_path), fake_decoder(), address, connect_s=0.5))
        end_s = time.monotonic() + 5
        while left := [value for value in gc.get_objects() if isinstance(value, Client)]:
            if is_silent or time.monotonic() > end_s:
                break
            del left
            time.sleep(0.05)  # a thread of the attempt may still be ending
        assert is_silent or not left
    finally:
        gc.enable()
