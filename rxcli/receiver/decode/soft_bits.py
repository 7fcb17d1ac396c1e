"""Soft bits of whole and cut packets for the link layer, limited by the confidence of the packet."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rxcli.numerics import TINY
from rxcli.receiver.decode.assemble import echoes, in_view
from rxcli.receiver.decode.confidence import BurstInView, confidence_log_odds, log_odds_of, wrong_share
from rxcli.receiver.decode.settings import SETTINGS
from rxcli.types import BoolArray, BurstPosteriors, Float32Array, FloatArray, FrameSoftBits, IntArray


def assume_unobserved_certain(posteriors: BurstPosteriors, n_observed: IntArray) -> BurstPosteriors:
    """Count symbols that were not fully observed as certain, so that a cut packet is judged by its visible part.

    Args:
        posteriors: of B bursts and C columns.
        n_observed: (B, C, packet).
    """
    return replace(posteriors, log_prob=np.where(in_view(n_observed), posteriors.log_prob, 0.0))


def llr_limits(posteriors: BurstPosteriors, n_observed: IntArray, log_odds: FloatArray) -> FloatArray:
    """(B, C) upper limit of a packet's log-likelihood ratios.

    Args:
        posteriors: of B bursts and C columns.
        n_observed: (B, C, packet).
        log_odds: (B, C) calibrated log-odds that every observed symbol is right.
    """
    known = in_view(n_observed)[..., None] & ~np.isnan(posteriors.bit_llr)
    n_bits = np.maximum(known.sum(axis=(-2, -1)), 1)
    wrong = wrong_share(log_odds, n_bits)
    own = (known / (1 + np.exp(np.abs(np.nan_to_num(posteriors.bit_llr))))).sum(axis=(-2, -1)) / n_bits
    hidden = np.maximum(wrong - own, SETTINGS.hidden_error_share * wrong)
    return np.asarray(np.clip(-np.log(np.maximum(hidden, TINY)), 0.0, SETTINGS.max_bit_llr))


def limit_llr(posteriors: BurstPosteriors, limits: FloatArray, erased: BoolArray) -> Float32Array:
    """(B, N, C, 7) log-likelihood ratios within the limits (B, C); 0 where `erased` (B, C)."""
    sure_of_w = posteriors.w_log_prob.max(axis=1) > np.log(SETTINGS.min_weight_probability)
    limit = np.where(erased | ~sure_of_w, 0.0, limits)[..., None, None]
    llr = np.clip(np.nan_to_num(posteriors.bit_llr), -limit, limit)
    return np.ascontiguousarray(llr.transpose(0, 2, 1, 3), np.float32)


def still_soft_bits(
    posteriors: BurstPosteriors,
    n_observed: IntArray,
    confidence_features: FloatArray,
    snr_db: Sequence[float | None],
    headerless: BoolArray,
) -> FrameSoftBits:
    """The soft bits of a photograph.

    Args:
        posteriors: of B bursts and C columns.
        n_observed: (B, C, packet).
        confidence_features: (B, C, 11) of what was observed.
        snr_db: of every column, None where nothing is visible.
        headerless: (C,) columns that show no packets.
    """
    limits = llr_limits(posteriors, n_observed, confidence_log_odds(confidence_features))
    erased = echoes(posteriors, snr_db) | headerless
    # The joint detector leaves one word of a symbol that is hardly in view, as if the others were impossible.
    llr = (
        limit_llr(posteriors, limits, erased)
        * in_view(n_observed, SETTINGS.max_missing_slots).swapaxes(1, 2)[..., None]
    )
    return FrameSoftBits(np.arange(len(n_observed)), llr)


def clip_soft_bits(bursts: Sequence[BurstInView], snr_db: Sequence[float | None], epoch: int) -> FrameSoftBits | None:
    """The soft bits of the bursts that end in a frame of a clip, or None."""
    if not bursts:
        return None
    parts = []
    for burst in bursts:
        n_observed = burst.n_observed[None]
        log_odds = log_odds_of(replace(burst, posteriors=assume_unobserved_certain(burst.posteriors, n_observed)))[None]
        limits = llr_limits(burst.posteriors, n_observed, log_odds)
        parts.append(limit_llr(burst.posteriors, limits, echoes(burst.posteriors, snr_db)))
    return FrameSoftBits(np.array([burst.number for burst in bursts], np.int64), np.concatenate(parts), epoch)
