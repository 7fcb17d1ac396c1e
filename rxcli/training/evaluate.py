"""What the auto-encoder is worth: frames of every validation class, received without it, with it, and by the bound.

python -m rxcli.training.evaluate 36
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from rxcli.benchmark.trial import Trial, simulate_trial
from rxcli.protocol import indices_to_bits
from rxcli.training.scenes import SCENE_CLASSES, validation_scene
from rxcli.truth import EXPECTED_LENGTHS, Score

_SCREENS = ("paper-34k6", "paper-17k3")


@dataclass(frozen=True)
class Outcome:
    """One frame: wrong bits of expected packets, lost ones counted as half wrong."""

    kind: str
    screen: str
    never: int
    auto: int
    bound: int
    bits: int
    columns: int
    milliseconds: float


def evaluate(numbers: Iterable[int], seed: int = 3_000_000) -> list[Outcome]:
    """Receive the frames of these numbers; classes, screens, cameras and pictures take turns."""
    return [_evaluate_one(number, seed) for number in numbers]


def _evaluate_one(number: int, seed: int) -> Outcome:
    kind, turn = SCENE_CLASSES[number % len(SCENE_CLASSES)], number // len(SCENE_CLASSES)
    screen = _SCREENS[turn % 2]
    trial = simulate_trial(validation_scene(kind, screen, turn // 2), seed + number, oracle=True)
    never, auto = (trial.receive(trial.options(cae=mode)) for mode in ("never", "auto"))
    report = auto[0].denoiser or {}
    return Outcome(
        kind.name,
        screen,
        _wrong_bits(never[1]),
        _wrong_bits(auto[1]),
        _bound_bits(trial),
        never[1].bits,
        int(report.get("columns", 0)),
        auto[0].timing_ms.get("denoise", 0.0),
    )


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
    """Sums by class and screen as a Markdown table."""
    groups: dict[tuple[str, str], list[Outcome]] = defaultdict(list)
    for outcome in outcomes:
        groups[outcome.kind, outcome.screen].append(outcome)
    lines = [
        "| scenes | screen | frames | bits | never | auto | bound | columns asked | ms a frame |",
        "|" + "---|" * 9,
    ]
    for (kind, screen), group in sorted(groups.items()):
        sums = [sum(getattr(o, name) for o in group) for name in ("bits", "never", "auto", "bound", "columns")]
        cost = np.mean([o.milliseconds for o in group])
        lines.append(f"| {kind} | {screen} | {len(group)} | {' | '.join(map(str, sums))} | {cost:.0f} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(evaluate(tqdm(range(int(sys.argv[1]))))))
