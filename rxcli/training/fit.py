"""Fitting: seeded, resumable, with a progress bar and a plot of the loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from rxcli.errors import InputError
from rxcli.training.network import Shape, StripNetwork

CHECKPOINT = "checkpoint.pt"
_CHECKPOINT_EVERY = 200
_CROP_SLOTS = 160


@dataclass(frozen=True)
class Sample:
    """Adjacent columns with equal numbers of strips, as the network sees them, with their truth."""

    #: (B, S, F, N) float16.
    strips: NDArray[np.float16]
    #: (B, G, N) float16.
    columns: NDArray[np.float16]
    #: (B, N) 0/1.
    slots: NDArray[np.uint8]
    #: (B, N) 1 where the slot can be seen.
    seen: NDArray[np.float16]


@dataclass(frozen=True)
class Recipe:
    """How a network is fitted."""

    shape: Shape = field(default_factory=Shape)
    steps: int = 6000
    batch_columns: int = 32
    learning_rate: float = 3e-3
    seed: int = 1
    #: Share of batches from whole simulated frames; the others are from `rxcli.training.columns`.
    frame_share: float = 0.5


class _Batches:
    """Random batches: random samples with equal numbers of strips, random parts of them."""

    def __init__(self, samples: Sequence[Sample], n_columns: int) -> None:
        self._groups: dict[int, list[Sample]] = {}
        for sample in samples:
            self._groups.setdefault(sample.strips.shape[1], []).append(sample)
        self._n_columns = n_columns

    def draw(self, rng: np.random.Generator) -> tuple[Tensor, ...]:
        sizes = np.array([len(group) for group in self._groups.values()], np.float64)
        group = list(self._groups.values())[int(rng.choice(sizes.size, p=sizes / sizes.sum()))]
        parts: list[tuple[NDArray[Any], ...]] = []
        while sum(len(part[0]) for part in parts) < self._n_columns:
            parts.append(_cut(group[int(rng.integers(len(group)))], rng, self._n_columns // 2))
        n_slots = min(part[0].shape[-1] for part in parts)
        joined = (np.concatenate([array[..., :n_slots] for array in arrays]) for arrays in zip(*parts, strict=True))
        return tuple(torch.from_numpy(array.astype(np.float32)) for array in joined)


def _cut(sample: Sample, rng: np.random.Generator, most_columns: int) -> tuple[NDArray[Any], ...]:
    n_columns, n_slots = sample.slots.shape
    start = int(rng.integers(0, max(n_slots - _CROP_SLOTS, 0) + 1))
    chosen = rng.permutation(n_columns)[:most_columns]
    window = slice(start, start + _CROP_SLOTS)
    return tuple(array[chosen][..., window] for array in (sample.strips, sample.columns, sample.slots, sample.seen))


def loss_of(network: StripNetwork, batch: tuple[Tensor, ...]) -> Tensor:
    """Mean cross-entropy of the visible slots, nats."""
    strips, columns, slots, seen = batch
    each = torch.nn.functional.binary_cross_entropy_with_logits(network(strips, columns), slots, reduction="none")
    return (each * seen).sum() / seen.sum().clamp(min=1)


def fit(
    columns: Sequence[Sample],
    frames: Sequence[Sample],
    validation: Sequence[Sample],
    recipe: Recipe,
    folder: Path,
    *,
    resume: bool = False,
    progress: bool = True,
) -> StripNetwork:
    """Fit a network.

    Args:
        columns: samples of `rxcli.training.columns`.
        frames: samples of whole simulated frames; may be empty.
        validation: samples that are not learned from.
        recipe: sizes and steps.
        folder: gets the checkpoint and the plot of the loss.
        resume: go on from the checkpoint in `folder`.
        progress: show a bar on stderr.

    Returns:
        The network.

    Raises:
        InputError: the checkpoint is missing or of another recipe.
    """
    torch.manual_seed(recipe.seed)
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    network = StripNetwork(recipe.shape)
    optimiser = torch.optim.AdamW(network.parameters(), recipe.learning_rate, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, recipe.learning_rate, total_steps=recipe.steps + 1)
    history: list[tuple[int, float, float]] = []
    first = _restore(folder / CHECKPOINT, recipe, network, optimiser, schedule, history) if resume else 0
    sources = [_Batches(part, recipe.batch_columns) for part in (columns, frames) if part]
    share = recipe.frame_share if len(sources) == 2 else 0.0
    held = [_Batches([sample], sample.slots.shape[0]).draw(np.random.default_rng(0)) for sample in validation]
    running = float("nan")
    for step in tqdm(range(first, recipe.steps), initial=first, total=recipe.steps, disable=not progress, unit="step"):
        # A generator of its own for every step: a resumed run draws the same batches.
        rng = np.random.default_rng([recipe.seed, step])
        batch = sources[int(rng.random() < share)].draw(rng)
        optimiser.zero_grad()
        loss = loss_of(network, batch)
        torch.autograd.backward(loss)
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        running = loss.item() if np.isnan(running) else 0.98 * running + 0.02 * loss.item()
        if (step + 1) % _CHECKPOINT_EVERY == 0 or step + 1 == recipe.steps:
            history.append((step + 1, running, _mean_loss(network, held)))
            _save(folder / CHECKPOINT, recipe, step + 1, network, optimiser, schedule, history)
    plot_loss(history, folder / "loss.png")
    network.eval()
    return network


def _mean_loss(network: StripNetwork, batches: list[tuple[Tensor, ...]]) -> float:
    network.eval()
    with torch.no_grad():
        losses = [loss_of(network, batch).item() for batch in batches]
    network.train()
    return float(np.mean(losses)) if losses else float("nan")


def _save(path: Path, recipe: Recipe, step: int, network: StripNetwork, *others: Any) -> None:
    optimiser, schedule, history = others
    state = {
        "recipe": asdict(recipe),
        "step": step,
        "network": network.state_dict(),
        "optimiser": optimiser.state_dict(),
        "schedule": schedule.state_dict(),
        "history": list(history),
    }
    part = path.with_suffix(".part")
    torch.save(state, part)
    part.replace(path)


def _restore(path: Path, recipe: Recipe, network: StripNetwork, *others: Any) -> int:
    optimiser, schedule, history = others
    state = load_checkpoint(path)
    if state["recipe"] != asdict(recipe):
        raise InputError(f"{path}: the checkpoint was made by another recipe", "give the same options, or start anew")
    network.load_state_dict(state["network"])
    optimiser.load_state_dict(state["optimiser"])
    schedule.load_state_dict(state["schedule"])
    history.extend(tuple(entry) for entry in state["history"])
    return int(state["step"])


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint; only tensors and plain values are accepted.

    Raises:
        InputError: missing or not a checkpoint.
    """
    try:
        state = torch.load(path, weights_only=True)
    except FileNotFoundError:
        raise InputError(f"{path}: no checkpoint to go on from", "start without --resume") from None
    except Exception as error:
        raise InputError(f"{path}: not a checkpoint ({type(error).__name__})", "start without --resume") from None
    return dict(state)


def final_losses(folder: Path) -> dict[str, float]:
    """Cross-entropy of a slot at the end of the run in `folder`, nats; -1 where nothing was held out."""
    _, training, validation = load_checkpoint(folder / CHECKPOINT)["history"][-1]
    return {
        "training_nats": round(training, 5),
        "validation_nats": -1.0 if np.isnan(validation) else round(validation, 5),
    }


def plot_loss(history: Sequence[tuple[int, float, float]], path: Path) -> None:
    """Training and validation loss over the steps, as a picture."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    steps, training, validation = np.array(history, np.float64).reshape(-1, 3).T
    figure, axes = plt.subplots(figsize=(7, 4))
    axes.plot(steps, training, label="training")
    axes.plot(steps, validation, label="validation")
    axes.set(xlabel="step", ylabel="cross-entropy of a slot, nats", yscale="log")
    axes.legend()
    figure.savefig(path, dpi=110, bbox_inches="tight")
    plt.close(figure)
