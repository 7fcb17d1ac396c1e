"""`vlc-rx train`: fit the auto-encoder and export it."""

from dataclasses import asdict
from math import isnan
from pathlib import Path
from typing import Any

import click

from rxcli.cli.common import options
from rxcli.cli.kinds import FOLDER
from rxcli.errors import require

#: Samples that the ranges of eight-bit integers are laid out for.
CALIBRATION_SAMPLES = 12


@click.command()
@click.argument("out", type=FOLDER)
@options(
    ("--name", str, "strips", "Name of the model."),
    ("--version model_version", click.IntRange(1), 1, "Its version."),
    ("--steps", click.IntRange(1), 1600, "Steps of the optimiser."),
    ("--frames", click.IntRange(1), 640, "Frames to simulate."),
    ("--held-out", click.IntRange(0), 12, "Frames to validate on."),
    ("--strip-width", click.IntRange(1), 32, "Channels of a strip."),
    ("--column-width", click.IntRange(1), 48, "Channels of a column."),
    ("--seed", click.IntRange(0), 1, "Same seed, same network."),
    ("--int8/--float quantise", None, True, "Compute in eight-bit integers, or not.", {"show_default": True}),
    ("-q --quiet", None, False, "No progress bars."),
)
def train(out: Path, **options: Any) -> None:
    """Fit the auto-encoder on simulated scenes and write a model folder to OUT.

    Needs the extra `train` (PyTorch on the CPU is enough). OUT gets model.onnx, model.toml and loss.png. The data sets
    and a checkpoint of the fit are kept; the same command resumes an interrupted run.
    """
    require("training", "torch", "onnx", "matplotlib")
    from rxcli.outputs import claim_folder, claim_own_folder

    claim_folder("OUT", out)
    from rxcli.lab.training import dataset, export, fit

    data, progress = out / "data", not options["quiet"]
    claim_own_folder("OUT", out, ("model.toml",))
    claim_own_folder("OUT", data, ("frames-*", "validation"))
    shape = fit.Shape(strip_width=options["strip_width"], column_width=options["column_width"])
    recipe = fit.Recipe(shape=shape, steps=options["steps"], seed=options["seed"])
    samples = dataset.frame_samples(options["frames"], options["seed"], data, progress=progress)
    held = dataset.validation_samples(options["held_out"], data, progress=progress)
    fitted = fit.fit(samples, held, recipe, out, progress=progress)
    described = {**asdict(recipe), **{name: options[name] for name in ("frames", "held_out")}}
    described["parameters"] = fit.n_parameters(fitted.network)
    losses = dict(zip(("training_nats", "validation_nats"), fitted.history[-1][1:], strict=True))
    # A NaN of the loss where nothing was held out is written as -1.
    losses = {name: -1.0 if isnan(loss) else round(loss, 5) for name, loss in losses.items()}
    calibration = samples[:CALIBRATION_SAMPLES] if options["quantise"] else ()
    name, version = options["name"], options["model_version"]
    card = export.export_model(fitted.network, out, name, version, described, losses, calibration)
    click.echo(
        f"{out / card.file}: {described['parameters']} parameters, cross-entropy {losses['training_nats']:.4f} per "
        f"word in training, {losses['validation_nats']:.4f} on held-out scenes",
        err=True,
    )
