"""The quick part of ``splatsoil benchmark validate``: laboratories and closed forms, on coarse grids."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from splatsoil.benchmarks._validation import columns, cuts, inclines, plates
from splatsoil.benchmarks._validation.blades import SCATTER, Blade, mckyes
from splatsoil.benchmarks.validate import main

from splatsoil.errors import MeasurementError, SimulationError
from splatsoil.mpm.tool import build_tool, thickened
from splatsoil.soil.matching import Matching

MEASURED = Path(os.environ.get("SPLATSOIL_MEASURED", "nowhere"))


def test_a_column_runs_out_as_in_the_laboratory_and_strong_sand_does_not() -> None:
    """Lube et al. (2004): 1.24 a, within 20 %; sand with a stress ratio of 1.30 stays far short of it."""
    sand = columns.Column(particles=2000.0)
    assert sand.run_out("cpu") == pytest.approx(1.24, rel=0.2)
    strong = replace(sand, friction_angle=55.0, matching=Matching.COMPRESSION)
    assert strong.run_out("cpu") < 0.8 * 1.24


def test_a_vertical_cut_stands_with_the_cohesion_of_limit_analysis() -> None:
    """γ H / c = 3.83 tan(45° + φ/2) (Chen 1975), up to what soil without dilation needs more (Davis 1968)."""
    exact, most = cuts.expected(33.0), cuts.davis(33.0)
    assert cuts.sinks(cuts.cut(0.7 * exact, 33.0, 6), "cpu") > cuts.FALLEN
    assert cuts.sinks(cuts.cut(most, 33.0, 6), "cpu") < cuts.FALLEN


@pytest.mark.parametrize(("angles", "factor"), [((90, 0, 35), 1.8451), ((90, 20, 35), 4.162), ((60, 20, 35), 1.820)])
def test_mckyes_factors_are_the_published_ones(angles: tuple[int, int, int], factor: float) -> None:
    assert mckyes(*angles)[0] == pytest.approx(factor, rel=1e-3)


@pytest.mark.parametrize("blade", [Blade(0.08), Blade(0.08, rake=60.0, cells=8.0), Blade(0.08, friction_angle=25.0)])
def test_a_smooth_blade_bears_passive_pressure(blade: Blade) -> None:
    assert blade.force("cpu") == pytest.approx(blade.expected, rel=SCATTER)


@pytest.mark.parametrize("skin", [0.0, 0.002])
def test_a_raked_plate_keeps_its_thickness(skin: float) -> None:
    """A plate turned by 45 degrees in its own frame: its middle lies half its thickness, and the skin, inside."""
    plate = trimesh.creation.box(extents=[0.01, 0.2, 0.2])
    plate.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 4, [0.0, 1.0, 0.0]))
    tool = build_tool(plate, margin=0.02, stiffness=1.0, damping=0.0, device="cpu", skin=skin, thin=0.02)
    assert tool.distance.numpy().min() == pytest.approx(-0.005 - skin, rel=0.1)
    assert tool.spacing < 0.01


def test_soil_stops_before_a_plates_faces_and_not_before_its_edges() -> None:
    """Distances in front of a box 1 x 20 x 20 cm: from its face less half a centimetre, from its edge whole."""
    plate = trimesh.creation.box(extents=[0.01, 0.2, 0.2])
    tool = build_tool(plate, margin=0.03, stiffness=1.0, damping=0.0, device="cpu", skin=0.005, thin=0.02)
    distance, lower = tool.distance.numpy(), np.array(tool.lower)
    axes = [lower[k] + tool.spacing * np.arange(n) for k, n in enumerate(distance.shape)]
    middle = [int(np.argmin(np.abs(axis))) for axis in axes]
    front, below = axes[0] > 0.006, axes[2] < -0.101
    np.testing.assert_allclose(distance[front, middle[1], middle[2]], axes[0][front] - 0.005 - 0.005, atol=1e-6)
    np.testing.assert_allclose(distance[middle[0], middle[1], below], -0.1 - axes[2][below], atol=1e-4)


def test_curved_plates_grow_across_and_blocks_all_around() -> None:
    """A pipe 12 mm thick by the skin on either side and not along; a ball and a drum by the skin everywhere."""
    pipe = trimesh.creation.annulus(0.1, 0.112, 0.12, sections=96)
    grown = thickened(pipe, skin=0.005, thin=0.02)
    radii = np.linalg.norm(grown.vertices[:, :2], axis=1)
    assert grown.is_volume
    np.testing.assert_allclose([radii.min(), radii.max()], [0.095, 0.117], atol=1e-4)
    assert grown.extents[2] == pytest.approx(0.12, abs=5e-4)
    ball = thickened(trimesh.creation.icosphere(4, 0.05), skin=0.005, thin=0.02)
    np.testing.assert_allclose(np.linalg.norm(ball.vertices, axis=1), 0.055, atol=2e-5)
    drum = thickened(trimesh.creation.cylinder(0.06, 0.12, sections=96), skin=0.005, thin=0.02)
    assert drum.is_volume
    np.testing.assert_allclose(drum.extents, [0.13, 0.13, 0.13], atol=2e-4)


def test_the_flat_foot_of_a_raked_plate_stays() -> None:
    """It isn't parallel to what lies behind it; a foot half a cell lower would bear a quarter more."""
    plate = trimesh.creation.box(extents=[0.01, 0.2, 0.2])
    shear = np.eye(4)
    shear[0, 2] = -1.0 / math.tan(math.radians(60.0))
    plate.apply_transform(shear)
    grown = thickened(plate, skin=0.0025, thin=0.01)
    assert grown.bounds[0, 2] == pytest.approx(plate.bounds[0, 2], abs=2e-5)
    broad = np.abs(grown.face_normals[:, 0]) > 0.5
    across = grown.triangles_center[broad] @ grown.face_normals[broad][0]
    assert np.ptp(across) == pytest.approx(0.01 * math.sin(math.radians(60.0)) + 0.005, rel=1e-3)


def test_a_scene_without_a_tool_takes_a_number_of_steps_and_one_with_a_tool_takes_poses() -> None:
    scene = columns.Column(particles=300.0).scene()
    run = scene.solver("cpu")
    np.testing.assert_array_equal(run.advance(2), 0.0)
    for wrong in (0, []):
        with pytest.raises(SimulationError, match="number of steps where there is no tool"):
            run.advance(wrong)


def test_an_obstacle_that_the_grid_cannot_see_is_refused() -> None:
    """A sphere in the middle of a cell reaches its corners when its radius is half the cell's diagonal."""
    scene = columns.Column(particles=300.0).scene()
    cell = scene.resolution.cell
    half = {"obstacle_x": 0.5 * cell, "obstacle_y": 0.5 * cell, "obstacle_height": 0.5 * cell}
    odd = round(scene.upper[0] / cell) % 2
    if odd:
        half |= {"obstacle_x": 0.0, "obstacle_y": 0.0}
    reach = 0.5 * math.sqrt(3.0) * cell
    seen = replace(scene, effects=("buried_obstacle",), values={**half, "obstacle_radius": 1.02 * reach})
    seen.solver("cpu").advance(1)
    with pytest.raises(SimulationError, match=r"holds no node of the grid.*finer preset"):
        replace(seen, values={**half, "obstacle_radius": 0.98 * reach}).solver("cpu")


@pytest.mark.slow
def test_a_layer_flows_down_an_incline_as_bagnold_says() -> None:
    assert inclines.Chute(24.0).ratio("cpu") == pytest.approx(1.0, abs=inclines.ALLOWED)


def test_forces_at_equal_depth_over_diameter_grow_with_the_cube() -> None:
    depths = np.array(plates.DEPTHS)
    assert plates.similar(1e5 * depths, 0.12) == pytest.approx(8.0 * 1e5 * depths[-1] / 2.0)


@pytest.mark.skipif(not (MEASURED / "cmu_plates").is_dir(), reason="SPLATSOIL_MEASURED names no cmu_plates")
def test_measured_plates_are_read_as_their_authors_processed_them() -> None:
    """Mean forces at 5/10/15/18 mm by the authors' own touch-down, which lies up to half a millimetre from ours."""
    published = {0.06: (13.3, 25.1, 39.9, 50.1), 0.08: (26.3, 57.5, 96.4, 121.8), 0.1: (51.0, 119.0, 207.0, 267.0)}
    for diameter, forces in published.items():
        np.testing.assert_allclose(plates.measured(MEASURED, diameter).mean(axis=0), forces, rtol=0.12)


def test_missing_plates_are_named(tmp_path: Path) -> None:
    with pytest.raises(MeasurementError, match="no trials of the plate of 60 mm"):
        plates.measured(tmp_path, 0.06)


def test_the_law_is_exact_and_written_into_the_page(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "<!-- validation: written by the command, what stands here is overwritten -->\n<!-- validation: end -->"
    )
    assert main(["--only", "element", "--out", str(tmp_path / "out"), "--page", str(page)]) == 0
    text = page.read_text()
    assert "14.639, 20.000, 26.902, 35.989, 48.284 kPa" in text and "11 of 11 comparisons hold" in text
