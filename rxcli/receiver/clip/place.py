"""Where the screen is, whatever it shows.

The texture of the picture gives a precise motion, but of the picture. On a screen at rest a film may move; in a hand
the screen moves with its picture. The stripes decide: their columns belong to the screen. In every frame the decided
slots give the distance of the columns from where they were read, at the left and at the right, so both hypotheses are
followed and compared by their likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.screen import geometry
from rxcli.types import FloatArray, Lens


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """Where the screen is if it rests, or if it moves with its picture."""

    #: (4, 2) pixels, the viewer's top-left first.
    corners: FloatArray
    #: (2, 2) covariance of its left and right sides, in columns.
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ScreenPlace:
    """Where the screen is, by two hypotheses."""

    #: The screen moves with its picture; and the picture moves on the screen.
    together: Hypothesis
    resting: Hypothesis
    n_columns: int
    lens: Lens | None
    #: Log-odds that the picture moves on the screen.
    log_odds: float

    @classmethod
    def at(cls, corners: FloatArray, n_columns: int, lens: Lens | None, log_odds: float) -> ScreenPlace:
        """The place that a search found."""
        found = Hypothesis(corners, SETTINGS.place_sd**2 * np.eye(2))
        return cls(found, found, n_columns, lens, log_odds)

    @property
    def is_film(self) -> bool:
        """Whether the picture moves on the screen."""
        return self.log_odds > 0

    @property
    def likelier(self) -> Hypothesis:
        """The hypothesis that counts."""
        return self.resting if self.is_film else self.together

    def off(self, corners: FloatArray, hypothesis: Hypothesis) -> FloatArray:
        """(2,) columns by which the left and the right of `corners` (4, 2) lie to the right of the screen's sides."""
        return self.n_columns * geometry.sides_off(hypothesis.corners, corners, self.lens)

    def after(self, before: FloatArray, after: FloatArray) -> ScreenPlace:
        """The place predicted for a frame, whose picture moved from corners (4, 2) `before` to corners `after`."""
        last = self.likelier
        together = replace(last, corners=geometry.carried(last.corners, before, after, self.lens))
        # A camera in a hand moves the screen, too, by an unknown part of it: both sides by the same.
        unsure = SETTINGS.unsteady_share * self.off(together.corners, last).mean()
        resting = replace(last, covariance=last.covariance + unsure**2)
        return replace(self, together=together, resting=resting)

    def measured(self, read: FloatArray, off: FloatArray, covariance: FloatArray) -> ScreenPlace:
        """The place after the light of a frame was compared with its slots.

        Args:
            read: (4, 2) corners between which the light was read.
            off: (2,) columns by which their left and right lie to the right of the columns.
            covariance: (2, 2) of `off`.
        """
        covariance = covariance + SETTINGS.columns_sd**2 * np.eye(2)
        (together, as_together), (resting, as_resting) = (
            self._corrected(each, off - self.off(read, each), covariance) for each in (self.together, self.resting)
        )
        # The picture may begin to move, and come to rest.
        begins, ends = SETTINGS.film_begins, SETTINGS.film_ends
        odds = np.exp(np.clip(self.log_odds + as_resting - as_together, -SETTINGS.max_log_odds, SETTINGS.max_log_odds))
        log_odds = float(np.log((begins + odds * (1 - ends)) / (1 - begins + odds * ends)))
        return replace(self, together=together, resting=resting, log_odds=log_odds)

    def _corrected(self, hypothesis: Hypothesis, error: FloatArray, covariance: FloatArray) -> tuple[Hypothesis, float]:
        """The hypothesis whose columns lie `error` to the left of it, and its log-likelihood."""
        total = hypothesis.covariance + covariance
        gain = hypothesis.covariance @ np.linalg.inv(total)
        corners = geometry.beside(hypothesis.corners, -(gain @ error) / self.n_columns, self.lens)
        log_likelihood = -(error @ np.linalg.solve(total, error) + np.linalg.slogdet(total)[1]) / 2
        return Hypothesis(corners, (np.eye(2) - gain) @ hypothesis.covariance), float(log_likelihood)
