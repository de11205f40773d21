"""A simulation at known parameters, moment by moment, with all fields of the solver's particles."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch

from splatsoil.arrays import FloatArray
from splatsoil.model import Model
from splatsoil.mpm.simulate import base_settings, step_poses
from splatsoil.mpm.solver import Solver
from splatsoil.scene import Relief, relief_of_particles

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Moment:
    """Soil and tool at one frame.

    Attributes:
        frame: its number.
        time: seconds on the tool motion's clock.
        positions: particles (n, 3), m.
        velocities: (n, 3), m/s.
        displacements: (n, 3) since frame 0, m.
        deformations: (n, 3, 3) visual deformation since frame 0.
        pressures: (n,) mean stress, Pa, positive in compression.
        plastic_strains: (n,) plastic shear strain so far; None where no effect of the model keeps it.
        tool: rotation (3, 3), mesh to world, and position (3,), m.
        surface: of the soil.
    """

    frame: int
    time: float
    positions: Floats
    velocities: Floats
    displacements: Floats
    deformations: Floats
    pressures: Floats
    plastic_strains: Floats | None
    tool: tuple[FloatArray, FloatArray]
    surface: Relief

    @property
    def surface_points(self) -> Floats:
        """The surface's cell centres (ny * nx, 3) in m, row after row."""
        return np.ascontiguousarray(self.surface.points.reshape(-1, 3).cpu().numpy(), dtype=np.float32)

    @property
    def surface_quads(self) -> npt.NDArray[np.int32]:
        """Quadrilaterals (k, 4) between these points, counter-clockwise as seen from above."""
        ny, nx = self.surface.height.shape
        corner = np.arange(ny * nx, dtype=np.int32).reshape(ny, nx)[:-1, :-1].reshape(-1, 1)
        return corner + np.array([0, 1, nx + 1, nx], dtype=np.int32)


class Writer(Protocol):
    """Writes moments in one format."""

    def add(self, moment: Moment) -> None:
        """Take the next moment; frames rise."""

    def finish(self, force: FloatArray) -> None:
        """Write what is left: ``force`` (frames run, 3) is the soil's mean force on the tool in frames 1, 2, …, N."""


def replay(
    model: Model,
    values: Mapping[str, float],
    frames: Iterable[int],
    writers: Sequence[Writer],
    *,
    seed: int = 0,
    progress: Callable[[int, int], None] = lambda frame, last: None,
) -> None:
    """Simulate a model as `Model.simulate` does, and hand each wanted frame to all writers.

    Args:
        model: what is simulated.
        values: parameters by name; defaults for those left out.
        frames: numbers of the frames to write, from 0 on.
        writers: who writes them.
        seed: of the particles.
        progress: called with (frame, last frame).

    Raises:
        SimulationError: the simulation could not go on.
        ParameterError: unknown names or values out of bounds.
    """
    measurement, resolution = model.measurement, model.resolution
    bed, tool = measurement.bed.domain, measurement.tool
    start = model.particles(seed).astype(np.float32)
    settings = base_settings(measurement)
    solver = Solver(
        start[None], bed.lower, bed.upper, tool.mesh, resolution, model.law, settings, [values], model.device
    )
    wanted, force = set(frames), []
    last = max(wanted)
    for frame in range(last + 1):
        if frame > 0:
            began = (frame - 1) * resolution.frame_time
            force.append(solver.advance(step_poses(tool.motion, began, resolution.frame_time, resolution.steps))[0])
        if frame in wanted:
            moment = _moment(model, solver, frame, start)
            for writer in writers:
                writer.add(moment)
        progress(frame, last)
    for writer in writers:
        writer.finish(np.array(force).reshape(-1, 3))


def _moment(model: Model, solver: Solver, frame: int, start: Floats) -> Moment:
    bed, time = model.measurement.bed.domain, frame * model.resolution.frame_time
    positions = solver.positions()[0]
    strains = solver.plastic_strains()
    # Soil's surface is seen, not simulated: the processor does.
    surface = relief_of_particles(torch.from_numpy(positions), model.resolution.spacing, bed.lower, bed.upper)
    return Moment(
        frame=frame,
        time=time,
        positions=positions,
        velocities=solver.velocities()[0],
        displacements=positions - start,
        deformations=solver.deformations()[0],
        pressures=solver.pressures()[0].astype(np.float32),
        plastic_strains=None if strains is None else strains[0],
        tool=model.measurement.tool.motion.pose(time),
        surface=surface,
    )
