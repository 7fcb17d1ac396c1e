"""A folder as people have them: photos, RAW files and clips, some of them bad, and a run that is killed and resumed."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_scene import scene, write_profiles

from rxcli.errors import ExitCode
from rxcli.ingest import open_source
from rxcli.lab.benchmark.media import repeat_clip
from rxcli.lab.simulate.capture import prepare
from rxcli.lab.simulate.files import write_dng, write_png, write_tiff, write_video
from rxcli.lab.simulate.truth import write_truth

GOOD = (
    *("a.jpg", "monday/b.png", "monday/roof/c.dng", "tuesday/d.tif", "e.jpeg", "monday/f.mp4"),
    *("monday/roof/g.png", "tuesday/h.dng", "i.tif", "monday/j.jpeg", "monday/roof/k.jpg", "tuesday/l.avi"),
)
N_KILLS = 3
ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}


def write_good(path: Path, seed: int) -> None:
    mode = {".mp4": "clip", ".avi": "clip", ".dng": "raw"}.get(path.suffix, "still")
    made = scene(mode, ("sky", "chelsea", "gradient")[seed % 3])
    if mode != "clip":  # one burst shows
        made = replace(made, start_slot=np.random.default_rng([seed, 13]).uniform(8, 25))
    take = prepare(made, seed)
    write_truth(take.truth(path.name), path)
    if mode == "clip":
        frames = (take.frame(number, threads=1).rgb for number in range(made.n_frames))
        write_video(frames, path, "mjpeg" if path.suffix == ".avi" else "h264", made.frame_rate_hz)
        return
    capture = take.frame(threads=1)
    if path.suffix == ".dng":
        write_dng(capture.raw, made, path)
    elif path.suffix == ".tif":
        write_tiff(capture.rgb, made, path)
    elif path.suffix == ".png":
        write_png(capture.rgb, path)
    else:
        path.write_bytes(capture.jpeg)


def write_bad(folder: Path, good: Sequence[Path]) -> list[Path]:
    """Files that cannot be read, and, the last four, files without a packet."""
    rng, data = np.random.default_rng(1), {path.suffix: path.read_bytes() for path in good}

    def cut(suffix: str, share: float) -> bytes:
        return data[suffix][: int(share * len(data[suffix]))]

    def png(picture: np.ndarray) -> bytes:
        return bytes(cv2.imencode(".png", picture)[1])

    scratched = bytearray(data[".png"])
    scratched[len(scratched) // 2 : len(scratched) * 5 // 8] = rng.bytes(len(scratched) // 8)
    lit = cv2.imdecode(np.frombuffer(data[".jpg"], np.uint8), cv2.IMREAD_GRAYSCALE)
    assert lit is not None
    made = {
        "empty.jpg": b"",
        "empty.mov": b"",
        "letter.jpg": b"Dear reader,\nthis is a letter and no picture.\n",
        "page.mp4": b"<!doctype html><title>404 Not Found</title>\n",
        "archive.tif": b"PK\x03\x04" + bytes(600),
        "zeros.jpg": bytes(10_000),
        "random.dng": rng.bytes(4096),
        "random.heic": rng.bytes(4096),
        "cut.jpg": cut(".jpg", 0.6),
        "head.jpg": cut(".jpg", 0.01),
        "cut.png": cut(".png", 0.5),
        "cut.dng": cut(".dng", 0.4),
        "cut.tif": cut(".tif", 0.5),
        "noindex.mp4": cut(".mp4", 0.5),
        "cut.avi": cut(".avi", 0.6),
        "scratched.png": bytes(scratched),
        "pixel.png": png(np.full((1, 1), 99, np.uint8)),
        "black.png": png(np.zeros((360, 640), np.uint8)),
        "noise.png": png(rng.integers(0, 255, (360, 640), dtype=np.uint8)),
        "unlit.png": png(cv2.blur(lit, (1, 121))),
    }
    for name, content in made.items():
        (folder / name).write_bytes(content)
    return [folder / name for name in made]


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("folder")
    paths = [folder / name for name in GOOD]
    for number, path in enumerate(paths):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_good(path, number)
    return paths


@pytest.mark.slow
def test_killed_and_resumed_runs_give_the_same_results(good: list[Path], tmp_path: Path) -> None:
    """`kill -9` at random moments: but for the times, the same lines as without kills."""
    folder, rng = good[0].parent, np.random.default_rng(12)
    bad = write_bad(folder, good)
    profiles = write_profiles(tmp_path)

    def start(out: Path, *more: str) -> subprocess.Popen[bytes]:
        command = [
            sys.executable,
            "-m",
            "rxcli.cli.main",
            "decode",
            str(folder),
            "--quiet",
            "--workers",
            "2",
            *profiles,
        ]
        command += ["--truth", "auto", "--json", str(out), "--summary", str(out.with_suffix(".csv")), *more]
        return subprocess.Popen(command, env=ENVIRONMENT, stderr=subprocess.DEVNULL)

    whole, killed = tmp_path / "whole.jsonl", tmp_path / "killed.jsonl"
    began = time.monotonic()
    assert start(whole).wait() == ExitCode.UNREADABLE
    longest_s, kills = (time.monotonic() - began) / 4, 0
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
        assert "the picture is black" in rows[str(folder / "black.png")]["reason"]


def test_a_clip_written_several_times_over_is_one_clip(good: list[Path], tmp_path: Path) -> None:
    short = next(path for path in good if path.suffix == ".mp4")
    out = tmp_path / "long.mp4"
    repeat_clip(short, out, 3)
    once, thrice = list(open_source(short)), list(open_source(out))
    assert len(thrice) == 3 * len(once)
    steps = {round(b.time_s - a.time_s, 4) for a, b in pairwise(thrice)}
    assert len(steps) == 1
    for number, frame in enumerate(thrice):
        assert (frame.pixels == once[number % len(once)].pixels).all()
