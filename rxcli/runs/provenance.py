"""Which numbers a result depends on, beside version, options and profiles."""

from hashlib import sha256
from importlib import import_module
from pkgutil import walk_packages
from typing import Any

import msgspec

from rxcli import link, receiver
from rxcli.resources import data_dir


def settings_in_force() -> str:
    """Hash of the thresholds of receiver and link layer (settings, named numbers) and of fitted models."""
    rooms = [walk_packages(room.__path__, f"{room.__name__}.") for room in (link, receiver)]
    names = sorted(found.name for room in rooms for found in room)
    numbers = {
        f"{name}.{constant}": value
        for name in names
        for constant, value in sorted(vars(import_module(name)).items())
        if constant.isupper() and _is_fixed(value)
    }
    models = [path.read_bytes() for path in sorted(data_dir("models").glob("*/model.toml"))]
    return sha256(repr(numbers).encode() + b"".join(models)).hexdigest()[:16]


def _is_fixed(value: Any) -> bool:
    """Whether a constant is a number, numbers, or a settings object."""
    return isinstance(value, (int, float, tuple, msgspec.Struct))
