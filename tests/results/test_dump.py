"""Taps: what `--dump-dir` writes of photographs and of the frames of clips."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_scene import scene

from rxcli.errors import UsageError
from rxcli.lab.benchmark.trial import Trial
from rxcli.lab.simulate.capture import prepare
from rxcli.protocol import hex_to_bits, indices_to_bits
from rxcli.receiver.receive import receive
from rxcli.results.dump import dump_stages, taps_writer
from rxcli.types import FrameResult


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[FrameResult]]:
    """The taps and results of a short clip that was not compressed."""
    folder = tmp_path_factory.mktemp("taps")
    take = prepare(replace(scene("clip", "sky"), n_frames=5), 1)
    trials = [Trial(take.frame(number, threads=1)) for number in range(5)]
    frames = [replace(t.frame, source="a clip.mp4", time_s=n / 30) for n, t in enumerate(trials)]
    return folder, list(receive(frames, trials[0].options(), taps_writer(folder)))


def taps_of(folder: Path, frame: int) -> dict[str, np.ndarray]:
    with np.load(folder / f"a_clip.mp4-{frame:06d}.npz") as file:
        return dict(file)


def test_every_frame_of_a_clip_has_its_taps_and_the_bursts_that_it_reports(
    clip: tuple[Path, list[FrameResult]],
) -> None:
    folder, results = clip
    assert len(list(folder.iterdir())) == len(results) == 5
    n_packets = 0
    for result in results:
        taps = taps_of(folder, result.frame)
        np.testing.assert_array_equal(taps["geometry.corners"], result.corners)
        assert taps["sampling.inside"].shape == taps["sampling.light"].shape
        assert taps["sampling.rows"].shape == taps["sampling.light"].shape[2:]
        assert taps["channel.llr"].shape[0] == taps["sampling.light"].shape[0] == len(result.columns)
        assert taps["clock.burst"].max() + 1 == taps["bursts.number"].size
        for column in result.columns:
            for packet in column.packets:
                index = taps[f"detect.{packet.burst}.index"][0, column.column]
                assert packet.burst in taps["bursts.ended"]
                bits = hex_to_bits(packet.payload, packet.payload_bits)
                np.testing.assert_array_equal(indices_to_bits(index, int(column.w or 0)), bits)
                n_packets += 1
    assert n_packets >= 20


def test_what_is_unknown_is_left_out(tmp_path: Path) -> None:
    path = dump_stages(tmp_path / "new", "x", 7, {"a": None, "b.c": [1, 2]})
    assert path.name == "x-000007.npz"
    with np.load(path) as taps:
        assert taps.files == ["b.c"]
    with pytest.raises(UsageError, match="cannot be written"):
        dump_stages(path, "x", 0, {})
