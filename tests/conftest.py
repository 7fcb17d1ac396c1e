"""Fixtures that several test files share."""

import os
import signal
from pathlib import Path

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


@pytest.fixture(scope="session")
def shared_captures() -> Path:
    """The folder of reference captures beside the checkout, which is no part of the project."""
    folder = _SHARED / "captures"
    if not folder.is_dir():
        pytest.skip(f"no reference captures at {folder}")
    return folder


@pytest.fixture(scope="session")
def shared_cases() -> Path:
    """The folder of odd files beside the checkout, which is no part of the project."""
    folder = _SHARED / "cases"
    if not folder.is_dir():
        pytest.skip(f"no odd files at {folder}")
    return folder


@pytest.fixture(scope="session")
def shared_real() -> Path:
    """The folder of real pictures beside the checkout, which is no part of the project."""
    folder = _SHARED / "real"
    if not folder.is_dir():
        pytest.skip(f"no real pictures at {folder}")
    return folder
