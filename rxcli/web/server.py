"""The page's HTTP server: a few fixed addresses, limits on everything, and no path that depends on a request.

`Bounds` limits the cost of visitors. If other machines can reach the page, its address contains a token. Requests from
pages of other origins are refused.
"""

import asyncio
import contextlib
import hmac
import itertools
import json
import logging
import os
import re
import shutil
import socket
import sys
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import NamedTemporaryFile, TemporaryFile
from typing import Any, Self

from aiohttp import web
from aiohttp.http_exceptions import HttpProcessingError

from rxcli.errors import UsageError, failure_explained
from rxcli.ingest.v4l2 import CameraSettings
from rxcli.options import ReceiverOptions
from rxcli.outputs import claim_folder
from rxcli.resources import data_dir, filled_page
from rxcli.web.decoding import DecodingProcess, refusal

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
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "X-Accel-Buffering": "no",  # a proxy passes on at once what is known so far
}
#: A line of JSON for each answer: partial answers, then the complete one.
_LINES = "application/x-ndjson"
#: Header that is equal for all photos to be combined, and its maximum length.
_SESSION, _SESSION_CHARACTERS = "X-Session", 64
_LOCAL = ("127.0.0.1", "localhost", "[::1]")
#: A name or address, and perhaps a port, as Host and Origin have them.
_HOST = re.compile(r"(\[[0-9a-fA-F:.]+\]|[^:\[\]/]+)(:\d*)?")
_EVERYWHERE = ("0.0.0.0", "::")
#: Addresses for documentation (RFC 5737, 3849), which are never reached.
_NOWHERE = {socket.AF_INET: "192.0.2.1", socket.AF_INET6: "2001:db8::1"}
#: Request of Linux for the address of an interface, where it stands in the answer, and where interfaces are described.
_INTERFACE_ADDRESS, _PLACE, _INTERFACES = 0x8915, slice(20, 24), Path("/sys/class/net")
_CHUNK = 1 << 16
#: Where the process that decodes opens a file of this one that has no name.
_OPEN_FILES = Path(f"/proc/{os.getpid()}/fd")
_PROXY = "open the address that the server shows; behind a proxy, start it with --proxy and the address of that"
#: Receives the answers of a picture or the events of a camera, one after the other.
_Publish = Callable[[dict[str, Any]], None]
_SWEEP_S = 2.0


@dataclass(frozen=True, slots=True)
class Bounds:
    """Limits on the cost of visitors."""

    upload_bytes: int = 96 << 20
    #: Maximum duration of an upload, and the time by which it may lag behind its minimum rate.
    upload_s: float = 60.0
    grace_s: float = 5.0
    #: Minimum rate of an upload, bytes a second.
    upload_rate: int = 32 << 10
    #: Maximum number of simultaneous uploads, and of complete pictures that wait to be decoded; a visitor gets half.
    uploads: int = 4
    waiting: int = 8
    #: Maximum size of the folder of uploads that are stored permanently.
    keep_bytes: int = 4 << 30
    #: Time within which a client must accept a part of an answer.
    answer_s: float = 30.0
    #: Maximum number of pages that watch the live camera.
    watchers: int = 8
    #: Maximum number of open connections; beyond it, idle ones are closed, oldest first.
    connections: int = 64
    #: Time after which an idle connection is closed.
    idle_s: float = 15.0


@dataclass(frozen=True, slots=True)
class Site:
    """What is served, and at which address."""

    options: ReceiverOptions
    host: str = "127.0.0.1"
    port: int = 8017
    #: Secret part of the address if other machines can reach the server, or None.
    token: str | None = None
    #: Name or address under which a proxy shows the page, or None.
    proxy: str | None = None
    device: Path | None = None
    camera: CameraSettings = field(default_factory=lambda: CameraSettings(wait=True))
    #: Folder in which uploads are stored permanently, or None.
    keep: Path | None = None
    bounds: Bounds = field(default_factory=Bounds)

    @property
    def prefix(self) -> str:
        """What every address starts with."""
        return f"/{self.token}" if self.token else ""

    @property
    def proxy_name(self) -> str | None:
        """Name by which a proxy shows the page."""
        return None if self.proxy is None else _name_of(self.proxy.partition("://")[2].split("/")[0])

    def addresses(self, port: int) -> list[str]:
        """What to open in a browser, the likeliest first."""
        if self.proxy is not None:
            return [f"{self.proxy.rstrip('/')}{self.prefix}/"]
        hosts = own_addresses() if self.host in _EVERYWHERE else [self.host]
        return [f"http://{_bracketed(host)}:{port}{self.prefix}/" for host in hosts]


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _name_of(host: str) -> str | None:
    """Host without its port; None where it is none."""
    found = _HOST.fullmatch(host)
    return found[1].lower() if found else None


def own_addresses() -> list[str]:
    """This machine's addresses in its networks; those of cables and radio first, since a VPN leads elsewhere."""
    found = [own for family in _NOWHERE if (own := _routed(family))]
    if sys.platform == "linux":
        import fcntl

        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            for _, name in socket.if_nameindex():
                with contextlib.suppress(OSError):  # it has none
                    answer = fcntl.ioctl(probe, _INTERFACE_ADDRESS, name.encode().ljust(40, b"\0"))
                    own = socket.inet_ntoa(answer[_PLACE])
                    found.insert(0 if (_INTERFACES / name / "device").exists() else len(found), own)
    shown = [own for own in dict.fromkeys(found) if not own.startswith("127.")]
    return shown or ["127.0.0.1"]


def _routed(family: socket.AddressFamily) -> str | None:
    """The address by which this machine would send to others, or None; nothing is sent."""
    with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.connect((_NOWHERE[family], 9))
        return str(probe.getsockname()[0])
    return None


@dataclass(eq=False, slots=True)
class _Upload:
    """A picture being uploaded."""

    visitor: str | None
    begun_s: float
    limit: asyncio.Timeout
    n_bytes: int = 0

    def is_slow(self, now_s: float, rate: int) -> bool:
        """Whether it is below the minimum rate after its first second."""
        return now_s - self.begun_s > 1.0 and self.n_bytes < rate * (now_s - self.begun_s)


class Server:
    """One running server; an async context manager.

    Raises:
        UsageError: the address cannot be used, or the folder to keep uploads in cannot be written.
    """

    def __init__(self, site: Site) -> None:
        self._site = site
        self._decoder = DecodingProcess(site.options)
        self._thread = ThreadPoolExecutor(1, "decode")
        self._arriving: list[_Upload] = []
        #: Visitors and callbacks of waiting pictures, in the order of decoding; each receives its place in the queue.
        self._queue: list[tuple[str | None, _Publish]] = []
        #: Oldest first.
        self._watchers: dict[asyncio.Queue[str], web.Request] = {}
        self._history: deque[str] = deque(maxlen=20)
        self._idle_since: dict[int, float] = {}
        #: Numbers of pictures: combined photos need distinct names.
        self._numbers = itertools.count(1)
        self._live: Any = None
        #: The port, once the server runs.
        self.port = site.port

    async def __aenter__(self) -> Self:
        try:
            await self._start()
        except BaseException:
            await self._stop()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stop()

    @property
    def addresses(self) -> list[str]:
        """What to open in a browser, the likeliest first."""
        return self._site.addresses(self.port)

    @property
    def address(self) -> str:
        """The likeliest address."""
        return self.addresses[0]

    async def _start(self) -> None:
        site = self._site
        if site.keep is not None:
            claim_folder("--keep", site.keep)
            self._kept_bytes = sum(path.stat().st_size for path in site.keep.iterdir() if path.is_file())
        app = web.Application(middlewares=[self._guard], client_max_size=1 << 16)
        app.router.add_get(f"{site.prefix}/", self._index)
        if site.token is not None:  # as people type it
            app.router.add_get(site.prefix, self._with_slash)
        app.router.add_get(f"{site.prefix}/asset/{{name}}", self._asset)
        app.router.add_post(f"{site.prefix}/photo", self._photo)
        app.router.add_get(f"{site.prefix}/live", self._events)
        self._runner = web.AppRunner(
            app, access_log=None, keepalive_timeout=site.bounds.idle_s, logger=_requests_log(), shutdown_timeout=1.0
        )
        await self._runner.setup()
        loop = asyncio.get_running_loop()
        await loop.run_in_executor(self._thread, self._decoder.start)
        with failure_explained(f"cannot serve at {site.host}:{site.port}", "choose another --port", UsageError):
            if site.host == "::" and socket.has_dualstack_ipv6():  # asyncio would not listen to IPv4
                dual = socket.create_server(("::", site.port), family=socket.AF_INET6, dualstack_ipv6=True)
                await web.SockSite(self._runner, dual, backlog=32).start()
            else:
                await web.TCPSite(self._runner, site.host, site.port, backlog=32).start()
        self.port = self._runner.addresses[0][1]
        self._sweeper = asyncio.create_task(self._sweep())
        if site.device is not None:
            from rxcli.web.live import LiveCamera

            publish = _from_thread(loop, self._broadcast)
            self._live = LiveCamera(site.device, site.camera, site.options, publish)
            self._live.start()

    async def _stop(self) -> None:
        try:
            if self._live is not None:
                self._live.close()
            if hasattr(self, "_sweeper"):
                self._sweeper.cancel()
            if hasattr(self, "_runner"):
                await self._runner.cleanup()
        finally:  # whatever becomes of the connections
            self._decoder.close()
            self._thread.shutdown(wait=True, cancel_futures=True)
            self._decoder.close()  # what the thread may have started meanwhile

    # -- access control -----------------------------------------------------------------------------------------------

    @web.middleware
    async def _guard(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Refuse requests from other origins or to other host names, and add the security headers."""
        if self._site.proxy and (senders := request.headers.get("X-Forwarded-For")):
            request = request.clone(remote=senders.rpartition(",")[2].strip())  # else all share one visitor's places
        try:
            response: web.StreamResponse = self._refused_visit(request) or await handler(request)
        except web.HTTPException as error:
            error.headers.update(_HEADERS)
            raise
        if not response.prepared:
            response.headers.update(_HEADERS)
            with self._taken_in_time(request):
                async with asyncio.timeout(self._site.bounds.answer_s):
                    await response.prepare(request)
                    await response.write_eof()
        return response

    @contextlib.contextmanager
    def _taken_in_time(self, request: web.Request) -> Iterator[None]:
        """Abort the connection of a client that does not accept data in time or has disconnected."""
        try:
            yield
        except (ConnectionError, TimeoutError):
            _abort(request)

    def _refused_visit(self, request: web.Request) -> web.Response | None:
        """The answer to a request that is not for this page, or not from it; None for the others."""
        site, host, name = self._site, request.host, _name_of(request.host)
        if site.token is not None:
            given = request.path.removeprefix("/").split("/")[0]
            if not hmac.compare_digest(given.encode(), site.token.encode()):
                raise web.HTTPNotFound(headers=_HEADERS)
        own_names = (*_LOCAL, _bracketed(site.host), site.proxy_name) if site.token is None else (name,)
        if name is None or name not in own_names:  # perhaps one that somebody else has pointed at this machine
            return _refused(403, "the page was asked for by another name than its own", _PROXY)
        is_visit = request.method == "GET" and request.headers.get("Sec-Fetch-Dest") == "document"
        headers = request.headers
        sender, origin = headers.get("Sec-Fetch-Site"), headers.get("Origin", "").partition("://")[2]
        if sender is None and "Origin" in headers:  # without encryption, browsers state the origin alone
            is_own = bool(origin) and origin in (host, headers.get("X-Forwarded-Host"))
            is_shown = site.proxy_name is not None and _name_of(origin) == site.proxy_name
            sender = "same-origin" if is_own or is_shown else "cross-site"
        if not is_visit and sender not in (None, "none", "same-origin"):
            return _refused(403, "the request came from another page", _PROXY)
        return None

    async def _sweep(self) -> None:
        """Close idle connections: after a time, and the oldest ones if there are too many."""
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
                max_s = bounds.answer_s if _is_taking(connection) else bounds.idle_s
                if number < too_many or now_s - self._idle_since[id(connection)] > max_s:
                    connection.force_close()
                    if connection.transport is not None:
                        connection.transport.abort()

    # -- addresses ----------------------------------------------------------------------------------------------------

    async def _index(self, request: web.Request) -> web.Response:
        site = self._site
        retention, live = "not kept" if site.keep is None else "kept", "no" if site.device is None else "yes"
        text = filled_page("index.html", {"kept": retention, "live": live, "largest": site.bounds.upload_bytes})
        return web.Response(text=text, content_type="text/html")

    async def _with_slash(self, request: web.Request) -> web.Response:
        raise web.HTTPPermanentRedirect(f"{self._site.token}/")

    async def _asset(self, request: web.Request) -> web.Response:
        kind = _ASSETS.get(request.match_info["name"])
        if kind is None:
            raise web.HTTPNotFound(headers=_HEADERS)
        body = (_PAGE / request.match_info["name"]).read_bytes()
        return web.Response(body=body, content_type=kind, charset="utf-8")

    async def _photo(self, request: web.Request) -> web.StreamResponse:
        bounds = self._site.bounds
        self._make_room(request.remote)
        uploading, waiting = [upload.visitor for upload in self._arriving], [visitor for visitor, _ in self._queue]
        if _is_full(uploading, bounds.uploads, request.remote) or _is_full(waiting, bounds.waiting, request.remote):
            busy = refusal("other pictures are being read just now", "try again in a few seconds")
            return web.json_response(busy, status=503)
        try:
            # Without a name: whatever ends the server, nothing is left.
            with TemporaryFile() if _OPEN_FILES.is_dir() else NamedTemporaryFile(prefix="vlc-rx-") as file:
                path = _OPEN_FILES / str(file.fileno()) if _OPEN_FILES.is_dir() else Path(file.name)
                if not await self._save(request, file):
                    large = f"the file is larger than {bounds.upload_bytes >> 20} MB"
                    return _refused(413, large, "send a photo, or a shorter clip")
                if _LINES in request.headers.get("Accept", ""):
                    return await self._answer_by_and_by(request, path)
                return web.json_response(await self._decoded(request, path, lambda _: None))
        except TimeoutError:
            return _refused(408, "the picture took too long to arrive", "move nearer to the network")
        except OSError as error:
            log.warning("an upload could not be stored: %s", error)
            return _refused(507, "there is no room for the picture", "inform the operator of this page")

    def _make_room(self, visitor: str | None) -> None:
        """If all upload places are taken, or a visitor's share, end the slowest such upload below the minimum rate."""
        bounds, now_s = self._site.bounds, asyncio.get_running_loop().time()
        taken = [upload for upload in self._arriving if upload.visitor == visitor]
        if len(self._arriving) >= bounds.uploads:
            taken = self._arriving
        slow = [upload for upload in taken if upload.is_slow(now_s, bounds.upload_rate)]
        if slow and _is_full([upload.visitor for upload in self._arriving], bounds.uploads, visitor):
            slowest = min(slow, key=lambda upload: upload.n_bytes / (now_s - upload.begun_s))
            slowest.limit.reschedule(now_s)
            self._arriving.remove(slowest)

    async def _decoded(self, request: web.Request, path: Path, publish: _Publish) -> dict[str, Any]:
        """Answer of an upload in its turn; `publish` receives its place in the queue and partial answers."""
        loop = asyncio.get_running_loop()
        waiting = request.remote, publish
        self._queue.append(waiting)
        self._publish_places()
        try:
            answer = await loop.run_in_executor(self._thread, self._decode_for, request, path, publish)
        finally:
            self._queue.remove(waiting)
            self._publish_places()
        self._keep(path, answer)
        return answer

    def _decode_for(self, request: web.Request, path: Path, publish: _Publish) -> dict[str, Any]:
        if request.transport is None or request.transport.is_closing():
            return refusal("nobody waits for the answer", "send it again")
        session = request.headers.get(_SESSION, "")[:_SESSION_CHARACTERS]
        return self._decoder.decode(path, f"picture {next(self._numbers)}", publish, session)

    def _publish_places(self) -> None:
        """Send their place in the queue to all waiting pictures but the first."""
        for place, (_, publish) in enumerate(self._queue):
            if place:
                publish({"status": "waiting", "place": place, "partial": True})

    async def _answer_by_and_by(self, request: web.Request, path: Path) -> web.StreamResponse:
        """Stream partial answers of a clip and the complete answer, one line of JSON each."""
        response = web.StreamResponse(headers={**_HEADERS, "Content-Type": _LINES})
        await response.prepare(request)
        loop = asyncio.get_running_loop()
        lines: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        decoding = asyncio.create_task(self._decoded(request, path, _from_thread(loop, lines.put_nowait)))
        decoding.add_done_callback(lambda _: lines.put_nowait({}))
        with self._taken_in_time(request):  # the upload stays until it is decoded, even if nobody listens any more
            while answer := await lines.get():
                await self._write_line(response, answer)
        whole = await decoding
        with self._taken_in_time(request):
            await self._write_line(response, whole)
            async with asyncio.timeout(self._site.bounds.answer_s):
                await response.write_eof()
        return response

    async def _write_line(self, response: web.StreamResponse, answer: dict[str, Any]) -> None:
        async with asyncio.timeout(self._site.bounds.answer_s):
            await response.write(json.dumps(answer).encode() + b"\n")

    async def _save(self, request: web.Request, file: Any) -> bool:
        """Write the body to `file`; returns whether it is small enough.

        Raises:
            TimeoutError: the upload is too slow.
        """
        bounds = self._site.bounds
        begun_s = asyncio.get_running_loop().time()
        if (request.content_length or 0) > bounds.upload_bytes:
            return False
        async with asyncio.timeout(bounds.grace_s) as limit:
            upload = _Upload(request.remote, begun_s, limit)
            self._arriving.append(upload)
            try:
                while chunk := await request.content.read(_CHUNK):
                    upload.n_bytes += len(chunk)
                    if upload.n_bytes > bounds.upload_bytes:
                        return False
                    file.write(chunk)
                    late_s = bounds.grace_s + upload.n_bytes / bounds.upload_rate
                    if upload in self._arriving:
                        limit.reschedule(begun_s + min(bounds.upload_s, late_s))
                file.flush()
            finally:
                if upload in self._arriving:
                    self._arriving.remove(upload)
        return True

    def _keep(self, path: Path, answer: dict[str, Any]) -> None:
        """Store the upload and its result, if requested."""
        folder = self._site.keep
        if folder is None:
            return
        stem = time.strftime("%Y%m%d-%H%M%S-") + uuid.uuid4().hex[:8]
        record = json.dumps({key: value for key, value in answer.items() if key != "picture"})
        try:
            n_bytes = path.stat().st_size + len(record)
            if self._kept_bytes + n_bytes > self._site.bounds.keep_bytes:
                log.warning("an upload was not kept: %s holds %d MB; empty it", folder, self._kept_bytes >> 20)
                return
            self._kept_bytes += n_bytes
            shutil.copyfile(path, folder / f"{stem}{_suffix(path)}")
            (folder / f"{stem}.json").write_text(record, encoding="utf-8")
        except OSError as error:
            log.warning("an upload could not be kept: %s", error)

    async def _events(self, request: web.Request) -> web.StreamResponse:
        """Events of the live camera, as server-sent events."""
        if self._site.device is None:
            raise web.HTTPNotFound(headers=_HEADERS)
        watching = [watcher.remote for watcher in self._watchers.values()]
        if _is_full(watching, self._site.bounds.watchers, request.remote):
            late = [queue for queue, watcher in self._watchers.items() if _is_taking(watcher)]
            if not late:
                raise web.HTTPServiceUnavailable(text="too many pages watch already", headers=_HEADERS)
            _abort(self._watchers.pop(late[0]))
        response = web.StreamResponse(headers={**_HEADERS, "Content-Type": "text/event-stream"})
        await response.prepare(request)
        queue: asyncio.Queue[str] = asyncio.Queue(maxsize=3)
        history = list(self._history)
        self._watchers[queue] = request
        try:
            with self._taken_in_time(request):
                while True:
                    text = history.pop(0) if history else await _next(queue)
                    async with asyncio.timeout(self._site.bounds.answer_s):
                        await response.write(f"data: {text}\n\n".encode())
        finally:
            self._watchers.pop(queue, None)
        return response

    def _broadcast(self, event: dict[str, Any]) -> None:
        """Send an event to all watching pages; a slow page misses pictures, but no texts."""
        text = json.dumps(event)
        if event.get("texts"):
            self._history.append(json.dumps({"texts": event["texts"]}))
        for queue in self._watchers:
            while queue.full() and not event.get("texts"):
                queue.get_nowait()
            with contextlib.suppress(asyncio.QueueFull):
                queue.put_nowait(text)


def _from_thread(loop: asyncio.AbstractEventLoop, publish: _Publish) -> _Publish:
    """`publish` for callers in other threads, who may outlive the loop."""

    def call(answer: dict[str, Any]) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(publish, answer)

    return call


def _is_full(visitors: list[str | None], n_places: int, visitor: str | None) -> bool:
    """Whether no place is left, or half of them are a visitor's."""
    return len(visitors) >= n_places or visitors.count(visitor) >= max(1, n_places // 2)


async def _next(queue: asyncio.Queue[str]) -> str:
    """The next event, or an empty one that keeps the connection open."""
    try:
        async with asyncio.timeout(10):
            return await queue.get()
    except TimeoutError:
        return "{}"


def _is_taking(asked: Any) -> bool:
    """Whether a connection or request has unsent data."""
    return asked.transport is not None and asked.transport.get_write_buffer_size() > 0


def _abort(request: web.Request) -> None:
    if request.transport is not None:
        request.transport.abort()


def _requests_log() -> logging.Logger:
    """Log of aiohttp's errors, without those of requests that are not HTTP."""
    requests = logging.getLogger(f"{__name__}.requests")
    if not requests.filters:
        requests.addFilter(lambda record: not (record.exc_info and isinstance(record.exc_info[1], HttpProcessingError)))
    return requests


def _refused(status: int, reason: str, step: str) -> web.Response:
    response = web.json_response(refusal(reason, step), status=status)
    response.force_close()  # the rest of the body is not awaited
    return response


def _suffix(path: Path) -> str:
    """Suffix of a stored upload, from its content and never from its name."""
    from rxcli.ingest.sniff import HEAD_BYTES, read_bytes, sniff

    kinds = {"jpeg": ".jpg", "tiff": ".tif", "heif": ".heic", "video": ".mp4", "other_image": ".bin"}
    kind = sniff(read_bytes(path, HEAD_BYTES), "") or "bin"
    return kinds.get(kind, f".{kind}")
