"""Less than a packet in view: slots without a header."""

import numpy as np
import pytest
from row_profiles import Shot, random_link, row_profiles

from rxcli.profiles import ScreenProfile, load_profile
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.still import initial_pass
from rxcli.types import Clock

SCREEN = load_profile("data-17k3", ScreenProfile)


@pytest.mark.parametrize("ambient", [0.0, 0.1, 0.3])
def test_room_light_is_known_without_a_header(ambient: float) -> None:
    """Slots of a payload alone: the light of dark ones is that of the room, otherwise weights come out too large."""
    rng, shot = np.random.default_rng(2), Shot(8.0, 0.8, 25.0, 600, ambient=ambient, texture=0.1, crosstalk=0.1)
    link = random_link(rng, [5] * 20, SCREEN.payload_symbols)
    clock = Clock(8.0, 0.8, SCREEN.packet_slots, 0.0, 75, 25, np.zeros(1, np.int64), np.zeros(20), 0.0)
    found = initial_pass(Acquisition(SCREEN, row_profiles(link, shot, rng), clock, (SCREEN,)))
    assert found.model.black_level == pytest.approx(ambient, abs=0.02)
    assert (found.posteriors.w == 5).all()
    lit = found.clock.on_grid(found.posteriors.lit) > 0.5
    assert (lit[:, 5:75] == link.slots()[:, 30:100]).mean() > 0.99
