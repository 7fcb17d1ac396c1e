"""Numbers of the receiver, found and moved."""

from __future__ import annotations

import pytest

from rxcli.errors import UsageError
from rxcli.lab.benchmark import sensitivity
from rxcli.lab.benchmark.journal import Journal
from rxcli.lab.benchmark.sensitivity import Number, moved, numbers
from rxcli.receiver.channel import likelihoods


def test_numbers_of_a_module_are_its_numeric_constants() -> None:
    found = {number.name: number for number in numbers("receiver/channel/likelihoods")}
    assert found["_TEMPER"].value == likelihoods._TEMPER
    assert isinstance(found["_SIDES"].value, tuple)
    assert found["_TEMPER"].place.startswith("receiver/channel/likelihoods.py:")


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
    temper = likelihoods._TEMPER
    number = next(number for number in numbers("receiver/channel/likelihoods") if number.name == "_TEMPER")
    with moved(number, 0.7):
        assert pytest.approx(0.7 * temper) == likelihoods._TEMPER
    assert temper == likelihoods._TEMPER


def test_rows_say_what_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    def received(task: dict[str, object]) -> dict[str, object]:
        lost = task["factor"] == 0.7 and task["number"]["name"] == "_TEMPER"  # type: ignore[index]
        return {"frames": [{"right": 17 if lost else 20, "surely_wrong": 0}], "cpu_s": 2.0}

    monkeypatch.setattr(sensitivity, "received", received)
    rows = sensitivity.run("receiver/channel/likelihoods", 1, Journal(), seed=1, quiet=True)
    assert rows[0]["number"].endswith("_TEMPER")
    assert (rows[0]["right_0.7"], rows[0]["right_1.4"], rows[0]["changed"]) == (-3, 0, 1)
    assert all(row["changed"] == 0 for row in rows[1:])
