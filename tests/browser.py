"""A headless Chromium for tests, driven by its own protocol: pages, files chosen, pictures, what the console said."""

import asyncio
import base64
import json
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, Self

import aiohttp

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
_FLAGS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run")
_FLAGS += ("--disable-quic", "--disable-background-networking", "--disable-component-update", "--disable-sync")
_FLAGS += ("--remote-debugging-port=0", "--mute-audio", "--hide-scrollbars")


class Browser:
    """One page in a browser of its own; an async context manager.

    Args:
        width, height: of the window, pixels.
        dark: whether the reader prefers dark pages.
    """

    def __init__(self, width: int = 390, height: int = 844, dark: bool = False) -> None:
        self._size, self._dark = (width, height), dark
        self._number = 0
        #: Errors and warnings of the console, and exceptions.
        self.complaints: list[str] = []
        self._answers: dict[int, asyncio.Future[Any]] = {}

    async def __aenter__(self) -> Self:
        self._home = tempfile.TemporaryDirectory(prefix="chromium-", ignore_cleanup_errors=True)
        assert CHROMIUM is not None
        command = [CHROMIUM, *_FLAGS, f"--user-data-dir={self._home.name}", "about:blank"]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        file, end_s = Path(self._home.name) / "DevToolsActivePort", time.monotonic() + 60
        while not (file.exists() and file.read_text().strip()):
            assert time.monotonic() < end_s, "the browser did not start"
            await asyncio.sleep(0.05)
        self._session = aiohttp.ClientSession()
        async with self._session.get(f"http://127.0.0.1:{file.read_text().split()[0]}/json") as answer:
            [address] = [page["webSocketDebuggerUrl"] for page in await answer.json() if page["type"] == "page"]
        self._socket = await self._session.ws_connect(address, max_msg_size=0)
        self._reader = asyncio.create_task(self._read())
        for domain in ("Page", "Runtime", "DOM", "Log", "Network"):
            await self.call(f"{domain}.enable")
        width, height = self._size
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        await self.call("Emulation.setDeviceMetricsOverride", **metrics)
        await self.prefer("dark" if self._dark else "light")
        return self

    async def __aexit__(self, *_: object) -> None:
        self._reader.cancel()
        await self._socket.close()
        await self._session.close()
        self._process.kill()
        self._process.wait()
        self._home.cleanup()

    async def _read(self) -> None:
        async for message in self._socket:
            data = json.loads(message.data)
            method, told = data.get("method"), data.get("params", {})
            if "id" in data:
                self._answers.pop(data["id"]).set_result(data)
            elif (
                method == "Runtime.exceptionThrown"
                or (method == "Runtime.consoleAPICalled" and told["type"] in ("error", "warning", "assert"))
                or (method == "Log.entryAdded" and told["entry"]["level"] in ("error", "warning"))
            ):
                self.complaints.append(json.dumps(told))

    async def call(self, method: str, **parameters: Any) -> Any:
        """One call of the protocol."""
        self._number += 1
        future = self._answers[self._number] = asyncio.get_running_loop().create_future()
        await self._socket.send_json({"id": self._number, "method": method, "params": parameters})
        answer = await asyncio.wait_for(future, 60)
        assert "error" not in answer, answer
        return answer["result"]

    async def run(self, expression: str) -> Any:
        """The value of an expression in the page."""
        answer = await self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    async def open(self, address: str) -> None:
        """Open a page and wait until it is loaded."""
        await self.call("Page.navigate", url=address)
        await self.until("document.readyState === 'complete' && location.href !== 'about:blank'")

    async def until(self, expression: str) -> None:
        """Wait until an expression is true."""
        end_s = time.monotonic() + 60
        while not await self.run(expression):
            assert time.monotonic() < end_s, f"never came true: {expression}"
            await asyncio.sleep(0.03)

    async def prefer(self, scheme: str) -> None:
        """Show pages as to a reader who prefers light or dark ones."""
        features = [{"name": "prefers-color-scheme", "value": scheme}]
        await self.call("Emulation.setEmulatedMedia", features=features)

    async def choose(self, selector: str, *paths: Path) -> None:
        """Choose files, as a person does with the dialogue."""
        root = (await self.call("DOM.getDocument"))["root"]["nodeId"]
        node = (await self.call("DOM.querySelector", nodeId=root, selector=selector))["nodeId"]
        await self.call("DOM.setFileInputFiles", files=[str(path) for path in paths], nodeId=node)

    async def press(self, key: str, code: int) -> None:
        """Press a key."""
        for kind in ("keyDown", "keyUp"):
            await self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code)

    async def shot(self, **how: Any) -> bytes:
        """What the page looks like, in the format that is asked for."""
        return base64.b64decode((await self.call("Page.captureScreenshot", **how))["data"])
