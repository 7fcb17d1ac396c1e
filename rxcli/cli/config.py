"""The user's `config.toml`: defaults of a few options. The command line and the environment override them."""

from pathlib import Path
from typing import Any

import msgspec

from rxcli.errors import ProfileError, failure_explained


class _Config(msgspec.Struct, forbid_unknown_fields=True):
    """What the file may hold."""

    screen: str | list[str] | None = None
    camera: str | list[str] | None = None
    workers: int | None = None


def option_defaults(path: Path) -> dict[str, Any]:
    """Defaults of the options of every command, as click takes them.

    Raises:
        ProfileError: the file is no TOML, or holds a key or a value that it should not.
    """
    step = "it may hold screen, camera and workers; correct the file, or remove it"
    with failure_explained(f"{path}: cannot be read", step, ProfileError):
        config = msgspec.toml.decode(path.read_bytes(), type=_Config)
    named = {"screens": config.screen, "cameras": config.camera, "workers": config.workers}
    return {name: [value] if isinstance(value, str) else value for name, value in named.items() if value is not None}
