"""Receiver for data sent by the mini-LED backlight of a liquid crystal display.

`import rxcli` loads nothing heavy: each name is loaded when it is first used. docs/python.md shows how to use them.
"""

__all__ = ["CameraProfile", "ColumnResult", "Frame", "FrameResult", "InputError", "LensModel", "Metadata", "Mosaic"]
__all__ += ["PacketResult", "ProfileError", "ReadoutMode", "Receiver", "ReceiverError", "ReceiverOptions"]
__all__ += ["ScreenProfile", "Taps", "UsageError", "__version__", "decode", "encode_packet", "load_profile"]
__all__ += ["open_source", "read_taps", "receive", "receiver_options", "tap"]
TYPE_CHECKING = False  # as type checkers take it; typing itself would cost milliseconds
if TYPE_CHECKING:
    from typing import Any

    from rxcli.errors import InputError, ProfileError, ReceiverError, UsageError
    from rxcli.ingest import open_source
    from rxcli.options import ReceiverOptions, receiver_options
    from rxcli.profiles import CameraProfile, LensModel, ReadoutMode, ScreenProfile, load_profile
    from rxcli.protocol import encode_packet
    from rxcli.results.dump import Taps, read_taps
    from rxcli.runs.api import Receiver, decode, receive, tap
    from rxcli.types import ColumnResult, Frame, FrameResult, Metadata, Mosaic, PacketResult

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


def __getattr__(name: str) -> "Any":
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'rxcli' has no attribute {name!r}")
    from importlib import import_module

    value = globals()[name] = getattr(import_module(_MODULE_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
