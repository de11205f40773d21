"""The independent solver's scene: what its solver is handed, held against what the tool and the bed must do."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks._hidden import NOTHING, Hidden
from splatsoil.benchmarks._newton import Numerics, Soil, _model, plough
from splatsoil.benchmarks._scenes import Scene
from splatsoil.benchmarks._truth import Truth

from splatsoil.mpm import Trajectory

SPACING, COARSE = 0.02, Numerics(voxel=0.04, substeps=2, iterations=60)


def soil_of(scene: Scene, spacing: float) -> Soil:
    return Hidden(NOTHING, 0, scene).soil(scene.setup(), spacing)


def test_a_bed_weighs_what_its_soil_does() -> None:
    """Whatever the spacing: volume x density x gravity."""
    scene = Scene(seed=1, angle=35.0, bed="flat", density=1430.0)
    for spacing in (0.02, 0.013):
        soil = soil_of(scene, spacing)
        weight = len(soil.particles) * soil.weight.astype(np.float64)
        assert weight == pytest.approx([0.0, 0.0, -0.8 * 0.5 * 0.12 * 1430.0 * 9.81], rel=1e-4)
    tilted = replace(soil, gravity=(1.0, 0.0, -2.0))
    assert tilted.weight == pytest.approx(1430.0 * 0.013**3 * np.array([1.0, 0.0, -2.0]))


def test_cohesion_is_the_whole_strength_without_pressure_and_counted_once(plow_damp: Path) -> None:
    newton = pytest.importorskip("newton")
    truth = Truth.load(plow_damp)
    x = truth.start(SPACING, 0)
    damp = Soil(truth.measurement, 33.0, x, SPACING, cohesion=300.0)
    material = _model(newton, [damp, replace(damp, angle=30.0, cohesion=0.0)], np.zeros((2, 3)), "cpu").mpm
    # Newton's shear strength is yield_stress + friction (p + tension)
    tension = material.yield_pressure.numpy() * material.tensile_yield_ratio.numpy()
    strength = material.yield_stress.numpy() + material.friction.numpy() * tension
    sine = np.sin(np.radians(33.0))
    # Drucker-Prager matched to triaxial compression, in sqrt(J2): 6 c cos / (sqrt(3) (3 - sin))
    exact = 6.0 * 300.0 * np.cos(np.radians(33.0)) / (np.sqrt(3.0) * (3.0 - sine))
    assert strength[: len(x)] == pytest.approx(exact, rel=1e-3)
    assert not strength[len(x) :].any()
    # the cone's apex, at c cot(friction angle)
    assert tension[: len(x)] == pytest.approx(300.0 / np.tan(np.radians(33.0)), rel=1e-3)


@pytest.mark.slow
def test_soil_falls_as_its_own_gravity_pulls() -> None:
    """A lump in the air, under 9.81 and under 4 m/s², and one without weight."""
    pytest.importorskip("newton")
    soil = soil_of(Scene(seed=1, angle=35.0), SPACING)
    along = np.arange(4) * SPACING
    lump = np.stack(np.meshgrid(0.55 + along, 0.21 + along, 0.12 + along), axis=-1).reshape(-1, 3)
    pulls = (9.81, 4.0, 0.0)
    soils = [replace(soil, particles=lump, gravity=(0.0, 0.0, -g)) for g in pulls]
    runs = plough(soils, COARSE, (5,))
    substeps = 5 * COARSE.substeps
    for pull, run in zip(pulls, runs, strict=True):
        fall = pull * 0.01**2 * substeps * (substeps + 1) / 2  # each step by the velocity at its end
        assert (lump - run.at(5)[0])[:, 2].mean() == pytest.approx(fall, rel=0.02, abs=1e-6)


@pytest.fixture(scope="module")
def ploughed() -> tuple[Truth, list[Trajectory]]:
    """Two coarse soils, ten frames into the push."""
    pytest.importorskip("newton")
    truth = Truth.load(Path(__file__).parents[2] / "examples" / "plow-damp")
    x = truth.start(SPACING, 0)
    short = replace(truth, particles={0: x, 5: x, 35: x}, volume=SPACING**3)
    true = Soil(short.measurement, 33.0, x, SPACING, cohesion=300.0)
    return short, plough([true, replace(true, angle=20.0)], COARSE, (5, 35))


@pytest.mark.slow
def test_soil_depends_on_no_other_beside_it() -> None:
    """Of another bed, tool, motion and density."""
    pytest.importorskip("newton")
    level = soil_of(Scene(seed=1, angle=35.0, bed="flat", tool="drum", rolling=1.2, depth=0.05), SPACING)
    slope = soil_of(Scene(seed=2, angle=26.0, bed="sloping", slope=6.0, density=1450.0, width=0.16, tilt=0.0), SPACING)
    beside, alone = plough([level, slope], COARSE, (30,)), plough([slope], COARSE, (30,))[0]
    moved = np.linalg.norm(alone.at(30)[0] - slope.particles, axis=1)
    apart = np.linalg.norm(beside[1].at(30)[0] - alone.at(30)[0], axis=1)
    assert np.percentile(moved, 99) > 10e-3
    assert np.percentile(apart, 99) < 0.2e-3
    assert beside[1].force[20:].mean(axis=0) == pytest.approx(alone.force[20:].mean(axis=0), rel=0.02, abs=0.5)


@pytest.mark.slow
def test_the_force_is_the_soils_on_the_tool(ploughed: tuple[Truth, list[Trajectory]]) -> None:
    """Next to nothing before it arrives; then against its way and up, more of it in stronger soil, and of the set's
    size: coarse voxels and few iterations bear less."""
    truth, (strong, weak) = ploughed
    force = truth.measurement.tool.force
    assert force is not None
    pushing = slice(29, 35)
    ours, less = (run.force[pushing].mean(axis=0) for run in (strong, weak))
    measured = force[pushing, 2:].mean(axis=0)
    assert np.abs(strong.force[:5, 0]).max() < 0.05 * abs(ours[0])
    assert np.all(np.sign(ours[[0, 2]]) == np.sign(measured[[0, 2]]))
    assert abs(ours[1]) < 0.1 * abs(ours[0])
    assert np.linalg.norm(less) < 0.8 * np.linalg.norm(ours)
    assert 0.5 * np.linalg.norm(measured) < np.linalg.norm(ours) < 1.1 * np.linalg.norm(measured)
