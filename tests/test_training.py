"""Training: data with right labels, seeded and resumable fitting, export that computes what torch computes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="PyTorch (extra train) is not installed")
pytest.importorskip("onnx", reason="onnx (extra train) is not installed")
pytest.importorskip("matplotlib", reason="matplotlib (extra train) is not installed")

from rxcli.cli.main import run  # noqa: E402
from rxcli.denoise import load_denoiser  # noqa: E402
from rxcli.errors import InputError, ReceiverError  # noqa: E402
from rxcli.simulate.pictures import PHOTOS  # noqa: E402
from rxcli.training import columns, dataset, export, fit, scenes  # noqa: E402
from rxcli.training.network import Shape, StripNetwork, n_parameters  # noqa: E402

SMALL = Shape(8, 8, (1, 2), (1, 2))


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> list[fit.Sample]:
    return dataset.column_samples(2, 1, tmp_path_factory.mktemp("data"), progress=False)


def test_no_picture_and_no_camera_stands_in_training_and_validation() -> None:
    assert not set(scenes.TRAINING_PHOTOS) & set(scenes.VALIDATION_PICTURES)
    assert set(scenes.TRAINING_PHOTOS) <= set(PHOTOS)
    used = {picture for kind in scenes.SCENE_CLASSES for picture in kind.pictures}
    assert used <= set(scenes.VALIDATION_PICTURES)
    drawn = [scenes.training_scene(np.random.default_rng(seed)) for seed in range(4)]
    assert all(isinstance(scene.picture, np.ndarray) for scene in drawn)
    assert not {scene.camera_name for scene in drawn} & {*scenes.VALIDATION_CAMERAS, "xs10", "phone12b"}


@pytest.mark.parametrize("seed", range(8))
def test_random_pictures_are_seeded_and_have_contrast(seed: int) -> None:
    one, two = (scenes.random_picture(np.random.default_rng(seed), 400, 300) for _ in range(2))
    np.testing.assert_array_equal(one, two)
    assert one.shape == (300, 400, 3)
    assert one.std() > 1


def test_column_samples_show_their_slots() -> None:
    """In front of a white picture the light of a column follows its slots."""
    white = np.full((768, 1366, 3), 255, np.uint8)
    for example in columns.random_examples(np.random.default_rng(2), white, 6):
        samples = example.scene.samples
        light = samples.light.mean(axis=1).reshape(*example.slots.shape, -1).mean(axis=2)
        likeness = [np.corrcoef(a, b)[0, 1] for a, b in zip(light, example.slots, strict=True)]
        assert min(likeness) > 0.5
        shifted = [np.corrcoef(a[4:], b[:-4])[0, 1] for a, b in zip(light, example.slots, strict=True)]
        assert max(shifted) < min(likeness)


def test_frame_samples_carry_what_was_sent(tmp_path: Path) -> None:
    """The shipped network, which has never seen this frame, agrees with the labels."""
    sample, *_ = dataset.validation_samples(1, tmp_path, progress=False)
    session = load_denoiser()._session
    found = session.run(
        None, {"strips": sample.strips.astype(np.float32), "columns": sample.columns.astype(np.float32)}
    )
    wrong = ((found[0] > 0) != (sample.slots > 0))[sample.seen > 0.5]
    assert wrong.mean() < 0.02


def test_data_sets_are_kept_and_made_again_where_damaged(tmp_path: Path) -> None:
    before = dataset.column_samples(1, 3, tmp_path, progress=False)
    path = tmp_path / "columns-3" / "00000.npz"
    path.write_bytes(path.read_bytes()[:1000])
    after = dataset.column_samples(1, 3, tmp_path, progress=False)
    assert len(before) == len(after) == dataset.EXAMPLES_PER_PICTURE
    np.testing.assert_array_equal(before[0].strips, after[0].strips)
    stamp = path.stat().st_mtime_ns
    dataset.column_samples(1, 3, tmp_path, progress=False)
    assert path.stat().st_mtime_ns == stamp


def test_fitting_learns(samples: list[fit.Sample], tmp_path: Path) -> None:
    recipe = fit.Recipe(SMALL, steps=40, batch_columns=8, learning_rate=1e-2)
    fit.fit(samples, [], samples[:2], recipe, tmp_path, progress=False)
    losses = fit.final_losses(tmp_path)
    assert losses["validation_nats"] < 0.6  # ln 2 = 0.69 is guessing
    assert (tmp_path / "loss.png").stat().st_size > 1000


def test_a_resumed_run_ends_where_an_uninterrupted_one_does(
    samples: list[fit.Sample], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = fit.Recipe(SMALL, steps=8, batch_columns=4)
    whole = fit.fit(samples, [], [], recipe, tmp_path / "whole", progress=False)
    monkeypatch.setattr(fit, "_CHECKPOINT_EVERY", 3)
    calls = iter(range(100))
    loss_of = fit.loss_of

    def failing(*arguments: object) -> object:
        if next(calls) == 5:
            raise KeyboardInterrupt
        return loss_of(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(fit, "loss_of", failing)
    with pytest.raises(KeyboardInterrupt):
        fit.fit(samples, [], [], recipe, tmp_path / "cut", progress=False)
    resumed = fit.fit(samples, [], [], recipe, tmp_path / "cut", resume=True, progress=False)
    for name, weights in whole.state_dict().items():
        np.testing.assert_array_equal(resumed.state_dict()[name].numpy(), weights.numpy(), err_msg=name)


def test_another_recipe_cannot_be_resumed(samples: list[fit.Sample], tmp_path: Path) -> None:
    fit.fit(samples, [], [], fit.Recipe(SMALL, steps=1), tmp_path, progress=False)
    with pytest.raises(InputError, match="another recipe"):
        fit.fit(samples, [], [], fit.Recipe(SMALL, steps=2), tmp_path, resume=True, progress=False)
    (tmp_path / fit.CHECKPOINT).write_bytes(b"no checkpoint")
    with pytest.raises(InputError, match="not a checkpoint"):
        fit.fit(samples, [], [], fit.Recipe(SMALL, steps=1), tmp_path, resume=True, progress=False)
    (tmp_path / fit.CHECKPOINT).unlink()
    with pytest.raises(InputError, match="no checkpoint"):
        fit.fit(samples, [], [], fit.Recipe(SMALL, steps=1), tmp_path, resume=True, progress=False)


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
    sizes = ["--steps", "3", "--frames", "0", "--pictures", "1", "--held-out", "0"]
    out = tmp_path / "made"
    assert run(["train", str(out), "-q", *sizes, "--strip-width", "4", "--column-width", "4", "--name", "tiny"]) == 0
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "parameters" in captured.err
    card = load_denoiser(str(out)).card
    assert (card.name, card.recipe["steps"], card.recipe["seed"]) == ("tiny", 3, 1)
