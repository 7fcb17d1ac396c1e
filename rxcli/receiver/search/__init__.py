"""Search for the outline, camera, screen and clock of a picture.

`propose` yields hypotheses with log priors and never decides. `evidence` measures an initial pass. `search` makes
initial passes of the best hypotheses, best prior first, until one is certain or the budget is spent. `refusal`
tests whether light without data explains the winner as well, and gives the reason for a failure.
"""

from rxcli.receiver.search.hypothesis import Found, Hypothesis, Scored, Tried
from rxcli.receiver.search.search import search

__all__ = ["Found", "Hypothesis", "Scored", "Tried", "search"]
