"""`vlc-rx decode`: photos, RAW files, clips and folders."""

from __future__ import annotations

import json
import logging
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from rxcli.cli.common import (
    claim_outputs,
    force_argument,
    options,
    receiver_arguments,
    receiver_options,
)
from rxcli.cli.kinds import FILE, FOLDER, SHARE, complete_files
from rxcli.cli.printing import JsonLines, Progress, Table, Writer, print_line, print_text
from rxcli.errors import ExitCode, InputError, ReceiverError, UsageError, worst

if TYPE_CHECKING:
    from rxcli.outputs import Output, Taken
    from rxcli.results.baseline import Baseline
    from rxcli.results.summary import SourceSummary
    from rxcli.results.truth import Scorer
    from rxcli.runs.batch import Decoded, Decoder, Source
    from rxcli.runs.journal import Head, Journal
    from rxcli.types import FrameResult

log = logging.getLogger(__name__)
#: Options that change nothing of a source's results: where they go, who decodes, what is asked of them.
_NO_MATTER = frozenset(
    {
        *("json_path", "junit", "summary", "save_camera", "dump_dir", "save_undistorted", "quiet", "force", "resume"),
        *("workers", "cluster", "max_ber", "min_packets", "min_packet_confidence"),
        *("baseline", "slower", "out", "payloads", "packets"),
    }
)
#: The source that is read from stdin.
STDIN = "-"


@click.command()
@click.argument("paths", nargs=-1, required=True, metavar="PATH...", shell_complete=complete_files)
@receiver_arguments
@options(
    ("--json=FILE|- json_path", str, None, "Write one JSON object a frame, instead of the table."),
    ("--truth=FILE|auto", str, None, "Score against this truth, or the NAME.truth.json beside each file."),
    ("--max-ber", SHARE, None, "Fail a file whose bit error rate is above (needs --truth)."),
    ("--min-packets", click.IntRange(1), 1, "Fail a file with fewer packets of --min-confidence (0.5 if not given)."),
    ("--baseline=FILE", FILE, None, "Fail a file that lost packets, or is slower, since this --json run."),
    ("--slower", click.FloatRange(1), 1.5, "How many times as long as in the --baseline a file may take."),
    ("--min-packet-confidence", SHARE, None, "Fail a file with a packet of lower confidence, which is still reported."),
    ("--junit", FILE, None, "Write one JUnit test case per file."),
    ("--summary", FILE, None, "Write one row per file, as .csv or .parquet."),
    ("--resume", None, False, "Go on with the run that wrote the file of --json."),
    ("--workers", click.IntRange(1), 1, "Decode in this many processes.", {"envvar": "VLC_RX_WORKERS"}),
    ("--cluster=ADDRESS", str, None, "Decode on the Dask cluster whose scheduler is at this address."),
    ("--dump-dir", FOLDER, None, "Write the arrays of every stage boundary into this folder."),
    ("--save-undistorted", FOLDER, None, "Write every frame without its lens distortion into this folder."),
    ("--save-camera", FILE, None, "Write what was estimated of an unknown camera as a profile (TOML)."),
    ("--stop-when-certain", None, False, "Pass over frames of a clip all of whose packets are certain already."),
    ("--out", FOLDER, None, "Write files that came whole into this folder, under their own names."),
    ("--packets", None, False, "Show every packet of a clip, not only its sum."),
    ("--payloads", FILE, None, "Write one row a packet (CSV): where it is from, bits, hex, confidence."),
    ("--quiet", None, False, "No table, no summary, no progress; only why a file failed."),
)
@force_argument
def decode(paths: tuple[str, ...], **options: Any) -> int:
    """Decode photos, RAW files and clips; PATH may be a folder, or - for one picture on stdin."""
    _check(paths, options)
    log.info("paths: %s", ", ".join(paths))
    from rxcli.runs.batch import standard_decoder

    more = {name: options[name] for name in ("dump_dir", "stop_when_certain")}
    configured = receiver_options(options, **more, soft_bits=True)
    tap, after = None, None
    if options["save_undistorted"]:
        from rxcli.results.undistort import UndistortedWriter

        folder = Path(options["save_undistorted"]).absolute()
        tap = UndistortedWriter(folder, configured.cameras, configured.force_camera)
        after = tap.finish
    sources = _sources(paths)
    taken = _claim(options, sources)
    with _stdin_as_file(sources) as sources:
        return _Run(standard_decoder(configured, tap, after), options, taken).run(sources)


def _check(paths: tuple[str, ...], options: dict[str, Any]) -> None:
    """Refuse what makes no sense before the long work starts."""
    from rxcli.results.summary import check_summary_path

    json_file = options["json_path"] not in (None, "-")
    if options["resume"] and not json_file:
        raise UsageError("--resume needs the file that --json wrote", "give --json FILE")
    if options["resume"] and STDIN in paths:
        raise UsageError("--resume cannot tell whether stdin is what it was", "name the file")
    if options["max_ber"] is not None and not options["truth"]:
        raise UsageError("--max-ber needs the truth", "give --truth FILE, or --truth auto")
    if options["cluster"] is not None and not options["cluster"].strip():
        raise UsageError("--cluster needs the address of a Dask scheduler (got none)", "name it: tcp://host:8786")
    if options["cluster"] and options["workers"] > 1:
        raise UsageError("--workers and --cluster exclude each other", "give one of them")
    if options["cluster"] and "-" in paths:
        raise UsageError("stdin cannot be sent to a cluster", "name a file that its workers see")
    if options["summary"]:
        check_summary_path(options["summary"])


def _claim(options: dict[str, Any], sources: list[Source]) -> Taken:
    """Refuse outputs that would destroy something, and make the folders of the taps; returns the files of the run."""
    from rxcli.outputs import claim_folder
    from rxcli.results.truth import truth_for

    truths = [truth_for(source.name, options["truth"]) for source in sources]
    inputs = [source.path for source in sources] + [str(path) for path in truths if path is not None]
    taken = claim_outputs(_outputs(options), inputs, (*options["screens"], *options["cameras"]), options["force"])
    for name in ("dump_dir", "save_undistorted", "out"):
        if options[name] is not None:
            claim_folder("--" + name.replace("_", "-"), options[name])
    for name in ("dump_dir", "save_undistorted"):
        both = options[name] and options["out"]
        if both and options["out"].resolve().is_relative_to(options[name].resolve()):
            option = "--" + name.replace("_", "-")
            raise UsageError(f"--out {options['out']}: {option} writes there", "name a folder for received files alone")
    return taken


def _outputs(options: dict[str, Any]) -> Iterator[Output]:
    """Every file that the run will write."""
    from rxcli import outputs

    summary = options["summary"]
    is_table = summary is not None and summary.suffix.casefold() == ".csv"
    looks = {
        # Resuming looks closer, and knows half lines.
        "json": outputs.ANYTHING if options["resume"] else outputs.JOURNAL,
        "junit": outputs.JUNIT,
        "summary": outputs.CSV_SUMMARY if is_table else outputs.PARQUET_SUMMARY,
        "save_camera": outputs.ESTIMATED_CAMERA,
        "payloads": outputs.PAYLOADS,
    }
    paths = {**options, "json": None if options["json_path"] == "-" else options["json_path"]}
    for name, ours in looks.items():
        if paths[name] is not None:
            kept = name == "json" and not options["resume"]
            way_on = "go on with it by --resume, replace it with --force, or name another file" if kept else None
            yield outputs.Output("--" + name.replace("_", "-"), Path(paths[name]), ours, way_on=way_on)


def _sources(paths: tuple[str, ...]) -> list[Source]:
    from rxcli.ingest import KNOWN_SUFFIXES
    from rxcli.runs.batch import collect_sources

    return collect_sources(paths, frozenset(KNOWN_SUFFIXES))


@contextmanager
def _stdin_as_file(sources: list[Source]) -> Iterator[list[Source]]:
    """The sources, with what comes from stdin put into a file for as long as it is needed."""
    from tempfile import NamedTemporaryFile

    if all(source.name != STDIN for source in sources):
        yield sources
        return
    if sys.stdin is None:
        raise InputError("stdin is closed", "name a file instead of -")
    with ExitStack() as stack:
        try:
            file = stack.enter_context(NamedTemporaryFile(prefix="vlc-rx-"))
            shutil.copyfileobj(sys.stdin.buffer, file)
            file.flush()
        except OSError as error:
            reason = f"stdin: cannot be kept in a temporary file ({error.strerror or error})"
            raise InputError(reason, "make room, or set TMPDIR to another folder") from None
        yield [replace(source, path=file.name) if source.name == STDIN else source for source in sources]


class _Run:
    """One run over many sources: where results go, and what is kept for the summary."""

    def __init__(self, decoder: Decoder, options: dict[str, Any], taken: Taken) -> None:
        from rxcli.link.collector import PhotoCollector
        from rxcli.results.summary import Limits

        self._decoder = decoder
        self._options = options
        self._taken = taken
        self._baseline = _baseline(options)
        self._limits = Limits(options["max_ber"], options["min_packets"], options["min_packet_confidence"])
        self._summaries: list[SourceSummary] = []
        self._to_stdout = options["json_path"] == "-"
        self._photos = PhotoCollector(decoder.link_screens, decoder.file_memory_mb)
        self._write_payloads: Callable[[FrameResult], None] = lambda result: None
        #: The frame with the most packets of those whose camera was estimated.
        self._estimated: FrameResult | None = None
        #: Name of a source -> where it is opened.
        self._paths: dict[str, str] = {}
        self._output = Writer()

    def run(self, sources: list[Source]) -> ExitCode:
        from rxcli.results.summary import exit_code

        if self._options["truth"] not in (None, "auto") and len(sources) != 1:
            raise UsageError(
                f"--truth {self._options['truth']} is the truth of one file ({len(sources)} were given)",
                "give --truth auto, which takes the NAME.truth.json beside each file",
            )
        self._paths = {source.name: source.path for source in sources}
        with ExitStack() as stack:
            journal = self._journal(stack)
            self._write_payloads = self._payloads(stack)
            done = self._recover(journal) if journal is not None and self._options["resume"] else set()
            self._output = writer = self._writer(journal, begun=bool(done))
            try:
                self._decode([source for source in sources if source.name not in done], writer, len(sources))
            except BaseException:
                with suppress(OSError):
                    self._conclude(sources)  # what it cannot write is told; why the run ended says more
                raise
        self._add_missing()
        return worst([*self._conclude(sources), exit_code(self._summaries, self._limits)])

    def _recover(self, journal: Journal) -> set[str]:
        """Take the results of an earlier run into the summary; returns the names of its complete sources."""
        done = set()
        for name, results in journal.recover(self._head(), self._files()):
            summary, scorer = self._begin(name)
            for result in results:
                summary.add(scorer.add(result) if scorer else result)
                if self._baseline is not None:
                    self._baseline.add(result)
                self._write_payloads(result)
            self._end(summary, scorer)
            done.add(name)
        return done

    def _journal(self, stack: ExitStack) -> Journal | None:
        """The file of --json, locked."""
        from rxcli.runs.journal import Journal

        path = self._options["json_path"]
        if path is None or self._to_stdout:
            return None
        return stack.enter_context(closing(Journal(Path(path), self._options["resume"])))

    def _files(self) -> dict[str, str]:
        return {name: path for name, path in self._paths.items() if name != STDIN}

    def _head(self) -> Head:
        """What the results depend on: the version, the options, what the profiles hold."""
        from rxcli import __version__
        from rxcli.runs.journal import Head

        given = {name: value for name, value in self._options.items() if name not in _NO_MATTER}
        options = json.loads(json.dumps(given, default=str))
        configured = self._decoder.options
        return Head(__version__, options | {"profiles": _digest((configured.screens, configured.cameras))})

    def _writer(self, journal: Journal | None, begun: bool) -> Writer:
        """What takes each result."""
        from rxcli.runs.journal import Lines

        if journal is None and not self._to_stdout:
            return Writer() if self._options["quiet"] else Table(self._options["packets"])
        lines = Lines(self._head(), self._files(), begun)
        return JsonLines(lines, print_line if journal is None else journal.append)

    def _payloads(self, stack: ExitStack) -> Callable[[FrameResult], None]:
        """What writes the packets of a result, where --payloads asks for it."""
        if self._options["payloads"] is None:
            return lambda result: None
        from rxcli.results.payloads import PayloadWriter

        return stack.enter_context(PayloadWriter(self._options["payloads"])).write

    def _decode(self, sources: list[Source], writer: Writer, n_total: int) -> None:
        from rxcli.link.saving import save_objects
        from rxcli.results.report import plural, result_in_words
        from rxcli.runs.batch import with_last

        log.info("%s to decode, %d done before", plural(len(sources), "source"), n_total - len(sources))
        with Progress(n_total, n_total - len(sources), self._options["quiet"]) as progress:
            for source, results in self._decoded(sources):
                summary, scorer = self._begin(source.name)
                writer.begin(source.name, scorer is not None)
                try:
                    for result, last in with_last(results):
                        result = scorer.add(result) if scorer else result
                        result = self._photos.add(result)
                        if self._options["out"]:
                            result = save_objects(
                                result,
                                self._options["out"],
                                self._options["force"],
                                summary.unwritten.append,
                                self._taken,
                            )
                        summary.add(result)
                        if self._baseline is not None:
                            self._baseline.add(result)
                        self._keep_estimate(result)
                        self._write_payloads(result)
                        log.info("%s", result_in_words(result))
                        with progress.hidden():
                            writer.write(result, last)
                        progress.add(result, last)
                    with progress.hidden():
                        writer.end(summary)
                finally:
                    self._end(summary, scorer)

    def _decoded(self, sources: list[Source]) -> Iterator[Decoded]:
        from rxcli.runs.batch import decode_here, decode_in_processes

        if self._options["cluster"]:
            from rxcli.runs.cluster import decode_on_cluster

            return decode_on_cluster(sources, self._decoder, self._options["cluster"])
        if self._options["workers"] > 1 and len(sources) > 1:
            return decode_in_processes(sources, self._decoder, self._options["workers"])
        return decode_here(sources, self._decoder)

    def _begin(self, name: str) -> tuple[SourceSummary, Scorer | None]:
        from rxcli.results.summary import SourceSummary
        from rxcli.results.truth import Scorer, load_truth, truth_for

        asked = self._options["min_confidence"]
        summary = SourceSummary(name) if asked is None else SourceSummary(name, min_confidence=asked)
        truth = self._options["truth"]
        path = truth_for(name, truth)
        if path is None:
            return summary, None
        try:
            return summary, Scorer(load_truth(path))
        except InputError as error:
            if truth != "auto":
                raise
            summary.truth_problem = str(error)
            return summary, None

    def _end(self, summary: SourceSummary, scorer: Scorer | None) -> None:
        if summary.n_frames:  # none: interrupted before the first
            if scorer is not None:
                summary.score, summary.faults = scorer.score(), scorer.faults()
            summary.regressions = self._baseline.regressions(summary.source) if self._baseline else []
            self._summaries.append(summary)

    def _add_missing(self) -> None:
        """Sources that the baseline names and that this run did not have."""
        from rxcli.results.summary import SourceSummary

        for name in self._baseline.missing() if self._baseline else ():
            self._summaries.append(SourceSummary(name, regressions=["in the baseline, and not in this run"]))

    def _keep_estimate(self, result: FrameResult) -> None:
        most = len(self._estimated.packets) if self._estimated else 0
        # An estimate that received nothing may be wrong, and a profile is not doubted.
        if "line_delay_s" in result.estimated and len(result.packets) > most:
            self._estimated = result

    def _save_camera(self, path: Path) -> None:
        from rxcli.ingest import open_source
        from rxcli.outputs import write_whole
        from rxcli.profiles import dump_profile
        from rxcli.receiver.camera import camera_profile

        if self._estimated is None:
            click.echo(f"vlc-rx: {path} was not written: no packet was received with an estimated camera", err=True)
            return
        frame = next(iter(open_source(self._paths[self._estimated.source])))
        about = frame.metadata
        name = re.sub(r"[^A-Za-z0-9._-]+", "-", path.stem).lstrip("._-") or "camera"
        profile = camera_profile(self._estimated.estimated, name, about.make, about.model, frame.width, frame.height)
        write_whole(path, dump_profile(profile))

    def _conclude(self, sources: list[Source]) -> list[ExitCode]:
        """Write what is written at the end, each whether or not the others can be; returns why some could not.

        Raises:
            OSError: stdout cannot be written, or its reader has gone; all files are written.
        """
        from rxcli.results.summary import write_junit, write_summary

        self._summaries.sort(key=_order([source.name for source in sources]))
        summaries, limits, codes = self._summaries, self._limits, []
        steps: dict[str, Callable[[Path], None]] = {
            "summary": lambda path: write_summary(path, summaries, limits),
            "save_camera": self._save_camera,
            "junit": lambda path: write_junit(path, summaries, limits),
        }
        for name, write in steps.items():
            try:
                if self._options[name]:
                    write(self._options[name])
            except ReceiverError as error:
                click.echo(f"vlc-rx: {error}", err=True)
                codes.append(error.exit_code)
        self._print_summary()
        return codes

    def _print_summary(self) -> None:
        from rxcli.results.report import LEGEND, printable, printable_name
        from rxcli.results.summary import format_summary

        if self._options["quiet"]:
            for summary in self._summaries:
                for _, reason in summary.failures(self._limits):
                    name = "" if reason.startswith(f"{summary.source}: ") else f"{summary.source}: "
                    click.echo(f"vlc-rx: {printable(name + reason)}", err=True)
        elif self._summaries:
            if self._output.has_table:
                print_text(LEGEND + "\n")
            print_text(format_summary(self._summaries, self._limits), err=self._to_stdout)
            for summary in self._summaries:
                of = f"{printable_name(summary.source)}: " if len(self._summaries) > 1 else ""
                for line in summary.came:
                    print_text(of + line, err=self._to_stdout)


def _baseline(options: dict[str, Any]) -> Baseline | None:
    """The run to hold this one against, where one is named."""
    if options["baseline"] is None:
        return None
    from rxcli.results.baseline import load_baseline
    from rxcli.types import BELIEVABLE

    asked = options["min_confidence"]
    return load_baseline(options["baseline"], BELIEVABLE if asked is None else asked, options["slower"])


def _order(names: list[str]) -> Any:
    places = {name: place for place, name in enumerate(names)}
    return lambda summary: places.get(summary.source, len(places))


def _digest(profiles: Any) -> str:
    """A short mark that differs where profiles do."""
    import hashlib

    import msgspec

    return hashlib.sha256(msgspec.json.encode(profiles)).hexdigest()[:16]
