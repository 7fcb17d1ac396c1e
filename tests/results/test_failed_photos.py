"""Photos that cannot be received say why and what to do: on the terminal, on the page of `serve`, and on inspect's."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import simplejpeg

from rxcli.cli.main import run
from rxcli.errors import without_commands
from rxcli.lab.simulate.capture import prepare
from rxcli.lab.simulate.pictures import load_picture
from rxcli.lab.simulate.scenes import preset
from rxcli.options import receiver_options
from rxcli.web.decoding import answer_for

#: Kind of photo -> a part of the reason, and of the next step.
PHOTOS = {
    "too dark": (
        "the picture is dark (5 % of white on average), and no screen that sends was found",
        "raise ISO, or show a brighter picture",
    ),
    "portrait": (
        "the same stripes run across all columns, as of a lamp that blinks, or of a screen on its side in the "
        "picture (portrait)",
        "turn the camera, until its long side lies along the screen's",
    ),
    "ordinary": ("no screen that sends was found", "photograph it from near"),
}


def photo(kind: str) -> bytes:
    """A JPEG as a phone may make it."""
    scene = preset("phone-plain", "data-17k3").scaled(0.4, keep_readout=True)
    if kind == "ordinary":
        picture = load_picture("astronaut", 800, 600) + np.random.default_rng(1).normal(0, 2, (600, 800, 3))
        return bytes(simplejpeg.encode_jpeg(np.clip(picture, 0, 255).astype(np.uint8), 92))
    if kind == "too dark":
        scene = replace(scene.exposed(scene.exposure_s, 1 / 2000), room=replace(scene.room, light_e_per_s=0.0))
    else:
        scene = replace(scene, pose=replace(scene.pose, roll_deg=90, fill=0.5))
    return prepare(scene, 1).frame().jpeg


@pytest.mark.parametrize("kind", PHOTOS)
def test_a_failed_photo_says_why_wherever_it_is_read(
    kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    reason, step = PHOTOS[kind]
    path = tmp_path / "photo.jpg"
    path.write_bytes(photo(kind))
    assert run(["decode", str(path)]) == 1
    assert capsys.readouterr().out.count(f"  {reason}\n  {step}") == 1

    answer = answer_for(path, "the picture", receiver_options(soft_bits=True))
    assert answer["headline"] == "No screen found"
    told = answer["reason"], answer["advice"]
    assert all(part.lower() in text.lower() for part, text in zip((reason, step), told, strict=True)), told
    assert "no screen found" not in answer["reason"].lower()  # which the headline says
    assert told == tuple(map(without_commands, told))

    assert run(["inspect", str(path), "--out", str(tmp_path / "page")]) == 1
    found = re.search(r'id="data">(.*?)</script>', (tmp_path / "page" / "index.html").read_text())
    page = json.loads(found[1])
    assert next(name for name, good in page["steps"] if not good) == "screen found"
    assert (page["headline"], page["notes"], page["advice"]) == ("No screen found", [told[0]], told[1])
    assert page["denoiser"] is None
