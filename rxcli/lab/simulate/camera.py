"""The camera: what light reaches every pixel during its row's exposure.

Electrons of a pixel are `T(u, v) * sum over columns c of K_c(u, v) * m_c(row) + room`. `T` is the picture (sharp),
`K_c` the light of column `c` (smooth, so it is evaluated on a coarse grid), `m_c` the share of the row's exposure in
which the column was lit (exact). Focus blur is applied to `T`: it mixes places, and one row remains one instant.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rxcli.lab.simulate.film import Player
from rxcli.lab.simulate.motion import HandMotion, turned, turned_back
from rxcli.lab.simulate.optics import CORNERS, Float32Array, FloatArray, View, between_nodes, grid_nodes, project
from rxcli.lab.simulate.scenes import Scene
from rxcli.lab.simulate.sensor import count_electrons, pick_colours, to_raw
from rxcli.lab.simulate.shutter import flicker, lit_share
from rxcli.lab.simulate.transmitter import Drive, Link, light_spread

#: Pitch of the coarse grid in rows, and rows of one band of work (a multiple of it).
_GRID_ROWS = 32
_BAND_ROWS = 256
#: Pitch of the nodes between which places in the texture are interpolated.
_PLACES_PITCH = 16
#: Texture pixels of black around the panel, so that blur can run out of it.
_TEXTURE_MARGIN = 12
#: Rounds after which a place of the screen is on the row that is read when it is there.
_MOTION_ROUNDS = 4
#: Places across and down at which the heights that rows see are sampled.
_HEIGHTS = 40
#: Decay times after which light has gone, and points across the sensor at which the light that glares is sampled.
DECAY_TIMES, _GLARE_POINTS = 8, 200
#: Breadth of the dark frame around the panel, in screen widths.
_BEZEL_WIDTHS = 0.035
#: Height at which a desk mirrors the screen, screen heights from its top; a person's head, its width against the
#: shoulders' and its height; and the share of the room's light that clothes throw back.
_DESK_TOP, _HEAD_SHARE, _HEAD_HEIGHT, _CLOTHES = 1.06, 0.45, 0.3, 0.2
#: Sensor pixels per panel pixel from which the three colour stripes of one can be resolved.
_RESOLVED_PX = 1.2


@dataclass(frozen=True)
class Exposure:
    """One picture to be taken: scene, clock and light, ready to be computed band by band."""

    #: What is shown and taken, with the light and focus of this picture.
    scene: Scene
    view: View
    drive: Drive
    link: Link
    #: Slot of the common clock at which row 0 starts to integrate.
    start_slot: float
    #: Slots a second, error included.
    slot_rate_hz: float
    #: (columns,) delay of every column in slots.
    delays: FloatArray
    #: Time of row 0 from the start of the clip, seconds.
    start_s: float = 0.0
    #: How the camera moves meanwhile; None for one on a tripod.
    motion: HandMotion | None = None
    #: The film that the screen shows; None for the picture of `drive` at rest.
    player: Player | None = None

    @cached_property
    def row_start_slots(self) -> FloatArray:
        """(height,) slot of the common clock at which every row starts to integrate."""
        return np.asarray(self.start_slot + self.scene.sensor.row_times_s() * self.slot_rate_hz)

    def pixels_to_screen(self, pixels: FloatArray) -> FloatArray:
        """Screen places (u, v) of sensor places (..., 2), each row at the middle of its own exposure."""
        if self.motion is None:
            return self.view.pixels_to_screen(pixels)
        ideal = turned_back(self.view.pixels_to_ideal(pixels), self._motion_of_rows(pixels[..., 1]))
        return project(np.asarray(np.linalg.inv(self.view.to_normalised)), ideal)

    def screen_to_pixels(self, places: FloatArray) -> FloatArray:
        """Sensor places (..., 2) of screen places (u, v); the inverse of `pixels_to_screen`."""
        if self.motion is None:
            return self.view.screen_to_pixels(places)
        at_rest = project(self.view.to_normalised, places)
        pixels = self.view.ideal_to_pixels(at_rest)
        for _ in range(_MOTION_ROUNDS):
            pixels = self.view.ideal_to_pixels(turned(at_rest, self._motion_of_rows(pixels[..., 1])))
        return pixels

    def lit_places(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Screen places (u, v) whose light sensor places (..., 2) see, on the screen or in a desk, and its share."""
        place = self.pixels_to_screen(pixels)
        mirrored = (place[..., 1] > _DESK_TOP) & (self.scene.room.desk > 0)
        place[..., 1] = np.where(mirrored, 2 * _DESK_TOP - place[..., 1], place[..., 1])
        return place, np.where(mirrored, self.scene.room.desk, 1.0)

    @cached_property
    def corners(self) -> FloatArray:
        """(4, 2) sensor places of the screen's corners, top-left first, clockwise for a viewer."""
        return self.screen_to_pixels(CORNERS)

    def _motion_of_rows(self, rows: FloatArray) -> FloatArray:
        """(..., 4) how far the camera has moved when the rows are in the middle of their exposure."""
        assert self.motion is not None
        return self.motion.at(self._middles_s(rows))

    def _middles_s(self, rows: FloatArray) -> FloatArray:
        """Time of the clip in the middle of the exposure of rows."""
        return self.start_s + rows * self.scene.sensor.line_delay_s + self.scene.exposure_s / 2

    def panel(self, places: Float32Array, top: int) -> list[Float32Array]:
        """For each kind of light (rows, width, 3) texture at places of it (rows, width, 2), of rows from `top` on."""

        def at_places(textures: tuple[Float32Array, ...]) -> list[Float32Array]:
            flags: dict[str, int] = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_CONSTANT}
            return [np.asarray(cv2.remap(texture, places, None, **flags)) for texture in textures]

        if self.player is None:
            return at_places(self.textures[0][0])
        lines = self.drive.grey.shape[0] * self.texture_scale[0]
        height = np.clip((places[..., 1] + 0.5 - _TEXTURE_MARGIN) / lines, 0, 1)
        middles_s = self._middles_s(top + np.arange(len(places), dtype=np.float64))
        begun = self.player.refreshes(middles_s[:, None], height)
        number = np.clip(np.floor(begun), self.refreshes[0], self.refreshes[-1])
        old = np.exp((number - begun) / (self.scene.film.refresh_hz * self.scene.film.response_s)).astype(np.float32)
        images = [np.zeros((*height.shape, 3), np.float32) for _ in self.decays]
        for refresh, textures in zip(self.refreshes, self.textures, strict=True):
            if (here := number == refresh).any():
                for image, new, before in zip(images, *map(at_places, textures), strict=True):
                    image[here] = (new + old[..., None] * (before - new))[here]
        return images

    @property
    def exposure_slots(self) -> float:
        """Exposure in slots."""
        return self.scene.exposure_s * self.slot_rate_hz

    @property
    def decays(self) -> tuple[float, ...]:
        """Time to 1/e of each kind of light, slots: 0 of that which goes out at once, then of the red that lags."""
        red = self.scene.red_lag_s * self.slot_rate_hz
        return (0.0, red) if red else (0.0,)

    @cached_property
    def lit(self) -> tuple[FloatArray, ...]:
        """For each kind of light (height, columns) share of every row's exposure in which a column is lit."""
        return self._lit(*self._slots)

    @cached_property
    def lit_by_drive(self) -> list[tuple[Drive, tuple[FloatArray, ...]]]:
        """What the backlight was driven with, and `lit` by the slots of that time: in a film, a part for each burst."""
        if self.player is None:
            return [(self.drive, self.lit)]
        first_slot, slots = self._slots
        bursts = (first_slot + np.arange(slots.shape[1])) // self.link.burst_slots
        return [(self.player.drive_in(int(b)), self._lit(first_slot, slots * (bursts == b))) for b in np.unique(bursts)]

    @cached_property
    def _slots(self) -> tuple[int, NDArray[Any]]:
        """Number of the first slot that the frame shows, and (columns, slots) all of them."""
        starts = self.row_start_slots
        first_slot = max(int(np.floor(starts[0] - self.delays.max() - DECAY_TIMES * self.decays[-1])), 0)
        last_slot = int(np.ceil(starts[-1] + self.exposure_slots - self.delays.min())) + 1
        first_slot = min(first_slot, int(np.floor(starts[0] - self.delays.max())) - 1)
        return first_slot, self.link.slots(first_slot, last_slot)

    def _lit(self, first_slot: int, slots: NDArray[Any]) -> tuple[FloatArray, ...]:
        starts = self.row_start_slots - self.delays[:, None] - first_slot
        delayed = list(zip(slots, starts, self.link.weights / 10, strict=True))
        return tuple(
            np.stack([lit_share(column, start, self.exposure_slots, decay, w) for column, start, w in delayed], axis=1)
            for decay in self.decays
        )

    @cached_property
    def room_rows(self) -> FloatArray:
        """(height,) electrons of a green pixel that sees white paper in the room's light."""
        starts = self.start_s + self.scene.sensor.row_times_s()
        wave = flicker(starts, self.scene.exposure_s, self.scene.room.flicker_hz, self.scene.room.flicker_depth, 0.0)
        return wave * (self.scene.room.light_e_per_s * self.scene.exposure_s)

    @cached_property
    def glare_rows(self) -> FloatArray:
        """(height, 3) electrons of every colour that glare adds to a row: a share of the mean at that instant."""
        sensor, step = self.scene.sensor, self.scene.sensor.width // _GLARE_POINTS + 1
        x, y = (np.arange(0, size, step, dtype=np.float64) for size in (sensor.width, sensor.height))
        places = _in_texture(self, x, y)
        light, total = column_light(self, x, y, self.drive), np.zeros((sensor.height, 3))
        for texture, lit in zip(self.textures[-1][0], self.lit, strict=True):
            image = cv2.remap(texture, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
            total += lit @ np.einsum("ycx,yxk->ck", light, image) / image[..., 0].size
        return np.asarray(total * self.scene.glare)

    @cached_property
    def grid_pitch(self) -> int:
        """Pixels between nodes of the coarse grid across: a sixth of the light spread, a power of two."""
        sigma_px = max(self.link.screen.light_spread, 0.1) * self.view.pixels_per_width / self.link.screen.columns
        return int(2 ** np.clip(np.floor(np.log2(max(sigma_px / 6, 1))), 0, 4))

    @cached_property
    def grid_rows(self) -> int:
        """Rows between nodes of the coarse grid."""
        sigma_px = max(self.link.screen.light_spread, 0.1) * self.view.pixels_per_height / self.link.screen.segment_rows
        return int(2 ** np.clip(np.floor(np.log2(max(sigma_px / 6, 1))), 0, np.log2(_GRID_ROWS)))

    @cached_property
    def texture_scale(self) -> tuple[int, int]:
        """Texture pixels per panel pixel, down and across: three where its colour stripes can be resolved, else one."""
        magnification = self.view.pixels_per_width / self.drive.grey.shape[1]
        return (3, 3) if self.scene.panel > 0 and magnification > _RESOLVED_PX else (1, 1)

    @cached_property
    def refreshes(self) -> range:
        """Refreshes of a film that the frame shows."""
        if self.player is None:
            return range(1)
        rows = np.linspace(0, self.scene.sensor.height - 1, _HEIGHTS)
        x = np.linspace(0, self.scene.sensor.width - 1, _HEIGHTS)
        heights = np.clip(self.pixels_to_screen(np.stack(np.meshgrid(x, rows), axis=-1))[..., 1], 0, 1)
        begun = self.player.refreshes(self._middles_s(rows)[:, None], heights)
        return range(int(np.floor(begun.min())), int(np.floor(begun.max())) + 1)

    @cached_property
    def textures(self) -> list[list[tuple[Float32Array, ...]]]:
        """For each of `refreshes` what it writes and, in a film, what it finds; for each kind of light (h, w, 3).

        Electrons of the sensor's colours per unit of green light, blurred, with a black margin around the panel.
        """
        panels = [(self.drive.transmittance,)] if self.player is None else map(self.player.panel, self.refreshes)
        shown = 1 - _person(self.scene, *self.drive.grey.shape[:2])[..., None]
        lagging = self.scene.red_lag_share * (len(self.decays) > 1)
        kinds = np.array([[1 - lagging, 1, 1], [lagging, 0, 0]], np.float32)[: len(self.decays)]
        return [
            [tuple(self._texture(light * shown * colours) for colours in kinds) for light in lights]
            for lights in panels
        ]

    def _texture(self, light: Float32Array) -> Float32Array:
        down, across = self.texture_scale
        fine = np.repeat(np.repeat(light, down, axis=0), across, axis=1)
        if across > 1:
            _draw_pixel_structure(fine, self.scene.panel)
        colours = cv2.transform(fine, self.scene.sensor.colour_matrix.astype(np.float32))
        margins = (_TEXTURE_MARGIN,) * 4
        colours = cv2.copyMakeBorder(colours, *margins, cv2.BORDER_CONSTANT, value=0)
        # A sensor pixel is a box of side 1, whose variance 1/12 the Gaussian takes along.
        sigma_px = np.sqrt(self.scene.blur_px**2 + 1 / 12)
        x_per_pixel = light.shape[1] * across / self.view.pixels_per_width
        y_per_pixel = light.shape[0] * down / self.view.pixels_per_height
        sigmas = [max(sigma_px * scale, 1e-3) for scale in (x_per_pixel, y_per_pixel)]
        return np.asarray(cv2.GaussianBlur(colours, (0, 0), sigmaX=sigmas[0], sigmaY=sigmas[1]), np.float32)


def _person(scene: Scene, height: int, width: int) -> Float32Array:
    """(height, width) 1 where a person covers the panel, else 0."""
    room = scene.room
    v, u = np.mgrid[:height, :width] / [[[height]], [[width]]]
    across, down = (
        np.abs(u - room.person_place[0]) / max(room.person / 2, 1e-9),
        (v - room.person_place[1]) / _HEAD_HEIGHT,
    )
    is_head = (across / _HEAD_SHARE) ** 2 + (2 * down - 1) ** 2 < 1
    is_body = (across < 1) & (across**2 / 4 < down - 0.8)
    return np.asarray((room.person > 0) * (is_head | is_body), np.float32)


def _draw_pixel_structure(fine: Float32Array, depth: float) -> None:
    """Colour stripes and the dark line below each pixel; every colour keeps its mean."""
    for colour in range(3):
        for stripe in range(3):
            fine[:, stripe::3, colour] *= np.float32(1 - depth + (3 * depth if stripe == colour else 0))
    for line, gain in enumerate((1 + 0.5 * depth, 1 + 0.5 * depth, 1 - depth)):
        fine[line::3] *= np.float32(gain)


def column_light(exposure: Exposure, x: FloatArray, y: FloatArray, drive: Drive) -> Float32Array:
    """Electrons that each column's light gives a green pixel behind clear panel, lit for the whole exposure.

    Args:
        exposure: the picture to be taken.
        x: (nx,) sensor columns.
        y: (ny,) sensor rows.
        drive: of the backlight at that time.

    Returns:
        (ny, columns, nx) float32.
    """
    screen = exposure.link.screen
    pixels = np.stack(np.meshgrid(x, y), axis=-1)
    place, share = exposure.lit_places(pixels)
    half = np.array([exposure.scene.sensor.width, exposure.scene.sensor.height]) / 2
    radius2 = (((pixels - half) / half) ** 2).sum(axis=-1) / 2
    vignette = 1 - exposure.scene.vignetting * radius2
    gain = exposure.scene.light_e_per_s * exposure.scene.exposure_s * vignette * share
    widths = screen.light_spread, exposure.scene.spread_tails
    along = light_spread(place[..., 1], screen.segment_rows, *widths) @ drive.lit_light
    along *= light_spread(place[..., 0], screen.columns, *widths)
    along *= gain[..., None]
    return np.ascontiguousarray(along.transpose(0, 2, 1), np.float32)


@dataclass(frozen=True)
class Band:
    """Expected light of some rows."""

    top: int
    #: For each kind of light (rows, width[, 3]) picture as the sensor's colours see it, per unit of green light.
    pictures: tuple[Float32Array, ...]
    #: For each kind of light (rows, width) electrons of green light from all columns.
    backlights: tuple[Float32Array, ...]
    #: (rows, width[, 3]) electrons of the room's light and of glare.
    room: Float32Array

    @cached_property
    def mean_e(self) -> Float32Array:
        """(rows, width[, 3]) expected electrons."""
        mean = self.room.copy()
        for picture, light in zip(self.pictures, self.backlights, strict=True):
            mean += picture * (light if picture.ndim == 2 else light[..., None])
        return mean


def render_band(exposure: Exposure, top: int, bottom: int) -> Band:
    """Expected light of the sensor rows `top` to `bottom`."""
    sensor, pitch = exposure.scene.sensor, exposure.grid_pitch
    x, y = grid_nodes(sensor.width, _PLACES_PITCH), grid_nodes(bottom - top, _PLACES_PITCH) + top
    places = between_nodes(_in_texture(exposure, x, y), _PLACES_PITCH, bottom - top, sensor.width)
    pictures = tuple(pick_colours(picture, sensor.pattern, top) for picture in exposure.panel(places, top))
    backlights = []
    for nodes in _backlight_nodes(exposure, grid_nodes(sensor.width, pitch), top, bottom):
        light = cv2.resize(nodes, (nodes.shape[1] * pitch, nodes.shape[0]), interpolation=cv2.INTER_LINEAR)
        backlights.append(np.ascontiguousarray(light[:, pitch : pitch + sensor.width], np.float32))
    return Band(top, pictures, tuple(backlights), _other_light(exposure, top, bottom))


def _in_texture(exposure: Exposure, x: FloatArray, y: FloatArray) -> Float32Array:
    """(ny, nx, 2) places in the texture of sensor columns (nx,) and rows (ny,)."""
    place, _ = exposure.lit_places(np.stack(np.meshgrid(x, y), axis=-1))
    down, across = exposure.texture_scale
    panel_height, panel_width = exposure.drive.grey.shape[:2]
    scale = np.array([panel_width * across, panel_height * down])
    return np.asarray(np.clip(place * scale - 0.5 + _TEXTURE_MARGIN, -1e4, 1e5), np.float32)


def _backlight_nodes(exposure: Exposure, x: FloatArray, top: int, bottom: int) -> list[Float32Array]:
    """For each kind of light (rows, nodes) electrons: the columns' light, interpolated along rows, times lit shares."""
    pitch = exposure.grid_rows
    n_cells = -(-(bottom - top) // pitch)
    share = (np.arange(pitch, dtype=np.float32) / pitch)[None, :, None]
    found = [np.zeros((bottom - top, x.size), np.float32) for _ in exposure.decays]
    for drive, lit_shares in exposure.lit_by_drive:
        light = column_light(exposure, x, top + pitch * np.arange(n_cells + 1.0), drive)
        pairs = np.concatenate([light[:-1], light[1:]], axis=1)
        for nodes, shares in zip(found, lit_shares, strict=True):
            padded = np.zeros((n_cells * pitch, shares.shape[1]), np.float32)
            padded[: bottom - top] = shares[top:bottom]
            lit = padded.reshape(n_cells, pitch, -1)
            ends = np.concatenate([lit * (1 - share), lit * share], axis=2)
            nodes += np.matmul(ends, pairs).reshape(n_cells * pitch, -1)[: bottom - top]
    return found


def _other_light(exposure: Exposure, top: int, bottom: int) -> Float32Array:
    """Electrons of the room's light, from walls, bezel, panel and a mirrored lamp, and of glare."""
    light = _room_share(exposure, top, bottom) * exposure.room_rows[top:bottom, None].astype(np.float32)
    colours = light[..., None] * np.array(exposure.scene.sensor.response, np.float32)
    if exposure.scene.glare:
        colours += exposure.glare_rows[top:bottom, None].astype(np.float32)
    return pick_colours(colours, exposure.scene.sensor.pattern, top)


def _room_share(exposure: Exposure, top: int, bottom: int) -> Float32Array:
    """(rows, width) share of the room's light that every pixel sees, against white paper."""
    pitch, room, screen = 8, exposure.scene.room, exposure.link.screen
    x, y = grid_nodes(exposure.scene.sensor.width, pitch), grid_nodes(bottom - top, pitch) + top
    place = exposure.pixels_to_screen(np.stack(np.meshgrid(x, y), axis=-1))
    # Pixels outside the screen's edge, negative inside; edges are ramps two nodes wide, as the grid can carry them.
    beyond = ((np.abs(place - 0.5) - 0.5) * [1.0, 1 / screen.aspect]).max(axis=-1) * exposure.view.pixels_per_width
    bezel_px = _BEZEL_WIDTHS * exposure.view.pixels_per_width
    on_wall, off_panel = (np.clip((beyond - edge) / (2 * pitch) + 0.5, 0, 1) for edge in (bezel_px, 0.0))
    from_lamp = np.abs((place - np.array(room.lamp_place)) * [1.0, 1 / screen.aspect]) / room.lamp_size
    panel = room.panel_reflectance + room.lamp * np.exp(-0.5 * (from_lamp**room.lamp_edge).sum(axis=-1))
    if room.person:
        size = exposure.drive.grey.shape[:2]
        at = np.clip(place[..., ::-1] * size, 0, np.array(size) - 1).astype(np.intp)
        panel += (_CLOTHES - panel) * _person(exposure.scene, *size)[at[..., 0], at[..., 1]]
    frame = room.bezel_reflectance + (room.wall_reflectance - room.bezel_reflectance) * on_wall
    share = (panel + (frame - panel) * off_panel).astype(np.float32)
    return between_nodes(share, pitch, bottom - top, exposure.scene.sensor.width)


BandVisitor = Callable[[Band, Float32Array], None]


def take_picture(
    exposure: Exposure, seed: int, threads: int = 2, visit: BandVisitor | None = None
) -> NDArray[np.uint16]:
    """Expose and read out one picture.

    Args:
        exposure: what is taken.
        seed: of all noise; the same seed gives the same pixels, whatever the number of threads.
        threads: bands computed at the same time.
        visit: called with every band and the electrons read of it, for those who need the truth behind the pixels.

    Returns:
        (height, width) uint16 mosaic, or (height, width, 3) where the sensor has no filter array.
    """
    sensor = exposure.scene.sensor
    shape = (sensor.height, sensor.width) if sensor.pattern is not None else (sensor.height, sensor.width, 3)
    raw = np.empty(shape, np.uint16)
    # Shared by all bands: made once, before threads ask for them.
    _ = exposure.textures, exposure.lit_by_drive, exposure.room_rows, exposure.grid_pitch, exposure.grid_rows
    _ = exposure.glare_rows if exposure.scene.glare else None

    def work(rows: tuple[int, int]) -> None:
        band = render_band(exposure, *rows)
        rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence([seed, rows[0]])))
        mean = band.mean_e * sensor.pixel_gains(rows[0], band.mean_e.shape)
        electrons = count_electrons(mean, sensor, rng)
        raw[rows[0] : rows[1]] = to_raw(electrons, sensor)
        if visit is not None:
            visit(band, electrons)

    with ThreadPoolExecutor(max_workers=max(threads, 1)) as pool:
        tops = range(0, sensor.height, _BAND_ROWS)
        list(pool.map(work, [(top, min(top + _BAND_ROWS, sensor.height)) for top in tops]))
    return raw
