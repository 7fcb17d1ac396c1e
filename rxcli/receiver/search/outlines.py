"""Outlines of the screens in a frame, given or proposed by the finder; or why there are none."""

from dataclasses import replace

import numpy as np

from rxcli.options import ReceiverOptions
from rxcli.profiles import ScreenProfile
from rxcli.receiver.decode.steady import periodic_share
from rxcli.receiver.frame.cache import FrameCache, key_of
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.plane.orientation import PORTRAIT
from rxcli.receiver.plane.read import turned
from rxcli.receiver.screen import find, geometry
from rxcli.receiver.screen.bright import bright_parts
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.screen.stripes import MIN_LEAN, common_stripes, stripe_lean
from rxcli.receiver.search.cameras import known_lens
from rxcli.receiver.search.settings import SETTINGS
from rxcli.types import FloatArray, Frame, Remark

#: Log-odds of the box around stripes against a bright part with four straight sides.
_BOX_LOG_ODDS = -50.0


def proposed_screens(cache: FrameCache, options: ReceiverOptions) -> list[list[Outline]] | Failure:
    """Candidate outlines, at least one, of every screen in a frame; or why there are none."""
    frame = cache.frame
    refused = unreadable_orientation(frame)
    if refused is not None:
        return refused
    if options.corners is not None:
        with cache.timer("geometry"):
            return outside_the_picture(options.corners, frame) or [[_given(options.corners, cache, options)]]
    found = possible_screens(cache, options)
    without = [] if found else without_borders(cache)
    if found or without:
        return found or [without]
    if "no_screen" in options.skip or not may_fill(frame):
        return no_screen(cache)
    return [[Outline(whole_picture(frame), inferred=geometry.SIDE_NAMES, column_offset=None)]]


def without_borders(cache: FrameCache) -> list[Outline]:
    """Outlines of a screen without borders of columns, as all send the same, or one alone; none without stripes."""
    frame = cache.frame
    if not may_fill(frame):
        return []
    with cache.timer("geometry"):
        striped = cache.once("striped", lambda: find.striped_box(cache.plane))
    if striped is None:
        return []
    own = Outline(striped, SETTINGS.sure_certainty, column_offset=None, family=-1, stands_out=False)
    bright = _parts(cache)[0]
    found = [own]
    if bright is not None:  # Sides that are seen are nearer than those of stripes.
        found = [replace(own, corners=bright, family=-2), replace(own, log_odds=_BOX_LOG_ODDS)]
    return [_viewed(outline, frame) for outline in found]


def _parts(cache: FrameCache) -> list[FloatArray | None]:
    """Corners of the bright parts of a picture."""
    return cache.once("parts", lambda: bright_parts(cache.plane))


def _viewed(outline: Outline, frame: Frame) -> Outline:
    """An outline with its corners in the viewer's order."""
    return replace(outline, corners=geometry.viewer_order(outline.corners, frame.metadata.orientation))


def no_screen(cache: FrameCache) -> Failure:
    """Failure of a picture without a screen."""
    return Failure(reason_for_none(cache), "no_screen")


def _given(corners: FloatArray, cache: FrameCache, options: ReceiverOptions) -> Outline:
    """The outline that a user gave, with the number of columns if they are narrow."""
    narrow = [layout for layout in layouts_of(options) if layout.is_narrow]
    if len(narrow) != 1 or len(options.screens) == 1 or not find.shows_narrow(cache.plane):
        return Outline(corners)
    return Outline(corners, n_columns=narrow[0].n_columns)


def possible_screens(cache: FrameCache, options: ReceiverOptions) -> list[list[Outline]]:
    """Outlines that the finder proposes of every screen."""
    layouts, frame = layouts_of(options), cache.frame
    lens = known_lens(frame, options)
    with cache.timer("geometry"):
        key = ("screens", *layouts, key_of(lens))
        parts = [part for part in _parts(cache) if part is not None]
        screens = cache.once(key, lambda: find.find_screens(cache.plane, layouts, lens, parts))
    wide = [layout.n_columns for layout in layouts if not layout.is_narrow]

    def viewed(outline: Outline) -> Outline:
        """The outline with its corners in the viewer's order; the only wide layout may be that of any screen."""
        outline = _viewed(outline, frame)
        return replace(outline, n_columns=None if wide == [outline.n_columns] else outline.n_columns)

    return [[viewed(outline) for outline in screen] for screen in screens]


def layouts_of(options: ReceiverOptions) -> list[find.ColumnLayout]:
    """Column layouts of the screen profiles, in ascending order of columns."""
    by_columns = {screen.columns: screen for screen in options.screens}
    return [find.ColumnLayout(n, by_columns[n].light_spread, by_columns[n].aspect) for n in sorted(by_columns)]


def unreadable_orientation(frame: Frame) -> Failure | None:
    """Failure of a picture whose readout runs along the columns' width, or None."""
    orientation = frame.metadata.orientation
    if orientation not in PORTRAIT:
        return None
    return Failure(Remark("portrait", {"orientation": orientation}))


def outside_the_picture(corners: FloatArray, frame: Frame) -> Failure | None:
    """Failure of a given outline that shows too little of the screen, or None."""
    import cv2

    size = {"width": frame.width, "height": frame.height}
    if (np.ptp(corners, axis=0) > SETTINGS.largest_outline * np.array([frame.width, frame.height])).any():
        return Failure(Remark("corners_far", size), "no_screen")
    right, bottom = frame.width - 0.5, frame.height - 0.5
    picture = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]], np.float32)
    outline = np.asarray(corners, np.float32)
    shared, part = cv2.intersectConvexConvex(outline, picture)
    if shared <= max(SETTINGS.min_overlap * min(cv2.contourArea(outline), frame.width * frame.height), 1.0):
        return Failure(Remark("corners_outside", size), "no_screen")
    n_rows = int(np.ptp(np.asarray(part)[..., 1]))
    if n_rows < SETTINGS.min_rows:
        facts = {"n_rows": n_rows, "min_rows": SETTINGS.min_rows}
        return Failure(Remark("corners_few_rows", facts), "no_screen")
    return None


def may_fill(frame: Frame) -> bool:
    """Whether the picture is large enough, and not too tall, to receive a screen that fills it."""
    return min(frame.width, frame.height) >= SETTINGS.min_rows and frame.height <= find.MAX_TALL * frame.width


def whole_picture(frame: Frame) -> FloatArray:
    """Corners (4, 2) of the picture itself, the viewer's top left first, for a screen that fills the picture."""
    right, bottom = frame.width - 1.0, frame.height - 1.0
    corners = np.array([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]])
    return geometry.viewer_order(corners, frame.metadata.orientation)


def lean_of(cache: FrameCache) -> float:
    """See `stripe_lean`."""
    return cache.once("lean", lambda: stripe_lean(cache.frame.pixels))


def may_be_turned(cache: FrameCache, options: ReceiverOptions) -> bool:
    """Whether a photograph may have been turned after it was taken: its stripes run downwards, as its rows do."""
    frame = cache.frame
    if not may_fill(frame) or frame.mosaic is not None or lean_of(cache) > -MIN_LEAN:
        return False
    layouts = [layout for layout in layouts_of(options) if not layout.is_narrow]
    shown = (screen[0] for screen in possible_screens(cache, options))
    upright = max((outline.contrast for outline in shown if outline.stands_out), default=0.0)
    lying = next(iter(find.find_screens(turned(cache.plane), layouts)), [])
    return bool(lying) and lying[0].stands_out and lying[0].contrast >= upright


def common_light(frame: Frame) -> Remark | None:
    """What shows the same stripes in all columns: a screen on its side, or light without data; None of others."""
    likeness, stripes = common_stripes(frame.pixels)
    if likeness < SETTINGS.min_common_light:
        return None
    is_even = periodic_share(stripes[None], stripes.size // SETTINGS.min_even_stripes) > SETTINGS.even_share
    return Remark("steady_light" if is_even else "on_its_side")


def useless(frame: Frame) -> Remark | None:
    """Why a frame shows nothing of any screen, or None."""
    return find.why_useless(frame.pixels, *_range_of(frame))


def _range_of(frame: Frame) -> tuple[float, float]:
    """Black and white of a frame's pixels."""
    levels = frame.mosaic
    return (frame.black, frame.white) if levels is None else (float(np.mean(levels.black)), levels.white)


def reason_for_none(cache: FrameCache) -> Remark:
    """Why no screen was found in a frame."""
    frame = cache.frame
    if (reason := useless(frame)) is not None:
        return reason
    is_striped = frame.mosaic is None and lean_of(cache) > MIN_LEAN
    common = common_light(frame) if is_striped else None
    mean = float(find.thinned(frame.pixels, *_range_of(frame)).mean())
    # Rows have noise in common in the dark.
    if mean < SETTINGS.dark_mean and (common is None or common.reason == "on_its_side"):
        return Remark("no_columns_dark", {"mean_percent": 100 * max(mean, 0.0)})
    if is_striped:
        return common or Remark("no_columns_striped")
    return Remark("no_columns" if _parts(cache)[0] is None else "lit")


def too_small(context: FrameContext, screen: ScreenProfile) -> Remark | None:
    """Remark if no packet of `screen` fits the rows that show it, or None."""
    frame, camera = context.frame, context.camera
    fill = float(np.ptp(np.clip(context.sampled_corners[:, 1], 0, frame.height - 1))) / frame.height
    needed = screen.packet_s / (camera.line_delay_s * frame.height)
    if fill >= needed:
        return None
    facts = {"fill_percent": np.floor(100 * fill), "needed_percent": np.ceil(100 * needed), "share": fill / needed}
    facts["slot_rate_hz"] = screen.slot_rate_hz
    return Remark("screen_fills_little" if needed < 1 else "packet_too_long", facts)
