"""Sources as tasks of an existing Dask scheduler (extra `cluster`)."""

from __future__ import annotations

import asyncio
import logging
import os
import time
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from typing import TYPE_CHECKING, Any

from rxcli.errors import InputError, OutputError, ReceiverError, UsageError
from rxcli.outputs import PICTURE, TAPS, check_replaceable, make_parent, write_whole
from rxcli.runs.batch import Decoded, Decoder, Source, unreadable
from rxcli.types import FrameResult

if TYPE_CHECKING:
    from distributed import Client

log = logging.getLogger(__name__)

#: How often a task may fail for reasons of the cluster; a task whose worker died is run again by the scheduler itself.
_RETRIES = 3
#: Tasks in the scheduler's hands at a time: enough for a large cluster, few enough that results do not pile up.
_IN_FLIGHT = 1024
#: Bytes of one source's taps: results wait in the memory of the cluster.
_MAX_TAPPED = 512 << 20
#: A tapped file: the option that asks for it, its path below that option's folder, its bytes.
_Tap = tuple[str, str, bytes]
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
        waiting = iter(sources)
        flying = deque((source, _submit(client, decoder, source)) for source in islice(waiting, _IN_FLIGHT))
        while flying:
            source, future = flying.popleft()
            results, taps = _await(source, future, address)
            _write(taps, decoder)
            yield source, iter(results)
            flying.extend((following, _submit(client, decoder, following)) for following in islice(waiting, 1))


def _connect(address: str, connect_s: float) -> Client:
    try:
        from distributed import Client
    except ImportError:
        raise UsageError("--cluster needs the package distributed", "pip install '.[cluster]'") from None
    end_s = time.monotonic() + connect_s
    problem = _problem_at(address, connect_s)
    if problem is not None:
        raise UsageError(f"--cluster: no Dask scheduler answers at {address!r} ({problem})", _START_ONE)
    try:
        with _silent():
            client = Client(address, timeout=max(end_s - time.monotonic(), 0.1), set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"--cluster: no Dask scheduler answers at {address!r} ({type(error).__name__})", _START_ONE
        ) from None
    if not client.scheduler_info()["workers"]:
        log.warning("the scheduler at %s has no workers yet; waiting for some (`dask worker %s`)", address, address)
    return client


def _problem_at(address: str, connect_s: float) -> str | None:
    """Why no scheduler answers; None where one does. Dask itself would try again and again, and say so at length."""
    outcome: list[str | None] = []

    def ask() -> None:
        try:
            kind = asyncio.run(asyncio.wait_for(_kind_at(address), connect_s))
            outcome.append(None if kind == "Scheduler" else f"that is a {kind}")
        except TimeoutError:
            return
        except Exception as error:  # Dask, its transports and TLS raise some ten unrelated types
            outcome.append(_first_line(error))

    # A name that is looked up in vain, or a server that accepts and is silent, is left behind with its thread.
    asker = Thread(target=ask, daemon=True)
    with _silent():
        asker.start()
        asker.join(connect_s)
    return outcome[0] if outcome else f"nothing within {connect_s:g} s"


async def _kind_at(address: str) -> str:
    """What the Dask server at an address says that it is."""
    from distributed.comm import connect
    from distributed.comm.addressing import get_address_host_port
    from distributed.security import Security

    if not 0 < int(get_address_host_port(address, strict=True)[1] or 0) < 1 << 16:
        raise ValueError("that is no address with a port")
    comm = await connect(address, **Security().get_connection_args("client"))
    try:
        await comm.write({"op": "identity", "reply": True})
        answer = await comm.read()
    finally:
        comm.abort()
    return str(answer.get("type")) if isinstance(answer, dict) else "server of another kind"


def _first_line(error: BaseException) -> str:
    text = str(error).strip().splitlines()
    return f"{type(error).__name__}: {text[0]:.120}" if text else type(error).__name__


@contextmanager
def _silent() -> Iterator[None]:
    """Without the tracebacks that Dask logs of attempts that fail."""
    loggers = [logging.getLogger(name) for name in ("distributed", "asyncio", "tornado")]
    levels = [logger.level for logger in loggers]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for logger in loggers:
            logger.setLevel(logging.CRITICAL + 1)
        try:
            yield
        finally:
            for logger, level in zip(loggers, levels, strict=True):
                logger.setLevel(level)


def _submit(client: Client, decoder: Decoder, source: Source) -> Any:
    task = replace(source, path=os.path.abspath(source.path))
    return client.submit(_decode, decoder, task, pure=False, retries=_RETRIES)


def _decode(decoder: Decoder, source: Source) -> _Outcome:
    """Decode a source on a worker; what is tapped comes back with the results, for the disk may be another one."""
    if not _folders(decoder):
        return list(decoder.results(source)), []
    with TemporaryDirectory(prefix="vlc-rx-") as scratch:
        results = list(_tapping_into(decoder, Path(scratch)).results(source))
        return results, _collect(Path(scratch), source)


def _folders(decoder: Decoder) -> dict[str, Path]:
    """Where taps go, by the option that names it."""
    folders = {
        "--dump-dir": getattr(decoder.options, "dump_dir", None),
        "--save-undistorted": getattr(decoder.tap, "folder", None),
    }
    return {option: folder for option, folder in folders.items() if folder is not None}


def _tapping_into(decoder: Decoder, scratch: Path) -> Decoder:
    """The decoder with its taps in folders of `scratch`, called as the options are."""
    there = {option: scratch / option for option in _folders(decoder)}
    if "--dump-dir" in there:
        decoder = replace(decoder, options=replace(decoder.options, dump_dir=there["--dump-dir"]))
    if "--save-undistorted" in there:
        tap: Any = decoder.tap
        decoder = replace(decoder, tap=replace(tap, folder=there["--save-undistorted"]))
    return decoder


def _collect(scratch: Path, source: Source) -> list[_Tap]:
    """The files below `scratch`."""
    paths = sorted(path for path in scratch.rglob("*") if path.is_file())
    size = sum(path.stat().st_size for path in paths)
    if size > _MAX_TAPPED:
        reason = f"{source.name}: its taps take {size >> 20} MB; a cluster sends at most {_MAX_TAPPED >> 20} MB"
        raise OutputError(reason, "decode this file without --cluster")
    found = []
    for path in paths:
        option, *below = path.relative_to(scratch).parts
        found.append((option, "/".join(below), path.read_bytes()))
    return found


def _write(taps: list[_Tap], decoder: Decoder) -> None:
    """Write what was tapped where the options say.

    Raises:
        OutputError: it cannot be written, or somebody else's file is there.
    """
    folders = _folders(decoder)
    looks = {"--dump-dir": TAPS, "--save-undistorted": PICTURE}
    for option, below, data in taps:
        folder = folders[option]
        path = folder / below
        if not path.resolve().is_relative_to(folder.resolve()):
            raise OutputError(f"{path}: a worker names a file outside {option}", "look at who joins the cluster")
        make_parent(path)
        check_replaceable(path, looks[option], option)
        write_whole(path, data)


def _await(source: Source, future: Any, address: str) -> _Outcome:
    from concurrent.futures import CancelledError

    from distributed import KilledWorker

    try:
        decoded: _Outcome = future.result()
        return decoded
    except KilledWorker:
        message = f"{source.name}: every worker that decoded it died; try it by itself"
        return [replace(unreadable(source, 0, message), retry=True)], []
    except (OSError, CancelledError) as error:
        raise InputError(
            f"the scheduler at {address!r} went away ({type(error).__name__})", "start it again and use --resume"
        ) from None
    except ReceiverError:
        raise
    except Exception as error:  # what a worker raises that cannot even load the task
        reason = f"the workers of {address!r} cannot decode ({_first_line(error)})"
        raise InputError(reason, "install the same vlc-rx there") from None
