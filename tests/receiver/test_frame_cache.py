"""What is read of a frame once while outlines are compared: the last ones used are kept."""

from __future__ import annotations

import numpy as np
import pytest

from rxcli.receiver.frame import cache
from rxcli.receiver.frame.cache import FrameCache
from rxcli.types import Frame


def test_an_outline_in_use_is_sampled_once_however_many_come_between(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = {"column_outlines": 0, "sample_rows": 0}

    def counted(module: object, name: str) -> None:
        function = getattr(module, name)

        def counting(*given: object) -> object:
            counts[name] += 1
            return function(*given)

        monkeypatch.setattr(module, name, counting)

    counted(cache.geometry, "column_outlines")
    counted(cache, "sample_rows")
    frames = FrameCache(Frame(np.zeros((120, 160), np.uint8), "memory"))
    corners = np.array([[10.0, 10], [150, 10], [150, 110], [10, 110]])
    n_rivals = 2 * cache._MAX_OUTLINES
    for number in range(n_rivals):
        for moved in (0.0, 1.0 + number):
            outlines = frames.outlines(corners + [moved / 8, 0], 20, None)
            assert frames.sample(outlines, "linear").light.shape == outlines.inside.shape
    assert counts == {"column_outlines": 1 + n_rivals, "sample_rows": 1 + n_rivals}
    assert len(frames._outlines) == cache._MAX_OUTLINES
    assert len(frames._sampled) == cache._MAX_SAMPLED
