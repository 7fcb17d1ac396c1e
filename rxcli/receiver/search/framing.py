"""How sure the length of packets is, and which copies are one packet.

The start of a long packet looks like the whole of a shorter one while the next header is not in view, and the copies of
a burst look like those of two while they show different slots. Such framings of the same slots are rivals: each has the
evidence of the same light, and a header that should show and does not counts against it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rxcli.profiles import ScreenProfile
from rxcli.protocol import PREAMBLE_SLOTS, SLOTS_PER_SYMBOL
from rxcli.receiver.decode import detect
from rxcli.receiver.decode.settings import SETTINGS as DECODE
from rxcli.receiver.frame.acquisition import Acquisition
from rxcli.receiver.frame.context import FrameContext
from rxcli.receiver.frame.passes import Reception
from rxcli.receiver.search import evidence
from rxcli.receiver.search.cameras import settle
from rxcli.receiver.search.settings import SETTINGS
from rxcli.receiver.still import detected_on
from rxcli.receiver.sync import clock as sync
from rxcli.receiver.sync.settings import SETTINGS as sync_settings
from rxcli.types import Clock, FloatArray

#: Limit of log-odds, so that no single picture settles a question for ever.
_MAX_LOG_ODDS = 10.0


@dataclass(frozen=True, slots=True)
class Framing:
    """Probabilities of a reception's clock."""

    #: That packets have its length: before the picture, and with it; and (B,) that moreover the copies of each burst
    #: are one packet.
    prior: float
    length: float
    bursts: FloatArray

    @property
    def gain(self) -> float:
        """Log-odds of the length that the picture adds."""
        return log_odds(self.length) - log_odds(self.prior)


def log_odds(probability: float) -> float:
    """Log-odds of a probability, within limits."""
    least = 1 / (1 + np.exp(_MAX_LOG_ODDS))
    bounded = float(np.clip(probability, least, 1 - least))
    return float(np.log(bounded / (1 - bounded)))


def framing_of(
    acquisition: Acquisition,
    reception: Reception,
    screens: Sequence[ScreenProfile],
    context: FrameContext | None = None,
) -> Framing:
    """How sure the length of packets and the copies of bursts are.

    Args:
        acquisition: the screen that was chosen.
        reception: its reception.
        screens: all screens that the camera may have seen.
        context: the frame, whose stated exposure speaks for screens of one slot rate if the camera is an estimate.
    """
    own, llr = reception.clock, reception.llr
    by_copy = detect.header_llr(own.by_copy.by_burst(llr))
    headers = np.clip(by_copy, -DECODE.max_llr, DECODE.max_llr).sum(axis=1)
    header = int(headers.argmax()) * own.packet_slots - own.first_slot
    lengths = {own.packet_slots: acquisition.repeats}
    if np.count_nonzero(headers > DECODE.max_llr) < 2:
        for screen in screens:
            if screen.packet_slots != own.packet_slots:
                lengths[screen.packet_slots] = (*lengths.get(screen.packet_slots, ()), screen.repeats)
    framings = {
        length: sync.possible_bursts(_framed(own, header, length), llr, repeats) for length, repeats in lengths.items()
    }
    likeliest, *rivals = framings[own.packet_slots]
    # A packet starts anywhere in its length.
    prior = 1 / sum(own.packet_slots / length for length in {own.packet_slots, *(s.packet_slots for s in screens)})
    is_plain = all(likeliest[1] - rival[1] > sync_settings.settled_llr for rival in rivals)
    if len(lengths) == 1 and is_plain and np.array_equal(likeliest[0].burst, own.burst):
        return Framing(prior, 1.0, np.ones(int(own.burst.max()) + 1))
    # Only the similarity of copies shows which of them are one packet.
    log_weight = np.concatenate(
        [_log_weight(reception, each[0][0]) + np.array([similar for _, similar in each]) for each in framings.values()]
    )
    n_own = 1 + len(rivals)
    odds = float(np.logaddexp.reduce(log_weight[:n_own]) - np.logaddexp.reduce(log_weight[n_own:]))
    if abs(odds) < _MAX_LOG_ODDS - SETTINGS.min_exposure_llr:  # else no exposure outweighs what the slots show
        exposed = _exposure_log_likelihood(context, acquisition, reception, screens)
        log_weight += [exposed.get(length, 0.0) for length, each in framings.items() for _ in each]
    weight = np.exp(log_weight - log_weight.max())
    length = float(weight[:n_own].sum() / weight.sum())
    ways, of_ways = np.array([clock.burst for clock, _ in (likeliest, *rivals)]), weight[:n_own]
    if reception.bursts_by_evidence:
        ways = np.array([way for way, _ in reception.bursts_by_evidence])
        gains = SETTINGS.temper * np.array([gain for _, gain in reception.bursts_by_evidence])
        of_ways = np.exp(gains - gains.max())
    of_ways = length * of_ways / of_ways.sum()
    # Part of a symbol of another packet does no harm.
    counts = own.to_copies(np.ones(own.n_slots, bool))[:, PREAMBLE_SLOTS:].sum(axis=1) >= SLOTS_PER_SYMBOL
    bursts = np.zeros(int(own.burst.max()) + 1)
    for burst in range(bursts.size):
        copies = ways[:, counts & (own.burst == burst)]
        bursts[burst] = of_ways[(copies == copies[:, :1]).all(axis=1)].sum()
    return Framing(prior, length, bursts)


def _framed(own: Clock, header: int, length: int) -> Clock:
    """The clock with packets of another length; one starts at slot `header` of the grid."""
    first_slot = -header % length
    n_copies = -(-(first_slot + own.n_slots) // length)
    return replace(own, packet_slots=length, first_slot=first_slot, burst=np.zeros(n_copies, np.int64))


def _exposure_log_likelihood(
    context: FrameContext | None, acquisition: Acquisition, reception: Reception, screens: Sequence[ScreenProfile]
) -> dict[int, float]:
    """Log-likelihood, by the length of packets, of the exposure in slots that the light shows, given the stated one."""
    stated_s = None if context is None else context.frame.metadata.exposure_s
    if context is None or not stated_s or context.camera.hypothesis is None or reception.is_long:
        return {}
    unstated = replace(context.camera.hypothesis, stated_exposure_slots=0.0)
    context = replace(context, camera=replace(context.camera, hypothesis=unstated))
    for _ in range(SETTINGS.exposure_fits):
        camera, _ = settle(context, acquisition, reception)
        if camera.hypothesis is None or not camera.hypothesis.exposure_slots_sd:
            return {}
        reception = replace(reception, clock=replace(reception.clock, exposure_slots=camera.hypothesis.exposure_slots))
    least, found = SETTINGS.shortest_exposure, reception.clock.exposure_slots
    out: dict[int, float] = {}
    for screen in screens:
        off = np.log(max(found, least) / max(stated_s * screen.slot_rate_hz, least)) / SETTINGS.exposure_sd
        log_likelihood = max(-float(off**2) / 2, SETTINGS.min_exposure_llr)
        out[screen.packet_slots] = max(log_likelihood, out.get(screen.packet_slots, log_likelihood))
    return out


def _log_weight(reception: Reception, clock: Clock) -> float:
    """Log-likelihood of the length of packets and its prior."""
    framed = detected_on(replace(reception, is_long=False), clock)
    return SETTINGS.temper * evidence.log_evidence(framed) - float(np.log(clock.packet_slots))
