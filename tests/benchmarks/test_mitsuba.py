"""Two path tracers that share no code see the same, and what closed forms say; skipped without the package."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from splatsoil.benchmarks import _mitsuba
from splatsoil.benchmarks._mitsuba import MitsubaStage

from splatsoil.errors import ParameterError, RunError
from splatsoil.measurement import Camera
from splatsoil.synthetic import Body, Light, Stage
from splatsoil.synthetic.setups import look_at

SUN, SKY, ALBEDO = np.array([0.9, 0.8, 0.7]), np.array([0.2, 0.3, 0.4]), np.array([0.5, 0.4, 0.3])
CAMERA = Camera(80, 60, 75.0, 75.0, 35.0, 33.0, look_at(np.array([1.0, -1.2, 0.9]), np.array([0.0, 0.0, 0.1])))


def waves() -> Body:
    """Soil like a washboard, which lights and shades itself."""
    axis = np.linspace(-0.4, 0.4, 60)
    x, y = np.meshgrid(axis, axis)
    points = np.stack([x, y, 0.1 + 0.05 * np.sin(20.0 * x) * np.cos(15.0 * y)], axis=-1).reshape(-1, 3)
    index = np.arange(3600).reshape(60, 60)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    normals = np.asarray(trimesh.Trimesh(points, faces, process=False).vertex_normals)
    return Body(points, faces, normals, np.broadcast_to(ALBEDO, points.shape))


def wall(grain: float = 0.0) -> Body:
    return Body.flat(trimesh.creation.box(bounds=((-0.45, -0.45, 0.0), (-0.41, 0.45, 0.25))), (0.2, 0.3, 0.6), grain)


def test_level_ground_is_lamberts() -> None:
    pytest.importorskip("mitsuba")
    far_away = Body.flat(trimesh.creation.box(bounds=[[90.0, 90.0, 0.0], [91.0, 91.0, 1.0]]), 0.5)
    stage = MitsubaStage([far_away], Light.from_angles(30.0, 40.0, SUN, SKY), ground_colour=ALBEDO)
    expected = ALBEDO * (SUN * math.sin(math.radians(40.0)) + SKY)
    np.testing.assert_allclose(stage.radiance(CAMERA, side=4).mean(axis=(0, 1)), expected, rtol=3e-3)


def test_both_see_the_same_in_the_same_pixels() -> None:
    """Sun, shade, light thrown from soil to soil and to the wall, and the camera's off-centre axis."""
    pytest.importorskip("mitsuba")
    light = Light.from_angles(40.0, 35.0, SUN, SKY, softness=1e-4)
    ours, theirs = (kind([waves(), wall()], light).radiance(CAMERA, side=8) for kind in (Stage, MitsubaStage))
    np.testing.assert_allclose(theirs.mean(axis=(0, 1)), ours.mean(axis=(0, 1)), rtol=1e-3)

    def apart(other: np.ndarray) -> float:
        """Mean difference of blocks of 5 pixels, those at the picture's edge left out."""
        one, two = (image.reshape(12, 5, 16, 5, 3).mean(axis=(1, 3))[1:-1, 1:-1] for image in (ours, other))
        return float(np.abs(one - two).mean())

    assert apart(theirs) < 0.001
    for axis, step in ((0, -1), (0, 1), (1, -1), (1, 1)):
        assert apart(np.roll(theirs, step, axis=axis)) > 8.0 * apart(theirs), "a pixel off would be seen"


def test_patterns_keep_the_mean_and_have_the_contrast() -> None:
    pytest.importorskip("mitsuba")
    light = Light.from_angles(40.0, 35.0, SUN, SKY)
    plain, fine = (
        MitsubaStage([wall(grain)], light, ground_grain=grain, pattern=3).radiance(CAMERA, side=6)
        for grain in (0.0, 0.1)
    )
    np.testing.assert_allclose(fine.mean(axis=(0, 1)), plain.mean(axis=(0, 1)), rtol=0.01)
    assert 0.01 < float(np.std(fine / plain)) < 0.1


def test_a_camera_that_distorts_is_refused() -> None:
    pytest.importorskip("mitsuba")
    stage = MitsubaStage([wall()], Light.from_angles(40.0, 35.0, SUN, SKY))
    with pytest.raises(ParameterError, match="distorts"):
        stage.radiance(replace(CAMERA, k1=0.1))


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(_mitsuba.importlib, "import_module", missing)
    with pytest.raises(RunError, match="independent"):
        MitsubaStage([wall()], Light.from_angles(40.0, 35.0, SUN, SKY))
