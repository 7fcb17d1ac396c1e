"""Reception of a frame on a given clock, and its assessment: packets, doubtful columns, dark columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rxcli.profiles import ScreenProfile
from rxcli.protocol import PREAMBLE_SLOTS
from rxcli.receiver import channel
from rxcli.receiver.channel import denoise
from rxcli.receiver.decode import assemble, confidence
from rxcli.receiver.decode.settings import SETTINGS as decode_settings
from rxcli.receiver.decode.soft_bits import assume_unobserved_certain, still_soft_bits
from rxcli.receiver.decode.steady import is_steady
from rxcli.receiver.frame.settings import SETTINGS
from rxcli.types import (
    BoolArray,
    BurstPosteriors,
    Clock,
    Float32Array,
    FloatArray,
    Frame,
    FrameSoftBits,
    IntArray,
    SlotSamples,
)


@dataclass(frozen=True)
class Reception:
    """Samples, slots and posteriors of a frame on a given clock."""

    clock: Clock
    #: Samples of the initial pass: strips binned in pairs.
    samples: SlotSamples
    #: Light of the columns between its local extremes, and its weight; see `sync.contrast`.
    contrast: tuple[Float32Array, Float32Array]
    posteriors: BurstPosteriors
    #: (C, N): squared contrast over variance of every slot.
    snr: Float32Array
    #: Observation model of the samples.
    model: channel.ObservationModel
    #: (C, N) log-likelihood ratio of every slot being lit, of every copy by itself.
    llr: Float32Array
    #: (C,) columns whose slots and picture were detected jointly, see `decode.survivors`.
    joint: BoolArray
    #: Whether exposures last several slots, so that all columns were detected jointly from the start.
    is_long: bool = False
    #: Assignments of the copies to bursts, each with its log evidence by joint detection; none: by their similarity.
    bursts_by_evidence: Sequence[tuple[IntArray, float]] = ()
    #: Skipped steps: name -> number of columns.
    skipped: dict[str, int] = field(default_factory=dict)

    @property
    def header_llr(self) -> FloatArray:
        """(B, C) log-likelihood ratio of headers; (1, C) of packets where exposures are too long to show headers."""
        return self.posteriors.log_evidence[None] if self.is_long else self.posteriors.header_llr

    @cached_property
    def n_observed(self) -> IntArray:
        """(B, C, packet) number of copies in which each slot was observed."""
        return assemble.slots_observed(self.samples, self.clock)

    @cached_property
    def is_complete(self) -> BoolArray:
        """(B, C) packets with all payload slots observed."""
        return assemble.complete(self.n_observed, decode_settings.max_missing_slots)

    @property
    def payload_lit(self) -> Float32Array:
        """(C, slots) probability that each payload slot of all bursts is lit."""
        lit = self.posteriors.lit[..., PREAMBLE_SLOTS:]
        return lit.transpose(1, 0, 2).reshape(lit.shape[1], -1)

    @cached_property
    def packet_confidence(self) -> FloatArray:
        """(B, C) confidence of packets without the auto-encoder."""
        return confidence.confidence(self.confidence_features(self.posteriors))

    def confidence_features(self, posteriors: BurstPosteriors, denoised: frozenset[int] = frozenset()) -> FloatArray:
        """(B, C, 11) features of the confidence of packets with these posteriors; some columns were denoised."""
        n_columns, n_strips = self.samples.light.shape[:2]
        was_denoised = np.isin(np.arange(n_columns), list(denoised))
        return confidence.confidence_features(posteriors, self._slot_margin, was_denoised, n_strips, self.joint)

    def best_confidence(self, denoised: frozenset[int] = frozenset()) -> FloatArray:
        """(C,) confidence of each column's surest complete packet, 0 if there is none."""
        own = confidence.confidence(self.confidence_features(self.posteriors, denoised))
        return np.asarray(np.where(self.is_complete, own, 0.0).max(axis=0))

    @cached_property
    def _slot_margin(self) -> Float32Array:
        """(B, C, N) log-likelihood ratio of each burst's payload slots as decided against their opposite."""
        decided = self.clock.on_grid(self.posteriors.lit) > 0.5
        return assemble.slot_margin_by_burst(np.where(decided, self.llr, -self.llr), self.clock)

    def of_columns(self, columns: IntArray) -> Reception:
        """The reception of some columns."""
        return replace(
            self,
            clock=replace(self.clock, delay_slots=self.clock.delay_slots[columns]),
            samples=self.samples.of_columns(columns),
            contrast=(self.contrast[0][columns], self.contrast[1][columns]),
            posteriors=self.posteriors.of_columns(columns),
            snr=self.snr[columns],
            llr=self.llr[columns],
            joint=self.joint[columns],
        )

    def scene_of(self, samples: SlotSamples, model: channel.ObservationModel) -> denoise.DenoiserInput:
        """Samples of all columns with their current decisions."""
        lit = self.clock.on_grid(self.posteriors.lit)
        return denoise.DenoiserInput(samples, self.clock, lit, self.llr, self.posteriors.w, model)


def packet_llr(reception: Reception) -> float:
    """Log-likelihood ratio of all columns containing packets on this clock, against arbitrary slots.

    Copies that differ and words outside the codebook count against packets, as missing headers do.
    """
    # The likelihoods are too sure, so a dark column or one that fits poorly must not count against packets.
    return float(np.logaddexp(reception.posteriors.log_evidence, 0.0).sum())


def headerless(reception: Reception) -> NDArray[np.bool_]:
    """(C,) columns without packets: no header at its place, and few words of the codebook.

    Few rows per slot and the screen's edge violate the light model, which affects headers first. No column has packets
    if the light is a periodic waveform.
    """
    out = assemble.find_headerless(reception.header_llr)
    if not out.all() and shows_steady_light(reception):
        return np.ones_like(out)
    return np.asarray(out & (reception.posteriors.log_evidence < SETTINGS.min_headerless_llr))


def shows_steady_light(reception: Reception) -> bool:
    """Whether the light is that of a lamp or of a screen dimmed by switching."""
    lit = reception.clock.on_grid(reception.posteriors.lit)
    return is_steady(*reception.contrast, lit, reception.clock.packet_slots)


def dark_columns(snr: Float32Array) -> NDArray[np.bool_]:
    """(C,) whether a column has too little light for the light model."""
    n_observed, n_lit = (snr > 0).sum(axis=1), (snr > 1).sum(axis=1)
    return np.asarray((2 * n_lit < n_observed) | (n_observed == 0))


def soft_bits(
    frame: Frame,
    screen: ScreenProfile,
    reception: Reception,
    no_header: NDArray[np.bool_],
    denoised: frozenset[int] = frozenset(),
) -> FrameSoftBits:
    """Soft bits of a photograph, including those of cut packets."""
    posteriors, n_observed = reception.posteriors, reception.n_observed
    features = reception.confidence_features(assume_unobserved_certain(posteriors, n_observed), denoised)
    snr_db = assemble.snr_db_of_columns(reception.snr)
    soft = still_soft_bits(posteriors, n_observed, features, snr_db, no_header)
    soft = replace(soft, screen_profile=screen.name)
    return replace(soft, source=frame.source, frame=frame.index, time_s=frame.time_s)
