"""The shipped captures decode to the same results in any order and with any number of workers."""

import json
from pathlib import Path

from rxcli.cli.main import run
from rxcli.errors import ExitCode
from rxcli.resources import data_dir

SAMPLES = ("phone_chelsea_17k3.jpg", "video1080_chelsea_17k3.mp4", "xtrans_sky_17k3.dng")


def test_results_depend_on_neither_order_nor_workers_nor_earlier_runs(tmp_path: Path) -> None:
    """Byte for byte, but for the times: in two orders in one process, and with two workers."""
    samples = [str(data_dir("sample_frames") / name) for name in SAMPLES]
    results = []
    for number, (order, workers) in enumerate([(samples, 1), (samples[::-1], 1), (samples, 2)]):
        out = tmp_path / f"{number}.jsonl"
        assert run(["decode", *order, "--json", str(out), "--quiet", "--workers", str(workers)]) == ExitCode.OK
        lines = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
        assert lines[0].pop("run")  # the options, with the first line of a file
        assert all(line.pop("timing_ms") for line in lines)
        by_source = {source: [line for line in lines if line.get("source") == source] for source in samples}
        results.append(json.dumps(by_source))
    assert {len(json.loads(result)[samples[1]]) for result in results} == {24}
    assert len(set(results)) == 1
