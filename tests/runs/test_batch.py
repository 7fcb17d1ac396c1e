"""Batches: which files, in which order, by whom, and what a kill leaves behind."""

import errno
import json
import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from fake_receiver import WRONG, fake_decoder

from rxcli.errors import InputError, UsageError
from rxcli.receiver.search.settings import SETTINGS
from rxcli.results.record import to_json_line
from rxcli.runs.batch import Source, collect_sources, decode_here, decode_in_processes, unreadable
from rxcli.runs.journal import Head, Journal, Lines
from rxcli.runs.provenance import settings_in_force
from rxcli.types import Frame

SUFFIXES = frozenset({".jpg", ".mp4"})


def write_order(folder: Path, name: str, **order: object) -> Source:
    path = folder / name
    path.write_text(json.dumps(order))
    return Source(str(path), str(path))


def lines(decoded: object) -> list[str]:
    return [to_json_line(result) for _, results in decoded for result in results]


def test_folders_are_walked_in_order_and_files_taken_once(tmp_path: Path) -> None:
    """Unknown suffixes are passed over in folders; a file named explicitly is taken whatever its suffix."""
    for name in ("b.jpg", "a.MP4", "notes.txt", "sub/c.jpg", ".hidden.jpg", ".git/d.jpg", "a.truth.json"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    paths = [str(tmp_path / name) for name in ("notes.txt", "b.jpg", ".", "missing")]
    found = [os.path.relpath(source.name, tmp_path) for source in collect_sources(paths, SUFFIXES)]
    assert found == ["notes.txt", "b.jpg", "a.MP4", "sub/c.jpg", "missing"]


def test_what_lies_beside_photos_is_passed_over_and_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    aside = ("@eaDir/a.jpg", "#recycle", "$RECYCLE.BIN", "__MACOSX", "sub/Thumbnails")
    for name in ("a.jpg", "sub/c.jpg", *(f"{folder}/x.jpg" for folder in aside)):
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).touch()
    (tmp_path / "other").symlink_to(tmp_path / "sub")
    found = [os.path.relpath(source.name, tmp_path) for source in collect_sources([str(tmp_path)], SUFFIXES)]
    assert found == ["a.jpg", "sub/c.jpg"]
    said = sorted(os.path.relpath(record.args[0], tmp_path) for record in caplog.records)
    assert said == sorted(["#recycle", "$RECYCLE.BIN", "@eaDir", "__MACOSX", "other", "sub/Thumbnails"])
    inside = collect_sources([str(tmp_path / "@eaDir" / "a.jpg"), str(tmp_path / "other")], SUFFIXES)
    assert [os.path.basename(source.name) for source in inside] == ["x.jpg", "c.jpg"]


@pytest.mark.parametrize(
    ("error", "is_tried_again"),
    [
        (PermissionError(errno.EACCES, "Permission denied"), True),
        (OSError(errno.EIO, "Input/output error"), True),
        (OSError(errno.ESTALE, "Stale file handle"), True),
        (MemoryError(), True),
        (OSError("image file is truncated"), False),
        (FileNotFoundError(errno.ENOENT, "No such file"), False),
    ],
    ids=str,
)
@pytest.mark.parametrize("is_explained", [False, True])
def test_a_failure_of_the_machine_is_tried_again(error: Exception, is_tried_again: bool, is_explained: bool) -> None:
    """Whether a reader explains it or not; a failure of the file is not."""

    def fail(path: str) -> Iterator[Frame]:
        yield Frame(np.zeros((1, 1), np.uint8), source=path)
        try:
            raise error
        except Exception:
            if is_explained:
                raise InputError(f"{path}: cannot be read", "check the disk") from None
            raise

    decoder = replace(fake_decoder(), open_source=fail)
    *_, last = decoder.results(Source("a", "a"))
    assert (last.status, last.retry) == ("unreadable", is_tried_again)


def test_a_folder_that_may_be_read_later_leaves_no_failure() -> None:
    [result] = fake_decoder().results(Source("a", "a", "a: the folder may not be read"))
    assert result.retry


def test_pictures_without_an_extension_are_known_by_their_content(tmp_path: Path) -> None:
    """As cameras, downloads and archives name them; a name with another extension means what it says."""
    taken = (
        "IMG_0001",
        "a b.JPG;1",
        "photo.jpg (2)",
        "photo.jpg.1",
        "pic.jpg_large",
        "x.jpg!d",
        "x.jpg?w=800",
        "x.jpg~",
    )
    passed_over = ("a.jpg.part", "a.thm", "notes.1", "README")
    for name in (*taken, *passed_over):
        (tmp_path / name).write_bytes(b"\xff\xd8\xff\xe0\0\x10JFIF\0")
    (tmp_path / "notes.1").write_text("for free use")
    (tmp_path / "README").write_text("BM is the start of a bitmap")
    (tmp_path / "empty").touch()
    os.mkfifo(tmp_path / "pipe")
    found = [os.path.basename(source.name) for source in collect_sources([str(tmp_path)], SUFFIXES)]
    assert found == sorted(taken)


def test_a_folder_without_pictures_is_a_reason_not_silence(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    [source] = collect_sources([str(tmp_path)], SUFFIXES)
    [result] = fake_decoder().results(source)
    assert result.status == "unreadable"
    assert str(tmp_path) in result.message
    assert "no picture" in result.message


@pytest.mark.parametrize(
    ("order", "statuses", "reason"),
    [
        ({"frames": 5, "fail_at": 3}, ["ok", "ok", "ok", "unreadable"], "breaks off in frame 3"),
        ({"bug_at": 0}, ["unreadable"], "internal error (ZeroDivisionError: a bug); run again with --verbose"),
        ({"frames": 0}, ["unreadable"], "holds no picture"),
    ],
)
def test_a_source_gives_everything_before_its_fault(
    tmp_path: Path, order: dict[str, int], statuses: list[str], reason: str
) -> None:
    sources = [write_order(tmp_path, "a.mp4", **order), write_order(tmp_path, "b.jpg")]
    *results, good = [result for _, found in decode_here(sources, fake_decoder()) for result in found]
    assert [result.status for result in results] == statuses
    assert results[-1].frame == len(statuses) - 1
    assert reason in str(results[-1].message)
    assert good.status == "ok"


def mixed(folder: Path) -> list[Source]:
    sources = [write_order(folder, f"{i:02}.jpg", sleep_s=0.02 * (i % 3)) for i in range(9)]
    sources.insert(2, write_order(folder, "clip.mp4", frames=6, sleep_s=0.02))
    sources.insert(4, write_order(folder, "cut.mp4", frames=4, fail_at=2))
    sources.append(Source(str(folder / "missing"), str(folder / "missing")))
    return sources


def test_worker_processes_give_what_one_gives_in_the_same_order(tmp_path: Path) -> None:
    sources = mixed(tmp_path)
    alone = lines(decode_here(sources, fake_decoder()))
    assert len(alone) == 9 + 6 + 3 + 1
    assert lines(decode_in_processes(sources, fake_decoder(), 3)) == alone


@pytest.mark.parametrize("n_workers", [2, 3])
def test_a_worker_that_dies_costs_nothing(tmp_path: Path, n_workers: int) -> None:
    sources = mixed(tmp_path)
    for place, (name, order) in enumerate((("a.mp4", {"frames": 4, "kill_at": 2}), ("b.jpg", {"kill_at": 0}))):
        sources.insert(2 * place, write_order(tmp_path, f"deadly-{name}", kills=1, **order))
    found = lines(decode_in_processes(sources, fake_decoder(), n_workers))
    assert len(list(tmp_path.glob("*.kills"))) == 2
    assert found == lines(decode_here(sources, fake_decoder()))


def test_a_source_that_ends_two_workers_costs_itself_only(tmp_path: Path) -> None:
    sources = mixed(tmp_path)
    deadly = write_order(tmp_path, "deadly.mp4", frames=3, kill_at=2)
    sources.insert(3, deadly)
    results = [result for _, found in decode_in_processes(sources, fake_decoder(), 2) for result in found]
    of_it = [result for result in results if result.source == deadly.name]
    # One frame late, as the fake receiver is, and none of them twice.
    assert [(result.frame, result.status) for result in of_it] == [(0, "ok"), (1, "unreadable")]
    assert "two processes that decoded it died, the last one was ended by SIGKILL" in str(of_it[-1].message)
    assert [result.retry for result in of_it] == [False, True]
    others = [to_json_line(result) for result in results if result.source != deadly.name]
    assert others == lines(decode_here([source for source in sources if source != deadly], fake_decoder()))


def test_wrong_options_end_a_run(tmp_path: Path) -> None:
    sources = mixed(tmp_path)
    for decoded in (
        decode_here(sources, fake_decoder(WRONG)),
        decode_in_processes(sources, fake_decoder(WRONG), 2),
    ):
        with pytest.raises(UsageError, match="make no sense"):
            lines(decoded)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("receiver.screen.find._PARTS", 6),
        ("receiver.search.settings.SETTINGS", msgspec.structs.replace(SETTINGS, plain=399.0)),
        ("receiver.light._MAX_MEMORY", 4),
        ("link.beacons._TRY_UP_TO", 0.1),
    ],
)
def test_a_changed_threshold_shows_in_the_provenance(name: str, value: object, monkeypatch: pytest.MonkeyPatch) -> None:
    before = settings_in_force()
    assert before == settings_in_force()
    monkeypatch.setattr(f"rxcli.{name}", value)
    assert settings_in_force() != before


def write_journal(path: Path, names: str) -> bytes:
    """A journal of one frame per letter of `names`, of which the decoder of `d` was killed."""
    journal = Journal(path)
    made = Lines(journal.append, Head("1", {"cae": "auto"}), {})
    found = [replace(unreadable(Source(name, name), n, "why"), status="ok") for n, name in enumerate(names)]
    for result, following in zip(found, [*found[1:], None], strict=True):
        made.begin(result.source)
        last = following is None or following.source != result.source
        made.write(replace(result, retry=result.source == "d"), last)
    journal.close()
    return path.read_bytes()


@pytest.mark.parametrize("zeros", [0, 5000])
@pytest.mark.parametrize("cut", range(0, 60, 7))
def test_recover_drops_a_half_line_and_the_source_it_belongs_to(tmp_path: Path, cut: int, zeros: int) -> None:
    """A machine that stops may leave zeros behind the half line."""
    path = tmp_path / "out.jsonl"
    whole = write_journal(path, "aabccc")
    path.write_bytes(whole[: len(whole) - cut] + bytes(zeros))
    n_kept = 3 if cut else 6
    journal = Journal(path, resume=True)
    whole_sources = [("a", 2), ("b", 1), ("c", 3)][: n_kept // 3 + 1]
    assert [(name, len(found)) for name, found in journal.recover()] == whole_sources
    journal.close()
    assert path.read_bytes() == b"".join(whole.splitlines(True)[:n_kept])


@pytest.mark.parametrize("names", ["aadccc", "daac", "aacd", "d", "adc"])
def test_recover_leaves_out_sources_whose_decoder_was_killed(tmp_path: Path, names: str) -> None:
    """`d` is to be tried again; the others stay as they are, behind what the first line says of the run."""
    path = tmp_path / "out.jsonl"
    write_journal(path, names)
    kept = [name for name in dict.fromkeys(names) if name != "d"]
    journal = Journal(path, resume=True)
    assert [name for name, _ in journal.recover()] == kept
    records = [json.loads(line) for line in path.read_text().splitlines()]
    assert [record["source"] for record in records] == [name for name in names if name != "d"]
    assert ["run" in record for record in records] == [place == 0 for place in range(len(records))]
    with pytest.raises(UsageError, match="another run"):
        Journal(path, resume=True)
    journal.append("more")
    journal.close()
    assert path.read_text().endswith("more\n")
    assert [path.name for path in tmp_path.iterdir()] == ["out.jsonl"]


@pytest.mark.parametrize(("order", "line"), [([0, 1, 2, 0, 1], 4), ([0, 2, 1], 2), ([3, 0, 3], 5), ([2, 3, 3], 5)])
def test_recover_refuses_a_file_in_which_a_source_stands_twice(tmp_path: Path, order: list[int], line: int) -> None:
    """Or in turns with another one: its packets would count twice."""
    path = tmp_path / "out.jsonl"
    lines = write_journal(path, "aabccc").splitlines(True)
    parts = [lines[0], lines[1], lines[2], b"".join(lines[3:])]
    run = json.loads(lines[0])["run"]
    edited = b"".join(parts[number] for number in order).splitlines(True)
    edited[0] = json.dumps({**json.loads(edited[0]), "run": run}).encode() + b"\n"
    path.write_bytes(b"".join(edited))
    with (
        closing(Journal(path, resume=True)) as journal,
        pytest.raises(UsageError, match="stand in two places") as found,
    ):
        list(journal.recover())
    assert f"line {line}: " in str(found.value)
    assert path.read_bytes() == b"".join(edited)


@pytest.mark.parametrize("text", ["hello\nworld\n", "hello", "{}\n", '[1, 2]\n{"source": 3}\n', "null\n"])
def test_recover_leaves_a_foreign_file_alone(tmp_path: Path, text: str) -> None:
    path = tmp_path / "letter.txt"
    path.write_text(text)
    with closing(Journal(path, resume=True)) as journal, pytest.raises(UsageError, match="line 1"):
        list(journal.recover())
    assert path.read_text() == text


def test_a_journal_is_not_written_through_a_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither one that is there, nor one that is put there after the last look."""
    path, victim = tmp_path / "out.jsonl", tmp_path / "victim"
    victim.write_text("mine")
    path.symlink_to(victim)
    with pytest.raises(UsageError, match="is a link"):
        Journal(path)
    monkeypatch.setattr(Path, "is_symlink", lambda _: False)
    with pytest.raises(UsageError, match="cannot be written"):
        Journal(path)
    assert victim.read_text() == "mine"


def test_a_journal_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="cannot be written"):
        Journal(tmp_path / "no such folder" / "out.jsonl")
    full = Journal(Path("/dev/full"))
    with pytest.raises(InputError, match="No space left"):
        full.append("a line")
    full.close()
