"""The page's HTTP server: a few fixed addresses, everything bounded, nothing from outside in a path.

What the page may cost: `Bounds`. Where it can be reached from other machines, a token stands in its address; requests
that come from the pages of others are refused.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import json
import logging
import shutil
import socket
import tempfile
import time
import uuid
from collections import deque
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from aiohttp import web

from rxcli.errors import UsageError
from rxcli.resources import data_dir
from rxcli.web.decoding import DecodingProcess, Limits, refusal

if TYPE_CHECKING:
    from rxcli.ingest.v4l2 import CameraSettings
    from rxcli.options import ReceiverOptions

log = logging.getLogger(__name__)

_PAGE = data_dir("pages")
#: Everything that is served from disk: name -> type.
_ASSETS = {
    "app.css": "text/css",
    "app.js": "text/javascript",
    "view.js": "text/javascript",
    "icon.svg": "image/svg+xml",
}
_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",  # the address may hold the token
    "Cache-Control": "no-store",
}
#: A line of JSON for every answer: what is known so far, and at last the whole.
_LINES = "application/x-ndjson"
_LOCAL = ("127.0.0.1", "localhost", "::1", "[::1]")
_CHUNK = 1 << 16
_SWEEP_S = 2.0


@dataclass(frozen=True, slots=True)
class Bounds:
    """What visitors may cost."""

    upload_bytes: int = 96 << 20
    #: An upload must be whole after so long.
    upload_s: float = 60.0
    #: Pictures that may be on their way or waiting at once.
    uploads: int = 4
    #: Pages that may watch the live camera.
    watchers: int = 8
    #: Open connections; of more, those that have asked for nothing are closed, oldest first.
    connections: int = 64
    #: A connection that has asked for nothing is closed after so long.
    idle_s: float = 15.0
    decoding: Limits = field(default_factory=Limits)


@dataclass(frozen=True, slots=True)
class Site:
    """What is served, and where."""

    options: ReceiverOptions
    host: str = "127.0.0.1"
    port: int = 8017
    #: Part of the address where the server can be reached from elsewhere; None: none is asked for.
    token: str | None = None
    device: Path | None = None
    camera: CameraSettings | None = None
    #: Where uploads are kept; None: nowhere.
    keep: Path | None = None
    bounds: Bounds = field(default_factory=Bounds)

    @property
    def prefix(self) -> str:
        """What every address starts with."""
        return f"/{self.token}" if self.token else ""

    def address(self, port: int) -> str:
        """What to open in a browser."""
        host = self.host if self.host not in ("0.0.0.0", "::") else own_address()
        return f"http://{f'[{host}]' if ':' in host else host}:{port}{self.prefix}/"


def own_address() -> str:
    """This machine's address in its network, as far as the system knows one; nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # never reached: an address for documentation (RFC 5737)
            return str(probe.getsockname()[0])
        except OSError:
            return "127.0.0.1"


class Server:
    """One running server; an async context manager.

    Raises:
        UsageError: the address cannot be used, or the folder to keep uploads in cannot be written.
    """

    def __init__(self, site: Site) -> None:
        self._site = site
        self._decoder = DecodingProcess(site.options, site.bounds.decoding)
        self._thread = ThreadPoolExecutor(1, "decode")
        self._folder = Path(tempfile.mkdtemp(prefix="vlc-rx-serve-"))
        self._n_uploads = 0
        self._watchers: set[asyncio.Queue[str]] = set()
        self._history: deque[str] = deque(maxlen=20)
        self._idle_since: dict[int, float] = {}
        self._live: Any = None
        #: The port, once the server runs.
        self.port = site.port

    async def __aenter__(self) -> Server:
        try:
            await self._start()
        except BaseException:
            await self._stop()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stop()

    @property
    def address(self) -> str:
        """What to open in a browser."""
        return self._site.address(self.port)

    async def _start(self) -> None:
        site = self._site
        if site.keep is not None:
            _make(site.keep)
        app = web.Application(middlewares=[self._guard], client_max_size=1 << 16)
        app.router.add_get(f"{site.prefix}/", self._index)
        app.router.add_get(f"{site.prefix}/asset/{{name}}", self._asset)
        app.router.add_post(f"{site.prefix}/photo", self._photo)
        app.router.add_get(f"{site.prefix}/live", self._events)
        self._runner = web.AppRunner(app, access_log=None, keepalive_timeout=site.bounds.idle_s)
        await self._runner.setup()
        try:
            await web.TCPSite(self._runner, site.host, site.port, backlog=32).start()
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UsageError(f"cannot serve at {site.host}:{site.port} ({reason})", "choose another --port") from None
        self.port = self._runner.addresses[0][1]
        loop = asyncio.get_running_loop()
        loop.run_in_executor(self._thread, self._decoder.start)
        self._sweeper = asyncio.create_task(self._sweep())
        if site.device is not None:
            from rxcli.ingest.v4l2 import CameraSettings
            from rxcli.web.live import LiveCamera

            camera = site.camera or CameraSettings(wait=True)

            def publish(event: dict[str, Any]) -> None:
                with contextlib.suppress(RuntimeError):  # the loop has ended
                    loop.call_soon_threadsafe(self._tell, event)

            self._live = LiveCamera(site.device, camera, site.options, publish)
            self._live.start()

    async def _stop(self) -> None:
        if self._live is not None:
            self._live.close()
        if hasattr(self, "_sweeper"):
            self._sweeper.cancel()
        if hasattr(self, "_runner"):
            await self._runner.cleanup()
        self._decoder.close()
        self._thread.shutdown(wait=True, cancel_futures=True)
        self._decoder.close()  # what the thread may have started meanwhile
        shutil.rmtree(self._folder, ignore_errors=True)

    # -- who may ask --------------------------------------------------------------------------------------------------

    @web.middleware
    async def _guard(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Refuse what comes from the pages of others, or to another name; add the headers that bind the browser."""
        if not self._is_ours(request):
            raise web.HTTPForbidden(text="not from this page", headers=_HEADERS)
        try:
            response: web.StreamResponse = await handler(request)
        except web.HTTPException as error:
            error.headers.update(_HEADERS)
            raise
        if not response.prepared:
            response.headers.update(_HEADERS)
        return response

    def _is_ours(self, request: web.Request) -> bool:
        site, host = self._site, request.host
        if site.token is not None:
            given = request.path.split("/")[1]
            if not hmac.compare_digest(given.encode(), site.token.encode()):
                raise web.HTTPNotFound(headers=_HEADERS)
        elif host.rsplit(":", 1)[0] not in (*_LOCAL, site.host):
            return False  # a name that somebody else has pointed at this machine
        origin = request.headers.get("Origin")
        return origin is None or origin in (f"http://{host}", f"https://{host}")

    async def _sweep(self) -> None:
        """Close connections that ask for nothing: long ones, and the oldest where there are too many."""
        bounds = self._site.bounds
        while True:
            await asyncio.sleep(_SWEEP_S)
            server = self._runner.server
            connections = list(server.connections) if server is not None else []
            now_s = time.monotonic()
            idle = [c for c in connections if getattr(c, "_current_request", None) is None]
            self._idle_since = {id(c): self._idle_since.get(id(c), now_s) for c in idle}
            idle.sort(key=lambda c: self._idle_since[id(c)])
            too_many = max(0, len(connections) - bounds.connections)
            for number, connection in enumerate(idle):
                if number < too_many or now_s - self._idle_since[id(connection)] > bounds.idle_s:
                    connection.force_close()
                    if connection.transport is not None:
                        connection.transport.abort()

    # -- addresses ----------------------------------------------------------------------------------------------------

    async def _index(self, request: web.Request) -> web.Response:
        text = (_PAGE / "index.html").read_text(encoding="utf-8")
        live = "yes" if self._site.device is not None else "no"
        largest = str(self._site.bounds.upload_bytes)
        kept = "not kept" if self._site.keep is None else "kept"
        text = text.replace("{{kept}}", kept).replace("{{live}}", live).replace("{{largest}}", largest)
        return web.Response(text=text, content_type="text/html")

    async def _asset(self, request: web.Request) -> web.Response:
        kind = _ASSETS.get(request.match_info["name"])
        if kind is None:
            raise web.HTTPNotFound(headers=_HEADERS)
        body = (_PAGE / request.match_info["name"]).read_bytes()
        return web.Response(body=body, content_type=kind, charset="utf-8")

    async def _photo(self, request: web.Request) -> web.StreamResponse:
        bounds = self._site.bounds
        if self._n_uploads >= bounds.uploads:
            return _answer(refusal("other pictures are being read just now", "try again in a few seconds"), 503)
        if (request.content_length or 0) > bounds.upload_bytes:
            return _answer(self._too_large(), 413, close=True)
        self._n_uploads += 1
        path = self._folder / uuid.uuid4().hex
        try:
            async with asyncio.timeout(bounds.upload_s):
                size = await self._save(request, path)
            if size is None:
                return _answer(self._too_large(), 413, close=True)
            if _LINES in request.headers.get("Accept", ""):
                return await self._answer_by_and_by(request, path)
            answer = await self._decoded(path, None)
            return _answer(answer, 200)
        except TimeoutError:
            slow = refusal(
                f"the picture took more than {bounds.upload_s:.0f} s to arrive", "move nearer to the network"
            )
            return _answer(slow, 408, close=True)
        except OSError as error:
            log.warning("an upload could not be stored: %s", error)
            return _answer(refusal("there is no room for the picture", "tell who runs this page"), 507, close=True)
        finally:
            path.unlink(missing_ok=True)
            self._n_uploads -= 1

    async def _decoded(self, path: Path, tell: Callable[[dict[str, Any]], None] | None) -> dict[str, Any]:
        loop = asyncio.get_running_loop()
        answer = await loop.run_in_executor(self._thread, self._decoder.decode, path, "the picture", tell)
        self._keep(path, answer)
        return answer

    async def _answer_by_and_by(self, request: web.Request, path: Path) -> web.StreamResponse:
        """A line of JSON for what is known of a clip so far, from time to time, and one for the whole answer."""
        response = web.StreamResponse(headers={**_HEADERS, "Content-Type": _LINES})
        await response.prepare(request)
        loop = asyncio.get_running_loop()
        lines: asyncio.Queue[dict[str, Any]] = asyncio.Queue()

        def tell(answer: dict[str, Any]) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(lines.put_nowait, answer)

        decoding = asyncio.create_task(self._decoded(path, tell))
        decoding.add_done_callback(lambda _: lines.put_nowait({}))
        with contextlib.suppress(ConnectionError):  # the upload stays until it is decoded, whoever still listens
            while answer := await lines.get():
                await response.write(json.dumps(answer).encode() + b"\n")
        whole = await decoding
        with contextlib.suppress(ConnectionError):
            await response.write(json.dumps(whole).encode() + b"\n")
        return response

    async def _save(self, request: web.Request, path: Path) -> int | None:
        """Write the body to `path`; its size, None where it is too large."""
        size = 0
        with path.open("wb") as file:
            async for chunk in _chunks(request):
                size += len(chunk)
                if size > self._site.bounds.upload_bytes:
                    return None
                file.write(chunk)
        return size

    def _too_large(self) -> dict[str, Any]:
        return refusal(
            f"the file is larger than {self._site.bounds.upload_bytes >> 20} MB", "send a photo, or a shorter clip"
        )

    def _keep(self, path: Path, answer: dict[str, Any]) -> None:
        """Keep the upload and what became of it, where that was asked for."""
        folder = self._site.keep
        if folder is None:
            return
        stem = time.strftime("%Y%m%d-%H%M%S-") + uuid.uuid4().hex[:8]
        record = {key: value for key, value in answer.items() if key != "picture"}
        try:
            shutil.copyfile(path, folder / f"{stem}{_suffix(path)}")
            (folder / f"{stem}.json").write_text(json.dumps(record), encoding="utf-8")
        except OSError as error:
            log.warning("an upload could not be kept: %s", error)

    async def _events(self, request: web.Request) -> web.StreamResponse:
        """What the live camera shows, as server-sent events."""
        if self._site.device is None:
            raise web.HTTPNotFound(headers=_HEADERS)
        if len(self._watchers) >= self._site.bounds.watchers:
            raise web.HTTPServiceUnavailable(text="too many pages watch already", headers=_HEADERS)
        response = web.StreamResponse(headers={**_HEADERS, "Content-Type": "text/event-stream"})
        await response.prepare(request)
        queue: asyncio.Queue[str] = asyncio.Queue(maxsize=3)
        for text in self._history:
            await response.write(f"data: {text}\n\n".encode())
        self._watchers.add(queue)
        try:
            while True:
                async with asyncio.timeout(30):
                    await response.write(f"data: {await _next(queue)}\n\n".encode())
        except (ConnectionError, TimeoutError, asyncio.CancelledError):
            return response
        finally:
            self._watchers.discard(queue)

    def _tell(self, event: dict[str, Any]) -> None:
        """Give an event to all who watch; one that lags misses pictures, not texts."""
        text = json.dumps(event)
        if event.get("texts"):
            self._history.append(json.dumps({"texts": event["texts"]}))
        for queue in self._watchers:
            while queue.full() and not event.get("texts"):
                queue.get_nowait()
            with contextlib.suppress(asyncio.QueueFull):
                queue.put_nowait(text)


async def _next(queue: asyncio.Queue[str]) -> str:
    """The next event, or an empty one that keeps the connection."""
    try:
        async with asyncio.timeout(10):
            return await queue.get()
    except TimeoutError:
        return "{}"


async def _chunks(request: web.Request) -> AsyncIterator[bytes]:
    while chunk := await request.content.read(_CHUNK):
        yield chunk


def _answer(answer: dict[str, Any], status: int, close: bool = False) -> web.Response:
    response = web.json_response(answer, status=status)
    if close:  # what is left of the body is not waited for
        response.force_close()
    return response


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"--keep {folder}: {error.strerror}", "name another folder") from None


def _suffix(path: Path) -> str:
    """A suffix for a kept upload, by what is in it, never by what it was called."""
    from rxcli.ingest.sniff import HEAD_BYTES, read_bytes, sniff

    kinds = {"jpeg": ".jpg", "png": ".png", "tiff": ".tif", "heif": ".heic", "raw": ".raw", "video": ".mp4"}
    return kinds.get(sniff(read_bytes(path, HEAD_BYTES), "") or "", ".bin")
