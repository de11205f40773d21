"""Effects and guards that need soil in a box: closed forms, and errors that say what happened."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
import trimesh
from splatsoil.benchmarks._validation.scene import STILL, Scene, lattice, resolution

from splatsoil.errors import SimulationError
from splatsoil.mpm import Solver
from splatsoil.mpm.tool import Pose
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.soil.settings import Settings

CELL = 0.02
RESOLUTION = resolution(CELL, 0.1, density=1600.0, young=5e5)


def scene(x: np.ndarray, mesh: trimesh.Trimesh | None = None, **settings: float) -> Scene:
    given = Settings(friction_angle=40.0, **settings)  # type: ignore[arg-type]
    return Scene(x, (0.24, 0.12, 0.4), RESOLUTION, given, mesh=mesh)


def batch(s: Scene, effects: tuple[str, ...], *values: Mapping[str, float]) -> Solver:
    """The scene once for each set of parameters."""
    law = Law(find_effects(effects))
    x = np.broadcast_to(s.x, (len(values), *s.x.shape))
    return Solver(x, np.zeros(3), s.upper, s.mesh, s.resolution, law, s.settings, values)


def test_a_plate_feels_the_changed_friction() -> None:
    """A plate pressed on coherent soil and dragged: drag over normal force grows by the change of the coefficient.
    Pressed lightly: a substep's friction takes no more than a particle's momentum, 1 kPa here."""
    plate = trimesh.creation.box(extents=[0.08, 0.08, 0.02])
    x = lattice([0.0, 0.0, 0.0], [0.24, 0.12, 0.08], 0.5 * CELL, jitter=0.0)
    s = scene(x, plate, tool_friction=0.2)
    changes = (-0.3, 0.0, 0.15)
    names = ("tool_friction", "cohesion")
    run = batch(s, names, *({"tool_friction_change": c, "cohesion": 1500.0} for c in changes))
    speed, start = np.array([0.1, 0.0, 0.0]), np.array([0.1, 0.06, 0.09 - 0.0003])
    step = RESOLUTION.frame_time
    force = np.array([run.advance([Pose(start + k * step * speed, STILL, speed, np.zeros(3))]) for k in range(12)])
    drag, normal = -force[4:, :, 0].mean(axis=0), force[4:, :, 2].mean(axis=0)
    assert (normal > 1.0).all()
    # a coefficient cannot fall below zero: 0.2 - 0.3 is smooth
    np.testing.assert_allclose(drag / normal - drag[0] / normal[0], [0.0, 0.2, 0.35], atol=0.03)


@pytest.mark.parametrize(
    ("lowest", "velocity", "says"),
    [
        (
            0.0,
            (0.0, 0.0, 8.0),
            r"of 128 particles [1-9]\d* left the grid upward by frame \d+ \(1 steps of \d+ substeps\)",
        ),
        (0.1, (1.1 * RESOLUTION.wave_speed, 0.0, 0.0), r"of 128 particles 128 lost .* by frame 1 "),
    ],
)
def test_soil_that_leaves_upward_or_is_faster_than_its_waves_is_an_error(
    lowest: float, velocity: tuple[float, float, float], says: str
) -> None:
    """Guards name the frame, how many particles of how many, and the parameters."""
    x = lattice([0.08, 0.04, lowest], [0.16, 0.08, lowest + 0.04], 0.5 * CELL)
    run = batch(scene(x), (), {"friction_angle": 33.0})
    run._particles.velocity.assign(np.tile(np.array(velocity, dtype=np.float32), (len(x), 1)))
    with pytest.raises(SimulationError, match=says + ".*'friction_angle': 33"):
        for _ in range(8):
            run.advance(1)
