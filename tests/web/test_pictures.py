"""What the pages look like: pictures on a phone and on a desk, light and dark, made in a real browser.

`VLC_RX_PICTURES=docs/pictures pytest tests/web/test_pictures.py` writes those of the documentation.
"""

import asyncio
import io
import os
import shutil
from contextlib import chdir
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("aiohttp")
pytest.importorskip("segno")

from browser import CHROMIUM, Browser
from PIL import Image

from rxcli.cli.main import run
from rxcli.ingest import open_source
from rxcli.options import receiver_options
from rxcli.web.live import live_events
from rxcli.web.server import Server, Site

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's chromium")
SAMPLES = Path(__file__).resolve().parents[2] / "sample_frames"
WIDTHS = {"narrow": 390, "wide": 1280}
#: Rows of a picture, at most: what is below looks like what is above.
MAX_HEIGHT = 1800


@pytest.fixture(scope="module")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A photo with a text; beside it one that was turned."""
    folder = tmp_path_factory.mktemp("photos")
    with chdir(folder):
        assert run(["demo", "--no-open"]) == 0
    shutil.copy(folder / "vlc-rx-demo" / "photo.jpg", folder / "IMG_1.jpg")
    with Image.open(folder / "IMG_1.jpg") as upright:
        upright.rotate(90, expand=True).save(folder / "IMG_2.jpg", quality=92)
    return folder / "IMG_1.jpg"


class NoCamera:
    """In place of a live camera: events are told by the test."""

    def __init__(self, *_: Any) -> None: ...
    def start(self) -> None: ...
    def close(self) -> None: ...


class Shots:
    """Opens pages in one browser and keeps pictures of them."""

    def __init__(self, browser: Browser, size: str, dark: bool, folder: Path) -> None:
        self.browser, self._width, self._folder = browser, WIDTHS[size], folder
        self._kind = f"{'dark' if dark else 'light'}-{size}"

    async def sent(self, address: str, name: str, *files: Path) -> None:
        """The page after files were sent."""
        await self.browser.open(address)
        await self.browser.choose("#file", *files)
        done = f"document.querySelectorAll('.entry:enabled').length === {len(files)}"
        await self.browser.until(f"{done} && document.getElementById('progress').textContent === ''")
        await self.keep(f"serve-{name}")

    async def told(self, server: Server, name: str, event: dict[str, Any]) -> None:
        """The page of a live camera after an event."""
        await self.browser.open(server.address)
        while await self.browser.run("document.querySelector('#live-picture img') === null"):
            server._broadcast(event)  # as often as a camera would: the page may not listen yet
        await self.browser.until("document.querySelector('#live-picture img').complete")
        word = await self.browser.run("document.getElementById('lock').textContent")
        assert word == event["state"]["word"]
        await self.keep(f"live-{name}")

    async def keep(self, name: str) -> None:
        """Write a picture of the page, and look whether it may be one."""
        assert await self.browser.run("document.documentElement.scrollWidth <= innerWidth")
        height = min(MAX_HEIGHT, await self.browser.run("document.documentElement.scrollHeight"))
        clip = {"x": 0, "y": 0, "width": self._width, "height": height, "scale": 1}
        data = await self.browser.shot(format="webp", quality=50, clip=clip, captureBeyondViewport=True)
        with Image.open(io.BytesIO(data)) as picture:
            assert picture.size == (self._width, height)
            grey = np.asarray(picture.convert("L"), np.float64)
        assert min(half.std() for half in np.array_split(grey, 2)) > 3, f"{name} is blank"
        (self._folder / f"{name}-{self._kind}.webp").write_bytes(data)


@pytest.mark.slow
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
@pytest.mark.parametrize("size", WIDTHS)
def test_the_pages_are_pictured(
    size: str, dark: bool, photo: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rxcli.web.live.LiveCamera", NoCamera)
    options = receiver_options(cameras=("auto", str(SAMPLES / "video1080.toml")), soft_bits=True)
    clip, turned = SAMPLES / "video1080_chelsea_17k3.mp4", photo.with_name("IMG_2.jpg")
    *_, locked = live_events(open_source(clip), options)
    waiting = next(live_events(open_source(turned), options))

    async def body() -> None:
        async with Browser(WIDTHS[size], 844, dark) as browser:
            shots = Shots(browser, size, dark, Path(os.environ.get("VLC_RX_PICTURES") or tmp_path))
            async with Server(Site(options, port=0)) as server:
                await shots.sent(server.address, "queue", turned, SAMPLES / "xtrans_sky_17k3.dng", photo)
                if size == "narrow":
                    await shots.sent(server.address, "turned", turned)
                    await shots.sent(server.address, "clip", clip)
            async with Server(Site(options, port=0, device=Path("/dev/video0"))) as server:
                await shots.told(server, "locked", locked)
                if size == "narrow":
                    await shots.told(server, "waiting", waiting)
                await browser.open((photo.parent / "vlc-rx-demo" / "index.html").as_uri())  # before the server goes
            widest = "Math.max(...[...document.querySelectorAll('svg')].map((one) => one.scrollWidth))"
            assert await browser.run(f"{widest} < innerWidth")  # all columns of every chart are in view
            await shots.keep("inspect")
            assert browser.complaints == []

    asyncio.run(body())
