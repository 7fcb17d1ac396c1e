"""Profiles: shipped ones load, anything wrong is named, what is written is read back; `vlc-rx profiles`."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from rxcli.cli.main import run
from rxcli.errors import ExitCode, ProfileError
from rxcli.link.layout import beacon_layout
from rxcli.options import receiver_options
from rxcli.profiles import (
    CameraProfile,
    LensModel,
    ReadoutMode,
    ScreenProfile,
    _parsed,
    check_profile,
    dump_profile,
    load_profile,
    match_camera,
    shipped_profiles,
)
from rxcli.resources import data_dir


def test_the_users_profiles_go_by_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """From anywhere, listed with their origin; one that is broken stops nothing."""
    monkeypatch.setenv("VLC_RX_HOME", str(tmp_path / "home"))
    folder = tmp_path / "home" / "cameras"
    folder.mkdir(parents=True)
    (folder / "mycam.toml").write_text(tomli_w.dumps(CAMERA | {"name": "mycam"}))
    (folder / "broken.toml").write_text("x = [")
    monkeypatch.chdir(tmp_path)
    assert load_profile("mycam", CameraProfile).models == ("M 1",)
    assert run(["profiles"]) == 0
    captured = capsys.readouterr()
    assert "camera  mycam            user     still 640x480; lens" in captured.out
    assert "camera  xs10             shipped " in captured.out
    assert "broken.toml: not valid TOML" in captured.err
    assert run(["decode", "none.jpg", "--camera", "mycam", "--quiet"]) == ExitCode.UNREADABLE
    assert run(["decode", "none.jpg", "--camera", "broken", "--quiet"]) == ExitCode.USAGE


SCREEN: dict[str, Any] = {"format": 1, "kind": "screen", "name": "s"}
SCREEN |= {"columns": 20, "slot_rate_hz": 8650.0, "payload_symbols": 5}
CAMERA: dict[str, Any] = {
    "format": 1,
    "kind": "camera",
    "name": "c",
    "models": ["M 1"],
    "modes": [{"name": "still", "width": 640, "height": 480, "line_delay_s": 1e-5}],
    "lens": {
        "width": 640,
        "height": 480,
        "camera_matrix": [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]],
        "dist_coeffs": [0.1, 0.0, 0.0, 0.0],
    },
}


def changed(raw: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """A deep copy of `raw` with one value replaced, or, where it is None, removed."""
    copy: dict[str, Any] = json.loads(json.dumps(raw))
    *parents, last = path.split(".")
    place: Any = copy
    for part in parents:
        place = place[int(part)] if isinstance(place, list) else place[part]
    if value is None:
        del place[last]
    else:
        place[int(last) if isinstance(place, list) else last] = value
    return copy


@pytest.mark.parametrize("kind", [ScreenProfile, CameraProfile])
def test_every_shipped_file_loads_under_its_own_name(kind: Any) -> None:
    folder = data_dir("calibration") / ("screens" if kind is ScreenProfile else "cameras")
    stems = sorted(path.stem for path in folder.glob("*.toml"))
    assert stems
    assert [profile.name for profile in shipped_profiles(kind)] == stems


def test_screens_for_texts_and_files_are_those_of_the_paper_sending_a_packet_once() -> None:
    for data, paper in (("data-34k6", "paper-34k6"), ("data-17k3", "paper-17k3"), ("data-8k65", "paper-8k65")):
        ours, theirs = (load_profile(name, ScreenProfile) for name in (data, paper))
        assert (ours.repeats, theirs.repeats) == (1, 3)
        assert msgspec.structs.replace(ours, name=paper, repeats=3, description=theirs.description) == theirs


@pytest.mark.parametrize(("name", "readout_s", "fill"), [("fast-2ms", 2.4e-3, 0.85), ("fast-5ms", 5.1e-3, 0.92)])
def test_screens_for_fast_cameras_show_a_packet_and_are_tried_only_by_name(
    name: str, readout_s: float, fill: float
) -> None:
    screen = load_profile(name, ScreenProfile)
    assert fill * readout_s > screen.packet_s
    # A text of 63 bytes takes a single burst.
    assert beacon_layout(64, screen.columns, screen.payload_symbols).period == 1
    assert screen not in receiver_options().screens
    assert receiver_options(name).screens == (screen,)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("modes.0.line_delay_s", 0.0, ["line_delay_s", "0.0"]),
        ("modes.0.width", -5, ["width", "-5"]),
        ("modes.0.exposure", 1e-4, ["exposure"]),
        ("lens.dist_coeffs", [0.1], ["dist_coeffs"]),
        ("lens.camera_matrix.0.0", -500.0, ["camera_matrix", "-500.0"]),
        ("lens.camera_matrix.0.2", float("nan"), ["camera_matrix[0][2]", "nan"]),
        ("lens.camera_matrix.2.2", 2.0, ["camera_matrix", "2.0"]),
        ("lens.camera_matrix.0.1", 1e300, ["camera_matrix", "1e+300"]),
        ("lens.camera_matrix.0.0", 1e300, ["camera_matrix[0][0]", "1e+300"]),
        ("lens.camera_matrix.0.0", 1e8, ["camera_matrix", "does not fit a picture of"]),
        ("lens.camera_matrix.1.1", 1e-300, ["camera_matrix", "does not fit a picture of"]),
        ("lens.dist_coeffs", [0.0, 1e300, 0.0, 0.0, 0.0], ["dist_coeffs[1]", "<= 1000", "1e+300"]),
        ("tone", "film", ["tone", "film"]),
        ("slot_rate", 1.0, ["slot_rate"]),
        ("slot_rate_hz", "fast", ["slot_rate_hz", "'fast'"]),
        ("columns", 0, ["columns", ">= 1", "0"]),
        ("columns", 201, ["columns", "<= 200", "201"]),
        ("slot_rate_hz", 50.0, ["slot_rate_hz", ">= 500", "50.0"]),
        ("payload_symbols", 65, ["payload_symbols", "<= 64", "65"]),
        ("repeats", 33, ["repeats", "<= 32", "33"]),
        ("segment_rows", 33, ["segment_rows", "<= 32", "33"]),
        ("width_mm", 1e5, ["width_mm", "<= 10000", "100000.0"]),
        ("height_px", 4097, ["height_px", "<= 4096", "4097"]),
        ("columns", 2.5, ["columns", "2.5"]),
        ("payload_symbols", None, ["payload_symbols"]),
        ("format", 2, ["format", "2"]),
        ("kind", "camera", ["kind", "camera"]),
        ("name", "../etc", ["name", "../etc"]),
        ("light_spread", float("nan"), ["light_spread"]),
    ],
)
def test_a_wrong_profile_names_file_key_and_value(path: str, value: Any, words: list[str]) -> None:
    of_camera = path.split(".")[0] in ("modes", "lens", "tone")
    kind, raw = (CameraProfile, CAMERA) if of_camera else (ScreenProfile, SCREEN)
    with pytest.raises(ProfileError) as caught:
        check_profile(tomllib.loads(tomli_w.dumps(changed(raw, path, value))), kind, "mine.toml")
    assert "\n" not in str(caught.value)
    for word in ("mine.toml", *words):
        assert word in str(caught.value)


def test_what_cannot_be_read_is_said(tmp_path: Path) -> None:
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00\x80")
    for name in (str(binary), str(tmp_path), str(tmp_path / "absent.toml"), "no-such-profile", "a\0b"):
        with pytest.raises(ProfileError):
            load_profile(name, CameraProfile)


@settings(max_examples=150, deadline=None)
@given(st.text(max_size=200))
def test_any_text_is_a_profile_or_a_profile_error(text: str) -> None:
    with pytest.raises(ProfileError):  # no random text has all the keys
        check_profile(_parsed(text, "fuzz.toml"), ScreenProfile, "fuzz.toml")


@pytest.mark.parametrize("profile", [*shipped_profiles(ScreenProfile), *shipped_profiles(CameraProfile)])
@pytest.mark.parametrize("change", [{}, {"description": 'a "b"\n\\ \x01 \u202e'}], ids=["shipped", "described"])
def test_a_written_profile_is_read_back_exactly(profile: Any, change: dict[str, str]) -> None:
    profile = msgspec.structs.replace(profile, **change)
    assert check_profile(tomllib.loads(dump_profile(profile)), type(profile), "written") == profile


@pytest.mark.parametrize(
    ("make", "model", "size", "fits"),
    [
        ("MAKER CORP.", "m 1", (640, 480), True),
        (None, "M 1", (640, 480), True),
        ("Other", "M 1", (640, 480), False),
        ("Maker", "M 2", (640, 480), False),
        ("Maker", None, (640, 480), False),
        ("Maker", "M 1", (480, 640), False),
    ],
)
def test_profiles_match_by_make_model_and_size(
    make: str | None, model: str | None, size: tuple[int, int], fits: bool
) -> None:
    """A body takes the lens that another profile of its own gives."""
    whole = check_profile(CAMERA | {"make": "Maker"}, CameraProfile, "c")
    body, glass = msgspec.structs.replace(whole, lens=None), msgspec.structs.replace(whole, name="lens", modes=())
    assert match_camera([whole], make, model, *size) is (whole if fits else None)
    assert match_camera([glass, body], make, model, *size) == (whole if fits else None)
    assert match_camera([glass], make, model, *size) is None


def test_list_and_show(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["profiles"]) == 0
    listed = capsys.readouterr().out
    assert "paper-34k6" in listed
    assert "xs10" in listed
    assert run(["profiles", "list", "--json", "-"]) == 0
    assert {s["name"] for s in json.loads(capsys.readouterr().out)["screens"]} >= {"paper-8k65", "wide-100"}
    assert run(["profiles", "show", "xs10"]) == 0
    shown = tomllib.loads(capsys.readouterr().out)
    assert check_profile(shown, CameraProfile, "shown") == load_profile("xs10", CameraProfile)
    assert run(["profiles", "show", "no-such"]) == ExitCode.USAGE
    assert "paper-34k6" in capsys.readouterr().err


def test_validate_goes_on_after_a_bad_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good, bad, odd = tmp_path / "good.toml", tmp_path / "bad.toml", tmp_path / "odd.toml"
    good.write_text(tomli_w.dumps(CAMERA))
    bad.write_text(tomli_w.dumps(SCREEN | {"colums": 3}))
    odd.write_text('kind = "teapot"')
    assert run(["profiles", "validate"]) == 0
    assert run(["profiles", "validate", str(bad), str(odd), str(good)]) == ExitCode.USAGE
    out, err = capsys.readouterr()
    assert f"{good}: valid camera profile 'c'" in out
    assert "colums" in err
    assert "teapot" in err
    assert len(err.strip().splitlines()) == 2


def picture(path: Path, size: tuple[int, int], make: str = "", model: str = "") -> str:
    exif = Image.Exif()
    exif.update({tag: text for tag, text in ((0x010F, make), (0x0110, model)) if text})
    Image.new("L", size, 90).save(path, exif=exif)
    return str(path)


def test_which_says_the_profile_and_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    profile = tmp_path / "c.toml"
    profile.write_text(tomli_w.dumps(CAMERA))
    about = (((640, 480), "X", "M 1"), ((320, 240), "X", "M 1"), ((640, 480), "X", "M 9"), ((640, 480),))
    files = [picture(tmp_path / f"{name}.jpg", *of) for name, of in zip("abcd", about, strict=True)]
    assert run(["profiles", "which", *files, "--camera", str(profile), "--json", "-"]) == 0
    records = json.loads(capsys.readouterr().out)
    assert [r["camera"] for r in records] == ["c", None, None, None]
    assert records[0]["line_delay_s"] == 1e-5
    assert "640x480" in records[1]["reason"]
    assert "no profile of X M 9" in records[2]["reason"]
    assert "no camera model" in records[3]["reason"]
    assert run(["profiles", "which", str(tmp_path / "absent.jpg"), files[0]]) == ExitCode.UNREADABLE
    out, err = capsys.readouterr()
    assert files[0] in out
    assert "absent.jpg" in err


@pytest.mark.parametrize(
    ("kind", "change", "said"),
    [
        (ScreenProfile, {"columns": 0}, r"ScreenProfile: columns: Expected `int` >= 1 \(got 0\)"),
        (ScreenProfile, {"slot_rate_hz": float("nan")}, "slot_rate_hz"),
        (ScreenProfile, {"name": "a b"}, "name"),
        (ScreenProfile, {"columns": object()}, "columns"),
        (ReadoutMode, {"height": 0}, "ReadoutMode: height"),
        (LensModel, {"dist_coeffs": (0.1,)}, "LensModel: dist_coeffs"),
        (LensModel, {"camera_matrix": np.zeros((3, 3))}, "LensModel: camera_matrix"),
        (CameraProfile, {"tone": "odd"}, "CameraProfile: tone"),
    ],
)
def test_python_checks_values_as_files_are_checked(kind: Any, change: dict[str, Any], said: str) -> None:
    """And takes numpy's numbers as numbers."""
    good: dict[Any, dict[str, Any]] = {
        ScreenProfile: {key: value for key, value in SCREEN.items() if key not in ("format", "kind")},
        ReadoutMode: CAMERA["modes"][0],
        LensModel: CAMERA["lens"],
        CameraProfile: {"name": "c"},
    }
    with pytest.raises(ProfileError, match=said):
        kind(**(good[kind] | change))
    screen = ScreenProfile(**good[ScreenProfile] | {"columns": np.int64(20), "slot_rate_hz": np.float32(8650)})
    assert screen == ScreenProfile(**good[ScreenProfile])
    assert (screen.format, screen.kind, screen.packet_slots) == (1, "screen", 70)
    assert type(screen.slot_rate_hz) is float
    lens = LensModel(**good[LensModel] | {"dist_coeffs": np.array([0.1, 0, 0, 0])})
    assert lens == LensModel(**good[LensModel])
    with pytest.raises(ProfileError, match="ScreenProfile: columns"):
        receiver_options(msgspec.structs.replace(screen, columns=0))


@pytest.mark.parametrize("kind", [ScreenProfile, CameraProfile, ReadoutMode, LensModel])
def test_the_page_on_profiles_lists_every_field_with_its_default(kind: type[msgspec.Struct]) -> None:
    title = re.sub("(?!^)([A-Z])", r" \1", kind.__name__).capitalize()
    page = (Path(__file__).parents[1] / "docs" / "profiles.md").read_text(encoding="utf-8")
    section = page.split(f"\n## {title}\n")[1].split("\n## ")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in section.splitlines() if line.startswith("| `")]
    listed = {name.strip("`"): default.strip("`") for name, _, default, _ in rows}
    fields = msgspec.structs.fields(kind)
    defaults = {f.name: "needed" if f.required else repr(f.default).replace("'", '"') for f in fields}
    assert listed == defaults
