"""Which numbers a result depends on, beside version, options and profiles."""

from hashlib import sha256
from importlib import import_module
from pkgutil import walk_packages

import msgspec

from rxcli import link, receiver
from rxcli.resources import data_dir


def settings_in_force() -> str:
    """Hash of the thresholds of receiver and link layer (settings, named numbers) and of fitted models."""
    found = [walk_packages(room.__path__, f"{room.__name__}.") for room in (link, receiver)]
    modules = [import_module(name) for name in sorted(module.name for room in found for module in room)]
    constants = [(m.__name__, *item) for m in modules for item in sorted(vars(m).items()) if item[0].isupper()]
    fixed = (int, float, tuple, msgspec.Struct)  # numbers, several, and settings objects
    numbers = {f"{module}.{name}": value for module, name, value in constants if isinstance(value, fixed)}
    models = [path.read_bytes() for path in sorted(data_dir("models").glob("*/model.toml"))]
    return sha256(repr(numbers).encode() + b"".join(models)).hexdigest()[:16]
