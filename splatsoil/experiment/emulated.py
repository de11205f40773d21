"""An experiment whose predictions cost nothing: patterns instead of a simulation, for measuring criticism itself."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from splatsoil.experiment.base import Candidate
from splatsoil.experiment.features import Layout
from splatsoil.parameters import Parameter

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class EmulatedExperiment:
    """Features that are known functions of parameters, with chance and instruments' noise drawn from known covariances.

    A prediction is the middle, plus each parameter's (and effect's) slope times its distance from home, plus half its
    curve times the square of that, plus chance of the seed.

    Attributes:
        layout: labels.
        middle: (t, s) features at home.
        home: values of the model's parameters there.
        slopes: (t, s) by parameter, effects' included.
        curves: (t, s) likewise; absent ones are 0.
        parameters: free parameters of the model.
        candidates: effects that are off.
        chance_root: (t s, t s) lower Cholesky factor of one simulation's chance.
        sensor: (t, s) standard deviation of the instruments.
        observed: (t, s).
        patterns: (t, s) what other numerics add, by name.
        guessed: (t, s) what other guesses of what no instrument shows add, by name.
        quiet: (t, s) where no physics acts.
        name: for people.
    """

    layout: Layout
    middle: FloatArray
    home: Mapping[str, float]
    slopes: Mapping[str, FloatArray]
    parameters: tuple[Parameter, ...]
    candidates: tuple[Candidate, ...]
    chance_root: FloatArray
    sensor: FloatArray
    observed: FloatArray
    curves: Mapping[str, FloatArray] = field(default_factory=dict)
    patterns: Mapping[str, FloatArray] = field(default_factory=dict)
    guessed: Mapping[str, FloatArray] = field(default_factory=dict)
    quiet: npt.NDArray[np.bool_] = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))
    name: str = "emulated"
    model: tuple[str, ...] = ()
    redrawn: tuple[str, ...] = ()
    chance: bool = True
    sensor_memory: float = 0.0

    def __post_init__(self) -> None:
        if self.quiet.size == 0:
            object.__setattr__(self, "quiet", np.zeros(self.layout.shape, dtype=bool))

    @property
    def seen(self) -> npt.NDArray[np.bool_]:
        """Everything is."""
        return np.ones(self.layout.shape, dtype=bool)

    @property
    def numerics(self) -> tuple[str, ...]:
        """Names of the other numerics."""
        return tuple(self.patterns)

    @property
    def guesses(self) -> tuple[str, ...]:
        """Names of the other guesses."""
        return tuple(self.guessed)

    def expected(self, values: Mapping[str, float], numerics: str = "") -> FloatArray:
        """(t, s) features without chance."""
        out = self.middle.copy()
        off = {p.name: float(p.off or 0.0) for c in self.candidates for p in c.parameters}
        for name, value in values.items():
            step = value - (self.home[name] if name in self.home else off.get(name, 0.0))
            out += step * self.slopes[name]
            if name in self.curves:
                out += 0.5 * step**2 * self.curves[name]
        if numerics:
            out += {**self.patterns, **self.guessed}[numerics]
        return out

    def predict(
        self, values: Mapping[str, float], *, effects: Iterable[str] = (), seed: int = 0, numerics: str = ""
    ) -> FloatArray:
        """(t, s) features; the same seed has the same chance."""
        del effects
        return self.expected(values, numerics) + self.drawn(seed)

    def drawn(self, seed: int | Sequence[int]) -> FloatArray:
        """(t, s) chance of one seed."""
        generator = np.random.default_rng(seed)
        return (self.chance_root @ generator.standard_normal(len(self.chance_root))).reshape(self.layout.shape)

    def measured(self, values: Mapping[str, float], seed: Sequence[int], extra: FloatArray | None = None) -> FloatArray:
        """(t, s) what instruments would report of a truth: its own chance, their noise, and whatever else is there."""
        generator = np.random.default_rng([*seed, 1])
        noise = self.sensor * generator.standard_normal(self.layout.shape)
        return self.expected(values) + self.drawn(seed) + noise + (0.0 if extra is None else extra)
