"""The solver: a batch of simulations of one scene, advanced frame by frame.

Two clocks. Particles and grid exchange state a few times a frame, as often as the motion needs it. Between two
exchanges, the grid's nodes move in many substeps, as often as the sound waves of the soil's skeleton need it, on frozen
weights. An exchange by itself loses nothing; what must be damped is damped by the second. So the
result depends neither on stiffness nor on the number of steps; docs/numerics.md has the remaining dependence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import trimesh
import warp as wp

from splatsoil.deterministic import wanted
from splatsoil.errors import SimulationError
from splatsoil.mpm.grid import GridShape
from splatsoil.mpm.presets import Resolution
from splatsoil.mpm.start import at_rest
from splatsoil.mpm.state import Cells, Contacts, Nodes, Particles
from splatsoil.mpm.substep import contact_forces, make_stress_kernel, move_nodes
from splatsoil.mpm.tool import Pose, build_tool
from splatsoil.mpm.transfer import (
    allow_start,
    average_cells,
    bound_stretch,
    find_gaps,
    grid_to_particles,
    hourglass_share,
    list_cells,
    mark_cells,
    momentum_to_velocity,
    number_cells,
    particles_to_grid,
)
from splatsoil.soil.law import OBSTACLE, STIFFNESS, Law
from splatsoil.soil.settings import Settings

FloatArray = npt.NDArray[np.floating]

BULK_VISCOSITY = 0.2
"""Linear bulk viscosity over (density * wave speed * cell), as explicit codes use against ringing (Benson 1992)."""
INERTIA_MARGIN = 1.2
"""Inertia of nearly empty nodes over the central-difference stability limit; 2/3 is marginal for a full cell."""
CONTACT_DAMPING = 0.2
"""Fraction of critical damping of the contact spring of one particle."""
CONTACT_RELEASE = 2.0
"""Rate, over :attr:`Resolution.relaxation`, at which soil sunk into the tool's contact springs comes out of them."""
DEEPEST = 0.25
"""Of a particle's spacing: soil deeper in the tool, as where a tool starts in the soil, comes out at once."""
MOST_STRAYS = 1.0e-3
"""Fraction of a batch's particles that may have risen above the bed's space before the run is given up."""
STRETCH = (0.4, 2.5)
"""Bounds of the visual deformation's singular values."""


class Solver:
    """A batch of simulations in one bed with one tool, which differ in parameters and particles.

    Args:
        positions: particles (simulations, n, 3) in m.
        lower: lower corner (3,) of the bed in m.
        upper: upper corner (3,) of the space that soil may use, in m.
        mesh: the tool in its own frame, m; None for soil that is left alone.
        resolution: lengths, steps and stiffness.
        law: the soil law; its effects' parameters are columns of ``values``.
        base: settings of the experiment, before any effect.
        values: parameters by name, one mapping for each simulation.
        device: Warp device name.

    Raises:
        SimulationError: particles outside the bed, arrays of the wrong shape, an obstacle that the grid cannot see.
        ParameterError: parameters that are unknown or out of bounds.
    """

    def __init__(
        self,
        positions: FloatArray,
        lower: npt.ArrayLike,
        upper: npt.ArrayLike,
        mesh: trimesh.Trimesh | None,
        resolution: Resolution,
        law: Law,
        base: Settings,
        values: Sequence[Mapping[str, float]],
        device: str = "cpu",
    ) -> None:
        wp.config.quiet = True
        self.law, self.device = law, device
        self.values = [dict(v) for v in values]
        table = law.table(base, self.values)
        # one step for the whole batch, as the stiffest of it needs
        stiffest = float(table[:, STIFFNESS].max())
        table[:, STIFFNESS] /= stiffest
        resolution = replace(resolution, bulk=stiffest * resolution.bulk, shear=stiffest * resolution.shear)
        self.resolution = resolution
        x = np.ascontiguousarray(positions, dtype=np.float32)
        if x.ndim != 3 or x.shape[2] != 3 or x.shape[0] != len(self.values) or x.shape[1] == 0:
            raise SimulationError(
                f"particles have shape {x.shape}; {len(self.values)} simulations need ({len(self.values)}, n, 3)"
            )
        low, high = np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64)
        slack = 1e-4 * resolution.cell
        if not (np.isfinite(x).all() and (x >= low - slack).all() and (x <= high + slack).all()):
            raise SimulationError("some particles start outside the bed's box or at positions that are not finite")
        self.simulations, self.particles_each = x.shape[0], x.shape[1]
        self.shape = GridShape.covering(low, high, resolution.cell)
        self._refuse_unseen(table[:, OBSTACLE : OBSTACLE + 4])
        self.grid = self.shape.to_warp()
        self.ceiling = float(high[2] + 2.0 * resolution.cell)
        self._table = wp.array(table.astype(np.float32), dtype=float, device=device)
        self._stress_kernel = make_stress_kernel(law.update, law.history)
        self._allocate(x)
        spring = resolution.bulk * resolution.spacing
        self.tool = (
            None
            if mesh is None
            else build_tool(
                mesh,
                margin=3.0 * resolution.cell,
                stiffness=spring,
                damping=2.0 * CONTACT_DAMPING * math.sqrt(spring * self._particles.mass),
                device=device,
                skin=resolution.skin * resolution.spacing,
                thin=resolution.cell,
            )
        )
        self._start(x, base)
        self._met = False
        # what sorts its sums counts them on the host in between
        self._replays = device != "cpu" and not wanted()
        self._beside = wp.Stream(device) if self._replays else None
        self._graphs: dict[tuple[bool, float, int, float], wp.Graph | None] = {}
        self.frame = 0

    def _refuse_unseen(self, obstacles: npt.NDArray[np.float64]) -> None:
        """SimulationError when a sphere (x, y from the middle, height, radius) holds no node of the grid."""
        cell, last = self.shape.cell, np.array(self.shape.nodes) - 1
        centres = obstacles[:, :3] + np.array([0.5, 0.5, 0.0]) * last * cell
        nearest = cell * np.clip(np.rint(centres / cell), 0, last)
        unseen = (obstacles[:, 3] > 0.0) & (np.linalg.norm(centres - nearest, axis=1) >= obstacles[:, 3])
        if unseen.any():
            raise SimulationError(
                f"an obstacle of radius {obstacles[unseen][0, 3]:g} m holds no node of the grid, whose cells measure "
                f"{cell.max():.3g} m, and would not be felt; make it larger, keep it in the bed or take a finer preset"
            )

    def _allocate(self, x: npt.NDArray[np.float32]) -> None:
        n, count, device = x.shape[0] * x.shape[1], self.simulations * self.grid.nodes, self.device

        def vectors(size: int) -> wp.array:
            return wp.zeros(size, dtype=wp.vec3, device=device)

        def floats(size: int) -> wp.array:
            return wp.zeros(size, dtype=float, device=device)

        def ints(size: int) -> wp.array:
            return wp.zeros(size, dtype=int, device=device)

        p = Particles()
        p.position = wp.array(x.reshape(-1, 3), dtype=wp.vec3, device=device)
        p.velocity, p.trilinear, p.normal, p.shear, p.gap_normal, p.drift, p.grip = (vectors(n) for _ in range(7))
        p.affine, p.bilinear = (wp.zeros(n, dtype=wp.mat33, device=device) for _ in range(2))
        p.deformation = wp.array(np.tile(np.eye(3, dtype=np.float32), (n, 1, 1)), dtype=wp.mat33, device=device)
        p.elastic, p.opening, p.gap, p.preload = (floats(n) for _ in range(4))
        p.cell = ints(n)
        kept = n if self.law.history else 0
        p.history, p.depth = wp.zeros(kept, dtype=wp.vec2, device=device), floats(kept)
        p.density = wp.ones(n, dtype=float, device=device)
        p.per_simulation = self.particles_each
        p.volume = self.resolution.spacing**3
        p.mass = p.volume * self.resolution.density
        self._particles = p

        g = Nodes()
        g.mass, g.inertia, g.active, g.count = floats(count), floats(count), ints(count), ints(1)
        g.velocity, g.force, g.displacement = vectors(count), vectors(count), vectors(count)
        self._nodes = g

        most = min(n, count)
        c = Cells()
        c.slot, c.node, c.count = ints(count), ints(most), ints(1)
        c.volume, c.elastic, c.opening = floats(most), floats(most), floats(most)
        c.normal, c.shear = (vectors(most) for _ in range(2))
        c.gradient = vectors(8 * most)
        kept = most if self.law.history else 0
        c.history, c.depth = wp.zeros(kept, dtype=wp.vec2, device=device), floats(kept)
        self._cells = c

        near = Contacts()
        near.particle, near.weight, near.count = ints(n), floats(8 * n), ints(1)
        near.area, near.deepest = self.resolution.spacing**2, DEEPEST * self.resolution.spacing
        self._contacts = near

        self._broken, self._strays = ints(1), ints(1)
        self._pose = floats(13)
        self._force = vectors(self.simulations)

    def _start(self, x: npt.NDArray[np.float32], base: Settings) -> None:
        """Start from the pressure of the soil above, so that the bed does not settle when the run begins."""
        stiffness = self._table.numpy()[:, STIFFNESS] * self.resolution.bulk
        soils = [
            at_rest(self.law, base, values, places, self.shape, self.resolution, float(bulk))
            for values, places, bulk in zip(self.values, x, stiffness, strict=True)
        ]
        strain, depth, density = (np.concatenate(parts).astype(np.float32) for parts in zip(*soils, strict=True))
        p = self._particles
        p.elastic.assign(strain)
        p.density.assign(density)
        if self.law.history:
            p.depth.assign(depth)

    def advance(self, poses: Sequence[Pose] | int) -> npt.NDArray[np.float64]:
        """Advance one frame.

        Args:
            poses: the tool at the start of each of the frame's steps; their number sets the step. Without a tool, the
                number alone.

        Returns:
            Mean force (simulations, 3) of the soil on the tool over the frame, N.

        Raises:
            SimulationError: soil left the grid or the state is not finite.
        """
        moves: Sequence[Pose | None] = [None] * poses if isinstance(poses, int) else poses
        if not moves or (self.tool is None) != isinstance(poses, int):
            raise SimulationError("advance() takes the tool's poses, or a number of steps where there is no tool")
        steps = len(moves)
        substeps = self.resolution.substeps(steps)
        step_time = self.resolution.frame_time / steps
        self._force.zero_()
        for pose in moves:
            self._step(pose, step_time, substeps, 1.0 / (steps * substeps))
        self.frame += 1
        total = self.simulations * self.particles_each
        broken, strays = int(self._broken.numpy()[0]), int(self._strays.numpy()[0])
        if broken or strays > MOST_STRAYS * total:
            what = f"{broken} lost a finite state" if broken else f"{strays} left the grid upward"
            raise SimulationError(
                f"of {total} particles {what} by frame {self.frame} ({steps} steps of {substeps} substeps); "
                f"parameters {self.values}"
            )
        return self._force.numpy().astype(np.float64)

    def _step(self, pose: Pose | None, step_time: float, substeps: int, share: float) -> None:
        """One exchange between particles and grid, and the substeps that follow.

        A GPU waits for launches longer than it works on them: what the second such step launches is kept as a graph,
        and the ones after it are launched whole.
        """
        if pose is not None:
            self._pose.assign(pose.row().astype(np.float32))
        step = (pose is not None, step_time, substeps, share)
        if not self._replays:
            self._launch_step(*step)
            return
        if step not in self._graphs:
            self._graphs[step] = None
            self._launch_step(*step)
            return
        if self._graphs[step] is None:
            with wp.ScopedCapture(device=self.device) as captured:
                self._launch_step(*step)
            self._graphs[step] = captured.graph
        wp.capture_launch(self._graphs[step])

    def _launch_step(self, with_tool: bool, step_time: float, substeps: int, share: float) -> None:
        p, c, g, grid, device = self._particles, self._cells, self._nodes, self.grid, self.device
        r = self.resolution
        dt = step_time / substeps
        modulus = r.bulk + 4.0 * r.shear / 3.0
        n, node_count, cell_count = p.position.shape[0], g.mass.shape[0], c.node.shape[0]
        for array in (g.mass, g.inertia, g.velocity, g.force, g.displacement, g.count, c.count, self._contacts.count):
            array.zero_()
        c.slot.fill_(-1)
        wp.launch(mark_cells, dim=n, inputs=[p, c, grid], device=device)
        wp.launch(list_cells, dim=node_count, inputs=[c], device=device)
        cells = self._size(c.count, cell_count)
        wp.launch(number_cells, dim=cells, inputs=[c], device=device)
        wp.launch(particles_to_grid, dim=n, inputs=[p, c, g, grid], device=device)
        wp.launch(
            average_cells,
            dim=cells,
            inputs=[p, c, g, grid, r.density, INERTIA_MARGIN * modulus * dt * dt],
            device=device,
        )
        wp.launch(momentum_to_velocity, dim=node_count, inputs=[g], device=device)
        nodes = self._size(g.count, node_count)
        viscosity = BULK_VISCOSITY * r.density * r.wave_speed * r.cell
        stress = wp.launch(
            self._stress_kernel,
            dim=cells,
            inputs=[c, g, grid, r.bulk, r.shear, viscosity, dt, self._table],
            device=device,
            record_cmd=True,
        )
        contact = self._contact(dt, share) if with_tool else None
        exchanges = step_time * (r.relaxation or 1.0 / step_time)
        keep, release = hourglass_share(exchanges), 1.0 - math.exp(-CONTACT_RELEASE * exchanges)
        move = wp.launch(move_nodes, dim=nodes, inputs=[g, grid, dt, self._table], device=device, record_cmd=True)
        for _ in range(substeps):
            self._launch_forces(stress, contact)
            move.launch()
        wp.launch(
            grid_to_particles,
            dim=n,
            inputs=[
                *(p, c, g, grid, self.ceiling, r.wave_speed),
                *(keep, release, DEEPEST * r.spacing, self._broken, self._strays),
            ],
            device=device,
        )

    def _launch_forces(self, stress: wp.Launch, contact: wp.Launch | None) -> None:
        """Both only add to the nodes' forces: a GPU works on both at once."""
        if contact is None or self._beside is None:
            stress.launch()
            if contact is not None:
                contact.launch()
            return
        here = wp.get_stream(self.device)
        self._beside.wait_stream(here)
        stress.launch()
        contact.launch(self._beside)
        here.wait_stream(self._beside)

    def _contact(self, dt: float, share: float) -> wp.Launch:
        """Find the particles near the tool, and make ready the launch of what runs in every substep."""
        p, device, near = self._particles, self.device, self._contacts
        n = p.position.shape[0]
        wp.launch(
            find_gaps, dim=n, inputs=[p, self.grid, self.tool, self._pose, self.resolution.cell, near], device=device
        )
        if not self._met:
            wp.launch(allow_start, dim=n, inputs=[p], device=device)
            self._met = True
        return wp.launch(
            contact_forces,
            dim=self._size(near.count, n),
            inputs=[p, self._nodes, self.grid, self.tool, self._pose, near, dt, share, self._table, self._force],
            device=device,
            record_cmd=True,
        )

    def _size(self, count: wp.array, most: int) -> int:
        """How many threads to launch for a packed list: its length where reading it is free, else its capacity."""
        return most if self.device != "cpu" else max(int(count.numpy()[0]), 1)

    def positions(self) -> npt.NDArray[np.float32]:
        """Particles now, (simulations, n, 3) in m."""
        return self._particles.position.numpy().reshape(self.simulations, -1, 3).copy()

    def velocities(self) -> npt.NDArray[np.float32]:
        """Velocities now, (simulations, n, 3) in m/s."""
        return self._particles.velocity.numpy().reshape(self.simulations, -1, 3).copy()

    def deformations(self) -> npt.NDArray[np.float32]:
        """Visual deformation since frame 0, (simulations, n, 3, 3), its singular values bounded."""
        p = self._particles
        wp.launch(bound_stretch, dim=p.position.shape[0], inputs=[p, *STRETCH], device=self.device)
        return p.deformation.numpy().reshape(self.simulations, -1, 3, 3).copy()

    def pressures(self) -> npt.NDArray[np.float64]:
        """Mean stress of the soil around each particle now, (simulations, n) in Pa, positive in compression."""
        stiffness = self.resolution.bulk * self._table.numpy()[:, STIFFNESS].astype(np.float64)
        return -stiffness[:, None] * self._particles.elastic.numpy().astype(np.float64).reshape(self.simulations, -1)

    def plastic_strains(self) -> npt.NDArray[np.float32] | None:
        """Plastic shear strain so far, (simulations, n); None where no effect of the law keeps it."""
        if not self.law.history:
            return None
        return self._particles.history.numpy()[:, 0].reshape(self.simulations, -1).copy()

    def momentum(self) -> npt.NDArray[np.float64]:
        """Total momentum (simulations, 3) in kg m/s."""
        p = self._particles
        velocity = p.velocity.numpy().astype(np.float64) * p.density.numpy()[:, None]
        return p.mass * velocity.reshape(self.simulations, -1, 3).sum(axis=1)

    def mass(self) -> npt.NDArray[np.float64]:
        """Mass (simulations,) in kg that the grid held in the last step."""
        return self._nodes.mass.numpy().astype(np.float64).reshape(self.simulations, -1).sum(axis=1)
