"""A fitted network as a model folder: ONNX file and card."""

import hashlib
import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import tomli_w
import torch

from rxcli.errors import ReceiverError
from rxcli.lab.training.dataset import Sample
from rxcli.lab.training.fit import StripNetwork
from rxcli.receiver.channel.denoise import (
    COLUMN_FEATURES,
    N_COLUMN_FEATURES,
    N_STRIP_FEATURES,
    STRIP_FEATURES,
    Contract,
    ModelCard,
)
from rxcli.resources import onnx_runtime

_OPSET = 17
#: Largest difference from torch that an exported network may show.
PARITY = 1e-4
_CALIBRATION_COLUMNS = 4


def export_model(
    network: StripNetwork,
    folder: Path,
    name: str,
    version: int,
    recipe: dict[str, Any],
    figures: dict[str, Any],
    calibration: Sequence[Sample] = (),
) -> ModelCard:
    """Write `model.onnx` and `model.toml`.

    Args:
        network: fitted.
        folder: is made where it does not exist.
        name: of the model.
        version: of the model, from 1.
        recipe: how it was fitted.
        figures: what it measured.
        calibration: samples whose ranges the eight-bit integers of a quantised network are laid out for; none: the
            network stays in floating point.

    Raises:
        ReceiverError: the exported network computes something else than torch.
    """
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "model.onnx"
    _write_onnx(network.eval(), file)
    difference = parity(network, file)
    if not difference < PARITY:
        raise ReceiverError(f"{file}: differs from torch by {difference:.1e}", "report this")
    if calibration:
        quantise(file, calibration)
    card = ModelCard(
        format=1,
        kind="denoiser",
        name=name,
        version=version,
        file=file.name,
        sha256=hashlib.sha256(file.read_bytes()).hexdigest(),
        contract=Contract(
            version=2, samples_per_slot=4, strip_features=STRIP_FEATURES, column_features=COLUMN_FEATURES
        ),
        description="Corrections of the light model's log-likelihood ratios of slots",
        recipe=recipe,
        figures=figures,
    )
    (folder / "model.toml").write_text(tomli_w.dumps(msgspec.to_builtins(card)), encoding="utf-8")
    return card


def _write_onnx(network: StripNetwork, file: Path) -> None:
    example = (torch.zeros(2, 3, N_STRIP_FEATURES, 40), torch.zeros(2, N_COLUMN_FEATURES, 40))
    inputs = {"strips": {0: "batch", 1: "strip", 3: "slot"}, "columns": {0: "batch", 2: "slot"}}
    output = {"correction": {0: "batch", 1: "slot"}}
    with warnings.catch_warnings():
        # The exporter that needs no further package is marked as the old one.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            example,
            str(file),
            input_names=list(inputs),
            output_names=list(output),
            dynamic_axes=inputs | output,
            opset_version=_OPSET,
            dynamo=False,
        )


def quantise(file: Path, samples: Sequence[Sample]) -> None:
    """Replace a network by one that computes in eight-bit integers.

    Args:
        file: ONNX file.
        samples: typical inputs.
    """
    onnx_runtime()
    from onnxruntime import quantization

    inputs = (
        {name: getattr(sample, name)[:_CALIBRATION_COLUMNS].astype(np.float32) for name in ("strips", "columns")}
        for sample in samples
    )
    reader = SimpleNamespace(get_next=lambda: next(inputs, None))
    kinds = {"activation_type": quantization.QuantType.QUInt8, "weight_type": quantization.QuantType.QInt8}
    part = file.with_suffix(".part")
    level = logging.getLogger().level
    logging.getLogger().setLevel(logging.ERROR)
    try:
        quantization.quantize_static(file, part, reader, per_channel=True, **kinds)
    finally:
        logging.getLogger().setLevel(level)
    part.replace(file)


def parity(network: StripNetwork, file: Path, seed: int = 0) -> float:
    """Largest difference between torch and ONNX Runtime on random inputs of other sizes than exported with."""
    onnxruntime = onnx_runtime()
    rng = np.random.default_rng(seed)
    strips = rng.standard_normal((3, 5, N_STRIP_FEATURES, 83), np.float32)
    columns = rng.standard_normal((3, N_COLUMN_FEATURES, 83), np.float32)
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    found = session.run(["correction"], {"strips": strips, "columns": columns})[0]
    with torch.no_grad():
        wanted = network.eval()(torch.from_numpy(strips), torch.from_numpy(columns)).numpy()
    return float(np.abs(found - wanted).max())
