"""A fake V4L2 camera (see `fake_v4l2`), and commands that run in front of it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from numpy.typing import NDArray

FAKE = Path(__file__).parent / "fake_v4l2"
SYSTEM_PYTHON = "/usr/bin/python3"
PROBE = "import gi; gi.require_version('UMockdev', '1.0'); from gi.repository import UMockdev"
VLC_RX = (sys.executable, "-c", "from rxcli.cli.main import main; main()")


def _umockdev_is_there() -> bool:
    if shutil.which(SYSTEM_PYTHON) is None:
        return False
    return subprocess.run([SYSTEM_PYTHON, "-c", PROBE], capture_output=True, check=False).returncode == 0


needs_umockdev = pytest.mark.skipif(
    not _umockdev_is_there(), reason="needs Debian's umockdev, gir1.2-umockdev-1.0 and python3-gi"
)


def environment() -> dict[str, str]:
    """Of commands: they run the code of this checkout."""
    return dict(os.environ, PYTHONPATH=str(Path(__file__).resolve().parents[1]))


class Bench:
    """A fake camera's scene, and commands run in front of it.

    Args:
        folder: for its files.
        luma: (n, height, width) pictures that it shows over and over.
        options: of the scene, see `fake_v4l2/serve.py`.
    """

    def __init__(self, folder: Path, luma: NDArray[np.uint8], **options: Any) -> None:
        self.luma, self._scene = luma, folder / "scene.json"
        luma.tofile(folder / "frames.luma")
        height, width = luma.shape[1:]
        self._options = {"width": width, "height": height, "luma": str(folder / "frames.luma"), **options}

    def add_jpegs(self) -> None:
        """Offer MJPG, too."""
        self._options["jpegs"] = jpegs = []
        for number, picture in enumerate(self.luma):
            path = self._scene.with_name(f"{number}.jpg")
            form = {"quality": 100, "colorspace": "GRAY", "colorsubsampling": "Gray"}
            path.write_bytes(simplejpeg.encode_jpeg(picture[:, :, None].copy(), **form))
            jpegs.append(str(path))

    def command(self, *command: str, **scene: Any) -> list[str]:
        """The command line that runs `command` in front of the camera."""
        self._scene.write_text(json.dumps(self._options | scene))
        return [SYSTEM_PYTHON, str(FAKE / "serve.py"), str(self._scene), *command]

    def client(self, settings: dict[str, Any], n_frames: int = 10, pause_s: float = 0.0, **scene: Any) -> Any:
        """What the receiver's reader saw."""
        command = [sys.executable, str(FAKE / "client.py"), json.dumps(settings), str(n_frames), str(pause_s)]
        done = subprocess.run(
            self.command(*command, **scene), capture_output=True, text=True, timeout=60, check=True, env=environment()
        )
        return json.loads(done.stdout)

    def vlc_rx(self, *arguments: str, **scene: Any) -> subprocess.CompletedProcess[str]:
        """Run the command line in front of the camera."""
        command = self.command(*VLC_RX, *arguments, **scene)
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, env=environment())

    def state(self) -> Any:
        """The camera's last state."""
        return json.loads(self._scene.with_suffix(".state.json").read_text())
