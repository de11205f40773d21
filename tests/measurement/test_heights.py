"""Grids of heights and depth maps, written by other libraries and read back; and what is wrong with a set's."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import skimage.io
import tifffile

from splatsoil.cli import main
from splatsoil.measurement import Camera, Contents, Frame, HeightMaps, Measurement, Picture, remarks, write_measurement
from splatsoil.measurement.heights import depth_points, read_heights
from splatsoil.reconstruction.heights import Cells, seen_heights

RAMP = np.linspace(0.1, 0.14, 16 * 10).reshape(10, 16).astype(np.float32)
"""Heights of a grid of 5 cm over a bed of 0.8 x 0.5 m, the first row at the lowest y."""


def with_heights(folder: Path, grids: dict[int, np.ndarray], **about: object) -> Path:
    """A set beside whose pictures lie grids of heights."""
    (folder / "heights").mkdir()
    entries = []
    for number, grid in grids.items():
        np.save(folder / "heights" / f"{number}.npy", grid)
        entries.append({"file_path": f"{number}.npy", "frame": number})
    told = {"corner": [0.0, 0.0], "cell": 0.05, **about, "frames": entries}
    told = {key: value for key, value in told.items() if value is not None}
    (folder / "heights" / "heights.json").write_text(json.dumps(told))
    experiment = json.loads((folder / "experiment.json").read_text())
    (folder / "experiment.json").write_text(json.dumps({**experiment, "heights": "heights/heights.json"}))
    return folder


def test_a_map_has_north_above_and_an_array_its_first_row_at_the_corner(tmp_path: Path) -> None:
    holed = np.where(RAMP > 0.13, np.nan, RAMP)
    np.save(tmp_path / "a.npy", holed)
    tifffile.imwrite(
        tmp_path / "a.tif",
        np.nan_to_num(holed, nan=-9999.0)[::-1],
        extratags=[(42113, "s", 0, "-9999", True)],
    )
    tifffile.imwrite(tmp_path / "b.tiff", holed[::-1], compression="zlib", tile=(16, 16))
    for name in ("a.npy", "a.tif", "b.tiff"):
        np.testing.assert_allclose(read_heights(tmp_path / name), holed, rtol=1e-6)


def test_points_are_the_centres_of_cells(small_set: Path) -> None:
    holed = RAMP.copy()
    holed[0, 0] = np.nan
    heights = Measurement.load(with_heights(small_set, {0: holed, 10: RAMP}, noise=0.002)).heights
    assert heights is not None and heights.noise == 0.002 and list(heights.grids) == [0, 10]
    points = heights.points(0)
    assert len(points) == RAMP.size - 1
    np.testing.assert_allclose(points[0], [0.075, 0.025, RAMP[0, 1]], rtol=1e-6)
    np.testing.assert_allclose(points[-1], [0.775, 0.475, RAMP[-1, -1]], rtol=1e-6)


def test_a_depth_map_shows_the_points_that_its_pixels_are_of(plow_dry: Path, tmp_path: Path) -> None:
    camera = replace(Measurement.load(plow_dry).cameras["left"], k1=-0.2, k2=0.03, p1=0.002)
    rows, columns = np.mgrid[: camera.height, : camera.width]
    depth = 0.7 + 0.001 * rows + 0.0005 * columns
    depth[:5] = 0.0
    skimage.io.imsave(tmp_path / "d.png", np.round(depth / 2e-5).astype(np.uint16), check_contrast=False)
    tifffile.imwrite(tmp_path / "d.tif", depth.astype(np.float32))
    skimage.io.imsave(tmp_path / "p.png", np.zeros((camera.height, camera.width, 3), np.uint8), check_contrast=False)
    for name, scale in (("d.png", 2e-5), ("d.tif", 1e-3)):
        frame = Frame(camera, tmp_path / "p.png", depth_path=tmp_path / name, depth_scale=scale)
        points = depth_points(frame)
        assert len(points) == (camera.height - 5) * camera.width
        pixels, along = camera.project(points)
        np.testing.assert_allclose(pixels, np.stack([columns, rows], -1)[5:].reshape(-1, 2) + 0.5, atol=1e-3)
        np.testing.assert_allclose(along, depth[5:].reshape(-1), atol=2e-5)


def test_a_set_of_heights_and_depths_is_what_was_written(small_set: Path, tmp_path: Path) -> None:
    given = Measurement.load(small_set)
    camera: Camera = given.cameras["left"]
    depth = np.full((camera.height, camera.width), 0.9)
    noise = np.random.default_rng(0).uniform(size=(camera.height, camera.width, 3))
    heights = HeightMaps(np.zeros(2), 0.05, {0: RAMP.astype(np.float64)}, 0.001)
    scanned = Contents(name="made", bed=given.bed, tool=given.tool, frame_rate=given.frame_rate, heights=heights)
    seen = replace(scanned, views=given.views, video=[Picture(camera, noise, 0, 0.0, depth)])
    made = write_measurement(tmp_path / "made", seen)
    assert made.heights is not None and made.heights.noise == 0.001
    np.testing.assert_array_equal(made.surface_points(0), heights.points(0))
    np.testing.assert_allclose(replace(made, heights=None).surface_points(0), depth_points(made.video[0]))
    bare = write_measurement(tmp_path / "bare", scanned)
    assert bare.frames == (0,) and not bare.cameras and not bare.views
    before = bare.hash
    np.save(bare.folder / "heights" / "+0000.npy", RAMP + np.float32(0.001))
    assert Measurement.load(bare.folder).hash != before


def renamed_grid(folder: Path, suffix: str) -> Path:
    """Heights of frame 0 in a file of another suffix."""
    listed = with_heights(folder, {0: RAMP}) / "heights"
    (listed / "0.npy").rename(listed / f"0{suffix}")
    file = listed / "heights.json"
    file.write_text(file.read_text().replace("0.npy", f"0{suffix}"))
    return folder


def test_suffixes_may_be_in_capitals_and_exact_zeros_get_a_remark(small_set: Path) -> None:
    renamed_grid(small_set, ".NPY")
    before = Measurement.load(small_set)
    assert np.isfinite(before.surface_points(0)).all() and not [r for r in remarks(before) if r.about == "heights"]
    grid = RAMP.copy()
    grid[0, :3] = 0.0
    with (small_set / "heights" / "0.NPY").open("wb") as file:
        np.save(file, grid)
    assert "3 heights are exactly 0 m" in " ".join(r.text for r in remarks(Measurement.load(small_set)))


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "another shape": (lambda s: with_heights(s, {0: RAMP, 10: RAMP[:-1]}), "9 x 16 cells where that of frames"),
    "no corner": (lambda s: with_heights(s, {0: RAMP}, corner=None), "corner"),
    "no cell": (lambda s: with_heights(s, {0: RAMP}, cell=None), "cell"),
    "millimetres": (lambda s: with_heights(s, {0: 1000.0 * RAMP}), "heights are in metres"),
    "depths": (lambda s: with_heights(s, {0: -RAMP}), "upwards"),
    "no number for unknown": (lambda s: with_heights(s, {0: np.where(RAMP.mean() < RAMP, RAMP, -9999.0)}), "is NaN"),
    "noise in millimetres": (lambda s: with_heights(s, {0: RAMP}, noise=0.5), "more than the bed's depth"),
    "a table": (lambda s: renamed_grid(s, ".csv"), "save a .npy or a TIFF"),
    "all unknown": (lambda s: with_heights(s, {0: np.nan * RAMP}), "no height is known"),
    "whole numbers": (lambda s: with_heights(s, {0: np.ones((4, 4), int)}), "floating-point metres"),
    "elsewhere": (lambda s: with_heights(s, {0: RAMP}, corner=[10.0, 0.0]), "no known height lies over the soil's box"),
    "not before": (lambda s: with_heights(s, {10: RAMP}), "no grid of frame 0"),
    "no file": (lambda s: (with_heights(s, {0: RAMP}) / "heights" / "0.npy").unlink(), "no such file"),
    "no frames": (lambda s: with_heights(s, {}), "the list is empty"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_heights_are_refused_by_one_sentence(
    what: str, small_set: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil, said = BAD[what]
    spoil(small_set)
    assert main(["check", str(small_set)]) == 2
    told = capsys.readouterr()
    assert said in told.err and "heights" in told.err and len(told.err.splitlines()) == 1 and not told.out


def test_what_is_higher_than_the_bed_is_no_soil(small_set: Path) -> None:
    """A gantry, or 9999 for unknown: cells with nothing else are unknown, others are as without it."""
    plain = Measurement.load(with_heights(small_set, {0: RAMP})).bed
    cells = Cells(plain.lower[:2], np.array([0.1, 0.1]), (5, 8))
    alone = seen_heights(Measurement.load(small_set), 0, cells)
    high = RAMP.copy()
    high[0, 0], high[8:10, 12:14] = 9999.0, plain.upper[2] + 2.0
    np.save(small_set / "heights" / "0.npy", high)
    found = seen_heights(Measurement.load(small_set), 0, cells)
    kept = np.isfinite(found)
    assert np.isfinite(alone).sum() > kept.sum() > 0
    np.testing.assert_allclose(found[kept], alone[kept], atol=0.05)
    assert np.nanmax(found[:, 2]) <= plain.upper[2]


def test_without_a_video_there_must_be_heights_and_without_views_no_video(
    small_set: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    experiment = json.loads((small_set / "experiment.json").read_text())
    del experiment["video"]
    (small_set / "experiment.json").write_text(json.dumps(experiment))
    assert main(["check", str(small_set)]) == 2 and "video" in capsys.readouterr().err
    with_heights(small_set, {0: RAMP, 10: RAMP})
    assert main(["check", str(small_set), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["heights"] == [0, 10] and told["video"]["cameras"] == []
    experiment = json.loads((small_set / "experiment.json").read_text())
    experiment["video"] = "video/transforms.json"
    del experiment["views"]
    (small_set / "experiment.json").write_text(json.dumps(experiment))
    assert main(["check", str(small_set)]) == 2 and "views" in capsys.readouterr().err
