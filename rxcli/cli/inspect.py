"""`vlc-rx inspect`: a page that shows every stage of the reception of a photo, or of a clip and one of its frames."""

import re
from dataclasses import asdict
from itertools import chain, islice
from pathlib import Path
from typing import Any

import click

from rxcli.cli.common import force_argument, json_output, options, receiver_arguments, receiver_options, write_json
from rxcli.cli.kinds import FOLDER
from rxcli.errors import ExitCode, InputError
from rxcli.ingest import open_source
from rxcli.options import ReceiverOptions
from rxcli.outputs import Output, claim, claim_own_folder, write_whole
from rxcli.receiver.receive import receive
from rxcli.results.cameras import Reception
from rxcli.results.dump import plain_name
from rxcli.results.inspection import inspect_frame
from rxcli.results.page import MARK, inspection_page
from rxcli.results.quality import qualities
from rxcli.results.record import plain
from rxcli.results.report import format_link
from rxcli.results.truth import Scorer, load_truth, truth_for
from rxcli.runs.batch import Decoder
from rxcli.types import Frame, FrameResult

#: Frames of a clip that its timeline shows.
_MAX_FRAMES = 240


@click.command()
@click.argument("path", type=click.Path())
@receiver_arguments
@options(
    ("--frame", click.IntRange(0), None, "Frame of a clip. [default: the one with the most packets]"),
    ("--out", FOLDER, None, "Folder to write. [default: ./inspect-NAME]"),
    ("--truth=FILE|auto", str, None, "Count wrong bits against this truth."),
    ("--json=FILE|- json_path", click.Path(allow_dash=True), None, "Write how well each column is driven as JSON."),
)
@force_argument
def inspect(path: str, frame: int | None, out: Path | None, force: bool, **options: Any) -> int:
    """Write a page that shows how PATH was received, stage by stage, or why not; prints the page's path.

    Texts and files that came are named on stderr.

    Of a clip, the first frames are received, and one is shown in full.
    """
    folder = out or Path(f"inspect-{plain_name(path).strip('._') or 'picture'}")
    page = folder / "index.html"
    truth, json_path = options.pop("truth"), options.pop("json_path")
    claim([page_output(folder), json_output(json_path, "frame", "quality")], (path,), (), force)
    if folder.exists():  # a new one is made when there is something to put into it
        claim_own_folder("--out", folder, (page.name,), force)
    results = write_page(path, page, receiver_options(options, soft_bits=True), frame, truth, force, json_path)
    for result in results:
        for line in format_link(result):
            click.echo(line, err=True)
    click.echo(page, err=json_path == "-")
    received = any(result.packets or result.messages or result.objects for result in results)
    return ExitCode.OK if received else ExitCode.NOT_RECEIVED


def page_output(folder: Path) -> Output:
    """The page in a folder, which may replace an earlier one."""
    return Output("--out", folder / "index.html", re.compile(re.escape(MARK.encode())), makes_folder=True)


def write_page(
    path: str,
    page: Path,
    options: ReceiverOptions,
    frame: int | None = None,
    truth: str | None = None,
    force: bool = False,
    json_path: str | None = None,
) -> list[FrameResult]:
    """Receive the photo or clip at `path` and write the page that shows how; results of all its frames.

    Args:
        path: a photo, or a clip, whose first frames are received.
        page: what to write; its folder is made, and is the command's own.
        options: of the receiver.
        frame: number of the frame to show; None: the one with the most packets.
        truth: file with what was sent, "auto" for the one beside `path`, None for none.
        force: write into a folder of somebody else.
        json_path: file that takes how well each column is driven, "-" for the standard output.

    Raises:
        InputError: the source cannot be read, or has no such frame.
    """
    results, picture, taps = _received(path, frame, options, truth)
    result = next(result for result in results if result.frame == picture.index)
    shown = Reception.of(picture, result, options)
    known = inspect_frame(taps, result) if taps and result.columns else None
    text = inspection_page(shown, known, results if len(results) > 1 else [])
    claim_own_folder("--out", page.parent, (page.name,), force)
    write_whole(page, text)
    quality = qualities(known, 1 / shown.screen.slot_rate_hz) if known and shown.screen else []
    write_json({"source": path, "frame": result.frame, "quality": [plain(asdict(each)) for each in quality]}, json_path)
    return results


def _received(
    path: str, number: int | None, options: ReceiverOptions, truth: str | None
) -> tuple[list[FrameResult], Frame, dict[str, Any] | None]:
    """Receive the frames of a source; also return the frame to show, and its arrays at the stage boundaries.

    Raises:
        InputError: the source cannot be read, or has no such frame.
    """
    found = truth_for(path, truth)
    scorer = Scorer(load_truth(found)) if found else None
    n_frames = max(_MAX_FRAMES, (number or 0) + 1)
    frames, decoder = islice(open_source(path), n_frames), Decoder(options)
    head = list(islice(frames, 1))  # so that a photo is read once
    pending: dict[int, dict[str, Any]] = {}
    results: list[FrameResult] = []
    best, taps = None, None
    received = receive(chain(head, frames), options, lambda _, frame, stages: pending.update({frame: stages}))
    for each in decoder.linked(received):
        results.append(scorer.add(each) if scorer else each)
        arrays = pending.pop(each.frame, None)
        is_better = best is None or len(each.packets) > len(best.packets)
        if is_better if number is None else each.frame == number:
            best, taps = each, arrays
    if best is None:
        raise InputError(f"{path}: has no frame {number or 0}", "choose a lower --frame")
    shown = best.frame
    return results, head[0] if shown == 0 else next(islice(open_source(path), shown, None)), taps
