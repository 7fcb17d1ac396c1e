"""Training: data with right labels, seeded and resumable fitting, export that computes what torch computes."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch (extra train) is not installed")
pytest.importorskip("onnx", reason="onnx (extra train) is not installed")
pytest.importorskip("matplotlib", reason="matplotlib (extra train) is not installed")

from rxcli.cli.main import run  # noqa: E402
from rxcli.errors import InputError, ReceiverError  # noqa: E402
from rxcli.lab.simulate.pictures import PHOTOS  # noqa: E402
from rxcli.lab.training import dataset, export, fit, scenes  # noqa: E402
from rxcli.lab.training.fit import Shape, StripNetwork, n_parameters  # noqa: E402
from rxcli.protocol import codebook  # noqa: E402
from rxcli.receiver.channel.denoise import load_denoiser  # noqa: E402

SMALL = Shape(8, 8, (1, 2), (1, 2))
#: Its first frame leaves the receiver in doubt.
SEED = 11


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> list[dataset.Sample]:
    """Of a frame whose columns are doubtful."""
    return dataset.frame_samples(1, SEED, tmp_path_factory.mktemp("data"), progress=False)


def test_no_picture_and_no_camera_stands_in_training_and_validation() -> None:
    assert set(scenes.TRAINING_PHOTOS) <= set(PHOTOS)
    used = {picture for kind in scenes.SCENE_CLASSES for picture in kind.pictures}
    assert not used & set(scenes.TRAINING_PHOTOS)
    drawn = [scenes.training_scene(np.random.default_rng(seed)) for seed in range(4)]
    assert all(isinstance(scene.picture, np.ndarray) for scene in drawn)
    assert not {scene.camera_name for scene in drawn} & {*scenes.VALIDATION_CAMERAS, "xs10", "phone12b"}


@pytest.mark.parametrize("seed", range(8))
def test_random_pictures_are_seeded_and_have_contrast(seed: int) -> None:
    one, two = (scenes.random_picture(np.random.default_rng(seed), 400, 300) for _ in range(2))
    np.testing.assert_array_equal(one, two)
    assert one.shape == (300, 400, 3)
    assert one.std() > 1


def test_samples_tell_what_was_sent(samples: list[dataset.Sample]) -> None:
    """The light model alone finds most words, and nearly all where it is sure."""
    assert len(samples) == 1
    sample = samples[0]
    known = sample.words != dataset.UNKNOWN
    assert known.mean() > 0.3
    best = sample.scores.argmax(axis=-1)
    assert (best == sample.words)[known].mean() > 0.4
    runner_up = np.sort(sample.scores.astype(np.float32), axis=-1)[..., -2]
    sure = known & (runner_up < -8)
    assert sure.sum() > 10
    assert (best == sample.words)[sure].mean() > 0.95


def test_words_are_scored_as_the_detector_would() -> None:
    """By the sum of the ratios of their lit slots, against the best word."""
    llr = np.random.default_rng(5).normal(0, 3, (2, 10)).astype(np.float32)
    scores, words = dataset._word_scores(llr, 4), codebook(4)
    assert scores.shape == (2, 128)
    assert not np.isfinite(scores[:, len(words) :]).any()
    for slots, found in zip(llr, scores, strict=True):
        totals = np.array([slots[word == 1].sum() for word in words])
        np.testing.assert_allclose(found[: len(words)], np.maximum(totals - totals.max(), -60), atol=0.05)


def test_a_network_that_corrects_nothing_leaves_the_light_models_loss(samples: list[dataset.Sample]) -> None:
    sample = samples[0]
    columns = np.arange(sample.w.size)
    known = sample.words != dataset.UNKNOWN
    scores = sample.scores[known].astype(np.float64)
    right = np.take_along_axis(scores, sample.words[known][:, None], axis=1)[:, 0]
    wanted = (np.log(np.exp(scores).sum(axis=1)) - right).mean()
    assert fit.loss_of(StripNetwork(SMALL), sample, columns).item() == pytest.approx(wanted, rel=1e-4)


def test_corrections_of_all_copies_count(samples: list[dataset.Sample]) -> None:
    """A network that knew the slots would leave no loss."""
    sample = samples[0]

    class Knowing(torch.nn.Module):
        def forward(self, strips: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
            return torch.from_numpy(corrections)

    corrections = np.zeros(sample.reception.shape, np.float32)
    grid = np.arange(corrections.shape[1]) + int(sample.first_slot)
    length = int(sample.packet_slots)
    for row, w in enumerate(sample.w):
        for slot, place in enumerate(grid):
            burst, at = sample.burst[place // length], place % length - 20
            word = sample.words[burst, row, at // 10] if at >= 0 else dataset.UNKNOWN
            if word != dataset.UNKNOWN:
                corrections[row, slot] = 100 * (2.0 * codebook(int(w))[word, at % 10] - 1)
    assert fit.loss_of(Knowing(), sample, np.arange(sample.w.size)).item() < 1e-3


def test_data_sets_are_kept_and_made_again_where_damaged(tmp_path: Path) -> None:
    before = dataset.frame_samples(1, SEED, tmp_path, progress=False)
    path = tmp_path / f"frames-{SEED}" / "00000.npz"
    path.write_bytes(path.read_bytes()[:1000])
    after = dataset.frame_samples(1, SEED, tmp_path, progress=False)
    assert len(before) == len(after) == 1
    np.testing.assert_array_equal(before[0].strips, after[0].strips)
    stamp = path.stat().st_mtime_ns
    dataset.frame_samples(1, SEED, tmp_path, progress=False)
    assert path.stat().st_mtime_ns == stamp


def test_fitting_learns(samples: list[dataset.Sample], tmp_path: Path) -> None:
    before = fit.mean_loss(StripNetwork(SMALL), samples)
    recipe = fit.Recipe(SMALL, steps=60, learning_rate=1e-2)
    history = fit.fit(samples, samples, recipe, tmp_path, progress=False).history
    assert history[-1][2] < 0.9 * before
    assert (tmp_path / "loss.png").stat().st_size > 1000


def test_nothing_is_learned_from_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no frame gave a doubtful column"):
        fit.fit([], [], fit.Recipe(SMALL, steps=1), tmp_path, progress=False)


def test_equal_recipes_give_equal_weights(samples: list[dataset.Sample], tmp_path: Path) -> None:
    folders = (tmp_path / "one", tmp_path / "two")
    one, two = (fit.fit(samples, [], fit.Recipe(SMALL, steps=4), folder, progress=False) for folder in folders)
    for name, weights in one.network.state_dict().items():
        np.testing.assert_array_equal(two.network.state_dict()[name].numpy(), weights.numpy(), err_msg=name)


def test_an_interrupted_fit_is_resumed(
    samples: list[dataset.Sample], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit, "_CHECKPOINT_EVERY", 2)
    recipe, n_steps, loss = fit.Recipe(SMALL, steps=5), 0, fit._drawn_loss

    def interrupted_loss(*batch: Any) -> torch.Tensor:
        nonlocal n_steps
        n_steps += 1
        if n_steps == 4:
            raise KeyboardInterrupt
        return loss(*batch)

    whole = fit.fit(samples, samples, recipe, tmp_path / "whole", progress=False)
    monkeypatch.setattr(fit, "_drawn_loss", interrupted_loss)
    with pytest.raises(KeyboardInterrupt):
        fit.fit(samples, samples, recipe, tmp_path / "resumed", progress=False)
    resumed = fit.fit(samples, samples, recipe, tmp_path / "resumed", progress=False)
    assert n_steps == 4 + 3
    assert resumed.history == whole.history
    for name, weights in whole.network.state_dict().items():
        np.testing.assert_array_equal(resumed.network.state_dict()[name].numpy(), weights.numpy(), err_msg=name)


def test_the_checkpoint_of_another_fit_is_left_alone(samples: list[dataset.Sample], tmp_path: Path) -> None:
    fit.fit(samples, [], fit.Recipe(SMALL, steps=2), tmp_path, progress=False)
    history = fit.fit(samples, [], fit.Recipe(SMALL, steps=3), tmp_path, progress=False).history
    alone = fit.fit(samples, [], fit.Recipe(SMALL, steps=3), tmp_path / "alone", progress=False).history
    assert history[-1][:2] == alone[-1][:2]


@pytest.mark.parametrize("shape", [Shape(), SMALL])
def test_onnx_computes_what_torch_computes(shape: Shape, tmp_path: Path) -> None:
    torch.manual_seed(4)
    network = StripNetwork(shape).eval()
    card = export.export_model(network, tmp_path, "tried", 1, {"steps": 0}, {})
    assert export.parity(network, tmp_path / card.file, seed=5) < export.PARITY
    assert load_denoiser(str(tmp_path)).card.name == "tried"


def test_an_export_that_differs_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export, "parity", lambda *_: 1e-3)
    with pytest.raises(ReceiverError, match=r"differs from torch by 1\.0e-03"):
        export.export_model(StripNetwork(SMALL), tmp_path, "tried", 1, {}, {})
    assert not (tmp_path / "model.toml").exists()


def test_the_default_network_is_small() -> None:
    assert 20_000 <= n_parameters(StripNetwork(Shape())) <= 300_000


def test_the_command_makes_a_model_that_loads(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sizes = ["--steps", "3", "--frames", "1", "--held-out", "0", "--seed", str(SEED)]
    out = tmp_path / "made"
    assert run(["train", str(out), "-q", *sizes, "--strip-width", "4", "--column-width", "4", "--name", "tiny"]) == 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "parameters" in captured.err
    card = load_denoiser(str(out)).card
    assert (card.name, card.recipe["steps"], card.recipe["seed"]) == ("tiny", 3, SEED)
