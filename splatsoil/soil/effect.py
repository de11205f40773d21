"""The interface of effects: parameters, and where an effect may act."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from splatsoil.measurement import Measurement
from splatsoil.observation import Observation
from splatsoil.parameters import FloatArray, Parameter
from splatsoil.soil.settings import Settings


class Effect:
    """One piece of physics that can be off or on. A new effect is one subclass in one file of its own.

    An effect acts in one or several of these ways:

    * ``settings`` changes the numbers a run starts from: contact friction, gravity, friction angle.
    * ``strength`` is a ``@wp.func`` called at every stress point in every step. It receives the
      :class:`~splatsoil.soil.strength.Strength` found so far, the :class:`~splatsoil.soil.strength.SoilState`, the
      array of values (simulations, columns), the row of this simulation and the effect's first column, and returns the
      changed Strength. It is compiled only into models that have the effect on. ``columns`` says what stands in the
      effect's columns: its parameters, or what is made of them once (a tangent instead of an angle).
    * ``density`` gives the soil another weight at the start.
    * ``observe`` changes what the cameras report of a simulation. An effect that has it does nothing else, so that its
      parameters never cost a simulation.

    Attributes:
        name: identifier used by the command line and every file.
        parameters: the effect's parameters. The first is its size: at its ``off`` value the effect does nothing. Others
            have an ``off`` value too where they act on their own, and None where they only shape the effect.
        shapes: names of those that only shape it and that data can tell once it is on: diagnoses and ``add`` free them.
            Not for an effect that observes.
        note: what it is, in one or two sentences.
        source: paper or textbook with equation.
        conflicts: effects that cannot be on at the same time, with the reason.
        numerical: whether it changes what other numerics change: diagnoses allow for these, and can't tell it.
        laboratory: whether tests of a laboratory are needed to tell it from others: diagnoses of photographs consider
            it by name only.
    """

    name: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    shapes: ClassVar[tuple[str, ...]] = ()
    note: ClassVar[str] = ""
    source: ClassVar[str] = ""
    strength: ClassVar[Any | None] = None
    conflicts: ClassVar[Mapping[str, str]] = {}
    numerical: ClassVar[bool] = False
    laboratory: ClassVar[bool] = False

    @property
    def observes(self) -> bool:
        """Whether it changes what the cameras report, and so no simulation."""
        return type(self).observe is not Effect.observe

    @property
    def size(self) -> str:
        """Name of the parameter that measures the effect."""
        return self.parameters[0].name

    def settings(self, settings: Settings, values: Mapping[str, float]) -> Settings:
        """Return ``settings`` changed by this effect with parameter ``values``; unchanged by default."""
        del values
        return settings

    def columns(self, settings: Settings, values: Mapping[str, float]) -> Sequence[float]:
        """Numbers that ``strength`` finds from its column on; the parameters' values by default. Always as many.

        Args:
            settings: of this simulation, after all effects.
            values: all parameters of the model by name.

        Raises:
            CombinationError: values that have no meaning together.
        """
        del settings
        return [values[p.name] for p in self.parameters]

    def density(self, depth: FloatArray, values: Mapping[str, float]) -> FloatArray:
        """Bulk density (n,) over the nominal one, at depths (n,) in m below the surface at the start; 1 by default."""
        del values
        return np.ones_like(depth)

    def observe(self, observation: Observation, values: Mapping[str, float]) -> Observation:
        """Return ``observation`` changed by this effect with parameter ``values``; unchanged by default."""
        del values
        return observation

    def for_measurement(self, measurement: Measurement) -> Effect:
        """The effect as a measurement set needs it, where its parameters depend on that; itself by default."""
        del measurement
        return self

    def bounded(self, bounds: Mapping[str, tuple[float, float]]) -> Effect:
        """The effect with other bounds of search and prior for some parameters; what it takes at all stays."""

        def parameter(p: Parameter) -> Parameter:
            if p.name not in bounds:
                return p
            lower, upper = bounds[p.name]
            default = min(max(p.default, lower), upper)
            return replace(p, lower=lower, upper=upper, default=default, limits=p.limits or (p.lower, p.upper))

        own: dict[str, Any] = {
            "__module__": type(self).__module__,
            "parameters": tuple(map(parameter, self.parameters)),
        }
        made: Effect = type(type(self).__name__, (type(self),), own)()
        return made
