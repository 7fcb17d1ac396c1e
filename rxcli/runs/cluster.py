"""Sources as tasks of an existing Dask scheduler (extra `cluster`)."""

from __future__ import annotations

import logging
import os
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING, Any

from rxcli.errors import InputError, UsageError
from rxcli.runs.batch import Decoded, Decoder, Source, unreadable
from rxcli.types import FrameResult

if TYPE_CHECKING:
    from distributed import Client

log = logging.getLogger(__name__)

#: How often a task may fail for reasons of the cluster; a task whose worker died is run again by the scheduler itself.
_RETRIES = 3
#: Tasks in the scheduler's hands at a time: enough for a large cluster, few enough that results do not pile up.
_IN_FLIGHT = 1024


def decode_on_cluster(
    sources: Sequence[Source], decoder: Decoder, address: str, connect_s: float = 10.0
) -> Iterator[Decoded]:
    """Decode sources on a Dask cluster; results as from `rxcli.runs.batch.decode_here`, in the same order.

    The workers must see the sources under the same absolute paths, and have `vlc-rx` installed.

    Args:
        sources: what to decode.
        decoder: how; must be picklable.
        address: the scheduler's, such as `tcp://host:8786`.
        connect_s: how long to wait for the scheduler, seconds.

    Raises:
        UsageError: the extra is missing, or no scheduler answers.
        InputError: the scheduler went away; what was taken till then is complete.
    """
    with _connect(address, connect_s) as client:
        waiting = iter(sources)
        flying = deque((source, _submit(client, decoder, source)) for source in islice(waiting, _IN_FLIGHT))
        while flying:
            source, future = flying.popleft()
            yield source, iter(_await(source, future, address))
            flying.extend((following, _submit(client, decoder, following)) for following in islice(waiting, 1))


def _connect(address: str, connect_s: float) -> Client:
    try:
        from distributed import Client
    except ImportError:
        raise UsageError("--cluster needs the package distributed", "pip install 'vlc-rx[cluster]'") from None
    try:
        client = Client(address, timeout=connect_s, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(
            f"--cluster: no Dask scheduler answers at {address!r} ({type(error).__name__})",
            "start one with `dask scheduler` and name its address, such as tcp://host:8786",
        ) from None
    if not client.scheduler_info()["workers"]:
        log.warning("the scheduler at %s has no workers yet; waiting for some (`dask worker %s`)", address, address)
    return client


def _submit(client: Client, decoder: Decoder, source: Source) -> Any:
    task = replace(source, path=os.path.abspath(source.path))
    return client.submit(_decode, decoder, task, pure=False, retries=_RETRIES)


def _decode(decoder: Decoder, source: Source) -> list[FrameResult]:
    return list(decoder.results(source))


def _await(source: Source, future: Any, address: str) -> list[FrameResult]:
    from distributed import KilledWorker

    try:
        results: list[FrameResult] = future.result()
        return results
    except KilledWorker:
        message = f"{source.name}: every worker that decoded it died; try it by itself"
        return [unreadable(source, 0, message)]
    except (OSError, _cancelled()) as error:
        raise InputError(
            f"the scheduler at {address!r} went away ({type(error).__name__})", "start it again and use --resume"
        ) from None


def _cancelled() -> type[BaseException]:
    from concurrent.futures import CancelledError

    return CancelledError
