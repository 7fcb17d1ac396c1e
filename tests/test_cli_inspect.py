"""`vlc-rx inspect`: pictures of every stage, and what they are drawn from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_frames import BOTTOM, N_COLUMNS, ROWS_PER_SLOT, TOP, W, write_frame, write_profiles

from rxcli.cli.common import receiver_options
from rxcli.cli.main import run
from rxcli.ingest import open_source
from rxcli.pictures import column_light, decided_slots
from rxcli.pipeline import receive

pytest.importorskip("matplotlib", reason="matplotlib is not installed (extra plot)")


def test_pictures_and_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    payloads = write_frame(tmp_path / "a<b>.png", 1)
    out = tmp_path / "pictures"
    code = run(["inspect", str(tmp_path / "a<b>.png"), "--out", str(out), "--truth", "auto", *write_profiles(tmp_path)])
    assert code == 0
    assert capsys.readouterr().out == f"{out / 'index.html'}\n"
    names = {path.name for path in out.iterdir()}
    assert names == {"index.html", "photo.png", "confidence.png", f"profiles-000-{N_COLUMNS - 1:03}.png"}
    page = (out / "index.html").read_text()
    assert "a&lt;b&gt;.png" in page
    assert all(f'src="{name}"' in page for name in names - {"index.html"})
    assert payloads[0] in page


def test_a_picture_without_a_signal_is_still_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import cv2

    noise = np.random.default_rng(1).integers(0, 255, (620, 340), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "noise.png"), noise)
    assert run(["inspect", str(tmp_path / "noise.png"), *write_profiles(tmp_path)]) == 1
    folder = tmp_path / "noise.png.inspect"
    assert (folder / "photo.png").stat().st_size > 10_000
    assert "no_signal" in (folder / "index.html").read_text()


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["missing.png"], 3, "missing.png"),
        (["a.png", "--frame", "1"], 3, "has no frame 1; choose a lower --frame"),
        (["a.png", "--out", "/dev/null/x"], 3, "/dev/null/x: cannot be written (Not a directory)"),
        (["a.png", "--truth", "none.json"], 3, "none.json: cannot be read as truth"),
    ],
)
def test_failures_are_one_line(
    tmp_path: Path,
    arguments: list[str],
    code: int,
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_frame(tmp_path / "a.png", 1)
    assert run(["inspect", *arguments, *write_profiles(tmp_path)]) == code
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1


def test_the_shaded_slots_are_where_the_light_is(tmp_path: Path) -> None:
    """The slots of a right packet, drawn from its first row on, agree with the light under them."""
    from rxcli import geometry, sampling

    write_frame(tmp_path / "a.png", 3)
    names = write_profiles(tmp_path)
    corners = [tuple(float(part) for part in text.split(",")) for text in names[5:]]
    options = receiver_options(screens=(names[1],), cameras=(names[3],), corners=tuple(corners))
    [frame] = open_source(tmp_path / "a.png")
    [result] = receive([frame], options)
    outlines = geometry.column_outlines(options.corners, N_COLUMNS, 1, frame.width, frame.height)
    profiles = sampling.sample_rows(frame, outlines, "linear")
    for column in result.columns:
        assert column.w == W
        rows, light = column_light(profiles, column.column)
        assert TOP <= rows.min() < rows.max() <= BOTTOM
        [(start, slots)] = decided_slots(column, options.screens[0], ROWS_PER_SLOT, rows)
        number = np.floor((rows - start) / ROWS_PER_SLOT + 1e-6).astype(int)
        shown = (number >= 0) & (number < slots.size)
        assert shown.mean() > 0.6
        assert np.corrcoef(light[shown], slots[number[shown]])[0, 1] > 0.8
