"""`vlc-rx demo`: from nothing to a text and the page that shows how it was read."""

import webbrowser
from pathlib import Path

import pytest

from rxcli.cli.main import run


@pytest.fixture
def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Addresses that a browser was asked to open."""
    addresses: list[str] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", lambda address: not addresses.append(address))
    return addresses


def test_a_text_goes_through_a_photo_and_the_page_opens(opened: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["demo", "--text", "Grüße!"]) == 0
    captured = capsys.readouterr()
    page = Path("vlc-rx-demo/index.html")
    assert captured.out == f"text: Grüße!\n{page}\n"
    assert captured.err == "A simulated screen sends the text; its photo: vlc-rx-demo/photo.jpg\n"
    assert opened == [page.absolute().as_uri()]
    assert "Gr\\u00fc\\u00dfe!" in page.read_text()
    assert run(["inspect", "vlc-rx-demo/photo.jpg", "--out", "page"]) == 0
    assert capsys.readouterr().err == "text: Grüße!\n"


def test_the_page_is_named_where_no_browser_is(
    opened: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("DISPLAY")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    for option, is_named in (("--no-open", False), ("--open", True)):  # the second time over its own files
        assert run(["demo", option]) == 0
        captured = capsys.readouterr()
        told = "Open this page in a browser: it shows how the text was read.\n"
        assert captured.err.endswith(told) == is_named
        assert captured.out.endswith("vlc-rx-demo/index.html\n")
    assert opened == []


def test_a_text_that_fits_no_photo_and_a_photo_of_somebody_else_are_refused(
    opened: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["demo", "--text", "x" * 200]) == 2
    assert "--text has more than 199 bytes" in capsys.readouterr().err
    Path("mine").mkdir()
    Path("mine/photo.jpg").write_bytes(b"mine")
    assert run(["demo", "--out", "mine"]) == 2
    assert Path("mine/photo.jpg").read_bytes() == b"mine"
    assert not Path("vlc-rx-demo").exists()
