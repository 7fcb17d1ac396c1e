"""What a person who aims a camera needs to know: is it locked, and if not, why, and what to do."""

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rxcli.errors import printable, sentence
from rxcli.results.reasons import sentence_of
from rxcli.types import FloatArray, Frame, FrameResult, Reason, Remark

#: Rates are averages over this time, seconds.
WINDOW_S = 1.0
_LOCKED = ("ok", "partial")
#: Mean below which a picture is dark, and share of pixels at white above which it is overexposed. Without a lock: mean
#: above which the exposure may be so long that no stripes show.
_DARK, _BRIGHT, _WASHED_OUT = 0.06, 0.1, 0.4
#: Share of the picture's height that a screen may move in a frame, which clips bear (`benchmark motion`: 8 pixels of
#: 1080), and share of the columns below which motion matters at all.
_STILL, _FEW = 0.01, 0.5
_CLOSER = "Move closer, until the screen fills the picture."
_NEARER = f"{_CLOSER[:-1]}, and hold the camera level with it."
_TURN = "Turn the camera, until its long side lies along the screen's."
_SIDEWAYS = "The screen lies on its side in the picture."
#: For those who aim: reason and next step, instead of those of photos.
_AIMING: dict[Reason | None, tuple[str, str]] = {
    **dict.fromkeys(("portrait", "on_its_side", "stripes_down"), (_SIDEWAYS, _TURN)),
    **dict.fromkeys(("no_columns", "no_columns_dark", "lit"), ("No screen that sends is in view.", _NEARER)),
    "no_columns_striped": ("Stripes show, but no columns of a screen.", _NEARER),
    "part_striped": ("Only a part of the picture shows stripes.", _CLOSER),
}
_WORDS = {"no_screen": "no screen", "no_signal": "no signal", "unreadable": "no picture"}


@dataclass(frozen=True, slots=True)
class Brightness:
    """How bright a picture is."""

    #: Mean, 0..1 of the values between black and white.
    mean: float
    #: Share of pixels at white.
    clipped: float

    @property
    def word(self) -> str:
        """For people."""
        if self.mean < _DARK:
            return "too dark"
        return "overexposed" if self.clipped > _BRIGHT else "good"


def brightness_of(frame: Frame) -> Brightness:
    """How bright a picture is, from some thousand of its pixels; a clip's black and white are those of its format."""
    step = max(1, min(frame.width, frame.height) // 64)
    black, white = frame.black, frame.white
    if frame.mosaic is not None:
        black, white = float(np.mean(frame.mosaic.black)), frame.mosaic.white
    share = (frame.pixels[::step, ::step].astype(np.float32) - black) / max(white - black, 1.0)
    return Brightness(float(np.clip(share, 0, 1).mean()), float(np.mean(share > 0.98)))


def height_share(corners: FloatArray | None, height: int) -> float | None:
    """Share of the picture's height that the screen fills; None where there is no screen."""
    if corners is None:
        return None
    return float(np.ptp(np.clip(corners[:, 1], 0, height - 1)) / height)


@dataclass(frozen=True, slots=True)
class AimState:
    """The state of reception, in what a person asks for."""

    #: In a word: "locked", "no screen", ...
    word: str
    locked: bool
    n_columns: int = 0
    #: Columns that give packets.
    n_received: int = 0
    frames_per_s: float = 0.0
    packets_per_s: float = 0.0
    bits_per_s: float = 0.0
    ber_hat: float | None = None
    light: Brightness | None = None
    height_share: float | None = None
    #: Why there is no lock, and what to do; with a lock, only of a hand that shakes and a screen partly out of view.
    reason: str = ""
    advice: str = ""


@dataclass(slots=True)
class Aim:
    """Follows the results of a live camera."""

    #: Time, packets, bits and wrong bits of recent results.
    _recent: deque[tuple[float, int, int, float]] = field(default_factory=deque)
    #: Of the last result.
    _corners: FloatArray | None = None

    def update(self, result: FrameResult, now_s: float, height: int, light: Brightness | None = None) -> AimState:
        """The state with one more result.

        Args:
            result: of the newest frame that has one.
            now_s: on any steady clock.
            height: of the frame, pixels.
            light: of the newest frame.
        """
        bits = sum(packet.payload_bits for packet in result.packets)
        wrong = sum(packet.payload_bits * packet.ber_hat for packet in result.packets)
        self._recent.append((now_s, len(result.packets), bits, wrong))
        while len(self._recent) > 2 and self._recent[0][0] < now_s - WINDOW_S:
            self._recent.popleft()
        locked = result.status in _LOCKED
        reason, advice = ("", "") if locked else aiming_hint(result, light)
        n_hidden = sum(column.reason == "out_of_view" for column in result.columns)
        if locked and n_hidden:
            reason = f"{n_hidden} of the screen's columns are out of the picture."
            advice = sentence(sentence_of(Remark("out_of_view")).partition("; ")[2])
        n_received = sum(column.status in ("ok", "weak") for column in result.columns) if locked else 0
        moved = self._moved(result.corners, height)
        if moved > _STILL and n_received <= _FEW * len(result.columns):
            reason = f"The screen moves by {100 * moved:.1f} % of the picture's height from frame to frame."
            advice = "Hold the camera still."
        return AimState(
            word="locked" if locked else _WORDS.get(result.status, result.status.replace("_", " ")),
            locked=locked,
            n_columns=len(result.columns),
            n_received=n_received,
            light=light,
            height_share=height_share(result.corners, height),
            reason=reason,
            advice=advice,
            **self._rates(),
        )

    def _moved(self, corners: FloatArray | None, height: int) -> float:
        """How far the screen's corners have moved since the last result, as a share of the picture's height."""
        before, self._corners = self._corners, corners
        if before is None or corners is None:
            return 0.0
        return float(np.median(np.linalg.norm(corners - before, axis=1))) / height

    def _rates(self) -> dict[str, Any]:
        """Of the last second; what the first frame brought only starts the span."""
        times_s, packets, bits, wrong_bits = zip(*self._recent, strict=True)
        span_s = max(times_s[-1] - times_s[0], 1e-3)
        return {
            "frames_per_s": (len(times_s) - 1) / span_s,
            "packets_per_s": sum(packets[1:]) / span_s,
            "bits_per_s": sum(bits[1:]) / span_s,
            "ber_hat": sum(wrong_bits) / sum(bits) if any(bits) else None,
        }


def aiming_hint(result: FrameResult, light: Brightness | None = None) -> tuple[str, str]:
    """Why there is no lock, and the one thing to do next, for a person who holds the camera.

    Light comes first: in a picture that is too dark or overexposed, nothing else can be judged.
    """
    if light is not None and result.status != "unreadable":
        if light.mean < _DARK:
            return "The picture is too dark.", "Expose longer, raise the gain, or show a brighter picture."
        if light.clipped > _BRIGHT or light.mean > _WASHED_OUT:
            return "The picture is so bright that stripes fade.", "Expose shorter."
    reason, advice = _AIMING.get(result.reason) or split_message(result)
    return reason, _CLOSER if "closer so" in advice or advice == "Move closer." else advice


def split_message(result: FrameResult) -> tuple[str, str]:
    """Why nothing was received, and the next step, as two sentences.

    Messages are `what; next step`, see `rxcli.errors`; parts of the headline are left out.
    """
    text = printable((result.message or "no packet was found").removeprefix(result.source + ": "))
    reason, _, advice = text.partition("; ")
    return sentence(reason), sentence(advice)
