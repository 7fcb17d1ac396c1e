"""Slots of long exposures through a rough picture that is known, and the place of their clock."""

from dataclasses import replace

import numpy as np
import pytest
from made_stages import clock_of, profiles_of
from msgspec import structs

from rxcli.profiles import ScreenProfile, load_profile
from rxcli.protocol import WEIGHTS, encode_packet
from rxcli.receiver.channel import ObservationModel
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.light import Crosstalk, Exposure, NoiseModel, SlotLight
from rxcli.receiver.still import decode, detect_jointly, initial_pass, lateness
from rxcli.types import Float32Array

COLUMNS, STRIPS, ROWS_PER_SLOT, W = 4, 4, 8.0, 4
UNKNOWN = np.full((COLUMNS, len(WEIGHTS)), -np.log(len(WEIGHTS)))


def rough_frame(
    exposure_slots: float,
    texture: float,
    n_columns: int = COLUMNS,
    row_noise: float = 0.0,
    copies: tuple[int, ...] = (0,),
    shown: slice = slice(0, None),
) -> tuple[Acquisition, ObservationModel, Float32Array]:
    """Packets in every column, whose picture changes from row to row; and the slots that were sent.

    Of the bursts in `copies`, one after the other, the slots in `shown` are in view.
    """
    rng = np.random.default_rng(4)
    screen = load_profile("paper-8k65", ScreenProfile)
    n = screen.packet_slots
    bits = rng.integers(0, 2, (max(copies) + 1, n_columns, screen.payload_symbols * 7)).astype(np.uint8)
    packets = np.stack([[encode_packet(each, W) for each in burst] for burst in bits]).astype(np.float32)
    sent = np.concatenate([packets[burst] for burst in copies], axis=1)[:, shown]
    known = {"rows_per_slot": ROWS_PER_SLOT, "exposure_slots": exposure_slots, "packet_slots": n}
    known |= {"n_slots": sent.shape[1], "first_slot": shown.start, "burst": np.array(copies)}
    rows = np.arange(int(sent.shape[1] * ROWS_PER_SLOT))
    exposed = SlotLight(np.pad(sent, ((0, 0), (5, 5)))).mean_over(
        ((rows + 0.5) / ROWS_PER_SLOT + 5)[None], exposure_slots
    )
    picture = np.exp(rng.normal(0, texture, (n_columns, 1, rows.size // 4))).repeat(4, axis=2)
    picture = (picture * rng.uniform(0.8, 1.2, (n_columns, STRIPS, 1))).astype(np.float32)
    light = picture * exposed[:, None] + rng.normal(0, 0.004, picture.shape)
    light = light + rng.normal(0, row_noise, rows.size)
    profiles, clock = profiles_of(light, 1.6e-5, level=picture / 2), clock_of(n_columns, row0=-0.5, **known)
    model = ObservationModel(0.0, NoiseModel(4e-6, 0.0), Crosstalk.of(STRIPS, 0.02), Exposure.of(exposure_slots, 4))
    return Acquisition(screen, profiles, clock, (screen,)), model, sent


@pytest.mark.parametrize("exposure_slots", [3.0, 6.0])
def test_a_known_picture_shows_the_slots_behind_it(exposure_slots: float) -> None:
    acquisition, model, sent = rough_frame(exposure_slots, texture=0.4)
    unknown = replace(acquisition, profiles=replace(acquisition.profiles, level=None))
    wrong = [
        np.mean((detect_jointly(each, model, UNKNOWN, None)[0].lit[0] > 0.5) != (sent > 0.5))
        for each in (acquisition, unknown)
    ]
    assert wrong[0] < 0.02
    assert wrong[1] > 0.1


def test_a_header_alone_of_another_burst_leaves_the_evidence() -> None:
    """Symbols that are not in view are no sign of noise."""
    acquisition, _, _ = rough_frame(4.0, texture=0.02)
    profiles, n_rows = replace(acquisition.profiles, level=None), round(24 * ROWS_PER_SLOT)
    longer = {
        name: np.pad(getattr(profiles, name), ((0, 0), (0, 0), (0, n_rows)), "wrap") for name in ("light", "inside")
    }
    longer["rows"] = np.arange(profiles.rows.size + n_rows)
    clock = replace(acquisition.clock, n_slots=acquisition.clock.n_slots + 24, burst=np.arange(2))
    once = (structs.replace(acquisition.screen, repeats=1),)
    one, two = (
        initial_pass(each)
        for each in (
            replace(acquisition, profiles=profiles),
            replace(acquisition, profiles=replace(profiles, **longer), clock=clock, variants=once),
        )
    )
    assert two.clock.burst.tolist() == [0, 1]
    assert (two.posteriors.log_evidence > 0.9 * one.posteriors.log_evidence).all()


def test_noise_of_rows_is_taken_off_by_the_slots_of_all_columns() -> None:
    """Twelve columns share each row's noise, half their light: the slots show it, and better slots show it better."""
    acquisition, _, sent = rough_frame(1.0, 0.02, n_columns=12, row_noise=0.5)
    first = initial_pass(replace(acquisition, profiles=replace(acquisition.profiles, level=None)))
    wrong = [np.mean((first.posteriors.lit[0] > 0.5) != (sent > 0.5))]
    for has_row_noise in (False, True):
        profiles = replace(acquisition.profiles, level=None, has_row_noise=has_row_noise)
        found = decode(replace(acquisition, profiles=profiles), frozenset(), first)
        wrong.append(np.mean((found.posteriors.lit[0] > 0.5) != (sent > 0.5)))
    assert wrong[2] < 0.5 * wrong[0] < wrong[1]


@pytest.mark.parametrize("late", [-0.2, 0.0, 0.15])
def test_the_clock_is_placed_by_evidence(late: float) -> None:
    acquisition, model, _ = rough_frame(4.0, texture=0.4)
    clock = acquisition.clock
    moved = replace(acquisition, clock=replace(clock, row0=clock.row0 + late * ROWS_PER_SLOT))
    assert lateness(moved, model, UNKNOWN, 0.25) == pytest.approx(late, abs=0.1)


@pytest.mark.parametrize("copies", [(0, 0), (0, 1)])
def test_copies_with_little_in_common_are_assigned_by_their_joint_evidence(copies: tuple[int, int]) -> None:
    """The first copy shows no weight: it has that of the second, whichever burst it is of."""
    acquisition, _, sent = rough_frame(4.0, texture=0.1, copies=copies, shown=slice(20, 105))
    found = initial_pass(replace(acquisition, profiles=replace(acquisition.profiles, level=None)))
    assert found.clock.burst.tolist() == list(copies)
    assert (found.posteriors.w == W).all()
    assert np.mean((found.clock.on_grid(found.posteriors.lit) > 0.5) != (sent > 0.5)) < 0.06


@pytest.mark.parametrize(
    ("n_columns", "lit", "expected"),
    [
        (8, slice(4, 8), range(3, 7)),
        (8, slice(0, 3), range(1, 5)),
        (100, slice(50, 60), range(50, 60)),  # ten rank a hypothesis as well as fifty
    ],
)
def test_the_brighter_half_of_the_columns_leaves_out_the_outermost(n_columns: int, lit: slice, expected: range) -> None:
    light = np.full((n_columns, STRIPS, 30), 0.1)
    light[lit] = 1.0
    screen = structs.replace(load_profile("paper-8k65", ScreenProfile), columns=n_columns)
    acquisition = Acquisition(screen, profiles_of(light), clock_of(n_columns), (screen,))
    assert acquisition.bright_columns.tolist() == list(expected)
