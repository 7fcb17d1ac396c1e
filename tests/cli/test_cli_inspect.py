"""`vlc-rx inspect`: pictures of every stage, and what they are drawn from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from small_frames import BOTTOM, N_COLUMNS, ROWS_PER_SLOT, TOP, W, write_frame, write_profiles

from rxcli.cli.common import receiver_options
from rxcli.cli.main import run
from rxcli.ingest import open_source
from rxcli.receiver.pipeline import receive
from rxcli.results import plots
from rxcli.results.plots import column_light, decided_slots

SAMPLE = Path(__file__).parents[2] / "sample_frames" / "phone_chelsea_17k3.jpg"

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
    from rxcli.receiver import sampling
    from rxcli.receiver.screen import geometry

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


@pytest.mark.parametrize("turned", [False, True])
def test_slots_of_an_unknown_camera_are_shaded_along_bent_stripes(
    turned: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import cv2

    seen: list[tuple[Any, ...]] = []
    figure, drawn = plots.new_figure(1, 1), plots.profile_figure
    monkeypatch.setattr(plots, "profile_figure", lambda *arguments: seen.append(arguments) or figure)
    stored = cv2.imread(str(SAMPLE), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(tmp_path / "phone.png"), stored[::-1, ::-1] if turned else stored)
    assert run(["inspect", str(tmp_path / "phone.png"), "--screen", "paper-17k3"]) == 0
    [(profiles, result, columns, screen)] = seen
    assert result.camera_profile is None
    shaded: list[tuple[float, NDArray[np.uint8]]] = []
    monkeypatch.setattr(plots, "_shade", lambda axes, start, rows_per_slot, slots: shaded.append((start, slots)))
    rows_per_slot = 1 / (screen.slot_rate_hz * result.line_delay_s)
    agreement = []
    for column in columns:
        rows, light = column_light(profiles, column.column)
        drawn(profiles, result, (column,), screen)
        for start, slots in shaded:
            number = np.floor((rows - start) / rows_per_slot).astype(int)
            shown = (number >= 0) & (number < slots.size)
            agreement.append(np.corrcoef(light[shown], slots[number[shown]])[0, 1])
        shaded.clear()
    assert len(agreement) >= 18
    assert np.median(agreement) > 0.7
