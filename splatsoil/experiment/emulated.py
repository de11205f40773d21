"""An experiment with an analytic forward model, for tests of model criticism."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from splatsoil.arrays import BoolArray, FloatArray
from splatsoil.experiment.base import Candidate, Run
from splatsoil.experiment.features import Layout
from splatsoil.parameters import Parameter


@dataclass(frozen=True)
class EmulatedExperiment:
    """Features that are known functions of parameters, with scatter and instrument noise of known covariance.

    A prediction is a quadratic function of the parameters about ``home``, plus the scatter of the seed.

    Attributes:
        layout: labels.
        middle: (t, s) features at ``home``.
        home: expansion point of the model's parameters.
        slopes: (t, s) first derivatives by parameter, including those of effects.
        curves: (t, s) second derivatives; 0 if absent.
        parameters: free parameters of the model.
        candidates: effects that are off.
        scatter_root: (t s, t s) lower Cholesky factor of one simulation's scatter.
        sensor: (t, s) standard deviation of the instruments.
        observed: (t, s).
        patterns: (t, s) what another discretisation adds, by name.
        albedo_patterns: (t, s) what another draw of the unknown albedo adds, by name.
        quiet: (t, s) where no physics acts.
        name: for the reader.
    """

    layout: Layout
    middle: FloatArray
    home: Mapping[str, float]
    slopes: Mapping[str, FloatArray]
    parameters: tuple[Parameter, ...]
    candidates: tuple[Candidate, ...]
    scatter_root: FloatArray
    sensor: FloatArray
    observed: FloatArray
    curves: Mapping[str, FloatArray] = field(default_factory=dict)
    patterns: Mapping[str, FloatArray] = field(default_factory=dict)
    albedo_patterns: Mapping[str, FloatArray] = field(default_factory=dict)
    quiet: BoolArray = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    name: str = "emulated"
    model: tuple[str, ...] = ()
    renderings: tuple[str, ...] = ()
    stochastic: bool = True
    sensor_memory: float = 0.0

    def __post_init__(self) -> None:
        if self.quiet.size == 0:
            object.__setattr__(self, "quiet", np.zeros(self.layout.shape, dtype=bool))

    @property
    def seen(self) -> BoolArray:
        """All features."""
        return np.ones(self.layout.shape, dtype=bool)

    @property
    def discretisations(self) -> tuple[str, ...]:
        """Names of the other discretisations."""
        return tuple(self.patterns)

    @property
    def albedo_draws(self) -> tuple[str, ...]:
        """Names of the draws of unknown albedo."""
        return tuple(self.albedo_patterns)

    def expected(self, values: Mapping[str, float], variant: str = "") -> FloatArray:
        """(t, s) features without scatter."""
        out = self.middle.copy()
        off = {p.name: float(p.off or 0.0) for c in self.candidates for p in c.parameters}
        for name, value in values.items():
            step = value - (self.home[name] if name in self.home else off.get(name, 0.0))
            out += step * self.slopes[name]
            if name in self.curves:
                out += 0.5 * step**2 * self.curves[name]
        if variant:
            out += {**self.patterns, **self.albedo_patterns}[variant]
        return out

    def predict(self, run: Run) -> FloatArray:
        """(t, s) features; the same seed gives the same scatter."""
        return self.expected(run.values, run.variant) + self.scatter(run.seed)

    def scatter(self, seed: int | Sequence[int]) -> FloatArray:
        """(t, s) scatter of one seed."""
        generator = np.random.default_rng(seed)
        return (self.scatter_root @ generator.standard_normal(len(self.scatter_root))).reshape(self.layout.shape)

    def measured(self, values: Mapping[str, float], seed: Sequence[int], extra: FloatArray | None = None) -> FloatArray:
        """(t, s) a synthetic observation of known parameters: scatter, instrument noise, and ``extra``."""
        generator = np.random.default_rng([*seed, 1])
        noise = self.sensor * generator.standard_normal(self.layout.shape)
        return self.expected(values) + self.scatter(seed) + noise + (0.0 if extra is None else extra)
