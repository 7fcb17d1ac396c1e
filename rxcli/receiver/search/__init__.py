"""One search decides what a picture shows: outline, rows, camera, screen, clock and bursts.

`propose` yields hypotheses with log priors and never decides. `evidence` measures an initial pass. `search` has the
best hypotheses measured, best prior first, until one is plain or the budget is spent. `nulls` ask the winner whether
light without data explains it as well, and `explain` says why nothing was found.
"""

from rxcli.receiver.search.hypothesis import Found, Hypothesis, Scored, Tried
from rxcli.receiver.search.search import search

__all__ = ["Found", "Hypothesis", "Scored", "Tried", "search"]
