"""Receiver for data sent by the mini-LED backlight of a liquid crystal display.

`import rxcli` loads nothing heavy: each name is loaded when it is first used. docs/python.md shows how to use them.
"""

TYPE_CHECKING = False  # as type checkers take it; typing itself would cost milliseconds
if TYPE_CHECKING:
    from typing import Any

    from rxcli.errors import InputError as InputError
    from rxcli.errors import ProfileError as ProfileError
    from rxcli.errors import ReceiverError as ReceiverError
    from rxcli.errors import UsageError as UsageError
    from rxcli.ingest import open_source as open_source
    from rxcli.options import ReceiverOptions as ReceiverOptions
    from rxcli.options import receiver_options as receiver_options
    from rxcli.profiles import CameraProfile as CameraProfile
    from rxcli.profiles import LensModel as LensModel
    from rxcli.profiles import ReadoutMode as ReadoutMode
    from rxcli.profiles import ScreenProfile as ScreenProfile
    from rxcli.profiles import load_profile as load_profile
    from rxcli.protocol import encode_packet as encode_packet
    from rxcli.results.dump import Taps as Taps
    from rxcli.results.dump import read_taps as read_taps
    from rxcli.runs.api import Receiver as Receiver
    from rxcli.runs.api import decode as decode
    from rxcli.runs.api import receive as receive
    from rxcli.runs.api import tap as tap
    from rxcli.types import ColumnResult as ColumnResult
    from rxcli.types import Frame as Frame
    from rxcli.types import FrameResult as FrameResult
    from rxcli.types import Metadata as Metadata
    from rxcli.types import Mosaic as Mosaic
    from rxcli.types import PacketResult as PacketResult

__version__ = "0.1.0"

#: Module -> what `import rxcli` gives of it.
_FROM = {
    "rxcli.errors": ("InputError", "ProfileError", "ReceiverError", "UsageError"),
    "rxcli.ingest": ("open_source",),
    "rxcli.options": ("ReceiverOptions", "receiver_options"),
    "rxcli.profiles": ("CameraProfile", "LensModel", "ReadoutMode", "ScreenProfile", "load_profile"),
    "rxcli.protocol": ("encode_packet",),
    "rxcli.results.dump": ("Taps", "read_taps"),
    "rxcli.runs.api": ("Receiver", "decode", "receive", "tap"),
    "rxcli.types": ("ColumnResult", "Frame", "FrameResult", "Metadata", "Mosaic", "PacketResult"),
}
_MODULE_OF = {name: module for module, names in _FROM.items() for name in names}
__all__ = ["__version__", *_MODULE_OF]


def __getattr__(name: str) -> "Any":
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'rxcli' has no attribute {name!r}")
    from importlib import import_module

    value = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
