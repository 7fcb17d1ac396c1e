"""A folder as people have them: photos, RAW files and clips, some of them bad, and a run that is killed and resumed."""

import csv
import json
import subprocess
import time
from itertools import pairwise
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from commands import COMMAND, ENVIRONMENT
from ingest_files import BAYER, write_dng
from small_frames import write_frame, write_profiles

from rxcli.errors import ExitCode
from rxcli.ingest import open_source
from rxcli.lab.benchmark.media import repeat_clip
from rxcli.runs.processes import ONE_THREAD

GOOD = (
    *("a.jpg", "monday/b.png", "monday/roof/c.dng", "tuesday/d.tif", "e.jpeg", "monday/f.mp4"),
    *("monday/roof/g.png", "tuesday/h.dng", "i.tif", "monday/j.jpeg", "monday/roof/k.jpg", "tuesday/l.avi"),
)
N_KILLS, N_FRAMES = 3, 4


def write_good(path: Path, seed: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix not in (".dng", ".mp4", ".avi"):
        write_frame(path, seed)
        return
    picture = path.with_suffix(".png")
    write_frame(picture, seed)
    pixels = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    picture.unlink()
    if path.suffix == ".dng":
        white = (50728, "2I", 3, (1, 1) * 3, True)  # the light is as white as daylight
        write_dng(path, pixels.astype(np.uint16) * 12 + 100, BAYER, white)
        return
    path.with_suffix(".truth.json").unlink()
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mjpeg" if path.suffix == ".avi" else "libx264", rate=30)
        stream.height, stream.width = pixels.shape
        stream.pix_fmt = "yuvj420p" if path.suffix == ".avi" else "yuv420p"
        for _ in range(N_FRAMES):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, "gray").reformat(format=stream.pix_fmt)))
        container.mux(stream.encode())


def write_bad(folder: Path) -> list[Path]:
    """Files that cannot be read, and, the last two, files without a packet."""
    rng, data = np.random.default_rng(1), {name: (folder / name).read_bytes() for name in GOOD}
    cut = {f"cut{Path(name).suffix}": data[name][: len(data[name]) // 2] for name in GOOD}
    made = cut | {
        "empty.jpg": b"",
        "letter.jpg": b"Dear reader,\nthis is a letter and no picture.\n",
        "archive.tif": b"PK\x03\x04" + bytes(600),
        "random.heic": rng.bytes(4096),
        "black.png": bytes(cv2.imencode(".png", np.zeros((620, 340), np.uint8))[1]),
        "noise.png": bytes(cv2.imencode(".png", rng.integers(0, 255, (620, 340), dtype=np.uint8))[1]),
    }
    for name, content in made.items():
        (folder / name).write_bytes(content)
    return [folder / name for name in made]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("folder")
    for number, name in enumerate(GOOD):
        write_good(folder / name, number)
    return [folder / name for name in GOOD]


@pytest.mark.slow
def test_killed_and_resumed_runs_give_the_same_results(good: list[Path], tmp_path: Path) -> None:
    """`kill -9` at random moments: but for the times, the same lines as without kills."""
    folder, rng = good[0].parent, np.random.default_rng(12)
    bad = write_bad(folder)
    options = [*write_profiles(tmp_path), "--quiet", "--workers", "2", "--truth", "auto"]

    def start(out: Path, *more: str) -> subprocess.Popen[bytes]:
        command = [*COMMAND, "decode", str(folder), *options]
        command += ["--json", str(out), "--summary", str(out.with_suffix(".csv")), *more]
        return subprocess.Popen(command, env=ENVIRONMENT | ONE_THREAD, stderr=subprocess.DEVNULL)

    whole, killed = tmp_path / "whole.jsonl", tmp_path / "killed.jsonl"
    began = time.monotonic()
    assert start(whole).wait() == ExitCode.UNREADABLE
    longest_s, kills = (time.monotonic() - began) / 2, 0
    while kills < N_KILLS:
        process = start(killed, "--resume")
        try:
            process.wait(timeout=rng.uniform(0, longest_s))
            killed.unlink(missing_ok=True)  # it was done: every kill is to hit a living process
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            kills += 1
    assert start(killed, "--resume").wait() == ExitCode.UNREADABLE
    records = [
        [json.loads(line) | {"timing_ms": None} for line in out.read_text().splitlines()] for out in (whole, killed)
    ]
    assert records[0] == records[1]
    for out in (whole, killed):
        with out.with_suffix(".csv").open(encoding="utf-8", newline="") as file:
            rows = {row["source"]: row for row in csv.DictReader(file)}
        assert {rows[str(path)]["exit_code"] for path in good} == {"0"}
        assert all(rows[str(path)]["exit_code"] != "0" and rows[str(path)]["reason"] for path in bad)
        assert "the file is empty" in rows[str(folder / "empty.jpg")]["reason"]


def test_a_clip_written_several_times_over_is_one_clip(good: list[Path], tmp_path: Path) -> None:
    short = next(path for path in good if path.suffix == ".mp4")
    out = tmp_path / "long.mp4"
    repeat_clip(short, out, 3)
    once, thrice = list(open_source(short)), list(open_source(out))
    assert len(thrice) == 3 * len(once)
    assert len({round(b.time_s - a.time_s, 3) for a, b in pairwise(thrice)}) == 1
    for number, frame in enumerate(thrice):
        assert (frame.pixels == once[number % len(once)].pixels).all()
