"""`vlc-rx benchmark`: a scenario received and counted, the headline, two checkouts."""

from pathlib import Path
from typing import Any

import click
import msgspec

from rxcli.cli.common import field_table, options
from rxcli.cli.groups import SuggestingGroup
from rxcli.cli.kinds import FOLDER
from rxcli.errors import ExitCode
from rxcli.lab.benchmark import compare as checkouts
from rxcli.lab.benchmark import measures, tables
from rxcli.lab.benchmark import quick as headline
from rxcli.lab.benchmark.cases import OTHER_KERNEL, TWIN, WAYS
from rxcli.lab.benchmark.draw import People
from rxcli.lab.benchmark.runner import Run, Scenario, capture_points, labels_by_field, load_journal, scenarios
from rxcli.outputs import claim_own_folder, write_whole

_COUNT = click.IntRange(1)
_FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)
_FILE = click.Path(exists=True, dir_okay=False, path_type=Path)
_OUT = ("--out", FOLDER, Path("benchmark-results"), "Folder of results.")
_SEED = ("--seed", click.IntRange(0, 10**6), 0, "Of all random scenes.")
_COUNTED = ("--count", _COUNT, None, "Numbers to draw at each point.  [default: the scenario's]")
_CAPTURES = ("--folder captures", _FOLDER, None, "Of `captures` and `files`: where they lie.  [default: the samples]")
_OVER = ("--over", str, None, "Of `files`: rows by this field of a CSV beside the captures, or of their metadata.")
_ONLY = ("--only", [str], None, "A point of the scenario; may be given several times.")
_SET = ("--set fields", [str], None, "A field of every point, as exposure_slots=[3,6]; may be given several times.")
_QUIET = ("--quiet", None, False, "No progress bar.")
_RUN = (("--jobs", click.IntRange(1, 256), 1, "Processes, one thread each."), _OUT, _SEED, _QUIET)


class _Scenarios(SuggestingGroup):
    """A command for every row of the table of scenarios."""

    def list_commands(self, context: click.Context) -> list[str]:
        return [*(name for name in scenarios() if name != "quick"), *super().list_commands(context)]

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        if name not in scenarios():
            return super().get_command(context, name)
        command = click.pass_context(_run_scenario)
        for row in (_COUNTED, _CAPTURES, _OVER, _ONLY, _SET, *_RECEPTION, *_RUN):
            command = options(row)(command)
        return click.command(name, help=scenarios()[name].about, short_help=scenarios()[name].about)(command)


_RECEPTION = (
    ("--way ways", [str], None, "A way to receive in place of the scenario's; may be given several times."),
    ("--cae", ("auto", "always", "never"), None, "When the auto-encoder runs."),
    ("--save", FOLDER, None, "Also write the drawn captures into this folder."),
    ("--also journals", [_FILE], None, "Count an earlier run's packets in the bins, too; may be given several times."),
)


def _begin(name: str, out: Path, jobs: int, quiet: bool) -> Run:
    """A run that keeps its journal in the folder of results."""
    claim_own_folder("--out", out, ("*.journal.jsonl",))
    return Run(out / f"{name}.journal.jsonl", jobs, quiet)


def _chosen(
    name: str, captures: Path | None, only: tuple[str, ...], fields: tuple[str, ...] = (), ways: tuple[str, ...] = ()
) -> Scenario:
    """The scenario of this name, with the points, their fields and the ways that were asked for."""
    scenario = scenarios()[name]
    points = capture_points(captures) if scenario.draw == "capture" else scenario.points
    for known, asked in ((points, only), ((*WAYS, OTHER_KERNEL, TWIN), ways)):
        for choice in asked:
            if choice not in known:
                raise click.BadParameter(f"{choice!r} is not one of {', '.join(known)}")
    fixed = {name: value for text in fields for name, value in field_table(text).items()}
    points = {label: point | fixed for label, point in points.items() if not only or label in only}
    if fixed and scenario.draw != "people":
        raise click.BadParameter(f"{name} draws no population: its fields are fixed", param_hint="--set")
    try:
        _ = [msgspec.convert(scenario.base | point, People) for point in points.values() if fixed]
    except msgspec.ValidationError as error:
        raise click.BadParameter(str(error), param_hint="--set") from None
    ways = ways or scenario.ways
    beside = scenario.beside if scenario.beside in ways else None
    return msgspec.structs.replace(scenario, points=points, ways=ways, beside=beside)


def _run_scenario(context: click.Context, /, journals: tuple[Path, ...], **given: Any) -> int:
    name, out = str(context.info_name), given["out"]
    scenario = _chosen(name, given["captures"], given["only"], given["fields"], given["ways"])
    if given["over"]:
        if scenario.draw != "capture":
            raise click.BadParameter(f"{name} receives no files of yours", param_hint="--over")
        labels = labels_by_field(scenario.points, given["captures"], given["over"])
        over = {file: scenario.points[file] | {"label": label} for file, label in labels.items()}
        scenario = msgspec.structs.replace(scenario, points=over, columns=measures.BY_FIELD)
    run = _begin(name, out, given["jobs"], given["quiet"])
    more = {"save": str(given["save"])} if given["save"] else {}
    count = given["count"] or scenario.count
    tasks = scenario.tasks(given["seed"], count, out / "media", cae=given["cae"], **more)
    records = run(tasks, name, alone=scenario.alone)
    rows = measures.rows(records, scenario.ways, scenario.all_columns, scenario.beside)
    odd = measures.worth_a_look(records, scenario.ways)
    click.echo(tables.titled([(scenario.about, rows), *([("worth a look", odd)] if odd else [])]))
    details: dict[str, Any] = {"worth_a_look": odd}
    if scenario.bins:
        earlier = [record for path in journals for some in load_journal(path).values() for record in some]
        packets = measures.Group([*records, *earlier], scenario.ways[0], scenario.ways[0]).packets
        bins, error = measures.calibration(packets)
        details |= {"bins": bins, "weights": measures.fitted_weights(packets)}
        click.echo(f"\n{tables.titled([(f'{len(packets)} packets, calibration error {error:.3g}', bins)])}")
        for weights in details["weights"].values():
            click.echo("likeliest weights of the features: " + " ".join(f"{weight:+.3f}" for weight in weights))
        tables.plot(bins, out / f"{name}-bins.png", "error_free", "interval95", "confidence")
    points = [row for row in rows if any(row["scenes"] == task["label"] for task in tasks)]
    for measure in ("ber", "share", "lost_share", "kbps"):
        if points and f"{measure}95" in points[0]:
            tables.plot(points, out / f"{name}-{measure}.png", measure, f"{measure}95")
    written = tables.write_outputs(out, name, rows, details)
    plotted = measures.error_over_time(records, scenario.ways) if scenario.draw == "capture" else {}
    if plotted and all(plotted.values()):
        written += tables.plot_error_over_time(plotted, out / f"{name}-error-over-time")
    _say_written(written)
    return ExitCode.OK if measures.passes(records, scenario.ways) else ExitCode.NOT_RECEIVED


def _say_written(paths: list[Path]) -> None:
    click.echo("written: " + ", ".join(str(path) for path in paths), err=True)


@click.group(cls=_Scenarios, invoke_without_command=True)
@options(("--quick", None, False, "Print the headline table: under three minutes on two cores."), *_RUN)
@click.pass_context
def benchmark(context: click.Context, /, quick: bool, seed: int, **run: Any) -> None:
    """Scenes received and counted: packets, error, confidence, run time.

    Every run keeps a journal in the folder --out and goes on where it was interrupted. The exit code is 1 where a
    reception raised or warned, a picture without data gave packets, or packets of confidence 0.99 are wrong more often
    than that. Options given here belong to --quick.
    """
    if context.invoked_subcommand is not None:
        if quick:
            raise click.UsageError("--quick stands alone, without a command", context)
        return
    if not quick:
        click.echo(context.get_help())
        return

    text = tables.titled(headline.run(_begin("quick", **run), seed, run["out"] / "media"))
    click.echo(text)
    write_whole(run["out"] / "quick.txt", text + "\n")
    _say_written([run["out"] / "quick.txt"])


@benchmark.command()
@click.argument("checkout", type=_FOLDER)
@click.argument("name", default="captures")
@options(("--repeats", _COUNT, 2, "Turns of each checkout; the least time of every file counts."))
@options(_COUNTED, _CAPTURES, _ONLY, _OUT, _SEED, _QUIET)
def compare(checkout: Path, name: str, out: Path, **given: Any) -> int:
    """Hold this checkout against CHECKOUT. The cases are those of scenario NAME.

    Exit code 1 where a result differs.
    """
    from tqdm import tqdm

    if name not in scenarios() or scenarios()[name].draw == "transfer":
        raise click.BadParameter(f"{name!r} is no scenario with pictures")
    scenario, reference = _chosen(name, given["captures"], given["only"]), checkouts.check_checkout(checkout)
    claim_own_folder("--out", out, ("*.journal.jsonl", "compare.json"))
    tasks = scenario.tasks(given["seed"], given["count"] or scenario.count, out / "media")
    with tqdm(total=2 * given["repeats"], desc="compare", leave=False, disable=given["quiet"] or None) as bar:
        records = checkouts.compare(tasks, reference, out / "compare", given["repeats"], bar.update)
    rows, differing = measures.rows(records, checkouts.WAYS, checkouts.COLUMNS), checkouts.differing(records)
    click.echo(tables.titled([("this checkout against the other", rows), ("results that differ", differing)]))
    _say_written(tables.write_outputs(out, "compare", rows, differing))
    return ExitCode.NOT_RECEIVED if differing else ExitCode.OK
