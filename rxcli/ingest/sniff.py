"""Identify the kind of a file from its first bytes, or from its suffix if they are ambiguous."""

import os
import re
import stat
from contextlib import suppress
from pathlib import Path
from typing import Literal

from rxcli.errors import InputError, failure_explained, reason_of

Kind = Literal["jpeg", "png", "tiff", "heif", "jxl", "other_image", "raw", "video", "device"]


def _suffixes(names: str) -> frozenset[str]:
    return frozenset(f".{name}" for name in names.split())


IMAGE_SUFFIXES = _suffixes("jpg jpeg jpe jfif mpo png tif tiff heic heif hif avif jxl bmp webp")
RAW_SUFFIXES = _suffixes(
    "raf dng arw sr2 srf nef nrw cr2 cr3 crw orf rw2 raw pef srw x3f 3fr fff iiq erf mef mos mrw kdc dcr rwl gpr"
)
#: Of JPEGs in a row: each begins like a photograph.
MJPEG_SUFFIXES = _suffixes("mjpeg mjpg")
VIDEO_SUFFIXES = MJPEG_SUFFIXES | _suffixes(
    "mp4 mov m4v mkv avi webm mts m2ts ts mpg mpeg m2v vob 3gp 3g2 flv asf wmv h264 264 avc h265 265 hevc"
)
#: Suffixes, lower case with their dot, of the files that are looked at in folders.
KNOWN_SUFFIXES = IMAGE_SUFFIXES | RAW_SUFFIXES | VIDEO_SUFFIXES

#: Bytes that `sniff` needs: enough for the file type box of ISO media, and the head of a part of HTTP.
HEAD_BYTES = 256
#: No camera makes larger pictures; what claims to be larger is damaged or a decompression bomb.
MAX_PIXELS = 400_000_000
#: What a reader may hold at a time: the file's bytes, its samples, and the luma made of them.
MAX_BYTES = 1_250_000_000

#: Starts of playlists (HLS, FFmpeg's concat, DASH), whatever their names.
_LIST_MAGIC = (b"#EXTM3U", b"ffconcat", b"<MPD")
_HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"mif1", b"mif2", b"miaf", b"hevc", b"hevx", b"msf1")
#: Signatures: offset, bytes and kind; the first match decides.
_MAGIC: tuple[tuple[int, tuple[bytes, ...], Kind], ...] = (
    (0, (b"\xff\xd8",), "jpeg"),
    (0, (b"\xff\n", b"\0\0\0\x0cJXL \r\n\x87\n"), "jxl"),
    (0, (b"\x89PNG\r\n\x1a\n",), "png"),
    (0, (b"FUJIFILMCCD-RAW", b"IIRO", b"IIRS", b"MMOR", b"IIU\0", b"FOVb", b"\0MRM"), "raw"),
    (0, (b"II\x1a\0\0\0HEAPCCDR",), "raw"),
    (8, (b"CR",), "raw"),
    (0, (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), "tiff"),
    (0, (b"BM",), "other_image"),
    (8, (b"WEBP",), "other_image"),
    (4, (b"ftypcrx ",), "raw"),
    (4, (b"ftypavif",), "other_image"),
    (4, tuple(b"ftyp" + brand for brand in _HEIF_BRANDS), "heif"),
    (4, (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"moof", b"pnot"), "video"),
    (0, (b"\x1a\x45\xdf\xa3",), "video"),  # Matroska
    (8, (b"AVI",), "video"),
    (0, (b"FLV\1",), "video"),
    (0, (b"\0\0\0\1", b"\0\0\1\xb3", b"\0\0\1\xba"), "video"),  # H.264, HEVC, MPEG without a container
)
#: An extension as programs give it to a kind of files.
_EXTENSION = re.compile(r"\.[a-z][a-z0-9]*\Z", re.IGNORECASE)
#: Starts of pictures that are long enough to be no chance behind other bytes.
_PICTURE = re.compile(rb"\xff\xd8\xff|\x89PNG\r\n\x1a\n")


def check_file(path: Path) -> Kind | None:
    """Refuse what can be no input at all; "device" for a character device, else None.

    Raises:
        InputError: nothing is there, or a folder, a pipe, an empty file.
    """
    try:
        info = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        if path.parts and path.parts[0].lower() in ("http:", "https:", "ftp:", "rtsp:"):
            reason = f"{str(path).replace(':/', '://', 1)}: is an address, and nothing is fetched from the network"
            raise InputError(reason, "download it first, and name the file") from None
        if path.is_symlink():
            reason = f"{path}: is a link to {os.readlink(path)}, which is not there"
            raise InputError(reason, "name the file itself, or mend the link") from None
        raise InputError(f"{path}: no such file", "check the name") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be looked at ({reason_of(error)})", "check name and permissions") from None
    if stat.S_ISCHR(info.st_mode):
        return "device"
    if stat.S_ISDIR(info.st_mode):
        raise InputError(f"{path}: is a folder, not a file", "name the files in it, or let `vlc-rx decode` walk it")
    if not stat.S_ISREG(info.st_mode):
        raise InputError(f"{path}: is not a regular file", "copy the data to a file first")
    if info.st_size == 0:
        raise InputError(f"{path}: the file is empty (0 bytes)", "copy it from the camera again")
    return None


def read_bytes(path: Path, size: int = -1) -> bytes:
    """The first `size` bytes of a file, all of it by default.

    Raises:
        InputError: the system refuses.
    """
    with failure_explained(f"{path}: cannot be read", "check permissions and disk"), path.open("rb") as file:
        if size < 0 and os.fstat(file.fileno()).st_size > MAX_BYTES:
            raise InputError(f"{path}: the file has more than {MAX_BYTES / 1e9:g} GB", "save the picture smaller")
        return file.read(size)


def sniff(head: bytes, suffix: str) -> Kind | None:
    """The kind of a file that starts with `head`; None if neither bytes nor `suffix` identify it."""
    if suffix in MJPEG_SUFFIXES or (head.lstrip().startswith(b"--") and b"image/jpeg" in head.lower()):
        return "video"
    by_name: Kind | None = "raw" if suffix in RAW_SUFFIXES else "video" if suffix in VIDEO_SUFFIXES else None
    kind = next((kind for at, starts, kind in _MAGIC if head.startswith(starts, at)), by_name)
    if kind is None and (stray := start_of_picture(head)):
        return sniff(head[stray:], suffix)
    # A brand of any picture goes with the brand of its codec.
    return "other_image" if kind == "heif" and b"avif" in head[: int.from_bytes(head[:4])] else kind


def is_unnamed_picture(path: str) -> bool:
    """Whether a file is a picture or clip, though its name states no kind: `IMG_0001`, `photo.jpg.1`, `photo.jpg_1`.

    A name that ends in a dot and letters states one. No text has a zero among its first bytes.
    """
    if _EXTENSION.search(path) or not os.path.isfile(path):
        return False
    with suppress(OSError), open(path, "rb") as file:
        head = file.read(HEAD_BYTES)
        return b"\0" in head and sniff(head, "") is not None
    return False


def start_of_picture(head: bytes) -> int:
    """Bytes before a JPEG or PNG that do not belong to it, such as the mark that text programs put before a file."""
    found = _PICTURE.search(head[:HEAD_BYTES])
    return found.start() if found else 0


def check_no_list(path: Path, head: bytes) -> None:
    """Refuse a playlist: what it names may be anybody's file, or in the network.

    Raises:
        InputError: `head`, the first bytes of a file, are those of a list.
    """
    if head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(_LIST_MAGIC):
        raise InputError(f"{path}: is a list of other files, which are not opened", "name the clips themselves")


def check_size(source: object, width: int, height: int, bytes_a_pixel: float = 1, further_bytes: int = 0) -> None:
    """Refuse a picture that no camera can have made, or that would fill the memory.

    Args:
        source: names the picture in messages.
        width: pixels.
        height: pixels.
        bytes_a_pixel: that the reader holds at a time.
        further_bytes: that it holds besides, the file's for instance.

    Raises:
        InputError: no pixels, more than `MAX_PIXELS`, or more than `MAX_BYTES`.
    """
    if width < 1 or height < 1:
        raise InputError(f"{source}: the picture is {width} x {height} pixels", "the file is damaged; copy it again")
    if width * height > MAX_PIXELS:
        reason = f"{source}: claims {width} x {height} pixels, more than {MAX_PIXELS // 1_000_000} million"
        raise InputError(reason, "the file is damaged or no photo")
    needed = width * height * bytes_a_pixel + further_bytes
    if needed > MAX_BYTES:
        reason = f"{source}: {width} x {height} pixels would take {needed / 1e9:.1f} GB, more than {MAX_BYTES / 1e9:g}"
        raise InputError(reason, "save it with fewer bits a sample or in grey, if it is no bomb")
