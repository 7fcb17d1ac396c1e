"""Photos by one camera share what is estimated of it, when told so and on the page."""

import numpy as np
import pytest

from rxcli.cli import decoding
from rxcli.options import receiver_options
from rxcli.runs.batch import Source
from rxcli.types import ColumnResult, Frame, FrameResult, Metadata, PacketResult
from rxcli.web.decoding import _estimated_camera

ESTIMATED = {"line_delay_s": (5e-6, 1e-9)}
PACKET = PacketResult(0.0, 1.0, 8, "00", 0.9, 0.0)


def photo(n_received: int, name: str = "a") -> FrameResult:
    columns = tuple(ColumnResult(c, "ok", packets=(PACKET,) * (c < n_received)) for c in range(4))
    return FrameResult(name, 0, 0.0, "ok", columns=columns, estimated=ESTIMATED)


@pytest.mark.parametrize(("model", "is_forced"), [("M 1", False), (None, True)])
def test_the_first_photo_with_packets_in_half_of_its_columns_gives_the_camera_of_all(
    monkeypatch: pytest.MonkeyPatch, model: str | None, is_forced: bool
) -> None:
    sources = [Source(name, name) for name in "abc"]
    results = zip(sources, (iter([photo(n, "x")]) for n in (1, 2, 4)), strict=True)
    monkeypatch.setattr("rxcli.runs.batch.decode_here", lambda _sources, _decoder: results)
    opened: list[str] = []

    def open_source(path: str) -> list[Frame]:
        opened.append(path)
        return [Frame(np.zeros((40, 60), np.uint8), path, metadata=Metadata(make="M", model=model))]

    monkeypatch.setattr(decoding, "open_source", open_source)
    options = decoding._with_same_camera(sources, receiver_options())
    assert opened == ["b"]
    assert options.force_camera is is_forced
    assert options.cameras[0].modes[0].line_delay_s == 5e-6
    assert len(options.cameras) == 1 or not is_forced


def test_without_packets_each_camera_is_estimated_by_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    results = [(Source("a", "a"), iter([photo(1)]))]
    monkeypatch.setattr("rxcli.runs.batch.decode_here", lambda _sources, _decoder: iter(results))
    assert decoding._with_same_camera([], receiver_options()) == receiver_options()


@pytest.mark.parametrize(("model", "n_received", "is_known"), [("M 1", 2, True), ("M 1", 1, False), (None, 4, False)])
def test_the_page_knows_a_visitors_camera_by_a_photo_with_packets(
    model: str | None, n_received: int, is_known: bool
) -> None:
    frame = Frame(np.zeros((40, 60), np.uint8), "a", metadata=Metadata(model=model))
    assert (_estimated_camera(photo(n_received), frame) is not None) is is_known
