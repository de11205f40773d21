"""`splatsoil check --pictures`: what is drawn lies where a pinhole camera puts it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from splatsoil import cli
from splatsoil.measurement import Bed, Camera, Frame, Measurement, Tool, ToolMotion
from splatsoil.report.overlay import BED, MOTION, TOOL, overlays


def test_lines_lie_where_a_pinhole_puts_them(tmp_path: Path) -> None:
    """From 1 m above the bed's floor, 200 px a metre there; a box goes 0.2 m along x at half the height."""
    Image.new("RGB", (200, 160), (90, 90, 90)).save(tmp_path / "grey.png")
    pose = np.eye(4)
    pose[:3, 3] = [0.3, 0.2, 1.0]
    camera = Camera(200, 160, 200.0, 200.0, 100.0, 80.0, pose, name="top", model="PINHOLE")
    times = np.arange(3) / 10.0
    positions = np.stack([0.2 + times, np.full(3, 0.2), np.full(3, 0.5)], axis=1)
    tool = Tool(
        trimesh.creation.box((0.04, 0.08, 1e-6)),
        ToolMotion(np.arange(3), times, positions, np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))),
    )
    video = tuple(Frame(camera, tmp_path / "grey.png", "top", n, n / 10.0) for n in (0, 2))
    bed = Bed(np.zeros(3), np.array([0.6, 0.4, 0.2]), 1600.0)
    views = (Frame(camera, tmp_path / "grey.png"),)
    made = Measurement(tmp_path, "made", np.array([0.0, 0.0, -9.81]), 10.0, bed, tool, views, video)
    pictures = {name: np.asarray(picture) for name, picture in overlays(made)}
    assert pictures.keys() == {"view_000", "top_0000", "top_0002"}

    def reaches(name: str, colour: tuple[int, int, int]) -> tuple[list[int], list[int]]:
        rows, columns = np.nonzero((pictures[name] == colour).all(axis=2))
        return [columns.min(), columns.max()], [rows.min(), rows.max()]

    # The bed's top, 0.8 m below the camera, is the wider rectangle: 250 px a metre.
    np.testing.assert_allclose(reaches("view_000", BED), [[100 - 75, 100 + 75], [80 - 50, 80 + 50]], atol=1)
    # The path, 0.5 m below, at 400 px a metre: from x = 0.2 to 0.4 m.
    np.testing.assert_allclose(reaches("view_000", MOTION), [[60, 140], [80, 80]], atol=1)
    for frame, middle in ((0, 60), (2, 140)):
        across = reaches(f"top_{frame:04d}", TOOL)
        np.testing.assert_allclose(across, [[middle - 8, middle + 8], [80 - 16, 80 + 16]], atol=1)
    assert not (pictures["view_000"] == TOOL).all(axis=2).any(), "views are of no moment of the motion"


def test_check_writes_them_whole_or_not_at_all(
    small_set: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "drawn"
    assert cli.main(["check", str(small_set), "--pictures", str(out)]) == 0
    assert {p.name for p in out.iterdir()} >= {"view_000.jpg", "left_0000.jpg", "right_0010.jpg"}
    assert cli.main(["check", str(small_set), "--pictures", str(out)]) == 2
    assert "not an empty folder" in capsys.readouterr().err
