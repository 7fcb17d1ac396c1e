"""Locations of models, profiles and sample frames: inside an installed wheel, or beside the package in a checkout.

The user's own files are in the system's folder for them (`platformdirs`), or in the folder named by `VLC_RX_HOME`.
"""

import errno
import os
import re
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).resolve().parent


def data_dir(name: str) -> Path:
    """The folder `name` ("calibration", "models", "pages" or "sample_frames") of this installation."""
    installed = _PACKAGE / "_data" / name
    return installed if installed.is_dir() else _PACKAGE.parent / name


def filled_page(name: str, parts: Mapping[str, object]) -> str:
    """A page of this installation with `{{part}}` replaced; what a part holds is left as it is."""
    text = (data_dir("pages") / name).read_text(encoding="utf-8")
    return re.sub(r"\{\{([\w.]+)\}\}", lambda found: str(parts[found[1]]), text)


def read_limited(path: Path, max_bytes: int) -> bytes:
    """Read a regular file of limited length, which excludes pipes.

    Raises:
        OSError: the file cannot be read, is not regular, or is longer than `max_bytes`.
        ValueError: the path is invalid.
    """
    info = path.stat()
    if not stat.S_ISREG(info.st_mode):
        raise OSError(errno.EINVAL, "is no regular file")
    if info.st_size > max_bytes:
        raise OSError(errno.EFBIG, f"has {info.st_size} bytes, more than {max_bytes}")
    return path.read_bytes()


#: Environment variable that replaces the folder of the user's profiles and settings.
HOME_VARIABLE = "VLC_RX_HOME"


def user_dir() -> Path:
    """The folder of the user's own profiles (`cameras/`, `screens/`) and `config.toml`; it need not exist."""
    home = os.environ.get(HOME_VARIABLE)
    if home:
        return Path(home)
    from platformdirs import user_config_path

    path = user_config_path("vlc-rx", appauthor=False)
    # Without a home it would be a folder of the current one, which may be anybody's.
    return path if path.is_absolute() else Path(os.devnull, f"no home, set {HOME_VARIABLE}")


def profile_dirs() -> list[tuple[str, Path]]:
    """Readable folders with `cameras/` and `screens/` and their origin; the first profile of a name wins."""
    places = [("user", user_dir()), ("shipped", data_dir("calibration"))]
    return [(origin, folder) for origin, folder in places if os.path.isdir(folder)]


def onnx_runtime() -> Any:
    """Import `onnxruntime` without telemetry and device id.

    The variable is read once on import (Privacy.md of ONNX Runtime, "Disabling Telemetry").
    """
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime

    return onnxruntime
