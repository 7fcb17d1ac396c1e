"""The benchmark: ways to receive, the runner and its journal, measures, tables, and the commands."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from small_frames import write_frame, write_profiles

from rxcli.cli.benchmark import benchmark
from rxcli.cli.main import run
from rxcli.errors import ExitCode, InputError, ReceiverError, UsageError
from rxcli.ingest import open_source
from rxcli.lab.benchmark import cases, compare, measures, quick, runner, tables
from rxcli.lab.benchmark.cases import Case, received
from rxcli.lab.benchmark.draw import Place, binned, draw_nodata
from rxcli.lab.benchmark.measures import Group, cluster_interval, wilson
from rxcli.lab.benchmark.media import bare_decode, write_known
from rxcli.lab.benchmark.runner import Run, Task, do, labels_by_field, load_journal, scenarios
from rxcli.lab.benchmark.trial import Trial, simulate_trial
from rxcli.lab.simulate.scenes import preset
from rxcli.options import receiver_options
from rxcli.receiver.receive import receive
from rxcli.types import FrameResult


@pytest.fixture(scope="module")
def easy() -> Trial:
    """A plain picture, plenty of light, a camera that is held straight."""
    scene = preset("xs10-still", "paper-17k3")
    pose = replace(scene.pose, roll_deg=0.0, yaw_deg=0.0, pitch_deg=0.0)
    return simulate_trial(replace(binned(scene, 0.07), picture="sky", pose=pose), 3, oracle=True)


def case_of(trial: Trial, **changes: Any) -> Case:
    case = Case(source=(trial.frame,), options=trial.options(), about={}, truth=trial.truth, corners=trial.corners)
    return replace(case, trials=(trial,), **changes)


# Ways.


def test_bound_and_paper_read_an_easy_frame(easy: Trial) -> None:
    records = {way: received(case_of(easy), way) for way in ("receiver", "bound", "paper")}
    scores = {way: record["score"] for way, record in records.items()}
    assert all(record["problems"] == [] for record in records.values())
    assert scores["receiver"]["expected"] == scores["bound"]["error_free"] == scores["bound"]["expected"] > 0
    assert scores["receiver"]["error_free"] == scores["bound"]["error_free"]
    assert scores["paper"]["error_free"] > 0.5 * scores["paper"]["expected"]


def test_grey_levels_that_nobody_sees_change_no_packet(easy: Trial) -> None:
    case = case_of(easy)
    whole, changed = (received(case, way) for way in ("receiver", "grey levels"))
    assert changed["problems"] == []
    assert measures.reported_payloads(changed) == measures.reported_payloads(whole) != set()
    frame = easy.frame
    step = cases.with_grey_levels(frame).pixels.astype(int) - frame.pixels.astype(int)
    assert np.abs(step).max() == 1
    assert np.abs(step).mean() == pytest.approx(0.01, rel=0.1)


def test_another_kernel_is_another_processs(easy: Trial) -> None:
    here, there = (received(case_of(easy), way) for way in ("receiver", cases.OTHER_KERNEL))
    assert (here["kernel"], there["kernel"]) == (os.environ.get("OPENBLAS_CORETYPE"), cases.KERNEL)
    assert there["score"]["error_free"] == there["score"]["expected"]


def test_the_command_receives_the_same_and_its_start_counts(tmp_path: Path) -> None:
    payloads, names = write_frame(tmp_path / "a.png", 3), write_profiles(tmp_path)
    corners = np.array([[float(part) for part in text.split(",")] for text in names[5:]])
    options = replace(receiver_options(names[1], names[3]), corners=corners)
    case = Case(source=(tmp_path / "a.png",), options=options, about={})
    here, command = (received(case, way) for way in ("receiver", "command"))
    for record in (here, command):
        assert [packet["payload"] for packet in record["packets"]] == payloads
    assert command["cpu_s"] > here["cpu_s"] + 0.1
    row = measures.rows(
        [{"groups": [], "has_data": True, "ways": {"command": command}}] * 2, ["command"], ["packets_each"]
    )
    assert row[-1]["packets_each"] == len(payloads)


def test_what_a_reception_raises_warns_or_says_wrongly_is_a_problem(
    easy: Trial, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_case: Case) -> list[FrameResult]:
        np.divide(np.ones(1), np.zeros(1))
        raise ValueError("out of order")

    monkeypatch.setitem(cases.WAYS, "broken", broken)
    monkeypatch.setitem(cases.WAYS, "mute", lambda _case: [FrameResult("", 0, float("nan"), "ok")])
    record = received(case_of(easy), "broken")
    assert record["problems"][0] == "ValueError: out of order"
    assert "divide by zero" in record["problems"][1]
    assert received(case_of(easy), "mute")["problems"] == ["result.time_s holds NaN", "neither columns nor message"]


def test_numbers_of_columns_and_corners_are_compared(easy: Trial) -> None:
    (result,) = receive([easy.frame], easy.options())
    moved = replace(result, columns=tuple(replace(c, column=c.column + 2) for c in result.columns))
    assert (cases.column_shift(result, easy.truth), cases.column_shift(moved, easy.truth)) == (0, 2)
    doubtful = replace(result, column_certainty=0.4, column_offset=None)
    assert {"numbered": False, "certainty": 0.4}.items() <= cases._found(doubtful, case_of(easy)).items()
    truth = np.array([[0.0, 0], [100, 0], [100, 60], [0, 60]])
    found = np.roll(truth + np.array([[0, 0], [0, 3], [0, 0], [0, 1]]), 2, axis=0)
    assert cases.corner_error(found, truth) == pytest.approx(0.03)


@pytest.mark.parametrize("suffix", [".jpg", ".dng", ".mp4"])
def test_the_bare_decode_counts_frames(suffix: str, tmp_path: Path) -> None:
    name = "xs10-still" if suffix == ".dng" else "video-1080p"
    scene = preset(name, "paper-17k3").scaled(0.2, 0.2, keep_readout=True)
    path = tmp_path / f"small{suffix}"
    write_known(replace(scene, n_frames=3 if suffix == ".mp4" else 1), path, 0)
    decode = bare_decode(path)
    assert decode() == (3 if suffix == ".mp4" else 1)
    (tmp_path / "a.txt").write_text("text")
    assert bare_decode(tmp_path / "a.txt") is None


# Runner.


def _double(task: Task) -> list[dict[str, Any]]:
    _calls.append(task["n"])
    return [{"twice": 2 * task["n"]}]


_calls: list[int] = []


def test_an_interrupted_run_goes_on(tmp_path: Path) -> None:
    _calls.clear()
    path = tmp_path / "journal.jsonl"
    tasks: list[Task] = [{"n": n} for n in range(4)]
    Run(path, quiet=True)(tasks[:3], "double", work=_double)
    with path.open("a") as file:
        file.write('{"key": "half a li')  # as a killed process leaves it
    records = Run(path, quiet=True)(tasks, "double", work=_double)
    assert [record["twice"] for record in records] == [0, 2, 4, 6]
    assert _calls == [0, 1, 2, 3]
    assert len(load_journal(path)) == 4
    path.write_text("no journal\n")
    with pytest.raises(InputError, match="line 1 is no journal entry"):
        load_journal(path)


@pytest.mark.slow
def test_workers_end_with_the_processes_that_they_started(tmp_path: Path) -> None:
    command = ["benchmark", "stability", "--only", "all named", "--count", "2", "--jobs", "2", "--quiet"]
    command += ["--way", cases.OTHER_KERNEL, "--out", str(tmp_path)]  # the way that starts a process
    done = subprocess.run([sys.executable, "-m", "rxcli.cli.main", *command], timeout=120, check=False)
    assert done.returncode == 0
    assert len(load_journal(tmp_path / "stability.journal.jsonl")) == 2


def test_a_picture_without_data_that_gave_packets_does_not_pass(tmp_path: Path) -> None:
    drawn = draw_nodata(Place(2, 1, {}, tmp_path))
    case = next(drawn)  # its files lie there as long as `drawn`
    ways = {"receiver": received(case, "receiver")}
    record = {"groups": ["noise"], "about": case.about, "has_data": False, "ways": ways}
    assert measures.passes([record], ["receiver"])
    assert measures.worth_a_look([record], ["receiver"]) == []
    packet = {"confidence": 0.4, "bit_errors": 35, "frame": 0, "column": 2, "payload": "ab"}
    gave = {**record, "ways": {"receiver": {**record["ways"]["receiver"], "packets": [packet]}}}
    assert not measures.passes([record, gave], ["receiver"])
    assert [row["packets"] for row in measures.worth_a_look([record, gave], ["receiver"])] == [1]


def test_a_transfer_is_byte_exact() -> None:
    scenario = scenarios()["goodput"]
    (record,) = do(scenario.tasks(1, 1, Path())[0])
    (row, _) = measures.rows([record], scenario.ways, scenario.columns)
    assert (row["n"], row["exact"]) == (1, 1)
    assert 0 < row["of_visible"] < 1
    assert row["kbps_worst"] == pytest.approx(0.8 / row["s_worst"])


# Measures.


def _record(group: str = "", packets: tuple[tuple[float, int], ...] = (), **changes: Any) -> dict[str, Any]:
    """A case of four rows a slot, received in two ways; the other one reports nothing."""
    listed = [
        {"confidence": c, "bit_errors": e, "frame": 0, "column": n, "payload": "00", "evidence": [1.0, c]}
        for n, (c, e) in enumerate(packets)
    ]
    score = {"expected": 10, "bits": 770, "error_free": 8, "bit_errors": 5, "lost": 1, "lost_bits": 77, "false": 1}
    reception = {"packets": listed, "score": score, "status": "ok", "problems": [], "cpu_s": 2.0, **changes}
    other = {"packets": [], "score": {**score, "error_free": 10}, "status": "ok", "problems": [], "cpu_s": 1.0}
    about = {"rows_per_slot": 4.0}
    return {"about": about, "has_data": True, "groups": [group], "ways": {"receiver": reception, "bound": other}}


def test_groups_ways_and_packets_are_counted() -> None:
    records = [
        _record("a", ((0.95, 0), (0.999, 3), (0.5, 1)), shift=1, numbered=True, rows_per_slot=(4.0015, 0.001)),
        _record("b", status="no_screen", shift=2, numbered=False),
    ]
    of_rows = ("rows_within", "rows_none", "rows_wild", "in_1_sd", "in_2_sd")
    columns = ["n", "right", "share", "ber", "likely", "likely_wrong", "sure", "surely_wrong", "changed"]
    columns += ["not_found", "of_shown", "numbered_wrong", "target", *of_rows]
    table = measures.rows(records, ["receiver", "bound"], columns, "bound")
    assert [(row["scenes"], row["way"]) for row in table[::2]] == [(n, "receiver") for n in ("a", "b", "all")]
    whole, bound = table[-2:]
    assert (whole["n"], whole["right"], whole["share"]) == (2, 16, 0.8)
    assert whole["ber"] == pytest.approx((5 + 77 / 2) / 770)
    low, high = measures.MEASURES["ber95"](Group(records, "receiver", "receiver"))
    assert low < whole["ber"] < high
    assert (whole["likely"], whole["sure"], whole["surely_wrong"], bound["changed"]) == (3, 1, 1, 3)
    assert whole["likely_wrong"] == 2
    assert (whole["not_found"], whole["of_shown"], whole["numbered_wrong"]) == (1, 2, 1)
    assert [whole[name] for name in of_rows] == [1, 1, 0, 0, 1]
    assert "target" not in whole


def test_packets_are_compared_with_those_of_the_first_row() -> None:
    score = {"expected": 4, "error_free": 4}
    records = [_record("none"), _record("none"), _record("effect")]
    for record, right in zip(records, (4, 2, 1), strict=True):
        record["ways"]["receiver"]["score"] = {**score, "error_free": right}
    table = measures.rows(records, ["receiver"], ("n", "of_plain"))
    assert [row["of_plain"] for row in table[:2]] == pytest.approx([1, 1 / 3])


def test_stages_are_columns_as_ratios_to_the_bare_decode() -> None:
    records = [
        _record(wall_s=wall, stages_ms={"detect": 1e3 * wall, "total": 2e3 * wall})
        | {"bare_wall_s": 0.5, "n_frames": 1}
        for wall in (3.0, 2.0)
    ]
    row = measures.rows(records, ["receiver"], ["total_ms", "stages"])[-1]
    assert row == {"scenes": "all", "way": "receiver", "total_ms": 2000.0, "detect": 4.0}


def test_bins_show_calibration() -> None:
    rng = np.random.default_rng(3)
    confidence = rng.random(6000)
    right = rng.random(6000) < confidence
    packets = [{"confidence": c, "bit_errors": int(not r)} for c, r in zip(confidence, right, strict=True)]
    bins, error = measures.calibration(packets)
    assert sum(row["packets"] for row in bins) == 6000
    assert sum(row["calibrated"] for row in bins) >= 8
    assert error < 0.02
    too_sure = [{**packet, "confidence": packet["confidence"] ** 0.3} for packet in packets]
    bins, error = measures.calibration(too_sure)
    assert sum(bool(row["calibrated"]) for row in bins) <= 3
    assert error > 0.2


def test_weights_of_features_are_found_again() -> None:
    rng = np.random.default_rng(7)
    terms = np.concatenate([np.ones((8000, 1)), rng.normal(size=(8000, 2))], axis=1)
    weights = np.array([0.5, 1.5, -0.8])
    right = rng.random(8000) < 1 / (1 + np.exp(-terms @ weights))
    packets = [{"evidence": t, "bit_errors": int(not r)} for t, r in zip(terms.tolist(), right, strict=True)]
    assert measures.fitted_weights([*packets, {"evidence": [1.0, 2.0], "bit_errors": 0}]) == {
        3: pytest.approx(weights, abs=0.1)
    }


def test_wilson_agrees_with_published_values() -> None:
    # Newcombe, Stat. Med. 17, 857 (1998), table I, method 3.
    assert wilson(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert wilson(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert (wilson(0, 0), wilson(20, 20)[1]) == ((0.0, 1.0), 1.0)


def test_clusters_widen_the_interval() -> None:
    equal = cluster_interval([5.0] * 8 + [6.0] * 8, [100.0] * 16, units=16)
    clustered = cluster_interval([0.0] * 14 + [44.0] * 2, [100.0] * 16, units=16)
    assert equal == pytest.approx(wilson(88, 1600))
    assert clustered[1] - clustered[0] > 3 * (equal[1] - equal[0])
    assert cluster_interval([0.0, 0.0], [1000.0, 1000.0], units=20) == wilson(0, 20)
    assert cluster_interval([], [], units=0) == (0.0, 1.0)


def test_tables_align_survive_csv_and_are_plotted(tmp_path: Path) -> None:
    rows = [{"name": "a", "rate": 0.00012345, "range": (0.0, 0.5)}, {"name": "bcd", "rate": None, "range": (0.25, 1.0)}]
    lines = tables.as_text(rows).splitlines()
    assert [line.split() for line in lines[1:]] == [["a", "0.000123", "0..0.5"], ["bcd", "-", "0.25..1"]]
    table = tables.to_csv(rows).splitlines()
    assert table == ["name,rate,range_low,range_high", "a,0.00012345,0.0,0.5", "bcd,,0.25,1.0"]
    assert tables.as_text([]) == "(nothing to show)"
    pytest.importorskip("matplotlib")
    rows = [{"scenes": s, "way": w, "ber": 0.01, "ber95": (0.0, 0.1)} for s in "ab" for w in ("receiver", "bound")]
    tables.plot(rows, tmp_path / "ber.png", "ber", "ber95")
    assert (tmp_path / "ber.png").read_bytes().startswith(b"\x89PNG")


def test_error_against_run_time_of_files_is_drawn(tmp_path: Path) -> None:
    cases = [_record("sky"), _record("sea")]
    for case, seconds in zip(cases, (0.5, 2.0), strict=True):
        case["ways"]["receiver"]["cpu_s"] = seconds
    points = measures.error_over_time(cases, ["receiver"])
    ber = pytest.approx((5 + 77 / 2) / 770)
    assert points == {"receiver": [(0.5, ber), (2.0, ber)]}
    pytest.importorskip("matplotlib")
    png, svg = tables.plot_error_over_time(points, tmp_path / "files")
    assert png.read_bytes().startswith(b"\x89PNG")
    assert "<svg" in svg.read_text()


def test_files_are_counted_over_a_field_in_its_order(tmp_path: Path) -> None:
    for name in ("a.png", "b.png", "c.png"):
        write_frame(tmp_path / name, 1)
    with pytest.raises(UsageError, match=r"a\.png: neither a CSV beside it nor its metadata states 'distance_m'"):
        labels_by_field(["a.png"], tmp_path, "distance_m")
    (tmp_path / "f.csv").write_text("file,distance_m,light\na.png,10,lamp\nb.png,9.5,sun\nc.png,9.5,lamp\n")
    assert labels_by_field(["a.png", "b.png", "c.png"], tmp_path, "distance_m") == {
        "b.png": "distance_m 9.5",
        "c.png": "distance_m 9.5",
        "a.png": "distance_m 10",
    }
    assert list(labels_by_field(["b.png", "a.png"], tmp_path, "light").values()) == ["light lamp", "light sun"]
    assert labels_by_field(["a.png"], tmp_path, "orientation") == {"a.png": "orientation 1"}


def test_lost_packets_and_goodput_have_intervals() -> None:
    still, clip = _record("sky"), _record("sea")
    clip["ways"]["receiver"]["seconds"] = 0.5
    row = measures.rows([still, clip], ["receiver"], ["lost_share", "lost_share95", "kbps", "kbps95"])[-1]
    score = clip["ways"]["receiver"]["score"]
    kbps = score["bits"] / 500
    assert row["kbps"] == pytest.approx(kbps * score["error_free"] / score["expected"])
    assert row["kbps95"][0] < row["kbps"] < row["kbps95"][1] < kbps
    assert row["lost_share"] == pytest.approx(score["lost"] / score["expected"])
    assert row["lost_share95"][0] < row["lost_share"] < row["lost_share95"][1]
    assert "kbps" not in measures.rows([still], ["receiver"], ["kbps", "kbps95"])[-1]


def test_shares_of_a_way_without_another_are_left_out() -> None:
    (row, _) = measures.rows([_record("sky")], ["receiver"], ["right", "share", "share95"])
    assert not row.keys() & {"share", "share95"}
    (row, _) = measures.rows([_record("sky")], ["receiver"], ["right", "share", "share95"], "receiver")
    assert row["share"] == 1


def test_the_headline_puts_receiver_and_yardsticks_beside_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = _record("sky") | {"bare_wall_s": 0.1, "bare_cpu_s": 0.1, "n_frames": 1}
    record["ways"] = dict.fromkeys(("receiver", "bound", "paper", "two threads"), record["ways"]["receiver"])
    record["ways"] = {way: some | {"wall_s": 0.2, "cpu_s": 0.3} for way, some in record["ways"].items()}
    monkeypatch.setattr(quick, "start_times", lambda _: {"bare python": 20.0})
    (_, errors), (_, times), (_, checks) = quick.run(lambda *_: [record, record], 0, tmp_path)  # type: ignore[arg-type]
    assert [(row["scenes"], row["way"], row["right"]) for row in errors] == [
        ("sky", way, 16) for way in ("receiver", "bound", "paper")
    ]
    assert all(row["ber"] == pytest.approx((5 + 77 / 2) / 770) for row in errors)
    assert (times[0]["over_bare_wall"], times[0]["over_bare"]) == (pytest.approx(2), pytest.approx(3))
    assert checks == [{"check": "20 random scenes", "result": "ok"}, {"check": "bare python", "result": "20 ms"}]


# Commands.


def test_a_scenario_writes_table_and_journal(tmp_path: Path) -> None:
    arguments = ["phones", "--count", "1", "--seed", "905", "--cae", "never", "--out", str(tmp_path), "--quiet"]
    result = CliRunner().invoke(benchmark, arguments)
    assert result.exit_code == 0, result.output
    row = json.loads((tmp_path / "phones.json").read_text())["rows"][-1]
    assert (row["scenes"], row["n"], row["expected"]) == ("all", 1, 20)
    assert row["right"] >= 5
    assert (tmp_path / "phones.journal.jsonl").read_text().count("\n") == 1


@pytest.mark.parametrize(
    ("more", "files"),
    [
        ({}, ["3-slots-2-0-0.jpg"]),
        ({"cameras": ["video-1080p"], "n_frames": 2}, ["3-slots-2-0-0.mp4"]),
        ({"photos": 2, "text_bytes": 6}, ["3-slots-2-0-0-0.jpg", "3-slots-2-0-0-1.jpg"]),
    ],
)
def test_drawn_captures_are_saved_with_all_that_is_known(
    more: dict[str, Any], files: list[str], tmp_path: Path
) -> None:
    point = {"screens": ["paper-8k65"], "exposure_slots": [3.0, 3.0], "width_px": [160, 160], "rows": [0.3, 0.3]} | more
    task = {"draw": "people", "ways": ["bound"], "seed": 2, "number": 0, "folder": str(tmp_path), "cae": None}
    (record,) = do({**task, "label": "3 slots", "point": point, "save": str(tmp_path)})
    known = json.loads((tmp_path / "3-slots-2-0-0.case.json").read_text())
    assert known["files"] == files
    assert len(known["text"] or "") == more.get("text_bytes", 0)
    assert record["about"]["exposure_slots"] == pytest.approx(3)
    assert (record["ways"]["bound"]["score"]["error_free"] > 0) == ("n_frames" not in more)
    for file in files:
        truth = json.loads((tmp_path / file).with_suffix(".truth.json").read_text())
        assert truth["corners_sensor_px"]
        assert truth["camera"]["exposure_s"] == pytest.approx(3 / 8650, rel=1e-3)
    assert run(known["named"]) in (ExitCode.OK, ExitCode.NOT_RECEIVED)


@pytest.mark.parametrize("camera", [{}, {"cameras": ["phone-video"], "n_frames": 3}])
def test_texts_that_arrive_are_counted(camera: dict[str, Any], tmp_path: Path) -> None:
    """Easy captures of a screen that sends a text."""
    easy = {"exposure_slots": [0.6, 0.6], "readout_s": [0.03, 0.03], "aim": 0.0, "lighted": 0.0, "width_px": [600, 600]}
    point = {"screens": ["data-8k65"], "text_bytes": 4, **easy, **camera}
    task = {"draw": "people", "ways": ["camera and corners given"], "seed": 2, "number": 1, "cae": "never"}
    (record,) = do({**task, "folder": str(tmp_path), "label": "", "point": point})
    (row, *_) = measures.rows([record], task["ways"], ("n", "texts", "texts_wrong"))
    assert (row["texts"], row["texts_wrong"]) == (1, 0)


def test_packets_of_earlier_journals_are_in_the_bins(tmp_path: Path) -> None:
    earlier = tmp_path / "earlier.jsonl"
    earlier.write_text(json.dumps({"key": "x", "records": [_record(packets=((0.95, 0), (0.95, 1)))]}) + "\n")
    arguments = ["confidence", "--only", "many rows", "--count", "1", "--seed", "5", "--quiet"]
    arguments += ["--out", str(tmp_path / "out")]
    alone, both = (CliRunner().invoke(benchmark, [*arguments, *more]) for more in ((), ("--also", str(earlier))))
    assert alone.exit_code == both.exit_code == 0, both.output
    counts = [int(result.output.split(" packets, ")[0].split()[-1]) for result in (alone, both)]
    assert counts[1] == counts[0] + 2


def test_a_way_alone_is_compared_with_none(tmp_path: Path) -> None:
    arguments = ["sweep-light", "--only", "x 1", "--way", "paper", "--count", "1", "--out", str(tmp_path), "--quiet"]
    assert CliRunner().invoke(benchmark, arguments).exit_code == 0
    assert "share" not in json.loads((tmp_path / "sweep-light.json").read_text())["rows"][0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sweep-light", "--only", "nope"], "is not one of x 0.01"),
        (["phones", "--way", "nope"], "is not one of receiver"),
        (["compare", ".", "nope"], "is no scenario"),
        (["--quick", "confidence"], "stands alone"),
        (["films", "--set", "exposure_slots=nope"], "exposure_slots"),
        (["films", "--set", 'films=["nope"]'], "films"),
        (["films", "--set", "?"], "not FIELD=VALUE"),
        (["films", "--over", "distance"], "receives no files"),
        (["speed", "--set", "n_frames=3"], "draws no population"),
    ],
)
def test_mistakes_are_told(arguments: list[str], message: str) -> None:
    result = CliRunner().invoke(benchmark, arguments)
    assert result.exit_code == 2 or isinstance(result.exception, UsageError)
    assert message in result.output + str(result.exception)


def test_films_twins_and_photographs_stand_in_one_table(tmp_path: Path) -> None:
    small = ["width_px=[240,240]", "rows=[0.25,0.25]", "n_frames=2", "exposure_slots=[1,1]", 'screens=["paper-8k65"]']
    small += ["named=true"]  # else the screen is searched, in vain
    arguments = ["films", "--only", "pan", "--count", "1", "--seed", "3", "--quiet", "--out", str(tmp_path / "out")]
    arguments += [part for field in small for part in ("--set", field)]
    assert CliRunner().invoke(benchmark, [*arguments, "--save", str(tmp_path / "saved")]).exit_code in (0, None)
    rows = json.loads((tmp_path / "out" / "films.json").read_text())["rows"]
    assert [row["way"] for row in rows if row["scenes"] == "up to 1.5 slots"] == ["receiver", "twin", "photographs"]
    assert all(row["problems"] == 0 for row in rows)
    names = {path.name for path in (tmp_path / "saved").glob("*.mp4")}
    assert names == {"pan-3-0-0.mp4", "pan-3-0-0-twin.mp4"}


def test_pictures_without_data_are_saved_with_their_truth(tmp_path: Path) -> None:
    arguments = ["nodata", "--count", "1", "--seed", "3", "--way", "bound", "--quiet", "--out", str(tmp_path / "out")]
    assert CliRunner().invoke(benchmark, [*arguments, "--save", str(tmp_path / "saved")]).exit_code in (0, None)
    truth = json.loads(next((tmp_path / "saved").glob("*.truth.json")).read_text())
    assert isinstance(truth["frames"][0]["start_slot"], float)


# Two checkouts.


@pytest.mark.parametrize(
    ("after", "difference"),
    [
        ({"a": [1, 2.5]}, None),
        ({"a": [1, 2.5000001]}, "[0].a[1]: 2.5 -> 2.5000001"),
        ({"a": [1, 2.5], "b": 2}, "[0].b: null -> 2"),
        ({"a": [1]}, "[0].a: [1, 2.5] -> [1]"),
        ({"a": [True, 2.5]}, "[0].a[0]: 1 -> true"),
    ],
)
def test_the_first_difference_is_named(after: Any, difference: str | None) -> None:
    assert next(compare.differences("", [{"a": [1, 2.5]}], [after]), None) == difference


def test_a_checkout_that_breaks_off_is_told(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no checkout of this project"):
        compare.check_checkout(tmp_path)
    package = tmp_path / "rxcli" / "cli"
    package.mkdir(parents=True)
    for folder in (package.parent, package):
        (folder / "__init__.py").touch()
    (package / "main.py").write_text("raise RuntimeError('out of order')\n")
    with pytest.raises(ReceiverError, match="out of order"):
        compare.compare([], compare.check_checkout(tmp_path), tmp_path, 1, lambda: None)


def test_frames_without_data_are_compared_as_a_clip(tmp_path: Path) -> None:
    (path,), *_ = (
        cases.write_case(case, tmp_path / "case") for case in draw_nodata(Place(3, 0, {"n_frames": 3}, tmp_path))
    )
    assert len(list(open_source(path))) == 3


def test_a_changed_receiver_is_found_out(tmp_path: Path) -> None:
    """A copy of this checkout that rounds confidences differently, on one random scene."""
    here, other = runner.CHECKOUT, tmp_path / "other"
    for name in ("rxcli", "calibration", "models"):
        shutil.copytree(here / name, other / name, ignore=shutil.ignore_patterns("__pycache__"))
    arguments = ["compare", str(other), "confidence", "--count", "1", "--repeats", "1", "--seed", "9"]
    arguments += ["--only", "many rows", "--out", str(tmp_path / "out"), "--quiet"]
    same = CliRunner().invoke(benchmark, arguments, standalone_mode=False)
    assert same.return_value == 0, same.output
    record = other / "rxcli" / "results" / "record.py"
    text = record.read_text()
    assert '"confidence": 6' in text
    record.write_text(text.replace('"confidence": 6', '"confidence": 1'))
    changed = CliRunner().invoke(benchmark, arguments, standalone_mode=False)
    assert changed.return_value == 1, changed.output
    assert "confidence: " in changed.output
    *_, before, after = json.loads((tmp_path / "out" / "compare.json").read_text())["rows"]
    assert (after["n"], after["same"], after["packets"]) == (1, 0, before["packets"])
