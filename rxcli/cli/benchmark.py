"""`vlc-rx benchmark`: error, run time, stability, calibration, captures beside twins, folders, memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

if TYPE_CHECKING:
    from rxcli.lab.benchmark.confidence import Calibration
    from rxcli.lab.benchmark.journal import Journal
    from rxcli.lab.benchmark.sweeps import Summary

_F = TypeVar("_F", bound=Callable[..., Any])

_COMMON = (
    click.option(
        "--out",
        type=click.Path(file_okay=False, path_type=Path),
        default=Path("benchmark-results"),
        show_default=True,
        help="Folder of journals, CSV, JSON and plots.",
    ),
    click.option("--seed", type=click.IntRange(0, 10**6), default=0, show_default=True, help="Of all random scenes."),
    click.option("--fresh", is_flag=True, help="Forget what an earlier run has left in the journal."),
    click.option("--quiet", is_flag=True, help="No progress bar."),
)
_JOBS = click.option(
    "--jobs", type=click.IntRange(1, 256), default=1, show_default=True, help="Processes, one thread each."
)


def _common(command: _F) -> _F:
    for option in reversed(_COMMON):
        command = option(command)
    return command


def _journal(out: Path, name: str, fresh: bool) -> Journal:
    from rxcli.lab.benchmark.journal import Journal

    path = out / f"{name}.journal.jsonl"
    if fresh:
        path.unlink(missing_ok=True)
    return Journal(path)


def _check_sweeps(_context: click.Context, _parameter: click.Parameter, names: tuple[str, ...]) -> tuple[str, ...]:
    from rxcli.lab.benchmark.sweeps import SWEEPS

    for name in names:
        if name not in SWEEPS:
            raise click.BadParameter(f"{name!r} is not one of {', '.join(SWEEPS)}")
    return names


@click.group(invoke_without_command=True)
@click.option("--quick", is_flag=True, help="Print the headline table: under three minutes on two cores.")
@click.option("--jobs", type=click.IntRange(1, 256), default=2, show_default=True, help="Processes of --quick.")
@_common
@click.pass_context
def benchmark(context: click.Context, quick: bool, jobs: int, out: Path, seed: int, fresh: bool, quiet: bool) -> None:
    """Run time against error; stability.

    Every run keeps a journal in the folder --out and goes on where it was interrupted. Options given here belong to
    --quick; each command below has its own.
    """
    if context.invoked_subcommand is not None:
        if quick:
            raise click.UsageError("--quick stands alone, without a command", context)
        return
    if not quick:
        click.echo(context.get_help())
        return
    from rxcli.lab.benchmark import quick as work
    from rxcli.lab.benchmark.tables import titled, write_text

    headline = work.run(out / "media", _journal(out, "quick", fresh), seed=seed, jobs=jobs, quiet=quiet)
    text = titled(headline.sections)
    click.echo(text)
    _say_written([write_text(out / "quick.txt", text + "\n")])


@benchmark.command()
@click.option(
    "--frames", type=click.IntRange(1), default=600, show_default=True, help="Random frames, some 20 packets each."
)
@click.option(
    "--clips", type=click.IntRange(1), help="Random compressed clips in place of frames, some 70 packets each."
)
@click.option("--cae", type=click.Choice(["auto", "always", "never"]), default="auto", show_default=True)
@click.option(
    "--also",
    "journals",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    multiple=True,
    metavar="JOURNAL",
    help="Count the packets of an earlier run's journal too, of phones for instance; may be given several times.",
)
@_JOBS
@_common
def confidence(
    frames: int,
    clips: int | None,
    cae: str,
    journals: tuple[Path, ...],
    jobs: int,
    out: Path,
    seed: int,
    fresh: bool,
    quiet: bool,
) -> None:
    """Share of error-free packets in ten bins of reported confidence."""
    from rxcli.lab.benchmark import clip_confidence, plots
    from rxcli.lab.benchmark import confidence as work
    from rxcli.lab.benchmark.journal import Journal
    from rxcli.lab.benchmark.tables import format_table, write_outputs

    earlier = [record for path in journals for record in Journal(path).records]
    journal = _journal(out, "confidence", fresh)
    run = work.run if clips is None else clip_confidence.run
    records = run(clips or frames, journal, seed=seed, cae=cae, jobs=jobs, quiet=quiet) + earlier
    result = work.calibration(records)
    rows = work.rows(result)
    click.echo(format_table(rows))
    click.echo("\n".join(_calibration_notes(result)))
    paths = write_outputs(out, "confidence", rows, work.details(result))
    if plots.available():
        paths.append(out / "confidence.png")
        plots.plot_confidence(result.bins, paths[-1])
    _say_written(paths)


@benchmark.command()
@click.option("--count", type=click.IntRange(1), default=100, show_default=True, help="Random phones, a picture each.")
@click.option("--cae", type=click.Choice(["auto", "always", "never"]), default="auto", show_default=True)
@_JOBS
@_common
def phones(count: int, cae: str, jobs: int, out: Path, seed: int, fresh: bool, quiet: bool) -> None:
    """Simulated phones received without a camera profile: rows per slot, and wrong packets by confidence."""
    from rxcli.lab.benchmark import phones as work
    from rxcli.lab.benchmark.tables import titled, write_outputs

    records = work.run(count, _journal(out, "phones", fresh), seed=seed, cae=cae, jobs=jobs, quiet=quiet)
    rows, missed = work.rows(records), work.missed(records)
    bound = f"rows per slot within {100 * work.BOUND:g} %"
    click.echo(titled([(bound, rows), ("phones further off", missed)]))
    _say_written(write_outputs(out, "phones", rows, missed))


def _calibration_notes(result: Calibration) -> list[str]:
    from rxcli.lab.benchmark.tables import format_value

    lines = [
        f"{result.n_packets} packets of {result.n_frames} frames; calibration error {format_value(result.error)}, "
        f"Brier score {format_value(result.brier)}"
    ]
    if result.scaling:
        lines.append(
            f"likeliest scaling: logistic({result.scaling.offset:+.3f} {result.scaling.slope:+.3f} * "
            f"logit(confidence)), Brier score {format_value(result.brier_scaled)}"
        )
    if result.weights:
        lines.append("likeliest weights of the evidence: " + " ".join(f"{weight:+.3f}" for weight in result.weights))
    return lines


def _say_written(paths: Sequence[Path]) -> None:
    click.echo("written: " + ", ".join(str(path) for path in paths), err=True)


@benchmark.command()
@click.option(
    "--only", multiple=True, metavar="NAME", callback=_check_sweeps, help="A sweep; may be given several times."
)
@click.option("--frames", type=click.IntRange(1), default=12, show_default=True, help="Frames of each point.")
@_JOBS
@_common
def sweep(only: tuple[str, ...], frames: int, jobs: int, out: Path, seed: int, fresh: bool, quiet: bool) -> None:
    """Error and run time over slot rate, light, exposure, picture, tilt, camera, and the receiver's variants."""
    from rxcli.lab.benchmark import sweeps
    from rxcli.lab.benchmark.tables import format_table, write_outputs

    names = only or tuple(sweeps.SWEEPS)
    journal = _journal(out, "sweep", fresh)
    summaries = sweeps.run(sweeps.points_of(names), frames, journal, seed=seed, jobs=jobs, quiet=quiet)
    rows = [summary.as_row() for summary in summaries]
    click.echo(format_table(rows))
    paths = write_outputs(out, "sweep", rows, [summary.details() for summary in summaries])
    _say_written([*paths, *_plot_sweeps(summaries, out)])


def _plot_sweeps(summaries: Sequence[Summary], out: Path) -> list[Path]:
    from rxcli.lab.benchmark import plots, sweeps

    if not plots.available():
        return []
    paths = []
    for name in dict.fromkeys(summary.point.sweep for summary in summaries):
        mine = [summary for summary in summaries if summary.point.sweep == name]
        paths.append(out / f"sweep-{name}.png")
        plots.plot_rates(mine, paths[-1]) if name == "rate" else plots.plot_sweep(mine, paths[-1])
        if name == "variants":
            paths.append(out / "plane.png")
            plots.plot_plane(sweeps.run_time_plane(mine), paths[-1])
    return paths


@benchmark.command()
@click.option("--repeats", type=click.IntRange(1), default=5, show_default=True, help="Runs whose median counts.")
@click.option("--medium", "only", multiple=True, metavar="NAME", help="A medium; may be given several times.")
@click.option("--growth/--no-growth", default=True, help="Also measure growth with pixels and columns.")
@_common
def stages(repeats: int, only: tuple[str, ...], growth: bool, out: Path, seed: int, fresh: bool, quiet: bool) -> None:
    """Time per stage against the bare decode, peak memory, growth with pixels and columns."""
    from tqdm import tqdm

    from rxcli.lab.benchmark import plots
    from rxcli.lab.benchmark import stages as work
    from rxcli.lab.benchmark.tables import format_table, write_outputs

    media = [medium for medium in work.MEDIA if not only or medium.name in only]
    if not media:
        raise click.BadParameter(f"no medium of that name; choose from: {', '.join(m.name for m in work.MEDIA)}")
    folder = out / "media"
    steps = 4 * len(media) + 1 + growth * (len(work.MEGAPIXELS) + len(work.COLUMNS))
    with tqdm(total=steps, desc="stages", leave=False, disable=quiet or None) as bar:
        paths = {}
        for medium in media:
            if fresh:
                (folder / f"{medium.name}{medium.suffix}").unlink(missing_ok=True)
            paths[medium] = work.make_medium(medium, folder, seed)
            bar.update()
        timings = []
        for threads in (1, 2):
            for medium, path in paths.items():
                timings.append(work.time_medium(medium, path, threads, repeats))
                bar.update()
        memory = []
        for medium, path in paths.items():
            memory.append({"medium": medium.name, **work.memory_of(medium, path)})
            bar.update()
        growths = [work.growth(axis, repeats, bar.update) for axis in ("megapixels", "columns")] if growth else []
        start_up = work.help_times()
        bar.update()
    rows = work.timing_rows(timings)
    click.echo("stages as ratios to the bare one-thread decode\n" + format_table(rows))
    click.echo("\npeak memory\n" + format_table(memory))
    for one in growths:
        click.echo(f"\ngrowth with {one.axis}: exponent {one.exponent:.2f}")
        click.echo(format_table([{one.axis: x, "ms": ms} for x, ms in zip(one.x, one.ms, strict=True)]))
    click.echo("\n" + format_table([{"start": name, "ms": ms} for name, ms in start_up.items()]))
    details = {"memory": memory, "start_ms": start_up, "growth": {g.axis: [g.x, g.ms, g.exponent] for g in growths}}
    written = write_outputs(out, "stages", rows, details)
    if growths and plots.available():
        written.append(out / "growth.png")
        plots.plot_growth(growths, written[-1])
    _say_written(written)


@benchmark.command()
@click.option("--scenes", type=click.IntRange(0), default=10_000, show_default=True, help="Random scenes.")
@_JOBS
@_common
def stability(scenes: int, jobs: int, out: Path, seed: int, fresh: bool, quiet: bool) -> int:
    """Hostile values and random scenes: no exception, no warning, no NaN, no confident nonsense.

    Exit code 1 where something was found.
    """
    from rxcli.errors import ExitCode
    from rxcli.lab.benchmark import stability as work
    from rxcli.lab.benchmark.tables import format_table, format_value, write_outputs

    verdict = work.run(scenes, _journal(out, "stability", fresh), seed=seed, jobs=jobs, quiet=quiet)
    rows = work.rows(verdict)
    click.echo(format_table(rows))
    click.echo(
        f"{verdict.wrong} of {verdict.confident} packets of confidence {work.CONFIDENT} or more are wrong "
        f"({format_value(verdict.wrong_interval)}); scenes by status: {verdict.status}"
    )
    summary = {"confident": verdict.confident, "wrong": verdict.wrong, "status": verdict.status}
    _say_written(write_outputs(out, "stability", rows, summary))
    return ExitCode.OK if verdict.stable else ExitCode.NOT_RECEIVED


@benchmark.command()
@click.argument("folder", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option("--twins", type=click.IntRange(1), default=3, show_default=True, help="Simulated twins of each capture.")
@click.option(
    "--pictures",
    type=click.Path(exists=True, file_okay=False, path_type=Path),
    help="Folder of the pictures shown, NAME.png or NAME.jpg for a capture with NAME in its own.",
)
@click.option("--only", multiple=True, metavar="TEXT", help="Captures with this in their name; may be repeated.")
@_JOBS
@_common
def captures(
    folder: Path,
    twins: int,
    pictures: Path | None,
    only: tuple[str, ...],
    jobs: int,
    out: Path,
    seed: int,
    fresh: bool,
    quiet: bool,
) -> None:
    """Captures of FOLDER that have a truth beside simulated twins of them: is either easier?

    Beside both stands the bound, on the sensor's electrons and on the delivered file.
    """
    from rxcli.lab.benchmark import captures as work
    from rxcli.lab.benchmark.tables import format_table, write_outputs

    found = work.find_captures(folder, pictures)
    wanted = [one for one in found if not only or any(text in one.path.name for text in only)]
    if not wanted:
        raise click.BadParameter(f"no capture with such a name; there are: {', '.join(o.path.name for o in found)}")
    rows = work.run(wanted, twins, _journal(out, "captures", fresh), seed=seed, jobs=jobs, quiet=quiet)
    click.echo(format_table(rows))
    _say_written(write_outputs(out, "captures", rows))


@benchmark.command()
@click.option("--files", type=click.IntRange(1), default=200, show_default=True, help="Files of the folder.")
@click.option("--bad", type=click.IntRange(0), default=20, show_default=True, help="Those of them that are bad.")
@click.option("--kills", type=click.IntRange(0), default=10, show_default=True, help="Kills of each disturbed run.")
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), default=Path("benchmark-results"))
@click.option("--seed", type=click.IntRange(0, 10**6), default=0, show_default=True, help="Of scenes and moments.")
def folder(files: int, bad: int, kills: int, out: Path, seed: int) -> int:
    """A folder of good and bad files, decoded undisturbed and by runs killed at random moments and resumed.

    Exit code 1 unless all good files give packets, all bad ones a reason, and all runs the same results.
    """
    from rxcli.errors import ExitCode
    from rxcli.lab.benchmark import folder as work
    from rxcli.lab.benchmark.tables import format_table, write_outputs

    if bad >= files:
        raise click.BadParameter(f"--bad must be below --files, {files} (got {bad})")
    contents = work.make_folder(out / f"folder-{files}-{bad}-{seed}", files - bad, bad, seed)
    outcomes = work.run(contents, out / "folder-runs", kills, seed)
    rows = [outcome.as_row() for outcome in outcomes]
    reasons = work.reasons(contents, out / "folder-runs")
    click.echo(format_table(rows) + "\n\n" + format_table(reasons))
    _say_written(write_outputs(out, "folder", rows, reasons))
    return ExitCode.OK if work.passed(contents, outcomes) else ExitCode.NOT_RECEIVED


@benchmark.command()
@click.option("--frames", type=click.IntRange(100), default=10_000, show_default=True, help="Frames of the clip.")
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), default=Path("benchmark-results"))
def memory(frames: int, out: Path) -> None:
    """Memory of `vlc-rx decode` over a long clip."""
    from rxcli.lab.benchmark import long_clip as work
    from rxcli.lab.benchmark.tables import format_table, write_outputs

    clip = work.make_clip(out / "media", frames)
    places = tuple(sorted({max(round(frames * share), 1) for share in (0.1, 0.2, 0.5, 1.0)}))
    found = work.measure(clip, places, out / "media" / "long.jsonl")
    click.echo(format_table(work.rows(found)))
    click.echo(f"{found.growth_kb:.3g} kB a frame, {found.packets} packets")
    _say_written(write_outputs(out, "memory", work.rows(found), {"growth_kb": found.growth_kb}))
