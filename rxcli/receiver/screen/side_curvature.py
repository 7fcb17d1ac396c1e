"""How a lens bows the sides of a screen whose corners are known.

Straight sides stay straight where a camera takes the distortion of its lens out of its pictures. Where it does not, all
four sides are arcs, of one coefficient between corners that stay: so every coefficient is a guess of the whole outline,
and the one along which light steps up most often is it. Least squares then puts it right together with what the corners
may be off by.
"""

from __future__ import annotations

import numpy as np

from rxcli.receiver.screen.edges import Steps, steps_of
from rxcli.receiver.screen.picture import Picture, Pixels
from rxcli.receiver.screen.pose import INDEPENDENT
from rxcli.receiver.screen.sides import BOTTOM, LEFT, RIGHT, TOP, Side, across, from_top_left, width_of
from rxcli.types import FloatArray

#: Coefficients around which steps of light are looked for, likeliest first, and those tried around each.
_GUESSES = (0.0, -0.14, 0.14, -0.28, 0.28)
_TRIED = np.linspace(-0.075, 0.075, 16)
#: Share of the four sides, added up, that must lie on the arcs.
_LEAST_SUPPORT = 0.25
#: The same, from which on no other guess is made, where the best is not at the end of those tried around this one: of
#: sides that are bowed otherwise the nearest ones tried fit best.
_SETTLED = 0.5
#: Sides that must say something, and the places, as a number and as a share of all, by which one does.
_LEAST_SIDES, _LEAST_PLACES, _LEAST_SHARE = 2, 6, 0.1
#: Squared distance of a corner from the picture's middle, widths, up to which a lens has an inverse; the shortest side,
#: pixels; and how far a side may lean.
_FURTHEST, _SHORTEST_PX, _LEANING = 0.8, 32.0, 0.5
#: Coefficients that lenses have, and how far off a corner may be, screen widths.
_SD, _CORNER_SD = 0.15, 7e-4
#: Places further from an arc than so many of their own tolerances are none of the side's.
_TOLERANCES = 2.0
#: Places err alike along the sides: how much too sure the least squares are, by straight sides.
_UNDERSTATED = 1.6
_ROUNDS = 3
_STEP = 0.005
#: Places of an arc that its polynomial goes through, and its degree.
_ALONG, _DEGREE = np.linspace(-0.02, 1.02, 33), 4


def measure_side_curvature(
    pixels: Pixels, corners: FloatArray, *, black: float, white: float, mosaic_period: int = 1
) -> tuple[float, float] | None:
    """The radial distortion that bows the sides of a screen.

    Args:
        pixels: as for `find_screen`.
        corners: (4, 2) the screen's corners, pixels, by turns.
        black: value of no light.
        white: value of full light.
        mosaic_period: as for `find_screen`.

    Returns:
        k1 for a focal length of one picture width, with k2 = -k1, and its standard deviation; None where too little of
        the sides shows, or the corners are no upright screen's in or about the picture.
    """
    picture = Picture(pixels, black, white, mosaic_period)
    corners = from_top_left(_clockwise(corners))
    if not _have_sides(corners, picture):
        return None
    size = width_of(corners)
    best = 0.0, 0.0, list[Steps]()
    for initial in _GUESSES:
        found = _best_around(picture, corners, initial, size)
        best = max(best, found, key=lambda one: one[0])
        if best is found and found[0] > _SETTLED and abs(found[1] - initial) < _TRIED[-1]:
            break
    support, k1, steps = best
    return _by_least_squares(picture, corners, k1, steps, size) if support >= _LEAST_SUPPORT else None


def _clockwise(corners: FloatArray) -> FloatArray:
    """Corners by turns either way, clockwise in the picture."""
    edges = np.roll(corners, -1, axis=0) - corners
    turn = edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0]
    return corners if turn > 0 else corners[::-1]


def _have_sides(corners: FloatArray, picture: Picture) -> bool:
    """Whether arcs can be drawn between the corners: from side to side clockwise, and not far outside the picture."""
    edges = np.roll(corners, -1, axis=0) - corners
    along, leaning = edges[[TOP, RIGHT, BOTTOM, LEFT], [0, 1, 0, 1]], edges[[TOP, RIGHT, BOTTOM, LEFT], [1, 0, 1, 0]]
    offset = (corners - [picture.width / 2, picture.height / 2]) / picture.width
    return bool(
        (along * [1, 1, -1, -1] > _SHORTEST_PX).all()
        and (np.abs(leaning) < _LEANING * np.abs(along)).all()
        and (offset**2).sum(axis=1).max() < _FURTHEST
    )


def _arcs(picture: Picture, corners: FloatArray, k1: FloatArray) -> list[list[Side]]:
    """The sides between corners that a lens of each coefficient has moved to where they are."""
    middle = np.array([(picture.width - 1) / 2, (picture.height - 1) / 2])
    k1 = np.asarray(k1, np.float64)[:, None, None]

    def moved(points: FloatArray) -> FloatArray:
        square = (points**2).sum(axis=-1, keepdims=True)
        return np.asarray(1 + k1.reshape(-1, *[1] * (points.ndim - 1)) * square * (1 - square))

    observed = (corners - middle) / picture.width
    ideal = np.broadcast_to(observed, (k1.size, 4, 2))
    for _ in range(8):
        ideal = observed / moved(ideal)
    straight = ideal[:, :, None] + _ALONG[:, None] * (np.roll(ideal, -1, axis=1) - ideal)[:, :, None]
    points = straight * moved(straight) * picture.width + middle
    upright = [side for side in range(4) if not across(side)]
    points[:, upright] = points[:, upright, :, ::-1]
    t, place = points[..., 0], points[..., 1]
    centre, half = (t[..., 0] + t[..., -1]) / 2, np.abs(t[..., -1] - t[..., 0]) / 2
    powers = ((t - centre[..., None]) / half[..., None])[..., None] ** np.arange(_DEGREE, -1, -1)
    turned = powers.swapaxes(-1, -2)
    coefficients = np.linalg.solve(turned @ powers, turned @ place[..., None])[..., 0]
    return [
        [Side(*one, 1.0) for one in zip(*sides, strict=True)]
        for sides in zip(coefficients, centre.tolist(), half.tolist(), strict=True)
    ]


def _best_around(
    picture: Picture, corners: FloatArray, initial: float, size: float
) -> tuple[float, float, list[Steps]]:
    """The support of the best coefficient near a guess, that coefficient, and the steps found along the guess."""
    tried = np.append(initial, initial + _TRIED)
    own, *others = _arcs(picture, corners, tried)
    steps = [steps_of(picture, own, side, size) for side in range(4)]
    return *max((_support(steps, arcs), k1) for arcs, k1 in zip(others, tried[1:].tolist(), strict=True)), steps


def _support(steps: list[Steps], arcs: list[Side]) -> float:
    """Shares of the sides whose steps lie on arcs, added up."""
    total = 0.0
    for observed, arc in zip(steps, arcs, strict=True):
        off = (observed.place - arc.at(observed.t)) / (_TOLERANCES * observed.sd)
        total += float((observed.weight * observed.found * np.maximum(1 - off**2, 0)).sum()) / max(observed.t.size, 1)
    return total


def _by_least_squares(
    picture: Picture, corners: FloatArray, k1: float, steps: list[Steps], size: float
) -> tuple[float, float] | None:
    """The coefficient that all sides agree on, each with its own offset and turn; None where only one says anything.

    What the sides differ by, beyond their own standard deviations, widens that of the result: one of them may be the
    edge of a picture's black part, or of what the correction of a lens left of it.
    """
    for _ in range(_ROUNDS):
        now, next_one = _arcs(picture, corners, np.array([k1, k1 + _STEP]))
        said = [_said_by(*one, size) for one in zip(steps, now, next_one, strict=True)]
        precision, pull = np.array([one for one in said if one]).reshape(-1, 2).T
        if precision.size < _LEAST_SIDES:
            return None
        total = float(precision.sum()) + _SD**-2
        change = (float(pull.sum()) - k1 * _SD**-2) / total
        k1 += change
    spread = float((precision * (pull / precision - change) ** 2).sum()) / (precision.size - 1)
    return k1, _UNDERSTATED * (max(spread, 1.0) / total) ** 0.5


def _said_by(observed: Steps, arc: Side, next_arc: Side, size: float) -> tuple[float, float] | None:
    """What one side says of the coefficient, its offset and turn aside: precision, and that times the change."""
    left = observed.place - arc.at(observed.t)
    on_it = observed.found & (np.abs(left) < _TOLERANCES * observed.sd)
    if on_it.sum() < max(_LEAST_PLACES, _LEAST_SHARE * on_it.size):
        return None
    t, left = observed.t[on_it], left[on_it]
    bow = (next_arc.at(t) - arc.at(t)) / _STEP
    terms = np.stack([bow, np.ones_like(t), (t - arc.middle) / arc.half])
    weight = observed.sd**-2 / max(t.size / INDEPENDENT, 1)
    normal, pull = weight * terms @ terms.T, weight * terms @ left
    shared = np.linalg.solve(normal[1:, 1:] + np.eye(2) / (_CORNER_SD * size) ** 2, normal[1:, 0])
    return float(normal[0, 0] - shared @ normal[1:, 0]), float(pull[0] - shared @ pull[1:])
