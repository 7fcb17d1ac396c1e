"""Convolutional auto-encoder that corrects slots for which the light model is uncertain.

The input of the network is a column as the light model describes it: the light of every strip, the light predicted for
the column and its neighbours from the current slots, the residual, and the log-likelihood ratio of every slot. Its
output is added to that ratio. The network was trained on the likelihood of the correct code words after this addition.

Row noise, an offset common to all columns because a sensor row is read out at once, is removed first. It is estimated
from the residuals of the other columns at the same instant.

One model serves every camera, slot rate, number of columns and number of strips: time is in slots, light is relative to
the local level or to the noise, and all strips pass through the same layers and are pooled.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from rxcli.errors import ProfileError
from rxcli.numerics import NORMAL_MEDIAN, TINY, mean_of_valid
from rxcli.protocol import HEADER, PREAMBLE_SLOTS, SLOTS_PER_SYMBOL
from rxcli.receiver.channel.model import Expected, ObservationModel
from rxcli.receiver.channel.picture import PictureSums, by_place, in_time, predict_picture
from rxcli.receiver.channel.settings import SETTINGS
from rxcli.receiver.light import NoiseModel
from rxcli.resources import data_dir, onnx_runtime
from rxcli.types import Clock, Float32Array, SlotSamples

#: Default model.
DEFAULT_MODEL = "strips"
SAMPLES_PER_SLOT = 4
#: Names of the features of a strip and of a column, in order; a name with `[4]` stands for one feature per sample.
STRIP_FEATURES = (
    *("log_light[4]", "neighbours[4]", "own[4]", "residual[4]", "contrast[4]"),
    *("valid", "noise", "shot", "share", "exposure", "known"),
)
COLUMN_FEATURES = ("known", "phase[10]", "believed", "lent", "weight", "score", "information")
N_STRIP_FEATURES, N_COLUMN_FEATURES = (
    sum(int((re.findall(r"\d+", name) or ["1"])[0]) for name in names) for names in (STRIP_FEATURES, COLUMN_FEATURES)
)
#: Limit of residuals in features, standard deviations; the network was trained with it.
_RESIDUAL_SIGMAS = 4.0
#: Least distance of a slot's probability from 0 and 1 in features.
_MIN_DOUBT = 1e-5


@dataclass(frozen=True, slots=True)
class DenoiserInput:
    """Input of the network for a frame: C columns of S strips, N slots of Q samples."""

    samples: SlotSamples
    clock: Clock
    #: (C, N) probability that each slot is lit, without the network.
    lit: Float32Array
    #: (C, N) log-likelihood ratio of each slot by the light model.
    llr: Float32Array
    #: (C,) most likely weight.
    w: NDArray[np.int64]
    model: ObservationModel


def remove_row_noise(samples: SlotSamples, whole: Float32Array, model: ObservationModel) -> SlotSamples:
    """Remove row noise, the light that a sensor row has in common everywhere.

    It is estimated for every column from the residuals of the other columns at the same instant, and from every second
    strip, since errors of the strips of a column are correlated.

    Args:
        samples: of all columns.
        whole: (C, S, n) light of all columns per unit of picture, given the current slots.
        model: the light model.
    """
    thin = slice(None, None, 2)
    light, valid = model.over_black(samples)[:, thin], samples.valid[:, thin]
    residual, scale, _ = _residual(light, valid, whole[:, thin], model.noise, samples.samples_per_slot)
    rows = _row_light(np.clip(residual, -_RESIDUAL_SIGMAS, _RESIDUAL_SIGMAS), scale)[:, None]
    return replace(samples, light=samples.light - rows * samples.valid)


def network_inputs(scene: DenoiserInput, columns: NDArray[np.int64]) -> tuple[Float32Array, Float32Array]:
    """Compute the features of the input contract.

    Args:
        scene: the frame, after `remove_row_noise`.
        columns: numbers of the B columns.

    Returns:
        (B, S, 26, N) features of the strips, and (B, 16, N) of the columns; float32.
    """
    model, valid = scene.model, scene.samples.valid[columns]
    light = model.over_black(scene.samples)[columns]
    expected = model.expected(scene.lit, scene.clock, columns)
    residual, scale, picture = _residual(light, valid, expected.whole, model.noise, scene.samples.samples_per_slot)
    residual = np.clip(residual, -_RESIDUAL_SIGMAS, _RESIDUAL_SIGMAS)
    # Light of a lit slot, in units of the limit of residuals.
    contrast = np.minimum(picture * expected.own * scale / np.float32(_RESIDUAL_SIGMAS), np.float32(2))
    of_strips = _strip_features(scene, columns, light, expected, residual, contrast)
    return of_strips, _column_features(scene, columns, residual, contrast)


def _residual(
    light: Float32Array, valid: Float32Array, whole: Float32Array, noise: NoiseModel, q: int
) -> tuple[Float32Array, Float32Array, Float32Array]:
    """Residual of light in standard deviations, one over these, and the picture; (C, S, n)."""
    sums = PictureSums.of(*(by_place(each, q) for each in (light, whole, valid)))
    prediction = predict_picture(sums, noise.dark_variance, SETTINGS.picture_scales, one_sided=False)
    picture = in_time(prediction.at_samples(q))
    variance = noise.through_picture(picture, np.repeat(prediction.variance[0], q, axis=-1), whole)
    scale = np.asarray(valid / np.sqrt(variance), np.float32)
    return (light - picture * whole) * scale, scale, picture


def _row_light(residual: Float32Array, scale: Float32Array) -> Float32Array:
    """(C, n) row noise estimated from the residuals of the other columns, shrunk by its own error.

    Args:
        residual: (C, S, n) in standard deviations.
        scale: (C, S, n) one over the standard deviation.
    """
    total, weight = (residual * scale).sum(axis=1), (scale * scale).sum(axis=1)
    weight = np.maximum(weight.sum(axis=0) - weight, np.float32(TINY))
    mean = (total.sum(axis=0) - total) / weight
    # Errors of the strips of a column are correlated, which about doubles the variance of their mean.
    error = 2 / weight
    power = max(float(np.median(mean * mean)) / NORMAL_MEDIAN**2 - float(np.median(error)), 0.0)
    return np.asarray(mean * np.float32(power) / (np.float32(power) + error), np.float32)


def _strip_features(
    scene: DenoiserInput,
    columns: NDArray[np.int64],
    light: Float32Array,
    expected: Expected,
    residual: Float32Array,
    contrast: Float32Array,
) -> Float32Array:
    """(B, S, 26, N) features of strips, see `STRIP_FEATURES`, from (B, S, n) values."""
    q, noise, valid = scene.samples.samples_per_slot, scene.model.noise, scene.samples.valid[columns]
    sigma = np.float32(max(noise.sigma, TINY))
    level = np.maximum(mean_of_valid(light, valid, SLOTS_PER_SYMBOL * q), 0)
    base = np.float32(0.02) * level + 2 * sigma
    middle = scene.model.crosstalk.against_middle()
    # The network was trained on light relative to the column's centre.
    part = middle / expected.own
    by_sample = (
        np.log((np.maximum(light, 0) + base) / (level + base)),
        expected.neighbours * part,
        expected.own * part * expected.shape,
        residual,
        contrast,
    )
    shape = (*light.shape[:2], -1, q)
    out = np.empty((*light.shape[:2], N_STRIP_FEATURES, light.shape[-1] // q), np.float32)
    for number, values in enumerate(by_sample):
        out[:, :, number * q : (number + 1) * q] = np.moveaxis(values.reshape(shape), -1, 2)
    level = level.reshape(shape)[..., 0]
    by_slot = (
        valid.reshape(shape).mean(axis=-1),
        # Noise of a dark and of an average sample relative to the level, decades.
        np.log10(sigma / (level + sigma)),
        np.log10(np.sqrt(sigma * sigma + np.float32(noise.shot_gain) * level) / (level + sigma)),
        middle,
        np.float32(scene.clock.exposure_slots),
        _known_slots(scene.clock),
    )
    for number, values in enumerate(by_slot):
        out[:, :, len(by_sample) * q + number] = values
    return out


def _column_features(
    scene: DenoiserInput, columns: NDArray[np.int64], residual: Float32Array, contrast: Float32Array
) -> Float32Array:
    """(B, 16, N) features of columns, see `COLUMN_FEATURES`, from (B, S, n) values."""
    q, clock = scene.samples.samples_per_slot, scene.clock
    lit = np.clip(scene.lit[columns], _MIN_DOUBT, 1 - _MIN_DOUBT)
    llr = scene.llr[columns]
    # Slope of a Student-t log-density with four degrees of freedom, which limits outliers.
    pull = residual / (1 + residual * residual / np.float32(4))
    place = clock.places % SLOTS_PER_SYMBOL
    by_slot = (
        _known_slots(clock),
        *(np.arange(SLOTS_PER_SYMBOL)[:, None] == place),
        *(np.clip(values / 4, -3, 3) for values in (llr, np.log(lit / (1 - lit)) - llr)),
        scene.w[columns, None] / SLOTS_PER_SYMBOL,
        np.clip(_pooled(pull * contrast, q), -_RESIDUAL_SIGMAS, _RESIDUAL_SIGMAS),
        np.log1p(_pooled(contrast * contrast, q)),
    )
    shape = (columns.size, clock.n_slots)
    return np.stack([np.broadcast_to(values, shape) for values in by_slot], axis=1).astype(np.float32)


def _pooled(values: NDArray[np.floating[Any]], q: int) -> Float32Array:
    """(B, N) sum over strips and the samples of a slot, for the effective number of independent samples."""
    return np.asarray(
        values.sum(axis=1).reshape(values.shape[0], -1, q).sum(axis=2) * np.float32(SETTINGS.slot_information / q)
    )


def _known_slots(clock: Clock) -> Float32Array:
    """(N,) 1 lit, -1 dark in headers, 0 elsewhere."""
    signs = np.zeros(clock.packet_slots, np.float32)
    signs[: len(HEADER)] = 2 * np.array(HEADER) - 1
    return signs[clock.places]


def payload_observed(scene: DenoiserInput) -> Float32Array:
    """(C, N) 1 where any part of a payload slot is visible, else 0.

    The network was trained on payloads only; header and dimming symbol are left to the light model.
    """
    clock = scene.clock
    payload = clock.places >= PREAMBLE_SLOTS
    valid = scene.samples.valid.max(axis=1)
    return np.asarray(payload & (valid.reshape(*scene.lit.shape, -1).max(axis=2) > 0), np.float32)


class Contract(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Meaning of a model's tensors."""

    version: Literal[2]
    samples_per_slot: Literal[4]
    #: Names of the features in order; see `STRIP_FEATURES` and `COLUMN_FEATURES`.
    strip_features: tuple[str, ...]
    column_features: tuple[str, ...]
    strips: str = "strips"
    columns: str = "columns"
    correction: str = "correction"

    def __post_init__(self) -> None:
        if (self.strip_features, self.column_features) != (STRIP_FEATURES, COLUMN_FEATURES):
            raise ValueError("the model wants other features than this receiver makes")


class ModelCard(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`model.toml`: description, training recipe and figures of a model."""

    format: Literal[1]
    kind: Literal["denoiser"]
    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
    version: Annotated[int, Meta(ge=1)]
    file: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
    sha256: Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
    contract: Contract
    description: str = ""
    #: Data, steps, seeds, commit.
    recipe: dict[str, Any] = {}
    figures: dict[str, Any] = {}


def load_denoiser(name_or_path: str = DEFAULT_MODEL) -> OnnxDenoiser:
    """Load a shipped model by name, or a model folder by path; the session starts when it is first used.

    Args:
        name_or_path: name of a folder in `models`, or path of a model folder.

    Raises:
        ProfileError: the model is missing, malformed, truncated, or made for another contract.
    """
    shipped = data_dir("models") / name_or_path
    is_name = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name_or_path) is not None
    folder = shipped if is_name and shipped.is_dir() else Path(name_or_path)
    path, hint = folder / "model.toml", "install the package again, or name a folder made by vlc-rx train"
    try:
        card = msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), ModelCard, strict=True)
        path = folder / card.file
        weights = path.read_bytes()
    except OSError as error:
        raise ProfileError(f"{path}: no model can be read there ({error.strerror})", hint) from None
    except ValueError as error:  # No text, no TOML or no card.
        raise ProfileError(f"{path}: not a model card ({error})", hint) from None
    import hashlib  # loads OpenSSL, which pictures without columns in doubt do without

    if hashlib.sha256(weights).hexdigest() != card.sha256:
        raise ProfileError(f"{path}: does not match the checksum in model.toml; it is cut or of another model", hint)
    return OnnxDenoiser(card, weights)


@dataclass(frozen=True, slots=True)
class OnnxDenoiser:
    """A network in ONNX Runtime, called once per frame."""

    card: ModelCard
    weights: bytes

    @property
    def name(self) -> str:
        """Name and version, for reports."""
        return f"{self.card.name}-{self.card.version}"

    def slot_corrections(self, scene: DenoiserInput, columns: NDArray[np.int64]) -> Float32Array:
        """(len(columns), N) values to add to ln p(light | lit) - ln p(light | dark) of every slot of `columns`.

        The scene must have passed `remove_row_noise`.

        Raises:
            ProfileError: the file is not the network described by its card.
        """
        strips, features = network_inputs(scene, columns)
        contract = self.card.contract
        try:
            fed = {contract.strips: strips, contract.columns: features}
            (correction,) = _session(self.weights).run([contract.correction], fed)
        except Exception as error:
            reason = str(error).splitlines()[0]
            raise ProfileError(f"model {self.name}: ONNX Runtime refuses it ({reason})", "export it again") from None
        return np.asarray(correction, np.float32) * payload_observed(scene)[columns]


@lru_cache(maxsize=1)
def _session(weights: bytes) -> Any:
    onnxruntime = onnx_runtime()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    return onnxruntime.InferenceSession(weights, options, providers=["CPUExecutionProvider"])
