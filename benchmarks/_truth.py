"""Particles of an independent simulator, and how a solver is compared with them: heights, volumes and forces."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from scipy.ndimage import gaussian_filter
from splatsoil.benchmarks._common import FloatArray

from splatsoil.errors import MeasurementError
from splatsoil.experiment.scene_parts import heading_of, stages_of
from splatsoil.measurement import Measurement
from splatsoil.reconstruction import HeightField, fill
from splatsoil.scene import relief_of_particles

CELL = 0.01
"""Edge of the cells in which heights are compared, m."""
PATCH = 1.5
"""Standard deviation, in cells, of the smoothing under which heights are compared: wider than seed-to-seed scatter."""
SETTLED = 2.0e-3
"""Change of a patch's height below which its soil counts as neither cut nor heaped, m: three times the scatter between
particle seeds, which would else fill a bed of 0.4 m² with a hundred cm³ of both."""


@dataclass(frozen=True)
class Truth:
    """Particles of an independent simulator.

    Attributes:
        measurement: bed, tool and motion.
        particles: (n, 3) in m by frame, from 0 on.
        volume: of one particle, m^3.
        values: true parameters by name.
        effects: effects that are on in the truth and known to the model.
        force: (f, 3) N of the soil on the tool: mean over the time that leads to frames 1, 2, …, f; None if unknown.
    """

    measurement: Measurement
    particles: dict[int, FloatArray]
    volume: float
    values: Mapping[str, float]
    effects: tuple[str, ...]
    force: FloatArray | None = None

    @classmethod
    def load(cls, folder: Path) -> Truth:
        """Read ``truth.json`` and ``truth_particles.npz``; MeasurementError when the set has none, or other ones."""
        measurement = Measurement.load(folder)
        try:
            truth = json.loads((folder / "truth.json").read_text())
            particles, spacing = read_particles(folder / "truth_particles.npz")
        except OSError as error:
            raise MeasurementError("the benchmark needs true particles", file=folder) from error
        if "parameters" in truth:  # a set of ours
            values, effects = {k: float(v) for k, v in truth["parameters"].items()}, tuple(truth["effects"])
        elif "phi" in truth:
            cohesion = float(truth["cohesion"])
            values, effects = {"friction_angle": float(truth["phi"])}, ("cohesion",) if cohesion else ()
            values |= {"cohesion": cohesion} if cohesion else {}
        else:
            raise MeasurementError(
                "the benchmark needs the true parameters", file=folder / "truth.json", field="parameters"
            )
        force = measurement.tool.force
        return cls(measurement, particles, spacing**3, values, effects, None if force is None else force[:, 2:])

    @property
    def spacing(self) -> float:
        """Edge of the cube of soil that a particle stands for, m."""
        return float(self.volume ** (1.0 / 3.0))

    @property
    def frames(self) -> tuple[int, ...]:
        """Of the particles, from 1 on."""
        return tuple(f for f in sorted(self.particles) if f > 0)

    def heights(self, x: npt.NDArray[np.floating], volume: float) -> FloatArray:
        """Surface (ny, nx) in m, smoothed over one cell, of particles (n, 3) of a volume each."""
        bed = self.measurement.bed
        # the kernel's width is a length of the bed, the same for every particle size
        spacing = volume ** (1.0 / 3.0)
        positions = torch.as_tensor(np.ascontiguousarray(x), dtype=torch.float32)
        relief = relief_of_particles(positions, spacing, bed.lower, bed.upper, smoothing=CELL / spacing)
        nx, ny = (round(float(e) / CELL) for e in (bed.upper - bed.lower)[:2])
        xs, ys = (bed.lower[k] + CELL * (np.arange(n) + 0.5) for k, n in ((0, nx), (1, ny)))
        points = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
        sampled = relief.sample(relief.height, torch.as_tensor(points, dtype=torch.float32))
        return gaussian_filter(sampled.numpy().reshape(ny, nx).astype(np.float64), 1.0)

    def surfaces(self) -> FloatArray:
        """(frames, ny, nx) m, of the true particles at the frames from 1 on."""
        return np.array([self.heights(self.particles[f], self.volume) for f in self.frames])

    def start(self, spacing: float, seed: int) -> FloatArray:
        """Other particles in the volume that the true ones fill at frame 0."""
        bed, first = self.measurement.bed, self.particles[0]
        height = self.heights(first, self.volume)
        plan = bed.upper[:2] - bed.lower[:2]
        height += len(first) * self.volume / float(np.prod(plan)) - (height - bed.lower[2]).mean()
        x, y = (bed.lower[k] + CELL * (np.arange(height.shape[1 - k]) + 0.5) for k in (0, 1))
        return fill(HeightField(x, y, height), bed, spacing, seed=seed)


def read_particles(file: Path) -> tuple[dict[int, FloatArray], float]:
    """Positions (n, 3) in m by frame, and the particles' spacing in m."""
    with np.load(file) as stored:
        low = stored["origin"] if "origin" in stored.files else 0.0
        scale = float(stored["scale"])
        particles = {int(k[1:]): stored[k] * scale + low for k in stored.files if k[1:].isdigit()}
        return particles, float(stored["spacing"])


def in_patches(difference: FloatArray) -> float:
    """Root mean square of a difference of heights (…, ny, nx), smoothed to patches."""
    width = (0.0,) * (difference.ndim - 2) + (PATCH, PATCH)
    return float(np.sqrt(np.mean(gaussian_filter(difference, width) ** 2)))


def cut_and_heaped(before: FloatArray, after: FloatArray) -> tuple[float, float]:
    """Soil that is missing and soil that was added, cm³, of heights (ny, nx) in m."""
    change = gaussian_filter(after - before, PATCH)
    change = np.where(np.abs(change) > SETTLED, change, 0.0)
    cut, heaped = (float(np.clip(sign * change, 0.0, None).sum()) * CELL**2 * 1.0e6 for sign in (-1.0, 1.0))
    return cut, heaped


def volume_range(start: FloatArray, heights: FloatArray) -> tuple[float, float]:
    """Lowest and highest mean of ``heights`` (frames, ny, nx) over the frames, relative to that of ``start``."""
    relative = heights.mean(axis=(1, 2)) / start.mean() - 1.0
    return float(relative.min()), float(relative.max())


def stage_forces(measurement: Measurement, force: npt.NDArray[np.floating]) -> dict[str, tuple[float, float]]:
    """Mean force along the tool's way forward and upwards, N, over all frames of each stage, by the stages' names.

    Args:
        measurement: bed, tool and motion.
        force: (f, 3) N at frames 1, 2, …, f.
    """
    stages = np.array(stages_of(measurement, [float(frame) for frame in range(1, len(force) + 1)]))
    parts = np.stack([force[:, :2] @ heading_of(measurement), force[:, 2]], axis=1)
    means = {str(name): parts[stages == name].mean(axis=0) for name in dict.fromkeys(stages)}
    return {name: (float(mean[0]), float(mean[1])) for name, mean in means.items()}
