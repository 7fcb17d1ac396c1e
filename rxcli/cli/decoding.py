"""What `vlc-rx decode` does: claim its outputs, decode every source, write what was asked for."""

import json
import logging
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import Any

from rxcli import __version__, outputs
from rxcli.cli.common import output, receiver_options, refuse
from rxcli.cli.printing import Progress, Table, print_line, print_text
from rxcli.errors import ExitCode, InputError, ReceiverError, failure_explained, worst
from rxcli.ingest import KNOWN_SUFFIXES, MAX_BYTES, open_source
from rxcli.link.collector import PhotoCollector
from rxcli.link.saving import save_objects
from rxcli.options import ReceiverOptions
from rxcli.profiles import dump_profile
from rxcli.results import report, summary
from rxcli.results.baseline import load_baseline, regressions
from rxcli.results.cameras import estimated_camera
from rxcli.results.columns import PAYLOAD_TABLE
from rxcli.results.truth import Scorer, load_truth, truth_for
from rxcli.runs import batch
from rxcli.runs.journal import Head, Journal, Lines
from rxcli.types import BELIEVABLE, Frame, FrameResult

log = logging.getLogger(__name__)
#: Options on which a source's results depend.
_MATTERS = {"screens", "cameras", "corners", "mirrored", "cae", "min_confidence", "no_skip", "file_memory_mb"}
_MATTERS |= {"truth", "same_camera", "stop_when_certain"}
#: The source that is read from stdin.
STDIN = "-"
#: Bytes that are read of it at a time.
_STDIN_BYTES = 1 << 20


def run(
    paths: tuple[str, ...], given: dict[str, Any], opened: Callable[[str], Iterator[Frame]] | None = None
) -> ExitCode:
    """Decode the files and folders `paths` with the options that were `given`; `opened` opens files in this process."""
    sources = batch.collect_sources(paths, frozenset(KNOWN_SUFFIXES))
    _check(paths, given, len(sources))
    log.info("paths: %s", ", ".join(paths))
    configured = receiver_options(given, soft_bits=True)
    tap, after = None, None
    if given["save_undistorted"]:
        from rxcli.results.undistort import UndistortedWriter

        folder = Path(given["save_undistorted"]).absolute()
        tap = UndistortedWriter(folder, configured.cameras, configured.force_camera)
        after = tap.finish
    taken = _claim(given, sources)
    with _stdin_as_file(sources) as sources:
        if given["same_camera"]:
            configured = _with_same_camera(sources, configured)
        decoder = batch.Decoder(configured, tap, after)
        return _Run(decoder if opened is None else replace(decoder, open_source=opened), given, taken, sources).run()


def _with_same_camera(sources: list[batch.Source], configured: ReceiverOptions) -> ReceiverOptions:
    """The options with the camera that the first photo with packets in half of its columns gives an estimate of."""
    decoder = batch.Decoder(replace(configured, soft_bits=False, dump_dir=None))
    for source, results in batch.decode_here(sources, decoder):
        photo = next(iter(results))
        if photo.gives_camera:
            profile = estimated_camera(next(iter(open_source(source.path))), photo, "same-camera")
            log.info("all photos are taken as by the camera of %s", source.name)
            if profile.models:
                return replace(configured, cameras=(profile, *configured.cameras))
            return replace(configured, cameras=(profile,), force_camera=True)
    log.warning("--same-camera: no photo gives packets in half of its columns; each camera is estimated by itself")
    return configured


def _check(paths: tuple[str, ...], given: dict[str, Any], n_sources: int) -> None:
    """Refuse what makes no sense before the long work starts."""
    resume, cluster, truth = given["resume"], given["cluster"], given["truth"]
    is_one_truth = truth not in (None, "auto") and n_sources != 1
    no_file, no_truth = given["json_path"] in (None, "-"), given["max_ber"] is not None and not truth
    no_address = "--cluster needs the address of a Dask scheduler (got none)"
    one_truth = f"--truth {truth} is the truth of one file ({n_sources} were given)"
    refuse(
        (resume and no_file, "--resume needs the file that --json wrote", "give --json FILE"),
        (resume and STDIN in paths, "--resume cannot check whether stdin is unchanged", "name the file"),
        (no_truth, "--max-ber needs the truth", "give --truth FILE, or --truth auto"),
        (is_one_truth, one_truth, "give --truth auto, which takes the NAME.truth.json beside each file"),
        (cluster is not None and not cluster.strip(), no_address, "name it: tcp://host:8786"),
        (cluster and given["workers"] > 1, "--workers and --cluster exclude each other", "give one of them"),
        (cluster and STDIN in paths, "stdin cannot be sent to a cluster", "name a file that its workers see"),
    )
    if given["summary"]:
        summary.check_summary_path(given["summary"])


def _claim(given: dict[str, Any], sources: list[batch.Source]) -> outputs.Taken:
    """Refuse outputs that would destroy something, and make the folders of the taps; returns the files of the run."""
    truths = [truth_for(source.name, given["truth"]) for source in sources]
    inputs = [source.path for source in sources] + [str(path) for path in truths if path is not None]
    taken = outputs.claim(_outputs(given), inputs, (*given["screens"], *given["cameras"]), given["force"])
    out = given["out"]
    for option, folder in (("--dump-dir", given["dump_dir"]), ("--save-undistorted", given["save_undistorted"])):
        if folder is not None:
            outputs.claim_folder(option, folder)
            is_inside = out is not None and out.resolve().is_relative_to(folder.resolve())
            refuse((is_inside, f"--out {out}: {option} writes there", "name a folder for received files alone"))
    if out is not None:
        outputs.claim_folder("--out", out)
    return taken


def _outputs(given: dict[str, Any]) -> list[outputs.Output | None]:
    """Every file that the run will write."""
    way_on = "go on with it by --resume, replace it with --force, or name another file"
    # Resuming looks closer, and knows half lines.
    ours = (outputs.ANYTHING, None) if given["resume"] else (outputs.JOURNAL, way_on)
    return [
        output("--json", given["json_path"], ours[0], way_on=ours[1]),
        output("--junit", given["junit"], outputs.JUNIT),
        output("--summary", given["summary"], outputs.SUMMARY),
        output("--save-camera", given["save_camera"], outputs.ESTIMATED_CAMERA),
        output("--payloads", given["payloads"], outputs.PAYLOADS),
    ]


@contextmanager
def _stdin_as_file(sources: list[batch.Source]) -> Iterator[list[batch.Source]]:
    """The sources, with what comes from stdin put into a file for as long as it is needed."""
    if all(source.name != STDIN for source in sources):
        yield sources
        return
    if sys.stdin is None:
        raise InputError("stdin is closed", "name a file instead of -")
    step = "make room, or set TMPDIR to another folder"
    with ExitStack() as stack:
        with failure_explained("stdin: cannot be kept in a temporary file", step):
            file = stack.enter_context(NamedTemporaryFile(prefix="vlc-rx-"))
            while part := sys.stdin.buffer.read(_STDIN_BYTES):
                file.write(part)
                if file.tell() > MAX_BYTES:
                    raise InputError(f"stdin: more than {MAX_BYTES / 1e9:g} GB", "name a file instead of -")
            file.flush()
        yield [replace(source, path=file.name) if source.name == STDIN else source for source in sources]


class _Run:
    """One run over many sources: where results go, and what is kept for the summary."""

    def __init__(
        self, decoder: batch.Decoder, given: dict[str, Any], taken: outputs.Taken, sources: list[batch.Source]
    ) -> None:
        self._decoder, self._given, self._taken, self._sources = decoder, given, taken, sources
        asked = given["min_confidence"]
        #: Packets of less confidence do not count for the limits.
        self._min_confidence = BELIEVABLE if asked is None else asked
        self._baseline = load_baseline(given["baseline"], self._min_confidence)
        bounds = ("max_ber", "min_packets", "expected_texts", "min_packet_confidence")
        self._limits = summary.Limits(**{name: given[name] for name in bounds})
        self._summaries: list[summary.SourceSummary] = []
        self._photos = PhotoCollector(decoder.options.screens, decoder.options.file_memory_mb)
        #: The frame with the most packets of those whose camera was estimated.
        self._estimated: FrameResult | None = None
        #: Name of a source -> where it is opened.
        self._paths = {source.name: source.path for source in sources}
        self._output: Table | Lines | None = None
        self._put_payloads: Callable[[Iterable[Iterable[Any]]], None] | None = None

    def run(self) -> ExitCode:
        """Decode what is not done yet, and write what is asked for; returns the exit code."""
        path, resume, done = self._given["json_path"], self._given["resume"], set[str]()
        with ExitStack() as stack:

            def journal(path: str | Path, resume: bool = False) -> Journal:
                return stack.enter_context(closing(Journal(Path(path), resume)))

            output = None if path in (None, "-") else journal(path, resume)
            if self._given["payloads"] is not None:
                append = journal(self._given["payloads"]).append
                self._put_payloads = lambda rows: append(report.csv_text(rows).removesuffix("\n"))
                self._put_payloads([PAYLOAD_TABLE])
            if path is not None:
                paths = {name: path for name, path in self._paths.items() if name != STDIN}
                lines = Lines(print_line if output is None else output.append, self._head(), paths)
                if output is not None and resume:
                    done = self._recover(output, lines)
                lines.begun = bool(done)
                self._output = lines
            elif not self._given["quiet"]:
                self._output = Table(self._given["packets"])
            try:
                self._decode([source for source in self._sources if source.name not in done])
            except BaseException:
                with suppress(OSError):
                    self._conclude()  # the reason why the run ended is more important than this
                raise
        for name in sorted(self._baseline.keys() - {os.path.normpath(counted.source) for counted in self._summaries}):
            lost = summary.SourceSummary(name, regressions=["in the baseline, and not in this run"])
            self._summaries.append(lost)
        return worst([*self._conclude(), summary.exit_code(self._summaries, self._limits)])

    def _head(self) -> Head:
        """What the results depend on: the version, the options, what the profiles hold, the thresholds in force."""
        import hashlib  # loads OpenSSL, and the thresholds load every room of the receiver: only --json needs them

        import msgspec

        from rxcli.runs.provenance import settings_in_force

        given = {name: value for name, value in self._given.items() if name in _MATTERS}
        configured = self._decoder.options
        profiles = msgspec.json.encode((configured.screens, configured.cameras))
        mark = {"profiles": hashlib.sha256(profiles).hexdigest()[:16], "settings": settings_in_force()}
        return Head(__version__, json.loads(json.dumps(given, default=str)) | mark)

    def _recover(self, journal: Journal, lines: Lines) -> set[str]:
        """Take the results of an earlier run into the summary; returns the names of its complete sources."""
        done = set()
        for name, results in journal.recover(lines.head, lines.paths):
            with self._summarised(name) as (counted, scorer):
                for result in results:
                    self._count(scorer.add(result) if scorer else result, counted)
            done.add(name)
        return done

    def _decode(self, sources: list[batch.Source]) -> None:
        n_done, quiet = len(self._sources) - len(sources), self._given["quiet"]
        log.info("%s to decode, %d done before", report.plural(len(sources), "source"), n_done)
        with Progress(len(self._sources), n_done, quiet) as progress:
            for source, results in self._decoded(sources):
                progress.begin(source.name)
                with self._summarised(source.name) as (counted, scorer):
                    if self._output is not None:
                        self._output.begin(source.name, scorer is not None)
                    for received, last in batch.with_last(results):
                        result = self._photos.add(scorer.add(received) if scorer else received)
                        if out := self._given["out"]:
                            force = self._given["force"]
                            result = save_objects(result, out, force, counted.unwritten.append, self._taken)
                        self._count(result, counted)
                        self._keep_estimate(result)
                        log.info("%s", report.result_in_words(result))
                        if self._output is not None:
                            with progress.hidden():
                                self._output.write(result, last)
                        progress.add(result, last)
                    if isinstance(self._output, Table):
                        with progress.hidden():
                            self._output.end(counted)

    def _decoded(self, sources: list[batch.Source]) -> Iterator[batch.Decoded]:
        if self._given["cluster"]:
            from rxcli.runs.cluster import decode_on_cluster

            return decode_on_cluster(sources, self._decoder, self._given["cluster"])
        if self._given["workers"] > 1 and len(sources) > 1:
            return batch.decode_in_processes(sources, self._decoder, self._given["workers"])
        return batch.decode_here(sources, self._decoder)

    @contextmanager
    def _summarised(self, name: str) -> Iterator[tuple[summary.SourceSummary, Scorer | None]]:
        """The figures of a source and the scorer of its packets, if its truth is known; kept however it ends."""
        before, scorer = self._baseline.get(os.path.normpath(name)), None
        counted = summary.SourceSummary(name, self._min_confidence, payloads=None if before is None else set())
        path = truth_for(name, self._given["truth"])
        try:
            scorer = None if path is None else Scorer(load_truth(path))
        except InputError as error:
            if self._given["truth"] != "auto":
                raise
            counted.truth_problem = str(error)
        try:
            yield counted, scorer
        finally:
            if counted.n["frames"]:  # none: interrupted before the first
                if scorer is not None:
                    counted.score, counted.faults = scorer.score(), scorer.faults()
                if before is not None:
                    counted.regressions = regressions(counted, before, self._given["slower"])
                self._summaries.append(counted)

    def _count(self, result: FrameResult, counted: summary.SourceSummary) -> None:
        counted.add(result)
        for message in result.messages:
            for photo in (before for before in self._summaries if before.source in message.photos):
                photo.add_part(message)
        if self._put_payloads is not None and result.packets:
            self._put_payloads(report.payload_rows(result))

    def _keep_estimate(self, result: FrameResult) -> None:
        # An estimate that received nothing may be wrong, and a profile is not doubted.
        most = len(self._estimated.packets) if self._estimated else 0
        if "line_delay_s" in result.estimated and len(result.packets) > most:
            self._estimated = result

    def _save_camera(self, path: Path) -> None:
        if self._estimated is None:
            log.error("%s was not written: no packet was received with an estimated camera", path)
            return
        name = re.sub(r"[^A-Za-z0-9._-]+", "-", path.stem).lstrip("._-") or "camera"
        frame = next(iter(open_source(self._paths[self._estimated.source])))
        outputs.write_whole(path, dump_profile(estimated_camera(frame, self._estimated, name)))

    def _conclude(self) -> list[ExitCode]:
        """Write what is written at the end, each whether or not the others can be; returns why some could not.

        Raises:
            OSError: stdout cannot be written, or its reader has gone; all files are written.
        """
        places = {name: place for place, name in enumerate(self._paths)}
        self._summaries.sort(key=lambda counted: places.get(counted.source, len(places)))
        codes = []
        steps: dict[str, Callable[[Path], None]] = {
            "summary": lambda path: summary.write_summary(path, self._summaries, self._limits),
            "save_camera": self._save_camera,
            "junit": lambda path: summary.write_junit(path, self._summaries, self._limits),
        }
        for name, write in steps.items():
            try:
                if self._given[name]:
                    write(self._given[name])
            except ReceiverError as error:
                log.error("%s", error)
                codes.append(error.exit_code)
        self._print_summary()
        return codes

    def _print_summary(self) -> None:
        to_stderr = self._given["json_path"] == "-"
        if self._given["quiet"]:
            for counted in self._summaries:
                for _, reason in counted.failures(self._limits):
                    name = "" if reason.startswith(f"{counted.source}: ") else f"{counted.source}: "
                    log.error("%s%s", name, reason)
        elif self._summaries:
            is_shown = isinstance(self._output, Table)
            if isinstance(self._output, Table) and self._output.has_table:
                print_text(report.LEGEND + "\n")
            print_text(summary.format_summary(self._summaries, self._limits, is_shown), err=to_stderr)
            for counted in self._summaries:
                of = f"{report.printable_name(counted.source)}: " if len(self._summaries) > 1 else ""
                for line in counted.came:
                    print_text(of + line, err=to_stderr)
