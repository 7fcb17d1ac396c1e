"""Run a command that finds the fake camera at /dev/video0: `serve.py SCENE.json COMMAND...`.

For the distribution's python3 with umockdev (Debian: umockdev, gir1.2-umockdev-1.0, python3-gi). SCENE.json holds
`width`, `height`, `luma` (a file of frames), `jpegs` (files), and whatever else `FakeCamera` and `Faults` take. When
the command ends, its exit status is passed on and the camera's last state is written beside the scene
(SCENE.state.json).
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import gi

gi.require_version("UMockdev", "1.0")
from gi.repository import GLib, UMockdev  # noqa: E402

sys.path.insert(0, str(Path(__file__).parent))
from device import FakeCamera, Faults  # noqa: E402

NODE = "/dev/video0"
UDEV_RECORD = """P: /devices/platform/fake/video4linux/video0
N: video0=00
E: DEVNAME=/dev/video0
E: SUBSYSTEM=video4linux
E: MAJOR=81
E: MINOR=0
A: dev=81:0\\n
A: name=Fake camera\\n

"""
_ENOTTY = 25


def load_camera(scene: Path, node: Path) -> FakeCamera:
    """The camera that a scene file describes."""
    options = json.loads(scene.read_text())
    options["luma"] = Path(options["luma"]).read_bytes()
    options["jpegs"] = [Path(name).read_bytes() for name in options.get("jpegs", [])]
    options["faults"] = Faults(**options.get("faults", {}))
    if "formats" in options:
        options["formats"] = tuple(options["formats"])
    node.unlink(missing_ok=True)
    return FakeCamera(node=node, **options)


class Handler:
    """Hands the ioctls of clients to the camera."""

    def __init__(self, camera: FakeCamera) -> None:
        self.camera = camera

    def __call__(self, base: object, client: UMockdev.IoctlClient, *_: object) -> bool:
        request = client.get_request() & 0xFFFFFFFF
        size = (request >> 16) & 0x3FFF
        data = client.get_arg().resolve(0, size) if size else None
        if data is None:  # termios and the like, which carry no structure
            client.complete(-1, _ENOTTY)
            return True
        argument = bytearray(data.retrieve())
        result, number = self.camera.ioctl(request, argument)
        data.update(0, bytes(argument[:size]))
        client.complete(result, number)
        return True


def main(scene: Path, command: list[str]) -> int:
    """Serve until `command` ends; its exit status."""
    testbed = UMockdev.Testbed.new()
    testbed.add_from_string(UDEV_RECORD)
    root = testbed.get_root_dir()
    camera = load_camera(scene, Path(root + NODE))
    handler = UMockdev.IoctlBase()
    handler.connect("handle-ioctl", Handler(camera))
    testbed.attach_ioctl(NODE, handler)
    loop = GLib.MainLoop()
    environment = dict(os.environ, LD_PRELOAD="libumockdev-preload.so.0", UMOCKDEV_DIR=root)
    child = subprocess.Popen(command, env=environment)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the command's business
    threading.Thread(target=lambda: (child.wait(), GLib.idle_add(loop.quit)), daemon=True).start()
    loop.run()
    testbed.detach_ioctl(NODE)
    state = {"controls": {hex(key): value for key, value in camera.controls.items()}, "n_frames": camera.n_frames}
    scene.with_suffix(".state.json").write_text(json.dumps(state | {"format": camera.format}))
    return child.wait()


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
