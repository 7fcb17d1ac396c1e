"""Mutated files of every kind through the whole program: an answer within limits, and never an internal error.

Every case is one call of `vlc-rx decode` (or `profiles validate`) on a valid file with something done to it: bytes
changed, cut, repeated, moved; or on a mutated truth, profile, journal or option. Many cases run in one process, which
reports a line each; a case that takes too long, or too much memory, ends the process and is named by its seed. The same
seed makes the same case.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import random
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, Queue
from threading import Thread
from typing import Any

from rxcli.resources import data_dir

#: What one process may take: resident memory, and time for one case on a machine of its own.
MOST_MB, MOST_S = 1500, 60.0
#: Address space of the process, which libraries reserve more of than they use; and waiting on a loaded machine.
_ADDRESSES_MB, _PATIENCE = 6000, 3
#: Exit code of a process that has grown and is to be begun anew.
_ENOUGH = 77
#: Bytes that decide much: ends of ranges, and what formats count with.
_TELLING = (b"\0", b"\xff", b"\x7f", b"\x80", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\0\0\0\0", b"\x01\0\0\0")
_NUMBERS = ("nan", "inf", "-inf", "-1", "0", "1e999", "1e-999", "9" * 5000, "x", "", "1,2", "0x10", "٣")
_OPTIONS = (
    "--min-confidence",
    "--max-ber",
    "--min-packets",
    "--workers",
    "--cae",
    "--corners",
    "--no-skip",
    "--camera",
)

Mutate = Callable[[bytes, random.Random], bytes]
Program = Callable[[list[str]], int]
#: The program is handed in by those above it.
_START = "from rxcli.cli.main import run; from rxcli.lab.benchmark.readers import serve; serve(run)"


def _change_bytes(data: bytes, rng: random.Random) -> bytes:
    changed = bytearray(data)
    # Headers decide most, and are small: half of the changes go there.
    for _ in range(rng.choice((1, 2, 4, 16, 64))):
        most = len(changed) if rng.random() < 0.5 else min(len(changed), 512)
        changed[rng.randrange(most)] = rng.randrange(256)
    return bytes(changed)


def _put_telling(data: bytes, rng: random.Random) -> bytes:
    value = rng.choice(_TELLING)
    at = rng.randrange(min(len(data), rng.choice((64, 1024, len(data)))))
    return data[:at] + value + data[at + len(value) :]


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))]


def _repeat(data: bytes, rng: random.Random) -> bytes:
    start, length = rng.randrange(len(data)), rng.choice((1, 16, 400, 5000))
    return data[:start] + data[start : start + length] * rng.choice((2, 10, 200)) + data[start:]


def _drop(data: bytes, rng: random.Random) -> bytes:
    start = rng.randrange(len(data))
    return data[:start] + data[start + rng.choice((1, 4, 100, 4000)) :]


def _swap(data: bytes, rng: random.Random) -> bytes:
    a, b = sorted(rng.randrange(len(data)) for _ in range(2))
    return data[b:] + data[a:b] + data[:a]


_MUTATIONS: tuple[Mutate, ...] = (_change_bytes, _change_bytes, _put_telling, _put_telling, _cut, _repeat, _drop, _swap)


def mutated(data: bytes, rng: random.Random) -> bytes:
    """`data` with one to three things done to it."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        data = rng.choice(_MUTATIONS)(data, rng) or b"\0"
    return data


def make_samples(folder: Path) -> dict[str, bytes]:
    """A small valid file of every format, by name; a frame of a shipped sample where it is a picture."""
    import av
    import cv2
    import numpy as np
    import tifffile
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    source = cv2.imread(str(data_dir("sample_frames") / "phone_chelsea_17k3.jpg"))
    assert source is not None
    picture = np.ascontiguousarray(cv2.resize(source, (256, 192), interpolation=cv2.INTER_AREA)[..., ::-1])
    image, exif = Image.fromarray(picture), Image.Exif()
    exif[0x010F], exif[0x0110], exif.get_ifd(0x8769)[0x829A] = "Example", "Camera", 1 / 8000
    image.save(folder / "a.jpg", exif=exif)
    image.save(folder / "progressive.jpg", progressive=True)
    image.save(folder / "a.png", exif=exif)
    cv2.imwrite(str(folder / "deep.png"), picture.astype(np.uint16) * 257)
    image.convert("P").save(folder / "palette.png")
    image.save(folder / "a.bmp")
    image.save(folder / "a.webp")
    tifffile.imwrite(folder / "a.tif", picture)
    tifffile.imwrite(folder / "zlib.tif", picture.astype(np.uint16) * 257, compression="zlib")
    tifffile.imwrite(folder / "float.tif", picture[..., 1].astype(np.float32))
    image.save(folder / "lzw.tif", compression="tiff_lzw")
    with contextlib.suppress(ImportError):
        import pillow_heif

        pillow_heif.from_pillow(image).save(str(folder / "a.heic"))
    tags = [
        (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, b"\0\1\1\2", True),
        (50706, "B", 4, b"\1\4\0\0", True),
        (50708, "s", 0, "Synthetic cam", True),
        (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
    ]
    mosaic = picture[..., 1].astype(np.uint16) * 16
    tifffile.imwrite(folder / "a.dng", mosaic, photometric=32803, extratags=tags, metadata=None)
    for name, codec in (("a.mp4", "libx264"), ("a.avi", "mjpeg"), ("a.mkv", "mjpeg"), ("a.ts", "libx264")):
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=30)
            stream.width, stream.height = 160, 120
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            small = cv2.resize(picture, (160, 120), interpolation=cv2.INTER_AREA)
            for _ in range(4):
                frame = av.VideoFrame.from_ndarray(small, "rgb24").reformat(format=stream.pix_fmt)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


@dataclass
class Verdict:
    """What came of all cases."""

    n: int = 0
    codes: Counter[str] = field(default_factory=Counter)
    kinds: Counter[str] = field(default_factory=Counter)
    #: What went wrong -> seeds.
    problems: dict[str, list[int]] = field(default_factory=dict)
    slowest_s: float = 0.0
    slowest_seed: int = -1
    most_mb: float = 0.0

    def add(self, record: dict[str, Any]) -> None:
        """Count one case."""
        self.n += 1
        self.codes[str(record["code"])] += 1
        self.kinds[record["kind"]] += 1
        self.most_mb = max(self.most_mb, record["mb"])
        if record["s"] > self.slowest_s:
            self.slowest_s, self.slowest_seed = record["s"], record["seed"]
        for problem in record["problems"]:
            self.problems.setdefault(problem, []).append(record["seed"])


class Cases:
    """Makes and runs cases in this process, each in a folder of its own.

    Args:
        folder: of samples and scratch files.
        program: takes the arguments of the command line and returns the exit code.
    """

    def __init__(self, folder: Path, program: Program) -> None:
        self._program = program
        self._samples = make_samples(folder / "samples")
        self._work = folder / f"work-{os.getpid()}"
        self._work.mkdir(exist_ok=True)
        shipped = data_dir("calibration")
        self._texts = {
            "screen": (shipped / "screens" / "paper-17k3.toml").read_bytes(),
            "camera": (data_dir("sample_frames") / "phone12.toml").read_bytes(),
            "truth": (data_dir("sample_frames") / "phone_chelsea_17k3.truth.json").read_bytes(),
        }
        self._whole: bytes | None = None

    def run(self, seed: int) -> dict[str, Any]:
        """Run one case; what came of it."""
        rng = random.Random(seed)
        kind = rng.choices(("file", "screen", "camera", "truth", "journal", "option"), (60, 8, 8, 8, 8, 8))[0]
        name, arguments = self._file(rng) if kind == "file" else (kind, getattr(self, f"_{kind}")(rng))
        began, cpu = time.monotonic(), time.process_time()
        code, text = _call(self._program, arguments)
        problems = [f"{name}: {line}" for line in text.splitlines() if "internal error" in line or "Traceback" in line]
        cpu_s, mb = time.process_time() - cpu, _peak_mb()
        if code not in (0, 1, 2, 3):
            problems.append(f"{name}: exit code {code}")
        if mb > MOST_MB:
            problems.append(f"{name}: {mb:.0f} MB")
        if min(cpu_s, time.monotonic() - began) > MOST_S:
            problems.append(f"{name}: {cpu_s:.0f} s")
        problems = [problem[:300].replace(str(self._work), "") for problem in problems]
        return {"seed": seed, "kind": name, "code": code, "s": round(cpu_s, 2), "mb": round(mb), "problems": problems}

    def _write(self, name: str, data: bytes) -> str:
        path = self._work / name
        path.write_bytes(data)
        return str(path)

    def _file(self, rng: random.Random) -> tuple[str, list[str]]:
        name = rng.choice(list(self._samples))
        path = self._write(f"mutated{Path(name).suffix}", mutated(self._samples[name], rng))
        more = rng.choice(([], [], ["--no-skip", "no_screen"], ["--json", "-"], ["--screen", "paper-17k3"]))
        return name, ["decode", path, *more]

    def _screen(self, rng: random.Random) -> list[str]:
        path = self._write("screen.toml", _mutated_text(self._texts["screen"], rng))
        return rng.choice((["profiles", "validate", path], ["decode", self._good(), "--screen", path]))

    def _camera(self, rng: random.Random) -> list[str]:
        path = self._write("camera.toml", _mutated_text(self._texts["camera"], rng))
        return rng.choice((["profiles", "validate", path], ["decode", self._good(), "--camera", path]))

    def _truth(self, rng: random.Random) -> list[str]:
        path = self._write("truth.json", _mutated_text(self._texts["truth"], rng))
        return ["decode", self._good(), "--truth", path, "--max-ber", "0.1"]

    def _option(self, rng: random.Random) -> list[str]:
        option = rng.choice(_OPTIONS)
        values = [rng.choice(_NUMBERS) for _ in range(4 if option == "--corners" else 1)]
        if option == "--corners" and rng.random() < 0.7:
            values = [f"{rng.uniform(-900, 900):.1f},{rng.uniform(-900, 900):.1f}" for _ in range(4)]
        return ["decode", self._good(), option, *values, "--truth", "auto"]

    def _journal(self, rng: random.Random) -> list[str]:
        picture = self._good()
        if self._whole is None:
            out = self._work / "whole.jsonl"
            _call(self._program, ["decode", picture, "--json", str(out), "--force"])
            self._whole = out.read_bytes()
        path = self._write("journal.jsonl", _mutated_text(self._whole, rng))
        return ["decode", picture, "--json", path, "--resume"]

    def _good(self) -> str:
        path = self._work / "good.png"
        if not path.exists():
            path.write_bytes(self._samples["a.png"])
        return str(path)


def _mutated_text(data: bytes, rng: random.Random) -> bytes:
    """Text with numbers or words replaced, or bytes mutated."""
    if rng.random() < 0.4:
        return mutated(data, rng)
    words = re.findall(rb"[-0-9.e+]+|[A-Za-z_]+|[^\w]", data)
    for _ in range(rng.choice((1, 2, 5))):
        value = rng.choice((*_NUMBERS, "true", "null", "[]", "{}", '"x"', "[" * 50_000, "1e308", "-5", "4294967296"))
        words[rng.randrange(len(words))] = value.encode()
    return b"".join(words)


def _call(program: Program, arguments: list[str]) -> tuple[int, str]:
    """Exit code, and all that is said."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = program(arguments)
    return int(code), f"{out.getvalue()}\n{err.getvalue()}"


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def run(n: int, seed: int, folder: Path, seconds: float | None = None) -> Verdict:
    """Run `n` cases with seeds from `seed` on, in one process after the other.

    Args:
        n: cases.
        seed: of the first; that of every case is one more.
        folder: of samples and scratch files.
        seconds: begin no case after so long; None: run all.
    """
    verdict, following, end = Verdict(), seed, time.monotonic() + (seconds or 1e9)
    while following < seed + n and time.monotonic() < end:
        following = _run_process(verdict, following, seed + n, folder, end)
    return verdict


def _run_process(verdict: Verdict, first: int, stop: int, folder: Path, end: float) -> int:
    """Run cases in a process until it ends or must be ended; returns the seed to go on with."""
    root = str(Path(__file__).resolve().parents[3])
    path = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    command = [sys.executable, "-c", _START, str(folder), str(first), str(stop)]
    environment = {**os.environ, "PYTHONPATH": path, **threads}
    with tempfile.TemporaryFile() as complaints:
        process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=complaints)
        following, problem = first, None
        try:
            for line in _lines(process):
                if line is None:
                    problem = f"no answer within {_PATIENCE * MOST_S:.0f} s"
                    break
                verdict.add(json.loads(line))
                following += 1
                if time.monotonic() > end:
                    return following
        finally:
            process.kill()
            code = process.wait()
            assert process.stdout is not None
            process.stdout.close()
        complaints.seek(0)
        said = complaints.read().decode(errors="replace").strip()
    if said:
        verdict.problems.setdefault(f"written past stderr: {said.splitlines()[-1]:.200}", []).append(following - 1)
    if following < stop and (problem or code != _ENOUGH):
        verdict.problems.setdefault(problem or f"the process ended with {code}", []).append(following)
        return following + 1
    return following


def _lines(process: subprocess.Popen[bytes]) -> Iterator[bytes | None]:
    """What the process prints, line by line; None where nothing came for too long."""
    assert process.stdout is not None
    lines: Queue[bytes] = Queue()
    stdout = process.stdout
    reader = Thread(target=_pass_on, args=(stdout, lines), daemon=True)
    reader.start()
    while True:
        try:
            line = lines.get(timeout=_PATIENCE * MOST_S)
        except Empty:
            yield None
            return
        if not line:
            process.wait()
            return
        yield line


def _pass_on(stdout: Any, lines: Queue[bytes]) -> None:
    with contextlib.suppress(ValueError):
        for line in iter(stdout.readline, b""):
            lines.put(line)
    lines.put(b"")


def rows(verdict: Verdict) -> list[dict[str, Any]]:
    """The verdict as a table."""
    table = [{"check": name, "result": f"{n} cases", "seeds": ""} for name, n in sorted(verdict.kinds.items())]
    for problem, seeds in verdict.problems.items():
        shown = " ".join(map(str, seeds[:5]))
        table.append({"check": f"{len(seeds)} cases", "result": problem, "seeds": shown})
    return table


def serve(program: Program) -> None:
    """Run the cases that the process is called with, a line of JSON each; ends early where the process has grown."""
    folder, first, stop = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESSES_MB << 20, _ADDRESSES_MB << 20))
    logging.raiseExceptions = False
    cases, out = Cases(folder, program), os.fdopen(os.dup(1), "w")
    for seed in range(first, stop):
        record = cases.run(seed)
        out.write(json.dumps(record) + "\n")
        out.flush()
        if record["mb"] > MOST_MB:
            sys.exit(_ENOUGH)
