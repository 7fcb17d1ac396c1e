"""Plots of the benchmark's results, PNG; matplotlib comes with the extra `plot`."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rxcli.errors import UsageError

if TYPE_CHECKING:
    from rxcli.lab.benchmark.confidence import Bin
    from rxcli.lab.benchmark.speed import Growth
    from rxcli.lab.benchmark.sweeps import PlanePoint, Summary

log = logging.getLogger(__name__)


def available() -> bool:
    """Whether plots can be drawn; says how to get them where not."""
    if find_spec("matplotlib") is not None:
        return True
    log.warning("no plots: matplotlib is not installed (pip install '.[plot]')")
    return False


@contextmanager
def _figure(path: Path, width: float = 6.4, height: float = 4.8) -> Iterator[Any]:
    """Axes of a figure that is written to `path`; no display, no global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    yield figure.subplots()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise UsageError(f"{path}: cannot be written ({error.strerror})", "name another folder with --out") from None


def plot_confidence(bins: Sequence[Bin], path: Path) -> None:
    """Share of error-free packets over reported confidence, with Wilson intervals."""
    filled = [b for b in bins if b.n]
    with _figure(path, 5.0, 5.0) as axes:
        axes.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="calibrated")
        share = [b.right / b.n for b in filled]
        below = [s - b.interval[0] for s, b in zip(share, filled, strict=True)]
        above = [b.interval[1] - s for s, b in zip(share, filled, strict=True)]
        axes.errorbar([b.reported for b in filled], share, yerr=[below, above], fmt="o", capsize=3, label="observed")
        for b, s in zip(filled, share, strict=True):
            axes.annotate(str(b.n), (b.reported, s), textcoords="offset points", xytext=(6, -10), fontsize=7)
        axes.set(xlabel="reported confidence", ylabel="share of error-free packets", xlim=(0, 1), ylim=(0, 1))
        axes.legend(loc="upper left")


def plot_sweep(summaries: Sequence[Summary], path: Path) -> None:
    """Bit error rate over the axis of one sweep, one line a method, with intervals."""
    points = list(dict.fromkeys(summary.point for summary in summaries))
    numeric = all(point.x is not None for point in points) and len({point.x for point in points}) == len(points)
    place = {point: point.x if numeric and point.x is not None else float(n) for n, point in enumerate(points)}
    with _figure(path, max(6.4, 0.7 * len(points))) as axes:
        for method in dict.fromkeys(summary.method for summary in summaries):
            _ber_line(axes, [s for s in summaries if s.method == method], place, method)
        axes.set(title=points[0].sweep, ylabel="bit error rate, lost packets included")
        if numeric and min(place.values()) > 0:
            axes.set_xscale("log")
        axes.set_xticks(list(place.values()), [point.label for point in points], rotation=30, ha="right", minor=False)
        axes.minorticks_off()
        axes.legend(fontsize=8)


def plot_rates(summaries: Sequence[Summary], path: Path) -> None:
    """The paper's Fig. 11: bit error rate over data rate; one line a picture and method (Fig. 12: sky and flower)."""
    from rxcli.lab.benchmark.sweeps import FEC_THRESHOLD

    with _figure(path) as axes:
        for picture in dict.fromkeys(summary.point.picture for summary in summaries):
            for method in dict.fromkeys(summary.method for summary in summaries):
                mine = [s for s in summaries if s.point.picture == picture and s.method == method]
                _ber_line(axes, mine, {s.point: s.point.rate_kbps for s in mine}, f"{method}, {picture}")
        axes.axhline(FEC_THRESHOLD, color="0.4", linestyle="--", linewidth=1)
        axes.annotate("FEC threshold 3.8e-3", (0.01, FEC_THRESHOLD), xycoords=("axes fraction", "data"), va="bottom")
        axes.set(xlabel="data rate, kb/s (20 columns, 60 payloads a second)", ylabel="bit error rate")
        axes.legend(fontsize=8)


def _ber_line(axes: Any, summaries: Sequence[Summary], place: dict[Any, float], label: str) -> None:
    """Rates of zero stand at the bottom of a logarithmic axis, with their upper bound."""
    shown = [s for s in summaries if s.score.ber is not None]
    bottom = 1e-6
    rates = [max(s.score.ber or 0.0, bottom) for s in shown]
    low = [max(rate - max(s.ber_interval[0], bottom), 0.0) for rate, s in zip(rates, shown, strict=True)]
    high = [max(s.ber_interval[1] - rate, 0.0) for rate, s in zip(rates, shown, strict=True)]
    # Lines step aside a little, lest their intervals cover each other.
    aside = 1 + 0.008 * (len(axes.containers) % 8 - 3)
    x = [place[s.point] * aside for s in shown]
    axes.errorbar(x, rates, yerr=[low, high], marker="o", markersize=4, capsize=2, linewidth=1, label=label)
    axes.set_yscale("log")
    axes.set_ylim(bottom / 2, 1)


def plot_plane(plane: Sequence[PlanePoint], path: Path) -> None:
    """Run time against error of every method; the Pareto front is marked."""
    with _figure(path) as axes:
        for point in plane:
            axes.scatter(point.ms, max(point.ber, 1e-6), marker="o" if point.on_front else "x", color="C0")
            axes.annotate(point.method, (point.ms, max(point.ber, 1e-6)), textcoords="offset points", xytext=(5, 4))
        front = sorted((p.ms, max(p.ber, 1e-6)) for p in plane if p.on_front)
        axes.plot(*zip(*front, strict=True), color="C1", linewidth=1, label="Pareto front")
        axes.set(xlabel="run time, ms a frame", ylabel="bit error rate", xscale="log", yscale="log")
        axes.legend()


def plot_growth(growths: Sequence[Growth], path: Path) -> None:
    """Run time over megapixels and columns, with the fitted exponents."""
    with _figure(path) as axes:
        for growth in growths:
            axes.plot(growth.x, growth.ms, marker="o", label=f"{growth.axis}: exponent {growth.exponent:.2f}")
        axes.set(xlabel="megapixels, columns", ylabel="run time after ingest, ms", xscale="log", yscale="log")
        axes.legend()
