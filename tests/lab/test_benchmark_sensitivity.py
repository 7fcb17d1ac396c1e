"""Numbers of the receiver, found and moved."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from rxcli.errors import UsageError
from rxcli.lab.benchmark import sensitivity
from rxcli.lab.benchmark.journal import Run
from rxcli.lab.benchmark.sensitivity import Number, moved, numbers
from rxcli.receiver.channel import likelihoods, words
from rxcli.receiver.channel.settings import SETTINGS


def test_numbers_of_a_module_are_its_numeric_constants() -> None:
    found = {number.name: number for number in numbers("receiver/channel/likelihoods")}
    assert found["_DEGREES"].value == likelihoods._DEGREES
    assert found["_THREADS"].value == likelihoods._THREADS, "of two that are assigned together"
    assert found["_DEGREES"].place.startswith("receiver/channel/likelihoods.py:")


def test_numbers_of_a_room_are_the_fields_of_its_settings() -> None:
    found = {number.name: number for number in numbers("receiver/channel/settings")}
    assert found["SETTINGS.slot_information"].value == SETTINGS.slot_information
    assert isinstance(found["SETTINGS.picture_kinds"].value, tuple)
    assert {name.removeprefix("SETTINGS.") for name in found} == {field.name for field in fields(SETTINGS)}


def test_rooms_that_do_not_exist_are_told() -> None:
    with pytest.raises(UsageError, match="no room"):
        numbers("receiver/attic")


@pytest.mark.parametrize(
    ("value", "factor", "expected"), [(2.0, 0.7, 1.4), (1, 0.7, 0), (3, 1.4, 4), (40, 1.4, 56), ((1.0, 2.0), 1.4, None)]
)
def test_moves_scale_and_keep_whole_numbers_whole(value: float, factor: float, expected: float | None) -> None:
    got = Number("m", "n", 1, value).times(factor)
    assert got == (pytest.approx((1.4, 2.8)) if expected is None else pytest.approx(expected))
    assert type(got) is type(value)


def test_a_number_is_moved_where_it_is_used_and_put_back() -> None:
    room = numbers("receiver/channel")
    before = likelihoods._DEGREES, likelihoods.SETTINGS.picture_kinds
    for name in ("_DEGREES", "SETTINGS.picture_kinds"):
        with moved(next(number for number in room if number.name == name), 0.7):
            after = likelihoods._DEGREES, words.SETTINGS.picture_kinds
            assert after[0] == pytest.approx(before[0] * (0.7 if name == "_DEGREES" else 1))
            assert after[1][1] == pytest.approx(np.multiply(before[1][1], 1 if name == "_DEGREES" else 0.7))
    assert (likelihoods._DEGREES, likelihoods.SETTINGS.picture_kinds) == before
    assert words.SETTINGS is SETTINGS


def test_rows_say_what_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    def received(task: dict[str, object]) -> dict[str, object]:
        lost = task["factor"] == 0.7 and task["number"]["name"] == "_DEGREES"  # type: ignore[index]
        return {"frames": [{"right": 17 if lost else 20, "surely_wrong": 0}], "cpu_s": 2.0}

    monkeypatch.setattr(sensitivity, "received", received)
    rows = sensitivity.run("receiver/channel/likelihoods", 1, Run(seed=1, quiet=True))
    assert rows[0]["number"].endswith("_DEGREES")
    assert (rows[0]["right_0.7"], rows[0]["right_1.4"], rows[0]["changed"]) == (-3, 0, 1)
    assert all(row["changed"] == 0 for row in rows[1:])
