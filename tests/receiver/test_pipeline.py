"""Frames in, packets or reasons out: small simulated scenes from clean to hopeless, and what no receiver can read."""

import sys
from dataclasses import replace
from functools import cache
from typing import Any

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from small_scene import reception, scored

from rxcli.lab.benchmark.trial import Trial, simulate_trial
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.options import ReceiverOptions
from rxcli.profiles import CameraProfile, ScreenProfile, check_profile, load_profile, usual_screens
from rxcli.receiver import still
from rxcli.receiver.channel import denoise
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.passes import Reception, headerless
from rxcli.receiver.plane.orientation import as_received
from rxcli.receiver.receive import receive, receive_frame
from rxcli.receiver.search import Found, search
from rxcli.receiver.still import initial_pass
from rxcli.results.reasons import explained
from rxcli.results.truth import Score
from rxcli.types import Clock, Frame, FrameResult, Metadata

FloatArray = NDArray[np.float64]


def small_scene(screen: str, camera: str = "xs10-still", picture: str = "sky", electrons: float = 30.0) -> Scene:
    """A part of the width, rows enough for a packet and more, and `electrons` times the light, all else alike."""
    scene = replace(preset(camera, screen), picture=picture, start_slot=40.0)
    scene = scene.scaled(0.25, 0.7) if camera.startswith("phone") else scene.scaled(0.1, 0.5)
    return replace(
        scene,
        light_e_per_s=scene.light_e_per_s * electrons,
        room=replace(scene.room, light_e_per_s=scene.room.light_e_per_s * electrons),
        sensor=replace(scene.sensor, full_scale_e=scene.sensor.full_scale_e * electrons),
    )


@cache
def taken_of(screen: str, camera: str, picture: str, electrons: float, seed: int) -> Trial:
    return simulate_trial(small_scene(screen, camera, picture, electrons), seed)


def clean() -> Trial:
    return taken_of("paper-34k6", "xs10-still", "sky", 30.0, 1)


def received(trial: Trial, frame: Frame | None = None, **changes: Any) -> FrameResult:
    """The result of a trial's frame, or of another one, with screen, camera and corners named but for the changes."""
    (result,) = receive([frame or trial.frame], replace(trial.options(), **changes))
    return explained(result)


def score_of(result: FrameResult, trial: Trial) -> Score:
    return scored(result, trial.truth)[1]


def with_pixels(trial: Trial, pixels: NDArray[Any], **changes: Any) -> Frame:
    return replace(trial.frame, pixels=np.ascontiguousarray(pixels), **changes)


@pytest.mark.parametrize(
    ("screen", "camera"),
    [("paper-34k6", "xs10-still"), ("paper-17k3", "xs10-still"), ("paper-8k65", "phone-plain")],
)
def test_a_clean_frame_gives_every_packet(screen: str, camera: str) -> None:
    taken = taken_of(screen, camera, "sky", 30.0, 1)
    result = received(taken)
    score = score_of(result, taken)
    assert score.expected >= 20
    assert (score.error_free, score.false, score.wrong_w) == (score.expected, 0, 0)
    assert result.status == "ok"
    assert result.message is None
    assert result.screen_profile == screen
    assert [c.column for c in result.columns] == list(range(20))
    packets = result.packets
    assert min(p.confidence for p in packets) > 0.9
    assert all(c.snr_db is not None and c.snr_db > 5 for c in result.columns)


@cache
def proportioned() -> Trial:
    scene = replace(preset("xs10-still", "paper-8k65"), picture="sky", start_slot=20.0).scaled(0.25, keep_readout=True)
    return simulate_trial(replace(scene, light_e_per_s=2 * scene.light_e_per_s), 1)


def test_the_screen_is_found_in_a_frame_of_true_proportions() -> None:
    taken = proportioned()
    result = received(taken, corners=None)
    score = score_of(result, taken)
    assert score.expected >= 20
    assert score.error_free == score.expected
    off = np.linalg.norm(result.corners - taken.corners, axis=1)
    assert off.max() < 0.005 * np.ptp(result.corners[:, 0])


def test_stripes_bent_by_a_correction_in_the_camera() -> None:
    taken = taken_of("paper-17k3", "phone-corrected", "sky", 20.0, 2)
    score = score_of(received(taken), taken)
    assert score.expected >= 20
    assert score.error_free == score.expected
    assert score.false == 0


def test_raw_mosaic() -> None:
    scene = replace(small_scene("paper-34k6"), output="raw")
    taken = simulate_trial(scene, 4)
    score = score_of(received(taken), taken)
    assert score.error_free >= 0.9 * score.expected
    assert (score.false, score.wrong_w) == (0, 0)


@pytest.mark.parametrize(("factor", "known"), [(3, True), (10, False)])
def test_a_wrongly_stated_exposure_is_estimated_and_the_difference_is_said(factor: float, known: bool) -> None:
    taken = clean()
    stated_s = factor * taken.capture.scene.exposure_s
    frame = replace(taken.frame, metadata=Metadata(exposure_s=stated_s))
    result = received(taken, frame, **{} if known else {"cameras": (), "force_camera": False})
    assert score_of(result, taken).error_free == 20
    assert f"the stated exposure ({1e6 * stated_s:.0f} us)" in str(result.message)


@pytest.mark.parametrize("change", [{"line_delay_s": 7e-6}, {"width": 99}])
def test_a_profile_that_gives_no_packet_is_no_veto(change: dict[str, Any]) -> None:
    taken = clean()
    (mode,) = taken.camera.modes
    wrong = msgspec.structs.replace(taken.camera, modes=(msgspec.structs.replace(mode, **change),))
    result = received(taken, cameras=(wrong,))
    assert score_of(result, taken).error_free == 20
    assert result.camera_profile is None
    assert f"camera profile {taken.camera.name}" in str(result.message)


class CountedPixels(np.ndarray[Any, Any]):
    """Pixels that count how many of them are taken, and that cannot be computed with as a whole."""

    n_taken = 0
    __array_ufunc__ = None

    def __getitem__(self, key: Any) -> Any:
        taken = np.asarray(self)[key]
        self.n_taken += np.size(taken)
        return taken


def n_reads(frame: Frame, options: ReceiverOptions) -> tuple[float, str]:
    """How often each pixel of a frame is read on average, and the status."""
    pixels = frame.pixels.view(CountedPixels)
    (result,) = receive([replace(frame, pixels=pixels)], options)
    return pixels.n_taken / pixels.size, result.status


def test_every_pixel_of_a_still_is_read_once() -> None:
    taken = clean()
    assert n_reads(taken.frame, taken.options()) == (1.0, "ok")
    searched = ReceiverOptions(cameras=(), skip=frozenset())
    # Some lines of this narrow picture are read again to explain the refusal.
    assert 1.0 <= n_reads(taken.frame, searched)[0] < 1.3


def test_every_pixel_of_a_picture_without_a_screen_is_read_once_and_some_for_the_message() -> None:
    noise = np.random.default_rng(3).integers(0, 255, (400, 600), np.uint8)
    reads, status = n_reads(Frame(noise, "memory"), ReceiverOptions())
    assert status == "no_screen"
    assert 1.0 <= reads < 1.3  # of a small picture these are many


def test_upside_down() -> None:
    """Turned by half a turn on the sensor: time runs on, the columns run from right to left."""
    taken = clean()
    turned = with_pixels(taken, taken.frame.pixels[:, ::-1], metadata=Metadata(orientation=2))
    mirrored = taken.corners * [-1, 1] + [taken.frame.width - 1, 0]
    plain = msgspec.structs.replace(taken.camera, lens=None)
    score = score_of(received(taken, turned, corners=mirrored, cameras=(plain,)), taken)
    assert score.error_free >= 18
    assert score.false == 0


@pytest.mark.parametrize(
    ("electrons", "at_least", "at_most"), [(30.0, 16, 20), (1.0, 5, 20), (0.2, 0, 20), (0.02, 0, 0)]
)
def test_from_clean_to_hopeless_nothing_false(electrons: float, at_least: int, at_most: int) -> None:
    taken = taken_of("paper-34k6", "xs10-still", "coffee", electrons, 3)
    result = received(taken)
    score = score_of(result, taken)
    assert at_least <= score.error_free <= at_most
    assert score.false == 0
    sure = [p for p in scored(result, taken.truth)[0].packets if p.confidence > 0.9]
    assert sum(p.bit_errors != 0 for p in sure) <= max(1, 0.15 * len(sure))


@cache
def overexposed() -> Trial:
    """Thirty times too much light: nearly all slots are clipped."""
    scene = small_scene("paper-34k6")
    return simulate_trial(replace(scene, sensor=replace(scene.sensor, full_scale_e=180.0)), 1)


def test_overexposure_gives_nothing_that_is_believed() -> None:
    taken = overexposed()
    packets = scored(received(taken), taken.truth)[0].packets
    wrong = [p.confidence for p in packets if p.bit_errors != 0]
    assert max(wrong, default=0) < 0.9
    assert sum(confidence >= 0.5 for confidence in wrong) <= 1


@pytest.mark.parametrize(("budget", "least", "most"), [(1, 1, 1), (10**9, 10, 20)])
def test_the_network_is_shown_what_its_time_allows(
    monkeypatch: pytest.MonkeyPatch, budget: int, least: int, most: int
) -> None:
    """The least certain columns beyond that are left out."""
    shown: list[int] = []
    denoiser = denoise.load_denoiser()

    class Recording:
        name = denoiser.name

        def slot_corrections(self, scene: denoise.DenoiserInput, columns: NDArray[np.int64]) -> NDArray[np.float32]:
            shown.append(columns.size)
            return denoiser.slot_corrections(scene, columns)

    monkeypatch.setattr(still, "_denoiser", Recording)
    monkeypatch.setattr(still, "STILL", msgspec.structs.replace(still.STILL, max_network_slots=budget))
    taken = overexposed()
    report = received(taken).denoiser
    assert shown == [report["columns"]]
    assert least <= shown[0] <= most


def test_the_network_has_no_say_in_the_length_of_packets(monkeypatch: pytest.MonkeyPatch) -> None:
    """It knows where headers are, so what it corrected fits the length that was assumed."""
    seen: list[Reception] = []
    receiving = sys.modules["rxcli.receiver.receive"]
    framing_of, apply = receiving.framing_of, receiving.apply_autoencoder
    monkeypatch.setattr(receiving, "framing_of", lambda a, r, *rest: (seen.append(r), framing_of(a, r, *rest))[1])
    monkeypatch.setattr(receiving, "apply_autoencoder", lambda a, r, options: (seen.append(r), apply(a, r, options))[1])
    taken = overexposed()
    assert received(taken).denoiser["columns"] > 0
    assert all(judged is shown for judged, shown in zip(seen[::2], seen[1::2], strict=True))


def test_weights_that_differ_by_column() -> None:
    w = tuple(1 + column % 9 for column in range(20))
    scene = replace(small_scene("paper-34k6"), w=w)
    taken = simulate_trial(scene, 6)
    result = received(taken)
    assert [c.w for c in result.columns] == list(w)
    assert score_of(result, taken).error_free >= 18


@pytest.mark.parametrize("reach", [0.5, 2.0])
def test_columns_with_delays(reach: float) -> None:
    scene = replace(small_scene("paper-34k6"), column_delay_slots=reach, slot_rate_error_ppm=100.0)
    taken = simulate_trial(scene, 7)
    result = received(taken)
    score = score_of(result, taken)
    assert score.error_free >= 0.9 * score.expected
    assert not [p for p in scored(result, taken.truth)[0].packets if p.bit_errors and p.confidence >= 0.5]
    found = np.array([c.delay_slots for c in result.columns])
    off = found - np.array(taken.capture.truth["column_delay_slots"])
    assert np.quantile(np.abs(off - np.median(off)), 0.8) < 0.2


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_upright_columns_are_received_though_the_file_says_portrait(orientation: int) -> None:
    taken = clean()
    result = received(taken, replace(taken.frame, metadata=Metadata(orientation=orientation)))
    assert score_of(result, taken).error_free == 20
    assert "the columns stand upright in the stored picture" in str(result.message)


@pytest.mark.parametrize(
    ("quarter_turns", "note"), [(1, "turned back by 90 degrees clockwise"), (3, "degrees counter-"), (2, "upside down")]
)
def test_a_picture_that_was_turned_afterwards_is_received_turned_back(quarter_turns: int, note: str) -> None:
    taken = proportioned()
    frame = with_pixels(taken, np.rot90(taken.frame.pixels, quarter_turns))
    result = received(taken, frame, corners=None)
    assert note in str(result.message)
    upside_down = quarter_turns == 2
    assert score_of(result.with_columns_mirrored() if upside_down else result, taken).error_free >= 18
    assert result.quarter_turns == (0 if upside_down else 4 - quarter_turns)
    back, turned_back = as_received(frame, result)
    if not upside_down:
        assert np.array_equal(back.pixels, taken.frame.pixels)
        assert np.abs(turned_back.corners - taken.corners).max() < 8


def test_what_is_not_believed_stands_in_the_result() -> None:
    taken = clean()
    frame = replace(taken.frame, metadata=Metadata(not_believed=("EXIF orientation 3",)))
    assert received(taken, frame).message == "not believed: EXIF orientation 3"


def test_a_screen_too_small_says_how_much_it_needs() -> None:
    """One packet at 8.65 kHz lasts 8.09 ms: 34 % of the 24.1 ms of a whole readout."""
    taken = clean()
    height, width = 1040, taken.frame.width
    line_delay = 24.098e-3 / height
    mode = msgspec.structs.replace(taken.camera.modes[0], height=height, line_delay_s=line_delay)
    camera = msgspec.structs.replace(taken.camera, lens=None, modes=(mode,))
    pixels = np.full((height, width), 20, np.uint8)
    top, bottom = 300, 300 + round(0.251 * height)
    pixels[top:bottom, 100:500] = np.random.default_rng(0).choice([30, 160], bottom - top)[:, None]
    corners = np.array([[100.0, top], [499, top], [499, bottom], [100, bottom]])
    known = {"screens": (load_profile("paper-8k65", ScreenProfile),), "corners": corners}
    frame = with_pixels(taken, pixels)
    result = received(taken, frame, cameras=(camera,), **known)
    assert result.status == "no_signal"
    assert "the screen fills 25 % of the height: one packet at 8.65 kHz needs 34 % with this camera" in result.message
    quick = msgspec.structs.replace(camera, modes=(msgspec.structs.replace(mode, line_delay_s=line_delay / 4),))
    result = received(taken, frame, cameras=(quick,), **known)
    assert "a picture shows 19 % of a packet: send 6 more photos, or film" in result.message
    assert result.message.index("the screen may have no profile here") < result.message.index("a faster slot rate")


def without_signal(kind: str, taken: Trial) -> NDArray[np.uint8]:
    rng = np.random.default_rng(0)
    shape = taken.frame.pixels.shape
    if kind == "noise":
        return rng.integers(0, 256, shape, dtype=np.uint8)
    if kind == "still screen":
        pixels = np.full(shape, 12.0)
        pixels[200:1900, 20:600] = 120 + 40 * np.sin(np.arange(580) / 30.0)
        return np.clip(pixels + rng.normal(0, 2, shape), 0, 255).astype(np.uint8)
    if kind == "lamp at 100 Hz":
        rows = 90 + 40 * np.cos(2 * np.pi * 100 * 5.79e-6 * np.arange(shape[0]))
        return np.clip(rows[:, None] + rng.normal(0, 3, shape), 0, 255).astype(np.uint8)
    if kind == "random stripes":
        rows = np.repeat(rng.choice([30.0, 160.0], shape[0] // 5 + 1), 5)[: shape[0]]
        return np.clip(rows[:, None] + rng.normal(0, 2, shape), 0, 255).astype(np.uint8)
    return np.full(shape, {"black": 0, "saturated": 255, "grey": 128}[kind], np.uint8)


NOTHING = ["black", "saturated", "grey", "noise", "still screen", "lamp at 100 Hz", "random stripes"]


@pytest.mark.parametrize("given", [True, False], ids=["corners given", "corners searched"])
@pytest.mark.parametrize("kind", NOTHING)
def test_no_packet_where_none_was_sent(kind: str, given: bool) -> None:
    taken = clean()
    frame = with_pixels(taken, without_signal(kind, taken))
    result = received(taken, frame, **{} if given else {"corners": None})
    assert not result.packets
    assert result.status == ("no_signal" if given else result.status)
    assert result.status in {"no_screen", "no_signal"}
    assert result.message
    assert "\n" not in result.message


def test_a_picture_without_a_screen_is_stopped_at_once_unless_told_not_to() -> None:
    taken = clean()
    grey = with_pixels(taken, without_signal("grey", taken))
    stopped = received(taken, grey, corners=None)
    assert stopped.status == "no_screen"
    assert stopped.skipped == {"no_screen": 1}
    assert "clock" not in stopped.timing_ms
    tried = received(taken, grey, corners=None, skip=taken.options().skip - {"no_screen"})
    assert tried.status == "no_signal"
    assert "no_screen" not in tried.skipped
    assert "clock" in tried.timing_ms


def test_a_camera_without_this_size_is_named() -> None:
    taken = clean()
    result = received(taken, with_pixels(taken, taken.frame.pixels[:1000]))
    assert result.status == "no_signal"
    assert taken.camera.name in result.message
    assert f"{taken.frame.width} x 1000" in result.message


def test_min_confidence_leaves_out_what_is_less_sure() -> None:
    taken = taken_of("paper-34k6", "xs10-still", "coffee", 1.0, 3)
    everything = received(taken)
    sure = received(taken, min_confidence=0.9)
    assert sure.packets == tuple(p for p in everything.packets if p.confidence >= 0.9)


def test_stages_are_timed() -> None:
    taken = clean()
    timing = received(taken).timing_ms
    assert {"geometry", "sampling", "clock", "detect", "total"} <= timing.keys()
    assert timing["total"] >= max(value for name, value in timing.items() if name != "total")


def test_slots_of_few_rows_are_received_although_developing_mixes_rows() -> None:
    """At 1.7 rows a slot demosaicing blurs a slot more than an exposure of 0.4 slots does."""
    base = preset("phone-plain", "paper-17k3")
    scene = base.scaled(700 / base.sensor.width, 1.7 / base.rows_per_slot, keep_readout=True)
    exposure_s = 0.4 / scene.screen.slot_rate_hz
    light = scene.light_e_per_s * scene.exposure_s / exposure_s
    scene = replace(scene, exposure_s=exposure_s, light_e_per_s=light, picture="coffee", n_frames=1)
    trials = [simulate_trial(scene, seed) for seed in range(3)]
    mixed = [reception(trial, trial.options(cae="never"))[1] for trial in trials]
    assert sum(score.expected for score in mixed) == 60
    assert sum(score.error_free for score in mixed) >= 40
    # One in twenty may be wrong of packets that are as sure as that.
    assert sum(score.false for score in mixed) <= 1


def found_in(taken: Trial, **changes: Any) -> Found:
    found = search(FrameCache(taken.frame), replace(taken.options(), **changes))
    assert isinstance(found, Found)
    return found


def test_packets_determine_the_bursts_where_the_similarity_of_copies_leaves_doubt(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    taken = simulate_trial(replace(small_scene("paper-17k3", "phone-plain"), start_slot=300.0), 1)
    best = found_in(taken).best
    right = best.reception.clock.burst
    assert right.max() > 0
    assert list(still.in_other_bursts(best.acquisition, best.reception)) == []
    possible_bursts = still.sync.possible_bursts

    def least_similar_first(*given: Any) -> list[tuple[Clock, float]]:
        return [(clock, 0.0) for clock, _ in reversed(possible_bursts(*given))]

    monkeypatch.setattr(still.sync, "possible_bursts", least_similar_first)
    assert not np.array_equal(initial_pass(best.acquisition).clock.burst, right)
    assert np.array_equal(found_in(taken).best.reception.clock.burst, right)


def test_columns_full_of_codewords_have_packets_whether_their_header_shows_or_not() -> None:
    best = found_in(clean()).best
    reception = still.decode(best.acquisition, clean().options().skip, best.reception)
    assert not headerless(reception).any()
    unseen = replace(reception.posteriors, header_llr=np.full_like(reception.posteriors.header_llr, -30.0))
    assert not headerless(replace(reception, posteriors=unseen)).any()
    detected = still.detected(np.roll(reception.llr, 3, axis=1), reception.clock)
    moved = replace(unseen, log_evidence=detected.log_evidence)
    assert headerless(replace(reception, posteriors=moved)).all()


@pytest.mark.parametrize("screen", ["paper-8k65", "paper-17k3", "paper-34k6"])
def test_packets_tell_the_screen(screen: str) -> None:
    """Pictures with strong texture hide all structure of a clock's slots."""
    taken = taken_of(screen, "phone-plain", "sky", 30.0, 1)
    assert found_in(taken, screens=usual_screens()).best.acquisition.screen.name == screen


@pytest.mark.parametrize(("period_rows", "duty"), [(19.3, 0.4), (14.2, 0.15), (27.9, 0.12), (32.1, 0.53), (25.7, 0.38)])
def test_a_screen_dimmed_by_switching_gives_no_packet(period_rows: float, duty: float) -> None:
    """Whatever clock a profile's line delay makes of its stripes."""
    rng = np.random.default_rng(round(1000 * period_rows * duty))
    fine, exposure = 8, max(round(4 * 0.5 * period_rows * duty), 1)
    on = (np.arange(540 * fine + exposure) / fine) % period_rows < duty * period_rows
    total = np.cumsum(np.concatenate([[0.0], on]))
    rows = ((total[exposure:] - total[:-exposure]) / exposure)[::fine][:540]
    pixels = 30 + 400 * np.repeat(rows[:, None], 960, axis=1)
    pixels = np.clip(pixels + rng.normal(0, 4, pixels.shape), 0, 1023).astype(np.uint16)
    frame = replace(clean().frame, pixels=pixels, black=0.0, white=1023.0, mosaic=None, linear=True)
    corners = np.array([[0.5, 0.5], [958.5, 0.5], [958.5, 538.5], [0.5, 538.5]])
    for rows_per_slot in (1.9, 2.6, 3.4):
        mode = {"name": "s", "width": 960, "height": 540, "line_delay_s": 1 / (rows_per_slot * 17300)}
        mode |= {"exposure_s": 0.7 / 17300}
        camera = check_profile({"format": 1, "kind": "camera", "name": "c", "modes": [mode]}, CameraProfile, "test")
        (result,) = receive([frame], ReceiverOptions(cameras=(camera,), force_camera=True, corners=corners))
        assert not result.packets


@pytest.mark.parametrize("period_rows", [4, 5, 6])
def test_stripes_of_few_rows_are_no_error(period_rows: int) -> None:
    """Their slots are of a row or two, which leaves no rows to level them by."""
    rng = np.random.default_rng(period_rows)
    on = (np.arange(540) % period_rows < 0.3 * period_rows).astype(float)
    pixels = np.clip(30 + 180 * np.repeat(on[:, None], 960, axis=1) + rng.normal(0, 3, (540, 960)), 0, 255)
    frame = Frame(pixels.astype(np.uint8), "memory")
    corners = np.array([[0.5, 0.5], [958.5, 0.5], [958.5, 538.5], [0.5, 538.5]])
    (result,) = receive([frame], ReceiverOptions(cameras=(), corners=corners))
    assert all(packet.confidence < 0.5 for column in result.columns for packet in column.packets)


def test_corners_of_a_hundred_columns_need_no_screen() -> None:
    """Columns of twenty would show headers, too, as all columns share them."""
    trial = simulate_trial(preset("xs10-still", "wide-100").scaled(0.6, keep_readout=True), 3)
    result = receive_frame(trial.frame, ReceiverOptions(corners=trial.corners))
    assert result.screen_profile == "wide-100"
    sent = {(column, text) for burst in trial.truth.payload.values() for column, text in enumerate(burst)}
    assert len({(column.column, p.payload) for column in result.columns for p in column.packets} & sent) > 70
