"""Number the columns of a grid: the log-odds of each to be the screen's first, by a fitted model.

Numberings that differ by a shift share all columns but the outermost, so what lies at the ends decides. Light is
measured in eighths of a column: the edge of a screen lies on a column border, whereas that of a picture shown on it
does so by chance only. The weights of the features are fitted data, `models/numbering`.
"""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import erfc

import numpy as np

from rxcli.numerics import TINY, best_run
from rxcli.receiver.screen.grid import Grid, columns_at
from rxcli.receiver.screen.rows import ScreenAxis
from rxcli.receiver.screen.strips import PictureStrips
from rxcli.resources import data_dir
from rxcli.types import BoolArray, Float32Array, FloatArray, IntArray

#: Parts of a column in which light is measured; parts on either side of a border whose levels are compared.
_PARTS, _BESIDE = 8, 3
#: Standard deviations from which light is the columns', and the means beside a border differ; e-folds below the
#: brightest parts at which a part is black; share of the most lit rows' light from which rows count.
_SURE, _BLACK, _LIT_ROWS = 4.0, 4.0, 0.2
#: Light of one grey level of 255; maximum log-odds by which a part that never goes out is no column.
_GREY_LEVEL, _MAX_STEADY = 255.0**-2, 2.0
#: Width of a margin, picture widths; root of the light, of white, below which nothing was exposed.
_MARGIN, _NO_LIGHT = 0.04, 0.001
#: Columns to either side of the picture's middle one that are looked at: on a plane seen nearly edge-on there are any
#: number.
_FURTHEST = 200
#: Mean light of parts that belong to the light; columns of the picture that must lie beyond light which ends in it.
_ENDS, _IN_VIEW = 0.15, 0.3
#: Share of the parts that are the darkest, or the brightest; parts are faint up to a share of the way from these to
#: those, of the root of light; minimum standard deviation of it, of white.
_DARK, _FAINT, _MIN_FAINT_SD = 0.1, 0.05, 0.0004
#: Standard deviations of the sides of a bright part against the screen's, screen widths, and of its height, screen
#: heights.
_SIDE_SD, _HEIGHT_SD = 0.0125, 0.03
#: Standard deviation of a grid at the screen's sides, screen widths, of 31 grids of 100 columns.
_GRID_SD = 0.004
#: Distances from the screen's middle, screen widths, within which edges lie that it has in pairs: of films and of the
#: screen's frame.
_PAIRED = (0.22, 0.58)
#: Columns that a picture shows of a screen, where it has as many.
_MIN_SHOWN = 3


#: Features of a first column in their order; the comments in `models/numbering/model.toml` explain them.
WEIGHTS = (
    *("lit_inside", "unlit_inside", "steady_inside", "picture_off_middle", "hidden_unlit", "columns_on_border"),
    *("light_on_border", "faint_on_border", "paired_edges", "part_between", "part_in_middle"),
)


@lru_cache(maxsize=1)
def numbering_weights() -> FloatArray:
    """(11,) the shipped weights, log-odds, in the order of the features."""
    path = data_dir("models") / "numbering" / "model.toml"
    weights = tomllib.loads(path.read_text(encoding="utf-8"))["weights"]
    return np.array([weights[name] for name in WEIGHTS])


@dataclass(frozen=True, slots=True)
class LightProfile:
    """Light across the columns of a grid."""

    #: (P,) middles of the parts of columns, and whether they are in the picture.
    place: FloatArray
    in_picture: BoolArray
    #: (P,) 0..1: how surely a part has the columns' light, and the logarithm of its level; 0 is black, 1 the brightest.
    coherent: FloatArray
    level: FloatArray
    #: (P,) log-odds that a part has light that never goes out.
    steady: FloatArray
    #: (P,) whether a part has hardly any light, and its level, scaled so that a difference of one in total is plain.
    is_faint: BoolArray
    faint: FloatArray
    #: Column at the picture's middle.
    picture_middle: float
    #: (Q, 2) columns at the left and the right of bright parts with four straight sides; (Q,) their heights, columns.
    sides: FloatArray
    heights: FloatArray

    @property
    def light(self) -> FloatArray:
        """(P,) 0..1: the columns' light."""
        return self.coherent * self.level

    @property
    def ends(self) -> tuple[float, float]:
        """Columns at which the light begins and ends."""
        start, end = best_run(self.light - _ENDS)
        left = float(self.place[0]) - 0.5 / _PARTS
        return left + start / _PARTS, left + end / _PARTS

    def edges(self, values: FloatArray, known: BoolArray | None = None) -> tuple[FloatArray, FloatArray]:
        """(P + 1,) 0..1: how much values (P,) rise, and fall, at a border of known parts or beside it."""
        step, middle = 2 * _BESIDE, slice(_BESIDE, -_BESIDE)
        known = self.in_picture if known is None else known
        shown, total = (np.concatenate([[0.0], np.cumsum(part)]) for part in (known, values))
        steps = np.zeros(total.size)
        steps[middle] = (total[step:] - 2 * total[middle] + total[:-step]) * (shown[step:] - shown[:-step] == step)
        return _at_or_beside(np.clip(steps, 0, 1)), _at_or_beside(np.clip(-steps, 0, 1))


def light_profile(
    strips: PictureStrips, light: Float32Array, grid: Grid, parts: Sequence[FloatArray] = ()
) -> LightProfile:
    """Measure the light across the columns of a grid.

    Args:
        strips: of the picture.
        light: (B, S, R) products of the strips with the waveforms predicted from their neighbours, `predicted_light`.
        grid: of the picture.
        parts: corners (4, 2) of bright parts of the picture, clockwise from the top left.
    """
    u = columns_at(grid.coefficients, strips.x, strips.y)
    u = np.clip(u, np.median(u) - _FURTHEST, np.median(u) + _FURTHEST)
    origin = int(np.floor(u.min())) - 1
    n = (int(np.ceil(u.max())) + 1 - origin) * _PARTS
    part = ((u - origin) * _PARTS).astype(np.int64)

    def total(values: FloatArray | Float32Array) -> FloatArray:
        return np.asarray(np.bincount(part.ravel(), np.broadcast_to(values, part.shape).ravel(), n), np.float64)

    count, power = total(np.ones(1)), total(np.einsum("bsr,bsr->bs", light, light))
    share = total(light.sum(axis=2)) / np.sqrt(np.maximum(power * count * light.shape[2], TINY))
    coherent = np.clip(share * np.sqrt(count * strips.n_rows) / _SURE, 0, 1)
    lit = _lit_rows(strips, light).astype(np.float64)
    n_lit = np.maximum(total(lit), 1)
    shown = total(lit) > 0
    root, place = total(lit * np.sqrt(np.maximum(strips.level, 0))) / n_lit, origin + (np.arange(n) + 0.5) / _PARTS
    is_faint, faint = _faint_light(root, shown)
    level = np.log(total(lit * strips.level) / n_lit + _GREY_LEVEL)
    darkest = total(lit * np.log(strips.darkest + _GREY_LEVEL)) / n_lit
    level = np.clip(1 + (level - np.quantile(level[shown], 1 - _DARK)) / _BLACK, 0, 1) * shown
    of_columns = darkest[shown & (coherent > 0.5)]
    usual = np.median(of_columns) if of_columns.size else np.inf
    steady = np.clip(darkest - usual, 0, _MAX_STEADY) * (1 - coherent) * shown
    # Without a lens's distortion a picture has margins that are not of the sensor.
    left, right = np.flatnonzero(count)[[0, -1]]
    at_side = np.minimum(np.arange(n) - left, right - np.arange(n)) < _MARGIN * (right - left)
    in_picture = (count > 0) & ~(at_side & (root < _NO_LIGHT))
    corners = np.reshape(parts, (-1, 4, 2))
    across = grid.columns_at(corners)
    sides = np.stack([across[:, [0, 3]].mean(axis=1), across[:, [1, 2]].mean(axis=1)], axis=1)
    along = ScreenAxis.through(grid, 1, 1.0, 0.0).along(*grid.flat(corners))
    heights = along[:, 2:].mean(axis=1) - along[:, :2].mean(axis=1)
    # A part that the picture cuts off goes on beyond it.
    whole = (sides[:, 0] > place[in_picture].min(initial=np.inf)) & (
        sides[:, 1] < place[in_picture].max(initial=-np.inf)
    )
    middle = float(grid.coefficients[0])
    return LightProfile(
        place, in_picture, coherent, level, steady, is_faint, faint, middle, sides[whole], heights[whole]
    )


def _lit_rows(strips: PictureStrips, light: Float32Array) -> BoolArray:
    """(B, S) whether strips lie between the first and the last rows of the columns' light, as columns lean."""
    along = strips.course.along(strips.raw_x, strips.raw_y)
    number = np.rint((along - along.min()) / (2 * strips.half_height)).astype(np.int64)
    by_rows = np.bincount(number.ravel(), light.mean(axis=2).ravel()) / np.maximum(np.bincount(number.ravel()), 1)
    return np.asarray((by_rows >= _LIT_ROWS * by_rows.max())[number])


def _faint_light(root: FloatArray, shown: BoolArray) -> tuple[BoolArray, FloatArray]:
    """`is_faint` and `faint` of parts with the root (P,) of their light: a panel that is dark passes a little.

    The screen's frame, and the room around it, mostly differ from that. Neighbouring parts give the noise.
    """
    darkest, brightest = np.quantile(root[shown], (_DARK, 1 - _DARK / 2))
    is_faint = shown & (root < darkest + _FAINT * (brightest - darkest))
    beside = np.abs(np.diff(root))[is_faint[1:] & is_faint[:-1]]
    # Of normal differences the median is 0.95 standard deviations of one part.
    sd = max(float(np.median(beside)) / 0.95 if beside.size else np.inf, _MIN_FAINT_SD)
    plain = _SURE * sd * np.sqrt(2 * _BESIDE)
    return is_faint, np.where(is_faint, root, 0) / plain


def first_columns(light: LightProfile, n_columns: int, aspect: float) -> tuple[IntArray, FloatArray, bool]:
    """Columns (F,) of a grid, the log-odds of each to be the screen's first, and whether no side of it is in view.

    If columns are dark at both ends and nothing else shows its sides, several candidates remain about equally likely.
    Log-odds are comparable between numbers of columns.
    """
    starts, terms, fills = first_column_features(light, n_columns, aspect)
    odds = terms @ numbering_weights()
    # A grid that is half a column off at the screen's sides counts one more, or one less.
    slip = np.log(max(erfc(0.5 / (_GRID_SD * n_columns * 2**0.5)) / 2, TINY))
    beside = np.pad(odds, 1, constant_values=-np.inf) + slip
    return starts, np.logaddexp.reduce([odds, beside[:-2], beside[2:]]), fills


def first_column_features(light: LightProfile, n_columns: int, aspect: float) -> tuple[IntArray, FloatArray, bool]:
    """Columns (F,) of a grid, their features (F, 11) in the order of the weights, and whether no side is in view."""
    shown = light.place[light.in_picture]
    left, right = float(shown.min()), float(shown.max())
    n_shown = min(n_columns, _MIN_SHOWN)
    leftmost = int(left) - n_columns + n_shown
    starts = np.arange(leftmost, max(int(right) - n_shown, leftmost) + 1)
    ends, middles = starts + n_columns, np.asarray(starts + n_columns / 2, np.float64)
    begin, end_of_light = light.ends
    reaches = np.array([begin < left + _IN_VIEW, end_of_light > right - _IN_VIEW])
    # Parts next to a border count for neither side.
    off = np.minimum(light.place - starts[:, None], ends[:, None] - light.place)
    inside = (light.in_picture & (off > 1 / _PARTS)) / _PARTS
    hidden = np.clip(np.stack([left - starts, ends - right]), 0, 1)
    rises, falls = light.edges(light.level)
    begins, ceases = light.edges(light.coherent)
    brightens, fades = light.edges(light.faint, light.is_faint)
    border, width = ((starts - light.place[0]) * _PARTS + 0.5).round().astype(np.int64), n_columns * _PARTS
    # Light that goes on outside the picture has its middle anywhere.
    off_middle = np.abs(light.picture_middle - middles) / n_columns * (not reaches.any())
    terms = (
        inside @ light.light,
        inside @ (1 - light.coherent),
        inside @ light.steady / n_columns,
        off_middle,
        ~reaches @ hidden,
        _at(begins, border) + _at(ceases, border + width),
        _at(rises, border) + _at(falls, border + width),
        _at(brightens, border) + _at(fades, border + width),
        _paired(rises, falls, border + width // 2, width),
        _between(light.sides, np.stack([starts, ends], axis=1) / n_columns, n_columns),
        _in_middle(light, middles, n_columns, aspect),
    )
    # Light across more columns than the screen has is not all the columns'.
    fills = bool(reaches.all()) and right - left < n_columns
    return starts, np.stack(terms, axis=1).astype(np.float64), fills


def _between(sides: FloatArray, screens: FloatArray, n_columns: int) -> FloatArray:
    """(F,) 0..1: how near the sides (Q, 2) of any bright part, columns, are to those of screens (F, 2), widths."""
    off = (sides[:, None] / n_columns - screens) / _SIDE_SD
    return np.asarray(np.exp(-0.5 * np.square(off).sum(axis=2)).max(axis=0, initial=0.0))


def _in_middle(light: LightProfile, middles: FloatArray, n_columns: int, aspect: float) -> FloatArray:
    """(F,) 0..1: how near the middle of a bright part as high as the screen, as of a film, is to the screen's."""
    off = (light.sides.mean(axis=1)[:, None] - middles) / n_columns / (_SIDE_SD / 2)
    missing = (light.heights[:, None] * aspect / n_columns - 1) / _HEIGHT_SD
    return np.asarray(np.exp(-0.5 * (off**2 + missing**2)).max(axis=0, initial=0.0))


def _paired(rises: FloatArray, falls: FloatArray, middle: IntArray, width: int) -> FloatArray:
    """(F,) strength of the edges that lie in pairs about each middle, both towards it or both away from it."""
    distance = np.arange(*(round(share * width) for share in _PAIRED))
    left, right = middle[:, None] - distance, middle[:, None] + distance
    inwards, outwards = (np.minimum(_at(a, left), _at(b, right)) for a, b in ((rises, falls), (falls, rises)))
    return np.asarray(np.linalg.norm(np.maximum(inwards, outwards), axis=1))


def _at(edges: FloatArray, number: IntArray) -> FloatArray:
    """Edges at borders of parts; none where there are no parts."""
    return np.asarray(edges[np.clip(number, 0, edges.size - 1)])


def _at_or_beside(values: FloatArray) -> FloatArray:
    """(P,) the largest of each value and its neighbours."""
    return np.asarray(np.maximum.reduce([np.roll(values, shift) for shift in (-1, 0, 1)]))
