"""What the auto-encoder is worth: frames of every validation class, received without it, with it, and by the bound.

python -m rxcli.lab.training.evaluate 96 [SEED]
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from tqdm import tqdm

from rxcli.lab.benchmark.trial import Trial, acquired, simulate_trial
from rxcli.lab.training.scenes import SCENE_CLASSES, validation_scene
from rxcli.protocol import indices_to_bits
from rxcli.receiver.still import apply_autoencoder, decode
from rxcli.results.truth import EXPECTED_LENGTHS, Score

_SCREENS = ("paper-34k6", "paper-17k3")
_SEED, _BOOTSTRAPS = 3_000_000, 2000


@dataclass(frozen=True)
class Outcome:
    """One frame: wrong bits of expected packets, lost ones counted as half wrong."""

    kind: str
    screen: str
    hard: bool
    never: int
    auto: int
    bound: int
    bits: int
    #: Error-free packets without and with it, of all.
    packets_never: int
    packets_auto: int
    packets: int
    #: Columns asked, and CPU time of the whole second opinion.
    columns: int
    milliseconds: float


def evaluate(numbers: Iterable[int], seed: int = _SEED) -> list[Outcome]:
    """Receive the frames of these numbers; classes, screens, cameras and pictures take turns."""
    return [_evaluate_one(number, seed) for number in numbers]


def _evaluate_one(number: int, seed: int) -> Outcome:
    kind, turn = SCENE_CLASSES[number % len(SCENE_CLASSES)], number // len(SCENE_CLASSES)
    screen = _SCREENS[turn % 2]
    trial = simulate_trial(validation_scene(kind, screen, turn // 2), seed + number, oracle=True)
    never, auto = (trial.receive(trial.options(cae=mode)) for mode in ("never", "auto"))
    return Outcome(
        kind=kind.name,
        screen=screen,
        hard=kind.hard,
        never=_wrong_bits(never[1]),
        auto=_wrong_bits(auto[1]),
        bound=_bound_bits(trial),
        bits=never[1].bits,
        packets_never=never[1].error_free,
        packets_auto=auto[1].error_free,
        packets=never[1].expected,
        columns=int((auto[0].denoiser or {}).get("columns", 0)),
        milliseconds=_cpu_ms(trial),
    )


def _cpu_ms(trial: Trial) -> float:
    """CPU time of the second opinion, the smaller of two runs; 0 where no clock is found."""
    options, acquisition = trial.options(), acquired(trial, quick=False)
    if acquisition is None:
        return 0.0
    reception, spent = decode(acquisition, options.skip), []
    for _ in range(2):
        start = time.process_time()
        apply_autoencoder(acquisition, replace(reception), options)
        spent.append(1e3 * (time.process_time() - start))
    return min(spent)


def _wrong_bits(score: Score) -> int:
    return score.bit_errors + score.lost_bits // 2


def _bound_bits(trial: Trial) -> int:
    """Wrong bits of the genie-aided bound in the packets that are expected."""
    oracle, truth = trial.capture.oracle, trial.truth
    assert oracle is not None
    least = EXPECTED_LENGTHS * trial.capture.scene.screen.packet_slots
    wrong = 0
    for burst in (b.burst for b in truth.frames[0].bursts if b.visible_slots >= least):
        for column, w in enumerate(truth.w):
            decided, sent, _ = oracle.decide(column, burst)
            wrong += int((indices_to_bits(decided, w) != indices_to_bits(sent, w)).sum())
    return wrong


def table(outcomes: Iterable[Outcome]) -> str:
    """Sums by class and screen, and over the hard classes, as a Markdown table."""
    groups: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        groups[outcome.kind, outcome.screen].append(outcome)
        if outcome.hard:
            groups["all hard", outcome.screen].append(outcome)
    order = [kind.name for kind in SCENE_CLASSES] + ["all hard"]
    lines = [
        "| scenes | screen | frames | bits | `never` | `auto` | bound | gap closed, 95 % | saved, 95 % "
        "| error-free packets `never` / `auto` of all | columns asked | CPU ms a frame: mean, most |",
        "|" + "---|" * 12,
    ]
    for (kind, screen), group in sorted(groups.items(), key=lambda item: (item[0][1], order.index(item[0][0]))):
        lines.append(f"| {kind} | {screen} | {len(group)} | " + " | ".join(_cells(group)) + " |")
    return "\n".join(lines)


def _cells(group: Sequence[Outcome]) -> list[str]:
    sums = [str(_sum(group, name)) for name in ("bits", "never", "auto", "bound")]
    never, auto, bound = (np.array([getattr(o, name) for o in group]) for name in ("never", "auto", "bound"))
    saved, gap = never - auto, never - bound
    # Frames, not packets, are drawn anew: the packets of a frame share picture and noise.
    drawn = np.random.default_rng(0).integers(len(group), size=(_BOOTSTRAPS, len(group)))
    low, high = np.quantile(saved[drawn].sum(axis=1), (0.025, 0.975))
    shares = saved[drawn].sum(axis=1) / np.maximum(gap[drawn].sum(axis=1), 1)
    least, most = np.quantile(shares, (0.025, 0.975))
    share = saved.sum() / gap.sum() if gap.sum() > 0 else float("nan")
    spent = [o.milliseconds for o in group]
    packets = [_sum(group, name) for name in ("packets_never", "packets_auto", "packets")]
    return [
        *sums,
        f"{share:.0%} ({least:.0%} .. {most:.0%})",
        f"{low:.0f} .. {high:.0f}",
        "{} / {} of {}".format(*packets),
        str(_sum(group, "columns")),
        f"{np.mean(spent):.0f}, {np.max(spent):.0f}",
    ]


def _sum(group: Sequence[Outcome], name: str) -> int:
    return int(sum(getattr(o, name) for o in group))


if __name__ == "__main__":
    chosen = _SEED if len(sys.argv) < 3 else int(sys.argv[2])
    print(table(evaluate(tqdm(range(int(sys.argv[1]))), chosen)))
