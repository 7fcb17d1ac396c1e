"""What is counted of receptions: one table of measures for all scenarios."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import sqrt
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rxcli.lab.benchmark.cases import Record
from rxcli.numerics import Z95
from rxcli.results.truth import Score
from rxcli.types import FloatArray

Row = dict[str, Any]
#: From this confidence on a packet is sure.
SURE = 0.99
#: Relative errors of rows per slot: `ROWS_BOUND` is the goal, larger ones than `ROWS_WILD` are outliers.
ROWS_BOUND, ROWS_WILD = 5e-4, 1e-2
#: Corners are to be as near as this, screen widths.
CORNER_BOUND = 0.003
#: Minimum number of packets with the true corners for a screen that should be found.
SHOWN = 5
N_BINS = 10


@dataclass(frozen=True)
class Group:
    """The cases of one row of the table, all received in one way."""

    cases: Sequence[Record]
    way: str
    #: Whose packets this one's are compared with.
    reference: str
    #: Whose right packets `share` counts against.
    beside: str | None = None
    #: Cases of the table's first row.
    plain: Sequence[Record] = ()

    @cached_property
    def receptions(self) -> list[Record]:
        """One a case."""
        return [case["ways"][self.way] for case in self.cases]

    @cached_property
    def scores(self) -> list[Score]:
        """Of those whose truth is known."""
        return [Score(**reception["score"]) for reception in self.receptions if reception.get("score")]

    @cached_property
    def score(self) -> Score:
        """Sum of the scores."""
        return sum(self.scores, Score())

    @cached_property
    def packets(self) -> list[Record]:
        """All that were reported."""
        return [packet for reception in self.receptions for packet in reception["packets"]]

    @cached_property
    def problems(self) -> list[str]:
        """Exceptions, warnings and nonsense."""
        return [problem for reception in self.receptions for problem in reception.get("problems", ())]

    def confident(self, least: float = SURE) -> list[Record]:
        """The packets of some confidence and more."""
        return [packet for packet in self.packets if packet["confidence"] >= least]

    def wrong(self, least: float = SURE) -> int:
        """Packets of some confidence with a wrong bit; of a picture without data every packet is wrong."""
        return sum(packet["bit_errors"] > 0 for packet in self.confident(least))

    def values(self, name: str) -> list[Any]:
        """What the receptions hold under a name, as far as they do."""
        return [reception[name] for reception in self.receptions if reception.get(name) is not None]

    @property
    def yardstick(self) -> Group:
        """The same cases in the way that this one is compared with."""
        return Group(self.cases, self.beside or self.way, self.reference)

    def rows_errors(self) -> tuple[FloatArray, FloatArray]:
        """Relative error of rows per slot, NaN where none was estimated, and its stated standard deviation."""
        truth = np.array([case["about"].get("rows_per_slot", np.nan) for case in self.cases])
        found = np.array([r.get("rows_per_slot") or (np.nan, np.nan) for r in self.receptions], np.float64)
        return np.abs(found[:, 0] / truth - 1), found[:, 1] / truth

    def changed(self) -> int:
        """Packets that the first way reported and this one did not, or the other way round."""
        ways = ([reported_payloads(case["ways"][way]) for case in self.cases] for way in (self.reference, self.way))
        return sum(len(before ^ after) for before, after in zip(*ways, strict=True))

    def shown(self) -> list[Record]:
        """Receptions of screens that can be found: the way beside gave packets."""
        pairs = zip(self.receptions, self.yardstick.scores, strict=True)
        return [reception for reception, score in pairs if score.error_free >= SHOWN]

    def ratio(self, over: str, of: str) -> float | None:
        """The least of repeated times of this group's cases over the least of the bare decodes."""
        bare = [case[over] for case in self.cases if over in case]
        return min(self.values(of)) / min(bare) if bare and min(bare) else None


def reported_payloads(reception: Record) -> set[tuple[int, int, str]]:
    """Frame, column and payload of every packet."""
    return {(packet["frame"], packet["column"], packet["payload"]) for packet in reception["packets"]}


def error_over_time(cases: Sequence[Record], ways: Sequence[str]) -> dict[str, list[tuple[float, float]]]:
    """Processor seconds and bit error rate of every case whose truth is known, by way."""
    groups = {way: [Group([case], way, way) for case in cases] for way in ways}
    return {
        way: [(group.receptions[0]["cpu_s"], group.score.ber) for group in mine if group.score.ber is not None]
        for way, mine in groups.items()
    }


def _within(group: Group, sd: float) -> float | None:
    error, stated = group.rows_errors()
    off = (error / stated)[error < ROWS_WILD]
    return float((off < sd).mean()) if off.size else None


def _ber_interval(group: Group) -> tuple[float, float]:
    """Bits of a packet hang together, and so may packets of a frame: the wider of both intervals."""
    scores, n = group.scores, group.score.expected
    errors = [score.bit_errors + score.lost_bits / 2 for score in scores]
    by_frame = cluster_interval(errors, [score.bits for score in scores], n)
    by_packet = cluster_interval(*_packet_clusters(scores), n)
    return min(by_frame[0], by_packet[0]), max(by_frame[1], by_packet[1])


def _goodput(group: Group) -> tuple[float, float, float] | None:
    """Kilobits a second of clips in packets without a wrong bit, and the ends of its interval."""
    clips = [case for case in group.cases if case["ways"][group.way].get("seconds")]
    score = Group(clips, group.way, group.reference).score
    if not score.expected:
        return None
    kbps = score.bits / 1e3 / sum(case["ways"][group.way]["seconds"] for case in clips)
    low, high = wilson(score.error_free, score.expected)
    return kbps * score.error_free / score.expected, kbps * low, kbps * high


def _of_plain(group: Group) -> float:
    """Right packets of a case on average, over those of the table's first row."""
    plain = Group(group.plain, group.way, group.reference).score.error_free / len(group.plain)
    return group.score.error_free / len(group.cases) / max(plain, 1 / len(group.plain))


def _real_time(group: Group) -> float | None:
    rates = [case["about"].get("frame_rate_hz") for case in group.cases]
    if None in rates:
        return None
    return float(group.cases[0]["n_frames"] / rates[0] / min(group.values("wall_s")))


def _stages(group: Group) -> Row:
    """Time of every stage of the quickest reception over the bare decode, by the wall."""
    bare_ms = 1e3 * min(case["bare_wall_s"] for case in group.cases)
    stages: dict[str, float] = dict(min(group.receptions, key=lambda reception: reception["wall_s"])["stages_ms"])
    stages.pop("total", None)
    return {name: ms / bare_ms for name, ms in stages.items()}


def _transfers(name: str, of: Callable[[list[Any]], Any]) -> Callable[[Group], Any]:
    """A figure of the transfers that came whole."""

    def measure(group: Group) -> Any:
        values = [transfer[name] for transfer in group.receptions if transfer.get("exact")]
        return of(values) if values else None

    return measure


#: Name -> measure of a group.
MEASURES: dict[str, Callable[[Group], Any]] = {
    "n": lambda g: len(g.cases),
    "gave_packets": lambda g: sum(bool(r["packets"]) for r in g.receptions),
    "expected": lambda g: g.score.expected if g.scores else None,
    "right": lambda g: g.score.error_free if g.scores else None,
    "share": lambda g: g.score.error_free / max(g.yardstick.score.error_free, 1) if g.beside else None,
    "share95": lambda g: (
        wilson(g.score.error_free, max(g.yardstick.score.error_free, g.score.error_free)) if g.beside else None
    ),
    "of_plain": lambda g: _of_plain(g) if g.plain else None,
    "ber": lambda g: g.score.ber,
    "ber95": _ber_interval,
    "lost": lambda g: g.score.lost,
    "lost_share": lambda g: g.score.lost / g.score.expected if g.score.expected else None,
    "lost_share95": lambda g: wilson(g.score.lost, g.score.expected),
    "kbps": lambda g: (_goodput(g) or (None,))[0],
    "kbps95": lambda g: (_goodput(g) or ())[1:] or None,
    # The genie decides whatever it sees, sure or not.
    "false": lambda g: None if g.way == "bound" or not g.scores else g.score.false,
    "packets": lambda g: len(g.packets),
    "packets_each": lambda g: len(g.packets) / len(g.cases),
    "right_packets": lambda g: sum(packet["bit_errors"] == 0 for packet in g.packets),
    "same": lambda g: sum(r.get("difference") is None for r in g.receptions),
    "cpu_ratio": lambda g: sum(g.values("cpu_s")) / sum(Group(g.cases, g.reference, g.reference).values("cpu_s")),
    "sure": lambda g: len(g.confident()),
    "surely_wrong": lambda g: g.wrong(),
    "likely": lambda g: len(g.confident(0.5)),
    "likely_wrong": lambda g: g.wrong(0.5),
    "at_most": lambda g: wilson(g.wrong(), len(g.confident()))[1] if g.confident() else None,
    "calibration": lambda g: calibration(g.packets)[1] if g.confident(1e-9) else None,
    "changed": lambda g: g.changed(),
    "problems": lambda g: len(g.problems),
    "cpu_s": lambda g: sum(g.values("cpu_s")) / len(g.cases),
    "mb": lambda g: max(g.values("mb"), default=None),
    "over_bare": lambda g: g.ratio("bare_cpu_s", "cpu_s"),
    "over_bare_wall": lambda g: g.ratio("bare_wall_s", "wall_s"),
    "bare_ms": lambda g: 1e3 * min(case["bare_wall_s"] / case["n_frames"] for case in g.cases),
    "total_ms": lambda g: 1e3 * min(g.values("wall_s")) / g.cases[0]["n_frames"],
    "real_time": _real_time,
    "stages": _stages,
    "target": lambda g: g.cases[0]["about"].get("target"),
    "status": lambda g: " ".join(dict.fromkeys(map(str, g.values("status")))),
    "rows_within": lambda g: int((g.rows_errors()[0] < ROWS_BOUND).sum()),
    "rows_none": lambda g: int(np.isnan(g.rows_errors()[0]).sum()),
    "rows_wild": lambda g: int((g.rows_errors()[0] >= ROWS_WILD).sum()),
    "in_1_sd": lambda g: _within(g, 1),
    "in_2_sd": lambda g: _within(g, 2),
    "corners_within": lambda g: sum(error < CORNER_BOUND for error in g.values("corner_error")),
    "corner_error": lambda g: median(g.values("corner_error")) if g.values("corner_error") else None,
    "no_screen": lambda g: sum(status == "no_screen" for status in g.values("status")),
    "not_found": lambda g: sum(r["status"] == "no_screen" for r in g.shown()),
    "of_shown": lambda g: len(g.shown()),
    # Columns that are reported as counted from the left are not numbered wrong.
    "numbered_wrong": lambda g: sum(bool(r.get("shift") and r["numbered"]) for r in g.receptions),
    "texts": lambda g: sum(any(texts) for texts in g.values("texts")),
    "texts_wrong": lambda g: sum(texts.count(False) for texts in g.values("texts")),
    "exact": lambda g: sum(g.values("exact")),
    "s_median": _transfers("seconds", median),
    "s_worst": _transfers("seconds", max),
    "kbps_median": _transfers("kbps", median),
    "kbps_worst": lambda g: min(g.values("kbps")) if all(g.values("exact")) else 0.0,
    "of_visible": _transfers("of_visible", np.mean),
}
COMMON = ("n", "expected", "right", "share", "false", "sure", "surely_wrong", "at_most", "calibration", "problems")
BY_FIELD = ("n", "expected", "right", "false", "ber", "ber95", "lost_share", "lost_share95", "kbps", "kbps95")
COMMON_COST = ("cpu_s", "over_bare", "mb")


def rows(
    records: Sequence[Record], ways: Sequence[str], columns: Sequence[str], beside: str | None = None
) -> list[Row]:
    """The table: a row for each group and way, groups in the order in which they come; last the row of all.

    Args:
        records: of cases.
        ways: in which each was received.
        columns: names of measures; empty ones are left out.
        beside: the way whose right packets are the measure of the others.
    """
    names = [name for name in dict.fromkeys(group for record in records for group in record["groups"]) if name]
    table: list[Row] = []
    for name in [*names, "all"]:
        cases = [record for record in records if name == "all" or name in record["groups"]]
        for way in ways:
            group = Group(cases, way, ways[0], beside, [case for case in records if names[:1] == case["groups"][:1]])
            cells = {column: MEASURES[column](group) for column in columns}
            stages = cells.pop("stages", {})
            table.append({"scenes": name, "way": way} | cells | stages)
    shown = dict.fromkeys(key for row in table for key, value in row.items() if value is not None)
    return [{key: row.get(key) for key in shown} for row in table]


def worth_a_look(records: Sequence[Record], ways: Sequence[str]) -> list[Row]:
    """Cases with a problem, a surely wrong packet, or packets of a picture without data; a number draws them again."""
    table = []
    for record in records:
        for way in ways:
            group = Group([record], way, way)
            if group.wrong() or group.problems or (group.packets and not record["has_data"]):
                about = record["about"].items()
                facts = " ".join(f"{key} {round(x, 3) if isinstance(x, float) else x}" for key, x in about)
                row = {"scene": facts, "way": way, "packets": len(group.packets), "surely_wrong": group.wrong()}
                table.append({**row, "problems": "; ".join(group.problems)})
    return table


def passes(records: Sequence[Record], ways: Sequence[str]) -> bool:
    """Whether no reception has a problem, no picture without data gave packets, and sure packets are right.

    The last two refer to the first way. The confidence of sure packets is refuted if the interval of their error rate
    lies above 1 %.
    """
    group = Group(records, ways[0], ways[0])
    without_data = any(record["ways"][ways[0]]["packets"] for record in records if not record["has_data"])
    problems = any(Group(records, way, way).problems for way in ways)
    return not (without_data or problems or wilson(group.wrong(), len(group.confident()))[0] > 1 - SURE)


# Calibration of the confidence.


def calibration(packets: Sequence[Record]) -> tuple[list[Row], float]:
    """Ten bins of reported confidence, and the mean distance of reported from observed over the packets of all bins."""
    confidence = np.array([packet["confidence"] for packet in packets], np.float64)
    right = np.array([packet["bit_errors"] == 0 for packet in packets], bool)
    number = np.minimum((confidence * N_BINS).astype(np.int64), N_BINS - 1)
    count = np.bincount(number, minlength=N_BINS)
    hits = np.bincount(number, weights=right, minlength=N_BINS)
    total = np.bincount(number, weights=confidence, minlength=N_BINS)
    bins = []
    for i, n in enumerate(count.tolist()):
        reported, interval = float(total[i]) / max(n, 1), wilson(float(hits[i]), n)
        filled = {"reported": reported, "error_free": float(hits[i]) / max(n, 1), "interval95": interval}
        known = {**filled, "calibrated": bool(interval[0] <= reported <= interval[1])} if n else dict.fromkeys(filled)
        bins.append({"confidence": f"{i / N_BINS:.1f}-{(i + 1) / N_BINS:.1f}", "packets": n, **known})
    return bins, float(np.abs(total - hits).sum() / max(len(packets), 1))


def fitted_weights(packets: Sequence[Record]) -> dict[int, list[float]]:
    """Likeliest weights of what confidences are made of, by how many terms that is.

    Packets of photographs and those of clips whose picture is known have terms of their own.
    """
    fitted = {}
    for n in sorted({len(packet["evidence"]) for packet in packets} - {0}):
        mine = [packet for packet in packets if len(packet["evidence"]) == n]
        right = np.array([packet["bit_errors"] == 0 for packet in mine])
        if 0 < right.sum() < right.size:
            fitted[n] = logistic_regression(np.array([packet["evidence"] for packet in mine]), right).tolist()
    return fitted


def logistic_regression(terms: FloatArray, right: NDArray[np.bool_]) -> FloatArray:
    """Weights (k,) that make outcomes (n,) likeliest given terms (n, k).

    A tiny pull towards 0 keeps them finite where the outcomes can be separated.
    """
    from scipy.optimize import minimize

    signed = np.where(right, -1.0, 1.0)[:, None] * terms

    def cost(weights: FloatArray) -> float:
        return float(np.logaddexp(0, signed @ weights).sum() + 5e-4 * weights @ weights)

    return np.asarray(minimize(cost, np.zeros(terms.shape[1])).x, np.float64)


# Intervals.


def wilson(successes: float, trials: float) -> tuple[float, float]:
    """Wilson's score interval of a proportion at 95 % (J. Am. Stat. Assoc. 22, 209, 1927).

    Args:
        successes: 0 .. trials; half-counts are allowed.
        trials: 0 gives the interval of total ignorance, 0 .. 1.
    """
    if trials <= 0:
        return 0.0, 1.0
    share, z2 = successes / trials, Z95 * Z95
    centre = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = Z95 / (1 + z2 / trials) * sqrt(share * (1 - share) / trials + z2 / (4 * trials * trials))
    # At the ends the interval reaches 0 or 1 exactly, but for rounding.
    low = 0.0 if successes <= 0 else max(centre - half, 0.0)
    high = 1.0 if successes >= trials else min(centre + half, 1.0)
    return low, high


def cluster_interval(errors: Sequence[float], sizes: Sequence[float], units: float) -> tuple[float, float]:
    """Wilson interval of a rate whose events come in clusters, such as the wrong bits of lost packets.

    The number of trials is divided by the design effect: the variance between clusters over the binomial one.

    Args:
        errors: events of each cluster.
        sizes: trials of each cluster.
        units: trials to count where the clusters do not differ and give
            no estimate of the correlation of their events.
    """
    k, n = np.asarray(errors, np.float64), np.asarray(sizes, np.float64)
    k, n = k[n > 0], n[n > 0]
    total = float(n.sum())
    if total <= 0:
        return 0.0, 1.0
    rate = float(k.sum()) / total
    between = k.size / max(k.size - 1, 1) * float(((k - rate * n) ** 2).sum())
    if between <= 0:
        return wilson(rate * units, units)
    effect = max(between / (total * rate * (1 - rate)), 1.0)
    return wilson(rate * total / effect, total / effect)


def _packet_clusters(scores: Sequence[Score]) -> tuple[list[float], list[float]]:
    """Wrong bits and bits of every packet, from scores; packets neither lost nor right share the other errors."""
    errors: list[float] = []
    sizes: list[float] = []
    for score in (score for score in scores if score.expected):
        wrong = score.expected - score.lost - score.error_free
        errors += [score.lost_bits / 2 / max(score.lost, 1)] * score.lost + [0.0] * score.error_free
        errors += [score.bit_errors / max(wrong, 1)] * wrong
        sizes += [score.bits / score.expected] * score.expected
    return errors, sizes
