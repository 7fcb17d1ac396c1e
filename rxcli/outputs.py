"""Output files of a run: checked together before any is opened, and written atomically.

`claim` refuses outputs that would destroy an input, a profile, another output, a folder, or a foreign file. `replacing`
and `write_whole` write to a file in a hidden folder and rename it when it is complete, so that a kill or a full disk
leaves the old file. Journals, which grow line by line, are the exception (`rxcli.runs.journal`).
"""

from __future__ import annotations

import errno
import os
import re
import stat
import zlib
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile
from typing import TYPE_CHECKING

from rxcli.errors import OutputError, UsageError, failure_explained, reason_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

#: Errors of the disk; a different name avoids the others.
_DISK_FAILS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EIO})
#: Marker file of folders that a command has written and that contain nothing to decode.
OUTPUT_MARKER = ".vlc-rx-output"
#: Bytes at a file's start and end by which its origin is recognised.
_SAMPLED_BYTES = 1 << 16
#: Signature and IHDR of a PNG (ISO 15948, section 5).
_PNG_HEADER_BYTES = 33

# Patterns of the content of own files.
#: No pattern: every existing file is foreign.
NEVER = re.compile(rb"(?!)")
ANYTHING = re.compile(rb"")
JOURNAL = re.compile(rb'\A\{"source": "[^\n]*?", "frame": \d+, "time_s": ')
PAYLOADS = re.compile(rb"\Asource,frame,column,burst,")
SUMMARY = re.compile(rb"\Asource,exit_code,frames,|\APAR1.*frames_failed", re.DOTALL)
JUNIT = re.compile(rb'<testsuite name="vlc-rx ')
#: A profile that may be extended, and one that was estimated.
CAMERA = re.compile(rb'^kind = "camera"', re.MULTILINE)
ESTIMATED_CAMERA = re.compile(rb'^description = "[^"\n]*estimated', re.MULTILINE)
# Of `vlc-rx simulate`: truth, camera, transmitter.
TRUTH = re.compile(rb'"written_by": "vlc-rx (simulate|encode)"')
SIMULATED_CAMERA = re.compile(rb'^description = "written by vlc-rx simulate"', re.MULTILINE)
#: Labels or slots of `vlc-rx encode`, and the line that states their order.
ENCODED = re.compile(rb"\A\x93NUMPY|\Aburst,symbol,column_0|one row a slot at")
WAVEFORMS = re.compile(rb"\Acolumn_0|one row a slot at")
#: Arrays of the stages (`rxcli.results.dump`).
TAPS = re.compile(
    rb"\APK\x03\x04.{26}(geometry|sampling|clock|samples|channel|detect|bursts)[a-z0-9._]*\.npy", re.DOTALL
)
#: Written by `encode_png`.
PICTURE = re.compile(rb"\A\x89PNG.{29}....tEXtSoftware\0vlc-rx", re.DOTALL)


def json_with(*keys: str) -> re.Pattern[bytes]:
    """Pattern of own JSON with these keys in this order."""
    return re.compile(rb'\A[\[{].*"' + rb'":.*"'.join(re.escape(key.encode()) for key in keys) + rb'":', re.DOTALL)


@dataclass(frozen=True, slots=True)
class Output:
    """An output file of a run."""

    #: The option that names it.
    option: str
    path: Path
    #: Pattern of earlier outputs of the same kind, which may be replaced.
    ours: re.Pattern[bytes]
    #: Whether a missing folder is created.
    makes_folder: bool = False
    #: Next step if an earlier output of the same kind must not be replaced; None: it is replaced.
    way_on: str | None = None

    def __str__(self) -> str:
        return f"{self.option} {self.path}"


class Taken:
    """Files that a run reads or writes, by resolved name and by file identity."""

    def __init__(self) -> None:
        self._by: dict[object, str] = {}

    def add(self, path: Path, whose: str) -> None:
        """Reserve a file for the rest of the run; `whose` states its use, as in "is an input"."""
        for key in self._keys(path):
            self._by.setdefault(key, whose)

    def by(self, path: Path) -> str | None:
        """The use of a reserved file, or None."""
        return next((self._by[key] for key in self._keys(path) if key in self._by), None)

    @staticmethod
    def _keys(path: Path) -> list[object]:
        return [key for key in (_identity(path), path.resolve()) if key is not None]


def claim(
    outputs: Iterable[Output | None],
    inputs: Iterable[str | Path] = (),
    profiles: Iterable[str | Path | None] = (),
    force: bool = False,
) -> Taken:
    """Refuse outputs that would destroy something or cannot be written; existing files are not touched.

    Args:
        outputs: all files that the run will write; None where an option was not given.
        inputs: files that the run reads; missing ones are ignored.
        profiles: names and files of profiles that the run reads, likewise.
        force: replace foreign files, but never an input or a profile of this run.

    Returns:
        All files of the run, for outputs whose names are known only when they are written.

    Raises:
        UsageError: two outputs are one file; or an output is an input, a profile, a folder, in no folder, in one that
            cannot be written, or a file that does not look like an earlier output of the same sort.
        OutputError: the disk is full.
    """
    taken = Taken()
    for kind, paths in (("an input", inputs), ("a profile that is read", profiles)):
        for path in (Path(path) for path in paths if path):
            if _identity(path) is not None:
                taken.add(path, kind)
    for output in filter(None, outputs):
        _check_place(output)
        if is_stream(output.path):
            continue
        whose = taken.by(output.path)
        if whose is not None:
            raise UsageError(f"{output}: the same file is {whose}", "name another file")
        taken.add(output.path, f"written by {output.option}")
        if not force:
            _check_ours(output)
        _check_writable(output)
    return taken


def claim_folder(option: str, folder: Path) -> None:
    """Create a folder that a run writes into.

    Raises:
        UsageError: it is a file, or cannot be made or written.
        OutputError: the disk is full.
    """
    with writable(f"{option} {folder}", "name another folder"):
        folder.mkdir(parents=True, exist_ok=True)
        _try_to_write(folder)


def _check_writable(output: Output) -> None:
    """Refuse an output in a read-only folder, or an existing read-only file."""
    with writable(output):
        path = output.path.resolve()
        if path.exists():
            path.open("r+b").close()
        _try_to_write(next(folder for folder in path.parents if folder.exists()))


def _try_to_write(folder: Path) -> None:
    """Create and remove a file in a folder, since permissions do not show read-only file systems."""
    TemporaryFile(prefix=".vlc-rx-", dir=folder).close()


def claim_own_folder(option: str, folder: Path, known: Iterable[str] = (), force: bool = False) -> None:
    """Create a folder for the outputs of one command and mark it, so that runs over folders skip it.

    Args:
        option: the option that names the folder.
        folder: new, empty, or written by the same command before.
        known: patterns of file names in unmarked folders of earlier versions.
        force: write into a foreign folder, which is not marked.

    Raises:
        UsageError: it is a file, cannot be made, or holds other files.
    """
    claim_folder(option, folder)
    mark = folder / OUTPUT_MARKER
    with writable(f"{option} {folder}", "name another folder"):
        if mark.exists() or any(any(folder.glob(name)) for name in known):
            return
        if not any(folder.iterdir()):
            mark.touch()
        elif not force:
            reason = f"{option} {folder}: the folder holds files that this command did not write"
            raise UsageError(reason, "name a new folder, or an empty one")


def _identity(path: Path) -> object | None:
    """Identity of a file independent of its name; None if it does not exist."""
    try:
        info = path.stat()
    except (OSError, ValueError):
        return None
    return (info.st_dev, info.st_ino)


def _check_place(output: Output) -> None:
    """Refuse a folder, and a name in a missing folder."""
    path = output.path
    with failure_explained(f"{output}: cannot be looked at", "name another file", UsageError):
        if path.is_dir():
            raise UsageError(f"{output}: is a folder", "name a file")
        if not output.makes_folder and not path.resolve().parent.is_dir():
            raise UsageError(f"{output}: there is no such folder", "make it, or name another")


def is_stream(path: Path) -> bool:
    """Whether `path` is a device or a pipe, which holds nothing to destroy."""
    try:
        return path.exists() and not path.is_file()
    except (OSError, ValueError):
        return False


def _check_ours(output: Output, step: str = "name another file, or replace it with --force") -> None:
    head = b""
    explained = failure_explained(f"{output}: cannot be looked at", "name another file", UsageError)
    with explained, suppress(FileNotFoundError), output.path.open("rb") as file:
        head = file.read(_SAMPLED_BYTES)
        rest = file.seek(0, os.SEEK_END) - len(head)
        file.seek(-min(rest, _SAMPLED_BYTES), os.SEEK_END)
        head += file.read() if rest else b""
    ours = not head or output.ours.search(head)
    if head and ours and output.way_on is not None:
        raise UsageError(f"{output}: holds the results of an earlier run", output.way_on)
    if not ours:
        raise UsageError(f"{output}: there is such a file, and it is no earlier output of this option", step)


@contextmanager
def replacing(path: Path, follow: bool = True, kept_mode: int = 0o777) -> Iterator[Path]:
    """Yield a path of the same name in a new private folder, whose file replaces `path` if the block succeeds.

    The file keeps permissions of the one that it replaces. If the block fails, `path` is unchanged.

    Args:
        path: the output.
        follow: write to the device, to the pipe, or to the target of the link that `path` is; otherwise replace it.
        kept_mode: permissions that are kept; never a set-uid bit.

    Raises:
        UsageError, OutputError: the file cannot be written; any `OSError` of the block ends so.
    """
    if follow and is_stream(path):
        with writable(path):
            yield path
        return
    target = path.resolve() if follow else path
    with writable(path), TemporaryDirectory(prefix=".vlc-rx-", dir=target.parent) as folder:
        hidden = Path(folder, target.name)
        yield hidden
        with suppress(FileNotFoundError):
            mode = target.lstat().st_mode
            if stat.S_ISREG(mode):
                hidden.chmod(mode & kept_mode)
        hidden.replace(target)


def write_whole(path: Path, content: str | bytes, follow: bool = True, kept_mode: int = 0o777) -> None:
    """Write a file atomically; arguments as of `replacing`.

    Raises:
        OutputError: it cannot be written.
    """
    data = content.encode() if isinstance(content, str) else content
    with replacing(path, follow, kept_mode) as hidden:
        hidden.write_bytes(data)


def tapped(path: Path, ours: re.Pattern[bytes], option: str) -> AbstractContextManager[Path]:
    """`replacing` for a file whose name is known only when it is written; its folder is made where there is none.

    Raises:
        UsageError: `path` exists and does not match `ours`.
        OutputError: it cannot be written.
    """
    with writable(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    if is_stream(path):
        raise UsageError(f"{path}: is no file", "remove it, or name another folder")
    _check_ours(Output(option, path, ours), "name another folder")
    return replacing(path, follow=False)


@contextmanager
def writable(what: object, step: str = "name a file in a folder that can be written") -> Iterator[None]:
    """Raise the system's errors for an output as errors of ours; that of a pipe whose reader has gone as it is.

    Raises:
        UsageError: the output cannot be written.
        OutputError: the disk is to blame.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        kind = OutputError if error.errno in _DISK_FAILS else UsageError
        raise kind(f"{what}: cannot be written ({reason_of(error)})", step) from None


def encode_png(picture: NDArray[np.uint8]) -> bytes:
    """Encode a PNG with the mark `PICTURE`; `picture` is (height, width) grey or (height, width, 3) BGR."""
    import cv2

    data = cv2.imencode(".png", picture)[1].tobytes()
    text = b"tEXtSoftware\0vlc-rx"
    chunk = (len(text) - 4).to_bytes(4, "big") + text + zlib.crc32(text).to_bytes(4, "big")
    return data[:_PNG_HEADER_BYTES] + chunk + data[_PNG_HEADER_BYTES:]
