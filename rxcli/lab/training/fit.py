"""The network, and its fit: strips, by the same convolutions along time each; pooled; then columns, likewise."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from tqdm import tqdm

from rxcli.errors import InputError
from rxcli.lab.benchmark.tables import draw_figure
from rxcli.lab.training.dataset import MAX_WORDS, UNKNOWN, Sample
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL, codebook
from rxcli.receiver.channel.denoise import N_COLUMN_FEATURES, N_STRIP_FEATURES

#: Steps from one checkpoint, and point of the plot of the loss, to the next.
_CHECKPOINT_EVERY = 500
_WEIGHT_DECAY, _LARGEST_GRADIENT = 5e-2, 1.0
#: Steps over which the stored weights are averaged.
_AVERAGED_STEPS = 200
#: Samples of a batch, columns of each, and how often strips are left out of a sample, down to how many.
_BATCH_SAMPLES, _BATCH_COLUMNS, _THINNED, _MIN_STRIPS = 4, 2, 0.5, 3


@dataclass(frozen=True)
class Shape:
    """Size of a network; channels and reach."""

    #: Channels of a strip and of a column.
    strip_width: int = 32
    column_width: int = 48
    #: Dilations of the strip's and of the column's convolutions, in slots.
    strip_dilations: tuple[int, ...] = (1, 2, 4)
    column_dilations: tuple[int, ...] = (1, 2, 4, 8)


class _Residual(nn.Module):  # type: ignore[misc]
    def __init__(self, width: int, dilation: int) -> None:
        super().__init__()
        self.conv = nn.Conv1d(width, width, 3, padding=dilation, dilation=dilation)

    def forward(self, x: Tensor) -> Tensor:
        return x + torch.relu(self.conv(x))


class StripNetwork(nn.Module):  # type: ignore[misc]
    """Corrections of slots from the features of `channel.denoise.network_inputs`; any number of strips and slots."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.shape = shape
        wide, tall = shape.strip_width, shape.column_width
        self.strip_in = nn.Conv1d(N_STRIP_FEATURES, wide, 3, padding=1)
        self.strip = nn.Sequential(*(_Residual(wide, d) for d in shape.strip_dilations))
        self.gate = nn.Conv1d(wide, wide, 1)
        self.column_in = nn.Conv1d(2 * wide + N_COLUMN_FEATURES, tall, 3, padding=1)
        self.column = nn.Sequential(*(_Residual(tall, d) for d in shape.column_dilations))
        self.out = nn.Conv1d(tall, 1, 1)
        # Before it has learned anything the network corrects nothing.
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, strips: Tensor, columns: Tensor) -> Tensor:
        """(B, S, F, N) and (B, G, N) to (B, N) corrections."""
        batch, n_strips, _, n_slots = strips.shape
        x = torch.relu(self.strip_in(strips.reshape(batch * n_strips, N_STRIP_FEATURES, n_slots)))
        x = self.strip(x)
        gate = torch.sigmoid(self.gate(x)).reshape(batch, n_strips, -1, n_slots)
        x = x.reshape(batch, n_strips, -1, n_slots)
        # Strips add up like independent observations; the mean over open gates is their consensus.
        total = (gate * x).sum(dim=1)
        mean = total / (gate.sum(dim=1) + 0.1)
        y = torch.relu(self.column_in(torch.cat([total * 0.2, mean, columns], dim=1)))
        return self.out(self.column(y)).squeeze(1)


def n_parameters(network: nn.Module) -> int:
    """Weights of a network."""
    return sum(p.numel() for p in network.parameters())


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
    """Mean cross-entropy (natural logarithm) of the words of some columns after the corrections.

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
    start, length, n_copies = int(sample.first_slot), int(sample.packet_slots), sample.burst.size
    inside = corrections[:, : n_copies * length - start]
    padded = torch.nn.functional.pad(inside, (start, n_copies * length - start - inside.shape[1]))
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


#: Step, and cross-entropy of a word in training and on held-out samples (nan of none), natural logarithm.
History = list[tuple[int, float, float]]


@dataclass(frozen=True)
class Fitted:
    """A network, its weights averaged over the last steps, and how its loss went."""

    network: StripNetwork
    history: History


def fit(
    samples: Sequence[Sample], validation: Sequence[Sample], recipe: Recipe, folder: Path, *, progress: bool = True
) -> Fitted:
    """Fit a network; equal recipes and samples give equal weights, whether the fit was interrupted or not.

    Args:
        samples: training samples.
        validation: samples for the validation loss alone.
        recipe: sizes and steps.
        folder: gets the plot of the loss, and the checkpoint from which an interrupted fit is resumed.
        progress: show a bar on stderr.

    Raises:
        InputError: nothing to learn from.
    """
    if not samples:
        raise InputError("no frame gave a doubtful column to learn from", "simulate more with --frames")
    torch.manual_seed(recipe.seed)
    torch.set_num_threads(1)
    network = StripNetwork(recipe.shape)
    averaged = torch.optim.swa_utils.AveragedModel(network, avg_fn=_moving_average)
    optimiser = torch.optim.AdamW(network.parameters(), recipe.learning_rate, weight_decay=_WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, recipe.learning_rate, total_steps=recipe.steps + 1, pct_start=0.1
    )
    parts, checkpoint = (network, averaged, optimiser, schedule), folder / "checkpoint.pt"
    key = f"{recipe} {len(samples)} samples"
    history = _restored(parts, checkpoint, key)
    start, running = history[-1][:2] if history else (0, float("nan"))
    for step in tqdm(range(start + 1, recipe.steps + 1), disable=not progress, unit="step"):
        loss = _drawn_loss(network, samples, np.random.default_rng([recipe.seed, step]))
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        torch.nn.utils.clip_grad_norm_(network.parameters(), _LARGEST_GRADIENT)
        optimiser.step()
        schedule.step()
        averaged.update_parameters(network)
        running = loss.item() if np.isnan(running) else 0.98 * running + 0.02 * loss.item()
        if step % _CHECKPOINT_EVERY == 0 or step == recipe.steps:
            history.append((step, running, mean_loss(averaged.module, validation)))
            _store(parts, checkpoint, key, history)
    _plot_loss(history, folder / "loss.png")
    return Fitted(averaged.module.eval(), history)


def _store(parts: Sequence[Any], path: Path, key: str, history: History) -> None:
    """Write the state of network, optimiser and all else that has one, and the losses so far."""
    path.parent.mkdir(parents=True, exist_ok=True)
    state, hidden = [each.state_dict() for each in parts], path.with_suffix(".part")
    torch.save({"fit": key, "history": history, "parts": state}, hidden)
    hidden.replace(path)


def _restored(parts: Sequence[Any], path: Path, key: str) -> History:
    """Restore the parts and return the losses so far; none if `path` is no checkpoint of this recipe and data."""
    stored = torch.load(path, weights_only=True) if path.exists() else {}
    if stored.get("fit") != key:
        return []
    for part, state in zip(parts, stored["parts"], strict=True):
        part.load_state_dict(state)
    return list(stored["history"])


def _moving_average(averaged: Tensor, current: Tensor, n_averaged: Tensor) -> Tensor:
    """Mean over about the last `_AVERAGED_STEPS` steps; over fewer at the start, which is soon forgotten."""
    share = max(1 / _AVERAGED_STEPS, float(10 / (n_averaged + 20)))
    return averaged + share * (current - averaged)


def mean_loss(network: StripNetwork, samples: Sequence[Sample]) -> float:
    """Mean over samples of `loss_of` all their columns; nan of none."""
    with torch.no_grad():
        losses = [loss_of(network, sample, np.arange(sample.w.size)).item() for sample in samples]
    return float(np.mean(losses)) if losses else float("nan")


def _plot_loss(history: History, path: Path) -> None:
    """Training and validation loss over the steps, as a picture."""
    steps, *losses = np.array(history, np.float64).T

    def draw(axes: Any) -> None:
        for label, values in zip(("training", "validation"), losses, strict=True):
            axes.plot(steps, values, label=label)
        axes.set(xlabel="step", ylabel="cross-entropy of a word", yscale="log")

    draw_figure(draw, path)
