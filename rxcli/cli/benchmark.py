"""`vlc-rx benchmark`: error, run time, stability, calibration, unknown cameras, two checkouts, memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rxcli.cli.common import options
from rxcli.cli.groups import SuggestingGroup

if TYPE_CHECKING:
    from rxcli.lab.benchmark.confidence import Calibration
    from rxcli.lab.benchmark.journal import Journal
    from rxcli.lab.benchmark.speed import Medium
    from rxcli.lab.benchmark.sweeps import Summary

_COUNT, _SOME = click.IntRange(1), click.IntRange(0)
_FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)
_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
_RESULTS = (
    "--out",
    click.Path(file_okay=False, path_type=Path),
    Path("benchmark-results"),
    "Folder of results.",
)
_SEED = ("--seed", click.IntRange(0, 10**6), 0, "Of all random scenes.")
_QUIET = ("--quiet", None, False, "No progress bar.")
_FRESH = ("--fresh", None, False, "Forget what an earlier run has left in the journal.")
_JOBS = ("--jobs", click.IntRange(1, 256), 1, "Processes, one thread each.")
_CAE = ("--cae", ("auto", "always", "never"), "auto", "When the auto-encoder runs.")
#: Of every run that keeps a journal, and of those over many random scenes.
_RUN = (_RESULTS, _SEED, _FRESH, _QUIET)
_MANY = (_JOBS, *_RUN)


#: Commands that keep no journal.
_WITHOUT_JOURNAL = ("speed", "readers", "compare", "memory", "goodput")


def _claim(out: Path) -> None:
    """Refuse a folder of results that is somebody else's."""
    from rxcli.outputs import claim_own_folder

    claim_own_folder("--out", out, ("*.journal.jsonl", *(f"{name}.json" for name in _WITHOUT_JOURNAL)))


def _journal(out: Path, name: str, fresh: bool) -> Journal:
    from rxcli.lab.benchmark.journal import Journal

    _claim(out)
    path = out / f"{name}.journal.jsonl"
    if fresh:
        path.unlink(missing_ok=True)
    return Journal(path)


def _say_written(paths: Sequence[Path]) -> None:
    click.echo("written: " + ", ".join(str(path) for path in paths), err=True)


def _random(label: str, work: Callable[..., Any], count: int, run: dict[str, Any], **more: Any) -> list[Any]:
    """Records of `count` random scenes of one kind."""
    from rxcli.lab.benchmark.journal import run_scenes

    journal = _journal(run["out"], label, run["fresh"])
    told = {name: run[name] for name in ("seed", "jobs", "quiet")}
    return run_scenes(label, work, count, journal, **told, **more)


@click.group(cls=SuggestingGroup, invoke_without_command=True)
@options(
    ("--quick", None, False, "Print the headline table: under three minutes on two cores."),
    ("--jobs", click.IntRange(1, 256), 2, "Processes of --quick."),
    *_RUN,
)
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

    journal = _journal(out, "quick", fresh)
    headline = work.run(out / "media", journal, seed=seed, jobs=jobs, quiet=quiet)
    text = titled(headline.sections)
    click.echo(text)
    _say_written([write_text(out / "quick.txt", text + "\n")])


@benchmark.command()
@options(
    ("--frames", _COUNT, 600, "Random frames, some 20 packets each."),
    ("--clips", _COUNT, None, "Random compressed clips in place of frames, some 70 packets each."),
    _CAE,
    (
        "--also journals",
        [_FILE],
        None,
        "Count an earlier run's packets too; may be given several times.",
    ),
    *_MANY,
)
def confidence(frames: int, clips: int | None, cae: str, journals: tuple[Path, ...], **run: Any) -> None:
    """Share of error-free packets in ten bins of reported confidence."""
    from rxcli.lab.benchmark import clip_confidence, plots
    from rxcli.lab.benchmark import confidence as work
    from rxcli.lab.benchmark.journal import Journal
    from rxcli.lab.benchmark.tables import format_table, write_outputs

    earlier = [record for path in journals for record in Journal(path).records]
    packets_of = work.packets_of if clips is None else clip_confidence.packets_of
    records = _random("confidence" if clips is None else "clips", packets_of, clips or frames, run, cae=cae)
    result = work.calibration(records + earlier)
    rows = work.rows(result)
    click.echo(format_table(rows))
    click.echo("\n".join(_calibration_notes(result)))
    if clips is not None:
        click.echo(format_table(clip_confidence.rows(records)))
    paths = write_outputs(run["out"], "confidence", rows, work.details(result))
    if plots.available():
        paths.append(run["out"] / "confidence.png")
        plots.plot_confidence(result.bins, paths[-1])
    _say_written(paths)


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
    fitted = (" ".join(f"{weight:+.3f}" for weight in weights) for weights in result.weights.values())
    return lines + [f"likeliest weights of the evidence: {weights}" for weights in fitted]


@benchmark.command()
@options(("--count", _COUNT, 100, "Random phones, a picture each."), _CAE, *_MANY)
def phones(count: int, cae: str, **run: Any) -> None:
    """Simulated phones received without a camera profile: rows per slot, and wrong packets by confidence."""
    from rxcli.lab.benchmark import phones as work
    from rxcli.lab.benchmark.tables import titled, write_outputs

    records = _random("phones", work.packets_of, count, run, cae=cae)
    rows, missed = work.rows(records), work.missed(records)
    bound = f"rows per slot within {100 * work.BOUND:g} %"
    click.echo(titled([(bound, rows), ("phones further off", missed)]))
    _say_written(write_outputs(run["out"], "phones", rows, missed))


@benchmark.command()
@options(("--frames", _COUNT, 80, "Random frames of full size, some seconds each."), *_MANY)
def outline(frames: int, **run: Any) -> None:
    """Corners of found screens against the true ones: any place, size and tilt, any room and picture."""
    from rxcli.lab.benchmark import outline as work
    from rxcli.lab.benchmark.tables import format_table, write_outputs

    found = [work.found_of(record) for record in _random("outline", work.search_record, frames, run)]
    rows = work.rows(found)
    click.echo(format_table(rows))
    _say_written(write_outputs(run["out"], "outline", rows))


@benchmark.command()
@options(("--frames", _COUNT, 100, "Random frames of full size, received twice each."), *_MANY)
def screens(frames: int, **run: Any) -> None:
    """Dark and ordinary pictures received with the screen searched, and with its corners handed over."""
    from rxcli.lab.benchmark import screens as work
    from rxcli.lab.benchmark.tables import format_table, write_outputs

    rows = work.rows(_random("screens", work.packets_of, frames, run))
    click.echo(format_table(rows))
    _say_written(write_outputs(run["out"], "screens", rows))


@benchmark.command()
@options(
    ("--room", str, "receiver", "Folder or module whose numbers are moved, like receiver/screen."),
    ("--pictures", _COUNT, 8, "Random pictures, half of them dark, received for each move: about a second each."),
    *_MANY,
)
def sensitivity(room: str, pictures: int, jobs: int, out: Path, seed: int, fresh: bool, quiet: bool) -> None:
    """What hangs on each of the receiver's numbers: moved by 0.7 and by 1.4, on the same pictures."""
    from rxcli.lab.benchmark import sensitivity as work
    from rxcli.lab.benchmark.tables import format_table, write_outputs

    journal = _journal(out, "sensitivity", fresh)
    rows = work.run(room, pictures, journal, seed=seed, jobs=jobs, quiet=quiet)
    still = sum(row["changed"] == 0 for row in rows)
    click.echo(format_table(rows))
    click.echo(f"{still} of {len(rows)} numbers change no packet of {pictures} pictures")
    _say_written(write_outputs(out, "sensitivity", rows))


@benchmark.command()
@options(
    ("--clips", _COUNT, 10, "Random scenes, each filmed at every speed, some minutes each."),
    ("--frames", click.IntRange(2), 12, "Frames of a clip."),
    *_MANY,
)
def motion(clips: int, frames: int, **run: Any) -> None:
    """Clips from a hand by how fast it moves, against their frames one by one."""
    from rxcli.lab.benchmark import motion as work
    from rxcli.lab.benchmark.tables import format_table, write_outputs

    rows = work.rows(_random("motion", work.record_of, clips, run, n_frames=frames))
    click.echo(format_table(rows))
    _say_written(write_outputs(run["out"], "motion", rows))


@benchmark.command()
@options(
    ("--count", _COUNT, 100, "Pictures, every other one striped."),
    ("--camera", ("unknown", "known"), "unknown", "What the receiver is told of the camera."),
    ("--frames", _COUNT, 1, "Frames of each: clips in place of pictures."),
    *_MANY,
)
def nodata(count: int, camera: str, frames: int, **run: Any) -> int:
    """Pictures without data: dimmed screens, lamps, blinds, photographs, noise. Nothing may be reported of them.

    Exit code 1 where a packet was reported.
    """
    from rxcli.errors import ExitCode
    from rxcli.lab.benchmark import nodata as work
    from rxcli.lab.benchmark.tables import titled, write_outputs

    records = _random("nodata", work.packets_of, count, run, camera=camera, n_frames=frames)
    rows, offenders = work.rows(records), work.offenders(records)
    click.echo(titled([("pictures without data", rows), ("pictures that gave packets", offenders)]))
    _say_written(write_outputs(run["out"], "nodata", rows, offenders))
    return ExitCode.NOT_RECEIVED if offenders else ExitCode.OK


def _check_sweeps(_context: click.Context, _parameter: click.Parameter, names: tuple[str, ...]) -> tuple[str, ...]:
    from rxcli.lab.benchmark.sweeps import SWEEPS

    for name in names:
        if name not in SWEEPS:
            raise click.BadParameter(f"{name!r} is not one of {', '.join(SWEEPS)}")
    return names


@benchmark.command()
@click.option(
    "--only", multiple=True, metavar="NAME", callback=_check_sweeps, help="A sweep; may be given several times."
)
@options(("--frames", _COUNT, 12, "Frames of each point."), *_MANY)
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
@options(
    ("--repeats", _COUNT, 5, "Runs of which the quickest counts."),
    ("--medium only", [str], None, "A medium; may be given several times."),
    ("--file", _FILE, None, "A photograph or clip of your own, in place of the media; needs --camera and --screen."),
    ("--camera", str, None, "Camera profile of --file: a name or a TOML file."),
    ("--screen", str, None, "Screen profile of --file: a name or a TOML file."),
    ("--growth/--no-growth", None, True, "Also measure growth with pixels and columns."),
    *_RUN,
)
def speed(repeats: int, only: tuple[str, ...], growth: bool, out: Path, quiet: bool, **given: Any) -> None:
    """Time per stage against the bare decode, clips in times real time, peak memory, growth with size."""
    from rxcli.lab.benchmark import speed as work
    from rxcli.lab.benchmark.tables import format_table

    named = given["camera"], given["screen"]
    if given["file"] is not None:
        if None in named:
            raise click.UsageError("--file needs --camera and --screen")
        camera, screen = named
        timings = [work.time_file(given["file"], screen, camera, threads, repeats) for threads in (1, 2)]
        click.echo(format_table(work.timing_rows(timings)))
        return
    media = [medium for medium in work.MEDIA if not only or medium.name in only]
    if not media:
        raise click.BadParameter(f"no medium of that name; choose from: {', '.join(m.name for m in work.MEDIA)}")
    _claim(out)
    if given["fresh"]:
        for medium in media:
            (out / "media" / f"{medium.name}{medium.suffix}").unlink(missing_ok=True)
    _speed_of_media(media, repeats, growth, out, given["seed"], quiet)


def _speed_of_media(
    media: Sequence[Medium], repeats: int, with_growth: bool, out: Path, seed: int, quiet: bool
) -> None:
    from tqdm import tqdm

    from rxcli.lab.benchmark import plots
    from rxcli.lab.benchmark import speed as work
    from rxcli.lab.benchmark.tables import format_table, titled, write_outputs

    axes = {"megapixels": work.MEGAPIXELS, "columns": work.COLUMNS} if with_growth else {}
    with tqdm(
        total=4 * len(media) + 1 + sum(map(len, axes.values())), desc="speed", leave=False, disable=quiet or None
    ) as bar:

        def counted(value: Any) -> Any:
            bar.update()
            return value

        paths = {medium: counted(work.make_medium(medium, out / "media", seed)) for medium in media}
        timings = [counted(work.time_medium(m, path, n, repeats)) for n in (1, 2) for m, path in paths.items()]
        memory = [{"medium": m.name, **counted(work.memory_of(m, path))} for m, path in paths.items()]
        growths = [work.growth(axis, repeats, bar.update) for axis in axes]
        start_up = counted(work.start_times())
    rows = work.timing_rows(timings)
    grown = [(f"growth with {g.axis}: exponent {g.exponent:.2f}", g.as_rows()) for g in growths]
    start = [{"start": name, "ms": ms} for name, ms in start_up.items()]
    click.echo("stages as ratios to the bare decode\n" + format_table(rows) + "\n")
    click.echo(titled([("peak memory", memory), *grown, ("start", start)]))
    details = {"memory": memory, "start_ms": start_up, "growth": {g.axis: [g.x, g.ms, g.exponent] for g in growths}}
    written = write_outputs(out, "speed", rows, details)
    if growths and plots.available():
        written.append(out / "growth.png")
        plots.plot_growth(growths, written[-1])
    _say_written(written)


def _mutated_readers(n: int, seconds: float | None, out: Path, seed: int) -> int:
    from rxcli.errors import ExitCode
    from rxcli.lab.benchmark import readers as work
    from rxcli.lab.benchmark.tables import format_table, write_outputs

    _claim(out)
    first = 1_000_000 * seed
    verdict = work.run(n, first, out / "readers", seconds)
    table = work.rows(verdict)
    click.echo(format_table(table))
    click.echo(
        f"{verdict.n} cases with seeds from {first} on; exit codes {dict(sorted(verdict.codes.items()))}; slowest "
        f"{verdict.slowest_s:.1f} s (seed {verdict.slowest_seed}); at most {verdict.most_mb:.0f} MB"
    )
    _say_written(write_outputs(out, "readers", table, {"n": verdict.n, "seed": first}))
    return ExitCode.NOT_RECEIVED if verdict.problems else ExitCode.OK


@benchmark.command()
@options(("--scenes", _SOME, 10_000, "Random scenes."), *_MANY)
@click.option("--readers", type=click.IntRange(1), metavar="N", help="N mutated files and options, instead of scenes.")
@click.option("--seconds", type=click.FloatRange(1), help="With --readers: begin nothing after so long.")
def stability(
    scenes: int, jobs: int, out: Path, seed: int, fresh: bool, quiet: bool, readers: int | None, seconds: float | None
) -> int:
    """Random scenes: no exception, no warning, no NaN, no confident nonsense.

    With --readers: mutated files of all formats, truths, profiles, journals and options through the whole program: no
    internal error, no process above 1.5 GB, no case above 60 s. Exit code 1 where something was found.
    """
    if readers is not None:
        return _mutated_readers(readers, seconds, out, seed)
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
@click.argument("checkout", type=_FOLDER)
@options(
    ("--captures", _FOLDER, None, "Folder of photographs and clips.  [default: the samples]"),
    ("--scenes", _SOME, 60, "Random scenes, camera and corners handed over."),
    ("--phones", _SOME, 40, "Random phones, nothing but the corners handed over."),
    ("--repeats", _COUNT, 2, "Turns of each checkout; the least time of every file counts."),
    _RESULTS,
    _SEED,
    _QUIET,
)
def compare(checkout: Path, out: Path, **given: Any) -> int:
    """This checkout against CHECKOUT, an earlier one: the same results to the last bit? In how much time?

    Exit code 1 where a result differs.
    """
    from tqdm import tqdm

    from rxcli.errors import ExitCode
    from rxcli.lab.benchmark import compare as work
    from rxcli.lab.benchmark.tables import titled, write_outputs
    from rxcli.resources import data_dir

    other, seed = work.check_checkout(checkout), given["seed"]
    _claim(out)
    screens = work.shared_screens(other)
    jobs = work.captures((given["captures"] or data_dir("sample_frames")).resolve(), screens)
    jobs += work.random_scenes(out / "compare", given["scenes"], seed)
    jobs += work.random_phones(out / "compare", given["phones"], seed, screens)
    with tqdm(total=2 * given["repeats"], desc="compare", leave=False, disable=given["quiet"] or None) as bar:
        found = work.compare(jobs, work.this_checkout(), other, given["repeats"], bar.update)
    rows, differing = work.rows(found), work.differing(found)
    click.echo(titled([("this checkout against the other", rows), ("results that differ", differing)]))
    _say_written(write_outputs(out, "compare", rows, differing))
    return ExitCode.NOT_RECEIVED if differing else ExitCode.OK


@benchmark.command()
@options(("--frames", click.IntRange(100), 10_000, "Frames of the clip."), _RESULTS)
def memory(frames: int, out: Path) -> None:
    """Memory of `vlc-rx decode` over a long clip."""
    from rxcli.lab.benchmark import long_clip as work
    from rxcli.lab.benchmark.tables import format_table, write_outputs

    _claim(out)
    clip = work.make_clip(out / "media", frames)
    places = tuple(sorted({max(round(frames * share), 1) for share in (0.1, 0.2, 0.5, 1.0)}))
    found = work.measure(clip, places, out / "media" / "long.jsonl")
    click.echo(format_table(work.rows(found)))
    click.echo(f"{found.growth_kb:.3g} kB a frame, {found.packets} packets")
    _say_written(write_outputs(out, "memory", work.rows(found), {"growth_kb": found.growth_kb}))


@benchmark.command()
@click.option("--screen", "screens", multiple=True, default=("data-34k6",), show_default=True, help="Screen profiles.")
@click.option(
    "--picture", "pictures", multiple=True, type=click.Choice(["bright", "china"]), default=("bright", "china")
)
@click.option("--camera", "cameras", multiple=True, metavar="FPS,READOUT", help="[default: five, see docs/link.md]")
@click.option("--size", "sizes", multiple=True, type=click.IntRange(1), default=(100, 1000, 10_000, 100_000))
@click.option("--starts", type=click.IntRange(1), default=20, show_default=True, help="Random starts of each point.")
@click.option("--mother", type=click.IntRange(0, 2), default=2, show_default=True, help="0: 1/1.5, 1: 1/2, 2: 1/3.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), default=Path("benchmark-results"))
def goodput(
    screens: tuple[str, ...],
    pictures: tuple[str, ...],
    cameras: tuple[str, ...],
    sizes: tuple[int, ...],
    starts: int,
    mother: int,
    seed: int,
    out: Path,
) -> None:
    """Texts and files from clips that begin anywhere: bytes a second, byte-exact or not counted."""
    from dataclasses import replace

    from tqdm import tqdm

    from rxcli.lab.benchmark import goodput as work
    from rxcli.lab.benchmark.tables import format_table, write_outputs

    _claim(out)
    chosen = [_camera_of(text) for text in cameras] or work.CAMERAS
    grid = [replace(point, mother=mother) for point in work.points(screens, pictures, chosen, sizes)]
    bar = tqdm(grid, unit="point", leave=False, disable=None)
    rows = [work.row(point, work.measure(point, starts, seed)) for point in bar]
    click.echo(format_table(rows))
    _say_written(write_outputs(out, "goodput", rows, {"starts": starts, "seed": seed, "mother": mother}))


def _camera_of(text: str) -> tuple[float, float]:
    try:
        rate, readout = (float(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"--camera {text}: give frames a second and share read, such as 30,0.61") from None
    if not (0 < rate <= 1000 and 0 < readout <= 1):
        raise click.BadParameter(f"--camera {text}: the share read is between 0 and 1")
    return rate, readout
