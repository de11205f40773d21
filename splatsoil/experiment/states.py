"""Which states soil goes through while it yields: where something can be said of its strength."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from splatsoil.soil.law import Law
from splatsoil.soil.library import library

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from splatsoil.model import Model

FloatArray = npt.NDArray[np.float64]

LEAST_PRESSURE = 1.0
"""Pa; soil that comes apart has none, and its logarithm must exist."""
MOST_STATES = 200_000


@dataclass(frozen=True)
class States:
    """States of yielding soil, each with the share of plastic work that is done in it.

    Attributes:
        pressure: (n,) mean stress, Pa.
        rate: (n,) rate of plastic shear strain, 1/s.
        strain: (n,) plastic shear strain so far.
        weight: (n,) pressure times plastic shear strain spent in this state, summing to 1: soil that falls loosely
            strains much, but its strength does nothing.
    """

    pressure: FloatArray
    rate: FloatArray
    strain: FloatArray
    weight: FloatArray

    @classmethod
    def of(cls, pressure: FloatArray, strain: FloatArray, seconds: FloatArray) -> States:
        """From histories (histories, moments) of pressure and plastic strain, and the time (moments - 1,) between."""
        spent = np.diff(strain, axis=1)
        yields = spent > 1e-6
        rate = spent / seconds
        middle = 0.5 * (strain[:, 1:] + strain[:, :-1])
        bears = np.maximum(pressure[:, 1:][yields], LEAST_PRESSURE)
        weight = bears * spent[yields]
        return cls(bears, rate[yields], middle[yields], weight / max(float(weight.sum()), 1e-300))

    @classmethod
    def joined(cls, parts: Sequence[States]) -> States:
        """Several experiments' states, each experiment weighing the same."""
        return cls(
            np.concatenate([s.pressure for s in parts]),
            np.concatenate([s.rate for s in parts]),
            np.concatenate([s.strain for s in parts]),
            np.concatenate([s.weight for s in parts]) / max(sum(s.weight.size > 0 for s in parts), 1),
        )


@runtime_checkable
class Strained(Protocol):
    """An experiment that knows which states its soil goes through."""

    def states(self, values: Mapping[str, float]) -> States:
        """States visited with these parameters.

        Raises:
            SimulationError: the simulation could not go on.
        """


def with_history(law: Law) -> Law:
    """The law, or the same one with an effect at its off value where it would keep no plastic strain."""
    return law if law.history else Law((*law.effects, library()["rate_dependence"]))


def plow_states(model: Model, values: Mapping[str, float], seed: int = 0) -> States:
    """States of the soil in a simulation of a measurement set, from frame to frame.

    Raises:
        SimulationError: the simulation could not go on.
    """
    from splatsoil.mpm.simulate import base_settings, step_poses
    from splatsoil.mpm.solver import Solver

    measurement, resolution = model.measurement, model.resolution
    law = with_history(model.law)
    bed, motion = measurement.bed, measurement.tool.motion
    particles = np.asarray(model.particles(seed), dtype=np.float32)[None]
    solver = Solver(
        particles,
        bed.lower,
        bed.upper,
        measurement.tool.mesh,
        resolution,
        law,
        base_settings(measurement),
        [dict(values)],
        model.device,
    )
    last = model.frames[-1]
    pressure, strain = [], []
    for frame in range(last + 1):
        if frame:
            start = (frame - 1) * resolution.frame_time
            solver.advance(step_poses(motion, start, resolution.frame_time, resolution.steps))
        pressure.append(solver.pressures()[0])
        strain.append(solver.plastic_strains()[0])
    every = max(1, particles.shape[1] * last // MOST_STATES)
    return States.of(np.array(pressure).T[::every], np.array(strain).T[::every], np.full(last, resolution.frame_time))
