"""The user's `config.toml`: defaults of a few options. The command line and the environment override them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rxcli.errors import ProfileError

#: Key of the file -> parameter of the commands, and what its value may be.
_KEYS: dict[str, tuple[str, type | tuple[type, ...]]] = {
    "screen": ("screens", (str, list)),
    "camera": ("cameras", (str, list)),
    "workers": ("workers", int),
}


def option_defaults(commands: list[str]) -> dict[str, dict[str, Any]]:
    """Defaults of the options of each command, as click takes them; empty where there is no file.

    Raises:
        ProfileError: the file is no TOML, or holds a key or a value that it should not.
    """
    from rxcli.resources import user_dir

    path = user_dir() / "config.toml"
    if not path.is_file():
        return {}
    defaults: dict[str, Any] = {}
    for key, value in _read(path).items():
        name, kinds = _KEYS.get(key, ("", str))
        if not name:
            raise ProfileError(f"{path}: unknown key {key!r}", f"known are {', '.join(_KEYS)}")
        if not isinstance(value, kinds) or isinstance(value, bool):
            raise ProfileError(f"{path}: {key} has a value of the wrong kind ({value!r})", "correct the file")
        defaults[name] = [value] if name.endswith("s") and isinstance(value, str) else value
    return dict.fromkeys(commands, defaults)


def _read(path: Path) -> dict[str, Any]:
    import tomllib

    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ProfileError(f"{path}: cannot be read ({error})", "correct the file, or remove it") from None
