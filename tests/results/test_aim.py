"""Aiming: who follows the hints of a live camera has the screen after three of them."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from rxcli.lab.simulate.capture import prepare
from rxcli.lab.simulate.scenes import Scene, preset
from rxcli.options import receiver_options
from rxcli.receiver.receive import receive_frame
from rxcli.results.aim import Aim, brightness_of
from rxcli.results.reasons import explained
from rxcli.types import Frame

MAX_HINTS, MAX_STEPS = 3, 12
GOOD = replace(preset("video-1080p", "paper-17k3"), n_frames=1)
#: Of half the size at half the slot rate, which is received in a quarter of the time.
SMALL = replace(preset("video-1080p", "paper-8k65").scaled(0.5, keep_readout=True), n_frames=1)


def _posed(scene: Scene, **pose: float) -> Scene:
    return replace(scene, pose=replace(scene.pose, **pose))


#: A word of a hint -> what a person does who reads it, a little at a time.
FOLLOWED: dict[str, Callable[[Scene], Scene]] = {
    "longer": lambda scene: scene.exposed(scene.exposure_s, 4.0),
    "shorter": lambda scene: replace(scene, exposure_s=scene.exposure_s * 0.5),
    "long side": lambda scene: _posed(scene, roll_deg=0.2 * scene.pose.roll_deg),
    "closer": lambda scene: _posed(scene, fill=min(1.3 * scene.pose.fill, 0.92)),
    "level": lambda scene: _posed(scene, roll_deg=0.4 * scene.pose.roll_deg),
}
STARTS = {
    "far away": _posed(SMALL, fill=0.3),
    "in portrait": _posed(GOOD, fill=0.5, roll_deg=88),
    "a long exposure": replace(SMALL, exposure_s=SMALL.exposure_s * 16),
    "dark, far and in portrait": _posed(SMALL, fill=0.35, roll_deg=92).exposed(SMALL.exposure_s, 1 / 100),
}


@pytest.mark.slow
@pytest.mark.parametrize("start", STARTS)
def test_three_hints_lead_to_a_lock(start: str) -> None:
    """Counted are hints that differ from the one before: a person goes on with one until it changes."""
    scene, aim, hints = STARTS[start], Aim(), list[str]()
    options = receiver_options()
    for step in range(MAX_STEPS):
        frame = Frame(prepare(scene, step).frame().pixels, "camera", index=0)
        result = explained(receive_frame(frame, options))
        for moment in (0.0, 0.5):  # a person who reads holds still
            state = aim.update(result, step + moment, frame.height, brightness_of(frame))
        if state.locked:
            break
        if state.advice not in hints[-1:]:
            hints.append(state.advice)
        steps = [action for word, action in FOLLOWED.items() if word in state.advice]
        assert steps, f"nobody knows what to do: {state.reason} {state.advice}"
        for action in steps:
            scene = action(scene)
    print(f"{start}: {step} steps, {len(hints)} hints: {' / '.join(hints)}")
    assert state.locked
    assert 1 <= len(hints) <= MAX_HINTS
