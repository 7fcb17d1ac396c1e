"""Fixtures that several test files share."""

import os
import signal
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

#: A busy machine fails no test: how long examples take to make says nothing of the code.
settings.register_profile("any machine", suppress_health_check=[HealthCheck.too_slow], deadline=None)
settings.load_profile("any machine")
_SHARED = Path(__file__).resolve().parents[1].parent / "shared"


def pytest_configure() -> None:
    """Be heard, though a shell makes what it runs in the background deaf to Ctrl-C; and use no settings of the user."""
    os.environ["VLC_RX_HOME"] = os.path.join(os.devnull, "none")
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _shared(folder: str) -> Any:
    """A fixture: a folder of files beside the checkout, which is no part of the project."""

    @pytest.fixture(scope="session")
    def found() -> Path:
        if not (_SHARED / folder).is_dir():
            pytest.skip(f"no files for this test at {_SHARED / folder}")
        return _SHARED / folder

    return found


shared_captures, shared_cases, shared_real = map(_shared, ("captures", "cases", "real"))
