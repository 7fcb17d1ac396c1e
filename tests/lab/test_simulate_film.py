"""Films on the screen: where a tear runs, how cells follow, what the backlight and the truth make of it."""

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from rxcli.errors import UsageError
from rxcli.lab.simulate.capture import Recording, prepare
from rxcli.lab.simulate.film import FILM_KINDS, Film, Player, draw_film
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.lab.simulate.transmitter import drive_screen
from rxcli.results.truth import Scorer, Truth
from rxcli.types import ColumnResult, FrameResult, PacketResult

SMALL = {"width_px": 200, "height_px": 112}
GREY = np.full((112, 200, 3), 128, np.uint8)


def scene_of(shows: str, **more: Any) -> Scene:
    """A small clip whose readout lasts 12.7 ms, of a coarse panel."""
    scene = preset("video-1080p", "paper-17k3").scaled(0.2, keep_readout=True)
    scene = replace(scene, screen=msgspec.structs.replace(scene.screen, **SMALL), picture="chelsea", panel=0.0)
    fields: dict[str, Any] = {"film": Film(shows), "n_frames": 3, "frame_rate_hz": 30.0}
    return replace(scene, **fields | more)


def player_of(film: Film) -> Player:
    return Player(film, GREY + np.arange(200, dtype=np.uint8)[:, None] // 4, lambda _: pytest.fail("driven"), 3, 0, 1)


def steps(response_s: float, black: bool = False) -> Player:
    """A player that shows black and white by turns, four refreshes each."""
    player = Player(
        Film("pan:0", response_s=response_s, black=black), GREY, lambda _: pytest.fail("not driven"), 1, 0, 1
    )
    dark, bright = (drive_screen(scene_of("").screen, np.full_like(GREY, grey), 5, "none") for grey in (0, 255))
    object.__setattr__(player, "drive", lambda number: bright if number // 4 % 2 else dark)
    return player


def test_cells_follow_exponentially_and_black_frames_come_between() -> None:
    keep = np.exp(-1 / (60 * 8e-3))
    assert [float(light.mean()) for light in steps(8e-3).panel(408)] == pytest.approx([1e-3, 0.99], abs=1e-3)
    left = [float(steps(8e-3).panel(409 + n)[1].mean()) for n in range(3)]
    assert left == pytest.approx([keep ** (n + 1) for n in range(3)], abs=2e-3)
    assert steps(1e-3, black=True).panel(405)[0].max() < 2e-3 < 0.9 < steps(1e-3).panel(405)[0].min()


def test_a_tear_runs_where_the_panel_is_written() -> None:
    """Rows above the line that is written show the new picture, those below it the old one."""
    film = Film("cut:1", response_s=1e-5, scan=0.5)
    take = prepare(scene_of("", film=film, blur_px=0.01, frame_rate_hz=25.0), 4)
    player, torn = take.player, 0
    assert player is not None
    for number in range(3):
        exposure, height = take.exposure(number), take.scene.sensor.height
        rows = np.arange(height, dtype=np.float64)
        places = exposure.pixels_to_screen(np.stack([np.full(height, 150.0), rows], axis=-1))
        inside = ((places > 0.02) & (places < 0.98)).all(axis=1)
        times_s = number / 25 + exposure.scene.sensor.row_times_s() + exposure.scene.exposure_s / 2
        written = np.floor(60 * times_s + player.refreshes(0.0) - 0.5 * places[:, 1]).astype(int)
        torn += len(set(written[inside])) > 1
        u, v = np.round(places * [200, 112] - 0.5).astype(int).T
        sent = np.array([player.panel(written[row])[0][v[row], u[row], 1] for row in np.flatnonzero(inside)])
        texture = (places * [200, 112] - 0.5 + 12).astype(np.float32)
        shown = exposure.panel(texture[:, None], 0)[0][inside, 0, 1]
        assert np.corrcoef(shown, sent)[0, 1] > 0.92
    assert torn


def test_the_twin_plain_has_the_same_payloads_noise_and_camera() -> None:
    take = prepare(scene_of("pan:3,1", hand_px=2.0), 7)
    rest, film = take.plain.truth("clip"), take.truth("clip")
    assert rest == film
    still = take.plain
    pictures = [recording.frame(2).rgb.astype(float) for recording in (take, still)]
    assert np.abs(pictures[0] - pictures[1]).mean() > 2
    # It is the simulator without any film.
    assert take.player is not None
    alone = scene_of("", picture=take.player.picture(take.player.start_number), hand_px=2.0)
    assert np.array_equal(prepare(alone, 7).frame(2).rgb, still.frame(2).rgb)


def dimmed() -> Recording:
    return prepare(scene_of("cut:1", w="dimming", n_frames=4), 3)


def test_weights_follow_the_film_and_stand_in_the_truth() -> None:
    take = dimmed()
    truth = take.truth("clip")
    weights = truth["w_of_burst"]
    assert len({tuple(w) for w in weights.values()}) > 1
    assert truth["w"] == next(iter(weights.values()))
    known = msgspec.convert(truth, Truth, str_keys=True)
    lit = take.link.slots(0, 4 * take.link.burst_slots)
    for burst in map(int, weights):
        first = lit[:, burst * take.link.burst_slots + 20 :][:, :10] if burst < 4 else None
        assert first is None or (first.sum(axis=1) == weights[str(burst)]).all()
        bits = [known.bits(burst, column) for column in range(20)]
        assert [len(text) for text in known.payload[burst]] == [2 * -(-n // 8) for n in bits]
    # The scorer takes a packet of a burst for right if its bits are those of the burst's weight.
    burst = known.frames[1].bursts[0].burst
    packet = PacketResult(0.0, 1.0, known.bits(burst, 4), known.payload[burst][4], confidence=1.0, ber_hat=0.0)
    column = ColumnResult(4, "ok", w=known.w_of_burst[burst][4], packets=(packet,))
    scorer = Scorer(known)
    scored = scorer.add(FrameResult("clip", 1, 0.0, "ok", columns=(column,)))
    assert scored.columns[0].packets[0].bit_errors == 0
    assert scorer.score().wrong_w == 0


def test_the_backlight_follows_from_burst_to_burst() -> None:
    exposures = [dimmed().exposure(number) for number in range(4)]
    parts = [[np.stack(shares) for _, shares in exposure.lit_by_drive] for exposure in exposures]
    assert max(map(len, parts)) == 2
    for exposure, mine in zip(exposures, parts, strict=True):
        assert sum(mine) == pytest.approx(np.stack(exposure.lit), abs=1e-9)


@pytest.mark.parametrize("kind", FILM_KINDS)
def test_drawn_films_move_and_are_the_same_for_a_seed(kind: str) -> None:
    film, again = (draw_film(kind, np.random.default_rng(5)) for _ in range(2))
    assert film == again
    player, twin = player_of(film), player_of(film)
    pictures = [player.picture(number) for number in range(0, 80, 8)]
    assert {picture.shape for picture in pictures} == {(112, 200, 3)}
    assert any((picture != pictures[0]).any() for picture in pictures)
    assert np.array_equal(pictures[3], twin.picture(24))


@pytest.mark.parametrize("shows", ["pan", "pan:x", "pan:nan", "pan:1,2,3", "tilt:4", "cut:0", "zoom:-1", "window:3"])
def test_what_is_no_film_is_refused(shows: str) -> None:
    with pytest.raises(UsageError, match="no part of a film"):
        Film(shows)
    with pytest.raises(UsageError, match="content_hz must be positive"):
        Film("pan:1", content_hz=0)


def test_a_camera_mixes_frames_over_time_and_moves_their_rows() -> None:
    plain = scene_of("", picture="chelsea")
    ways: list[dict[str, Any]] = [{}, {"averaged": 0.4}, {"averaged": 0.4, "averages_again": True}]
    takes = [prepare(replace(plain, **fields), 5) for fields in ways]
    frames, mixed, recursive = ([picture.astype(float) for picture in take.pictures()] for take in takes)
    assert np.array_equal(mixed[0], frames[0])
    assert np.abs(mixed[2] - 0.6 * frames[2] - 0.4 * frames[1]).max() < 0.51
    assert np.abs(recursive[2] - 0.6 * frames[2] - 0.4 * recursive[1]).max() < 0.51
    moved = prepare(replace(plain, warp=(0.02, 0.0)), 5)
    assert [np.abs(moved.frame(n).rgb - frames[n]).mean() > 2 for n in range(2)] == [True, True]
    assert np.array_equal(moved.frame(1).rgb, moved.frame(1).rgb)
    assert np.array_equal(moved.plain.frame(1).rgb, frames[1])
