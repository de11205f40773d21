"""A model's pictures under observation effects: drawn anew from one trajectory, never simulated anew."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from skimage.registration import phase_cross_correlation

from splatsoil.errors import ParameterError
from splatsoil.measurement import Bed, Camera, Frame, Measurement, Tool, ToolMotion
from splatsoil.mpm.simulate import Trajectory
from splatsoil.scene import linear

SPACING, DEPTH, RATE, FOCAL, SPEED = 0.02, 0.1, 10.0, 150.0, 0.2
BED = Bed(np.zeros(3), np.array([0.4, 0.4, 0.2]), 1600.0)
CAMERAS = ("left", "right")


def from_above(x):
    """0.6 m above the soil at (x, 0.2), image right is +x."""
    pose = np.eye(4)
    pose[:3, 3] = [x, 0.2, DEPTH + 0.6]
    return Camera(90, 90, FOCAL, FOCAL, 45.0, 45.0, pose, model="PINHOLE")


@pytest.fixture(scope="module")
def measurement():
    """A small box glides over a bed at 0.2 m/s along x; two cameras look down on it."""
    times = np.arange(11) / RATE
    positions = np.stack([0.1 + SPEED * times, np.full(11, 0.2), np.full(11, 0.2)], axis=1)
    motion = ToolMotion(np.arange(11), times, positions, np.tile([1.0, 0.0, 0.0, 0.0], (11, 1)))
    views = dict(zip(CAMERAS, (from_above(0.2), from_above(0.24)), strict=True))
    video = tuple(Frame(view, Path(), n, f, f / RATE) for n, view in views.items() for f in (0, 4, 8))
    tool = Tool(trimesh.creation.box((0.04, 0.04, 0.04)), motion)
    return Measurement(Path(), "made", np.array([0.0, 0.0, -9.81]), RATE, BED, tool, (), video)


@pytest.fixture(scope="module")
def still():
    axis = np.arange(SPACING / 2, 0.4, SPACING)
    levels = np.arange(SPACING / 2, DEPTH, SPACING)
    return np.stack(np.meshgrid(axis, axis, levels, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)


@pytest.fixture(scope="module")
def scene(measurement, still, spotted):
    """Level, spotted soil under a steep sun."""
    # Spots that hardly overlap: of overlapping ones at the same depth, a turn changes which comes first.
    return spotted(still, SPACING, BED, 0.002, measurement.tool.mesh)


@pytest.fixture(scope="module")
def model_of(measurement, scene, over_level_soil):
    def make(*effects):
        model = over_level_soil(measurement, DEPTH, *effects)
        model._scene = lambda seed: scene
        return model

    return make


def trajectory_of(model, still, drift=(0.0, 0.0, 0.0)):
    """Soil that moves as one, by ``drift`` metres a frame."""
    moved = [still + np.float32(f) * np.asarray(drift, dtype=np.float32) for f in model.recorded]
    eye = np.tile(np.eye(3, dtype=np.float32), (len(moved), len(still), 1, 1))
    return Trajectory(model.recorded, np.stack(moved), eye, np.zeros((10, 3)), SPACING, model.resolution)


def tool_column(image):
    """Where the blue tool is, in pixels along the rows."""
    blue = np.clip(image[..., 2] - image[..., 0] - 0.2, 0.0, None)
    return float((blue.sum(axis=0) * (np.arange(image.shape[1]) + 0.5)).sum() / blue.sum())


def test_each_camera_of_the_set_has_its_own_six_numbers(model_of):
    model = model_of("camera_pose", "cohesion")
    free = [p.name for p in model.observation_parameters]
    kinds = ("pan", "tilt", "roll", "right", "up", "forward")
    assert free == [f"camera_{k}_{name}" for k in (1, 2) for name in kinds]
    assert set(free) | {"friction_angle", "cohesion"} == set(model.space().names)
    assert "camera right" in next(p.label for p in model.parameters if p.name == "camera_2_pan")


def test_a_pan_shifts_the_picture_of_that_camera_alone(model_of, still):
    model = model_of("camera_pose")
    trajectory = trajectory_of(model, still)
    angle = float(np.degrees(np.arctan(4.0 / FOCAL)))
    before, after = model.draw(trajectory), model.draw(trajectory, 0, {"camera_2_pan": angle})
    assert np.array_equal(before["left", 4], after["left", 4])
    middle = np.s_[25:65, 25:65]  # far from the axis a turn shifts by more than the tangent
    shift, _, _ = phase_cross_correlation(
        before["right", 0][middle].mean(axis=2), after["right", 0][middle].mean(axis=2), upsample_factor=20
    )
    assert np.allclose(shift, [0.0, 4.0], atol=0.15)


def test_a_late_video_shows_the_tool_farther_on(model_of, still):
    model = model_of("time_offset")
    trajectory = trajectory_of(model, still)
    late = model.draw(trajectory, 0, {"time_offset": 0.037})
    moved = tool_column(late["left", 4]) - tool_column(model.draw(trajectory)["left", 4])
    # The box's top stands 0.48 m below the camera, its sides hardly show.
    assert moved == pytest.approx(FOCAL * SPEED * 0.037 / 0.48, abs=0.3)


def test_between_frames_soil_is_interpolated(model_of, still):
    model = model_of("time_offset")
    assert model.recorded == (0, 1, 3, 4, 5, 7, 8, 9)
    drift = (0.003, 0.0, -0.001)
    trajectory = trajectory_of(model, still, drift)
    for moment in (0.0, 0.37, 3.63, 8.0, 8.4):
        x, f = trajectory.at(moment)
        assert np.allclose(x, still + moment * np.array(drift), atol=1e-6)
        assert np.allclose(f, np.eye(3))
    assert np.array_equal(trajectory.at(-0.4)[0], still)
    plain = model_of()
    assert plain.recorded == plain.frames == (0, 4, 8)
    with pytest.raises(ParameterError, match="frame 1"):
        model.draw(trajectory_of(plain, still), 0, {"time_offset": 0.02})


def test_the_drawn_tool_moves_and_the_soil_does_not(model_of, still):
    model = model_of("tool_pose")
    trajectory = trajectory_of(model, still)
    before, after = model.draw(trajectory), model.draw(trajectory, 0, {"tool_x": 0.02})
    moved = tool_column(after["left", 4]) - tool_column(before["left", 4])
    assert moved == pytest.approx(FOCAL * 0.02 / 0.48, rel=0.05)
    assert np.abs(after["left", 4][:15] - before["left", 4][:15]).max() < 5e-3  # what the tool sends back


def test_a_lower_sun_lengthens_the_shadow(model_of, still):
    model = model_of("light")
    trajectory = trajectory_of(model, still)

    def shadow_end(values):
        row = linear(torch.from_numpy(model.draw(trajectory, 0, values)["right", 0][43:47])).mean(dim=(0, 2)).numpy()
        bright = np.convolve(row, np.full(5, 0.2), "same")
        # The camera stands over x = 0.24, the bed ends at pixel 85.
        dark = np.flatnonzero(bright[:80] < 0.75 * np.median(bright[60:80]))
        return 0.24 + (dark.max() + 0.5 - 45.0) * 0.6 / FOCAL

    # The upper edge that faces the sun casts the far end: 0.08 to 0.12 m above the soil, at x = 0.12.
    for change in (0.0, -15.0):
        reach = 0.12 / np.tan(np.radians(60.0 + change))
        assert shadow_end({"sun_elevation_change": change}) == pytest.approx(0.12 + reach, abs=0.012)
    shares = {p.name for p in model.observation_parameters}
    assert shares == {"sun_azimuth_change", "sun_elevation_change", "sky_share_change"}


def test_exposure_and_blur_reach_the_pictures(model_of, still):
    model = model_of("exposure", "blur")
    trajectory = trajectory_of(model, still)
    plain = model.draw(trajectory)
    brighter = model.draw(trajectory, 0, {"exposure_gain": 1.2})
    lit = np.s_[:10]
    ratio = linear(torch.from_numpy(brighter["left", 8][lit])) / linear(torch.from_numpy(plain["left", 8][lit]))
    assert torch.allclose(ratio.median(), torch.tensor(1.2), atol=1e-3)
    soft = model.draw(trajectory, 0, {"blur": 2.0})["left", 8]
    assert soft[lit].std(axis=(0, 1)).max() < 0.7 * plain["left", 8][lit].std(axis=(0, 1)).min()
    with pytest.raises(ParameterError, match="blur"):
        model.draw(trajectory, 0, {"blur": 99.0})


def test_another_guess_of_buried_colours_shows_where_soil_was_turned_over(model_of, still):
    model = model_of()
    turned = still.copy()
    turned[:, 2] = np.where(still[:, 0] > 0.2, DEPTH - still[:, 2], still[:, 2])
    eye = np.tile(np.eye(3, dtype=np.float32), (3, len(still), 1, 1))
    soil = np.stack([still, turned, turned])
    over = Trajectory(model.recorded, soil, eye, np.zeros((10, 3)), SPACING, model.resolution)
    best, again, other = model.draw(over), model.draw(over, albedo=1), model.draw(over, albedo=2)
    changes = {frame: np.abs(again["left", frame] - best["left", frame]).mean(axis=2) for frame in (0, 8)}
    left, right = np.s_[15:75, 8:30], np.s_[15:75, 52:80]
    # a little of the uppermost particles always shines through
    assert changes[8][right].mean() > 2.5 * max(changes[8][left].mean(), changes[0][right].mean())
    assert np.array_equal(model.draw(over, albedo=1)["left", 8], again["left", 8])
    assert np.abs(other["left", 8] - again["left", 8])[right].mean() > 0.5 * changes[8][right].mean()


def test_rounding_takes_shade_from_a_furrow_and_nothing_from_level_soil(model_of, still):
    model = model_of()
    furrowed = still.copy()
    furrowed[:, 2] -= 0.03 * np.exp(-(((furrowed[:, 0] - 0.28) / 0.04) ** 2)) * (furrowed[:, 2] / DEPTH)
    level, once, twice = (
        model.draw(trajectory_of(model, soil), rounding=r)["left", 0].mean(axis=2)
        for soil, r in ((still, 1.0), (furrowed, 1.0), (furrowed, 2.0))
    )
    # Away from the tool and its shadow; smoothed over the spots, which stay where they are.
    part = np.s_[30:60, 45:85]
    depth = [float(np.std((image - level)[part].mean(axis=0))) for image in (once, twice)]
    assert 0.4 * depth[0] < depth[1] < 0.9 * depth[0]
    again = model.draw(trajectory_of(model, still), rounding=2.0)["left", 0].mean(axis=2)
    assert np.abs((again - level)[part].mean(axis=0)).max() < 0.1 * depth[0]
