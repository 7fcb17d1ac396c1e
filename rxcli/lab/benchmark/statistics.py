"""Intervals, fits and fronts: the statistics that the benchmark's tables rest on."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt

import numpy as np

#: Two-sided 95 % quantile of the normal distribution.
Z95 = 1.959963984540054


def wilson(successes: float, trials: float, z: float = Z95) -> tuple[float, float]:
    """Wilson's score interval of a proportion (J. Am. Stat. Assoc. 22, 209, 1927).

    Args:
        successes: 0 .. trials; half-counts are allowed.
        trials: 0 gives the interval of total ignorance, 0 .. 1.
        z: normal quantile of the wanted coverage.
    """
    if trials <= 0:
        return 0.0, 1.0
    share, z2 = successes / trials, z * z
    centre = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = z / (1 + z2 / trials) * sqrt(share * (1 - share) / trials + z2 / (4 * trials * trials))
    # At the ends the interval reaches 0 or 1 exactly, but for rounding.
    low = 0.0 if successes <= 0 else max(centre - half, 0.0)
    high = 1.0 if successes >= trials else min(centre + half, 1.0)
    return low, high


def power_law(x: Sequence[float], y: Sequence[float]) -> float:
    """Exponent of the power law `y = factor * x ** exponent` nearest to the points in logarithms.

    Raises:
        ValueError: fewer than two different x, or a value that is not positive.
    """
    points = np.array([x, y], np.float64)
    if points.min(initial=np.inf) <= 0 or np.unique(points[0]).size < 2:
        raise ValueError(f"a power law needs positive values at two or more places (got {list(x)}, {list(y)})")
    log_x, log_y = np.log(points)
    return float(np.polyfit(log_x, log_y, 1)[0])


def pareto_front(costs: Sequence[tuple[float, float]]) -> list[bool]:
    """Whether each point is on the front: no other one is as good in both costs and better in one."""
    return [not any(a <= x and b <= y and (a, b) != (x, y) for a, b in costs) for x, y in costs]


def cluster_interval(
    errors: Sequence[float], sizes: Sequence[float], units: float, z: float = Z95
) -> tuple[float, float]:
    """Wilson interval of a rate whose events come in clusters, such as the wrong bits of lost packets.

    The number of trials is divided by the design effect: the variance between clusters over the binomial one.

    Args:
        errors: events of each cluster.
        sizes: trials of each cluster.
        units: trials to count where the clusters do not differ, and so tell nothing of how their events hang together.
        z: normal quantile of the wanted coverage.
    """
    k, n = np.asarray(errors, np.float64), np.asarray(sizes, np.float64)
    k, n = k[n > 0], n[n > 0]
    total = float(n.sum())
    if total <= 0:
        return 0.0, 1.0
    rate = float(k.sum()) / total
    between = k.size / max(k.size - 1, 1) * float(((k - rate * n) ** 2).sum())
    if between <= 0:
        return wilson(rate * units, units, z)
    effect = max(between / (total * rate * (1 - rate)), 1.0)
    return wilson(rate * total / effect, total / effect, z)
