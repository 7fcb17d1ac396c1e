"""Exit codes and what an error says; where shipped data lie."""

import pickle

import pytest

from rxcli.errors import ExitCode, InputError, ProfileError, ReceiverError, UsageError, without_commands, worst
from rxcli.resources import data_dir


def test_exit_codes_of_the_command_line() -> None:
    names = ("OK", "NOT_RECEIVED", "USAGE", "UNREADABLE", "INTERRUPTED", "TERMINATED")
    assert {code.name: code.value for code in ExitCode} == dict(zip(names, (0, 1, 2, 3, 130, 143), strict=True))


@pytest.mark.parametrize(
    ("codes", "expected"), [([], 0), ([0, 0], 0), ([0, 1], 1), ([1, 3], 3), ([3, 2, 1], 2), ([1, 2, 3, 130, 0], 130)]
)
def test_where_several_hold_the_first_of_130_2_3_1_wins(codes: list[int], expected: int) -> None:
    assert worst([ExitCode(code) for code in codes]) == expected


@pytest.mark.parametrize(
    ("kind", "code"), [(InputError, 3), (ProfileError, 2), (UsageError, 2), (ReceiverError, ExitCode.NOT_RECEIVED)]
)
def test_an_error_is_one_line_with_its_next_step(kind: type[ReceiverError], code: int) -> None:
    """Also where it comes from another process."""
    assert str(kind("a.jpg: no picture")) == "a.jpg: no picture"
    error = pickle.loads(pickle.dumps(kind("a.jpg: no picture", "name a photo")))
    assert type(error) is kind
    assert str(error) == "a.jpg: no picture; name a photo"
    assert error.exit_code == code


@pytest.mark.parametrize(
    ("text", "fits"),
    [
        ("it is dark; expose longer", "it is dark; expose longer"),
        ("another one (--screen auto tries all), or its place wrong (--corners)", "another one, or its place wrong"),
        (
            "too slow (at 3 kHz); go nearer; if it sends, give its place with --corners",
            "too slow (at 3 kHz); go nearer",
        ),
        ("run `pip install x`, or save as JPEG", "save as JPEG"),
        ("run vlc-rx calibrate shutter", ""),
    ],
)
def test_a_page_speaks_of_no_commands(text: str, fits: str) -> None:
    assert without_commands(text) == fits


@pytest.mark.parametrize(
    ("name", "suffix"), [("calibration", ".toml"), ("models", ".onnx"), ("pages", ".html"), ("sample_frames", ".jpg")]
)
def test_shipped_data_are_found(name: str, suffix: str) -> None:
    assert any(path.suffix == suffix for path in data_dir(name).rglob("*"))
