"""The search: one answer in whatever order hypotheses come, screens as hypotheses, a record of what was tried."""

import tomllib
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from small_frames import CAMERA, SCREEN, write_frame

from rxcli.ingest import open_source
from rxcli.lab.benchmark.trial import Trial, simulate_trial
from rxcli.lab.simulate.scenes import preset
from rxcli.options import ReceiverOptions
from rxcli.profiles import CameraProfile, ScreenProfile, check_profile, load_profile, usual_screens
from rxcli.receiver.camera.proposals import CameraHypothesis
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.receive import receive_frame
from rxcli.receiver.screen.grid import grid_between
from rxcli.receiver.screen.outline import Outline
from rxcli.receiver.search import Found, cameras, outlines, propose, search
from rxcli.receiver.search.evidence import distinct_share
from rxcli.receiver.search.hypothesis import Hypothesis
from rxcli.receiver.search.numbers import rated_by_packets
from rxcli.receiver.search.propose import Proposer, ways
from rxcli.receiver.search.search import _Walk
from rxcli.receiver.search.settings import SETTINGS
from rxcli.receiver.sync import clock as sync
from rxcli.types import Frame, FrameResult, Metadata

SHIPPED = usual_screens()


def more_screens() -> tuple[ScreenProfile, ...]:
    """Screens of other columns and rates, as somebody may have them in a folder."""
    usual = next(screen for screen in SHIPPED if screen.name == "paper-34k6")
    others = ((10, 20000.0, 24), (12, 34600.0, 24), (24, 17300.0, 11), (40, 8650.0, 5))
    return tuple(
        msgspec.structs.replace(usual, name=f"mine-{columns}", columns=columns, slot_rate_hz=rate, payload_symbols=n)
        for columns, rate, n in others
    )


@lru_cache(maxsize=4)
def trial_of(screen: str, picture: str = "coffee") -> Trial:
    scene = preset("phone-plain", screen).scaled(0.3, 0.5, keep_readout=True)
    return simulate_trial(replace(scene, picture=picture), 3)


def payloads_of(result: FrameResult) -> list[tuple[int, str, float]]:
    return [
        (column.column, packet.payload, packet.confidence) for column in result.columns for packet in column.packets
    ]


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("seed", range(2))
def test_the_order_of_proposals_screens_and_cameras_does_not_matter(
    seed: int, known: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    trial, rng = trial_of("paper-17k3"), np.random.default_rng(seed)
    others = tuple(msgspec.structs.replace(trial.camera, name=f"other-{k}", make="Other") for k in range(3))
    options = ReceiverOptions(screens=(*SHIPPED, *more_screens()), cameras=(*others, *((trial.camera,) * known)))
    possible = [
        Outline(trial.corners + np.array([40.0 * k, 0.0]), log_odds=-0.5 * abs(k), family=family)
        for k in (-1, 0, 1)
        for family in (0, 1)
    ]
    of_camera, siblings = Proposer._of_camera, Proposer.siblings

    def shuffled(some: Iterable[Any]) -> list[Any]:
        some = list(some)
        return [some[k] for k in rng.permutation(len(some))]

    def received(order: Callable[[Iterable[Any]], list[Any]]) -> tuple[FrameResult, list[tuple[int, str, float]]]:
        monkeypatch.setattr(outlines, "possible_screens", lambda *_: [order(possible)])
        monkeypatch.setattr(Proposer, "_of_camera", lambda *given: order(of_camera(*given)))
        monkeypatch.setattr(Proposer, "siblings", lambda *given: order(siblings(*given)))
        screens, cameras = tuple(order(options.screens)), tuple(order(options.cameras))
        result = receive_frame(trial.frame, replace(options, screens=screens, cameras=cameras))
        return result, payloads_of(result)

    as_listed, packets = received(list)
    assert (as_listed.camera_profile == trial.camera.name) == known
    assert len(packets) > 10
    result, again = received(shuffled)
    assert again == packets
    assert result.search == as_listed.search
    assert result.estimated == as_listed.estimated


@pytest.mark.parametrize("known", [True, False])
def test_columns_are_read_through_the_estimated_lens_where_the_camera_has_none(known: bool) -> None:
    trial = trial_of("paper-17k3")
    assert trial.camera.lens is not None
    grid = grid_between(trial.corners, 20, (trial.frame.width, trial.frame.height), None)
    outline = Outline(trial.corners, grid=grid)
    options = trial.options() if known else replace(trial.options(), cameras=(), force_camera=False)
    proposer = Proposer(FrameCache(trial.frame), options, (outline,))
    camera = proposer.context(next(proposer.cameras())[0]).camera
    assert camera.lens.dist_coeffs.any() == known


@pytest.mark.parametrize("screen", ["paper-17k3", "paper-34k6", "paper-8k65"])
@pytest.mark.parametrize("known", [True, False])
def test_more_screens_in_the_folder_lose_no_packet(screen: str, known: bool) -> None:
    trial = trial_of(screen)
    options = replace(trial.options(), screens=SHIPPED, force_camera=known)
    options = options if known else replace(options, cameras=())
    alone = receive_frame(trial.frame, options)
    among = receive_frame(trial.frame, replace(options, screens=(*more_screens(), *SHIPPED)))
    assert len(payloads_of(alone)) > 10
    same = {found[:2] for found in payloads_of(among)} & {found[:2] for found in payloads_of(alone)}
    # An unknown camera is estimated on other columns, so that a packet in doubt may come out otherwise.
    assert len(same) >= (1.0 if known else 0.9) * len(payloads_of(alone))


def test_outlines_are_read_as_screens_of_their_columns() -> None:
    trial = trial_of("paper-17k3")
    possible = tuple(Outline(trial.corners, log_odds=-n / 10, family=n, n_columns=n) for n in (20, 24, 50))
    options = replace(trial.options(), screens=(*SHIPPED, *more_screens()))
    proposer = Proposer(FrameCache(trial.frame), options, possible)
    hypotheses = next(proposer.cameras())
    assert {one.outline.family for one in hypotheses} == {20, 24}
    assert all(one.screen.columns == one.outline.n_columns for one in hypotheses)


@pytest.mark.parametrize(("repeats", "share"), [(1, 1.0), (2, 0.5), (5, 0.2)])
def test_columns_that_repeat_their_neighbour_say_nothing_more(repeats: int, share: float) -> None:
    lit = np.random.default_rng(repeats).random((100 // repeats, 500)).repeat(repeats, axis=0) > 0.5
    reception: Any = SimpleNamespace(
        payload_lit=lit.astype(np.float32), posteriors=SimpleNamespace(log_evidence=np.full(100, 50.0))
    )
    assert distinct_share(reception) == pytest.approx(share, abs=0.02)


def test_columns_with_packets_are_not_left_out_of_the_screen() -> None:
    trial = trial_of("paper-17k3")
    options = ReceiverOptions(corners=trial.corners, cameras=(trial.camera,), force_camera=True)
    cache = FrameCache(trial.frame)
    found = search(cache, options)
    assert isinstance(found, Found)
    own = found.best.hypothesis.outline
    side = (own.corners[1] - own.corners[0]) / found.best.hypothesis.screen.columns
    rivals = [replace(own, corners=own.corners + shift * side, log_odds=-0.5) for shift in (-2, 1)]
    proposer = Proposer(cache, options, (own, *rivals), None)
    kept, *less_likely = rated_by_packets(found.best, (own, *rivals), proposer)
    assert kept is own
    assert max(one.log_odds for one in less_likely) < -3.0


def test_columns_out_of_the_picture_say_nothing_of_the_number() -> None:
    """Cut off at its right: the outermost column of the outline is as open as one more to the left would be."""
    trial = trial_of("paper-17k3")
    cut = replace(trial.frame, pixels=trial.frame.pixels[:, : int(trial.corners[[1, 2], 0].min()) - 60])
    cache, options = FrameCache(cut), replace(trial.options(), cameras=(), force_camera=False)
    side = (trial.corners[1] - trial.corners[0]) / 20
    own = Outline(trial.corners)
    found = search(cache, options, outlines=[own])
    assert isinstance(found, Found)
    assert not found.best.reception.n_observed[:, -1].any()
    rival = replace(own, corners=trial.corners - side, log_odds=-1.0)
    _, rated = rated_by_packets(found.best, [own, rival], Proposer(cache, options, (own, rival)))
    # No packet stands left of the screen, and none could at its right.
    assert rated.log_odds < -1.5


@pytest.mark.parametrize("shift", [-1, 1])
def test_a_column_with_a_packet_beside_the_outline_corrects_its_number(shift: int) -> None:
    trial = trial_of("paper-17k3")
    side = (trial.corners[1] - trial.corners[0]) / 20
    outlines = [Outline(trial.corners + shift * side), Outline(trial.corners, log_odds=-9.0)]
    found = search(
        FrameCache(trial.frame), ReceiverOptions(cameras=(trial.camera,), force_camera=True), outlines=outlines
    )
    assert isinstance(found, Found)
    np.testing.assert_array_equal(found.best.hypothesis.outline.corners, trial.corners)
    assert found.outline.certainty > 0.99


def test_scores_by_the_bright_columns_compare_with_those_by_all() -> None:
    trial = trial_of("paper-17k3")
    options = ReceiverOptions(cameras=(trial.camera,), force_camera=True)
    outlines = [Outline(trial.corners, log_odds=-odds, family=family) for family, odds in enumerate((0.0, 1.0))]
    found = search(FrameCache(trial.frame), options, outlines=outlines)
    assert isinstance(found, Found)
    (half,) = (step for step in found.tried if step.fate == "half")
    assert found.best.score - 10 < half.score < found.best.score


@pytest.mark.parametrize(
    ("exposure_slots", "evidence", "measured"),
    [
        pytest.param(4.0, 30.0, ["all"] * 3, id="long exposures without packets"),
        pytest.param(4.0, 50.0, ["all", *["middle", "all"] * 2], id="long exposures"),
        pytest.param(1.0, 1.0, ["all", *["middle", "all"] * 2], id="short exposures"),
    ],
)
def test_hypotheses_are_measured_on_their_bright_columns_first(
    exposure_slots: float, evidence: float, measured: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, own = SimpleNamespace(exposure_slots=exposure_slots, n_slots=1, delay_slots=np.zeros(20)), list[str]()
    middle = SimpleNamespace(part="middle", clock=clock)
    acquisition = SimpleNamespace(clock=clock, part="all", bright_columns=None, of_columns=lambda _: middle)

    def measure(_: object, __: object, acquisition: Any) -> Any:
        own.append(acquisition.part)
        return SimpleNamespace(score=0.0, evidence=evidence, reception=None, hypothesis=estimated)

    monkeypatch.setitem(_Walk.run.__globals__, "_acquired", lambda _: acquisition)
    monkeypatch.setattr(_Walk, "_measured", measure)
    estimated: Any = SimpleNamespace(camera=SimpleNamespace(hypothesis=1), way=0)
    monkeypatch.setattr(_Walk, "_fitted", lambda _, scored: scored)
    monkeypatch.setitem(_Walk.run.__globals__, "_in_likeliest_bursts", lambda scored: scored)
    monkeypatch.setitem(_Walk.run.__globals__, "evidence", SimpleNamespace(bright_score=lambda _: 0.0))
    walk = _Walk([])
    walk.ways.append(cast(Any, SimpleNamespace(way=0, siblings=lambda _: (), doubts=False)))
    for _ in range(3):
        walk._score(estimated)
    assert own == measured


@pytest.mark.parametrize(
    ("is_long", "evidence", "asks"), [(True, 300.0, True), (True, 500.0, False), (False, 300.0, False)]
)
def test_a_long_exposure_is_also_read_the_other_way_round(
    monkeypatch: pytest.MonkeyPatch, is_long: bool, evidence: float, asks: bool
) -> None:
    trial = trial_of("paper-17k3")
    proposer = Proposer(FrameCache(trial.frame), ReceiverOptions(cameras=()), (Outline(trial.corners),))
    own = next(proposer.cameras())[0]
    scored: Any = SimpleNamespace(
        hypothesis=own,
        context=SimpleNamespace(camera=own.camera),
        reception=SimpleNamespace(is_long=is_long),
        evidence=evidence,
    )
    monkeypatch.setattr(propose, "is_whole", lambda _: False)
    back = [sibling for sibling in proposer.siblings(scored) if sibling.camera.reversed != own.camera.reversed]
    assert [sibling.identity != own.identity for sibling in back] == [True] * asks


def test_every_hypothesis_is_recorded_with_its_fate(tmp_path: Path) -> None:
    write_frame(tmp_path / "small.png", 5)
    frame = next(iter(open_source(str(tmp_path / "small.png"))))
    screen = check_profile(tomllib.loads(SCREEN), ScreenProfile, "small")
    camera = check_profile(tomllib.loads(CAMERA), CameraProfile, "camera")
    corners = np.array([[10, 10], [329, 10], [329, 609], [10, 609]], float)
    options = ReceiverOptions(
        screens=(screen, *SHIPPED), cameras=(camera,), force_camera=True, corners=corners, cae="never"
    )
    found = search(FrameCache(frame), options)
    assert isinstance(found, Found)
    assert [one.fate for one in found.tried].count("won") == 1
    won = next(one for one in found.tried if one.fate == "won")
    assert won.hypothesis.screen.name == "small"
    assert won.evidence == found.best.evidence > 100
    assert won.score == max(one.score for one in found.tried)
    result = receive_frame(frame, options)
    assert [step.fate for step in result.search] == [one.fate for one in found.tried]
    assert any("small" in step.hypothesis and step.fate == "won" for step in result.search)


def test_a_refusal_says_what_came_nearest() -> None:
    rng = np.random.default_rng(2)
    frame = Frame(rng.integers(90, 110, (620, 340), np.uint8), "noise")
    corners = np.array([[10, 10], [329, 10], [329, 609], [10, 609]], float)
    camera = check_profile(tomllib.loads(CAMERA), CameraProfile, "camera")
    found = search(FrameCache(frame), ReceiverOptions(cameras=(camera,), force_camera=True, corners=corners))
    if isinstance(found, Found):
        assert found.best.evidence < 40
    else:
        assert isinstance(found, Failure)
        assert found.outline is not None
        assert found.context is not None
        assert found.tried


@pytest.mark.parametrize("gives_up", [True, False])
def test_a_picture_without_evidence_ends_when_its_work_is_done(gives_up: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    noise = np.random.default_rng(1).integers(90, 110, (620, 340), np.uint8)
    corners = np.array([[10, 10], [329, 10], [329, 609], [10, 609]], float)
    camera = check_profile(tomllib.loads(CAMERA), CameraProfile, "camera")
    options = ReceiverOptions(cameras=(camera,), force_camera=True, corners=corners)
    monkeypatch.setitem(_Walk.run.__globals__, "SETTINGS", msgspec.structs.replace(SETTINGS, work=1))
    walk = _Walk([Proposer(FrameCache(Frame(noise, "noise")), options, (Outline(corners),))], gives_up)
    fates = [tried.fate for tried in walk.record(walk.run())]
    assert (fates.count("not tried") > 0) == gives_up
    assert len(fates) - fates.count("not tried") == (1 if gives_up else len(fates))


def test_evidence_extends_the_work_and_ends_the_doubt_of_what_is_stated() -> None:
    trial = trial_of("paper-17k3")
    found = search(FrameCache(trial.frame), replace(trial.options(), screens=SHIPPED), may_doubt=True)
    assert isinstance(found, Found)
    assert not found.doubts
    assert "not tried" not in [tried.fate for tried in found.tried]


def test_ways_to_look_at_a_picture_come_in_the_order_of_their_likelihood() -> None:
    trial = trial_of("paper-17k3")
    stated = replace(trial.frame, metadata=replace(trial.frame.metadata, exposure_s=1e-4))
    outlines = [Outline(trial.corners)]
    options = replace(trial.options(), corners=None)
    looked = list(ways(FrameCache(stated), options, outlines, may_doubt=True))
    priors = [way.log_prior for way in looked]
    assert priors == sorted(priors, reverse=True)
    assert looked[0].log_prior == 0.0
    assert [way.cache.frame.metadata.exposure_s for way in looked if way.doubts] == [1e-4, None]
    assert [way.options.cameras for way in looked if way.doubts] == [(), ()]
    assert not any(way.doubts for way in ways(FrameCache(stated), options, outlines))


def test_a_bright_box_shows_the_camera_and_a_grid_the_columns() -> None:
    """Where a grid's light misleads the estimate of the camera, that of the box may be right, and is tried on both."""
    trial = trial_of("paper-17k3")
    own, options = Outline(trial.corners), ReceiverOptions(screens=SHIPPED)
    _, boxes = ways(FrameCache(trial.frame), options, [own])
    assert boxes.outlines[0] is own
    assert len(boxes.outlines) > 1
    assert boxes.lit == boxes.outlines[1:]
    assert {one.outline.family for one in next(boxes.cameras())} == {own.family, *(box.family for box in boxes.lit)}
    _, given = ways(FrameCache(trial.frame), replace(options, corners=trial.corners), [own])
    assert given.outlines == (own,)


@pytest.mark.parametrize(
    ("screen", "stated_us", "found_us", "contradicts"),
    [
        ("paper-8k65", 100, 100, False),
        ("paper-8k65", 100, 130, False),  # Nearer to its own slots than to those of another rate.
        ("paper-8k65", 100, 200, True),  # As many slots as it lasts at 17.3 kHz.
        ("paper-17k3", 100, 50, True),
        ("paper-8k65", None, 200, False),
    ],
)
def test_an_exposure_may_be_that_of_a_screen_of_another_rate(
    screen: str, stated_us: float | None, found_us: float, contradicts: bool
) -> None:
    frame = Frame(np.zeros((2, 2), np.uint8), "photo", metadata=Metadata(exposure_s=stated_us and stated_us * 1e-6))
    camera = SimpleNamespace(exposure_s=found_us * 1e-6, line_delay_s=1e-5)
    own = SimpleNamespace(screen=load_profile(screen, ScreenProfile))
    scored: Any = SimpleNamespace(context=SimpleNamespace(camera=camera), hypothesis=own)
    assert Proposer(FrameCache(frame), ReceiverOptions(), ()).contradicts(scored) == contradicts


@pytest.mark.parametrize(("exposure_slots", "n_sought"), [(1.5, 1), (3.0, 2)])
def test_a_clock_is_sought_once_for_all_exposures_that_are_not_long(
    exposure_slots: float, n_sought: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    trial, sought = trial_of("paper-17k3"), list[float]()
    find = sync.find_clock
    monkeypatch.setattr(sync, "find_clock", lambda *given: sought.append(given[2]) or find(*given))
    proposer = Proposer(FrameCache(trial.frame), trial.options(), (Outline(trial.corners),))
    hypothesis = next(proposer.cameras())[0]
    for exposure in (1.0, exposure_slots):
        camera = replace(hypothesis.camera, exposure_s=exposure / hypothesis.screen.slot_rate_hz)
        found = proposer.with_clock(replace(hypothesis, camera=camera))
        assert found.clock.exposure_slots == pytest.approx(exposure)
    assert len(sought) == n_sought


@pytest.mark.parametrize(
    ("upright", "lean", "found"),
    [(5.0, -0.5, True), (20.0, -0.5, False), (0.0, 0.5, False), (0.0, -0.1, False)],
    ids=["turned", "upright columns stand out more", "upright stripes", "no stripes"],
)
def test_columns_that_stand_out_more_upright_do_not_lie_on_their_side(
    monkeypatch: pytest.MonkeyPatch, upright: float, lean: float, found: bool
) -> None:
    corners = np.array([[40.0, 40.0], [200.0, 40.0], [200.0, 130.0], [40.0, 130.0]])
    grid = grid_between(corners, 20, (240, 200), None)
    lying, standing = (Outline(corners, grid=replace(grid, contrast=contrast)) for contrast in (10.0, upright))
    monkeypatch.setattr(outlines.find, "find_screens", lambda *_: [[lying]])
    monkeypatch.setattr(outlines, "possible_screens", lambda *_: [[standing]])
    monkeypatch.setattr(outlines, "stripe_lean", lambda _: lean)
    cache = FrameCache(Frame(np.zeros((200, 240), np.uint8), "memory"))
    assert outlines.may_be_turned(cache, ReceiverOptions()) is found


@pytest.mark.parametrize(
    ("stated_s", "rates_hz"),
    [(None, [34600, 17300, 8650]), (1000 / (4 * 17300) * 1.07, [17300]), (0.2, [34600, 17300, 8650])],
    ids=["none", "7 % off", "of no screen"],
)
def test_a_stated_readout_shows_the_slot_rate(
    stated_s: float | None, rates_hz: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A picture shows rows per slot; the readout makes seconds of them, and the estimate stays that of the picture."""
    frame = Frame(np.zeros((1000, 40), np.uint8), "clip", metadata=Metadata(readout_s=stated_s))
    ways = (CameraHypothesis(4.0, length, False, np.zeros(4), 1.0, 9.0, 0.1, np.zeros(4)) for length in (260, 130, 70))
    monkeypatch.setattr(cameras, "propose", lambda *_, **__: list(ways))
    monkeypatch.setattr(cameras, "_strips", lambda *_, **__: None)
    monkeypatch.setattr(cameras, "why_not", lambda *_: None)
    monkeypatch.setattr(cameras, "in_phase", lambda _, hypothesis: hypothesis)
    monkeypatch.setattr(FrameContext, "sample_columns", lambda *_: None)
    options = ReceiverOptions(screens=tuple(screen for screen in SHIPPED if screen.columns == 20))
    proposed = list(cameras.propose_cameras(FrameCache(frame), np.zeros((4, 2)), options, 20))
    assert [round(1 / (4.0 * camera.line_delay_s)) for camera in proposed] == rates_hz
    proposer = Proposer(FrameCache(frame), options, ())
    best = cast(Hypothesis, SimpleNamespace(camera=proposed[0], screen=next(iter(options.screens))))
    rates = {screen.slot_rate_hz for screen in proposer.possible_screens(best)}
    assert len(rates) == (1 if len(rates_hz) == 1 else 3)
