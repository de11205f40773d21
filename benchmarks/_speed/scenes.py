"""Scenes that several parts share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from splatsoil.benchmarks.numerics import FloatArray, Truth

from splatsoil.measurement import Measurement
from splatsoil.mpm import PRESETS, Resolution, Solver, Trajectory, simulate
from splatsoil.mpm.grid import GridShape
from splatsoil.mpm.simulate import base_settings, step_poses
from splatsoil.mpm.tool import Pose
from splatsoil.reconstruction import fill
from splatsoil.soil.law import Law
from splatsoil.soil.matching import cone_slope
from splatsoil.synthetic import paper

PAPER_ANGLE = 35.0
"""Friction angle of the published scene here, degrees; the time hardly hangs on it."""


@dataclass(frozen=True)
class Plough:
    """A scene with its particles.

    Attributes:
        name: of the scene.
        measurement: bed, tool and motion.
        resolution: of ours.
        x: particles (n, 3) in m.
        values: parameters by name.
        last: the run ends with this frame.
        truth: particles of an independent simulator; None where there are none.
    """

    name: str
    measurement: Measurement
    resolution: Resolution
    x: FloatArray
    values: Mapping[str, float]
    last: int
    truth: Truth | None = None

    @property
    def steps(self) -> int:
        """Exchanges of particles and grid in the whole run."""
        return self.last * self.resolution.steps

    @property
    def substeps(self) -> int:
        """Substeps of the grid in the whole run: each is what a step of an explicit MPM does, as often as it must."""
        return self.steps * self.resolution.substeps(self.resolution.steps)

    def run(self, device: str = "cpu", batch: int = 1, frames: tuple[int, ...] | None = None) -> list[Trajectory]:
        """The whole run; a batch has friction angles of its own each."""
        angle = self.values["friction_angle"]
        values = [{**self.values, "friction_angle": angle + 0.5 * k} for k in range(batch)]
        return simulate(
            self.measurement, self.x, values, resolution=self.resolution, frames=frames or (self.last,), device=device
        )

    def solver(self, device: str, law: Law | None = None) -> Solver:
        """The solver at frame 0."""
        bed, tool = self.measurement.bed, self.measurement.tool
        # a law that is no law of ours has no parameters
        values = self.values if law is None else {}
        return Solver(
            self.x[None].astype(np.float32), bed.lower, bed.upper, tool.mesh, self.resolution, law or Law(),
            base_settings(self.measurement), [values], device,
        )  # fmt: skip

    def poses(self, frame: int) -> tuple[Pose, ...]:
        """The tool at the start of each step of the frame that follows ``frame``."""
        r = self.resolution
        return step_poses(self.measurement.tool.motion, frame * r.frame_time, r.frame_time, r.steps)

    def words(self) -> str:
        """Particles, frames, steps and substeps."""
        return (
            f"{len(self.x)} particles, {self.last} frames, {self.steps} exchanges of particles and grid, "
            f"{self.substeps} substeps of the grid"
        )

    def refined(self, particles: int) -> Plough:
        """The same bed with about this many particles, in finer cells, steps and substeps."""
        assert self.truth is not None
        spacing = self.resolution.spacing * (len(self.x) / particles) ** (1.0 / 3.0)
        width = float(np.sort(self.measurement.tool.mesh.extents)[1])
        small = PRESETS["small"]
        preset = replace(small, cells_across_tool=width / (small.particles_per_edge * spacing))
        finer = Resolution.derive(self.measurement, preset)
        return replace(self, resolution=finer, x=self.truth.start(finer.spacing, 0))


def plough(folder: Path, preset: str = "small") -> Plough:
    """A measurement set with its true angle, from the set's own first particles where the preset has as many.

    Raises:
        MeasurementError: the set carries no true particles.
        ParameterError: an unknown preset.
    """
    truth = Truth.load(folder)
    resolution = Resolution.derive(truth.measurement, preset)
    same = abs(truth.volume ** (1.0 / 3.0) / resolution.spacing - 1.0) < 1e-3
    x = truth.particles[0] if same else truth.start(resolution.spacing, 0)
    values = {"friction_angle": truth.values["friction_angle"]}
    return Plough(truth.measurement.name, truth.measurement, resolution, x, values, max(truth.particles), truth)


def paper_scene(cells: float | None = None) -> Plough:
    """The published scene with the preset ``paper``, or another number of cells across the tool."""
    setup = paper()
    measurement = setup.experiment()
    preset = PRESETS["paper"] if cells is None else replace(PRESETS["paper"], cells_across_tool=cells)
    resolution = Resolution.derive(measurement, preset)
    x = fill(setup.surface, setup.bed, resolution.spacing, seed=0)
    return Plough("paper", measurement, resolution, x, {"friction_angle": PAPER_ANGLE}, max(setup.frames))


def explicit(scene: Plough, courant: float) -> dict[str, Any]:
    """The scene for :mod:`splatsoil.benchmarks._speed.sand_taichi`: same grid, particles, stiffness and motion.

    Args:
        scene: with a tool that is a box in its own frame.
        courant: of the step, in cells that a pressure wave goes.
    """
    r, m = scene.resolution, scene.measurement
    shape = GridShape.covering(m.bed.lower, m.bed.upper, r.cell)
    frame_steps = max(1, int(np.ceil(r.frame_time * r.wave_speed / (courant * r.cell) - 1e-9)))
    poses = []
    for frame in range(scene.last):
        turn, place = m.tool.motion.pose(frame * r.frame_time)
        following = m.tool.motion.pose((frame + 1) * r.frame_time)[1]
        poses.append(np.concatenate([place, np.ravel(turn), (following - place) / r.frame_time]))
    solver = scene.solver("cpu")
    return {
        "positions": scene.x,
        "lower": shape.lower,
        "upper": shape.lower + shape.cell * (np.array(shape.nodes) - 1),
        "cell": shape.cell,
        "step": r.frame_time / frame_steps,
        "spacing": r.spacing,
        "density": r.density,
        "bulk": r.bulk,
        "shear": r.shear,
        "slope": cone_slope(scene.values["friction_angle"]),
        "gravity": m.gravity,
        # both start from the pressure of the soil above
        "elastic": -solver.pressures()[0] / r.bulk,
        "floor_friction": m.bed.floor_friction,
        "wall_friction": m.bed.wall_friction,
        "tool_friction": m.tool.friction,
        # nodes must be able to lie in the plate
        "tool": np.maximum(0.5 * m.tool.mesh.extents, 0.5 * r.cell),
        "poses": np.array(poses),
        "frame_steps": frame_steps,
    }


def height_error(scene: Plough, states: Mapping[int, FloatArray]) -> float | None:
    """Root mean square distance in mm of a run's heights from the true ones, over the frames; None without truth."""
    truth = scene.truth
    frames = [] if truth is None else [f for f in states if f in truth.particles and f > 0]
    if truth is None or not frames:
        return None
    off = [
        truth.heights(states[f], scene.resolution.spacing**3) - truth.heights(truth.particles[f], truth.volume)
        for f in frames
    ]
    return float(1e3 * np.sqrt(np.mean(np.square(off))))
