"""`vlc-rx decode`: photos, RAW files, clips and folders."""

from __future__ import annotations

import hashlib
import json
import logging
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

import click
import msgspec

from rxcli import __version__, outputs
from rxcli.cli.common import claim_outputs, force_argument, options, receiver_arguments, receiver_options
from rxcli.cli.kinds import FILE, FOLDER, SHARE, complete_files
from rxcli.cli.printing import JsonLines, Progress, Table, Writer, print_line, print_text
from rxcli.errors import ExitCode, InputError, ReceiverError, UsageError, worst
from rxcli.ingest import KNOWN_SUFFIXES, open_source
from rxcli.link.collector import PhotoCollector
from rxcli.link.saving import save_objects
from rxcli.outputs import Output, Taken
from rxcli.profiles import dump_profile
from rxcli.results.baseline import load_baseline
from rxcli.results.payloads import PayloadWriter
from rxcli.results.report import LEGEND, plural, printable, printable_name, result_in_words
from rxcli.results.summary import (
    Limits,
    SourceSummary,
    check_summary_path,
    exit_code,
    format_summary,
    write_junit,
    write_summary,
)
from rxcli.results.truth import Scorer, load_truth, truth_for
from rxcli.runs.batch import (
    Decoded,
    Decoder,
    Source,
    collect_sources,
    decode_here,
    decode_in_processes,
    standard_decoder,
    with_last,
)
from rxcli.runs.journal import Head, Journal, Lines
from rxcli.types import BELIEVABLE, FrameResult

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
    more = {name: options[name] for name in ("dump_dir", "stop_when_certain")}
    configured = receiver_options(options, **more, soft_bits=True)
    tap, after = None, None
    if options["save_undistorted"]:
        from rxcli.results.undistort import UndistortedWriter

        folder = Path(options["save_undistorted"]).absolute()
        tap = UndistortedWriter(folder, configured.cameras, configured.force_camera)
        after = tap.finish
    sources = collect_sources(paths, frozenset(KNOWN_SUFFIXES))
    taken = _claim(options, sources)
    with _stdin_as_file(sources) as sources:
        return _Run(standard_decoder(configured, tap, after), options, taken, sources).run()


def _check(paths: tuple[str, ...], options: dict[str, Any]) -> None:
    """Refuse what makes no sense before the long work starts."""
    resume, cluster = options["resume"], options["cluster"]
    no_file, no_truth = options["json_path"] in (None, "-"), options["max_ber"] is not None and not options["truth"]
    no_address = "--cluster needs the address of a Dask scheduler (got none)"
    for is_wrong, reason, step in (
        (resume and no_file, "--resume needs the file that --json wrote", "give --json FILE"),
        (resume and STDIN in paths, "--resume cannot check whether stdin is unchanged", "name the file"),
        (no_truth, "--max-ber needs the truth", "give --truth FILE, or --truth auto"),
        (cluster is not None and not cluster.strip(), no_address, "name it: tcp://host:8786"),
        (cluster and options["workers"] > 1, "--workers and --cluster exclude each other", "give one of them"),
        (cluster and STDIN in paths, "stdin cannot be sent to a cluster", "name a file that its workers see"),
    ):
        if is_wrong:
            raise UsageError(reason, step)
    if options["summary"]:
        check_summary_path(options["summary"])


def _flag(name: str) -> str:
    return "--" + name.removesuffix("_path").replace("_", "-")


def _claim(options: dict[str, Any], sources: list[Source]) -> Taken:
    """Refuse outputs that would destroy something, and make the folders of the taps; returns the files of the run."""
    truths = [truth_for(source.name, options["truth"]) for source in sources]
    inputs = [source.path for source in sources] + [str(path) for path in truths if path is not None]
    taken = claim_outputs(_outputs(options), inputs, (*options["screens"], *options["cameras"]), options["force"])
    for name in ("dump_dir", "save_undistorted", "out"):
        if options[name] is not None:
            outputs.claim_folder(_flag(name), options[name])
    for name in ("dump_dir", "save_undistorted"):
        conflict = options[name] and options["out"]
        if conflict and options["out"].resolve().is_relative_to(options[name].resolve()):
            reason = f"--out {options['out']}: {_flag(name)} writes there"
            raise UsageError(reason, "name a folder for received files alone")
    return taken


def _outputs(options: dict[str, Any]) -> Iterator[Output]:
    """Every file that the run will write."""
    summary, resume = options["summary"], options["resume"]
    is_table = summary is not None and summary.suffix.casefold() == ".csv"
    way_on = "go on with it by --resume, replace it with --force, or name another file"
    for name, ours in {
        # Resuming looks closer, and knows half lines.
        "json_path": outputs.ANYTHING if resume else outputs.JOURNAL,
        "junit": outputs.JUNIT,
        "summary": outputs.CSV_SUMMARY if is_table else outputs.PARQUET_SUMMARY,
        "save_camera": outputs.ESTIMATED_CAMERA,
        "payloads": outputs.PAYLOADS,
    }.items():
        if options[name] not in (None, "-"):
            is_kept = name == "json_path" and not resume
            yield Output(_flag(name), Path(options[name]), ours, way_on=way_on if is_kept else None)


@contextmanager
def _stdin_as_file(sources: list[Source]) -> Iterator[list[Source]]:
    """The sources, with what comes from stdin put into a file for as long as it is needed."""
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

    def __init__(self, decoder: Decoder, options: dict[str, Any], taken: Taken, sources: list[Source]) -> None:
        self._decoder, self._options, self._taken, self._sources = decoder, options, taken, sources
        asked = options["min_confidence"]
        #: Packets of less confidence do not count for the limits.
        self._min_confidence = BELIEVABLE if asked is None else asked
        earlier = options["baseline"]
        self._baseline = load_baseline(earlier, self._min_confidence, options["slower"]) if earlier else None
        self._limits = Limits(options["max_ber"], options["min_packets"], options["min_packet_confidence"])
        self._summaries: list[SourceSummary] = []
        self._to_stdout = options["json_path"] == "-"
        self._photos = PhotoCollector(decoder.link_screens, decoder.file_memory_mb)
        self._write_payloads: Callable[[FrameResult], None] = lambda result: None
        #: The frame with the most packets of those whose camera was estimated.
        self._estimated: FrameResult | None = None
        #: Name of a source -> where it is opened.
        self._paths = {source.name: source.path for source in sources}
        self._output = Writer()

    def run(self) -> ExitCode:
        """Decode what is not done yet, and write what is asked for; returns the exit code."""
        truth, path = self._options["truth"], self._options["json_path"]
        if truth not in (None, "auto") and len(self._sources) != 1:
            raise UsageError(
                f"--truth {truth} is the truth of one file ({len(self._sources)} were given)",
                "give --truth auto, which takes the NAME.truth.json beside each file",
            )
        with ExitStack() as stack:
            journal = None
            if path is not None and not self._to_stdout:
                journal = stack.enter_context(closing(Journal(Path(path), self._options["resume"])))
            if self._options["payloads"] is not None:
                self._write_payloads = stack.enter_context(PayloadWriter(self._options["payloads"])).write
            files = {name: path for name, path in self._paths.items() if name != STDIN}
            lines = Lines(self._head(), files)
            done = self._recover(journal, lines) if journal is not None and self._options["resume"] else set()
            lines.begun = bool(done)
            if journal is not None or self._to_stdout:
                self._output = JsonLines(lines, print_line if journal is None else journal.append)
            elif not self._options["quiet"]:
                self._output = Table(self._options["packets"])
            try:
                self._decode([source for source in self._sources if source.name not in done])
            except BaseException:
                with suppress(OSError):
                    self._conclude()  # the reason why the run ended is more important than this
                raise
        for name in self._baseline.missing() if self._baseline else ():
            self._summaries.append(SourceSummary(name, regressions=["in the baseline, and not in this run"]))
        return worst([*self._conclude(), exit_code(self._summaries, self._limits)])

    def _head(self) -> Head:
        """What the results depend on: the version, the options, what the profiles hold."""
        given = {name: value for name, value in self._options.items() if name not in _NO_MATTER}
        configured = self._decoder.options
        profiles = msgspec.json.encode((configured.screens, configured.cameras))
        mark = {"profiles": hashlib.sha256(profiles).hexdigest()[:16]}
        return Head(__version__, json.loads(json.dumps(given, default=str)) | mark)

    def _recover(self, journal: Journal, lines: Lines) -> set[str]:
        """Take the results of an earlier run into the summary; returns the names of its complete sources."""
        done = set()
        for name, results in journal.recover(lines.head, lines.paths):
            summary, scorer = self._begin(name)
            for result in results:
                self._count(scorer.add(result) if scorer else result, summary)
            self._end(summary, scorer)
            done.add(name)
        return done

    def _decode(self, sources: list[Source]) -> None:
        n_done = len(self._sources) - len(sources)
        log.info("%s to decode, %d done before", plural(len(sources), "source"), n_done)
        with Progress(len(self._sources), n_done, self._options["quiet"]) as progress:
            for source, results in self._decoded(sources):
                summary, scorer = self._begin(source.name)
                self._output.begin(source.name, scorer is not None)
                try:
                    for result, last in with_last(results):
                        result = self._photos.add(scorer.add(result) if scorer else result)
                        if out := self._options["out"]:
                            force = self._options["force"]
                            result = save_objects(result, out, force, summary.unwritten.append, self._taken)
                        self._count(result, summary)
                        self._keep_estimate(result)
                        log.info("%s", result_in_words(result))
                        with progress.hidden():
                            self._output.write(result, last)
                        progress.add(result, last)
                    with progress.hidden():
                        self._output.end(summary)
                finally:
                    self._end(summary, scorer)

    def _decoded(self, sources: list[Source]) -> Iterator[Decoded]:
        if self._options["cluster"]:
            from rxcli.runs.cluster import decode_on_cluster

            return decode_on_cluster(sources, self._decoder, self._options["cluster"])
        if self._options["workers"] > 1 and len(sources) > 1:
            return decode_in_processes(sources, self._decoder, self._options["workers"])
        return decode_here(sources, self._decoder)

    def _begin(self, name: str) -> tuple[SourceSummary, Scorer | None]:
        summary, truth = SourceSummary(name, min_confidence=self._min_confidence), self._options["truth"]
        path = truth_for(name, truth)
        try:
            return summary, None if path is None else Scorer(load_truth(path))
        except InputError as error:
            if truth != "auto":
                raise
            summary.truth_problem = str(error)
            return summary, None

    def _count(self, result: FrameResult, summary: SourceSummary) -> None:
        summary.add(result)
        if self._baseline is not None:
            self._baseline.add(result)
        self._write_payloads(result)

    def _end(self, summary: SourceSummary, scorer: Scorer | None) -> None:
        if summary.n_frames:  # none: interrupted before the first
            if scorer is not None:
                summary.score, summary.faults = scorer.score(), scorer.faults()
            summary.regressions = self._baseline.regressions(summary.source) if self._baseline else []
            self._summaries.append(summary)

    def _keep_estimate(self, result: FrameResult) -> None:
        most = len(self._estimated.packets) if self._estimated else 0
        # An estimate that received nothing may be wrong, and a profile is not doubted.
        if "line_delay_s" in result.estimated and len(result.packets) > most:
            self._estimated = result

    def _save_camera(self, path: Path) -> None:
        from rxcli.receiver.camera import camera_profile

        if self._estimated is None:
            click.echo(f"vlc-rx: {path} was not written: no packet was received with an estimated camera", err=True)
            return
        frame = next(iter(open_source(self._paths[self._estimated.source])))
        about = frame.metadata
        name = re.sub(r"[^A-Za-z0-9._-]+", "-", path.stem).lstrip("._-") or "camera"
        profile = camera_profile(self._estimated.estimated, name, about.make, about.model, frame.width, frame.height)
        outputs.write_whole(path, dump_profile(profile))

    def _conclude(self) -> list[ExitCode]:
        """Write what is written at the end, each whether or not the others can be; returns why some could not.

        Raises:
            OSError: stdout cannot be written, or its reader has gone; all files are written.
        """
        places = {name: place for place, name in enumerate(self._paths)}
        self._summaries.sort(key=lambda summary: places.get(summary.source, len(places)))
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
