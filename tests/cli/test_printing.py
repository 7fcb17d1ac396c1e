"""What `decode` shows: texts and files first, a clip in one line, and progress that tells the end."""

from dataclasses import replace

import pytest

from rxcli.cli import printing
from rxcli.cli.printing import Progress, Table
from rxcli.results.summary import SourceSummary
from rxcli.types import ColumnResult, FrameResult, Message, PacketResult

PACKET = PacketResult(1.0, 1.5, 24, "abcdef", 0.998, 1e-5)


def frame(number: int, n_frames: int, text: str | None = None) -> FrameResult:
    burst = number if n_frames > 1 else None
    columns = tuple(ColumnResult(c, "ok", w=5, snr_db=20.0, packets=(replace(PACKET, burst=burst),)) for c in (0, 1))
    messages = (Message("text", text.encode(), "a", number, 0.0),) if text else ()
    return FrameResult("a", number, number / 30, "ok", columns=columns, messages=messages)


def shown(n_frames: int, packets: bool = False) -> Table:
    """Print a source whose last frame brings a text."""
    table, summary = Table(packets), SourceSummary("a")
    table.begin("a", scored=False)
    for number in range(n_frames):
        last = number == n_frames - 1
        result = frame(number, n_frames, "hello" if last else None)
        summary.add(result)
        table.write(result, last)
    table.end(summary)
    return table


def test_a_clip_is_one_line_without_hex(capsys: pytest.CaptureFixture[str]) -> None:
    assert not shown(30).has_table
    lines = capsys.readouterr().out.split("\n")
    assert lines[0] == "text: hello"
    assert lines[1] == (
        "a | clip of 30 frames, 1.00 s | 30 bursts: 60 packets received | 1.4 kb/s | mean confidence 0.998 | 0 ms"
    )
    assert lines[2:] == ["", ""]


def test_a_clips_table_on_request_has_time_burst_and_status(capsys: pytest.CaptureFixture[str]) -> None:
    shown(3, packets=True)
    header, *rows = capsys.readouterr().out.splitlines()
    assert header.split()[:5] == ["time", "s", "burst", "col", "status"]
    assert rows[2].split()[:4] == ["0.033", "1", "0", "ok"]
    assert rows[2].index("abcdef") == header.index("payload")
    assert sum("abcdef" in row for row in rows) == 6


def test_progress_tells_the_end(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with Progress(12, 2, quiet=False) as progress, Progress(12, 2, quiet=True) as quiet:
        progress.add(frame(0, 1, "hello"), last=True)
        assert capsys.readouterr().err == ""  # not yet ten seconds
        assert progress.line(2.0) == (
            "3 of 12 photos and clips; 1 frame, 2 packets, 1 texts and files; 0.5 a second; 18 s left"
        )
        monkeypatch.setattr(printing, "_EVERY_S", 0.0)
        progress.add(frame(0, 2), last=False)
        quiet.add(frame(0, 1), last=True)
        [line] = capsys.readouterr().err.splitlines()
        assert line.startswith("vlc-rx: 3 of 12 photos and clips; 2 frames, 4 packets")


def until(words: str, capsys: pytest.CaptureFixture[str]) -> str:
    """What a thread writes, up to some words."""
    said = ""
    for _ in range(100_000):
        said += capsys.readouterr().err
        if words in said:
            return said
    raise AssertionError(said)


@pytest.mark.parametrize(
    ("on_terminal", "n_total", "words"), [(True, 1, " frames"), (True, 2, "0/2"), (False, 1, "0 of 1")]
)
def test_a_photo_that_is_searched_and_a_clip_show_how_far_they_are(
    on_terminal: bool, n_total: int, words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before the first result, too: a thread shows it."""
    monkeypatch.setattr(printing, "is_terminal", lambda stream: on_terminal)
    monkeypatch.setattr(printing, "_DELAY_S", 0.0)
    monkeypatch.setattr(printing, "_EVERY_S", 0.0)
    with Progress(n_total, 0, quiet=False) as progress:
        progress.begin("photo.jpg")
        said = until("photo.jpg: searching", capsys)
        assert words in said
        progress.add(frame(0, 30), last=False)
        assert until("photo.jpg: frame 1", capsys)
    assert not progress._watch.is_alive()


def test_a_terminal_gets_a_bar_when_there_is_time_to_read_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(printing, "is_terminal", lambda stream: True)
    with Progress(3, 0, quiet=False) as progress:
        progress.add(frame(0, 1), last=True)
        assert capsys.readouterr().err == ""
        monkeypatch.setattr(printing, "_DELAY_S", 0.0)
        progress.add(frame(0, 1), last=True)
        assert "2/3" in capsys.readouterr().err


def test_a_long_simulation_says_how_far_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(printing, "_EVERY_S", 0.0)
    assert list(printing.with_progress(range(3), "clip.mp4", "frames")) == [0, 1, 2]
    assert "vlc-rx: clip.mp4: 2 of 3 frames" in capsys.readouterr().err
