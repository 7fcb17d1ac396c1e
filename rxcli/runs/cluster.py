"""Sources as tasks of an existing Dask scheduler (extra `cluster`)."""

from __future__ import annotations

import gc
import logging
import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import TYPE_CHECKING, Any

from rxcli.errors import InputError, OutputError, ReceiverError, UsageError, reason_of, require
from rxcli.ingest.ahead import in_order
from rxcli.outputs import PICTURE, TAPS, tapped
from rxcli.runs.batch import Decoded, Decoder, Source, unreadable
from rxcli.types import FrameResult

if TYPE_CHECKING:
    from distributed import Client

log = logging.getLogger(__name__)

#: How often a task may fail for reasons of the cluster; a task whose worker died is run again by the scheduler itself.
_RETRIES = 3
#: Tasks in the scheduler's hands at a time: enough for a large cluster, few enough that results do not pile up.
_IN_FLIGHT = 1024
#: Maximum bytes of one source's taps, which wait in the memory of the cluster.
_MAX_TAPPED = 512 << 20
#: Dask is given so much longer to give up by itself, seconds.
_MARGIN_S = 0.5
#: A tapped file: its path below the name of the option that asks for it, and its bytes.
_Tap = tuple[str, bytes]
_Outcome = tuple[list[FrameResult], list[_Tap]]
_START_ONE = "start one with `dask scheduler` and name its address, such as tcp://host:8786"


def decode_on_cluster(
    sources: Sequence[Source], decoder: Decoder, address: str, connect_s: float = 10.0
) -> Iterator[Decoded]:
    """Decode sources on a Dask cluster; results as from `rxcli.runs.batch.decode_here`, in the same order.

    The workers must see the sources under the same absolute paths, and have `vlc-rx` installed.

    Args:
        sources: what to decode.
        decoder: how; must be picklable.
        address: the scheduler's, such as `tcp://host:8786`.
        connect_s: how long to wait for the scheduler in all, seconds.

    Raises:
        UsageError: the extra is missing, the address is none, or no scheduler answers there.
        InputError: the scheduler went away, or its workers cannot decode; what was taken till then is complete.
    """
    with _connect(address, connect_s) as client:
        #: Workers that do not see a file that is there.
        blind = set[str]()

        def submit(source: Source) -> Any:
            task = replace(source, path=os.path.abspath(source.path))
            seeing = [worker for worker in client.nthreads() if worker not in blind] if blind else None
            where: dict[str, Any] = {"workers": seeing, "allow_other_workers": True} if seeing else {}
            is_there = os.access(task.path, os.R_OK)
            return client.submit(_decode, decoder, task, is_there, pure=False, retries=_RETRIES, **where)

        for source, future in in_order(sources, submit, _IN_FLIGHT):
            outcome, tried = _await(source, future, address), set[str]()
            while isinstance(outcome, str) and outcome not in tried:
                if outcome not in blind:
                    log.warning("the worker %s does not see %s; others are asked", outcome, source.name)
                tried.add(outcome)
                blind.add(outcome)
                outcome = _await(source, submit(source), address)
            if isinstance(outcome, str):
                message = f"{source.name}: no worker sees it; give them the folder under the same path"
                outcome = [unreadable(source, 0, message)], []
            results, taps = outcome
            _write(taps, decoder)
            yield source, iter(results)


def _connect(address: str, connect_s: float) -> Client:
    require("--cluster", "distributed")
    from distributed import Client

    made: list[Client] = []
    failures: list[str] = []

    def connect() -> None:
        try:
            made.append(Client(address, timeout=connect_s, set_as_default=False))
        except Exception as error:  # Dask, its transports and TLS raise some ten unrelated types
            failures.append(reason_of(error))
        if not made:
            # A client that failed is closed here: its end and the start of another one wait for one lock of Dask, so
            # that a later connection would hang if garbage were collected within it.
            gc.collect()

    # A name that is looked up in vain, or a server that accepts and is silent, is left behind with its thread.
    connecting = Thread(target=connect, daemon=True)
    logging.disable()  # without the tracebacks that Dask logs of attempts that fail
    try:
        with warnings.catch_warnings(action="ignore"):
            connecting.start()
            connecting.join(connect_s + _MARGIN_S)
    finally:
        logging.disable(logging.NOTSET)
    if not made:
        why = failures[0] if failures else f"nothing within {connect_s:g} s"
        raise UsageError(f"--cluster: no Dask scheduler answers at {address!r} ({why})", _START_ONE)
    client = made[0]
    if not client.scheduler_info()["workers"]:
        log.warning("the scheduler at %s has no workers yet; waiting for some (`dask worker %s`)", address, address)
    return client


class _UnseenError(Exception):
    """A file that is there is not where this worker looks; the argument is the worker's address."""


def _decode(decoder: Decoder, source: Source, is_there: bool = False) -> _Outcome:
    """Decode a source on a worker; what is tapped comes back with the results, for the disk may be another one."""
    if is_there and not os.access(source.path, os.R_OK):
        from distributed import get_worker

        raise _UnseenError(get_worker().address)
    with TemporaryDirectory(prefix="vlc-rx-") as scratch:
        for option in _folders(decoder):
            decoder = _tapping_into(decoder, option, Path(scratch) / option)
        results = list(decoder.results(source))
        paths = sorted(path for path in Path(scratch).rglob("*") if path.is_file())
        size = sum(path.stat().st_size for path in paths)
        if size > _MAX_TAPPED:
            reason = f"{source.name}: its taps take {size >> 20} MB; a cluster sends at most {_MAX_TAPPED >> 20} MB"
            raise OutputError(reason, "decode this file without --cluster")
        return results, [(str(path.relative_to(scratch)), path.read_bytes()) for path in paths]


def _folders(decoder: Decoder) -> dict[str, Path]:
    """Where taps go, by the option that names it."""
    places = (("--dump-dir", decoder.options, "dump_dir"), ("--save-undistorted", decoder.tap, "folder"))
    return {option: folder for option, of, name in places if (folder := getattr(of, name, None)) is not None}


def _tapping_into(decoder: Decoder, option: str, folder: Path) -> Decoder:
    """The decoder with the taps of one option in another folder."""
    if option == "--dump-dir":
        return replace(decoder, options=replace(decoder.options, dump_dir=folder))
    writer: Any = decoder.tap
    writer = replace(writer, folder=folder)
    return replace(decoder, tap=writer, after=decoder.after and writer.finish)


def _write(taps: list[_Tap], decoder: Decoder) -> None:
    """Write the taps to the folders of the options.

    Raises:
        OutputError: it cannot be written, or somebody else's file is there.
    """
    for place, data in taps:
        option, below = place.split(os.sep, 1)
        ours = {"--dump-dir": TAPS, "--save-undistorted": PICTURE}[option]
        with tapped(_folders(decoder)[option] / below, ours, option) as hidden:
            hidden.write_bytes(data)


def _await(source: Source, future: Any, address: str) -> _Outcome | str:
    """What a worker made of a source, or the address of one that does not see it."""
    from concurrent.futures import CancelledError

    from distributed import KilledWorker

    try:
        decoded: _Outcome = future.result()
        return decoded
    except KilledWorker:
        message = f"{source.name}: every worker that decoded it died; try it by itself"
        return [unreadable(source, 0, message)], []
    except (OSError, CancelledError) as error:
        reason = f"the scheduler at {address!r} went away ({type(error).__name__})"
        raise InputError(reason, "start it again and use --resume") from None
    except _UnseenError as error:
        return str(error)
    except ReceiverError:
        raise
    except Exception as error:  # what a worker raises that cannot even load the task
        reason = f"the workers of {address!r} cannot decode ({reason_of(error)})"
        raise InputError(reason, "install the same vlc-rx there") from None
