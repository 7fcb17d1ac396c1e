"""The page's server: what it answers, who may ask, what it costs; and the page itself in a browser."""

import asyncio
import base64
import contextlib
import io
import itertools
import json
import multiprocessing
import os
import pickle
import signal
import socket
import subprocess
import tempfile
import threading
import time
import zlib
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_frames import N_COLUMNS, write_frame, write_profiles

pytest.importorskip("aiohttp")
pytest.importorskip("segno")

import aiohttp
from browser import CHROMIUM, Browser
from commands import COMMAND, ENVIRONMENT
from fake_camera import Bench
from PIL import Image

from rxcli.cli.main import run
from rxcli.ingest import open_source
from rxcli.lab.benchmark.goodput import detect
from rxcli.link.encoder import message
from rxcli.options import ReceiverOptions, receiver_options
from rxcli.profiles import ScreenProfile, load_profile
from rxcli.results.columns import text_rows
from rxcli.runs.processes import resident_bytes
from rxcli.types import ColumnResult, FrameResult, FrameSoftBits, Message, PacketResult, ReceivedObject
from rxcli.web.decoding import DecodingProcess, _by_session, answer_for
from rxcli.web.live import live_events
from rxcli.web.server import Bounds, Server, Site, own_addresses

SAMPLES = Path(__file__).resolve().parents[2] / "sample_frames"
MEGABYTE = 1 << 20
CLIP, VIDEO_CAMERA = SAMPLES / "video1080_chelsea_17k3.mp4", str(SAMPLES / "video1080.toml")
LINES = {"Accept": "application/x-ndjson"}
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's chromium")


@pytest.fixture(autouse=True)
def own_folder(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Uploads of other servers of this machine lie elsewhere."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path_factory.mktemp("uploads")))


@pytest.fixture
def options(tmp_path: Path) -> ReceiverOptions:
    """Of a receiver of small frames."""
    names = write_profiles(tmp_path)
    corners = tuple(tuple(float(part) for part in text.split(",")) for text in names[5:])
    return receiver_options(screens=(names[1],), cameras=(names[3],), corners=corners)  # type: ignore[arg-type]


def serving(site: Site, work: Callable[[Server, Any], Awaitable[Any]]) -> None:
    """Run `work` with a server and a client."""

    async def body() -> None:
        async with Server(site) as server, aiohttp.ClientSession() as client:
            await work(server, client)

    asyncio.run(body())


async def post(server: Server, client: Any, data: Any, **more: Any) -> tuple[int, Any]:
    body = io.BytesIO(data) if isinstance(data, bytes) else data
    async with client.post(server.address + "photo", data=body, **more) as answer:
        return answer.status, await answer.json()


def uploads(pid: int, folder: Path) -> int:
    """Bytes of the files in a folder, and of those without a name that a process has open there."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    for handle in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):
            files += [handle] if os.readlink(handle).startswith(f"{folder}/") else []
    return sum(path.stat().st_size for path in files)


async def emptied() -> None:
    """Wait until the server of this test keeps no upload; one goes just after its answer."""
    for _ in range(200):
        if not uploads(os.getpid(), Path(tempfile.gettempdir())):
            return
        await asyncio.sleep(0.05)
    raise AssertionError("an upload is left")


def leftovers() -> list[str]:
    return os.listdir(tempfile.gettempdir())


def visiting(number: int) -> Any:
    """A client with an address of its own on this machine."""
    return aiohttp.ClientSession(connector=aiohttp.TCPConnector(local_addr=(f"127.0.0.{number}", 0)))


def test_a_photo_gives_payloads_or_a_reason_without_a_path_and_is_not_kept(
    tmp_path: Path, options: ReceiverOptions
) -> None:
    payloads = write_frame(tmp_path / "a.png", 3)

    async def work(server: Server, client: Any) -> None:
        status, answer = await post(server, client, (tmp_path / "a.png").read_bytes())
        assert (status, answer["status"]) == (200, "ok")
        assert [packet["payload"] for packet in answer["packets"]] == payloads
        assert len(answer["picture"]["outlines"]) == N_COLUMNS
        for data, told in ((b"hello", "Neither a picture nor a clip"), (b"", "The file is empty (0 bytes)")):
            _, answer = await post(server, client, data)
            assert answer["status"] == "unreadable"
            assert answer["reason"].startswith(told)
            assert "/" not in answer["reason"]
            assert answer["advice"]
        await emptied()

    serving(Site(options, port=0), work)
    assert leftovers() == []


def test_photos_of_a_session_add_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Photos none of which shows enough of a text give it together; those of another session do not help."""
    screen, rng = load_profile("data-17k3", ScreenProfile), np.random.default_rng(6)
    n = screen.payload_symbols
    options, sending = receiver_options(screens=screen, soft_bits=True), message("z" * 150)

    def results(*_: Any) -> Iterator[FrameResult]:
        llr = detect(sending.labels(rng.integers(0, 100, 1), 20, n), 5, (7.0,) * 20, rng)
        llr[:, rng.permutation(n)[n // 2 :]] = 0
        soft = FrameSoftBits(np.arange(1), llr)
        yield replace(result_of("partial", packets=1), screen_profile=screen.name, soft_bits=soft)

    monkeypatch.setattr("rxcli.runs.batch.Decoder.results", results)
    photos_of: Any = _by_session(options)

    def texts(session: str) -> list[str]:
        answer = answer_for(tmp_path / "a.jpg", "a", options, photos=photos_of(session) if session else None)
        return [item["text"] for item in answer["texts"]]

    came = [texts("mine") for _ in range(12)]
    assert came[0] == []
    assert [text for photo in came for text in photo] == ["z" * 150]
    assert texts("another") == texts("") == []
    mine = photos_of("mine")
    for number in range(20):
        texts(str(number))
    assert photos_of.cache_info().currsize == 8  # the latest
    assert photos_of("mine") is not mine


def test_a_photo_that_gives_its_text_without_a_packet_is_no_failure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = FrameResult("a", 0, 0.0, "ok", messages=(Message("text", b"hello", "a", 0, 0.0),))
    monkeypatch.setattr("rxcli.runs.batch.Decoder.results", lambda *_: iter([read]))
    answer = answer_for(tmp_path / "a.jpg", "a", receiver_options(soft_bits=True))
    assert [answer[key] for key in ("status", "headline", "reason", "advice")] == ["ok", "Received", "", ""]


def test_a_clip_is_answered_by_and_by() -> None:
    """What was received so far comes while the rest is read; at last the whole comes, as it does without."""

    async def work(server: Server, client: Any) -> None:
        data = CLIP.read_bytes()
        async with client.post(server.address + "photo", data=io.BytesIO(data), headers=LINES) as answer:
            assert answer.content_type == "application/x-ndjson"
            *before, whole = [json.loads(line) async for line in answer.content]
        assert before
        assert all(part["partial"] and part["packets"] for part in before)
        assert before[0]["picture"]["outlines"]
        assert "partial" not in whole
        assert len(before[0]["packets"]) < len(whole["packets"]) == 360
        assert whole["packets"][: len(before[0]["packets"])] == before[0]["packets"]
        assert (await post(server, client, data))[1]["packets"] == whole["packets"]

    serving(Site(receiver_options(cameras=(VIDEO_CAMERA,)), port=0), work)


def test_who_goes_away_while_a_clip_is_read_leaves_nothing() -> None:
    async def work(server: Server, client: Any) -> None:
        async with client.post(server.address + "photo", data=io.BytesIO(CLIP.read_bytes()), headers=LINES) as answer:
            answer.close()
        status, answer = await post(server, client, b"hello")  # is read after the clip
        assert (status, answer["status"]) == (200, "unreadable")
        await emptied()

    serving(Site(receiver_options(cameras=(VIDEO_CAMERA,)), port=0), work)
    assert leftovers() == []


def test_uploads_are_kept_where_that_is_asked_for(tmp_path: Path, options: ReceiverOptions) -> None:
    write_frame(tmp_path / "a.png", 3)
    data, more = (tmp_path / "a.png").read_bytes(), {"headers": {"X-Name": "../../evil", "X-Session": "x" * 999}}
    serving(Site(options, port=0, keep=tmp_path / "kept"), lambda server, client: post(server, client, data, **more))
    full = Site(options, port=0, keep=tmp_path / "kept", bounds=Bounds(keep_bytes=2 * len(data)))
    serving(full, lambda server, client: post(server, client, data, **more))  # there is no room for another
    record, picture = sorted((tmp_path / "kept").iterdir())
    assert (record.suffix, picture.suffix) == (".json", ".png")
    assert picture.read_bytes() == data
    assert len(json.loads(record.read_text())["packets"]) == N_COLUMNS


def test_who_may_ask(options: ReceiverOptions) -> None:
    async def status(client: Any, address: str, **more: Any) -> int:
        async with client.get(address, **more) as answer:
            assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
            assert answer.status != 200 or "script-src 'self'" in answer.headers["Content-Security-Policy"]
            return int(answer.status)

    async def local(server: Server, client: Any) -> None:
        assert await status(client, server.address) == 200
        for host in ("evil.example", "localhost:http", "localhost:80:80", "localhost:8x", "a@localhost"):
            assert await status(client, server.address, headers={"Host": host}) == 403, host
        for host in ("localhost", "localhost:80", "127.0.0.1:80", "[::1]:80"):
            assert await status(client, server.address, headers={"Host": host}) == 200, host
        assert await status(client, server.address, headers={"Origin": "http://evil.example"}) == 403
        visit = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "document"}
        assert await status(client, server.address, headers=visit) == 200  # a link on another page
        for site, path in (("cross-site", "live"), ("same-site", "asset/app.js"), ("cross-site", "")):
            embedded = {"Sec-Fetch-Site": site, "Sec-Fetch-Dest": "script"}
            assert await status(client, server.address + path, headers=embedded) == 403
        assert await status(client, server.address + "asset/app.js") == 200
        assets = ("asset/server.py", "asset/..%2fserver.py", "asset/%2e%2e/server.py")
        for name in (*assets, "live", "etc/passwd", "photo"):
            assert await status(client, server.address + name) in (404, 405), name

    async def elsewhere(server: Server, client: Any) -> None:
        assert "/secret/" in server.address
        assert await status(client, server.address) == 200
        root = server.address.removesuffix("secret/")
        for path in ("", "photo", "secre/", "asset/app.js"):
            assert await status(client, root + path) == 404

    serving(Site(options, port=0), local)
    serving(Site(options, port=0, host="0.0.0.0", token="secret"), elsewhere)


LAB, SAME = "lab.example.org", {"Sec-Fetch-Site": "same-origin"}


@pytest.mark.parametrize(
    ("proxy", "expected"),
    [  # as nginx passes a request on by default, of a browser over HTTPS; over HTTP; with the host that it was sent to
        (
            None,
            [
                ({"Origin": f"https://{LAB}", **SAME}, 200),
                ({"Origin": f"http://{LAB}"}, 403),
                ({"Origin": f"http://{LAB}", "X-Forwarded-Host": LAB}, 200),
                ({"Origin": f"https://{LAB}", "Host": LAB, **SAME}, 403),  # a name that is pointed at this machine
                ({"Origin": "null"}, 403),
                ({"Host": "localhost:1x"}, 403),
            ],
        ),
        (
            f"http://{LAB}:8080/rx",
            [
                ({"Origin": f"http://{LAB}:8080"}, 200),
                ({"Origin": f"http://{LAB}:8080", "Host": LAB, **SAME}, 200),
                ({"Origin": "https://evil.example"}, 403),
                ({"Origin": "null"}, 403),
                ({"Origin": f"http://{LAB}:8080", "Sec-Fetch-Site": "cross-site"}, 403),
            ],
        ),
    ],
    ids=["unnamed", "named"],
)
def test_behind_a_proxy(
    options: ReceiverOptions, proxy: str | None, expected: list[tuple[dict[str, str], int]]
) -> None:
    async def work(server: Server, client: Any) -> None:
        for headers, status in expected:
            async with client.post(f"http://127.0.0.1:{server.port}/photo", data=b"hello", headers=headers) as answer:
                assert (answer.status, headers) == (status, headers)
                assert set(await answer.json()) >= {"reason", "advice"}
        assert proxy is None or server.address == f"{proxy}/"

    serving(Site(options, port=0, proxy=proxy), work)


def test_visitors_of_a_proxy_are_told_apart(options: ReceiverOptions) -> None:
    """One of them gets half of the places."""

    async def work(server: Server, client: Any) -> None:
        held = "POST /photo", "Content-Length: 9\r\nX-Forwarded-For: 10.0.0.1, 10.0.0."
        slow = [await raw(server, held[0], f"{held[1]}{n}\r\n\r\n".encode()) for n in (7, 7, 8)]
        await asyncio.sleep(0.2)
        visitors = [upload.visitor for upload in server._arriving]
        for _, writer in slow:
            writer.close()
        assert visitors == ["10.0.0.7", "10.0.0.7", "10.0.0.8"]

    serving(Site(options, port=0, proxy="https://lab.example.org"), work)


def test_the_address_opens(options: ReceiverOptions, monkeypatch: pytest.MonkeyPatch) -> None:
    """By IPv6 and IPv4, with and without its last slash."""

    async def work(server: Server, client: Any) -> None:
        for host in ("127.0.0.1", "[::1]"):
            for slash in ("", "/"):
                async with client.get(f"http://{host}:{server.port}/secret{slash}") as answer:
                    assert answer.status == 200
        assert all(address.endswith(f":{server.port}/secret/") for address in server.addresses)

    serving(Site(options, port=0, host="::", token="secret"), work)


def test_addresses_without_a_route_and_with_a_tunnel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of interfaces with a device first: what sends to others may be a tunnel."""
    addresses = {"lo": "127.0.0.1", "tun0": "10.8.0.2", "wlan0": "192.168.1.7", "docker0": "172.17.0.1"}

    def ask(_: object, _request: int, data: bytes) -> bytes:
        name = data.rstrip(b"\0").decode()
        if name not in addresses:
            raise OSError(99, "Cannot assign requested address")
        return bytes(20) + socket.inet_aton(addresses[name]) + bytes(16)

    (tmp_path / "wlan0" / "device").mkdir(parents=True)
    monkeypatch.setattr("rxcli.web.server._INTERFACES", tmp_path)
    monkeypatch.setattr("fcntl.ioctl", ask)
    monkeypatch.setattr("socket.if_nameindex", lambda: list(enumerate(["eth0", *addresses])))
    monkeypatch.setattr("rxcli.web.server._routed", {socket.AF_INET: "10.8.0.2", socket.AF_INET6: None}.get)
    assert own_addresses() == ["192.168.1.7", "10.8.0.2", "172.17.0.1"]
    monkeypatch.setattr("rxcli.web.server._routed", lambda _: None)
    assert own_addresses()[0] == "192.168.1.7"
    addresses.clear()
    assert own_addresses() == ["127.0.0.1"]


async def raw(
    server: Server, head: str, body: bytes = b"", visitor: int = 1
) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Send a request as it stands."""
    own = (f"127.0.0.{visitor}", 0)
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port, limit=1 << 12, local_addr=own)
    writer.write(f"{head} HTTP/1.1\r\nHost: localhost\r\n".encode() + b"\r\n" * (b"\r\n\r\n" not in body) + body)
    await writer.drain()
    return reader, writer


def test_who_sends_a_byte_a_second_keeps_nobody_out(options: ReceiverOptions) -> None:
    body = b"Content-Length: 1000000\r\n\r\nx"

    async def work(server: Server, client: Any) -> None:
        slow = [await raw(server, "POST /photo", body, visitor) for visitor in (1, 2)]
        await asyncio.sleep(1.5)
        status, answer = await post(server, client, b"hello")
        assert (status, answer["status"]) == (200, "unreadable")
        heads = [asyncio.create_task(reader.readline()) for reader, _ in slow]
        done, _ = await asyncio.wait(heads, return_when="FIRST_COMPLETED")
        assert b" 408 " in done.pop().result()
        for _, writer in slow:
            writer.close()

    async def alone(server: Server, client: Any) -> None:
        reader, writer = await raw(server, "POST /photo", body)
        # The connection itself ends only after the server has waited for the rest of the body.
        assert b" 408 " in await reader.readline()
        await reader.readuntil(b"took too long to arrive")
        writer.close()

    serving(Site(options, port=0, bounds=Bounds(uploads=2, grace_s=60)), work)
    serving(Site(options, port=0, bounds=Bounds(grace_s=0.1)), alone)


def test_who_never_reads_the_answer_keeps_nobody_out(options: ReceiverOptions, monkeypatch: pytest.MonkeyPatch) -> None:
    def decode(_self: DecodingProcess, path: Path, *_: Any) -> dict[str, Any]:
        return {"status": "ok", "text": "x" * (64 * MEGABYTE if path.read_bytes() == b"large" else 1)}

    monkeypatch.setattr(DecodingProcess, "decode", decode)

    async def work(server: Server, client: Any) -> None:
        deaf = []
        for lines in ("", "Accept: application/x-ndjson\r\n"):
            deaf.append(await raw(server, "POST /photo", f"{lines}Content-Length: 5\r\n\r\nlarge".encode()))
            await asyncio.sleep(0.3)  # its answer is being written
            status, answer = await post(server, client, b"hello")
            assert (status, answer["text"]) == (200, "x")
        await emptied()
        await asyncio.sleep(1.0)
        for reader, writer in deaf:  # the connection was closed before all was taken
            with contextlib.suppress(ConnectionError):
                assert len(await reader.read()) < 64 * MEGABYTE
            writer.close()

    serving(Site(options, port=0, bounds=Bounds(uploads=1, answer_s=0.5)), work)


def test_who_waits_is_told_the_place(options: ReceiverOptions, monkeypatch: pytest.MonkeyPatch) -> None:
    released = threading.Event()
    monkeypatch.setattr(DecodingProcess, "decode", lambda *_: {"status": "ok", "in_time": released.wait(60)})

    async def work(server: Server, client: Any) -> None:
        asked, address = [], server.address + "photo"
        async with visiting(2) as neighbour:
            asked += [await client.post(address, data=b"hello", headers=LINES) for _ in range(2)]
            status, answer = await post(server, client, b"hello")  # half of the places are taken by this visitor
            assert (status, answer["reason"]) == (503, "Other pictures are being read just now.")
            asked.append(await neighbour.post(address, data=b"hello", headers=LINES))
            assert json.loads(await asked[2].content.readline()) == {"status": "waiting", "place": 2, "partial": True}
            released.set()
            lines = [[json.loads(line) async for line in answer.content] for answer in asked]
        assert [part[-1]["status"] for part in lines] == ["ok"] * 3
        assert lines[2][0]["place"] == 1

    serving(Site(options, port=0, bounds=Bounds(waiting=4)), work)


@pytest.mark.parametrize("token", [None, "secret"])
@pytest.mark.parametrize("head", ["OPTIONS *", "CONNECT a.example:443", "CONNECT /", "GET *", "PRI *"])
def test_odd_requests_are_refused_without_a_word(
    head: str, token: str | None, options: ReceiverOptions, caplog: pytest.LogCaptureFixture
) -> None:
    async def work(server: Server, client: Any) -> None:
        reader, writer = await raw(server, head)
        assert (await reader.readline()).split()[1] in (b"400", b"403", b"404", b"405")
        writer.close()

    serving(Site(options, port=0, token=token), work)
    assert not [record for record in caplog.records if record.exc_info or record.levelname == "ERROR"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT, signal.SIGKILL])
def test_no_upload_is_left_however_the_server_ends(number: int, tmp_path: Path) -> None:
    """While an upload arrives, whose sender does not go away."""
    command = [*COMMAND, "serve", "--port", "0"]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    told = ENVIRONMENT | {"TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, env=told, start_new_session=True, **pipes) as server:
        port = int(server.stdout.readline().decode().rsplit(":", 1)[1].strip("/\n"))
        with socket.create_connection(("127.0.0.1", port)) as slow:
            head = b"POST /photo HTTP/1.1\r\nHost: localhost\r\nContent-Length: 99999999\r\n\r\n"
            slow.sendall(head + bytes(1 << 20))
            while not uploads(server.pid, tmp_path):
                time.sleep(0.05)
            os.killpg(server.pid, number)  # with the process that decodes, as a machine out of memory does
            server.wait(60)
    assert list(tmp_path.iterdir()) == []


def test_the_address_for_phones_holds_a_new_secret() -> None:
    from rxcli.cli import serve

    def token(*arguments: str) -> str | None:
        given = serve.serve.make_context("serve", list(arguments)).params
        return serve._site(given.pop("device"), given).token

    secrets = [token("--host", "0.0.0.0") for _ in range(2)]
    assert secrets[0] != secrets[1]
    assert min(len(secret or "") for secret in secrets) >= 16
    assert token() is None


def test_a_port_that_is_taken_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert run(["serve", "--port", str(port)]) == 2
    assert f"cannot serve at 127.0.0.1:{port}" in capsys.readouterr().err


def test_the_decoding_process_may_die_hang_and_swell(tmp_path: Path, options: ReceiverOptions) -> None:
    write_frame(tmp_path / "a.png", 3)
    with contextlib.closing(DecodingProcess(options)) as decoder:
        assert decoder.decode(tmp_path / "a.png", "a")["status"] == "ok"
        assert decoder.pid is not None
        os.kill(decoder.pid, signal.SIGKILL)
        time.sleep(0.2)
        assert decoder.decode(tmp_path / "a.png", "a")["status"] == "ok"
    for limits, told in (
        ({"max_s": 0.0}, "Nothing was found in 0 s, after which the page gives up."),
        ({"max_bytes": 0}, "It takes too much memory."),
    ):
        with contextlib.closing(DecodingProcess(options, **limits)) as decoder:
            assert decoder.decode(tmp_path / "a.png", "a")["reason"] == told
            assert decoder.pid is None


class Loaded:
    """Leaves a mark where it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return Path.touch, (self.mark,)


PART = json.dumps({"partial": True, "text": "x" * MEGABYTE}).encode()


@pytest.mark.parametrize(
    ("answers", "status", "n_published"),
    [
        (lambda mark: [pickle.dumps(Loaded(mark))], "unreadable", 0),
        (lambda mark: [b"7"], "unreadable", 0),
        (lambda mark: [b" " * (9 * MEGABYTE)], "unreadable", 0),
        (lambda mark: [*[PART] * 20, b'{"status": "ok"}'], "ok", 7),
    ],
    ids=["pickle", "number", "long", "flood"],
)
def test_an_answer_of_the_decoding_process_is_no_program_and_no_flood(
    answers: Any, status: str, n_published: int, options: ReceiverOptions, tmp_path: Path, monkeypatch: Any
) -> None:
    """A hostile picture may take that process over."""

    def start(*_: Any) -> tuple[Any, Any]:
        ours, theirs = multiprocessing.Pipe()

        def say() -> None:
            with contextlib.suppress(OSError):
                for answer in answers(tmp_path / "mark"):
                    theirs.send_bytes(answer)

        threading.Thread(target=say).start()
        return SimpleNamespace(pid=os.getpid(), is_alive=lambda: True, kill=int, join=int), ours

    monkeypatch.setattr("rxcli.web.decoding.start_process", start)
    published: list[Any] = []
    assert DecodingProcess(options).decode(tmp_path / "a", "a", published.append)["status"] == status
    assert len(published) == n_published
    assert not (tmp_path / "mark").exists()


def bomb(side: int) -> bytes:
    """A PNG of few bytes that claims many pixels."""
    png = io.BytesIO()
    Image.new("L", (64, 64)).save(png, "PNG")
    header = b"IHDR" + side.to_bytes(4, "big") * 2 + bytes([8, 0, 0, 0, 0])
    return png.getvalue()[:12] + header + zlib.crc32(header).to_bytes(4, "big") + png.getvalue()[33:]


def test_hostile_uploads(tmp_path: Path, options: ReceiverOptions) -> None:
    """Afterwards the server answers as before, it is no larger, and the disk is as it was."""
    write_frame(tmp_path / "a.png", 3)
    good, files_before = (tmp_path / "a.png").read_bytes(), set(Path("/tmp").glob("vlc-rx*"))
    bounds = Bounds(upload_bytes=4 * MEGABYTE, upload_s=1.5, connections=20, idle_s=2.0)
    inflated = zlib.compress(bytes(64 * MEGABYTE), 9)
    bodies = [good[: len(good) // 2], bomb(20_000), bomb(8_100), bytes(5 * MEGABYTE), b"<script>alert(1)</script>"]

    async def endless_body(size: int, pause_s: float) -> AsyncIterator[bytes]:
        while True:
            yield bytes(size)
            await asyncio.sleep(pause_s)

    async def quietly(call: Awaitable[Any]) -> Any:
        with contextlib.suppress(aiohttp.ClientError, ConnectionError, TimeoutError, asyncio.IncompleteReadError):
            return await call

    async def held(server: Server, text: bytes, hold_s: float) -> None:
        _, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(text)
        await quietly(writer.drain())
        await asyncio.sleep(hold_s)
        writer.close()

    async def work(server: Server, client: Any) -> None:
        assert (await post(server, client, good))[1]["status"] == "ok"
        memory = resident_bytes(os.getpid())
        answers = [await quietly(post(server, client, body, headers={"X-Name": "../../x"})) for body in bodies]
        answers += [await quietly(post(server, client, inflated, headers={"Content-Encoding": "deflate"}))]
        calls = [quietly(post(server, client, endless_body(*how))) for how in [(1, 0.1), (MEGABYTE, 0.0)] * 3]
        calls += [quietly(post(server, client, good)) for _ in range(24)]  # a flood of good ones: some are told to wait
        head = b"POST /photo HTTP/1.1\r\nHost: localhost\r\n"
        calls += [quietly(held(server, head, 3.0)) for _ in range(30)]
        calls += [quietly(held(server, b"GET / HTTP/1.1\r\nX: " + b"y" * 200_000, 0.5)) for _ in range(5)]
        calls += [quietly(held(server, head + b"Content-Length: 9\r\n\r\n", 3.0))]
        calls += [quietly(held(server, b"\x16\x03\x01 no HTTP at all", 0.2)) for _ in range(14)]
        answers += await asyncio.gather(*calls)
        assert {answer[0] for answer in answers if answer} <= {200, 400, 408, 413, 503}
        for _ in range(50):  # slow ones are let go in time
            status, answer = await post(server, client, good)
            if status == 200:
                break
            await asyncio.sleep(0.2)
        assert answer["status"] == "ok"
        await emptied()
        assert resident_bytes(os.getpid()) < memory + 100 * MEGABYTE
        assert resident_bytes(server._decoder.pid) < 500 * MEGABYTE

    serving(Site(options, port=0, bounds=bounds), work)
    assert leftovers() == []
    assert set(Path("/tmp").glob("vlc-rx*")) <= files_before


# -- the live camera --------------------------------------------------------------------------------------------------


def result_of(status: str, message: str | None = None, packets: int = 0) -> FrameResult:
    packet = PacketResult(1.0, 2.0, 35, "ab", confidence=0.99, ber_hat=1e-3)
    columns = tuple(ColumnResult(i, "ok", packets=(packet,)) for i in range(packets))
    corners = np.array([[0, 100], [50, 100], [50, 400], [0, 400]], np.float64)
    return FrameResult("camera", 0, 0.0, status, message, corners=corners, columns=columns)  # type: ignore[arg-type]


def test_texts_and_files_come_to_the_page() -> None:
    result = result_of("ok", packets=1)
    texts = (Message("text", "Grüße".encode(), "camera", 0, 0.0), Message("uri", b"https://a.b", "camera", 0, 0.0))
    received = ReceivedObject("a.txt", b"abc", 3, "00", 1, 1, "camera", 0, 0.0)
    assert text_rows(replace(result, messages=texts, objects=(received,))) == [
        {"kind": "text", "text": "Grüße"},
        {"kind": "uri", "text": "https://a.b"},
        {"kind": "file", "name": "a.txt", "size": 3, "base64": "YWJj"},
    ]


@pytest.mark.parametrize("passed_s", [0.0, 1.0])
def test_a_live_camera_gives_state_picture_and_packets(passed_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clip's frames as a camera gives them, however fast they are received."""
    clock = itertools.count(100.0, passed_s)
    monkeypatch.setattr("rxcli.web.live.time", SimpleNamespace(monotonic=lambda: next(clock)))
    events = list(live_events(open_source(CLIP), receiver_options(cameras=(VIDEO_CAMERA,))))
    assert events[-1]["state"]["locked"]
    assert len(events) == 2 if passed_s == 0 else len(events) > 2
    assert len(events[-1]["picture"]["outlines"]) == 20
    assert sum(len(event["packets"]) for event in events) >= 20
    assert 0.7 < events[-1]["state"]["height_share"] < 1
    json.dumps(events)


def in_a_thread(work: Callable[..., None], *arguments: Any) -> tuple[Any, Any]:
    """In place of `start_process`: it sees the fake camera."""
    ours, theirs = multiprocessing.Pipe()

    def run_it() -> None:
        with contextlib.suppress(OSError):
            work(theirs, *arguments)

    threading.Thread(target=run_it, daemon=True).start()
    return SimpleNamespace(kill=theirs.close, join=int, exitcode=0), ours


def test_the_live_page_is_told_when_the_camera_sees_the_screen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clip = np.stack([frame.pixels for frame in open_source(CLIP)])
    blank = np.full((20, *clip.shape[1:]), 24, np.uint8)
    Bench(tmp_path, np.concatenate([blank, *[clip] * 5]), monkeypatch, formats=["NV12"], fps=15.0)
    monkeypatch.setattr("rxcli.web.live.start_process", in_a_thread)
    monkeypatch.setattr("rxcli.web.live.signal", SimpleNamespace(signal=max, SIGINT=0, SIG_IGN=0))

    async def work(server: Server, client: Any) -> None:
        advice = []
        async with client.get(server.address + "live", timeout=aiohttp.ClientTimeout(60)) as answer:
            assert answer.content_type == "text/event-stream"
            async for line in answer.content:
                if line.startswith(b'data: {"'):
                    event = json.loads(line[6:])
                    advice.append(event["state"]["reason"] + event["state"]["advice"])
                    if event["state"]["locked"] and event["packets"]:
                        break
        assert "The picture is too dark." in advice[0]
        assert len(event["picture"]["outlines"]) == 20

    serving(Site(receiver_options(cameras=(VIDEO_CAMERA,)), port=0, device=Path("/dev/video0")), work)


# -- in a browser -----------------------------------------------------------------------------------------------------


@asynccontextmanager
async def page(site: Site, **how: Any) -> AsyncIterator[tuple[Server, Browser]]:
    async with Server(site) as server, Browser(**how) as browser:
        await browser.open(server.address)
        yield server, browser


@needs_chromium
def test_a_phone_sends_the_samples_and_a_bad_file(tmp_path: Path) -> None:
    (tmp_path / "bad.jpg").write_bytes(b"\xff\xd8\xff nothing")
    expected = {
        SAMPLES / "phone_chelsea_17k3.jpg": ("20 packets received", 20),
        SAMPLES / "xtrans_sky_17k3.dng": ("20 packets received", 20),
        SAMPLES / "video1080_chelsea_17k3.mp4": ("360 packets received", 20),
        tmp_path / "bad.jpg": ("The file could not be read", 0),
    }
    profiles = tuple(str(SAMPLES / f"{name}.toml") for name in ("phone12", "xs10-small", "video1080"))

    async def body() -> None:
        async with page(Site(receiver_options(cameras=profiles), port=0)) as (_, browser):
            for path, (title, n_outlines) in expected.items():
                await browser.run("document.getElementById('result').hidden = true")  # a bad file answers at once
                await browser.choose("#file", path)
                await browser.until("!document.getElementById('result').hidden")
                await browser.until("document.getElementById('progress').textContent === ''")
                assert await browser.run("document.getElementById('result-title').textContent") == title
                assert await browser.run("document.activeElement.id") == "result-title"
                drawn = await browser.run("document.querySelectorAll('#picture polygon:not(.corners)').length")
                assert drawn == n_outlines
                if path.suffix == ".mp4":  # a table for each burst, with its time
                    bursts = await browser.run(
                        "[...document.querySelectorAll('#payloads summary')].map(n => n.innerText)"
                    )
                    assert bursts[-18:-16] == ["Burst 1 at 0.02 s: 20 packets", "Burst 2 at 0.03 s: 20 packets"]
                    assert await browser.run("document.querySelectorAll('#payloads tbody tr').length") == 360
                assert await browser.run("document.documentElement.scrollWidth <= innerWidth")
            assert browser.complaints == []

    asyncio.run(body())


@needs_chromium
def test_files_that_are_dropped_queue_with_their_thumbnails(tmp_path: Path, options: ReceiverOptions) -> None:
    """One after the other is read; each can be looked at again; starting over forgets them."""
    write_frame(tmp_path / "a.png", 3)
    (tmp_path / "b.png").write_bytes(b"nothing")
    data = {path.name: base64.b64encode(path.read_bytes()).decode() for path in sorted(tmp_path.glob("*.png"))}
    drop = """(async (files) => {
      const dropped = new DataTransfer();
      for (const [name, data] of Object.entries(files)) {
        dropped.items.add(new File([await (await fetch("data:image/png;base64," + data)).blob()], name));
      }
      document.getElementById("drop").dispatchEvent(new DragEvent("drop", { dataTransfer: dropped, bubbles: true }));
    })(%s)"""

    async def body() -> None:
        async with Server(Site(options, port=0)) as server, Browser() as browser:
            await browser.call("Page.setBypassCSP", enabled=True)  # for the test's own files
            await browser.open(server.address)
            await browser.run(drop % json.dumps(data))
            await browser.until("document.querySelectorAll('.entry:enabled').length === 2")
            states = await browser.run("[...document.querySelectorAll('.entry')].map((node) => node.innerText)")
            title = f"{N_COLUMNS} packets received"
            expected = [["a.png", title], ["b.png", "The file could not be read"]]
            assert [state.split("\n")[-2:] for state in states] == expected
            assert await browser.run("document.querySelectorAll('.thumb img').length") == 1
            assert await browser.run("document.querySelector('[aria-current=true] .name').textContent") == "b.png"
            await browser.run("document.querySelector('.entry').click()")
            assert await browser.run("document.getElementById('result-title').textContent") == title
            told = await browser.run("document.getElementById('together').innerText")
            assert "So far: 1 photo, 0 texts and files." in told
            await browser.run("document.getElementById('again').click()")
            assert await browser.run("document.querySelectorAll('.entry').length") == 0
            assert await browser.run("document.getElementById('result').hidden")
            assert browser.complaints == []

    asyncio.run(body())


@needs_chromium
def test_the_page_is_for_keyboards_and_screen_readers(options: ReceiverOptions) -> None:
    async def body() -> None:
        async with page(Site(options, port=0)) as (_, browser):
            await browser.press("Tab", 9)
            assert await browser.run("document.activeElement.id") == "file"
            tree = await browser.call("Accessibility.getFullAXTree")
            named = {
                (node["role"]["value"], node.get("name", {}).get("value"))
                for node in tree["nodes"]
                if not node["ignored"]
            }
            assert ("heading", "Photos") in named
            assert any(role == "button" and name and "Take or choose photos" in name for role, name in named), named
            assert not {role for role, name in named if role in ("button", "link", "image") and not name}
            assert await browser.run("document.documentElement.lang") == "en"
            for scheme in ("light", "dark"):
                await browser.prefer(scheme)
                for selector in ("body", "header p", ".hint", ".button"):
                    assert await browser.run(_CONTRAST % selector) >= 4.5, (scheme, selector)

    asyncio.run(body())


#: WCAG 2 contrast of an element's text against the nearest ground below it.
_CONTRAST = """(() => {
  const light = (text) => {
    const [r, g, b] = text.match(/[\\d.]+/g).map(Number).map((v) => v / 255)
      .map((v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  let node = document.querySelector("%s");
  const ink = light(getComputedStyle(node).color);
  while (getComputedStyle(node).backgroundColor === "rgba(0, 0, 0, 0)") node = node.parentElement;
  const ground = light(getComputedStyle(node).backgroundColor);
  return (Math.max(ink, ground) + 0.05) / (Math.min(ink, ground) + 0.05);
})()"""
