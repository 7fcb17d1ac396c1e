"""Mutated files of every kind through the whole program: an answer within limits, and never an internal error.

    python tests/mutated_files.py --seconds 60 --seed 1

Every case is one call of `vlc-rx decode` (or `profiles validate`) on a valid file with something done to it: bytes
changed, cut, repeated, moved; or on a mutated truth, profile, journal or option. Many cases run in one process, which
reports a line each; a case that takes too long, or too much memory, ends the process and is named by its seed. The same
seed makes the same case.
"""

import argparse
import contextlib
import io
import json
import logging
import multiprocessing
import os
import random
import re
import resource
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from ingest_files import BAYER, write_dng, write_palette_clip, write_sizes
from numpy.typing import NDArray
from odd_stills import odd_jpegs, odd_pngs, odd_tiffs, orientations, uncommon_jpegs
from small_frames import write_frame, write_profiles

from rxcli.resources import data_dir
from rxcli.runs.processes import ONE_THREAD, environment, peak_memory_mb

#: What one process may take: resident memory, and time for one case on a machine of its own.
MAX_MB, MAX_S = 1500, 60.0
#: Address space of the process, which libraries reserve more of than they use; and waiting on a loaded machine.
_ADDRESSES_MB, _PATIENCE = 6000, 3
#: Marks what was written to the file of stderr by others than Python.
_PAST = "written past stderr:"
#: Bytes that decide much: ends of ranges, and what formats count with.
_TELLING = (b"\0", b"\xff", b"\x7f", b"\x80", b"\xff\xff\xff\xff", b"\x7f\xff\xff\xff", b"\0\0\0\0", b"\x01\0\0\0")
_NUMBERS = ("nan", "inf", "-inf", "-1", "0", "1e999", "1e-999", "9" * 5000, "x", "", "1,2", "0x10", "٣")
_PLAUSIBLE = ("0", "1", "2", "7", "19", "64", "1000", "0.5", "1.5", "-1", "1e-6", "1e6", "1e300", "4294967296", "0.0")
_WORDS = ("true", "null", "[]", "{}", '"x"', "[" * 50_000, "1e308", "-5", "4294967296")
_OPTIONS = (
    *("--min-confidence", "--max-ber", "--min-packets", "--workers", "--cae", "--corners", "--no-skip", "--camera"),
    *("--screen", "--truth", "--baseline", "--slower", "--min-packet-confidence", "--cluster"),
)
#: What is mutated, and how often of a hundred.
_KINDS = {"file": 60, "screen": 7, "camera": 7, "truth": 6, "journal": 6, "option": 6}
_KINDS |= {"config": 3, "gyroflow": 3, "baseline": 2}
_BLIND_PX = 256
_LENS = """
[lens]
width = 340
height = 620
camera_matrix = [[500.0, 0.0, 170.0], [0.0, 500.0, 310.0], [0.0, 0.0, 1.0]]
dist_coeffs = [0.0, 0.0, 0.0, 0.0, 0.0]
"""
_GYROFLOW = {
    "calib_dimension": {"w": 3840, "h": 2160},
    "frame_readout_time": 14.5,
    "fps": 30.0,
    "fisheye_params": {
        "camera_matrix": [[2600.0, 0, 1910.0], [0, 2610.0, 1085.0], [0, 0, 1]],
        "distortion_coeffs": [0.3, 0.1, -0.2, 0.1],
    },
}

#: Stands for the mutated file in a command.
_PATH = "PATH"

Mutate = Callable[[bytes, random.Random], bytes]


def _change_bytes(data: bytes, rng: random.Random, most: int = 64) -> bytes:
    changed = bytearray(data)
    # Headers decide most, and are small: half of the changes go there.
    for _ in range(rng.choice([n for n in (1, 2, 4, 16, 64) if n <= most])):
        stop = len(changed) if rng.random() < 0.5 else min(len(changed), 512)
        changed[rng.randrange(stop)] = rng.randrange(256)
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


MUTATIONS: tuple[Mutate, ...] = (_change_bytes, _change_bytes, _put_telling, _put_telling, _cut, _repeat, _drop, _swap)


def mutated(data: bytes, rng: random.Random) -> bytes:
    """`data` with one to three things done to it; often with little, which gets beyond the first checks."""
    if rng.random() < 0.35:
        return _change_bytes(data, rng, most=3)
    for _ in range(rng.choice((1, 1, 2, 3))):
        data = rng.choice(MUTATIONS)(data, rng) or b"\0"
    return data


class _Kind(NamedTuple):
    """A picture, RGB, that is written in every format; how often it is taken, and options that go with it."""

    picture: NDArray[np.uint8]
    weight: int
    options: tuple[str, ...] = ()


def _pictures(folder: Path) -> dict[str, _Kind]:
    """The pictures: what is refused at a glance costs little, and what is decoded goes through the whole receiver.

    Args:
        folder: where two small pictures of a screen and its profiles are written.
    """
    import cv2

    source = cv2.imread(str(data_dir("sample_frames") / "phone_chelsea_17k3.jpg"))
    assert source is not None
    names = write_profiles(folder)
    (folder / "camera.toml").write_text((folder / "camera.toml").read_text() + _LENS)
    for number in (1, 2):
        write_frame(folder / f"good{number}.png", number)
    known = cv2.imread(str(folder / "good1.png"))
    assert known is not None
    kinds = {"known": _Kind(known, 3, tuple(names))}
    for name, width, weight in (("blind", _BLIND_PX, 1), ("small", 144, 2), ("thumb", 64, 2)):
        picture = cv2.resize(source, (width, width * 3 // 4), interpolation=cv2.INTER_AREA)[..., ::-1]
        kinds[name] = _Kind(np.ascontiguousarray(picture, np.uint8), weight)
    return kinds


def make_samples(folder: Path, picture: NDArray[np.uint8]) -> dict[str, bytes]:
    """A small valid file of every format that shows `picture`, by name."""
    folder.mkdir(parents=True, exist_ok=True)
    _write_stills(folder, picture)
    _write_clips(folder, picture)
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.is_file()}


def _write_stills(folder: Path, picture: NDArray[np.uint8]) -> None:
    import cv2
    import imagecodecs
    import tifffile
    from PIL import Image

    image, exif = Image.fromarray(picture), Image.Exif()
    exif[0x010F], exif[0x0110], exif.get_ifd(0x8769)[0x829A] = "Example", "Camera", 1e-5
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
    write_dng(folder / "a.dng", picture[..., 1].astype(np.uint16) * 16, BAYER)
    luma = np.ascontiguousarray(picture[..., 1])
    (folder / "a.jxl").write_bytes(imagecodecs.jpegxl_encode(picture))
    image.save(folder / "a.avif", exif=exif)
    for name, data in orientations(picture).items():
        (folder / name).write_bytes(data)
    jpegs = odd_jpegs(picture) | uncommon_jpegs(luma)
    for suffix, files in (("jpg", jpegs), ("png", odd_pngs(picture)), ("tif", odd_tiffs(picture))):
        for name, data in files.items():
            (folder / f"{name}.{suffix}").write_bytes(data[0] if isinstance(data, tuple) else data)


def _write_clips(folder: Path, picture: NDArray[np.uint8]) -> None:
    import av
    import cv2

    height, width = picture.shape[:2]
    if width == _BLIND_PX:  # every frame of it is looked at for long
        width, height = 160, 120
    frame_rgb = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    for name, codec in (("a.mp4", "libx264"), ("a.avi", "mjpeg"), ("a.mkv", "mjpeg"), ("a.ts", "libx264")):
        with av.open(str(folder / name), "w") as container:
            stream = container.add_stream(codec, rate=30)
            stream.width, stream.height = width, height
            stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
            for _ in range(4):
                frame = av.VideoFrame.from_ndarray(frame_rgb, "rgb24").reformat(format=stream.pix_fmt)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    write_palette_clip(folder / "palette.avi", [frame_rgb[..., 1]] * 3)
    for name, codec in (("sizes.avi", "mjpeg"), ("sizes.webm", "libvpx-vp9")):
        write_sizes(folder / name, codec, [(width, height), (width // 2, height // 2), (width, height)], frame_rgb)


class Cases:
    """Makes and runs cases in this process, each in a folder of its own.

    Args:
        folder: of samples and scratch files.
    """

    def __init__(self, folder: Path) -> None:
        #: Scratch files of this process.
        self.folder = folder / f"work-{os.getpid()}"
        self._home = self.folder / "home"
        self._home.mkdir(parents=True, exist_ok=True)
        self.pictures = _pictures(self.folder)
        self.samples = {
            f"{kind}/{name}": data
            for kind, of in self.pictures.items()
            for name, data in make_samples(folder / "samples" / kind, of.picture).items()
        }
        self._known = list(self.pictures["known"].options)
        self._texts = {
            "screen": (self.folder / "screen.toml").read_bytes(),
            "camera": (self.folder / "camera.toml").read_bytes(),
            "shipped": (data_dir("calibration") / "screens" / "paper-17k3.toml").read_bytes(),
            "truth": (self.folder / "good1.truth.json").read_bytes(),
            "config": b'screen = ["paper-17k3"]\ncamera = "phone12"\nworkers = 1\n',
            "gyroflow": json.dumps(_GYROFLOW).encode(),
        }
        self._whole: bytes | None = None

    def run(self, seed: int) -> dict[str, Any]:
        """Run one case; what came of it."""
        rng = random.Random(seed)
        kind = rng.choices(list(_KINDS), list(_KINDS.values()))[0]
        # Nobody's own profiles and settings.
        with environment({"VLC_RX_HOME": str(self._home)}):
            (self._home / "config.toml").unlink(missing_ok=True)
            name, arguments = self._file(rng) if kind == "file" else (kind, self.arguments(kind, rng))
            return self._outcome(seed, name, arguments)

    def _outcome(self, seed: int, name: str, arguments: list[str]) -> dict[str, Any]:
        began, cpu = time.monotonic(), time.process_time()
        code, text = _call(arguments)
        signs = ("internal error", "Traceback", _PAST)
        problems = [f"{name}: {line}" for line in text.splitlines() if any(sign in line for sign in signs)]
        cpu_s, mb = time.process_time() - cpu, peak_memory_mb()
        if code not in (0, 1, 2, 3):
            problems.append(f"{name}: exit code {code}")
        if mb > MAX_MB:
            problems.append(f"{name}: {mb:.0f} MB")
        if min(cpu_s, time.monotonic() - began) > MAX_S:
            problems.append(f"{name}: {cpu_s:.0f} s")
        problems = [problem[:300].replace(str(self.folder), "") for problem in problems]
        kind = name.rpartition("/")[2]
        return {"seed": seed, "kind": kind, "code": code, "s": round(cpu_s, 2), "mb": round(mb), "problems": problems}

    def _write(self, name: str, data: bytes) -> str:
        path = self.folder / name
        path.write_bytes(data)
        return str(path)

    def _good(self, number: int = 1) -> str:
        return str(self.folder / f"good{number}.png")

    def _file(self, rng: random.Random) -> tuple[str, list[str]]:
        weights = {kind: of.weight for kind, of in self.pictures.items()}
        kind = rng.choices(list(weights), list(weights.values()))[0]
        name = rng.choice([name for name in self.samples if name.startswith(f"{kind}/")])
        data = mutated(self.samples[name], rng)
        if name.endswith(".png") and rng.random() < 0.7:
            data = with_checksums(data)
        path = self._write(f"mutated{Path(name).suffix}", data)
        taps = ["--dump-dir", str(self.folder / "taps"), "--save-undistorted", str(self.folder / "taps")]
        more = rng.choice(([], [], ["--no-skip", "no_screen"], ["--json", "-"], ["--screen", "paper-17k3"], taps))
        return name, ["decode", path, *self.pictures[kind].options, *more]

    def arguments(self, kind: str, rng: random.Random) -> list[str]:
        """The command of a case of a kind that is no picture."""
        if kind == "option":
            return self._option(rng)
        good, known = self._good(), self._known
        decode, both = ["decode", good, *known], ["decode", good, self._good(2), *known]
        resume = [*both, "--resume", "--json", _PATH]
        summary = ["--summary", str(self.folder / "summary.csv"), "--junit", str(self.folder / "junit.xml")]
        validate, of_camera = (
            ["profiles", "validate", _PATH],
            ["decode", good, *known[:2], *known[4:], "--camera", _PATH],
        )
        commands = {
            "screen": [validate, *[[*decode, "--screen", _PATH]] * 2],
            "camera": [validate, of_camera, of_camera],
            "truth": [[*decode, "--truth", _PATH, "--max-ber", "0.1"]],
            "config": [["profiles", "list"], decode],
            "gyroflow": [["calibrate", "gyroflow", _PATH, "--json", "-"]],
            "journal": [resume, [*resume, *summary]],
            "baseline": [[*both, "--baseline", _PATH]],
        }[kind]
        text = self._results() if kind in ("journal", "baseline") else self._texts[kind]
        if kind == "screen" and rng.random() < 0.5:
            text = self._texts["shipped"]
        path = self._write({"config": "home/config.toml"}.get(kind, f"mutated.{kind}"), _mutated_text(text, rng))
        return [path if part == _PATH else part for part in rng.choice(commands)]

    def _option(self, rng: random.Random) -> list[str]:
        arguments = ["decode", self._good(), *self._known, "--truth", "auto"]
        for option in rng.sample(_OPTIONS, rng.choice((1, 1, 2))):
            values = [rng.choice(_NUMBERS) for _ in range(4 if option == "--corners" else 1)]
            if option == "--corners" and rng.random() < 0.7:
                values = [f"{rng.uniform(-900, 900):.1f},{rng.uniform(-900, 900):.1f}" for _ in range(4)]
            arguments += [option, *values]
        return arguments

    def _results(self) -> bytes:
        """What a run over both pictures writes."""
        if self._whole is None:
            out = self.folder / "whole.jsonl"
            _call(["decode", self._good(), self._good(2), *self._known, "--json", str(out), "--force"])
            self._whole = out.read_bytes()
        return self._whole


#: What a process that runs cases has made ready.
_cases: Cases | None = None


def with_checksums(data: bytes) -> bytes:
    """A damaged PNG whose chunks have the checksums of what they hold: damage that goes beyond the first check."""
    out, place = bytearray(data), 8
    while place + 12 <= len(out):
        end = place + 8 + int.from_bytes(out[place : place + 4], "big")
        if end + 4 > len(out):
            break
        out[end : end + 4] = zlib.crc32(out[place + 4 : end]).to_bytes(4, "big")
        place = end + 4
    return bytes(out)


def _mutated_text(data: bytes, rng: random.Random) -> bytes:
    """Text with numbers or words replaced, or bytes mutated."""
    way = rng.random()
    if way < 0.35:
        return mutated(data, rng)
    words = re.findall(rb"[-0-9.e+]+|[A-Za-z_]+|[^\w]", data)
    numbers = [place for place, word in enumerate(words) if word[:1].isdigit()]
    for _ in range(1 if way < 0.7 else rng.choice((1, 2, 5))):
        if numbers and (way < 0.7 or rng.random() < 0.5):  # what may pass the first checks
            words[rng.choice(numbers)] = rng.choice(_PLAUSIBLE).encode()
        else:
            words[rng.randrange(len(words))] = rng.choice((*_NUMBERS, *_WORDS)).encode()
    return b"".join(words)


def _call(arguments: list[str]) -> tuple[int, str]:
    """Exit code, and all that is said; what libraries write past Python is marked."""
    from rxcli.cli.main import run as program

    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), tempfile.TemporaryFile() as past:
        kept = os.dup(2)
        os.dup2(past.fileno(), 2)
        try:
            code = program(arguments)
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        past.seek(0)
        lines = past.read().decode(errors="replace").strip().splitlines()
    return int(code), "\n".join([out.getvalue(), err.getvalue(), *(f"{_PAST} {line}" for line in lines[-1:])])


def run(n: int, seed: int, folder: Path, seconds: float | None = None) -> list[dict[str, Any]]:
    """Run `n` cases with seeds from `seed` on, in one process after the other; what came of each.

    Args:
        n: cases.
        seed: of the first; that of every case is one more.
        folder: of samples and scratch files.
        seconds: begin no case after so long; None: run all.
    """
    records: list[dict[str, Any]] = []
    pool, end = None, time.monotonic() + (seconds or 1e9)
    for number in range(seed, seed + n):
        if time.monotonic() > end:
            break
        if pool is None:
            with environment(ONE_THREAD):
                pool = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _begin, (folder,))
                pool.submit(os.getpid).result()
        try:
            record = pool.submit(_run_case, number).result(_PATIENCE * MAX_S)
        except (TimeoutError, BrokenProcessPool) as error:
            reason = "the process ended" if isinstance(error, BrokenProcessPool) else "no answer for too long"
            record = {"seed": number, "code": reason, "s": 0.0, "mb": np.inf, "problems": [reason]}
            for process in multiprocessing.active_children():
                process.kill()
        records.append(record)
        if record["mb"] > MAX_MB:
            pool.shutdown()
            pool = None
    if pool is not None:
        pool.shutdown()
    return records


def problems_of(records: list[dict[str, Any]]) -> dict[str, list[int]]:
    """What went wrong, with the seeds of the cases."""
    found: dict[str, list[int]] = {}
    for record in records:
        for problem in record["problems"]:
            found.setdefault(problem, []).append(record["seed"])
    return found


def _begin(folder: Path) -> None:
    """Make a process ready for cases."""
    global _cases
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESSES_MB << 20, _ADDRESSES_MB << 20))
    logging.raiseExceptions = False
    os.dup2(2, 1)
    _cases = Cases(folder)


def _run_case(seed: int) -> dict[str, Any]:
    return _cases.run(seed)


def main(arguments: list[str]) -> int:
    """Run cases for some time; 1 where something was found, which is printed with its seeds."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args(arguments)
    first = 1_000_000 * given.seed
    with tempfile.TemporaryDirectory() as folder:
        records = run(given.count, first, Path(folder), given.seconds)
    problems, slowest = problems_of(records), max(records, key=lambda record: record["s"])
    for problem, seeds in problems.items():
        print(f"{len(seeds)} cases, such as {seeds[:5]}: {problem}")
    codes, max_mb = Counter(str(record["code"]) for record in records), max(record["mb"] for record in records)
    print(
        f"{len(records)} cases with seeds from {first} on; exit codes {dict(sorted(codes.items()))}; slowest "
        f"{slowest['s']:.1f} s (seed {slowest['seed']}); at most {max_mb:.0f} MB"
    )
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
