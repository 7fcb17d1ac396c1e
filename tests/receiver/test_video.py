"""Clips: time through the frames, bursts over several frames, what is reused and what makes it start again."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
import pytest
from made_stages import clock_of
from numpy.typing import NDArray

from rxcli import numerics
from rxcli.errors import InputError
from rxcli.lab.simulate.capture import prepare
from rxcli.lab.simulate.scenes import preset
from rxcli.lab.simulate.truth import build_camera_profile
from rxcli.options import SKIPS, ReceiverOptions
from rxcli.receiver.channel.known_picture import ColumnLight, KnownPicture, Observation
from rxcli.receiver.clip.camera import ClipCamera
from rxcli.receiver.clip.settings import SETTINGS
from rxcli.receiver.clip.window import Source
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.result import Received
from rxcli.receiver.light import Crosstalk, NoiseModel, SlotLight
from rxcli.receiver.receive import receive, receive_frame
from rxcli.receiver.sync.tracking import BurstPhase, LinkTime
from rxcli.results.truth import Score, Scorer, Truth
from rxcli.types import Clock, Float32Array, Frame, FrameResult

N_FRAMES = 14


@dataclass(frozen=True)
class Clip:
    """A simulated clip, its truth and the options to receive it."""

    frames: tuple[Frame, ...]
    truth: Truth
    options: ReceiverOptions


def simulate(
    seed: int,
    n_frames: int,
    picture: str | NDArray[np.uint8] = "coffee",
    height: float = 0.94,
    repeats: int = 3,
    frame_rate_hz: float = 60000 / 1001,
    screen: str = "paper-8k65",
    readout_s: float | None = None,
    exposure_slots: float | None = None,
    height_scale: float = 0.5,
) -> Clip:
    """Nearly the whole height is screen: a frame shows 1.5 packets, so that bursts fall into two or three frames."""
    scene = preset("video-1080p", screen)
    scene = (scene if readout_s is None else scene.read_in(readout_s)).scaled(0.32, height_scale, keep_readout=True)
    if exposure_slots is not None:
        longer = exposure_slots / (scene.exposure_s * scene.screen.slot_rate_hz)
        scene = replace(
            scene, exposure_s=longer * scene.exposure_s, light_e_per_s=scene.light_e_per_s / max(longer, 1.0)
        )
    left, right, n_rows = 20.0, scene.sensor.width - 22.0, scene.sensor.height
    top, bottom = n_rows * (1 - height) / 2, n_rows * (1 + height) / 2
    corners = ((left, top), (right, top + 3), (right - 2, bottom), (left + 3, bottom - 2))
    scene = replace(
        scene,
        screen=msgspec.structs.replace(scene.screen, repeats=repeats),
        n_frames=n_frames,
        frame_rate_hz=frame_rate_hz,
        picture=picture,
        pose=replace(scene.pose, corners=corners),
    )
    take = prepare(scene, seed)
    frames = tuple(
        Frame(np.asarray(take.frame(k).pixels), "clip", k, round(k / scene.frame_rate_hz, 3)) for k in range(n_frames)
    )
    truth = msgspec.json.decode(msgspec.json.encode(take.truth("clip")), type=Truth)
    corners_px = np.array(take.truth("clip")["corners_sensor_px"])
    camera = build_camera_profile(take.scene, take.exposure())
    options = ReceiverOptions((scene.screen,), (camera,), force_camera=True, corners=corners_px, cae="never")
    return Clip(frames, truth, options)


@pytest.fixture(scope="module")
def clip() -> Clip:
    return simulate(3, N_FRAMES)


def scored(results: list[FrameResult], truth: Truth) -> tuple[list[FrameResult], Score]:
    scorer = Scorer(truth)
    return [scorer.add(result) for result in results], scorer.score()


def bursts_in(results: list[FrameResult]) -> list[tuple[int | None, int]]:
    return [(p.burst, c.column) for r in results for c in r.columns for p in c.packets]


@pytest.fixture(scope="module")
def results(clip: Clip) -> list[FrameResult]:
    return list(receive(clip.frames, clip.options))


def test_every_frame_has_a_result_in_order(results: list[FrameResult]) -> None:
    assert [result.frame for result in results] == list(range(N_FRAMES))


def test_packets_are_right_and_none_is_false(clip: Clip, results: list[FrameResult]) -> None:
    _, score = scored(results, clip.truth)
    assert score.false == 0
    assert score.error_free >= 0.9 * score.expected


def test_a_packet_stands_once_in_the_last_frame_that_shows_it(clip: Clip, results: list[FrameResult]) -> None:
    found = bursts_in(results)
    assert len(found) == len(set(found))
    for result in results:
        for column in result.columns:
            for packet in column.packets:
                assert packet.frames[-1] == result.frame
    combined = [p for r in results for c in r.columns for p in c.packets if p.frames and len(p.frames) > 1]
    assert len(combined) >= 20


def test_the_counter_counts_bursts_as_they_were_sent(clip: Clip, results: list[FrameResult]) -> None:
    shown = {f.frame: [b.burst for b in f.bursts] for f in clip.truth.frames}
    first = shown[0][0]
    for result in results:
        numbers = {p.burst for c in result.columns for p in c.packets}
        assert numbers <= {burst - first for burst in shown[result.frame]}


def test_tracking_is_counted_and_can_be_switched_off(clip: Clip, results: list[FrameResult]) -> None:
    assert sum(result.skipped.get("tracking", 0) for result in results) >= N_FRAMES - 2
    few = clip.frames[:4]
    plain = list(receive(few, replace(clip.options, skip=frozenset(SKIPS) - {"tracking"})))
    assert all("tracking" not in result.skipped for result in plain)
    assert scored(plain, clip.truth)[1].error_free >= 20


def test_an_occluded_frame_costs_its_own_packets_only(clip: Clip) -> None:
    dark = replace(clip.frames[7], pixels=np.full_like(clip.frames[7].pixels, 20))
    got = list(receive((*clip.frames[:7], dark, *clip.frames[8:]), clip.options))
    assert got[7].status in ("no_signal", "no_screen")
    assert got[7].reason
    marked, score = scored(got, clip.truth)
    assert score.false == 0
    after = [p for r in marked[8:] for c in r.columns for p in c.packets]
    assert len(after) >= 60
    first = clip.truth.frames[0].bursts[0].burst
    sent = {b.burst - first for f in clip.truth.frames[8:] for b in f.bursts}
    assert {p.burst for p in after} <= sent


def test_what_came_before_a_break_comes_out(clip: Clip) -> None:
    def breaking() -> Iterator[Frame]:
        yield from clip.frames[:5]
        raise InputError("clip: the clip breaks off", "copy it again")

    got: list[FrameResult] = []
    with pytest.raises(InputError, match="breaks off"):
        got.extend(receive(breaking(), clip.options))
    assert [result.frame for result in got] == [0, 1, 2, 3, 4]
    assert scored(got, clip.truth)[1].error_free >= 20


def test_the_source_is_closed_when_reception_is_left(clip: Clip) -> None:
    closed = []

    def source() -> Iterator[Frame]:
        try:
            yield from clip.frames
        finally:
            closed.append(True)

    reception = receive(source(), clip.options)
    next(reception)
    reception.close()  # type: ignore[attr-defined]
    assert closed == [True]


def _is_numpys(library: dict[str, object]) -> bool:
    """Whether a library of matrix products is NumPy's: what other tests have loaded takes no part in reception."""
    return library["user_api"] == "blas" and "numpy" in str(library["filepath"])


def _controlled_blas(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The threads of matrix products, in an environment that does not limit them."""
    blas = pytest.importorskip("threadpoolctl").ThreadpoolController()
    monkeypatch.setattr(numerics, "_blas", lambda: blas)
    return blas


def test_products_take_one_thread_while_a_frame_is_received(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    """More would spin beside the decoder's; what is done between the frames keeps its own."""
    blas = _controlled_blas(monkeypatch)
    inside: list[list[int]] = []

    def threads() -> list[int]:
        return [library["num_threads"] for library in blas.info() if _is_numpys(library)]

    def receive_next(_receiver: object, source: Source) -> list[FrameResult]:
        inside.append(threads())
        return [FrameResult(source.pop().source, 0, 0.0, "no_screen")]

    monkeypatch.setattr("rxcli.receiver.clip.receiver.ClipReceiver.receive_next", receive_next)
    with blas.limit(limits=2, user_api="blas"):
        if max(threads(), default=0) < 2:
            pytest.skip("this numpy's BLAS has one thread")
        between = [threads() for _ in receive(clip.frames[:3], clip.options)]
    assert inside == [[1] * len(threads())] * 3
    assert all(max(counts) == 2 for counts in between)


def test_products_take_one_thread_while_a_photograph_is_received(monkeypatch: pytest.MonkeyPatch) -> None:
    blas = _controlled_blas(monkeypatch)
    inside: list[int] = []

    def received(cache: FrameCache, *_: object) -> Received:
        inside.extend(library["num_threads"] for library in blas.info() if _is_numpys(library))
        return Received(FrameResult(cache.frame.source, 0, 0.0, "no_screen"), {})

    monkeypatch.setattr("rxcli.receiver.receive._receive_still", received)
    with blas.limit(limits=2, user_api="blas"):
        receive_frame(Frame(np.zeros((8, 8), np.uint8), "dark"), ReceiverOptions())
    assert inside
    assert set(inside) == {1}


def test_a_single_frame_is_a_photograph(clip: Clip) -> None:
    (result,) = receive(clip.frames[:1], clip.options)
    packets = [p for c in result.columns for p in c.packets]
    assert all(p.burst is None and p.frames is None for p in packets)


@pytest.mark.parametrize(("much_doubt", "share"), [(SETTINGS.much_doubt, 0.7), (-1.0, 0.9)], ids=["plain", "in doubt"])
def test_another_scene_is_searched_anew(
    clip: Clip, monkeypatch: pytest.MonkeyPatch, much_doubt: float, share: float
) -> None:
    """Frames held back in doubt are looked at again by their own picture, and leave that of the new scene alone."""
    monkeypatch.setattr("rxcli.receiver.clip.ledger.SETTINGS", msgspec.structs.replace(SETTINGS, much_doubt=much_doubt))
    other = simulate(8, 8, "chelsea")
    moved = tuple(replace(frame, index=6 + k, time_s=0.1 + frame.time_s) for k, frame in enumerate(other.frames))
    got = list(receive((*clip.frames[:6], *moved), clip.options))
    _, score = scored([replace(result, frame=result.frame - 6) for result in got[6:]], other.truth)
    assert score.error_free >= share * score.expected
    numbers = [p.burst for r in got for c in r.columns[:1] for p in c.packets if p.burst is not None]
    assert numbers == sorted(numbers)


def test_frames_keep_the_certainty_with_which_their_screen_was_found(
    clip: Clip, monkeypatch: pytest.MonkeyPatch
) -> None:
    locate, n_unsure = ClipCamera.locate, 6

    def unsure(camera: ClipCamera, cache: FrameCache, *rest: Any, **more: Any) -> Any:
        located = locate(camera, cache, *rest, **more)
        certainty = 0.5 if cache.frame.index < n_unsure else 1.0
        return replace(located, outline=replace(located.outline, certainty=certainty))

    monkeypatch.setattr(ClipCamera, "locate", unsure)
    other = simulate(8, 8, "chelsea")
    moved = [replace(frame, index=n_unsure + k, time_s=0.1 + frame.time_s) for k, frame in enumerate(other.frames)]
    got = list(receive((*clip.frames[:n_unsure], *moved), clip.options))
    confidence = [[p.confidence for r in part for p in r.packets] for part in (got[:n_unsure], got[n_unsure:])]
    assert 0.4 < max(confidence[0]) <= 0.5
    assert max(confidence[1]) > 0.9


def test_wrong_times_do_not_make_the_only_possible_screen_unsure(clip: Clip) -> None:
    """A clock that contradicts the link's time is no sign of another length of packets where none is possible."""
    times_s = np.random.default_rng(2).uniform(0, 0.02, 8).cumsum()
    frames = [replace(frame, time_s=float(at)) for frame, at in zip(clip.frames, times_s, strict=False)]
    packets = [packet for result in receive(frames, clip.options) for packet in result.packets]
    assert sum(packet.confidence > 0.9 for packet in packets) > 20


def test_frames_before_and_after_an_occlusion_are_looked_at_again(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[list[int]] = []

    def measure_again(_scene: object, views: list[Any], *_: object) -> None:
        measured.append([view.context.frame.index for view in views])

    monkeypatch.setattr("rxcli.receiver.clip.scene.TrackedScreen.measure_again", measure_again)
    dark = replace(clip.frames[3], pixels=np.full_like(clip.frames[3].pixels, 2))
    got = list(receive((*clip.frames[:3], dark, *clip.frames[4:]), clip.options))
    assert [result.frame for result in got] == [frame.index for frame in clip.frames]
    assert got[3].status in ("no_signal", "no_screen")
    assert measured[:2] == [[0, 1, 2], [4, 5, 6, 7, 8, 9]]


def test_parts_of_packets_are_put_together() -> None:
    """No frame shows a whole packet: what two frames show of one burst makes it."""
    few = simulate(5, 16, height=0.51, repeats=4, frame_rate_hz=53.7)
    assert few.truth.expected_bursts == frozenset()
    got = list(receive(few.frames, few.options))
    combined = [p for r in got for c in r.columns for p in c.packets if p.frames and len(p.frames) > 1]
    assert len(combined) >= 60
    _, score = scored(got, few.truth)
    assert score.extra_error_free >= 0.85 * len(combined)
    assert score.false == 0


def test_frames_with_nothing_new_are_passed_over_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    # Longer than frames are held where the first ones leave doubt: none is passed over before.
    monkeypatch.setattr("rxcli.receiver.clip.ledger.SETTINGS", msgspec.structs.replace(SETTINGS, frames_in_doubt=4))
    long = simulate(2, 14, repeats=14)
    every = list(receive(long.frames, long.options))
    thinned = list(receive(long.frames, replace(long.options, stop_when_certain=True)))
    passed = [result for result in thinned if result.skipped.get("certain_frames")]
    assert passed
    assert all(result.status == "ok" and not result.columns for result in passed)
    assert not any("certain_frames" in result.skipped for result in every)
    assert {b for b, _ in bursts_in(thinned)} == {b for b, _ in bursts_in(every)}


def clock_at(slot: float) -> Clock:
    """A clock whose sensor row 0 is `slot`."""
    whole = int(np.floor(slot))
    known = {"row0": -(slot - whole) * 5.0, "first_slot": whole % 70}
    return clock_of(20, n_slots=100, burst=np.zeros(3, np.int64), header_peak_ratio=5.0, **known)


@pytest.mark.parametrize("digits", [3, 6])
def test_link_time_counts_copies_over_rounded_times(digits: int) -> None:
    rate, frame_s, start = 8650.0 * (1 + 80e-6), 1001 / 60000, 33.3
    time = LinkTime(70, 8650.0)
    for number in range(400):
        if number % 50 == 17:
            continue  # a frame that the camera dropped
        slot = start + number * frame_s * rate
        copy = time.update(number - number // 50, round(number * frame_s, digits), clock_at(slot))
        assert copy == int(slot // 70)


def test_link_time_tells_another_time() -> None:
    time = LinkTime(70, 8650.0)
    for number in range(5):
        assert time.update(number, number / 60, clock_at(10 + number * 8650 / 60)) is not None
    assert time.update(5, 5 / 60, clock_at(10 + 20 + 5 * 8650 / 60)) is None


def test_burst_phase_from_parts_of_copies_over_frames() -> None:
    rng = np.random.default_rng(1)
    repeats, packet, columns = 3, 70, 10
    sent = {burst: rng.integers(0, 2, (columns, packet)) for burst in range(40)}
    phase = BurstPhase(repeats)
    for frame in range(30):
        start = 2.22 * frame
        first = int(start)
        llr = np.zeros((2, columns, packet))
        for number in (0, 1):
            place = first + number + np.arange(packet) / packet
            reception = (place >= start) & (place < start + 0.8)
            slots = 2.0 * sent[(first + number + 1) // repeats] - 1
            llr[number] = reception * (2.5 * slots + rng.normal(0, 1.5, slots.shape))
        phase.update(first, llr)
    assert phase.settled
    copies = np.arange(60)
    assert (phase.burst_of(copies) == (copies + 1) // repeats).all()


def test_known_picture_gives_back_the_columns_light() -> None:
    """Light made by the equation itself, in another way: a loop over strips and columns."""
    rng = np.random.default_rng(5)
    columns, strips, rows, black_level = 6, 4, 200, 0.01
    picture = rng.uniform(0.02, 0.5, (columns, strips, rows)).astype(np.float32)
    crosstalk = rng.uniform(0.1, 1.0, (strips, 3))
    inside = np.ones(picture.shape, bool)
    known = KnownPicture(picture.shape, black_level, NoiseModel(1e-7, 1e-6))

    def frame() -> tuple[np.ndarray, np.ndarray]:
        bits = rng.integers(0, 2, (columns, 42)).astype(np.float32)
        slots = SlotLight(bits).mean_over(np.arange(rows)[None] / 5 + 0.5, 1.08)
        light = np.full(picture.shape, black_level)
        for column in range(columns):
            for strip in range(strips):
                for k in (-1, 0, 1):
                    if 0 <= column + k < columns:
                        light[column, strip] += picture[column, strip] * crosstalk[strip, k + 1] * slots[column + k]
        return light.astype(np.float32), slots

    for _ in range(25):
        light, slots = frame()
        known.learn(Observation(light, slots, np.ones_like(slots), inside, Crosstalk(crosstalk)))
    light, slots = frame()
    reception = known.placed(inside, Crosstalk(crosstalk)).solve(light)
    assert np.abs(reception.value - slots).max() < 0.1
    assert (reception.precision > 0).all()


#: Crosstalk of four strips that receive the light of their column alone.
OWN_LIGHT = Crosstalk(np.tile([0.0, 1.0, 0.0], (4, 1)))


def known_picture(rng: np.random.Generator, columns: int = 6, rows: int = 400) -> tuple[Any, ...]:
    """A picture known from many frames, 5 rows a slot; and what makes a frame of it: light and exposed slots."""
    picture = rng.uniform(0.1, 0.5, (columns, 4, rows)).astype(np.float32)
    inside = np.ones(picture.shape, bool)
    known = KnownPicture(picture.shape, 0.0, NoiseModel(1e-6, 0.0))

    def frame() -> tuple[Float32Array, Float32Array]:
        bits = rng.integers(0, 2, (columns, rows // 5 + 2)).astype(np.float32)
        slots = SlotLight(bits).mean_over(np.arange(rows)[None] / 5 + 0.5, 1.0)
        return (picture * slots[:, None]).astype(np.float32), slots

    for _ in range(20):
        light, slots = frame()
        known.learn(Observation(light, slots, np.ones_like(slots), inside, OWN_LIGHT))
    return known, frame


def test_strips_that_show_something_else_are_trusted_less() -> None:
    rng = np.random.default_rng(8)
    known, frame = known_picture(rng)
    light, slots = frame()
    light[:, 0] += rng.normal(0, 0.2, light[:, 0].shape).astype(np.float32)
    placed = known.placed(np.ones(light.shape, bool), OWN_LIGHT)
    plain = np.abs(placed.solve(light).value - slots).mean()
    again = np.abs(placed.solve_again(light, slots, 5.0).value - slots).mean()
    assert again < 0.5 * plain


def test_a_decision_does_not_bear_itself_out() -> None:
    """One slot that shows the opposite of what was decided must still show it."""
    known, frame = known_picture(np.random.default_rng(9))
    light, slots = frame()
    wrong = slots.copy()
    wrong[2, 200:205] = 1 - wrong[2, 200:205]
    placed = known.placed(np.ones(light.shape, bool), OWN_LIGHT)
    reception = placed.solve_again(light, wrong, 5.0).value[2, 201:204]
    assert np.abs(reception - slots[2, 201:204]).max() < 0.1


def test_a_picture_without_a_frame_is_that_of_the_others() -> None:
    known, frame = known_picture(np.random.default_rng(10))
    other = copy.deepcopy(known)
    light, slots = frame()
    look = Observation(light, slots, np.full_like(slots, 0.7), np.ones(light.shape, bool), OWN_LIGHT)
    update = known.learn(look, forget=False)
    with_it, _ = known.picture()
    without, _ = known.without(update).picture()
    alone, _ = other.picture()
    assert without == pytest.approx(alone, abs=1e-4)
    assert known.picture()[0] == pytest.approx(with_it)


@pytest.mark.parametrize("together", [1, 5])
def test_errors_that_rows_have_in_common_count_as_one(together: int) -> None:
    """Noise of the same variance on every row alone, or on five rows at a time: the latter leaves less to be told."""
    rng = np.random.default_rng(11)
    inside = np.ones((8, 1, 1000), bool)
    known = KnownPicture(inside.shape, 0.0, NoiseModel(1e-4, 0.0))
    noise = np.repeat(rng.normal(0, 0.1, (8, 1000 // together)), together, axis=1).astype(np.float32)
    slots = np.repeat(rng.integers(0, 2, (8, 200)), 5, axis=1).astype(np.float32)
    seen = ColumnLight(slots + noise, np.full((8, 1000), 50, np.float32))
    judged = known.placed(inside, Crosstalk(np.array([[0.0, 1.0, 0.0]]))).judge(seen, slots, 40.0, 0.0, 5.0)
    # Each row tells 1 / 0.1^2, whatever was foreseen; five that err together tell what one does.
    expected = 100 / together
    assert np.median(judged.precision) == pytest.approx(expected, rel=0.1)


def test_black_parts_of_a_picture_show_no_slots() -> None:
    """The black bar of a letterboxed picture, whose slots are unknown: it is black whatever is sent."""
    rng = np.random.default_rng(12)
    inside = np.ones((3, 4, 300), bool)
    known = KnownPicture(inside.shape, 0.0, NoiseModel(1e-7, 1e-4))
    slots = np.repeat(rng.integers(0, 2, (3, 60)), 5, axis=1).astype(np.float32)
    light = (0.3 * slots[:, None] + rng.normal(0, 3e-4, (3, 4, 300))).astype(np.float32)
    slots[:, 200:] = 0.5
    light[..., 200:] = rng.normal(0, 3e-4, (3, 4, 100))
    known.learn(Observation(light, slots, np.abs(2 * slots - 1), inside, OWN_LIGHT))
    precision = known.placed(inside, OWN_LIGHT).solve(light).precision
    assert np.median(precision[:, :200]) > 50
    assert np.median(precision[:, 250:]) < 0.2


def test_rows_that_were_never_lit_are_not_known() -> None:
    """Light that neighbours spill is no look at a picture: what is lit there at last is not taken for dark."""
    inside = np.ones((3, 1, 60), bool)
    crosstalk = Crosstalk(np.array([[0.05, 0.9, 0.05]]))
    known = KnownPicture(inside.shape, 0.0, NoiseModel(1e-6, 1e-6))
    lit = np.zeros((3, 60), np.float32)
    lit[0] = 1.0
    # The model has it that the neighbour spills a twentieth; three times as much comes.
    light = np.where(np.arange(3)[:, None] == 1, 0.15, 0.9)[:, None] * np.ones((3, 1, 60)) * lit[:1]
    for _ in range(4):
        known.learn(Observation(light.astype(np.float32), lit, np.ones((3, 60), np.float32), inside, crosstalk))
    both = lit.copy()
    both[1] = 1.0
    now = (np.array([0.95, 0.95, 0.05])[:, None, None] * np.ones((3, 1, 60))).astype(np.float32)
    seen = known.placed(inside, crosstalk).solve(now)
    assert (seen.precision[1] * (1 - seen.value[1]) < 8).all()


def test_few_frames_are_not_sure_of_what_they_taught_themselves() -> None:
    """A picture learned from the frames that it is then used on bears out every wrong decision."""
    short = simulate(3, 2)
    marked, score = scored(list(receive(short.frames, short.options)), short.truth)
    packets = [p for r in marked for c in r.columns for p in c.packets]
    sure = [p for p in packets if p.confidence >= 0.9]
    assert score.error_free >= 10
    assert score.false == 0
    assert sum(p.bit_errors != 0 for p in sure) <= 0.15 * len(sure)


def test_dark_columns_give_no_false_packets() -> None:
    """Nine columns of twenty under black."""
    picture = np.full((90, 160, 3), 200, np.uint8)
    picture[:, 88:] = 0
    half = simulate(6, 12, picture)
    marked, score = scored(list(receive(half.frames, half.options)), half.truth)
    assert score.error_free >= 90
    packets = [p for r in marked for c in r.columns for p in c.packets]
    assert all(p.bit_errors == 0 for p in packets if p.confidence >= 0.9)
    assert all(not c.packets for r in marked[6:] for c in r.columns[12:])


def _right_packets(results: list[FrameResult], truth: Truth) -> dict[tuple[int, str], set[int]]:
    """Column and payload of every right packet, and the frames that showed it."""
    marked, _ = scored(results, truth)
    packets = [(column.column, p) for r in marked for column in r.columns for p in column.packets]
    return {(column, p.payload): set(p.frames or ()) for column, p in packets if p.bit_errors == 0}


@pytest.mark.parametrize("left_out", [{0}, {0, 1, 2}, {8, 9}, {3}, {6}])
def test_frames_that_are_missing_take_no_other_packets_along(
    clip: Clip, results: list[FrameResult], left_out: set[int]
) -> None:
    """A clip cut anywhere, or with dropped frames, keeps the packets that the other frames showed."""
    kept = tuple(frame for frame in clip.frames if frame.index not in left_out)
    right = _right_packets(list(receive(kept, clip.options)), clip.truth)
    shown = {packet for packet, frames in _right_packets(results, clip.truth).items() if not frames & left_out}
    assert len(shown) >= 60
    assert len(shown - right.keys()) <= 0.01 * len(shown)
