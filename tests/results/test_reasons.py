"""Every reason has a sentence, and every sentence its facts."""

import ast
import string
from functools import cache
from pathlib import Path
from typing import get_args

import pytest

import rxcli
from rxcli.results.reasons import explained, sentence_of, sentences
from rxcli.results.record import from_record, to_record
from rxcli.types import ColumnResult, FrameResult, Reason, Remark

CODE = [path.read_text(encoding="utf-8") for path in Path(rxcli.__file__).parent.rglob("*.py")]


@cache
def constants() -> set[str]:
    """Texts in the code, docstrings aside."""
    nodes = (node for text in CODE for node in ast.walk(ast.parse(text)))
    return {node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str)}


def test_every_reason_has_a_sentence_and_no_other() -> None:
    assert sentences().keys() == set(get_args(Reason))


@pytest.mark.parametrize("reason", get_args(Reason))
def test_a_sentence_is_one_line_without_a_full_stop_and_names_facts_of_the_code(reason: str) -> None:
    sentence = sentences()[reason]
    assert sentence == sentence.strip(" .\n")
    assert "\n" not in sentence
    derived = {"share_percent": "share", "n_photos": "share"}
    for name in (field for _, field, *_ in string.Formatter().parse(sentence) if field):
        unit = {"us": "s", "khz": "hz"}.get(name.rpartition("_")[2])
        name = derived.get(name, f"{name.rpartition('_')[0]}_{unit}" if unit else name)
        assert name in constants()


def test_facts_stand_in_the_sentence_in_the_units_of_people() -> None:
    facts = {"fill_percent": 25.0, "needed_percent": 34.0, "slot_rate_hz": 8650.0, "share": 0.7}
    assert sentence_of(Remark("screen_fills_little", facts)).startswith(
        "the screen fills 25 % of the height: one packet at 8.65 kHz needs 34 %"
    )
    why = Remark("no_column", {"column": 3, "why": Remark("uncertain", {"snr_db": 4.04})})
    assert "column 3 is the clearest: too many slots are uncertain at 4.0 dB" in sentence_of(why)


def test_a_result_comes_with_reason_and_sentence_and_so_does_its_record() -> None:
    column = ColumnResult(0, "no_packet", remark=Remark("echo"))
    bare = FrameResult("a", 0, 0.0, "no_signal", columns=(column,), remarks=(Remark("steady_light"), Remark("unsure")))
    result = explained(bare)
    assert result.message == f"{sentences()['steady_light']}; {sentences()['unsure']}"
    assert result.columns[0].message == sentences()["echo"]
    record = to_record(result)
    assert (record["reason"], record["message"]) == ("steady_light", result.message)
    assert (record["columns"][0]["reason"], record["columns"][0]["message"]) == ("echo", sentences()["echo"])
    back = from_record(record)
    assert (back.reason, back.message, back.columns[0].reason) == ("steady_light", result.message, "echo")
    assert "reason" not in to_record(FrameResult("a", 0, 0.0, "ok"))


def test_a_message_without_a_reason_stays() -> None:
    unreadable = FrameResult("a", 0, 0.0, "unreadable", "a: the file is empty")
    assert explained(unreadable) == unreadable
