"""What was received of a frame on a clock, and what it says of itself: packets, doubt, darkness. Part of the wiring."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rxcli.protocol import SLOTS_PER_SYMBOL, WEIGHTS
from rxcli.receiver import channel, sync
from rxcli.receiver.channel import denoise
from rxcli.receiver.decode import assemble, confidence, detect
from rxcli.receiver.decode.soft_bits import assume_unobserved_certain, still_soft_bits
from rxcli.receiver.decode.steady import is_steady
from rxcli.receiver.settings import SETTINGS
from rxcli.types import BurstPosteriors, Clock, Float32Array, FloatArray, Frame, FrameSoftBits, SlotSamples


@dataclass(frozen=True)
class Reception:
    """What was received of a frame."""

    clock: Clock
    #: Of the quick look: strips pooled in pairs.
    samples: SlotSamples
    posteriors: BurstPosteriors
    #: (C, N): squared contrast over variance of every slot.
    snr: Float32Array
    #: For the samples.
    model: channel.ObservationModel
    #: (C, N + memory, patterns).
    metrics: FloatArray
    #: All strips on the fine grid without the rows' own light, and the model for them; None where nothing was in doubt.
    cleaned: tuple[SlotSamples, channel.ObservationModel] | None = None
    #: What was skipped: name -> columns.
    skipped: dict[str, int] = field(default_factory=dict)

    @cached_property
    def column_llr(self) -> FloatArray:
        """(C,) log-likelihood ratio of each column's slots being packets, over slots that are anything."""
        packets = self.posteriors.log_evidence - np.log(len(WEIGHTS))
        share = self.posteriors.w / SLOTS_PER_SYMBOL
        return np.asarray(packets - detect.free_log_evidence(self.metrics, share))

    @cached_property
    def packet_confidence(self) -> FloatArray:
        """(B, C) confidence of packets, the auto-encoder not yet asked."""
        by_burst = assemble.slot_margin_by_burst(slot_margin(self), self.clock)
        n_columns, n_strips = self.samples.light.shape[:2]
        return confidence.confidence(
            confidence.confidence_features(self.posteriors, by_burst, np.zeros(n_columns, bool), n_strips)
        )

    @property
    def scene(self) -> denoise.DenoiserInput | None:
        """What the auto-encoder may be shown; None where nothing was in doubt."""
        return None if self.cleaned is None else self.scene_of(*self.cleaned)

    def scene_of(self, samples: SlotSamples, model: channel.ObservationModel) -> denoise.DenoiserInput:
        """Samples of all columns with what was decided of them."""
        lit = self.clock.on_grid(self.posteriors.lit)
        return denoise.DenoiserInput(samples, self.clock, lit, self.metrics, self.posteriors.w, model)


def packet_llr(reception: Reception) -> float:
    """Log-likelihood ratio of all columns' slots being packets, on the clock they were received with, over any slots.

    Copies that differ and words that are not in the codebook speak against it, headers or not.
    """
    # The light model is surer than it should be: a column that fits poorly, or is dark, says nothing.
    return float(np.logaddexp(reception.column_llr, 0.0).sum())


def has_clear_packets(reception: Reception) -> bool:
    """Whether packets show beyond doubt."""
    return packet_llr(reception) >= SETTINGS.clear_packets_llr


def word_log_prob(reception: Reception) -> FloatArray:
    """(C,) log probability that all words decided of a column are right, as far as the light model is."""
    return np.asarray(reception.posteriors.log_prob.sum(axis=(0, 2)))


def headerless(reception: Reception) -> NDArray[np.bool_]:
    """(C,) columns that show no packets: no header where it should be, and not so many words of the codebook.

    With few rows a slot or at the screen's edge light is not as the model has it, and headers are the first to tell.
    None has any where all the light is a steady periodic waveform.
    """
    out = assemble.find_headerless(reception.posteriors.header_llr)
    if not out.all() and shows_steady_light(reception):
        return np.ones_like(out)
    if out.any():
        out &= reception.column_llr < SETTINGS.min_headerless_llr
    return out


def shows_steady_light(reception: Reception) -> bool:
    """Whether the light is that of a lamp or of a screen that is dimmed by switching."""
    samples, clock = reception.samples, reception.clock
    contrast = sync.contrast(samples.light, samples.valid, samples.samples_per_slot, reception.model.noise.sigma)
    lit = clock.on_grid(reception.posteriors.lit)
    return is_steady(*contrast, lit, clock.packet_slots)


def dark_columns(snr: Float32Array) -> NDArray[np.bool_]:
    """(C,) whether a column has too little light for the light model to make anything of it."""
    n_observed, n_lit = ((snr > least).sum(axis=1) for least in (0.0, 10 ** (SETTINGS.dark_snr_db / 10)))
    return np.asarray((2 * n_lit < n_observed) | (n_observed == 0))


def has_doubtful_packet(reception: Reception, certain: float) -> NDArray[np.bool_]:
    """(C,) whether a packet that could be reported has less than the confidence `certain`."""
    doubtful = (reception.packet_confidence < certain) & (
        reception.posteriors.log_prob.min(axis=2) < SETTINGS.beyond_doubt_log_prob
    )
    return np.asarray((doubtful & complete_packets(reception)).any(axis=0))


def complete_packets(reception: Reception) -> NDArray[np.bool_]:
    """(B, C) packets that could be reported."""
    return assemble.complete(assemble.slots_observed(reception.samples, reception.clock))


def best_log_prob(reception: Reception) -> FloatArray:
    """(C,) mean log probability of the symbols of each column's surest packet that could be reported."""
    return np.asarray(
        np.where(complete_packets(reception), reception.posteriors.log_prob.mean(axis=2), -np.inf).max(axis=0)
    )


def slot_margin(reception: Reception) -> Float32Array:
    """(C, N) what the light says for every slot as decided, nats."""
    return detect.slot_margin(reception.metrics, reception.clock.on_grid(reception.posteriors.lit) > 0.5)


def soft_bits(
    frame: Frame, reception: Reception, no_header: NDArray[np.bool_], denoised: frozenset[int] = frozenset()
) -> FrameSoftBits:
    """What a photograph says of the payload's bits, cut packets included."""
    n_observed = assemble.slots_observed(reception.samples, reception.clock)
    n_columns, n_strips = reception.samples.light.shape[:2]
    features = confidence.confidence_features(
        assume_unobserved_certain(reception.posteriors, n_observed),
        assemble.slot_margin_by_burst(slot_margin(reception), reception.clock),
        np.isin(np.arange(n_columns), list(denoised)),
        n_strips,
    )
    snr_db = assemble.snr_db_of_columns(reception.snr)
    soft = still_soft_bits(reception.posteriors, n_observed, features, snr_db, no_header)
    return replace(soft, source=frame.source, frame=frame.index, time_s=frame.time_s)
