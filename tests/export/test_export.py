"""Exports of a small simulation, read back by the libraries that others read them with."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from splatsoil.errors import ParameterError
from splatsoil.export import make_writers, replay
from splatsoil.measurement import Bed, Camera, Frame, Measurement, Tool, ToolMotion
from splatsoil.model import Model
from splatsoil.mpm import Trajectory
from splatsoil.splats import load_ply, rasterise

BED = Bed(np.zeros(3), np.array([0.4, 0.4, 0.2]), 1600.0)
DEPTH, RATE, SPEED = 0.1, 50.0, 0.5
FRAMES = (0, 3, 6)
VALUES = {"friction_angle": 33.0}


@pytest.fixture(scope="module")
def measurement() -> Measurement:
    """A box goes through level soil along x, turning about the vertical; a camera looks down on it."""
    times = np.arange(9) / RATE
    positions = np.stack([0.15 + SPEED * times, np.full(9, 0.2), np.full(9, 0.1)], axis=1)
    quaternions = Rotation.from_euler("z", 2.0 * times[:, None]).as_quat(scalar_first=True)
    pose = np.eye(4)
    pose[:3, 3] = [0.2, 0.2, DEPTH + 0.6]
    camera = Camera(90, 90, 150.0, 150.0, 45.0, 45.0, pose, model="PINHOLE")
    video = tuple(Frame(camera, Path(), "top", f, f / RATE) for f in FRAMES)
    force = np.array([[k, k / RATE, -float(k), 0.25, 0.5] for k in (2, 3)])
    tool = Tool(trimesh.creation.box((0.03, 0.08, 0.06)), ToolMotion(np.arange(9), times, positions, quaternions))
    tool = Tool(tool.mesh, tool.motion, force=force)
    return Measurement(Path(), "made", np.array([0.0, 0.0, -9.81]), RATE, BED, tool, (), video)


@pytest.fixture(scope="module")
def make_model(
    measurement: Measurement, over_level_soil: Callable[..., Model], spotted: Callable[..., Any]
) -> Callable[..., Model]:
    """Makes a model with some effects, over soil with spots."""

    def make(*effects: str) -> Model:
        model = over_level_soil(measurement, DEPTH, *effects)
        particles = model.particles().astype(np.float32)
        scene = spotted(particles, model.resolution.spacing, BED, 0.004, measurement.tool.mesh)
        model._scene = lambda seed: scene  # type: ignore[assignment]
        return model

    return make


@pytest.fixture(scope="module")
def model(make_model: Callable[..., Model]) -> Model:
    return make_model()


@pytest.fixture(scope="module")
def trajectory(model: Model) -> Trajectory:
    """The same simulation as fits make it."""
    return model.simulate(VALUES)


def export(model: Model, folder: Path, *formats: str, frames: tuple[int, ...] = FRAMES) -> Path:
    writers = make_writers(folder, formats, model, frames)
    replay(model, VALUES, frames, writers)
    return folder


def at(file: Path, time: float) -> Any:
    """The mesh of a .pvd at a time, as ParaView's own reader has it."""
    pyvista = pytest.importorskip("pyvista")
    reader = pyvista.PVDReader(file)
    reader.set_active_time_value(time)
    return reader.read()[0]


def test_vtk_series_hold_the_simulation(model: Model, trajectory: Trajectory, tmp_path: Path) -> None:
    pytest.importorskip("meshio")
    pyvista = pytest.importorskip("pyvista")
    folder = export(model, tmp_path / "e", "vtk", frames=tuple(range(8))) / "vtk"
    assert pyvista.PVDReader(folder / "particles.pvd").time_values == pytest.approx([k / RATE for k in range(8)])
    before, now, after = (at(folder / "particles.pvd", k / RATE) for k in (5, 6, 7))
    assert now.n_cells == now.n_points == len(model.particles())
    np.testing.assert_array_equal(now.points, trajectory.positions[2])
    np.testing.assert_allclose(now["displacement"], trajectory.positions[2] - trajectory.positions[0], atol=1e-7)
    # A step of the solver takes a quarter of a frame and more, over which velocities change: most of it must agree.
    difference = 0.5 * RATE * (after.points - before.points)
    moving = np.linalg.norm(difference, axis=1) > 0.1 * SPEED
    assert moving.sum() > 20
    misfit = np.linalg.norm(now["velocity"] - difference, axis=1)[moving]
    assert np.median(misfit / np.linalg.norm(difference, axis=1)[moving]) < 0.2
    # At rest the pressure is the weight of what lies above.
    still = at(folder / "particles.pvd", 0.0)
    slope = np.polyfit(DEPTH - still.points[:, 2], still["pressure"], 1)[0]
    assert slope == pytest.approx(1600.0 * 9.81, rel=0.1)
    assert "plastic_strain" not in now.array_names


def test_vtk_tool_and_surface(model: Model, tmp_path: Path) -> None:
    pytest.importorskip("meshio")
    folder = export(model, tmp_path / "e", "vtk") / "vtk"
    tool = at(folder / "tool.pvd", 6 / RATE)
    centre = np.array([0.15 + SPEED * 6 / RATE, 0.2, 0.1])
    corner = Rotation.from_euler("z", 2.0 * 6 / RATE).apply([0.015, 0.04, 0.03]) + centre
    assert np.linalg.norm(tool.points - corner, axis=1).min() < 1e-6
    assert np.allclose(tool.points.mean(axis=0), centre)
    rest, now = (at(folder / "surface.pvd", time) for time in (0.0, 6 / RATE))
    inside = np.abs(rest.points[:, :2] - 0.2).max(axis=1) < 0.15
    # Particles' uppermost centres lie half a spacing beneath it.
    assert rest.points[inside, 2].mean() == pytest.approx(DEPTH, abs=0.1 * model.resolution.spacing)
    assert np.abs(rest["height_change"]).max() == 0.0
    np.testing.assert_allclose(now["height_change"], now.points[:, 2] - rest.points[:, 2], atol=1e-7)
    assert now["height_change"].max() > 0.002, "soil rises before the box"
    assert now.n_cells == (len(np.unique(now.points[:, 0])) - 1) * (len(np.unique(now.points[:, 1])) - 1)
    normals = now.extract_surface(algorithm="dataset_surface").compute_normals(auto_orient_normals=False)
    assert normals["Normals"][:, 2].min() > 0.0


def test_plastic_strain_where_an_effect_keeps_it(make_model: Callable[..., Model], tmp_path: Path) -> None:
    pytest.importorskip("meshio")
    folder = export(make_model("dilatancy"), tmp_path / "e", "vtk") / "vtk"
    early, late = (at(folder / "particles.pvd", k / RATE)["plastic_strain"] for k in (3, 6))
    far = np.linalg.norm(at(folder / "particles.pvd", 0.0).points[:, :2] - 0.2, axis=1) > 0.18
    assert early.min() >= 0.0 and late.sum() > 1.5 * early.sum() > 0.0
    assert late[far].mean() < 0.2 * late[~far].mean(), "soil shears where the box is"


def test_usd_stage(model: Model, trajectory: Trajectory, tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    file = export(model, tmp_path / "e", "usd") / "usd" / "prediction.usdc"
    stage = Usd.Stage.Open(str(file))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0.0, 6.0, RATE)
    points = UsdGeom.Points(stage.GetPrimAtPath("/World/Particles"))
    assert points.GetPointsAttr().GetTimeSamples() == list(FRAMES)
    for k, frame in enumerate(FRAMES):
        np.testing.assert_array_equal(np.array(points.GetPointsAttr().Get(frame)), trajectory.positions[k])
    assert np.linalg.norm(np.array(points.GetVelocitiesAttr().Get(6)), axis=1).max() > 0.5 * SPEED
    assert list(points.GetWidthsAttr().Get()) == pytest.approx([model.resolution.spacing])
    colours = np.array(points.GetDisplayColorPrimvar().Get())
    assert len(colours) == len(trajectory.positions[0])
    encoded = model.scene().grain_albedo.numpy()
    np.testing.assert_allclose(colours, ((encoded + 0.055) / 1.055) ** 2.4, atol=1e-5)
    low, high = np.array(points.GetExtentAttr().Get(6))
    assert (low < trajectory.positions[2]).all() and (high > trajectory.positions[2]).all()

    tool = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Tool"))
    for k, frame in enumerate(FRAMES):
        world = tool.ComputeLocalToWorldTransform(Usd.TimeCode(frame))
        corner = Rotation.from_euler("z", 2.0 * frame / RATE).apply([0.015, 0.04, 0.03])
        wanted = corner + np.array([0.15 + SPEED * frame / RATE, 0.2, 0.1])
        assert np.allclose(world.Transform((0.015, 0.04, 0.03)), wanted, atol=1e-6), k
    assert len(tool.GetFaceVertexCountsAttr().Get()) == 12
    surface = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Surface"))
    assert surface.GetPointsAttr().GetTimeSamples() == list(FRAMES)
    assert max(surface.GetFaceVertexIndicesAttr().Get()) == len(surface.GetPointsAttr().Get(0)) - 1


def test_without_photographs_there_is_all_but_splats_and_colours(
    measurement: Measurement, over_level_soil: Callable[..., Model], tmp_path: Path
) -> None:
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    model = over_level_soil(measurement, DEPTH)
    model.reconstruction.soil[:] = False
    folder = export(model, tmp_path / "e", "vtk", "usd", "csv")
    assert (folder / "vtk" / "particles.pvd").is_file() and (folder / "csv").is_dir()
    stage = Usd.Stage.Open(str(folder / "usd" / "prediction.usdc"))
    points = UsdGeom.Points(stage.GetPrimAtPath("/World/Particles"))
    assert len(points.GetPointsAttr().Get(6)) and not points.GetDisplayColorPrimvar().HasAuthoredValue()
    with pytest.raises(ParameterError, match="--to ply: made has no photographs"):
        make_writers(tmp_path / "ply", ["ply"], model, FRAMES)


def test_openusd_finds_no_fault_in_the_stage(model: Model, tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    validation = pytest.importorskip("pxr.UsdValidation")
    from pxr import Usd

    stage = Usd.Stage.Open(str(export(model, tmp_path / "e", "usd") / "usd" / "prediction.usdc"))
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    errors = validation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in errors] == []


def test_tables(model: Model, trajectory: Trajectory, tmp_path: Path) -> None:
    folder = export(model, tmp_path / "e", "csv") / "csv"
    with (folder / "force.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [int(row["frame"]) for row in rows] == list(range(1, 7))
    assert [float(row["time"]) for row in rows] == pytest.approx([k / RATE for k in range(1, 7)])
    predicted = np.array([[float(row[f"f{axis}_predicted"]) for axis in "xyz"] for row in rows])
    np.testing.assert_allclose(predicted, trajectory.force, rtol=1e-4, atol=1e-4)
    assert [row["fx_measured"] for row in rows] == ["", "-2", "-3", "", "", ""]
    with (folder / "surface.csv").open(newline="") as stream:
        table = list(csv.DictReader(stream))
    assert list(table[0]) == ["x", "y", "reconstructed", "frame_0", "frame_3", "frame_6"]
    middle = min(table, key=lambda row: abs(float(row["x"]) - 0.08) + abs(float(row["y"]) - 0.2))
    assert float(middle["reconstructed"]) == pytest.approx(DEPTH)
    assert float(middle["frame_0"]) == pytest.approx(DEPTH, abs=2e-3)


def test_splats_show_what_the_model_draws(model: Model, trajectory: Trajectory, tmp_path: Path) -> None:
    folder = export(model, tmp_path / "e", "ply") / "ply"
    assert sorted(p.name for p in folder.iterdir()) == ["splats_000000.ply", "splats_000006.ply"]
    gaussians = load_ply(folder / "splats_000006.ply")
    posed = model.scene().pose(
        trajectory.positions[2], trajectory.deformations[2], model.measurement.tool.motion.pose(6 / RATE)
    )
    count = len(posed.centres)
    torch.testing.assert_close(gaussians.covariances()[:count], posed.covariances, rtol=1e-3, atol=1e-9)
    camera = model.measurement.cameras["top"]
    seen = rasterise(gaussians, camera, antialias=True).colour.numpy()
    pictures = model.draw(trajectory)
    drawn = pictures["top", 6]
    pixels, _ = camera.project([[0.15 + SPEED * 6 / RATE, 0.2, 0.13]])
    away = np.hypot(*(np.indices((90, 90))[::-1] + 0.5 - pixels[0][:, None, None])) > 20.0
    assert np.abs(seen - drawn)[away].mean() < 0.02
    # Where the box's shadow has come to, and soil has been moved.
    darkened = away & ((pictures["top", 0] - drawn).mean(axis=2) > 0.1)
    assert darkened.sum() > 20
    assert np.abs(seen - drawn)[darkened].mean() < 0.5 * np.abs(pictures["top", 0] - drawn)[darkened].mean()
    tool = seen[int(pixels[0, 1]), int(pixels[0, 0])]
    assert tool[2] - tool[0] > 0.5, "the box is blue"
