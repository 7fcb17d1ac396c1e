"""The auto-encoder's input contract, the model folder, inference, and the gate in the receiver."""

import hashlib
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from small_scene import reception

from rxcli.errors import ProfileError
from rxcli.lab.benchmark.trial import Trial, simulate_trial
from rxcli.lab.training.dataset import UNKNOWN, Sample, validation_sample
from rxcli.lab.training.scenes import SCENE_CLASSES, validation_scene
from rxcli.protocol import HEADER, bits_per_symbol, codebook, encode_packet
from rxcli.receiver import channel, still
from rxcli.receiver.channel import denoise
from rxcli.receiver.channel.denoise import COLUMN_FEATURES, STRIP_FEATURES, DenoiserInput, load_denoiser, network_inputs
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.result import Failure
from rxcli.receiver.light import Crosstalk, Exposure, NoiseModel
from rxcli.receiver.search import search
from rxcli.resources import data_dir
from rxcli.results.truth import Score
from rxcli.types import Clock, Denoiser, FrameResult, SlotSamples

N_COLUMNS, N_STRIPS, Q = 3, 5, 4
N_SYMBOLS, W = 5, 5
PACKET = 20 + 10 * N_SYMBOLS
EXPOSURE = 1.2


def sent(rng: np.random.Generator) -> np.ndarray:
    """(C, 2 packets) slots of two copies."""
    bits = rng.integers(0, 2, (N_COLUMNS, N_SYMBOLS * bits_per_symbol(W)), dtype=np.uint8)
    return np.stack([np.tile(encode_packet(b, W), 2) for b in bits])


def through_exposure(slots: np.ndarray, exposure: float) -> np.ndarray:
    """(C, N * Q) by brute force: 64 instants of an exposure, 8 exposures a sample; half lit beyond the ends."""
    n = slots.shape[1]
    centres = (np.arange(n * Q * 8) + 0.5) / (8 * Q)
    instants = centres[:, None] + ((np.arange(64) + 0.5) / 64 - 0.5) * exposure
    index = np.floor(instants).astype(int)
    values = slots[:, np.clip(index, 0, n - 1)].astype(float)
    return np.where((index < 0) | (index >= n), 0.5, values).mean(axis=2).reshape(len(slots), n * Q, 8).mean(axis=2)


def scene_of(slots: np.ndarray, rng: np.random.Generator, *, noise: float = 0.005, rows: float = 0.0) -> DenoiserInput:
    """Columns in front of a slowly changing picture, rightly believed; every row with an offset of its own."""
    shape = through_exposure(slots, EXPOSURE)
    place = (np.arange(N_STRIPS) + 0.5) / N_STRIPS - 0.5
    crosstalk = np.exp(-((place[:, None] - np.arange(-1, 2)) ** 2) / (2 * 0.45**2))
    around = np.pad(shape, ((1, 1), (0, 0)))
    light = sum(crosstalk[None, :, k, None] * around[k : k + len(slots), None] for k in range(3))
    picture = 0.3 + 0.1 * np.sin(np.arange(shape.shape[1]) / 90 + place[:, None] * 5)
    light = 0.01 + light * picture + noise * rng.standard_normal(light.shape)
    light += rows * rng.standard_normal(light.shape[-1])
    clock = Clock(5.0, EXPOSURE, PACKET, 0.0, slots.shape[1], 0, np.zeros(2, np.int64), np.zeros(len(slots)), 9.0)
    return DenoiserInput(
        samples=SlotSamples(light.astype(np.float32), np.ones(light.shape, np.float32), Q),
        clock=clock,
        lit=slots.astype(np.float32),
        llr=(9.0 * (2.0 * slots - 1)).astype(np.float32),
        w=np.full(len(slots), W),
        model=channel.ObservationModel(
            0.01, NoiseModel(noise**2, 1e-6), Crosstalk(crosstalk), Exposure.of(EXPOSURE, Q)
        ),
    )


def with_crosstalk(scene: DenoiserInput, shares: np.ndarray) -> DenoiserInput:
    return replace(scene, model=replace(scene.model, crosstalk=Crosstalk(shares)))


@pytest.fixture
def scene() -> DenoiserInput:
    rng = np.random.default_rng(3)
    return scene_of(sent(rng), rng)


def widths(names: tuple[str, ...]) -> list[int]:
    return [int(found.group(1)) if (found := re.search(r"\[(\d+)\]", name)) else 1 for name in names]


def feature(strips: np.ndarray, name: str) -> np.ndarray:
    """(B, S, k, N) the features of one name."""
    number = STRIP_FEATURES.index(name)
    start = sum(widths(STRIP_FEATURES)[:number])
    return strips[:, :, start : start + widths(STRIP_FEATURES)[number]]


def test_the_contract_names_every_feature(scene: DenoiserInput) -> None:
    strips, columns = network_inputs(scene, np.array([0, 2]))
    n_named = [sum(widths(names)) for names in (STRIP_FEATURES, COLUMN_FEATURES)]
    assert strips.shape == (2, N_STRIPS, n_named[0], 2 * PACKET)
    assert columns.shape == (2, n_named[1], 2 * PACKET)
    assert strips.dtype == columns.dtype == np.float32
    assert np.isfinite(strips).all()


def test_headers_are_known_and_no_other_slot(scene: DenoiserInput) -> None:
    _, columns = network_inputs(scene, np.array([1]))
    np.testing.assert_array_equal(columns[0, 0, :10], 2 * np.array(HEADER) - 1)
    np.testing.assert_array_equal(columns[0, 0, PACKET : PACKET + 10], 2 * np.array(HEADER) - 1)
    assert not columns[0, 0, 10:PACKET].any()
    np.testing.assert_array_equal(columns[0, 1:11].argmax(axis=0), np.arange(2 * PACKET) % 10)


def test_neighbours_light_is_slots_through_the_exposure(scene: DenoiserInput) -> None:
    strips, _ = network_inputs(scene, np.array([0, 1]))
    shape = through_exposure(scene.lit, EXPOSURE).reshape(N_COLUMNS, -1, Q)
    expected = (
        scene.model.crosstalk.shares[:, 0, None, None] * shape[0]
        + scene.model.crosstalk.shares[:, 2, None, None] * shape[2]
    )
    np.testing.assert_allclose(np.moveaxis(feature(strips, "neighbours[4]")[1], 1, 2), expected, atol=0.02)
    alone = scene.model.crosstalk.shares[:, 2, None, None] * shape[1]
    np.testing.assert_allclose(np.moveaxis(feature(strips, "neighbours[4]")[0], 1, 2), alone, atol=0.02)


def test_delayed_neighbours_move(scene: DenoiserInput) -> None:
    delayed = replace(scene, clock=replace(scene.clock, delay_slots=np.array([1.0, 0.0, 1.0])))
    on_time = feature(network_inputs(scene, np.array([1]))[0], "neighbours[4]")
    late = feature(network_inputs(delayed, np.array([1]))[0], "neighbours[4]")
    np.testing.assert_allclose(late[..., 1:], on_time[..., :-1], atol=1e-5)


def test_right_beliefs_leave_noise_alone(scene: DenoiserInput) -> None:
    strips, _ = network_inputs(scene, np.arange(N_COLUMNS))
    inner = feature(strips, "residual[4]")[..., 5:-5]
    assert abs(inner.mean()) < 0.25  # a trace of every sample lies beyond the memory
    assert 0.5 < inner.std() < 1.2


@pytest.mark.parametrize("sent_state", [0, 1])
def test_a_wrong_belief_stands_out(scene: DenoiserInput, sent_state: int) -> None:
    """Light where the slot is believed dark, and the reverse."""
    slot = 20 + int(np.flatnonzero(scene.lit[1, 20:] == sent_state)[5])
    lit = scene.lit.copy()
    lit[1, slot] = 1 - sent_state
    residual = feature(network_inputs(replace(scene, lit=lit), np.array([1]))[0], "residual[4]")[0].mean(axis=(0, 1))
    assert abs(np.abs(residual).argmax() - slot) <= 1
    assert np.sign(residual[slot]) == 2 * sent_state - 1


def taken_from(scene: DenoiserInput) -> np.ndarray:
    """(C, S, n) light that is taken for row noise."""
    whole = scene.model.expected(scene.lit, scene.clock, np.arange(len(scene.lit))).whole
    return scene.samples.light - denoise.remove_row_noise(scene.samples, whole, scene.model).light


def test_what_all_columns_show_at_one_instant_is_taken_off() -> None:
    """Most of the rows' own light goes, and hardly anything of what the columns send."""
    rng = np.random.default_rng(8)
    slots = np.concatenate([sent(rng) for _ in range(4)])
    rows = 0.008
    scene = scene_of(slots, rng, rows=rows)
    taken = taken_from(scene)
    own = np.random.default_rng(8)
    _ = [sent(own) for _ in range(4)]
    own.standard_normal(scene.samples.light.shape)
    true = rows * own.standard_normal(scene.samples.light.shape[-1])
    inner = slice(20, -20)
    left = (true - taken)[..., inner]
    assert left.std() < 0.6 * true[inner].std()
    calm = scene_of(slots, rng)
    spoiled = taken_from(calm)
    assert spoiled[..., inner].std() < 0.3 * rows


def test_one_column_alone_has_no_row_light_to_tell(scene: DenoiserInput) -> None:
    alone = scene_of(scene.lit[:1], np.random.default_rng(1))
    assert not taken_from(alone).any()


SHIPPED = sorted(path.parent.name for path in data_dir("models").glob("*/model.onnx"))


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_models_are_small_and_explained(name: str) -> None:
    folder = data_dir("models") / name
    denoiser = load_denoiser(name)
    assert denoiser.card.name == name
    assert (folder / denoiser.card.file).stat().st_size <= 2_000_000
    assert denoiser.card.recipe["steps"] > 0
    assert (folder / "README.md").is_file()


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_models_do_not_spoil_what_is_right(name: str) -> None:
    rng = np.random.default_rng(3)
    scene = scene_of(sent(rng), rng, noise=0.02)
    corrections = load_denoiser(name).slot_corrections(scene, np.arange(N_COLUMNS))
    assert corrections.shape == scene.lit.shape
    corrected = 9.0 * (2 * scene.lit - 1) + corrections
    assert ((corrected > 0) == (scene.lit > 0.5)).mean() > 0.99


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_models_contradict_wrong_beliefs(name: str) -> None:
    """Where the light model is wrongly sure of a slot, the correction points the other way."""
    rng = np.random.default_rng(4)
    scene = scene_of(sent(rng), rng, noise=0.03)
    wrong = rng.random(scene.lit.shape) < 0.04
    wrong[:, np.arange(2 * PACKET) % PACKET < 20] = False
    lit = np.where(wrong, 1 - scene.lit, scene.lit).astype(np.float32)
    doubted = replace(scene, lit=lit, llr=2.0 * (2 * lit - 1))
    towards = load_denoiser(name).slot_corrections(doubted, np.arange(N_COLUMNS)) * (2 * scene.lit - 1)
    assert (towards[wrong] > 0).mean() > 0.8
    assert towards[wrong].mean() > towards[~wrong].mean() + 0.5


#: Validation frames of four scene classes with doubtful columns; of class 0 the first with more than a nat to lose.
DOUBTFUL_FRAMES = (3, 4, 19, 42)


def cross_entropy(sample: Sample, corrections: np.ndarray) -> float:
    """Sum over the words that were sent, after corrections (B, N) of slots."""
    n_columns = sample.w.size
    before, n_slots = int(sample.first_slot), sample.burst.size * int(sample.packet_slots)
    of_packets = np.pad(corrections * sample.reception, ((0, 0), (before, n_slots)))[:, :n_slots]
    copies = of_packets.reshape(n_columns, sample.burst.size, -1)[..., 20:]
    total = 0.0
    for burst, column, symbol in zip(*np.nonzero(sample.words != UNKNOWN), strict=True):
        words = codebook(int(sample.w[column]))
        slots = copies[column, sample.burst == burst].sum(axis=0)[10 * symbol :][:10]
        scores = sample.scores[burst, column, symbol, : len(words)] + words @ slots
        total += np.logaddexp.reduce(scores) - scores[sample.words[burst, column, symbol]]
    return total


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_models_make_the_words_that_were_sent_likelier(name: str) -> None:
    """Cross-entropy per word of frames not trained on, against that without a network."""
    samples = [sample for number in DOUBTFUL_FRAMES if (sample := validation_sample(number)) is not None]
    assert len(samples) == len(DOUBTFUL_FRAMES)
    session = onnxruntime.InferenceSession(load_denoiser(name).weights)
    sums = np.zeros(2)
    for sample in samples:
        fed = {part: getattr(sample, part).astype(np.float32) for part in ("strips", "columns")}
        corrections = session.run(["correction"], fed)[0]
        sums += [cross_entropy(sample, values) for values in (corrections, np.zeros_like(corrections))]
    assert sums[0] <= 0.95 * sums[1], sums[0] / sums[1]


def test_slots_that_are_not_seen_and_preambles_are_left_alone(scene: DenoiserInput) -> None:
    valid = scene.samples.valid.copy()
    valid[..., : 26 * Q] = 0
    hidden = replace(scene, samples=replace(scene.samples, valid=valid))
    corrections = load_denoiser().slot_corrections(hidden, np.array([1]))
    assert not corrections[:, :26].any()
    assert not corrections[:, PACKET : PACKET + 20].any()
    assert (corrections[:, 26:PACKET] != 0).mean() > 0.95


def test_columns_and_the_order_of_strips_do_not_touch_each_other(scene: DenoiserInput) -> None:
    denoiser = load_denoiser()
    together = denoiser.slot_corrections(scene, np.array([0, 1, 2]))
    alone = denoiser.slot_corrections(scene, np.array([2]))
    np.testing.assert_allclose(together[2], alone[0], atol=1e-3)
    order = np.array([3, 0, 4, 1, 2])
    samples = SlotSamples(scene.samples.light[:, order], scene.samples.valid[:, order], Q)
    mixed = denoiser.slot_corrections(
        with_crosstalk(replace(scene, samples=samples), scene.model.crosstalk.shares[order]), np.array([0, 1, 2])
    )
    np.testing.assert_allclose(mixed, together, atol=1e-2)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    """A copy of the shipped model that may be damaged."""
    return Path(shutil.copytree(data_dir("models") / denoise.DEFAULT_MODEL, tmp_path / "model"))


def edit(model: Path, old: str, new: str) -> None:
    text = (model / "model.toml").read_text()
    assert old in text
    (model / "model.toml").write_text(text.replace(old, new))


def replace_weights(model: Path, data: bytes) -> None:
    """Put other bytes in place of the weights, with their own checksum."""
    before = load_denoiser(str(model)).card.sha256
    (model / "model.onnx").write_bytes(data)
    edit(model, before, hashlib.sha256(data).hexdigest())


@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (shutil.rmtree, r"no model can be read there.*vlc-rx train"),
        (lambda model: (model / "model.onnx").unlink(), r"model\.onnx: no model can be read there"),
        (lambda model: (model / "model.onnx").write_bytes(b"cut"), "does not match the checksum"),
    ],
)
def test_what_is_missing_or_cut_is_named(damage: Callable[[Path], object], told: str, model: Path) -> None:
    damage(model)
    with pytest.raises(ProfileError, match=rf"{model}.*{told}"):
        load_denoiser(str(model))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('kind = "denoiser"', 'kind = "camera"'),
        ("format = 1", "format = 2"),
        ("format = 1", "format = 1\ncolour = 3"),
        ("samples_per_slot = 4", "samples_per_slot = 8"),
        ('"shot"', '"phase of the moon"'),
        ("[contract]", "[contract"),
    ],
)
def test_cards_are_strict(model: Path, old: str, new: str) -> None:
    edit(model, old, new)
    with pytest.raises(ProfileError, match=r"model\.toml"):
        load_denoiser(str(model))


def test_what_is_no_network_is_refused_when_it_is_needed(model: Path, scene: DenoiserInput) -> None:
    replace_weights(model, b"not a network")
    with pytest.raises(ProfileError, match="ONNX Runtime refuses it"):
        load_denoiser(str(model)).slot_corrections(scene, np.array([0]))


@pytest.fixture(scope="module")
def trials() -> dict[str, Trial]:
    """A clean frame, and one whose long exposure leaves the receiver in doubt."""
    clean, *_, long_exposure = SCENE_CLASSES
    return {
        "clean": simulate_trial(validation_scene(clean, "paper-17k3", 0), 1),
        "hard": simulate_trial(validation_scene(long_exposure, "paper-17k3", 1), 1),
    }


def packets(result: FrameResult) -> list[str]:
    return [packet.payload for column in result.columns for packet in column.packets]


def received(trial: Trial, mode: str) -> tuple[FrameResult, Score]:
    return reception(trial, trial.options(cae=mode))


def test_a_clean_frame_goes_without(trials: dict[str, Trial]) -> None:
    result, score = received(trials["clean"], "auto")
    assert score.bit_errors == 0
    assert result.denoiser is None
    assert not any(column.denoised for column in result.columns)


def test_always_runs_on_every_column_and_harms_none(trials: dict[str, Trial]) -> None:
    result, score = received(trials["clean"], "always")
    assert score.bit_errors == 0
    assert result.denoiser["columns"] == 20
    assert result.denoiser["kept"] == sum(column.denoised for column in result.columns)


def test_doubtful_columns_get_a_second_opinion(trials: dict[str, Trial]) -> None:
    never, without = received(trials["hard"], "never")
    auto, with_it = received(trials["hard"], "auto")
    assert never.denoiser is None
    assert 0 < auto.denoiser["columns"] <= 20
    assert with_it.error_free >= without.error_free


def test_the_receiver_goes_on_without_a_broken_model(trials: dict[str, Trial], monkeypatch: pytest.MonkeyPatch) -> None:
    never, _ = received(trials["hard"], "never")

    def broken() -> Denoiser:
        raise ProfileError("models/strips/model.onnx: does not match its checksum", "install the package again")

    monkeypatch.setattr(still, "_denoiser", broken)
    auto, _ = received(trials["hard"], "auto")
    assert packets(auto) == packets(never)
    assert "does not match its checksum; install the package again" in auto.denoiser["message"]


def test_corrections_are_kept_only_where_they_leave_less_doubt(trials: dict[str, Trial]) -> None:
    options = trials["hard"].options()
    found = search(FrameCache(trials["hard"].frame), options)
    assert not isinstance(found, Failure)
    lock = found.best.acquisition
    seen = still.decode(lock, options.skip, found.best.reception)
    better, kept, report = still.apply_autoencoder(lock, seen, options)
    assert report["kept"] == len(kept) > 0
    columns = sorted(kept)
    assert (better.best_confidence(kept)[columns] > seen.best_confidence()[columns]).all()
