"""What a picture leaves open of the length of packets, and of which copies are one packet, lowers the confidence."""

from dataclasses import replace

import numpy as np
import pytest
from row_profiles import Shot, random_link, row_profiles, sigma_of

from rxcli.options import ReceiverOptions
from rxcli.receiver.camera.proposals import CameraHypothesis
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.frame.camera import FrameCamera
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.search import framing
from rxcli.receiver.search.framing import Framing, framing_of
from rxcli.receiver.still import detected_on, initial_pass
from rxcli.receiver.sync import clock as sync
from rxcli.types import Frame, Metadata

SCREENS = tuple(screen for screen in ReceiverOptions().screens if screen.columns == 20)
ROWS_PER_SLOT = 4.0
#: Share of packets of 70 slots that start at one place, beside those of 130 and 260 slots.
PRIOR = 1 / (1 + 70 / 130 + 70 / 260)


def framed(
    sent: str,
    taken_for: str,
    start_slot: float,
    n_slots: int,
    names: str = "",
    context: FrameContext | None = None,
    as_one_burst: bool = False,
    evidence: float = 0.0,
) -> Framing:
    """Receive a window of slots as of a screen; `names` begins the names of the screens that are possible.

    All copies may be taken for one burst, and joint detection may have `evidence` of that.
    """
    rng = np.random.default_rng(1)
    screens = {screen.name: screen for screen in SCREENS}
    own = screens[taken_for]
    shot = Shot(ROWS_PER_SLOT, start_slot=start_slot, n_rows=round(n_slots * ROWS_PER_SLOT))
    profiles = row_profiles(random_link(rng, [5] * 20, screens[sent].payload_symbols), shot, rng)
    clock = sync.find_clock(profiles, ROWS_PER_SLOT, 1.0, own.packet_slots, sigma_of(profiles))
    assert clock is not None
    possible = tuple(screen for screen in SCREENS if screen.name.startswith(tuple(names.split()) or ""))
    variants = tuple(screen for screen in possible if screen.packet_slots == own.packet_slots)
    acquisition = Acquisition(own, profiles, clock, variants)
    reception = initial_pass(acquisition)
    if as_one_burst:
        as_received, one = reception.clock.burst, 0 * reception.clock.burst
        reception = detected_on(reception, replace(reception.clock, burst=one))
        by_evidence = [(one, evidence), (as_received, 0.0)] if evidence else []
        reception = replace(reception, bursts_by_evidence=by_evidence)
    return framing_of(acquisition, reception, possible, context)


def estimate(rate_hz: float) -> tuple[FrameContext, FrameCamera]:
    """A photograph by an estimated camera, whose file states an exposure of a slot of this rate."""
    hypothesis = CameraHypothesis(ROWS_PER_SLOT, 70, False, np.zeros(4), 1.0, 0.0, 0.0, np.zeros(4), 0.05)
    camera = FrameCamera(None, 1 / (ROWS_PER_SLOT * 8650), 1 / 8650, None, "srgb", hypothesis=hypothesis)
    frame = Frame(np.zeros((4, 4), np.uint8), "photo", metadata=Metadata(exposure_s=1 / rate_hz))
    return FrameContext(FrameCache(frame), np.zeros((4, 2)), camera, SCREENS), camera


@pytest.mark.parametrize("sent", ["paper-8k65", "paper-17k3", "paper-34k6"])
def test_one_header_in_view_leaves_the_length_open(sent: str) -> None:
    """Whatever was sent: the slots of the window are those of either screen."""
    found = framed(sent, "paper-8k65", 520 - 30.0, 66)
    assert found.prior == pytest.approx(PRIOR)
    assert found.length == pytest.approx(PRIOR, abs=0.1)
    assert found.gain == pytest.approx(0.0, abs=0.5)


@pytest.mark.parametrize(("rate_hz", "low", "high"), [(8650.0, 0.9, 1.0), (17300.0, 0.0, 0.2), (34600.0, 0.0, 0.3)])
def test_the_exposure_that_a_file_states_speaks_for_a_slot_rate(
    rate_hz: float, low: float, high: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The light shows an exposure of a slot, the file that it lasts one of a screen's slot rate."""
    context, camera = estimate(rate_hz)
    monkeypatch.setattr(framing, "settle", lambda *_: (camera, 0.0))
    assert low <= framed("paper-8k65", "paper-8k65", 520 - 30.0, 66, context=context).length <= high


def test_no_exposure_is_fitted_where_slots_settle_the_length(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(framing, "settle", lambda *_: pytest.fail("an exposure was fitted"))
    assert framed("paper-17k3", "paper-8k65", 520 - 2.0, 100, context=estimate(8650.0)[0]).length < 1e-4


@pytest.mark.parametrize("n_slots", [78, 84, 100])
def test_a_header_that_should_show_and_does_not_excludes_the_length(n_slots: int) -> None:
    assert framed("paper-17k3", "paper-8k65", 520 - 2.0, n_slots).length < 0.01


def test_two_headers_in_view_settle_the_length() -> None:
    found = framed("paper-8k65", "paper-8k65", 210 - 5.0, 150)
    assert found.length == 1.0
    assert found.bursts == pytest.approx(1.0)


@pytest.mark.parametrize(("name", "certainty"), [("paper-8k65", 2 / 3), ("data-8k65", 1.0)])
def test_copies_that_show_different_slots_may_be_two_packets(name: str, certainty: float) -> None:
    """One boundary in three of a screen of three copies is that of two bursts; one of single copies knows no others."""
    found = framed("paper-8k65", name, 210 - 35.0, 66, name)
    assert found.length == pytest.approx(1.0)
    assert found.bursts == pytest.approx(certainty, abs=0.1)


def test_less_than_a_symbol_of_another_packet_does_no_harm() -> None:
    """Of the next packet a header and five slots are in view, and are taken for those of a copy."""
    found = framed("paper-8k65", "paper-8k65", 210 - 72.0, 97, "paper-8k65", as_one_burst=True)
    assert found.bursts == pytest.approx(1.0)
    assert framed("paper-8k65", "paper-8k65", 210 - 72.0, 112, "paper-8k65", as_one_burst=True).bursts < 0.01


@pytest.mark.parametrize(("evidence", "certainty"), [(-200.0, 0.0), (0.01, 0.5), (200.0, 1.0)])
def test_joint_detection_says_which_copies_are_one_packet(evidence: float, certainty: float) -> None:
    found = framed("paper-8k65", "paper-8k65", 210 - 72.0, 112, "paper-8k65", as_one_burst=True, evidence=evidence)
    assert found.bursts == pytest.approx(certainty, abs=0.01)


@pytest.mark.parametrize("split", [31.0, 35.0])
def test_copies_that_share_no_slot_are_one_packet_as_often_as_screens_send_them_so(split: float) -> None:
    """Of two screens one sends three copies and one a single one; what different slots show says nothing of that."""
    found = framed("paper-8k65", "paper-8k65", 210 - split, 66, "paper-8k65 data-8k65", as_one_burst=True)
    assert found.bursts == pytest.approx(1 / 3, abs=0.03)
