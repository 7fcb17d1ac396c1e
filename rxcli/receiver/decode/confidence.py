"""Calibrated confidence of packets, and their expected share of wrong bits.

The weights are fitted data, `models/confidence`.
"""

import tomllib
from dataclasses import dataclass
from functools import lru_cache

import msgspec
import numpy as np

from rxcli.numerics import TINY
from rxcli.resources import data_dir
from rxcli.types import BoolArray, BurstPosteriors, Float32Array, FloatArray, IntArray

#: Lower limit of the log-likelihood of slots against a packet, so that its logarithm exists.
_MIN_CONTRADICTION = 0.5
#: Number of the first feature of joint detections, which is 1 for them and 0 for others.
_FIRST_JOINT = 8
#: Upper limit of the negative log probability of a packet, so that its log-odds are finite.
_MAX_DOUBT = 500.0


class _Photographs(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    weights: tuple[float, ...]
    max_log_odds: float
    max_average: float
    max_joint_log_odds: float


class _Clips(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    weights: tuple[float, ...]
    max_log_odds: float


class _WrongBits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    wrong_bits_at_even_odds: float
    wrong_share_at_even_odds: float
    exponent: float


class ConfidenceModel(msgspec.Struct, frozen=True):
    """Fitted weights from `models/confidence/model.toml`; the comments there explain them."""

    photographs: _Photographs
    clips: _Clips
    wrong_bits: _WrongBits


@lru_cache(maxsize=1)
def confidence_model() -> ConfidenceModel:
    """Load the shipped weights."""
    path = data_dir("models") / "confidence" / "model.toml"
    return msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), ConfidenceModel)


@dataclass(frozen=True, slots=True)
class BurstInView:
    """A burst as reported in the photograph, or in the last frame of a clip, that shows it."""

    #: Number in the clip, None of photographs; and index in the frame's clock.
    number: int | None
    index: int
    #: Of this burst alone.
    posteriors: BurstPosteriors
    #: (C, packet) how often each slot was seen, over all frames.
    n_observed: IntArray
    #: Of the clip; None of photographs.
    frames: tuple[int, ...] | None
    #: (C, 11) see `confidence_features`; None of tracked frames.
    confidence_features: FloatArray | None
    #: (C,) largest log-likelihood of any payload slot against its decision; None where the frames were received like
    #: photographs.
    against: Float32Array | None = None


@dataclass(frozen=True, slots=True)
class Quality:
    """Confidence of the packets of a burst's C columns."""

    #: (C,) probability that they are error-free, and expected share of wrong bits.
    confidence: FloatArray
    ber_hat: FloatArray
    #: (C, 11) see `confidence_features`; (C, 3) of tracked bursts, see `clip_features`.
    confidence_features: FloatArray


def quality_of(burst: BurstInView) -> Quality:
    """Confidence of the packets of a burst.

    Errors of a known picture and of compression are correlated over slots and copies, so the likelihoods of bits are
    too sure in clips; those of a joint detection are, too.
    """
    log_odds, bit_llr, features = log_odds_of(burst), burst.posteriors.bit_llr[0], burst.confidence_features
    known = ~np.isnan(bit_llr)  # symbols of fewer than 7 bits are padded with NaN
    n_bits = np.maximum(known.sum(axis=(-2, -1)), 1)
    share = (1 / (1 + np.exp(np.abs(bit_llr)))).sum(axis=(-2, -1), where=known) / n_bits
    is_too_sure = True if features is None else features[..., _FIRST_JOINT] > 0
    ber_hat = np.where(is_too_sure, np.maximum(share, wrong_share(log_odds, n_bits)), share)
    return Quality(_probability(log_odds), ber_hat, clip_features(burst) if features is None else features)


def wrong_share(log_odds: FloatArray, n_bits: IntArray) -> FloatArray:
    """Expected share of wrong bits of packets of `n_bits`, from their log-odds of being error-free."""
    model = confidence_model().wrong_bits
    wrong_bits_at_even_odds = np.maximum(model.wrong_bits_at_even_odds / n_bits, model.wrong_share_at_even_odds)
    return np.asarray(np.minimum(wrong_bits_at_even_odds * np.exp(-model.exponent * log_odds), 0.5))


def log_odds_of(burst: BurstInView) -> FloatArray:
    """(C,) calibrated log-odds of the packets of a burst being error-free."""
    if burst.confidence_features is not None:
        return confidence_log_odds(burst.confidence_features)
    return np.asarray(clip_features(burst) @ np.array(confidence_model().clips.weights))


def clip_features(burst: BurstInView) -> FloatArray:
    """(C, 3) features of the confidence of a tracked burst's packets, in the order of the weights.

    The posterior is limited: beyond the limit errors are not due to noise. Slots that contradict the decided codeword
    reveal such.
    """
    assert burst.against is not None
    log_odds = np.minimum(_log_odds(burst.posteriors.log_prob.sum(axis=2))[0], confidence_model().clips.max_log_odds)
    return np.stack([np.ones_like(log_odds), log_odds, np.log(burst.against + _MIN_CONTRADICTION)], axis=1)


def confidence_features(
    posteriors: BurstPosteriors,
    slot_margin: Float32Array,
    denoised: BoolArray,
    n_strips: int,
    joint: BoolArray | None = None,
) -> FloatArray:
    """(B, C, 11) features of the confidence of packets, in the order of the weights.

    The light model scales its likelihoods down, because errors of strips and samples are correlated. They are still too
    sure where the picture or the camera deviates from the model; single slots then contradict the packet. The weights
    are a logistic regression on packets of the benchmark's `confidence` and `phones`. A change to the likelihoods of
    the light model or to the auto-encoder requires a new fit. The last three are of columns whose slots and
    picture were detected jointly, and 0 of the others; the first eight the other way round.

    Args:
        posteriors: of B bursts and C columns.
        slot_margin: (B, C, n) log-likelihood ratio of the packets' payload slots as decided against the opposite; 0
            where nothing is visible; see `slot_margin_by_burst`.
        denoised: (C,) whether corrections of the auto-encoder were kept.
        n_strips: strips of a column in the initial pass.
        joint: (C,) whether slots and picture were detected jointly; None: of no column.
    """
    model = confidence_model().photographs
    uncapped = _log_odds(posteriors.log_prob.sum(axis=2))
    log_odds = np.minimum(uncapped, model.max_log_odds)
    against = np.log(_MIN_CONTRADICTION - np.minimum(slot_margin, 0).sum(axis=2))
    n_observed_slots = np.maximum((slot_margin != 0).sum(axis=2), 1)
    average = np.log(np.clip(slot_margin.sum(axis=2) / n_observed_slots, 1, model.max_average))
    strips = np.log(n_strips)
    terms = (1.0, log_odds, denoised, against, average, average * log_odds, strips, strips * log_odds)
    joint_terms = (1.0, np.minimum(uncapped, model.max_joint_log_odds), against)
    is_joint = np.zeros(len(denoised), bool) if joint is None else joint
    out = np.zeros((*log_odds.shape, len(terms) + len(joint_terms)))
    for number, term in enumerate(terms):
        out[..., number] = np.where(is_joint, 0.0, term)
    for number, term in enumerate(joint_terms, len(terms)):
        out[..., number] = np.where(is_joint, term, 0.0)
    return out


def confidence(confidence_features: FloatArray) -> FloatArray:
    """(...) probability that packets are error-free, from their features (..., 11)."""
    return _probability(confidence_log_odds(confidence_features))


def confidence_log_odds(confidence_features: FloatArray) -> FloatArray:
    """(...) log-odds that packets are error-free, from their features (..., 11).

    Small noisy columns deserve more confidence than their posterior, because errors of their strips are less correlated
    than assumed. Where slots have the largest counted margin, noise does not explain a doubtful symbol, and the
    posterior is an upper limit.
    """
    model = confidence_model().photographs
    log_odds = np.asarray(confidence_features @ np.array(model.weights))
    posterior, average = confidence_features[..., 1], confidence_features[..., 4]
    # Columns that were detected jointly have no average, and are never plain.
    plain = np.isclose(average, np.log(model.max_average)) & (posterior < model.max_log_odds)
    # The limit applies only to packets that are more likely right than wrong.
    return np.asarray(np.where(plain, np.minimum(log_odds, np.maximum(posterior, 0.0)), log_odds))


def _log_odds(log_prob: FloatArray) -> FloatArray:
    at_most = np.clip(log_prob, -_MAX_DOUBT, -TINY)
    return np.asarray(at_most - np.log(-np.expm1(at_most)))


def _probability(log_odds: FloatArray | float) -> FloatArray:
    return np.asarray(1 / (1 + np.exp(-log_odds)))
