"""A decode opens no socket of the internet family and writes no file but its outputs, whatever it reads."""

import ctypes
import os
import shutil
import signal
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from ingest_files import N_FRAMES, read_all, write_clip

from rxcli.resources import data_dir

#: linux/prctl.h, linux/seccomp.h: a filter that a process sets for itself and its children.
_NO_NEW_PRIVS, _SET_SECCOMP, _FILTER, _KILL, _ALLOW = 38, 22, 2, 0x80000000, 0x7FFF0000
#: Number of `socket` by machine; AF_INET and AF_INET6.
_SOCKET, _INTERNET = {"x86_64": 41, "aarch64": 198}, (2, 10)
_LOAD, _JUMP_IF, _RETURN = 0x20, 0x15, 0x06


class _Program(ctypes.Structure):
    _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_char_p))


def forbid_internet() -> None:
    """Have the kernel end this process, and those it starts, at the first internet socket."""
    steps = [
        (_LOAD, 0, 0, 0),  # seccomp_data.nr
        (_JUMP_IF, 0, 4, _SOCKET[os.uname().machine]),
        (_LOAD, 0, 0, 16),  # seccomp_data.args[0]
        (_JUMP_IF, 1, 0, _INTERNET[0]),
        (_JUMP_IF, 0, 1, _INTERNET[1]),
        (_RETURN, 0, 0, _KILL),
        (_RETURN, 0, 0, _ALLOW),
    ]
    code = b"".join(struct.pack("HBBI", *step) for step in steps)
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    prctl.argtypes = [ctypes.c_int, *[ctypes.c_void_p] * 4]
    if prctl(_NO_NEW_PRIVS, 1, 0, 0, 0) or prctl(
        _SET_SECCOMP, _FILTER, ctypes.addressof(_Program(len(steps), code)), 0, 0
    ):
        raise OSError(ctypes.get_errno(), "no filter of system calls")


def run_forbidden(*command: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a Python command without internet, in a fresh home."""
    if sys.platform != "linux" or os.uname().machine not in _SOCKET:
        pytest.skip("needs Linux's filter of system calls")
    home = cwd / "home"
    home.mkdir(exist_ok=True)
    places = dict.fromkeys(("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME"), str(home))
    environment = {**os.environ, **places, "PYTHONDONTWRITEBYTECODE": "1", "VLC_RX_HOME": str(home)}
    environment.pop("ORT_DISABLE_TELEMETRY", None)
    try:
        given = {"cwd": cwd, "env": environment, "capture_output": True, "text": True}
        return subprocess.run([sys.executable, *map(str, command)], preexec_fn=forbid_internet, **given)
    except subprocess.SubprocessError:
        pytest.skip("this machine lets no process filter its system calls")


def test_the_filter_ends_what_opens_an_internet_socket(tmp_path: Path) -> None:
    for family, code in (("AF_INET", -signal.SIGSYS), ("AF_INET6", -signal.SIGSYS), ("AF_UNIX", 0)):
        assert run_forbidden("-c", f"import socket as s; s.socket(s.{family})", cwd=tmp_path).returncode == code


@pytest.mark.parametrize(
    "names", [["video1080_chelsea_17k3.mp4"], ["phone_chelsea_17k3.jpg", "xtrans_sky_17k3.dng"]], ids=["MP4", "folder"]
)
def test_a_decode_writes_its_outputs_and_talks_to_nobody(tmp_path: Path, names: list[str]) -> None:
    """The auto-encoder runs, whose library by itself reports to its maker and keeps a device id."""
    (tmp_path / "in").mkdir()
    for name in names:
        shutil.copy(data_dir("sample_frames") / name, tmp_path / "in")
    source = tmp_path / "in" / names[0] if len(names) == 1 else tmp_path / "in"
    outputs = ("--json", "o.jsonl", "--summary", "o.csv", "--payloads", "p.csv")
    before = set(tmp_path.rglob("*"))
    ran = run_forbidden(
        *("-m", "rxcli.cli.main", "decode", source, "--cae", "always", "--workers", len(names), *outputs), cwd=tmp_path
    )
    assert ran.returncode == 0, ran.stderr
    assert '"model": "strips-' in (tmp_path / "o.jsonl").read_text()
    assert {str(path.relative_to(tmp_path)) for path in {*tmp_path.rglob("*")} - before} == {
        *("home", "o.jsonl", "o.csv", "p.csv")
    }


@pytest.mark.parametrize(
    "name", ["http:/host/x.mp4", "http:x.mp4", "a:b.mp4", "concat:a.mp4", "50%d?x=1#y.mp4", "a%d.jpg"]
)
def test_the_name_of_a_clip_is_the_name_of_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """FFmpeg takes what stands before a colon for a protocol, of the network for instance, and %d for other files."""
    monkeypatch.chdir(tmp_path)
    Path(name).parent.mkdir(parents=True, exist_ok=True)
    write_clip(tmp_path / "plain.mp4")
    (tmp_path / "plain.mp4").rename(name)
    frames, error = read_all(Path(name))
    assert error is None
    assert len(frames) == N_FRAMES


LISTS = {
    "list.m3u8": "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\na.mp4\n#EXT-X-ENDLIST\n",
    "list.mp4": "\n ffconcat version 1.0\nfile a.mp4\n",
    "list.ts": "<MPD><BaseURL>a.mp4</BaseURL></MPD>",
}


@pytest.mark.parametrize("name", LISTS)
def test_a_list_of_other_files_is_refused(tmp_path: Path, name: str) -> None:
    write_clip(tmp_path / "a.mp4")
    (tmp_path / name).write_text(LISTS[name])
    frames, error = read_all(tmp_path / name)
    assert not frames
    assert "is a list of other files, which are not opened" in str(error)
