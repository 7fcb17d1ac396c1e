"""Fitting: seeded, resumable, with a progress bar and a plot of the loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from rxcli.errors import InputError
from rxcli.lab.training.network import Shape, StripNetwork
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, codebook

CHECKPOINT = "checkpoint.pt"
#: Words of the largest codebook, and what stands for a word that is not known.
MAX_WORDS, UNKNOWN = 128, -1
_CHECKPOINT_EVERY = 200
_WEIGHT_DECAY, _LARGEST_GRADIENT = 5e-2, 1.0
#: The weights that are kept are a mean over about so many steps.
_AVERAGED_STEPS = 200
#: Samples of a batch, columns of each, and how often strips are left out of a sample, down to how many.
_BATCH_SAMPLES, _BATCH_COLUMNS, _THINNED, _MIN_STRIPS = 2, 4, 0.5, 3


@dataclass(frozen=True)
class Sample:
    """Doubtful columns of a frame as the network sees them, and what was sent; B columns, N slots, M symbols."""

    #: (B, S, F, N) float16.
    strips: NDArray[np.float16]
    #: (B, G, N) float16.
    columns: NDArray[np.float16]
    #: (B, N) 1 where a slot of the payload can be seen.
    reception: NDArray[np.float16]
    #: (): place of the first slot in its packet, and slots of a packet.
    first_slot: NDArray[np.int64]
    packet_slots: NDArray[np.int64]
    #: (copies,) burst of each copy.
    burst: NDArray[np.int64]
    #: (B,) weight that was sent.
    w: NDArray[np.int64]
    #: (bursts, B, M, 128) log-likelihood of every word by the light model alone.
    scores: NDArray[np.float16]
    #: (bursts, B, M) index of the word that was sent, or `UNKNOWN`.
    words: NDArray[np.int64]


@dataclass(frozen=True)
class Recipe:
    """How a network is fitted."""

    shape: Shape = field(default_factory=Shape)
    steps: int = 1600
    learning_rate: float = 4e-3
    seed: int = 1


@lru_cache(maxsize=16)
def _codebook(w: int) -> Tensor:
    """(10, 128) the words of weight `w`, zeros where there are fewer."""
    words = np.zeros((MAX_WORDS, SLOTS_PER_SYMBOL), np.float32)
    words[: len(codebook(w))] = codebook(w)
    return torch.from_numpy(words.T.copy())


def loss_of(network: StripNetwork, sample: Sample, columns: NDArray[np.int64]) -> Tensor:
    """Mean cross-entropy of the words of some columns, nats, when corrections are added to what the light model says.

    The copies of a burst are added before its words are compared, as the receiver does.
    """
    strips, features, reception = (
        torch.from_numpy(part[columns].astype(np.float32)) for part in (sample.strips, sample.columns, sample.reception)
    )
    bursts = _by_burst(network(strips, features) * reception, sample)
    payload = bursts[..., PREAMBLE_SLOTS:].reshape(*bursts.shape[:2], -1, SLOTS_PER_SYMBOL)
    books = torch.stack([_codebook(int(w)) for w in sample.w[columns]])
    scores = torch.from_numpy(sample.scores[:, columns].astype(np.float32)) + payload @ books
    words = torch.from_numpy(sample.words[:, columns])
    each = torch.nn.functional.cross_entropy(
        scores.reshape(-1, MAX_WORDS), words.reshape(-1), ignore_index=UNKNOWN, reduction="sum"
    )
    return each / (words != UNKNOWN).sum().clamp(min=1)


def _by_burst(corrections: Tensor, sample: Sample) -> Tensor:
    """(bursts, B, packet) corrections (B, N) added over the copies of each burst."""
    first, length, n_copies = int(sample.first_slot), int(sample.packet_slots), sample.burst.size
    inside = corrections[:, : n_copies * length - first]
    padded = torch.nn.functional.pad(inside, (first, n_copies * length - first - inside.shape[1]))
    copies = padded.reshape(len(corrections), n_copies, length)
    n_bursts = int(sample.burst.max()) + 1
    return torch.stack([copies[:, torch.from_numpy(sample.burst == burst)].sum(dim=1) for burst in range(n_bursts)])


def _drawn_loss(network: StripNetwork, samples: Sequence[Sample], rng: np.random.Generator) -> Tensor:
    """Mean loss of a random batch."""
    losses = []
    for number in rng.integers(len(samples), size=_BATCH_SAMPLES):
        sample = samples[int(number)]
        columns = rng.permutation(sample.w.size)[:_BATCH_COLUMNS]
        losses.append(loss_of(network, _thinned(sample, rng), columns))
    return torch.stack(losses).mean()


def _thinned(sample: Sample, rng: np.random.Generator) -> Sample:
    """Now and then a sample without some of its strips: cameras differ in how many there are."""
    n_strips = sample.strips.shape[1]
    if n_strips <= _MIN_STRIPS or rng.random() >= _THINNED:
        return sample
    left = np.sort(rng.permutation(n_strips)[: int(rng.integers(_MIN_STRIPS, n_strips))])
    return replace(sample, strips=sample.strips[:, left])


def fit(
    samples: Sequence[Sample],
    validation: Sequence[Sample],
    recipe: Recipe,
    folder: Path,
    *,
    resume: bool = False,
    progress: bool = True,
) -> StripNetwork:
    """Fit a network.

    Args:
        samples: what to learn from.
        validation: samples that are not learned from.
        recipe: sizes and steps.
        folder: gets the checkpoint and the plot of the loss.
        resume: go on from the checkpoint in `folder`.
        progress: show a bar on stderr.

    Returns:
        The network, its weights averaged over the last steps.

    Raises:
        InputError: nothing to learn from; or the checkpoint is missing or of another recipe.
    """
    if not samples:
        raise InputError("no frame gave a doubtful column to learn from", "simulate more with --frames")
    torch.manual_seed(recipe.seed)
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    network = StripNetwork(recipe.shape)
    averaged = torch.optim.swa_utils.AveragedModel(network, avg_fn=_moving_average)
    optimiser = torch.optim.AdamW(network.parameters(), recipe.learning_rate, weight_decay=_WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, recipe.learning_rate, total_steps=recipe.steps + 1, pct_start=0.1
    )
    history: list[tuple[int, float, float]] = []
    parts = {"network": network, "averaged": averaged, "optimiser": optimiser, "schedule": schedule}
    first = _restore(folder / CHECKPOINT, recipe, parts, history) if resume else 0
    running = float("nan")
    for step in tqdm(range(first, recipe.steps), initial=first, total=recipe.steps, disable=not progress, unit="step"):
        # A generator of its own for every step: a resumed run draws the same batches.
        loss = _drawn_loss(network, samples, np.random.default_rng([recipe.seed, step]))
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        torch.nn.utils.clip_grad_norm_(network.parameters(), _LARGEST_GRADIENT)
        optimiser.step()
        schedule.step()
        averaged.update_parameters(network)
        running = loss.item() if np.isnan(running) else 0.98 * running + 0.02 * loss.item()
        if (step + 1) % _CHECKPOINT_EVERY == 0 or step + 1 == recipe.steps:
            history.append((step + 1, running, mean_loss(averaged.module, validation)))
            _save(folder / CHECKPOINT, recipe, step + 1, parts, history)
    plot_loss(history, folder / "loss.png")
    mean: StripNetwork = averaged.module
    mean.eval()
    return mean


def _moving_average(averaged: Tensor, current: Tensor, n_averaged: Tensor) -> Tensor:
    """Mean over about the last `_AVERAGED_STEPS` steps; over fewer at the start, which is soon forgotten."""
    share = max(1 / _AVERAGED_STEPS, float(10 / (n_averaged + 20)))
    return averaged + share * (current - averaged)


def mean_loss(network: StripNetwork, samples: Sequence[Sample]) -> float:
    """Mean over samples of `loss_of` all their columns; nan of none."""
    with torch.no_grad():
        losses = [loss_of(network, sample, np.arange(sample.w.size)).item() for sample in samples]
    return float(np.mean(losses)) if losses else float("nan")


def _save(path: Path, recipe: Recipe, step: int, parts: dict[str, Any], history: Sequence[Any]) -> None:
    states = {name: part.state_dict() for name, part in parts.items()}
    part = path.with_suffix(".part")
    torch.save({"recipe": asdict(recipe), "step": step, "history": list(history), **states}, part)
    part.replace(path)


def _restore(path: Path, recipe: Recipe, parts: dict[str, Any], history: list[tuple[int, float, float]]) -> int:
    state = load_checkpoint(path)
    if state["recipe"] != asdict(recipe):
        raise InputError(f"{path}: the checkpoint was made by another recipe", "give the same options, or start anew")
    for name, part in parts.items():
        part.load_state_dict(state[name])
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
    """Cross-entropy of a word at the end of the run in `folder`, nats; -1 where nothing was held out."""
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
    axes.set(xlabel="step", ylabel="cross-entropy of a word, nats", yscale="log")
    axes.legend()
    figure.savefig(path, dpi=110, bbox_inches="tight")
    plt.close(figure)
