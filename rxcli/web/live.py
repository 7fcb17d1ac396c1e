"""Follow a live camera in a separate process: its picture, state and payloads, for the page."""

import logging
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from rxcli.errors import ReceiverError, sentence, without_commands
from rxcli.ingest.v4l2 import CameraSettings, LiveSource
from rxcli.options import ReceiverOptions
from rxcli.results.aim import Aim, AimState, brightness_of
from rxcli.results.columns import packet_rows, text_rows
from rxcli.runs.batch import Decoder, Source, use_one_thread
from rxcli.runs.processes import start_process
from rxcli.types import FrameResult
from rxcli.web.decoding import Previews, receive, send

log = logging.getLogger(__name__)

#: Maximum rate of events, and the width of their pictures, for a phone on a poor network.
_EVENTS_PER_S = 8.0
_WIDTH_PX = 720
_RESTART_S = 2.0
#: Number of earlier texts and packets that a page receives when it is opened.
_HISTORY = 50


class LiveCamera(threading.Thread):
    """Follow a camera and publish its events.

    Args:
        device: the camera.
        settings: of the camera.
        options: of the receiver.
        publish: called with each event as plain data.
    """

    def __init__(
        self,
        device: Path,
        settings: CameraSettings,
        options: ReceiverOptions,
        publish: Callable[[dict[str, Any]], None],
    ) -> None:
        super().__init__(name=f"follow {device}", daemon=True)
        self._arguments, self._publish = (device, settings, options), publish
        self._process: BaseProcess | None = None
        self._running = True

    def close(self) -> None:
        """Stop."""
        self._running = False
        if self._process is not None:
            self._process.kill()
        self.join(timeout=5)

    def run(self) -> None:
        """Publish the events of the process, and restart the process if it dies."""
        while self._running:
            self._process, ours = start_process(_work, *self._arguments)
            try:
                while True:
                    self._publish(receive(ours)[0])
            except (EOFError, OSError, ValueError):
                ours.close()
            self._process.join()
            if self._running:
                log.warning("the process of the live camera ended (code %s); starting again", self._process.exitcode)
                self._publish({"problem": "The camera's program ended; it is starting again."})
                time.sleep(_RESTART_S)


def _work(connection: Connection, device: Path, settings: CameraSettings, options: ReceiverOptions) -> None:
    """Main loop of the process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    use_one_thread()
    source = LiveSource(device, settings, on_lost=lambda reason: send(connection, {"problem": sentence(reason)}))
    try:
        for event in live_events(source, options):
            send(connection, event)
    except ReceiverError as error:
        send(connection, {"problem": sentence(str(error))})
        time.sleep(_RESTART_S)
    except (BrokenPipeError, EOFError):
        return


def live_events(frames: Any, options: ReceiverOptions) -> Iterator[dict[str, Any]]:
    """Events for the page at a limited rate: picture, outline, state, and the packets and texts since the last event.

    Args:
        frames: endless, of one camera; if it has `counts`, dropped and damaged frames are reported, too.
        options: of the receiver.
    """
    watched, aim = Previews(_WIDTH_PX, quality=70), Aim()
    prompt = replace(options, prompt=True)
    decoder = Decoder(prompt, watched.tap, open_source=lambda path: frames)
    packets: deque[dict[str, Any]] = deque(maxlen=_HISTORY)
    texts: list[dict[str, Any]] = []

    def event(result: FrameResult, state: AimState) -> dict[str, Any]:
        """A result, with the packets and texts since the last event."""
        made = {
            "state": asdict(state),
            "light": state.light.word if state.light else None,
            "columns": [[column.column, column.status] for column in result.columns],
            "packets": list(packets),
            "texts": list(texts),
            "picture": watched.picture(result, options),
            "screen": result.screen_profile,
            "camera": result.camera_profile,
        }
        packets.clear()
        texts.clear()
        return made

    last_s = 0.0
    unsent: tuple[FrameResult, AimState] | None = None
    for received in decoder.results(Source("camera", "camera")):
        result = replace(received, message=received.message and without_commands(received.message))
        now_s = time.monotonic()
        newest = watched.frame
        height, light = (newest.height, brightness_of(newest)) if newest is not None else (1, None)
        unsent = result, aim.update(result, now_s, height, light)
        packets.extend(packet_rows(result))
        texts += text_rows(result)
        if now_s - last_s >= 1 / _EVENTS_PER_S or texts or result.status == "unreadable":
            yield event(*unsent)
            last_s, unsent = now_s, None
    if unsent is not None:
        yield event(*unsent)
