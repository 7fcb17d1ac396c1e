"""Files and cameras -> frames: luma or sensor mosaic as stored, with the metadata of the file.

Readers are imported when a file of their kind comes, because each brings a heavy library.
"""

from collections.abc import Callable, Generator, Iterator
from importlib import import_module
from pathlib import Path

from rxcli.errors import InputError, UsageError
from rxcli.ingest.ahead import read_ahead
from rxcli.ingest.sniff import HEAD_BYTES, KNOWN_SUFFIXES, MAX_BYTES, Kind, check_file, check_no_list, read_bytes, sniff
from rxcli.types import Frame

__all__ = ["KNOWN_SUFFIXES", "MAX_BYTES", "begun", "open_source"]

#: Kind of a file -> module of this room and function of it that reads a path: a frame, or several.
_READERS: dict[Kind, str] = {
    "jpeg": "image.read_jpeg",
    "png": "image.read_png",
    "tiff": "image.read_tiff",
    "other_image": "image.read_other",
    "heif": "heif.read_heif",
    "jxl": "jxl.read_jxl",
    "raw": "raw.read_raw",
    "video": "video.read_video",
    "device": "v4l2.LiveSource",
}
#: Bytes in which JPEGs in a row show: three at least.
_ROW_BYTES = 1 << 26


def open_source(path: str | Path) -> Generator[Frame, None, None]:
    """Yield the frames of a photo, RAW file, clip or V4L2 device; the source is opened with the first frame.

    Args:
        path: any file; its content decides the format, not its suffix.

    Yields:
        One frame of a still, every whole frame of a clip, frames without end of a device.

    Raises:
        InputError: the source cannot be read, or breaks off (after the whole frames before the break).
    """
    if not isinstance(path, (str, Path)) or not str(path):
        raise UsageError(f"a source must be the path of a file or device (got {path!r:.80})", "give a path")
    path = Path(path)
    kind = check_file(path) or _kind(path)
    if kind is None:
        known = "JPEG, PNG, TIFF, HEIC, camera RAW, MP4, MOV, MKV or AVI"
        raise InputError(f"{path}: neither a picture nor a clip", f"{known} can be read")
    module, reader = _READERS[kind].split(".")
    found = getattr(import_module(f"{__name__}.{module}"), reader)(path)
    yield from [found] if isinstance(found, Frame) else found


def begun(path: str) -> Callable[[str], Iterator[Frame]]:
    """`open_source`, which has begun to read one photograph in a thread."""
    opened = {path: read_ahead(open_source(path))}
    return lambda wanted: opened.pop(wanted, None) or open_source(wanted)


def _kind(path: Path) -> Kind | None:
    head = read_bytes(path, HEAD_BYTES)
    check_no_list(path, head)
    kind = sniff(head, path.suffix.lower())
    if kind == "jpeg":
        from rxcli.ingest.jpeg import is_row

        return "video" if is_row(read_bytes(path, _ROW_BYTES)) else kind
    if kind == "tiff":
        from rxcli.ingest.metadata import is_raw_tiff

        return "raw" if is_raw_tiff(path) else "tiff"
    return kind
