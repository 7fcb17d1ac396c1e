"""What is read of a frame once while outlines are compared: the last ones used are kept."""

from collections import Counter

import numpy as np
import pytest

from rxcli.options import ReceiverOptions
from rxcli.receiver.frame import cache
from rxcli.receiver.frame.cache import FrameCache
from rxcli.receiver.screen import find
from rxcli.receiver.screen.stripes import MIN_LEAN
from rxcli.receiver.search.outlines import lean_of, possible_screens
from rxcli.types import Frame, Metadata


def counted(monkeypatch: pytest.MonkeyPatch, *functions: tuple[object, str]) -> Counter[str]:
    """Calls of functions of modules, by name."""
    counts = Counter[str]()
    for module, name in functions:

        def counting(*given: object, name: str = name, function: object = getattr(module, name)) -> object:
            counts[name] += 1
            return function(*given)  # type: ignore[operator]

        monkeypatch.setattr(module, name, counting)
    return counts


def test_screens_are_looked_for_once_whatever_the_file_states(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = counted(monkeypatch, (find, "find_screens"))
    pixels = np.random.default_rng(3).integers(0, 255, (400, 600), np.uint8)
    frames = FrameCache(Frame(pixels, "memory", metadata=Metadata(exposure_s=1e-4)))
    for frame in (frames, frames.with_metadata(Metadata())):
        assert possible_screens(frame, ReceiverOptions()) == []
        assert abs(lean_of(frame)) < MIN_LEAN
    assert counts == {"find_screens": 1}


def test_an_outline_in_use_is_sampled_once_however_many_come_between(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = counted(monkeypatch, (cache.geometry, "column_outlines"), (cache, "sample_rows"))
    frames = FrameCache(Frame(np.zeros((120, 160), np.uint8), "memory"))
    corners = np.array([[10.0, 10], [150, 10], [150, 110], [10, 110]])
    n_rivals = 2 * cache._MAX_OUTLINES
    for number in range(n_rivals):
        for moved in (0.0, 1.0 + number):
            outlines = frames.outlines(corners + np.array([moved / 8, 0]), 20, None)
            assert frames.sample(outlines, "linear").light.shape == outlines.inside.shape
    assert counts == {"column_outlines": 1 + n_rivals, "sample_rows": 1 + n_rivals}
    assert len(frames._outlines) == cache._MAX_OUTLINES
    assert len(frames._sampled) == cache._MAX_SAMPLED
