"""The convolutional auto-encoder: a second opinion on slots where the model-based path is unsure.

The network sees what the light model sees, the lateral strips of a column on the slot grid and what the neighbours are
believed to send, but it needs no idea of the column's own slots: it has learned what pictures look like. So it serves
where the iteration of picture and slots went astray. It returns log-odds of every slot, from which the iteration starts
once more; the more plausible end is kept (that is the pipeline's business).

One model serves every camera, slot rate, number of columns and number of strips: time is measured in slots, light in
multiples of the local level, strips are treated alike and pooled.
"""

from __future__ import annotations

import hashlib
import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from rxcli.errors import ProfileError
from rxcli.protocol import HEADER, SLOTS_PER_SYMBOL
from rxcli.resources import data_dir
from rxcli.types import Clock, Float32Array, FloatArray, SlotSamples

#: The model that is used unless another is named.
DEFAULT_MODEL = "strips"
SAMPLES_PER_SLOT = 4
#: Names of the features of a strip and of a column, in order; a name with `[4]` stands for one feature a sample.
STRIP_FEATURES = ("light[4]", "log_light[4]", "neighbours[4]", "valid", "noise", "shot", "own", "exposure", "known")
COLUMN_FEATURES = ("known", "phase[10]")
N_STRIP_FEATURES, N_COLUMN_FEATURES = 18, 11
#: Slots on either side over which the local level is averaged.
_LEVEL_SLOTS = 10
_MAX_MODEL_BYTES = 2_000_000


@dataclass(frozen=True, slots=True)
class Scene:
    """What a frame's columns look like to the network; C columns of S strips, N slots of Q samples."""

    samples: SlotSamples
    clock: Clock
    #: (C, N) probability that each slot is lit, by the model-based path; only neighbours' are looked at.
    lit: Float32Array
    #: Light of a dark slot.
    floor: float
    #: Standard deviation of a sample of no light.
    sigma: float
    #: Variance of a sample per unit of light.
    shot: float
    #: (S, 3) shares of columns -1, 0, +1 in the light of each strip, up to a factor.
    spread: FloatArray


class Denoiser(Protocol):
    """Something that tells lit slots from dark ones by the light alone."""

    @property
    def name(self) -> str:
        """Name for reports."""

    def slot_log_odds(self, scene: Scene, columns: NDArray[np.int64]) -> Float32Array:
        """(len(columns), N) ln p(lit)/p(dark) of every slot of `columns`."""


def network_inputs(scene: Scene, columns: NDArray[np.int64]) -> tuple[Float32Array, Float32Array]:
    """The input contract.

    Args:
        scene: the frame.
        columns: columns to look at, B of them.

    Returns:
        (B, S, 18, N) features of the strips, and (B, 11, N) of the columns; float32.
    """
    q = scene.samples.samples_per_slot
    valid = scene.samples.valid[columns]
    light = (scene.samples.light[columns] - np.float32(scene.floor)) * valid
    level = _local_level(light, valid, q)
    sigma = np.float32(max(scene.sigma, 1e-7))
    relative = np.clip(light / (level + 2 * sigma), -1, 4)
    base = 0.02 * level + 2 * sigma
    log_light = np.log((np.maximum(light, 0) + base) / (level + base))
    shape = (*light.shape[:2], -1, q)
    known = _known_slots(scene.clock)
    features = [
        *np.moveaxis(relative.reshape(shape), -1, 0),
        *np.moveaxis(log_light.reshape(shape), -1, 0),
        *np.moveaxis(_from_neighbours(scene, columns, q).reshape(shape), -1, 0),
        valid.reshape(shape).mean(axis=-1),
        *_noise_features(level.reshape(shape)[..., 0], sigma, np.float32(scene.shot)),
        _against_middle(scene.spread)[None, :, 1, None],
        np.float32(scene.clock.exposure_slots),
        known,
    ]
    whole = features[0].shape
    strips = np.stack([np.broadcast_to(feature, whole) for feature in features], axis=2).astype(np.float32)
    return strips, np.broadcast_to(_column_features(known, scene.clock), (columns.size, N_COLUMN_FEATURES, whole[-1]))


def _local_level(light: Float32Array, valid: Float32Array, q: int) -> Float32Array:
    """(B, S, n) mean light of the valid samples around."""
    import cv2

    size = (2 * _LEVEL_SLOTS * q + 1, 1)
    flat = (-1, light.shape[-1])
    border = cv2.BORDER_CONSTANT
    total = cv2.boxFilter(light.reshape(flat), -1, size, normalize=False, borderType=border)
    count = cv2.boxFilter(valid.reshape(flat), -1, size, normalize=False, borderType=border)
    mean = np.maximum(total / np.maximum(count, 1), 0)
    return np.asarray(mean.reshape(light.shape), np.float32)


def _noise_features(level: Float32Array, sigma: np.float32, shot: np.float32) -> tuple[Float32Array, Float32Array]:
    """Noise of a dark and of an average sample against the level, decades."""
    whole = level + sigma
    return np.log10(sigma / whole), np.log10(np.sqrt(sigma * sigma + shot * level) / whole)


def _known_slots(clock: Clock) -> Float32Array:
    """(N,) 1 lit, -1 dark in headers, 0 where nothing is known."""
    position = (np.arange(clock.n_slots) + clock.first_slot) % clock.packet_slots
    header = 2 * np.array(HEADER, np.float32) - 1
    return np.where(position < len(HEADER), header[np.minimum(position, len(HEADER) - 1)], 0).astype(np.float32)


def _column_features(known: Float32Array, clock: Clock) -> Float32Array:
    """(11, N): known slots, and the place in the symbol as one of ten."""
    place = (np.arange(clock.n_slots) + clock.first_slot) % SLOTS_PER_SYMBOL
    return np.concatenate([known[None], np.arange(SLOTS_PER_SYMBOL)[:, None] == place]).astype(np.float32)


def _from_neighbours(scene: Scene, columns: NDArray[np.int64], q: int) -> Float32Array:
    """(B, S, N * Q) light that the adjacent columns should shed into each strip, per unit of picture."""
    n_columns = scene.lit.shape[0]
    out = np.zeros((columns.size, *scene.samples.light.shape[1:]), np.float32)
    centres = (np.arange(out.shape[-1]) + 0.5) / q
    spread = _against_middle(scene.spread)
    for side, share in ((-1, spread[:, 0]), (1, spread[:, 2])):
        for row, column in enumerate(columns):
            other = int(column) + side
            if 0 <= other < n_columns:
                ahead = scene.clock.delay_slots[column] - scene.clock.delay_slots[other]
                out[row] += share[:, None] * _exposed(scene.lit[other], centres + ahead, scene.clock.exposure_slots)
    return out


def _against_middle(spread: FloatArray) -> FloatArray:
    """(S, 3) light of columns -1, 0, +1 in each strip against the column's own light in its middle.

    A Gaussian's shares tell where in the column the strip lies: their logarithms bend by 1 / sigma**2 and rise by the
    strip's place over sigma**2.
    """
    log = np.log(np.maximum(spread, 1e-12))
    bend = np.maximum(2 * log[:, 1] - log[:, 0] - log[:, 2], 1e-6)
    rise = (log[:, 2] - log[:, 0]) / 2
    own = np.exp(-np.square(rise) / (2 * bend))
    return np.asarray(spread / spread[:, 1:2] * own[:, None])


def _exposed(lit: Float32Array, centres: FloatArray, exposure_slots: float) -> FloatArray:
    """Mean of slots over exposures centred at `centres` (in slots); slots beyond the grid are half lit."""
    margin = int(np.ceil(exposure_slots)) + 4
    padded = np.pad(lit.astype(np.float64), margin, constant_values=0.5)
    integral = np.concatenate([[0.0], np.cumsum(padded)])
    knots = np.arange(integral.size) - margin
    half = max(exposure_slots, 0.25) / 2
    return np.asarray(
        (np.interp(centres + half, knots, integral) - np.interp(centres - half, knots, integral)) / (2 * half)
    )


class Contract(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a model's tensors mean."""

    version: Literal[1]
    samples_per_slot: Literal[4]
    #: Names, in order; see `STRIP_FEATURES` and `COLUMN_FEATURES`.
    strip_features: tuple[str, ...]
    column_features: tuple[str, ...]
    strips: str = "strips"
    columns: str = "columns"
    log_odds: str = "log_odds"


class ModelCard(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """`model.toml`: what a model is, how it was made, and what it measured."""

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


def load_denoiser(name_or_path: str = DEFAULT_MODEL, threads: int = 1) -> OnnxDenoiser:
    """A shipped model by name, or a model folder by path; the file is checked, the session is made when first needed.

    Args:
        name_or_path: name of a folder in `models`, or path of one.
        threads: threads of the network.

    Raises:
        ProfileError: missing, malformed, cut, or made for another contract.
    """
    shipped = data_dir("models") / name_or_path
    is_name = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name_or_path) is not None
    folder = shipped if is_name and shipped.is_dir() else Path(name_or_path)
    card = _read_card(folder / "model.toml")
    return OnnxDenoiser(card, _read_weights(folder / card.file, card), threads)


def _read_card(path: Path) -> ModelCard:
    hint = "install the package again, or name a folder made by vlc-rx train"
    try:
        card = msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), ModelCard, strict=True)
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not text"
        raise ProfileError(f"{path}: no model can be read there ({reason})", hint) from None
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise ProfileError(f"{path}: not a model card ({error})", hint) from None
    wanted = (STRIP_FEATURES, COLUMN_FEATURES)
    if (card.contract.strip_features, card.contract.column_features) != wanted:
        raise ProfileError(f"{path}: the model wants other features than this receiver makes", hint)
    return card


def _read_weights(path: Path, card: ModelCard) -> bytes:
    hint = "install the package again, or export the model again with vlc-rx train"
    try:
        if path.stat().st_size > _MAX_MODEL_BYTES:
            raise ProfileError(f"{path}: larger than {_MAX_MODEL_BYTES} bytes", hint)
        data = path.read_bytes()
    except OSError as error:
        raise ProfileError(f"{path}: cannot be read ({error.strerror})", hint) from None
    if hashlib.sha256(data).hexdigest() != card.sha256:
        raise ProfileError(f"{path}: does not match the checksum in model.toml; it is cut or of another model", hint)
    return data


class OnnxDenoiser:
    """A network in ONNX Runtime; one call a frame."""

    def __init__(self, card: ModelCard, weights: bytes, threads: int = 1) -> None:
        self.card = card
        self._weights = weights
        self._threads = threads

    @property
    def name(self) -> str:
        """Name and version, for reports."""
        return f"{self.card.name}-{self.card.version}"

    def slot_log_odds(self, scene: Scene, columns: NDArray[np.int64]) -> Float32Array:
        """(len(columns), N) ln p(lit)/p(dark) of every slot of `columns`.

        Raises:
            ProfileError: the file is not the network that its card tells of.
        """
        strips, features = network_inputs(scene, columns)
        contract = self.card.contract
        fed = {contract.strips: strips, contract.columns: np.ascontiguousarray(features)}
        return np.asarray(self._session.run([contract.log_odds], fed)[0], np.float32)

    @cached_property
    def _session(self) -> Any:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = self._threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            session = onnxruntime.InferenceSession(self._weights, options, providers=["CPUExecutionProvider"])
        except Exception as error:
            reason = str(error).splitlines()[0]
            raise ProfileError(f"model {self.name}: ONNX Runtime refuses it ({reason})", "export it again") from None
        self._check_tensors(session.get_inputs(), session.get_outputs())
        return session

    def _check_tensors(self, inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
        contract = self.card.contract
        wanted = {contract.strips: (4, 2, N_STRIP_FEATURES), contract.columns: (3, 1, N_COLUMN_FEATURES)}
        found = {tensor.name: tensor.shape for tensor in inputs}
        fits = found.keys() == wanted.keys() and all(
            len(found[name]) == rank and found[name][axis] == size for name, (rank, axis, size) in wanted.items()
        )
        if not fits or [tensor.name for tensor in outputs] != [contract.log_odds]:
            raise ProfileError(
                f"model {self.name}: its tensors {found} are not those of its contract {sorted(wanted)}",
                "export it again with vlc-rx train",
            )

    def __getstate__(self) -> dict[str, Any]:
        """Sessions do not travel to worker processes."""
        return {"card": self.card, "_weights": self._weights, "_threads": self._threads}
