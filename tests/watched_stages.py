"""Watches the numeric stages: every value that a public function of theirs returns is checked."""

import inspect
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from rxcli.lab.benchmark.cases import problems_in
from rxcli.receiver import channel, plane
from rxcli.receiver.decode import detect
from rxcli.receiver.screen import geometry
from rxcli.receiver.sync import clock as sync

STAGES = (geometry, plane, sync, channel, detect)


@contextmanager
def watched() -> Iterator[list[str]]:
    """While this lasts, problems of the stages' outputs and all warnings are gathered in the list it gives."""
    found: list[str] = []
    with warnings.catch_warnings(record=True) as caught, pytest.MonkeyPatch.context() as patch:
        warnings.simplefilter("always")
        for module, name, function in [(stage, *of) for stage in STAGES for of in _public(stage)]:
            patch.setattr(module, name, _watch(function, f"{module.__name__.rpartition('.')[2]}.{name}", found))
        yield found
    found += [f"{w.category.__name__}: {w.message} ({Path(w.filename).name}:{w.lineno})" for w in caught]


def _public(module: ModuleType) -> list[tuple[str, Callable[..., Any]]]:
    members = inspect.getmembers(module, inspect.isfunction)
    # What a package hands on is defined in its files.
    own = [(name, f) for name, f in members if f"{f.__module__}.".startswith(f"{module.__name__}.")]
    return [(name, f) for name, f in own if not name.startswith("_")]


def _watch(function: Callable[..., Any], name: str, found: list[str]) -> Callable[..., Any]:
    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        result = function(*args, **kwargs)
        for problem in problems_in(result, name):
            if problem not in found:
                found.append(problem)
        return result

    return call
