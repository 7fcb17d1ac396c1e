"""`vlc-rx inspect`: the page, and what is drawn on it."""

import asyncio
import json
import re
from contextlib import chdir
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_frames import BOTTOM, N_COLUMNS, ROWS_PER_SLOT, TOP, write_frame, write_profiles

from rxcli.cli.main import run
from rxcli.ingest import open_source
from rxcli.options import ReceiverOptions, receiver_options
from rxcli.receiver.receive import receive
from rxcli.results.inspection import Inspection, inspect_frame
from rxcli.runs.batch import collect_sources


def shown(page: Path) -> dict[str, Any]:
    """What a page draws, out of the page itself."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.read_text())
    data: dict[str, Any] = json.loads(found[1])
    return data


def inspected(path: Path, options: ReceiverOptions) -> Inspection:
    """The analysis of a photo that is received."""
    taps: dict[str, Any] = {}
    [result] = receive(open_source(path), options, lambda _, __, stages: taps.update(stages))
    return inspect_frame(taps, result)


SAMPLE = Path(__file__).parents[2] / "sample_frames" / "phone_chelsea_17k3.jpg"


def test_a_page_that_needs_nothing_else(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    payloads = write_frame(tmp_path / "a<b>.png", 1)
    out = tmp_path / "page"
    code = run(["inspect", str(tmp_path / "a<b>.png"), "--out", str(out), "--truth", "auto", *write_profiles(tmp_path)])
    assert code == 0
    assert capsys.readouterr().out == f"{out / 'index.html'}\n"
    page = (out / "index.html").read_text()
    assert {path.name for path in out.iterdir()} == {"index.html", ".vlc-rx-output"}
    assert "a&lt;b&gt;.png" in page
    assert "<b>" not in page
    assert not re.search(r'(src|href)="(?!data:)', page)
    data = shown(out / "index.html")
    assert [packet["payload"] for packet in data["packets"]] == payloads
    assert {packet["errors"] for packet in data["packets"]} == {0}
    assert [outline["status"] for outline in data["picture"]["outlines"]] == ["ok"] * N_COLUMNS
    assert len(data["inspection"]["traces"]) == len(data["inspection"]["crosstalk"]) == N_COLUMNS
    assert data["maps"]
    arguments = ["inspect", str(tmp_path / "a<b>.png"), "--out", str(out), *write_profiles(tmp_path)]
    assert run([*arguments, "--json", "-"]) == 0
    quality = json.loads(capsys.readouterr().out)["quality"]
    assert quality == data["quality"]
    assert [column["column"] for column in quality] == list(range(N_COLUMNS))
    assert all(column["snr_db"] > 10 and column["contrast"] > 0.5 for column in quality)


@pytest.mark.parametrize("name", ["{{data}}", "{{view.js}}", "{{mark}}{{app.css}}", "{{nothing}}"])
def test_a_name_that_looks_like_a_part_of_the_page_is_a_name(name: str, tmp_path: Path) -> None:
    write_frame(tmp_path / f"{name}.png", 1)
    out = tmp_path / "page"
    assert run(["inspect", str(tmp_path / f"{name}.png"), "--out", str(out), *write_profiles(tmp_path)]) == 0
    page = (out / "index.html").read_text()
    assert f"<title>{name}.png: " in page
    assert page.count('id="data"') == page.count("<style>") == 1
    assert name in shown(out / "index.html")["source"]


@pytest.mark.parametrize("width", [390, 1280])
def test_the_page_draws_all_sections_in_a_browser(width: int, tmp_path: Path) -> None:
    pytest.importorskip("aiohttp")
    from browser import CHROMIUM, Browser

    if CHROMIUM is None:
        pytest.skip("needs Debian's chromium")
    write_frame(tmp_path / "a.png", 1)
    out = tmp_path / "page"
    command = ["inspect", str(tmp_path / "a.png"), "--out", str(out), "--truth", "auto", *write_profiles(tmp_path)]
    assert run(command) == 0

    async def look() -> None:
        async with Browser(width=width) as browser:
            await browser.call("Page.navigate", url=(out / "index.html").as_uri())
            await browser.until("document.querySelectorAll('h2').length > 5")
            titles = await browser.run("[...document.querySelectorAll('h2')].map((node) => node.textContent).join('|')")
            assert titles == (
                f"{N_COLUMNS} packets received|The picture|Packets|Light and slots|How clear slots are|"
                "Is the clock right?|Light of neighbours|Confidence|Search|Time"
            )
            assert await browser.run("document.querySelectorAll('polygon.ok').length") == N_COLUMNS
            assert await browser.run("document.querySelectorAll('tbody tr').length") >= N_COLUMNS
            unnamed = "svg:not([aria-label]):not([aria-hidden]), img:not([alt])"
            assert await browser.run(f"document.querySelectorAll('{unnamed}').length") == 0
            assert await browser.run("document.documentElement.scrollWidth <= innerWidth")
            assert browser.complaints == []

    asyncio.run(look())


def test_it_writes_beside_no_photo_and_is_passed_over_by_runs_over_folders(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "here").mkdir()
    write_frame(tmp_path / "photos" / "a$ b.png", 1)
    with chdir(tmp_path / "here"):
        assert run(["inspect", str(tmp_path / "photos" / "a$ b.png"), *write_profiles(tmp_path)]) == 0
    assert capsys.readouterr().out == "inspect-a_b.png/index.html\n"
    assert {path.name for path in (tmp_path / "photos").iterdir()} == {"a$ b.png", "a$ b.truth.json"}
    write_frame(tmp_path / "here" / "inspect-a_b.png" / "copy.png", 1)
    found = collect_sources([str(tmp_path / "here")], frozenset({".png"}))
    assert all(source.problem for source in found)


def test_a_clip_has_a_timeline(tmp_path: Path) -> None:
    samples = SAMPLE.parent
    profile = str(samples / "video1080.toml")
    clip = str(samples / "video1080_chelsea_17k3.mp4")
    assert run(["inspect", clip, "--camera", profile, "--out", str(tmp_path)]) == 0
    page = shown(tmp_path / "index.html")
    assert page["headline"] == "360 packets received, 24 frames"
    assert re.fullmatch(r"Frame \d+ is shown: \d+ packets received\.", page["notes"][0])
    timeline = page["timeline"]
    assert [len(timeline), sum(frame[3] for frame in timeline)] == [24, 360]
    assert all(frame[4] for frame in timeline)


def test_what_is_measured_agrees_with_what_was_sent(tmp_path: Path) -> None:
    """Small frames have no crosstalk, an even picture and the clock of their profile."""
    write_frame(tmp_path / "a.png", 3)
    names = write_profiles(tmp_path)
    corners = [tuple(float(part) for part in text.split(",")) for text in names[5:]]
    known = inspected(tmp_path / "a.png", receiver_options((names[1],), (names[3],), tuple(corners)))
    assert known.rows_per_slot == pytest.approx(ROWS_PER_SLOT)
    np.testing.assert_allclose(known.crosstalk[:, 1], 1, atol=0.1)
    assert np.nanmax(np.abs(known.crosstalk[:, [0, 2]])) < 0.1
    late = known.residuals[:, 1]
    assert late.size >= N_COLUMNS
    assert np.abs(late).max() < 0.15
    dark, lit = known.histogram
    assert dark[20:].sum() == lit[:20].sum() == 0
    for trace in known.traces:
        assert TOP <= trace.rows.min() < trace.rows.max() <= BOTTOM
        assert np.isfinite(trace.share).mean() > 0.6


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["missing.png"], 3, "missing.png"),
        (["a.png", "--frame", "1"], 3, "has no frame 1; choose a lower --frame"),
        (["a.png", "--out", "/dev/null/x"], 2, "--out /dev/null/x/index.html: cannot be looked at (Not a directory)"),
        (["a.png", "--truth", "none.json"], 3, "none.json: cannot be read as truth"),
    ],
)
def test_failures_are_one_line(
    tmp_path: Path, arguments: list[str], code: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with chdir(tmp_path):
        write_frame(tmp_path / "a.png", 1)
        assert run(["inspect", *arguments, *write_profiles(tmp_path)]) == code
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.err.count("\n") == 1


@pytest.mark.parametrize(("turned", "mirrored"), [(False, False), (True, False), (False, True)])
def test_slots_of_an_unknown_camera_lie_along_bent_stripes(turned: bool, mirrored: bool, tmp_path: Path) -> None:
    import cv2

    stored = cv2.imread(str(SAMPLE), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(tmp_path / "phone.png"), stored[::-1, ::-1] if turned else stored)
    agreement = []
    for trace in inspected(tmp_path / "phone.png", receiver_options(screens=("paper-17k3",), mirrored=mirrored)).traces:
        good = np.isfinite(trace.relative) & np.isfinite(trace.share)
        agreement.append(np.corrcoef(trace.light[good], trace.share[good])[0, 1])
    assert len(agreement) >= 18
    assert np.median(agreement) > 0.7
