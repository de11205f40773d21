"""Prior and design of experiments: which simulations a comparison of models needs.

Parameters are spread by a Sobol sequence (Owen 1998, ACM Trans. Model. Comput. Simul. 8). The size of an effect is
log-uniform between its smallest meaningful size and 16 times that, of either sign where it has two. Finite sizes are
needed: a derivative at size zero misses a stone smaller than a cell, or tool friction beyond the angle at which soil
sticks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import qmc

from splatsoil.arrays import FloatArray
from splatsoil.experiment.base import Candidate, Experiment, Run
from splatsoil.parameters import Parameter, ParameterSpace

MAX_SIZE = 16.0
"""Largest size of an effect, over its smallest meaningful size."""


@dataclass(frozen=True)
class Prior:
    """Prior of the base model's parameters: uniform on a box, on the logarithm of a logarithmic parameter.

    Attributes:
        space: the parameters; their bounds are those of the box.
    """

    space: ParameterSpace

    @classmethod
    def of(cls, experiment: Experiment, *values: Mapping[str, float]) -> Prior:
        """The whole range for a parameter of the base law; from off to twice the fitted value for an effect that is on.

        Args:
            experiment: its parameters.
            values: fitted values by name, or both ends of the interval that a search has found.
        """
        return cls(ParameterSpace(_narrowed(p, [v[p.name] for v in values]) for p in experiment.parameters))

    def inside(self, runs: Sequence[Run]) -> list[Run]:
        """The runs whose parameters lie in the box."""
        return [r for r, point in zip(runs, self.unit(runs), strict=True) if np.abs(point).max() <= 1.0 + 1e-9]

    def points(self, count: int, seed: int) -> FloatArray:
        """(count, n) Sobol points in [-1, 1]."""
        return 2.0 * qmc.Sobol(len(self.space), seed=seed).random(count) - 1.0

    def values(self, points: FloatArray) -> list[dict[str, float]]:
        """Physical values by name of points (m, n)."""
        return [self.space.to_dict(row) for row in self.space.from_unit(points)]

    def unit(self, runs: Sequence[Run]) -> FloatArray:
        """(m, n) points in [-1, 1] of runs."""
        values = np.array([[r.values[p.name] for p in self.space] for r in runs])
        return self.space.to_unit(values.reshape(len(runs), len(self.space)))


def sizes(candidate: Candidate, cube: FloatArray) -> FloatArray:
    """(m, k) sizes of an effect's parameters over their smallest meaningful sizes, from points (m, k) of [0, 1]^k."""
    out = np.empty_like(cube)
    for i, p in enumerate(candidate.parameters):
        side = np.full(len(cube), float(p.sign)) if p.sign else np.where(cube[:, i] > 0.5, 1.0, -1.0)
        share = cube[:, i] if p.sign else 2.0 * np.abs(cube[:, i] - 0.5)
        room = np.where(side > 0.0, p.upper - _off(p), _off(p) - p.lower) / p.meaningful
        out[:, i] = side * np.minimum(MAX_SIZE, np.maximum(room, 1.0)) ** share
    return out


def effect_values(candidate: Candidate, size: FloatArray, shape: FloatArray) -> dict[str, FloatArray]:
    """(m,) values of an effect's parameters by name, from sizes (m, k) and shapes (m, j) in [-1, 1]."""
    found = {
        p.name: np.clip(_off(p) + size[:, i] * p.meaningful, p.lower, p.upper)
        for i, p in enumerate(candidate.parameters)
    }
    if candidate.shapes:
        shaped = ParameterSpace(candidate.shapes).from_unit(shape)
        found |= {p.name: shaped[:, i] for i, p in enumerate(candidate.shapes)}
    return found


def effect_points(candidate: Candidate, runs: Sequence[Run]) -> tuple[FloatArray, FloatArray]:
    """Sizes (m, k) and shapes (m, j) in [-1, 1] of runs with the effect on."""
    size = np.array([[(r.values[p.name] - _off(p)) / p.meaningful for p in candidate.parameters] for r in runs])
    if not candidate.shapes:
        return size, np.zeros((len(runs), 0))
    values = np.array([[r.values[p.name] for p in candidate.shapes] for r in runs])
    return size, ParameterSpace(candidate.shapes).to_unit(values)


def effect_runs(candidate: Candidate, prior: Prior, count: int, seed: int) -> list[Run]:
    """Runs with an effect on, spread over its parameters and those of the base model."""
    n, k, j = len(prior.space), len(candidate.parameters), len(candidate.shapes)
    cube = qmc.Sobol(n + k + j, seed=seed).random(1 << max(count - 1, 0).bit_length())[:count]
    base = prior.values(2.0 * cube[:, :n] - 1.0)
    own = effect_values(candidate, sizes(candidate, cube[:, n : n + k]), 2.0 * cube[:, n + k :] - 1.0)
    return [
        Run({**values, **{name: float(v[i]) for name, v in own.items()}}, (candidate.name,), seed + i)
        for i, values in enumerate(base)
    ]


def _narrowed(parameter: Parameter, values: Sequence[float]) -> Parameter:
    if parameter.off is None:
        return parameter
    reach = [0.0, *(2.0 * (value - parameter.off) for value in values)]
    margin = 2.0 * parameter.meaningful
    low, high = parameter.off + min(reach) - margin, parameter.off + max(reach) + margin
    low, high = max(low, parameter.lower), min(high, parameter.upper)
    return Parameter(
        **{**vars(parameter), "lower": low, "upper": high, "default": min(max(parameter.default, low), high)}
    )


def _off(parameter: Parameter) -> float:
    assert parameter.off is not None
    return parameter.off
