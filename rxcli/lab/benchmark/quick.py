"""The headline: error beside both yardsticks, run time beside the bare decode, and stability, in three minutes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rxcli.lab.benchmark import speed, stability, sweeps
from rxcli.lab.benchmark.journal import Run
from rxcli.lab.benchmark.tables import Row

#: Frames of each point, and runs whose median counts.
_FRAMES, _REPEATS = 2, 3
#: Random scenes that are received under watch.
_SCENES = 20
#: Easy ones, a hard picture, and a phone that nobody has measured.
_MEDIA = ("jpeg-26mp", "raw-26mp", "jpeg-26mp-hard", "jpeg-12mp-unknown")


def points() -> list[sweeps.Point]:
    """The paper's three rates on its two pictures, a dim photo, a phone and a clip."""
    paper = [point for point in sweeps.SWEEPS["rate"] if point.slot_rate_hz <= 34600]
    dim = replace(sweeps.SWEEPS["picture"][0], picture="coffee", light=0.3, label="coffee x 0.3")
    cameras = [p for p in sweeps.SWEEPS["camera"] if p.camera in ("phone-corrected", "video-4k")]
    return [*paper, dim, *cameras]


def run(folder: Path, how: Run) -> list[tuple[str, list[Row]]]:
    """Measure the headline: titles and tables; the media that are timed lie in `folder`."""
    errors = error_rows(sweeps.run(points(), _FRAMES, how))
    verdict = stability.run(_SCENES, how)
    return [
        ("bit error rate, lost packets included: receiver, bound, the paper's pipeline", errors),
        (
            "time on two threads, of the wall and of the processor, against the bare decode on one",
            _time_rows(folder, how.seed),
        ),
        ("checks", _check_rows(verdict)),
    ]


def error_rows(summaries: Sequence[sweeps.Summary]) -> list[Row]:
    """One row a point: error of the receiver and of both yardsticks."""
    table = []
    for point in dict.fromkeys(summary.point for summary in summaries):
        mine = {summary.method: summary for summary in summaries if summary.point == point}
        receiver = mine["receiver"]
        table.append(
            {
                "scene": point.label,
                "kb/s": point.rate_kbps,
                "packets": receiver.score.expected,
                "receiver": receiver.score.ber,
                "receiver95": receiver.ber_interval,
                "bound": mine[sweeps.BOUND].score.ber,
                "paper": mine[sweeps.PAPER].score.ber,
                "error_free": receiver.score.error_free,
                "false": receiver.score.false,
            }
        )
    return table


def _time_rows(folder: Path, seed: int) -> list[Row]:
    table = []
    for medium in (medium for medium in speed.MEDIA if medium.name in _MEDIA):
        timing = speed.time_medium(medium, speed.make_medium(medium, folder, seed), 2, _REPEATS)
        table.append(
            {
                "medium": medium.name,
                "bare_ms": timing.bare_ms,
                "total_ms": timing.total_ms,
                "ratio": timing.ratio,
                "cpu_ratio": timing.total_cpu_ms / timing.bare_cpu_ms,
                "target": speed.TARGETS[medium.name],
                "status": timing.status,
            }
        )
    return table


def _check_rows(verdict: stability.Verdict) -> list[Row]:
    start = speed.start_times(3)
    return [
        *({"check": row["check"], "result": row["result"]} for row in stability.rows(verdict)),
        *({"check": name, "result": f"{ms:.0f} ms"} for name, ms in start.items()),
    ]
