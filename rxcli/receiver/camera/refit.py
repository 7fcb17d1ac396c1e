"""The camera once more, from slots that were received with the first estimate of it.

The receiver's light model and codebook know the slots far better than levels and a trellis do. With them as they are,
what is left is the least squares of the refinement: start, period, bend and exposure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rxcli.receiver.camera.estimates import BlindEstimate
from rxcli.receiver.camera.rows import fit_rows
from rxcli.receiver.camera.settings import SETTINGS
from rxcli.receiver.camera.strips import Correction, Strips
from rxcli.receiver.camera.timing import (
    FLAT,
    curvature_chi_square,
    gauss_newton,
)
from rxcli.receiver.camera.tone import tone_exponent
from rxcli.receiver.camera.views import BLOCK_ROWS, View, Views, slot_time
from rxcli.receiver.camera.waves import column_waves, exposure_of_known, fitted
from rxcli.types import Clock, Float32Array, FloatArray

#: Chi-square of a bend beyond doubt, by whether the picture was corrected: with slots as received, unbent ones reach
#: 205, bent ones have 441 and more but for star fields, few slots at long exposures, and a bend next to none.
_BENT_CHI_SQUARE: dict[Correction, float] = {"no": np.inf, "likely": 30.0, "unknown": 240.0}


@dataclass(frozen=True, slots=True)
class _Fit:
    values: FloatArray
    covariance: FloatArray
    exposure_slots: float
    exposure_sd: float
    #: Share of the local variance that the slots explain: at the start, and now.
    explained_first: float
    explained: float
    #: (M, R) light 0..1 that the slots give, and the rows over which the picture was taken as constant.
    wave: Float32Array
    window: int


def refit(strips: Strips, estimate: BlindEstimate, clock: Clock, lit: Float32Array) -> tuple[BlindEstimate, float]:
    """The estimate from decoded slots, and how far it moves the clock anywhere on the screen, in slots.

    The estimate comes back as it was, moved by nothing, where the slots explain little light, or less with another.

    Args:
        strips: as the picture has them.
        estimate: the camera that the slots were received with.
        clock: on which the slots stand.
        lit: (C, N) probability that each slot of the clock's grid is lit; C columns of the strips.
    """
    view = Views(strips).at(estimate.rows_per_slot, estimate.reversed)
    ordered, curvature = view.strips, view.curvature(estimate.curvature)
    first = np.concatenate([[clock.row0, clock.rows_per_slot], curvature if estimate.corrected else np.zeros(4)])
    shutter = estimate.least_exposure_slots
    may_curve = strips.correction != "no"
    fit = _fit(view, first, lit, clock.exposure_slots, 6 if may_curve else 2, shutter)
    corrected = curvature_chi_square(fit.values, fit.covariance) > _BENT_CHI_SQUARE[strips.correction]
    if may_curve and not corrected:
        before = fit.explained_first
        fit = replace(_fit(view, first * FLAT, lit, fit.exposure_slots, 2, shutter), explained_first=before)
    if fit.explained < max(SETTINGS.not_less_share * fit.explained_first, SETTINGS.refit_least_explained):
        return estimate, 0.0
    moved = np.abs(slot_time(ordered, view.terms, fit.values) - slot_time(ordered, view.terms, first)) * ordered.inside
    sd = SETTINGS.understated_spread * np.sqrt(np.diag(fit.covariance))
    found = replace(
        estimate,
        rows_per_slot=float(fit.values[1]),
        rows_per_slot_sd=float(sd[1]),
        exposure_slots=max(fit.exposure_slots, estimate.least_exposure_slots),
        exposure_slots_sd=fit.exposure_sd if fit.exposure_slots > estimate.least_exposure_slots else 0.0,
        curvature=view.curvature(fit.values[2:]),
        curvature_sd=sd[2:],
        corrected=corrected,
        explained=fit.explained,
        tone=tone_exponent(ordered, fit.wave, fit.window),
    )
    return found, float(moved.max())


def _fit(
    view: View,
    values: FloatArray,
    lit: Float32Array,
    exposure_slots: float,
    n_free: int,
    shutter_slots: float = 0.0,
) -> _Fit:
    """Gauss-Newton on the first `n_free` values of the row-time map, with slots that stay."""
    strips, terms = view.strips, view.terms
    pitch = float(strips.rows[1] - strips.rows[0])
    exposure, exposure_sd, explained_first = exposure_slots, 0.0, 0.0
    window = round(SETTINGS.picture_slots * values[1] / pitch)
    time = slot_time(strips, terms, values)
    moved = np.inf
    for _ in range(SETTINGS.refit_steps):
        slots = fitted(lit, max(int(time.max()) + 3, lit.shape[1]))
        if moved > SETTINGS.rows_anew_slots:
            exposure, exposure_sd = exposure_of_known(column_waves(view, time), lit, exposure)
            rows = fit_rows(strips, time, values, slots, exposure, window, shutter_slots)
            moved = 0.0
        observed = rows.observed(strips, time, values, slots)
        change, covariance, explained = gauss_newton(
            strips, terms, values, time, observed, n_free, SETTINGS.picture_slots, SETTINGS.texture_order
        )
        explained_first = explained_first or explained
        values = values + change
        before, time = time, slot_time(strips, terms, values)
        step = float(np.abs(time - before)[:, ::BLOCK_ROWS].max())
        moved += step
        if step < SETTINGS.converged_slots:
            break
    return _Fit(values, covariance, exposure, exposure_sd, explained_first, explained, observed[0], window)
