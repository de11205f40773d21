"""The interface of an experiment to fits and model criticism."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

from splatsoil.arrays import BoolArray, FloatArray
from splatsoil.experiment.features import Layout
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect


@dataclass(frozen=True)
class Run:
    """One simulation of an experiment.

    Attributes:
        values: parameters by name, including those of ``effects``.
        effects: candidates to switch on, by name.
        seed: of the simulation's random numbers.
        variant: one of the experiment's ``discretisations``, ``renderings`` or ``albedo_draws``; empty for the standard
            simulation.
    """

    values: Mapping[str, float]
    effects: tuple[str, ...] = ()
    seed: int = 0
    variant: str = ""

    @property
    def label(self) -> str:
        """Effects or variant, for progress messages."""
        return ", ".join(self.effects) or self.variant or "base model"


@dataclass(frozen=True)
class Candidate:
    """An effect that is off and could be on.

    Attributes:
        name: the effect's.
        kind: ``observation`` if it changes only the observation, else ``physics``.
        parameters: those with an off value.
        size: name of the parameter that is its size.
        note: description.
        shapes: parameters that act only while the effect is on, and that data can determine then.
    """

    name: str
    kind: Literal["physics", "observation"]
    parameters: tuple[Parameter, ...]
    size: str
    note: str = ""
    shapes: tuple[Parameter, ...] = ()

    def __post_init__(self) -> None:
        if self.size not in {p.name for p in self.parameters}:
            raise ValueError(f"{self.name}: its size {self.size} is not a parameter with an off value")

    @property
    def measure(self) -> Parameter:
        """The parameter that is its size."""
        return next(p for p in self.parameters if p.name == self.size)


class Experiment(Protocol):
    """Observed features, their noise, and predictions.

    Attributes:
        name: for the reader.
        layout: labels of the features.
        observed: (t, s) features; arbitrary where ``seen`` is False.
        seen: (t, s) whether there is an observation (the tool can hide it).
        quiet: (t, s) True where no physics of the model acts, so that residuals are instrument noise.
        sensor: (t, s) standard deviation of the instruments' noise.
        sensor_memory: its correlation between neighbouring times, in [0, 1).
        parameters: free parameters of the model.
        model: names of the effects that are on.
        candidates: effects that are off.
        discretisations: names of finer discretisations of the same physics.
        renderings: names of other renderings of the same simulation.
        albedo_draws: names of random draws of the albedo of buried soil, which no photograph shows.
        stochastic: True where another seed gives another prediction.
    """

    @property
    def name(self) -> str: ...
    @property
    def layout(self) -> Layout: ...
    @property
    def observed(self) -> FloatArray: ...
    @property
    def seen(self) -> BoolArray: ...
    @property
    def quiet(self) -> BoolArray: ...
    @property
    def sensor(self) -> FloatArray: ...
    @property
    def sensor_memory(self) -> float: ...
    @property
    def parameters(self) -> tuple[Parameter, ...]: ...
    @property
    def model(self) -> tuple[str, ...]: ...
    @property
    def candidates(self) -> tuple[Candidate, ...]: ...
    @property
    def discretisations(self) -> tuple[str, ...]: ...
    @property
    def renderings(self) -> tuple[str, ...]: ...
    @property
    def albedo_draws(self) -> tuple[str, ...]: ...
    @property
    def stochastic(self) -> bool: ...

    def predict(self, run: Run) -> FloatArray:
        """(t, s) predicted features.

        Raises:
            SimulationError: the simulation failed.
        """


def candidate_of(effect: Effect) -> Candidate | None:
    """The candidate of an effect; None if none of its parameters has an off value."""
    testable = tuple(p for p in effect.parameters if p.off is not None)
    if not testable:
        return None
    kind: Literal["physics", "observation"] = "observation" if effect.observes else "physics"
    shapes = tuple(p for p in effect.parameters if p.name in effect.shapes)
    return Candidate(effect.name, kind, testable, effect.size, effect.note, shapes)


def candidates_of(effects: Iterable[Effect], on: Iterable[Effect]) -> tuple[Candidate, ...]:
    """Candidates for a model with some effects on: effects that are off and compatible with these."""
    present = list(on)
    names = {effect.name for effect in present}
    excluded = {other for effect in present for other in effect.conflicts}
    free = (e for e in effects if e.name not in names | excluded and not names & set(e.conflicts))
    return tuple(c for c in map(candidate_of, free) if c is not None)
