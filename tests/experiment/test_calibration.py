"""Known errors of cameras, exposure, clock and tool come back from pictures of a made bed, and nothing else does."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from splatsoil.comparison import Comparator
from splatsoil.errors import ParameterError
from splatsoil.experiment import calibration, calibration_bench
from splatsoil.experiment.calibration import calibrate
from splatsoil.measurement import Bed, Camera, Frame, Measurement, Tool, ToolMotion
from splatsoil.model import Model
from splatsoil.mpm.simulate import Trajectory
from splatsoil.parameters import Parameter
from splatsoil.reconstruction import HeightField
from splatsoil.soil.library import library
from splatsoil.synthetic.setups import look_at

SPACING, DEPTH, RATE, FOCAL, SIDE = 0.02, 0.1, 10.0, 200.0, 110
BED = Bed(np.zeros(3), np.array([0.4, 0.4, 0.2]), 1600.0)
EFFECTS = ("camera_pose", "exposure", "blur", "tool_pose", "time_offset")
SHIFTS = {
    "camera_1_pan": 0.3,
    "camera_2_up": 0.004,
    "exposure_gain": 0.9,
    "tool_x": 0.003,
    "time_offset": 0.015,
}
USEFUL = {
    "camera_1_pan": 0.15,
    "camera_2_up": 0.002,
    "exposure_gain": 0.05,
    "tool_x": 0.001,
    "time_offset": 0.005,
}
"""Standard deviations that a calibration must not exceed to be of use here: half of what is hidden at most."""


def camera(x, y):
    """Looks down on the bed's middle from 0.6 m above the soil."""
    return Camera(
        SIDE, SIDE, FOCAL, FOCAL, 0.5 * SIDE, 0.5 * SIDE, look_at((x, y, 0.7), (0.2, 0.2, DEPTH)), model="PINHOLE"
    )


VIDEO = {"left": camera(0.0, 0.1), "right": camera(0.5, 0.15)}
VIEWS = tuple(camera(0.2 + 0.25 * np.cos(a), 0.2 + 0.25 * np.sin(a)) for a in np.arange(18) / 18 * 2.0 * np.pi)


def motion():
    """Forth at 0.2 m/s along x, then across, well above the soil."""
    times = np.arange(11) / RATE
    x, y = np.minimum(times, 0.5), np.maximum(times - 0.5, 0.0)
    positions = np.stack([0.12 + 0.2 * x, 0.15 + 0.2 * y, np.full(11, 0.2)], axis=1)
    return ToolMotion(np.arange(11), times, positions, np.tile([1.0, 0.0, 0.0, 0.0], (11, 1)))


@pytest.fixture(scope="module")
def still():
    axis, levels = np.arange(SPACING / 2, 0.4, SPACING), np.arange(SPACING / 2, DEPTH, SPACING)
    return np.stack(np.meshgrid(axis, axis, levels, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)


@pytest.fixture(scope="module")
def scenes(still, spotted):
    """Level, spotted soil under the sun, as a reconstruction has it and as it is: a little otherwise everywhere."""
    scene = spotted(still, SPACING, BED, 0.003, trimesh.creation.box((0.05, 0.05, 0.05)))
    random = torch.Generator().manual_seed(1)
    wrong = 1.0 + 0.05 * torch.randn(len(scene.soil_albedo), 1, generator=random)
    return scene, scene.replace(soil_albedo=(scene.soil_albedo * wrong).clamp(0.0, 1.0))


def model_of(measurement, scene, effects=()):
    surface = HeightField.over(BED.lower, BED.upper, 0.02, DEPTH)
    model = Model(measurement, SimpleNamespace(surface=surface), effects=effects, preset="tiny")
    model._scene = lambda seed: scene
    return model


@pytest.fixture(scope="module")
def world(tmp_path_factory, scenes, still):
    """Makes a set whose video errs by given values: its model and the soil's trajectory, in which nothing moves."""

    def make(values):
        folder, random = tmp_path_factory.mktemp("set"), np.random.default_rng(1)

        def written(name, image):
            noisy = image + random.normal(scale=1.5 / 255.0, size=image.shape)
            Image.fromarray(np.round(255.0 * noisy.clip(0.0, 1.0)).astype(np.uint8)).save(folder / name)
            return folder / name

        video = tuple(
            Frame(replace(view, name=n), folder / f"{n}-{f}.png", n, f, f / RATE)
            for n, view in VIDEO.items()
            for f in (0, 3, 6, 9)
        )
        tool = Tool(trimesh.creation.box((0.05, 0.05, 0.05)), motion())
        first = scenes[1].pose(still, None, tool.motion.pose(0.0))
        views = tuple(Frame(v, written(f"{k}.png", scenes[1].picture(first, v))) for k, v in enumerate(VIEWS))
        measurement = Measurement(folder, "made", np.array([0.0, 0.0, -9.81]), RATE, BED, tool, views, video)
        true = model_of(measurement, scenes[1], EFFECTS)
        count = len(true.recorded)
        trajectory = Trajectory(
            true.recorded,
            np.tile(still, (count, 1, 1)),
            np.tile(np.eye(3, dtype=np.float32), (count, len(still), 1, 1)),
            np.zeros((10, 3)),
            SPACING,
            true.resolution,
        )
        for (name, frame), image in true.draw(trajectory, 0, values).items():
            written(f"{name}-{frame}.png", image)
        return model_of(measurement, scenes[0]), trajectory

    return make


@pytest.fixture(autouse=True)
def reconstructed(monkeypatch, scenes):
    """The scene stands for what photographs give."""
    monkeypatch.setattr(calibration, "_scene_of_photographs", lambda model, seed: scenes[0])


def asked(model, effects=EFFECTS):
    return [p for name in effects for p in library()[name].for_measurement(model.measurement).parameters]


def compared(model, **options):
    return Comparator(model.measurement, surface=model.reconstruction.surface, **options)


@pytest.fixture(scope="module")
def quiet_world(world):
    return world({})


def test_known_shifts_come_back(world):
    model, trajectory = world(SHIFTS)
    parameters = asked(model)
    found = calibrate(model, compared(model), parameters, trajectory)
    assert found.names == tuple(p.name for p in parameters)
    truth = np.array([SHIFTS.get(p.name, p.off) - p.off for p in parameters])
    z = (found.estimate - truth) / found.deviation
    assert np.abs(z).max() < 3.0, dict(zip(found.names, z.round(1), strict=True))
    deviation = dict(zip(found.names, found.deviation, strict=True))
    assert {n: deviation[n] for n, most in USEFUL.items() if deviation[n] > most} == {}
    assert np.linalg.eigvalsh(found.covariance / np.outer(found.deviation, found.deviation)).min() > 0.0


def test_nothing_wrong_is_nothing_found(quiet_world):
    model, trajectory = quiet_world
    found = calibrate(model, compared(model), asked(model), trajectory)
    z = found.estimate / found.deviation
    assert np.abs(z).max() < 3.0, dict(zip(found.names, z.round(1), strict=True))


@pytest.mark.parametrize("late", [-0.035, 0.035])
def test_a_clock_that_is_pixels_off_is_found_and_no_tool_blamed(world, late):
    model, trajectory = world({"time_offset": late})
    found = calibrate(model, compared(model), asked(model, ("tool_pose", "time_offset")), trajectory)
    told = dict(zip(found.names, zip(found.estimate, found.deviation, strict=True), strict=True))
    assert told["time_offset"][0] == pytest.approx(late, abs=0.004)
    assert told["time_offset"][1] < 0.005
    assert max(abs(told[name][0] / told[name][1]) for name in ("tool_x", "tool_y", "tool_z")) < 3.0


def test_what_drawing_gets_wrong_in_every_picture_is_no_cameras(quiet_world, monkeypatch, scenes):
    """Soil drawn a tenth too dark looks like longer exposure, in photographs as in the video."""
    dark = scenes[0].replace(soil_albedo=0.95 * scenes[0].soil_albedo)
    monkeypatch.setattr(calibration, "_scene_of_photographs", lambda model, seed: dark)
    model, trajectory = quiet_world
    found = calibrate(model, compared(model), asked(model), trajectory)
    told = dict(zip(found.names, zip(found.estimate, found.deviation, strict=True), strict=True))
    assert abs(told["exposure_gain"][0]) < min(3.0 * told["exposure_gain"][1], 0.03)
    assert told["exposure_gain"][1] < USEFUL["exposure_gain"]


def test_what_nothing_tells_stays_open(quiet_world):
    model, trajectory = quiet_world
    parameters = asked(model, ("camera_pose",))
    found = calibrate(model, compared(model, cameras=["left"]), parameters, trajectory)
    unseen = np.array([p.name.startswith("camera_2") for p in parameters])
    wide = np.array([p.upper - p.lower for p in parameters])
    assert np.isfinite(found.estimate).all() and np.isfinite(found.covariance).all()
    assert np.allclose(found.estimate[unseen], 0.0)
    assert (found.deviation[unseen] > 5.0 * wide[unseen]).all()
    assert (found.deviation[~unseen] < 0.2 * wide[~unseen]).all()
    assert np.linalg.eigvalsh(found.covariance / np.outer(found.deviation, found.deviation)).min() > 0.0


def test_a_tool_that_is_hidden_tells_nothing(quiet_world, monkeypatch):
    model, trajectory = quiet_world
    monkeypatch.setattr(calibration_bench, "CLEAR", 1.0)
    parameters = asked(model, ("tool_pose", "time_offset"))
    found = calibrate(model, compared(model), parameters, trajectory)
    assert np.array_equal(found.estimate, np.zeros(5))
    assert (found.deviation >= [p.upper - p.lower for p in parameters]).all()


def test_only_observation_is_calibrated(quiet_world):
    model, trajectory = quiet_world
    with pytest.raises(ParameterError, match="wind"):
        calibrate(model, compared(model), [Parameter("wind", "m/s", 0.0, 1.0, 0.0, off=0.0)], trajectory)
