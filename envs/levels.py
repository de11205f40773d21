"""A problem at two resolutions: the one that counts, and a coarser one that costs less.

The level is one more parameter, so that whatever records, replays or plays a problem does it with this one, too.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from splatsoil.errors import ParameterError
from splatsoil.parameters import Parameter, ParameterSpace

from .problem import Evaluation, Problem, WrappedProblem

if TYPE_CHECKING:
    from splatsoil.mpm import Resolution

#: Evaluates parameters (by name) with a seed.
Evaluate = Callable[[Mapping[str, float], int], Evaluation]

#: 1: the resolution that counts, 0: the coarse one; what lies between goes to the nearer.
FIDELITY = Parameter("fidelity", "1", 0.0, 1.0, 1.0)

#: Share of an evaluation that is drawing and comparing, alike at both resolutions: 3.7 of 16.8 s on `plow-dry`, preset
#: `small`, on one core. With `tiny` beside it that makes 0.24, and 4.0 s were measured.
DRAWING = 0.22


class TwoLevelProblem(WrappedProblem):
    """Simulate-and-compare with ``fidelity`` as the last parameter.

    Both levels are compared with the same observation.

    Args:
        fine: the problem that counts. Its method ``cheaper(preset)`` gives the evaluation at a coarser preset, and
            that one's cost in units of its own.
        coarse: name of the preset of the cheap simulation.

    Raises:
        ParameterError: a preset that is unknown or no cheaper, or a problem without a coarse likeness.
    """

    def __init__(self, fine: Problem, coarse: str) -> None:
        super().__init__(fine)
        self.coarse = coarse
        self._space = ParameterSpace([*fine.space, FIDELITY])
        cheaper = getattr(fine, "cheaper", None)
        if cheaper is None:
            raise ParameterError(f"{type(fine).__name__} has no coarse likeness; leave the coarse preset out")
        self._cheap: Evaluate
        self._cheap, self.cost = cheaper(coarse)

    @property
    def space(self) -> ParameterSpace:
        """The free parameters, and the level."""
        return self._space

    def evaluate(self, parameters: Mapping[str, float], seed: int) -> Evaluation:
        """Simulate at the level that ``fidelity`` names, and compare.

        Raises:
            SimulationError: the simulation could not go on.
        """
        values = {name: value for name, value in parameters.items() if name != FIDELITY.name}
        full = is_full(parameters)
        began = time.perf_counter()
        evaluation = self.inner.evaluate(values, seed) if full else self._cheap(values, seed)
        return replace(
            evaluation,
            seconds=time.perf_counter() - began,
            extras={**evaluation.extras, "cost": 1.0 if full else self.cost},
        )


def is_full(parameters: Mapping[str, float]) -> bool:
    """Whether an evaluation was made at the resolution that counts."""
    return parameters.get(FIDELITY.name, FIDELITY.default) >= 0.5


def relative_cost(fine: Resolution, coarse: Resolution) -> float:
    """Cost of an evaluation with a coarser simulation, in units of one with the finer: work goes with particles and
    steps, drawing stays.

    Raises:
        ParameterError: it is no cheaper.
    """
    ratio = (fine.spacing / coarse.spacing) ** 3 * (coarse.steps / fine.steps)
    if ratio >= 1.0:
        raise ParameterError("the coarse preset is no cheaper than the fit's own; choose a coarser one")
    return DRAWING + (1.0 - DRAWING) * ratio
