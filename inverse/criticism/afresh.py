"""A second look, from soil as one would guess it: the fit may have been led astray.

Soil that is viscous, or sticks together, drives the friction angle of a model without that effect far off, up to its
bound. There the derivatives are those of another regime, and the effect that is missing looks like nothing in
particular. From the law's defaults it stands out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt
from scipy.optimize import lsq_linear

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate, Experiment
from splatsoil.parameters import Parameter

from .evidence import Evidence, Vantage, around, look_from
from .misfit import Omnibus
from .sight import Sight
from .simulations import Simulations
from .verdicts import GATE

FloatArray = npt.NDArray[np.float64]


def look_afresh(experiment: Experiment, evidence: Evidence, misfit: Omnibus, simulate: Simulations) -> Vantage | None:
    """The soil's own parameters at their defaults, those of effects as fitted; effects of physics switched on there.

    None where nothing says that the fit was led astray (no misfit on slow waves, and no bound reached), where the fit
    lies near the defaults, or where these can't be simulated.
    """
    bound = any(len(around(p, evidence.values[p.name])) == 1 for p in experiment.parameters)
    own = {p.name: p.default for p in experiment.parameters if p.off is None}
    far = any(abs(evidence.values[name] - value) > evidence.widths[name] for name, value in own.items())
    if not far or not (bound or misfit.p < GATE):
        return None
    there = {**evidence.values, **own}
    candidates = [c for c in experiment.candidates if c.kind == "physics" and c.name in evidence.directions]

    def look(ask: Callable[..., FloatArray]) -> Vantage:
        def run(purpose: str, at: Mapping[str, float], effects: tuple[str, ...] = ()) -> FloatArray:
            return ask(at, effects=effects, purpose=f"from the defaults: {purpose}")

        return look_from(experiment, there, candidates, run)

    simulate.ahead(look)
    try:
        return look(simulate)
    except SimulationError:
        return None


def promising(
    experiment: Experiment,
    vantage: Vantage,
    sight: Sight,
    candidates: Sequence[Candidate],
    price: Callable[[Candidate], float],
) -> list[str]:
    """Names of the effects that would explain most from there, for their parameters; the best first.

    Least squares within the bounds, over the model's parameters and one effect's at a time; effects that bring less
    than their price are left out.
    """
    target = sight(experiment.observed - vantage.prediction)
    model = np.stack([sight(vantage.slopes[p.name]) for p in experiment.parameters], axis=-1)

    def chi2(columns: FloatArray, free: Sequence[Parameter]) -> float:
        at = np.array([vantage.values.get(p.name, p.off if p.off is not None else p.default) for p in free])
        lower, upper = (np.array([getattr(p, side) for p in free]) for side in ("lower", "upper"))
        span = upper - lower
        room = np.minimum((lower - at) / span, 0.0), np.maximum((upper - at) / span, 1e-9)
        return 2.0 * float(lsq_linear(columns * span, target, bounds=room).cost)

    alone = chi2(model, experiment.parameters)
    costs = {}
    for candidate in candidates:
        if candidate.name not in vantage.directions:
            continue
        added = np.stack([sight(table) for table in vantage.directions[candidate.name]], axis=-1)
        free = (*experiment.parameters, *candidate.parameters)
        costs[candidate.name] = chi2(np.concatenate([model, added], axis=-1), free) + price(candidate)
    return sorted((name for name, cost in costs.items() if cost < alone), key=lambda name: costs[name])
