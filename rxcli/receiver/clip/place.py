"""Where the screen is, whatever it shows.

The texture of the picture gives a precise motion, but of the picture. On a screen at rest a film may move; in a hand
the screen moves with its picture. The stripes decide: their columns belong to the screen. In every frame the decided
slots give the distance of the columns from where they were read, at the left and at the right, so both hypotheses are
followed and compared by their likelihood. Up and down, the light at the screen's ends decides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.screen import geometry
from rxcli.types import FloatArray, Frame, Lens


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

    def after(self, before: FloatArray, after: FloatArray, frame: Frame) -> ScreenPlace:
        """The place predicted for a frame, whose picture moved from corners (4, 2) `before` to corners `after`."""
        last = self.likelier
        together = replace(last, corners=geometry.carried(last.corners, before, after, self.lens))
        # A camera in a hand moves the screen, too, by an unknown part of it: both sides by the same.
        unsure = SETTINGS.unsteady_share * self.off(together.corners, last).mean()
        resting = replace(last, covariance=last.covariance + unsure**2)
        shown = _log_odds_of_ends(frame, together.corners, resting.corners)
        return replace(self, together=together, resting=resting, log_odds=self.log_odds + shown)

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


def _log_odds_of_ends(frame: Frame, together: FloatArray, resting: FloatArray) -> float:
    """Log-odds of the corners (4, 2) `resting` against `together` by the light where only one has the screen."""
    log_odds, x = 0.0, np.linspace(0.1, 0.9, SETTINGS.n_end_places)
    for left, right, inwards in ((0, 1, 1), (3, 2, -1)):
        (here, there), places = (
            [a[left, 1] + (a[right, 1] - a[left, 1]) * x for a in (together, resting)],
            (together[left, 0] + (together[right, 0] - together[left, 0]) * x).round().astype(int),
        )
        height = round(float(np.abs(here - there).mean()))
        if height < SETTINGS.min_end_rows:
            continue
        # Rows of one alone, and as many that both have.
        outer, inner = (np.minimum(here, there), np.maximum(here, there))[::inwards]
        of_one = _mean_light(frame, (outer + inner) / 2, places, height)
        of_both = _mean_light(frame, inner + inwards * height / 2, places, height)
        dark = SETTINGS.min_end_light * (frame.white - frame.black)
        share = float(np.clip((of_one + dark) / (of_both + 2 * dark), 0, 1).mean())
        is_resting = (there.mean() - here.mean()) * inwards < 0
        log_odds += SETTINGS.end_log_odds * (2 * share - 1) * (1 if is_resting else -1)
    return log_odds


def _mean_light(frame: Frame, rows: FloatArray, columns: FloatArray, height: int) -> FloatArray:
    """(n,) mean light over black of `height` rows around the pixels at `rows` and `columns` (n,)."""
    y = np.clip(rows.round().astype(int) + np.arange(height)[:, None] - height // 2, 0, frame.height - 1)
    values = frame.pixels[y, np.clip(columns, 0, frame.width - 1)].astype(np.float64)
    return np.asarray(np.maximum(values - frame.black, 0).mean(axis=0))
