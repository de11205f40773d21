"""The README's picture, of a run folder that is made up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence
from splatsoil.benchmarks.readme import HEADING, main

from splatsoil.errors import RunError
from splatsoil.files import write_json

COLOURS = {"observed": (200, 30, 30), "predicted": (30, 200, 30), "difference": (30, 30, 200)}


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """Two frames of one camera, each picture of one colour, brighter in the second frame."""
    folder = tmp_path / "run"
    measurement = {"name": "plow", "folder": "nowhere", "hash": "ab" * 32}
    write_json(
        folder / "run.json", {"format": "splatsoil-run/1", "measurement": measurement, "preset": "tiny", "seed": 0}
    )
    parameter = {"estimate": 35.0, "std": 1.0, "unit": "deg", "title": "friction angle [°]", "determined": True}
    fit = {"format": "splatsoil-fit/2", "name": "base", "parameters": {"friction_angle": parameter}, "history": []}
    write_json(folder / "fit.json", {**fit, "setup": {"effects": [], "preset": "tiny"}, "minimum": {}})
    frames = []
    for frame in (10, 20):
        names = {kind: f"left_{frame:04d}_{kind}.jpg" for kind in COLOURS}
        frames.append({"camera": "left", "frame": frame, "losses": {"robust": 0.1}, **names})
        (folder / "comparison").mkdir(exist_ok=True)
        for kind, name in names.items():
            Image.new("RGB", (160, 120), tuple(c + frame for c in COLOURS[kind])).save(folder / "comparison" / name)
    told = {"format": "splatsoil-comparison/1", "fit": "base", "parameters": {"friction_angle": 35.0}}
    write_json(folder / "comparison" / "comparison.json", {**told, "cameras": ["left"], "gain": 4.0, "frames": frames})
    return folder


def test_each_frame_shows_three_pictures_under_their_headings(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "readme.webp"
    assert main([str(run), str(out)]) == 0
    shown = [np.asarray(frame.convert("RGB")).astype(int) for frame in ImageSequence.Iterator(Image.open(out))]
    assert len(shown) == 2
    for k, frame in enumerate((10, 20)):
        for place, colour in enumerate(COLOURS.values()):
            middle = shown[k][HEADING + 40 : HEADING + 80, 160 * place + 60 : 160 * place + 100]
            assert np.abs(middle.mean(axis=(0, 1)) - frame - colour).max() < 15
            heading = shown[k][:HEADING, 160 * place : 160 * (place + 1)]
            assert heading.max() > 240 and heading.min() < 80, "dark letters on white"


def test_a_camera_that_is_not_there(run: Path, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="camera 'top'"):
        main([str(run), str(tmp_path / "readme.webp"), "--camera", "top"])
    assert not (tmp_path / "readme.webp").exists()
