"""Effects in the solver: what the element test cannot show, on a small bed."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
import numpy.typing as npt
import pytest
import torch
import trimesh
from splatsoil.benchmarks._validation.scene import STILL, lattice

from splatsoil.mpm import Resolution, Solver
from splatsoil.mpm.tool import Pose
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects, library
from splatsoil.soil.settings import Settings

DENSITY = 1600.0
RESOLUTION = Resolution(
    cell=0.02, spacing=0.01, frame_time=0.02, steps=2, courant=0.5, bulk=4.2e5, shear=1.9e5, density=DENSITY
)
LOWER, UPPER = np.zeros(3), np.array([0.24, 0.12, 0.16])
PLATE = trimesh.creation.box(extents=[0.012, 0.08, 0.08])
FAR_AWAY = Pose(np.array([9.0, 9.0, 9.0]), STILL, np.zeros(3), np.zeros(3))


block = partial(lattice, spacing=0.01, jitter=0.0)
BED = block(LOWER, [0.24, 0.12, 0.08])


def solver(
    x: npt.NDArray[np.float64],
    *values: Mapping[str, float],
    effects: tuple[str, ...] = (),
    settings: Settings | None = None,
    mesh: trimesh.Trimesh = PLATE,
    device: str = "cpu",
) -> Solver:
    batch = np.broadcast_to(x, (len(values), *x.shape))
    law = Law(find_effects(effects))
    return Solver(batch, LOWER, UPPER, mesh, RESOLUTION, law, settings or Settings(friction_angle=35.0), values, device)


def test_a_bed_of_growing_density_rests_and_weighs_its_integral() -> None:
    """Mass of a column: rho (h + g h^2 / 2); the bed starts in equilibrium with that weight."""
    run = solver(BED, {"density_gradient": 2.0}, {"density_gradient": 0.0}, effects=("density_gradient",))
    mass = run._particles.mass * run._particles.density.numpy().reshape(2, -1).sum(axis=1)
    assert mass[0] / mass[1] == pytest.approx(1.0 + 2.0 * 0.08 / 2.0, rel=2e-3)
    pressure = -RESOLUTION.bulk * run._particles.elastic.numpy().reshape(2, -1)
    depth = 0.08 - BED[:, 2]
    np.testing.assert_allclose(pressure[0], 9.81 * DENSITY * (depth + depth**2), rtol=2e-3)
    for _ in range(5):
        run.advance([FAR_AWAY, FAR_AWAY])
    assert np.abs(run.positions() - BED).max() < 1e-3


def test_a_layer_keeps_to_the_soil_that_was_below() -> None:
    """Weight begins below the depth, and depth stays with the particles."""
    run = solver(BED, {"layer_depth": 0.04, "layer_density": 1.3, "layer_friction": 5.0}, effects=("layering",))
    density = run._particles.density.numpy()
    np.testing.assert_allclose(density, np.where(BED[:, 2] < 0.04, 1.3, 1.0))
    depth = run._particles.depth.numpy().copy()
    np.testing.assert_allclose(depth, 0.08 - BED[:, 2], atol=1e-6)
    run.advance([FAR_AWAY, FAR_AWAY])
    np.testing.assert_array_equal(run._particles.depth.numpy(), depth)


def test_stiffer_soil_under_its_weight_settles_less_and_takes_more_steps() -> None:
    run = solver(BED, {"stiffness_factor": 1.0}, {"stiffness_factor": 4.0}, effects=("stiffness",))
    assert run.resolution.bulk == pytest.approx(4.0 * RESOLUTION.bulk)
    assert run.resolution.substeps(2) == pytest.approx(2 * RESOLUTION.substeps(2), abs=1)
    run._particles.elastic.zero_()
    for _ in range(10):
        run.advance([FAR_AWAY, FAR_AWAY])
    sunk = (BED - run.positions()).reshape(2, -1, 3)[:, BED[:, 2] > 0.07, 2].mean(axis=1)
    assert sunk[0] / sunk[1] == pytest.approx(4.0, rel=0.15)


def slide(run: Solver, start: npt.NDArray[np.float64], speed: float, frames: int) -> npt.NDArray[np.float64]:
    """Force (frames, simulations, 3) on a tool that moves along x."""
    velocity, force = np.array([speed, 0.0, 0.0]), []
    for frame in range(frames):
        times = [(frame + step / 2) * RESOLUTION.frame_time for step in range(2)]
        force.append(run.advance([Pose(start + t * velocity, STILL, velocity, np.zeros(3)) for t in times]))
    return np.array(force)


def ploughed(effects: tuple[str, ...], *values: Mapping[str, float], frames: int = 8, device: str = "cpu") -> Solver:
    """A plate goes 5 cm through the bed."""
    run = solver(BED, *values, effects=effects, device=device)
    slide(run, np.array([0.06, 0.06, 0.06]), 0.3, frames)
    return run


def test_sheared_dense_soil_dilates_and_loose_soil_contracts() -> None:
    """Where shear has gone far the volume gained is b g_d, and nowhere more; loose soil loses what it can."""
    run = ploughed(("dilatancy",), {"dilatancy_angle": 0.0}, {"dilatancy_angle": 15.0})
    strain, dilated = run._particles.history.numpy().reshape(2, -1, 2).transpose(2, 0, 1)
    assert strain[1].max() > 0.5
    np.testing.assert_array_equal(dilated[0], 0.0)
    most = run.law.table(Settings(35.0), run.values)[1, -2] * 0.3
    assert 0.5 * most < dilated[1].max() <= 1.001 * most
    volume = np.maximum.reduceat(
        run.positions()[:, np.lexsort((BED[:, 1], BED[:, 0])), 2], np.arange(0, len(BED), 8), 1
    )
    assert volume[1].mean() > volume[0].mean() + 5e-4
    loose = ploughed(("compaction",), {"looseness": 0.05})
    assert -0.05005 < loose._particles.history.numpy()[:, 1].min() < -0.02


@pytest.mark.parametrize(
    ("name", "value"), [("dilatancy", {"dilatancy_angle": 15.0}), ("compaction", {"looseness": 0.05})]
)
def test_volume_in_the_books_is_volume_in_space(name: str, value: dict[str, float]) -> None:
    """What det F of the particles' own motion gained over the base law is what the law booked as plastic volume.

    To an eighth: the books are of whole cells, the motion is seen at eight places in them.
    """
    off = dict.fromkeys(value, 0.0)
    run = ploughed((name,), off, value)
    p = run._particles
    booked = p.history.numpy()[:, 1] + p.opening.numpy() + p.elastic.numpy()
    in_books = np.exp(booked.astype(np.float64)).reshape(2, -1).sum(axis=1)
    in_space = np.linalg.det(p.deformation.numpy().astype(np.float64)).reshape(2, -1).sum(axis=1)
    assert abs(in_books[1] - in_books[0]) > 30.0
    assert in_space[1] - in_space[0] == pytest.approx(in_books[1] - in_books[0], rel=0.125)


def test_an_obstacle_holds_the_soil_around_it() -> None:
    """Soil within the sphere stays put while the free bed beside it is carried along."""
    place = {"obstacle_x": 0.02, "obstacle_y": 0.0, "obstacle_height": 0.04}
    run = ploughed(("buried_obstacle",), {"obstacle_radius": 0.0, **place}, {"obstacle_radius": 0.035, **place})
    inside = np.linalg.norm(BED - np.array([0.14, 0.06, 0.04]), axis=1) < 0.02
    moved = np.linalg.norm(run.positions() - BED, axis=2)[:, inside].max(axis=1)
    assert moved[1] < 0.25 * moved[0]
    assert moved[0] > 0.005


def test_adhesion_drags_a_sliding_tool_by_its_area() -> None:
    """A plate laid on cohesive soil and pulled along, tool friction zero: the force is adhesion times area."""
    plate = trimesh.creation.box(extents=[0.08, 0.08, 0.02])
    settings = Settings(friction_angle=45.0, tool_friction=0.0)
    names = ("tool_adhesion", "cohesion")
    values = [{"tool_adhesion": a, "cohesion": 1500.0} for a in (0.0, 300.0)]
    run = solver(BED, *values, effects=names, settings=settings, mesh=plate)
    # the lower face half a millimetre below the surface
    drag = -slide(run, np.array([0.1, 0.06, 0.09 - 0.0005]), 0.1, 6)[2:, :, 0].mean(axis=0)
    assert drag[1] - drag[0] == pytest.approx(300.0 * 0.08 * 0.08, rel=0.03)


EVERY = tuple(n for n in library() if n not in ("compaction", "critical_state", "camera_pose"))
EVERY_VALUE = {
    "dilatancy_angle": 8.0, "rate_gain": 0.5, "viscosity": 5.0, "softening_angle": 4.0, "cohesion": 100.0,
    "pressure_exponent": 0.05, "layer_friction": 2.0, "density_gradient": 0.5, "tool_adhesion": 100.0,
    "tilt_x": 2.0, "gravity_factor": 0.9, "obstacle_radius": 0.03, "stiffness_factor": 1.5,
    "hardening_strain": 0.01, "intermediate_share": 0.5,
}  # fmt: skip


def test_all_effects_together_run() -> None:
    run = ploughed(EVERY, EVERY_VALUE, frames=4)
    assert np.isfinite(run.positions()).all() and np.isfinite(run.momentum()).all()
    assert run._particles.history.numpy()[:, 0].max() > 0.1


@pytest.mark.cuda
def test_all_effects_are_the_same_on_cuda() -> None:
    if not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    one, other = (ploughed(EVERY, EVERY_VALUE, frames=2, device=device) for device in ("cpu", "cuda:0"))
    assert np.abs(one.positions() - other.positions()).max() < 5e-4
    np.testing.assert_allclose(
        one._particles.history.numpy().mean(axis=0), other._particles.history.numpy().mean(axis=0), rtol=0.02
    )
