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
    from rxcli.benchmark.confidence import Bin

log = logging.getLogger(__name__)


def available() -> bool:
    """Whether plots can be drawn; says how to get them where not."""
    if find_spec("matplotlib") is not None:
        return True
    log.warning("no plots: matplotlib is not installed (pip install 'vlc-rx[plot]')")
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
