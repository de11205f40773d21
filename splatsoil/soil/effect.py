"""The plug: what an effect is, and where it may act."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from splatsoil.measurement import Measurement
from splatsoil.observation import Observation
from splatsoil.parameters import Parameter
from splatsoil.soil.settings import Settings


class Effect:
    """One piece of physics that can be off or on. A new effect is one subclass in one file of its own.

    An effect acts in one or several of these ways:

    * ``settings`` changes the numbers a run starts from: contact friction, gravity, friction angle.
    * ``strength`` is a ``@wp.func`` called at every stress point in every step. It receives the
      :class:`~splatsoil.soil.strength.Strength` found so far, the :class:`~splatsoil.soil.strength.SoilState`, the
      array of parameter values (simulations, columns), the row of this simulation and the column of the effect's first
      parameter, and returns the changed Strength. It is compiled only into models that have the effect on.
    * ``observe`` changes what the cameras report of a simulation. An effect that has it does nothing else, so that its
      parameters never cost a simulation.

    Attributes:
        name: identifier used by the command line and every file.
        parameters: the effect's parameters, each with the value at which it is off.
        note: what it is, in one or two sentences.
        source: paper or textbook with equation.
    """

    name: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    note: ClassVar[str] = ""
    source: ClassVar[str] = ""
    strength: ClassVar[Any | None] = None

    def settings(self, settings: Settings, values: Mapping[str, float]) -> Settings:
        """Return ``settings`` changed by this effect with parameter ``values``; unchanged by default."""
        del values
        return settings

    def observe(self, observation: Observation, values: Mapping[str, float]) -> Observation:
        """Return ``observation`` changed by this effect with parameter ``values``; unchanged by default."""
        del values
        return observation

    def for_measurement(self, measurement: Measurement) -> Effect:
        """The effect as a measurement set needs it, where its parameters depend on that; itself by default."""
        del measurement
        return self
