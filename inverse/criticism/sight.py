"""Where refits look: at what tells of parameters, effects and slow waves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatsoil.experiment.base import Experiment

from .evidence import Vantage
from .floor import Floor
from .noise import Noise, Solver, orthonormal

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Sight:
    """Whitened features as far as they tell of parameters, effects and slow waves.

    Two simulations differ by chance in every feature. Their χ² over all of them, which is what a refit would compare,
    scatters by tens; in the directions in which anything acts, by few. Experiments without chance are looked at as a
    whole. Numerics are projected out.

    Attributes:
        noise: of the features looked at.
        solver: of that noise.
        directions: (n, d) orthonormal, in which to look; None for all of the features.
    """

    noise: Noise
    solver: Solver
    directions: FloatArray | None

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        floor: Floor,
        basis: FloatArray,
        vantage: Vantage | None = None,
        rows: npt.NDArray[np.bool_] | None = None,
        *,
        averaged: bool = False,
    ) -> Sight:
        """For slow waves (n, k), a second look where one was taken, and some times (t,) or all; against one prediction,
        or the mean of the repeats."""
        rows = np.ones(len(experiment.observed), dtype=bool) if rows is None else rows
        noise = floor.noise if averaged else floor.single
        inside = (experiment.seen & rows[:, None])[experiment.seen]
        if not rows.all():
            noise = noise.rows(rows)
        solver = noise.solver.beside(floor.nuisance[inside])
        if not experiment.chance:
            return cls(noise, solver, None)
        columns = [floor.parameters, floor.directions, basis]
        if vantage is not None:
            tables = [*vantage.slopes.values(), *(table for tables in vantage.directions.values() for table in tables)]
            columns.append(np.stack([table[experiment.seen] for table in tables], axis=-1))
        return cls(noise, solver, orthonormal(solver.whiten(np.concatenate(columns, axis=1)[inside])))

    def __call__(self, table: FloatArray) -> FloatArray:
        """Of a table (t, s, …): (d, …), of noise alone independent with variance 1."""
        white = self.solver.whiten(table[self.noise.seen])
        return white if self.directions is None else self.directions.T @ white
