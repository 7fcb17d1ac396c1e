"""Where models, profiles and sample frames lie: inside an installed wheel, or beside the package in a checkout.

What a user adds lies in the folder that the system has for it (`platformdirs`), or where `VLC_RX_HOME` says.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).resolve().parent


def data_dir(name: str) -> Path:
    """The folder `name` ("calibration", "models", "pages" or "sample_frames") of this installation."""
    installed = _PACKAGE / "_data" / name
    return installed if installed.is_dir() else _PACKAGE.parent / name


def read_limited(path: Path, max_bytes: int) -> bytes:
    """A whole file that people write; a pipe, which may never end, or a file that is absurdly long is none.

    Raises:
        OSError: it cannot be read, is no regular file, or longer than `max_bytes`.
        ValueError: the path is none.
    """
    info = path.stat()
    if not stat.S_ISREG(info.st_mode):
        raise OSError(errno.EINVAL, "is no regular file")
    if info.st_size > max_bytes:
        raise OSError(errno.EFBIG, f"has {info.st_size} bytes, more than {max_bytes}")
    return path.read_bytes()


#: Names another folder for the user's profiles and settings.
HOME_VARIABLE = "VLC_RX_HOME"


def user_dir() -> Path:
    """The folder of the user's own profiles (`cameras/`, `screens/`) and `config.toml`; it need not exist."""
    told = os.environ.get(HOME_VARIABLE)
    if told:
        return Path(told)
    from platformdirs import user_config_path

    return user_config_path("vlc-rx", appauthor=False)


def profile_dirs() -> list[tuple[str, Path]]:
    """Folders that hold `cameras/` and `screens/`, with what each is called; of two of one name the first wins."""
    return [("user", user_dir()), ("shipped", data_dir("calibration"))]


def onnx_runtime() -> Any:
    """The module `onnxruntime`, imported so that it reports nothing to its maker and writes no device id.

    It reads the variable once, when it is loaded (its Privacy.md, "Disabling Telemetry").
    """
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime

    return onnxruntime
