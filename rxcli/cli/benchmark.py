"""`vlc-rx benchmark`: error, run time, stability, calibration, unknown cameras, two checkouts, memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rxcli.cli.common import options
from rxcli.cli.groups import SuggestingGroup

if TYPE_CHECKING:
    from rxcli.lab.benchmark.confidence import Calibration
    from rxcli.lab.benchmark.journal import Run
    from rxcli.lab.benchmark.speed import Medium
    from rxcli.lab.benchmark.sweeps import Summary
    from rxcli.lab.benchmark.tables import Row

_COUNT, _SOME = click.IntRange(1), click.IntRange(0)
_FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)
_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
_RESULTS = ("--out", click.Path(file_okay=False, path_type=Path), Path("benchmark-results"), "Folder of results.")
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


def _begin(name: str, out: Path, fresh: bool, **how: Any) -> Run:
    """A run that keeps its journal in the folder of results."""
    from rxcli.lab.benchmark.journal import Journal, Run

    _claim(out)
    path = out / f"{name}.journal.jsonl"
    if fresh:
        path.unlink(missing_ok=True)
    return Run(Journal(path), **how)


def _say_written(paths: Sequence[Path]) -> None:
    click.echo("written: " + ", ".join(str(path) for path in paths), err=True)


def _report(
    out: Path, name: str, rows: Sequence[Row], details: Any = None, said: str = "", titles: Sequence[str] = ()
) -> list[Path]:
    """Print a table, and write it with its details; returns the files.

    Args:
        out: folder of results.
        name: of the files.
        rows: the table.
        details: what the JSON holds beside it.
        said: printed below it.
        titles: of the table and of the details, where these are printed as another one.
    """
    from rxcli.lab.benchmark.tables import format_table, titled, write_outputs

    click.echo(titled(zip(titles, (rows, details), strict=True)) if titles else format_table(rows))
    if said:
        click.echo(said)
    return write_outputs(out, name, rows, details)


@click.group(cls=SuggestingGroup, invoke_without_command=True)
@options(
    ("--quick", None, False, "Print the headline table: under three minutes on two cores."),
    ("--jobs", click.IntRange(1, 256), 2, "Processes of --quick."),
    *_RUN,
)
@click.pass_context
def benchmark(context: click.Context, /, quick: bool, **run: Any) -> None:
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

    text = titled(work.run(run["out"] / "media", _begin("quick", **run)))
    click.echo(text)
    _say_written([write_text(run["out"] / "quick.txt", text + "\n")])


@benchmark.command()
@options(
    ("--frames", _COUNT, 600, "Random frames, some 20 packets each."),
    ("--clips", _COUNT, None, "Random compressed clips in place of frames, some 70 packets each."),
    _CAE,
    ("--also journals", [_FILE], None, "Count an earlier run's packets too; may be given several times."),
    *_MANY,
)
def confidence(frames: int, clips: int | None, cae: str, journals: tuple[Path, ...], **run: Any) -> None:
    """Share of error-free packets in ten bins of reported confidence."""
    from rxcli.lab.benchmark import clip_confidence, plots
    from rxcli.lab.benchmark import confidence as work
    from rxcli.lab.benchmark.journal import Journal
    from rxcli.lab.benchmark.tables import format_table

    earlier = [record for path in journals for record in Journal(path).records]
    packets_of = work.packets_of if clips is None else clip_confidence.packets_of
    label = "confidence" if clips is None else "clips"
    records = _begin(label, **run).scenes(label, packets_of, clips or frames, cae=cae)
    result = work.calibration(records + earlier)
    said = _calibration_notes(result)
    if clips is not None:
        said.append(format_table(clip_confidence.rows(records)))
    paths = _report(run["out"], "confidence", work.rows(result), work.details(result), "\n".join(said))
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

    records = _begin("phones", **run).scenes("phones", work.packets_of, count, cae=cae)
    titles = (f"rows per slot within {100 * work.BOUND:g} %", "phones further off")
    _say_written(_report(run["out"], "phones", work.rows(records), work.missed(records), titles=titles))


@benchmark.command()
@options(("--frames", _COUNT, 80, "Random frames of full size, some seconds each."), *_MANY)
def outline(frames: int, **run: Any) -> None:
    """Corners of found screens against the true ones: any place, size and tilt, any room and picture."""
    from rxcli.lab.benchmark import outline as work

    records = _begin("outline", **run).scenes("outline", work.search_record, frames)
    _say_written(_report(run["out"], "outline", work.rows(records)))


@benchmark.command()
@options(("--frames", _COUNT, 100, "Random frames of full size, received twice each."), *_MANY)
def screens(frames: int, **run: Any) -> None:
    """Dark and ordinary pictures received with the screen searched, and with its corners handed over."""
    from rxcli.lab.benchmark import screens as work

    records = _begin("screens", **run).scenes("screens", work.packets_of, frames)
    _say_written(_report(run["out"], "screens", work.rows(records)))


@benchmark.command()
@options(
    ("--room", str, "receiver", "Folder or module whose numbers are moved, like receiver/screen."),
    ("--pictures", _COUNT, 8, "Random pictures, half of them dark, received for each move: about a second each."),
    *_MANY,
)
def sensitivity(room: str, pictures: int, **run: Any) -> None:
    """What hangs on each of the receiver's numbers: moved by 0.7 and by 1.4, on the same pictures."""
    from rxcli.lab.benchmark import sensitivity as work

    rows = work.run(room, pictures, _begin("sensitivity", **run))
    still = sum(row["changed"] == 0 for row in rows)
    said = f"{still} of {len(rows)} numbers change no packet of {pictures} pictures"
    _say_written(_report(run["out"], "sensitivity", rows, said=said))


@benchmark.command()
@options(
    ("--clips", _COUNT, 10, "Random scenes, each filmed at every speed, some minutes each."),
    ("--frames", click.IntRange(2), 12, "Frames of a clip."),
    *_MANY,
)
def motion(clips: int, frames: int, **run: Any) -> None:
    """Clips from a hand by how fast it moves, against their frames one by one."""
    from rxcli.lab.benchmark import motion as work

    records = _begin("motion", **run).scenes("motion", work.record_of, clips, n_frames=frames)
    _say_written(_report(run["out"], "motion", work.rows(records)))


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

    records = _begin("nodata", **run).scenes("nodata", work.packets_of, count, camera=camera, n_frames=frames)
    offenders = work.offenders(records)
    titles = ("pictures without data", "pictures that gave packets")
    _say_written(_report(run["out"], "nodata", work.rows(records), offenders, titles=titles))
    return ExitCode.NOT_RECEIVED if offenders else ExitCode.OK


def _check_sweeps(_context: click.Context, _parameter: click.Parameter, names: tuple[str, ...]) -> tuple[str, ...]:
    from rxcli.lab.benchmark.sweeps import SWEEPS

    for name in names:
        if name not in SWEEPS:
            raise click.BadParameter(f"{name!r} is not one of {', '.join(SWEEPS)}")
    return names


@benchmark.command()
@options(
    ("--only", [str], None, "A sweep; may be given several times.", {"metavar": "NAME", "callback": _check_sweeps}),
)
@options(("--frames", _COUNT, 12, "Frames of each point."), *_MANY)
def sweep(only: tuple[str, ...], frames: int, **run: Any) -> None:
    """Error and run time over slot rate, light, exposure, picture, tilt, camera, and the receiver's variants."""
    from rxcli.lab.benchmark import sweeps

    summaries = sweeps.run(sweeps.points_of(only or sweeps.SWEEPS), frames, _begin("sweep", **run))
    rows, details = [summary.as_row() for summary in summaries], [summary.details() for summary in summaries]
    paths = _report(run["out"], "sweep", rows, details)
    _say_written([*paths, *_plot_sweeps(summaries, run["out"])])


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

    _claim(out)
    first = 1_000_000 * seed
    verdict = work.run(n, first, out / "readers", seconds)
    said = (
        f"{verdict.n} cases with seeds from {first} on; exit codes {dict(sorted(verdict.codes.items()))}; slowest "
        f"{verdict.slowest_s:.1f} s (seed {verdict.slowest_seed}); at most {verdict.most_mb:.0f} MB"
    )
    _say_written(_report(out, "readers", work.rows(verdict), {"n": verdict.n, "seed": first}, said))
    return ExitCode.NOT_RECEIVED if verdict.problems else ExitCode.OK


@benchmark.command()
@options(("--scenes", _SOME, 10_000, "Random scenes."), *_MANY)
@options(
    ("--readers=N", click.IntRange(1), None, "N mutated files and options, instead of scenes."),
    ("--seconds", click.FloatRange(1), None, "With --readers: begin nothing after so long."),
)
def stability(scenes: int, readers: int | None, seconds: float | None, **run: Any) -> int:
    """Random scenes: no exception, no warning, no NaN, no confident nonsense.

    With --readers: mutated files of all formats, truths, profiles, journals and options through the whole program: no
    internal error, no process above 1.5 GB, no case above 60 s. Exit code 1 where something was found.
    """
    if readers is not None:
        return _mutated_readers(readers, seconds, run["out"], run["seed"])
    from rxcli.errors import ExitCode
    from rxcli.lab.benchmark import stability as work
    from rxcli.lab.benchmark.tables import format_value

    verdict = work.run(scenes, _begin("stability", **run))
    said = (
        f"{verdict.wrong} of {verdict.confident} packets of confidence {work.CONFIDENT} or more are wrong "
        f"({format_value(verdict.wrong_interval)}); scenes by status: {verdict.status}"
    )
    summary = {"confident": verdict.confident, "wrong": verdict.wrong, "status": verdict.status}
    _say_written(_report(run["out"], "stability", work.rows(verdict), summary, said))
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
    from rxcli.resources import data_dir

    other, seed = work.check_checkout(checkout), given["seed"]
    _claim(out)
    screens = work.shared_screens(other)
    jobs = work.captures((given["captures"] or data_dir("sample_frames")).resolve(), screens)
    jobs += work.random_scenes(out / "compare", given["scenes"], seed)
    jobs += work.random_phones(out / "compare", given["phones"], seed, screens)
    with tqdm(total=2 * given["repeats"], desc="compare", leave=False, disable=given["quiet"] or None) as bar:
        found = work.compare(jobs, work.this_checkout(), other, given["repeats"], bar.update)
    differing = work.differing(found)
    titles = ("this checkout against the other", "results that differ")
    _say_written(_report(out, "compare", work.rows(found), differing, titles=titles))
    return ExitCode.NOT_RECEIVED if differing else ExitCode.OK


@benchmark.command()
@options(("--frames", click.IntRange(100), 10_000, "Frames of the clip."), _RESULTS)
def memory(frames: int, out: Path) -> None:
    """Memory of `vlc-rx decode` over a long clip."""
    from rxcli.lab.benchmark import long_clip as work

    _claim(out)
    clip = work.make_clip(out / "media", frames)
    places = tuple(sorted({max(round(frames * share), 1) for share in (0.1, 0.2, 0.5, 1.0)}))
    found = work.measure(clip, places, out / "media" / "long.jsonl")
    said = f"{found.growth_kb:.3g} kB a frame, {found.packets} packets"
    _say_written(_report(out, "memory", work.rows(found), {"growth_kb": found.growth_kb}, said))


@benchmark.command()
@options(
    ("--screen screens", [str], None, "Screen profiles.", {"default": ("data-34k6",), "show_default": True}),
    ("--picture pictures", [click.Choice(["bright", "china"])], None, None, {"default": ("bright", "china")}),
    ("--camera=FPS,READOUT cameras", [str], None, "[default: five, see docs/link.md]"),
    ("--size sizes", [click.IntRange(1)], None, None, {"default": (100, 1000, 10000, 100000)}),
    ("--starts", click.IntRange(1), 20, "Random starts of each point."),
    ("--mother", click.IntRange(0, 2), 2, "0: 1/1.5, 1: 1/2, 2: 1/3."),
    ("--seed", click.IntRange(0), 0, None),
    ("--out", click.Path(file_okay=False, path_type=Path), Path("benchmark-results"), None, {"show_default": False}),
)
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

    _claim(out)
    chosen = [_camera_of(text) for text in cameras] or work.CAMERAS
    grid = [replace(point, mother=mother) for point in work.points(screens, pictures, chosen, sizes)]
    bar = tqdm(grid, unit="point", leave=False, disable=None)
    rows = [work.row(point, work.measure(point, starts, seed)) for point in bar]
    _say_written(_report(out, "goodput", rows, {"starts": starts, "seed": seed, "mother": mother}))


def _camera_of(text: str) -> tuple[float, float]:
    try:
        rate, readout = (float(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"--camera {text}: give frames a second and share read, such as 30,0.61") from None
    if not (0 < rate <= 1000 and 0 < readout <= 1):
        raise click.BadParameter(f"--camera {text}: the share read is between 0 and 1")
    return rate, readout
