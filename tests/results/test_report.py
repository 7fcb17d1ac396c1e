"""JSON lines, tables, summaries and JUnit files."""

import csv
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rxcli.errors import ExitCode, UsageError
from rxcli.results.record import from_record, to_json_line, to_record
from rxcli.results.report import format_frame, headline, printable_name
from rxcli.results.summary import Limits, SourceSummary, exit_code, format_summary, write_junit, write_summary
from rxcli.results.truth import Score
from rxcli.types import ColumnResult, FrameResult, Message, PacketResult, Remark

PACKET = PacketResult(412.6, 2.76, 168, "d076558cfe9de2d3cbb042f32dc440df474e5a5d9c", 0.998, 1.23e-5)
OK = FrameResult(
    "a.jpg",
    0,
    0.0,
    "ok",
    screen_profile="paper-34k6",
    corners=np.array([[1.0, 2.0], [3.004, 4.0], [5.0, 6.0], [7.0, 8.0]]),
    camera_profile="xs10",
    line_delay_s=5.79e-06,
    exposure_s=3.125e-05,
    columns=(
        ColumnResult(0, "ok", w=5, snr_db=21.3, delay_slots=0.0, packets=(PACKET, replace(PACKET, first_row=1912.0))),
        ColumnResult(1, "dark", message="too little light; expose longer"),
        ColumnResult(2, "dark", message="too little light; expose longer"),
    ),
    timing_ms={"ingest": 118.0, "total": 150.2},
)
LOST = FrameResult("b.jpg", 0, 0.0, "no_screen", message="no columns were found; give --corners")
BAD = FrameResult("c.jpg", 0, 0.0, "unreadable", message="c.jpg: the file is empty; copy it again")


def test_the_documented_shape_in_the_documented_order() -> None:
    line = to_json_line(OK)
    assert line.startswith(
        '{"source": "a.jpg", "frame": 0, "time_s": 0.0, "status": "ok", '
        '"screen": {"profile": "paper-34k6", "corners": [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0]]}, '
        '"camera": {"profile": "xs10", "line_delay_s": 5.79e-06, "exposure_s": 3.125e-05}, '
        '"columns": [{"column": 0, "status": "ok", "w": 5, "snr_db": 21.3, "denoised": false, "delay_slots": 0.0, '
        '"packets": [{"first_row": 412.6, "copies": 2.76, "payload_bits": 168, '
        '"payload": "d076558cfe9de2d3cbb042f32dc440df474e5a5d9c", "confidence": 0.998, "bit_errors": null, '
    )
    assert line.endswith('"timing_ms": {"ingest": 118.0, "total": 150.2}}')
    assert "\n" not in line


def test_unknown_values_are_null_and_failures_carry_a_message() -> None:
    record = json.loads(to_json_line(LOST))
    assert record["screen"] == {"profile": None, "corners": None}
    assert record["camera"] == {"profile": None, "line_delay_s": None, "exposure_s": None}
    assert record["message"] == LOST.message
    assert "message" not in to_record(OK)
    assert to_record(OK)["columns"][1]["snr_db"] is None
    assert to_record(OK)["columns"][1]["message"] == OK.columns[1].message


wild = st.floats(allow_nan=True, allow_infinity=True) | st.none()


@given(wild, wild, st.floats(), st.floats(), st.text(), st.lists(st.floats(), min_size=8, max_size=8))
def test_no_value_makes_a_line_that_is_not_json(
    snr: float, delay: float, confidence: float, row: float, name: str, corners: list[float]
) -> None:
    packet = PacketResult(row, confidence, 3, "a0", confidence, row, bit_errors=2)
    column = ColumnResult(0, "ok", w=5, snr_db=snr, delay_slots=delay, packets=(packet,), message=name)
    result = replace(
        OK,
        source=name,
        columns=(column,),
        corners=np.array(corners).reshape(4, 2),
        estimated={"line_delay_s": (row, confidence)},
        denoiser={"snr": np.float64(row), "columns": np.arange(3), name: (confidence, None, True)},
        timing_ms={"total": row},
    )

    def refuse(token: str) -> float:
        raise AssertionError(token)

    line = to_json_line(result)
    record = json.loads(line, parse_constant=refuse)
    assert to_json_line(from_record(record)) == line
    assert "\n" not in format_frame(result).splitlines()[0]


def test_a_line_reads_back_as_the_result() -> None:
    packet = replace(PACKET, burst=7, frames=(3, 4))  # of a clip
    sent = replace(OK, columns=(replace(OK.columns[0], packets=(packet,)), *OK.columns[1:]))
    back = from_record(json.loads(to_json_line(sent)))
    assert back.columns == sent.columns
    assert back.corners == pytest.approx(np.round(OK.corners, 2))
    assert replace(back, corners=None) == replace(sent, corners=None)


@pytest.mark.parametrize("record", [{}, [], None, {"source": 3}, to_record(OK) | {"columns": 3}])
def test_what_is_no_result_is_refused(record: Any) -> None:
    with pytest.raises(UsageError, match="not a result line"):
        from_record(record)


@given(st.binary(min_size=1, max_size=20))
@example(b"caf\xe9.jpg")
def test_a_name_survives_and_can_be_told_from_what_is_printed(raw: bytes) -> None:
    name = raw.decode(errors="surrogateescape")
    line = to_json_line(replace(OK, source=name))
    assert line.isascii()
    assert from_record(json.loads(line)).source == name
    format_frame(replace(OK, source=name)).encode("utf-8")
    shown = printable_name(name)
    assert shown.isprintable()
    plain = {"\\": "\\", "n": "\n", "r": "\r", "t": "\t"}

    def character(escape: re.Match[str]) -> str:
        text = escape[1]
        return plain.get(text) or chr(int(text[1:], 16) + (0xDC00 if text[0] == "x" else 0))

    assert re.sub(r"\\([\\nrt]|x..|u.{4}|U.{8})", character, shown) == name


def test_the_table_shows_what_a_person_looks_for() -> None:
    columns = (replace(OK.columns[0], packets=(PACKET, replace(PACKET, confidence=0.99999, payload="ab" * 10))),)
    heading, header, first, second, dark = format_frame(replace(OK, columns=columns + OK.columns[1:])).splitlines()
    assert heading == "a.jpg | ok | screen paper-34k6 | camera xs10 | 2 packets received (3 columns) | 150 ms"
    assert header.split() == ["col", "status", "w", "snr", "dB", "confidence", "copies", "payload"]
    assert first.split() == ["0", "ok", "5", "21.3", "0.9980", "2.76", "d076558cfe9de2d…5d9c"]
    assert second.split()[4:] == ["0.9999", "2.76", "ab" * 10]  # never rounded up to certainty; a short one whole
    assert first.index("d076") == header.index("payload")
    assert dark.split(maxsplit=2) == ["1-2", "dark", "too little light; expose longer"]
    assert format_frame(BAD) == "c.jpg | unreadable\n  the file is empty\n  copy it again"


def test_columns_of_one_reason_share_a_row() -> None:
    """Whose figures may differ a little."""
    columns = tuple(
        ColumnResult(n, "no_packet", remark=Remark("incomplete"), message=f"of 70 slots {25 + n // 5} are missing")
        for n in range(20)
    )
    rows = format_frame(replace(OK, status="no_signal", columns=columns)).splitlines()[2:]
    assert [row.split(maxsplit=2) for row in rows] == [["0-19", "no_packet", "of 70 slots 25 are missing"]]


def summary(*results: FrameResult, score: Score | None = None) -> SourceSummary:
    found = SourceSummary(results[0].source, score=score)
    for result in results:
        found.add(result)
    return found


SCORE = Score(expected=4, bits=400, error_free=3, bit_errors=8)


def test_exit_codes() -> None:
    ok, lost, bad, scored = summary(OK), summary(LOST), summary(BAD), summary(OK, score=SCORE)
    for summaries, limits, code in (
        ([], Limits(), ExitCode.OK),
        ([ok], Limits(), ExitCode.OK),
        ([ok, lost], Limits(), ExitCode.NOT_RECEIVED),
        ([ok, bad, lost], Limits(), ExitCode.UNREADABLE),
        ([summary(OK, BAD)], Limits(), ExitCode.UNREADABLE),
        ([ok], Limits(min_packets=2), ExitCode.OK),
        ([ok], Limits(min_packets=3), ExitCode.NOT_RECEIVED),
        ([scored], Limits(max_ber=0.02), ExitCode.OK),
        ([scored], Limits(max_ber=0.0199), ExitCode.NOT_RECEIVED),
        ([ok], Limits(max_ber=1.0), ExitCode.NOT_RECEIVED),
    ):
        assert exit_code(summaries, limits) is code, limits


READ = Message("text", b"hello", "d.jpg", 0, 0.0, photos=("b.jpg", "d.jpg"))


def test_a_text_is_a_success(tmp_path: Path) -> None:
    """Also of the photo that shows a part of it, and another completes."""
    photo = FrameResult("d.jpg", 0, 0.0, "ok", messages=(READ,))
    text, part = summary(photo), summary(LOST)
    part.add_part(READ)
    assert exit_code([text, part], Limits(expected_texts=("hello",))) is ExitCode.OK
    assert exit_code([text], Limits(expected_texts=("hello", "bye"))) is ExitCode.NOT_RECEIVED
    assert exit_code([text], Limits(min_packets=2)) is ExitCode.NOT_RECEIVED
    assert "completed by d.jpg" in format_summary([text, part], Limits())
    assert format_summary([text, part], Limits()).endswith("all received")
    write_junit(tmp_path / "j.xml", [text], Limits(expected_texts=("bye",)))
    written = (tmp_path / "j.xml").read_text()
    assert "the text 'bye' did not come" in written
    assert "text: hello" in written
    assert from_record(to_record(photo)) == photo


def test_the_summary_names_reasons_and_scores() -> None:
    scored = summary(OK, score=SCORE)
    header, first, second, last = format_summary([scored, summary(BAD)], Limits()).splitlines()
    names = ["source", "frames", "received", "unsure", "confidence", "expected", "error-free", "lost", "false", "ber"]
    assert header.split() == names
    assert first.split()[:10] == ["a.jpg", "1", "2", "0", "0.998", "4", "3", "0", "0", "0.02"]
    assert second.endswith("the file is empty; copy it again")
    assert last.endswith("1 of 2 failed")
    last = format_summary([scored, summary(LOST), scored], Limits()).splitlines()[-1]
    assert last.split()[:10] == ["total", "3", "4", "0", "0.998", "8", "6", "0", "0", "0.02"]
    assert "expected" not in format_summary([summary(OK)], Limits())


def test_a_photo_alone_says_its_reason_once() -> None:
    """In the table above the summary; what that does not show stays."""
    assert format_summary([summary(BAD)], Limits(), is_shown=True).endswith(" -")
    assert format_summary([summary(LOST)], Limits(), is_shown=True).endswith("no packet")
    assert format_summary([summary(OK)], Limits(min_packets=3), is_shown=True).endswith("3 were asked for")
    for summaries in ([summary(LOST), summary(OK)], [summary(LOST, LOST)]):
        assert "give --corners" in format_summary(summaries, Limits(), is_shown=True)


def unsure(n_unsure: int, n_columns: int = 3) -> FrameResult:
    """A photo whose last packets are below what can be believed."""
    confidence = [0.5] * (n_columns - n_unsure) + [0.499] * n_unsure
    columns = (ColumnResult(n, "ok", packets=(replace(PACKET, confidence=c),)) for n, c in enumerate(confidence))
    return replace(OK, columns=tuple(columns))


@pytest.mark.parametrize(
    ("n_unsure", "said"),
    [(0, "3 packets received"), (1, "2 packets received, 1 unsure"), (3, "no packet received, 3 unsure")],
)
def test_headlines_count_packets_that_can_be_believed(n_unsure: int, said: str) -> None:
    result = unsure(n_unsure)
    assert f"| {said} (3 columns) |" in format_frame(result)
    assert headline(result) == said[0].upper() + said[1:]
    row = summary(result).row(Limits())
    assert (row["packets"], row["received"], row["unsure"]) == (3, 3 - n_unsure, n_unsure)


def test_all_received_is_said_only_where_it_is_so() -> None:
    first, second = (
        replace(r, frame=n, columns=tuple(replace(c, packets=(replace(PACKET, burst=n),)) for c in r.columns))
        for n, r in enumerate([unsure(0)] * 2)
    )
    lacking = replace(second, columns=(replace(second.columns[0], packets=()), *second.columns[1:]))
    for results, is_whole in (
        ([unsure(0)], True),
        ([first, second], True),
        ([unsure(1)], False),
        ([OK], False),
        ([first, lacking], False),
    ):
        last = format_summary([summary(unsure(0)), summary(*results)], Limits()).splitlines()[-1]
        assert last.endswith("all received") == is_whole


def test_reasons_that_differ_in_numbers_are_one() -> None:
    many = [replace(LOST, frame=n, message=f"too dark at {n}.5 dB; expose longer") for n in range(9)]
    assert summary(*many).reason == "too dark at 0.5 dB; expose longer"
    packet = replace(PACKET, confidence=math.nan)
    found = summary(replace(OK, columns=(replace(OK.columns[0], packets=(packet,)),)))
    assert found.row(Limits())["confidence"] is None


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_summary_files(suffix: str, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed (extra parquet)")
    path, summaries = tmp_path / f"s.{suffix}", [summary(OK, score=SCORE), summary(BAD)]
    write_summary(path, summaries, Limits())
    if suffix == "csv":
        rows = csv.DictReader(path.read_text().splitlines())
        first, second = ({name: cell or None for name, cell in row.items()} for row in rows)
    else:
        first, second = parquet.read_table(path).to_pylist()
    for name, kind, expected in (("packets", int, 2), ("ber", float, 0.02), ("exit_code", int, 0), ("unsure", int, 0)):
        assert kind(first[name]) == expected
    assert (first["source"], second["ber"], int(second["exit_code"])) == ("a.jpg", None, 3)
    with pytest.raises(UsageError, match=r"must end in .csv or .parquet \(got"):
        write_summary(tmp_path / "s.xls", summaries, Limits())
    with pytest.raises(UsageError, match="cannot be written"):
        write_summary(tmp_path / "none" / path.name, summaries, Limits())


def test_junit(tmp_path: Path) -> None:
    odd = replace(LOST, source="odd\x00\x1f<&>.jpg")
    write_junit(tmp_path / "j.xml", [summary(OK), summary(BAD), summary(odd)], Limits())
    [suite] = ElementTree.parse(tmp_path / "j.xml").getroot()
    assert (suite.get("tests"), suite.get("errors"), suite.get("failures")) == ("3", "1", "1")
    passed, error, failure = suite
    assert [(part.tag, part.text) for part in passed] == [("system-out", "2 packets received")]
    assert float(str(passed.get("time"))) == pytest.approx(0.150)
    assert "the file is empty" in str(error.find("error").get("message"))
    assert "no columns were found" in str(failure.find("failure").get("message"))
    assert str(failure.get("name")).endswith("<&>.jpg")


def test_a_frame_whose_bursts_go_on_does_not_look_like_a_failure() -> None:
    """The first frame of a clip: received, and all it shows is reported with the next one."""
    goes_on = ColumnResult(0, "ok", message="its burst goes on in the next frame and is reported there")
    first = replace(OK, columns=(goes_on, replace(goes_on, column=1)))
    text = format_frame(first)
    assert "its packets end in later frames" in text.splitlines()[0]
    assert len(text.splitlines()) == 1
    second = replace(OK, frame=1, columns=(replace(OK.columns[0], packets=(replace(PACKET, burst=0),)), goes_on))
    line = format_summary([summary(first, second)], Limits()).splitlines()[-1]
    assert "goes on" not in line
