"""What a posterior says of one parameter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from splatsoil.parameters import Parameter, ParameterSpace

from .criticism.evidence import Evidence

FloatArray = npt.NDArray[np.float64]

BESIDE, CROWDED = 0.05, 0.10
"""A bound is reached where this share of the axis beside it holds more than twice its share of the posterior."""


@dataclass(frozen=True, eq=False)
class Marginal:
    """Weighted draws of a parameter.

    Attributes:
        parameter: which.
        values: (k,) in its unit.
        weights: (k,) that sum to 1.
    """

    parameter: Parameter
    values: FloatArray
    weights: FloatArray

    @classmethod
    def of(cls, parameter: Parameter, evidence: Evidence) -> Marginal:
        """Averaged over models by their probability."""
        models = evidence.models
        weights = [evidence.probability[name] * model.weights.sum(axis=0) for name, model in models.items()]
        values = [model.values[parameter.name] for model in models.values()]
        return cls(parameter, np.concatenate(values), np.concatenate(weights))

    @property
    def mean(self) -> float:
        """Mean."""
        return float(self.weights @ self.values)

    @property
    def std(self) -> float:
        """Standard deviation."""
        return float(np.sqrt(self.weights @ (self.values - self.mean) ** 2))

    def quantile(self, share: float) -> float:
        """The value below which a share of the weight lies."""
        order = np.argsort(self.values)
        index = np.searchsorted(np.cumsum(self.weights[order]), share * self.weights.sum())
        return float(self.values[order][min(int(index), len(order) - 1)])

    @property
    def at_bounds(self) -> list[Literal["lower", "upper"]]:
        """Bounds of the parameter's range that the posterior crowds at."""
        unit = ParameterSpace([self.parameter]).to_unit(self.values[:, None])[:, 0]
        edge = 1.0 - 2.0 * BESIDE
        near: dict[Literal["lower", "upper"], npt.NDArray[np.bool_]] = {"lower": unit < -edge, "upper": unit > edge}
        return [bound for bound, beside in near.items() if float(self.weights @ beside) > CROWDED]
