"""Derivatives by differences: how far parameters and effects are moved, and what that tells."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from splatsoil.experiment.base import Candidate
from splatsoil.parameters import Parameter, distance

FloatArray = npt.NDArray[np.float64]
Run = Callable[..., FloatArray]

STEP = 4.0
"""Steps of derivatives in smallest meaningful sizes."""
REACH = 0.5
"""Most of the way to a bound that such a step may go."""


def around(parameter: Parameter, value: float) -> list[float]:
    """Where a model's parameter is varied to: both sides of its value, or one where a bound is near."""
    whole = distance(parameter, parameter.lower, parameter.upper) / rate(parameter, parameter.lower)
    step = STEP * parameter.meaningful / rate(parameter, value) if parameter.meaningful > 0.0 else 0.05 * whole
    step = min(step, 0.25 * whole)
    ends = [moved(parameter, value, side * step) for side in (-1.0, 1.0)]
    return [end for end in ends if abs(distance(parameter, value, end)) > 0.3 * step * rate(parameter, value)]


def rate(parameter: Parameter, value: float) -> float:
    """How fast a parameter grows along its scale: 1, or the value itself on a logarithmic one."""
    return value if parameter.log else 1.0


def moved(parameter: Parameter, value: float, step: float) -> float:
    """A value moved along its scale (by a logarithm, where that is logarithmic), within the bounds."""
    end = value * math.exp(step) if parameter.log else value + step
    return min(max(end, parameter.lower), parameter.upper)


def ignorance(parameter: Parameter, value: float) -> float:
    """Standard deviation of a parameter of which only the bounds are known, in its unit at a value."""
    whole = distance(parameter, parameter.lower, parameter.upper) / rate(parameter, parameter.lower)
    return whole * rate(parameter, value) / math.sqrt(12.0)


def derivatives(
    offsets: Sequence[float], tables: Sequence[FloatArray], middle: FloatArray
) -> tuple[FloatArray, FloatArray | None]:
    """First derivative and half the second from one or two neighbours."""
    if len(offsets) == 1:
        return (tables[0] - middle) / offsets[0], None
    matrix = np.array([[offset, offset**2] for offset in offsets])
    first, second = np.linalg.solve(matrix, np.stack([(t - middle).reshape(-1) for t in tables]))
    return first.reshape(middle.shape), second.reshape(middle.shape)


def step_of(parameter: Parameter, times: float = 1.0) -> float:
    """How far an effect's parameter is moved from off, in the direction in which there is room; ``times`` as far as
    where nothing is left to chance."""
    off = parameter.off if parameter.off is not None else parameter.default
    room = {1: parameter.upper - off, -1: off - parameter.lower}
    side = parameter.sign or (1 if room[1] >= room[-1] else -1)
    wanted = times * (STEP * parameter.meaningful if parameter.meaningful > 0.0 else 0.1 * room[side])
    return side * min(wanted, REACH * room[side])


def directions_of(
    candidate: Candidate,
    base: Mapping[str, float],
    middle: FloatArray,
    run: Run,
    steps: dict[str, float],
    times: float = 1.0,
    *,
    sides: int = 2,
) -> FloatArray:
    """(k, t, s) derivatives by a candidate's parameters at off, of predictions whose ``middle`` is that without it, by
    steps ``times`` as long as where nothing is left to chance; ``steps`` gets them. Where a parameter has no sign, from
    one or two ``sides``."""
    return np.stack([_slope(candidate, p, base, middle, run, steps, times, sides) for p in candidate.parameters])


def _slope(
    candidate: Candidate,
    parameter: Parameter,
    base: Mapping[str, float],
    middle: FloatArray,
    run: Run,
    steps: dict[str, float],
    times: float,
    sides: int,
) -> FloatArray:
    """Derivative by one parameter of an effect, its others at off."""
    off = {p.name: float(p.off or 0.0) for p in candidate.parameters}
    step = step_of(parameter, times)
    steps[parameter.name] = abs(step)
    tables = []
    # Drawing the same simulation otherwise has no chance in it: one side will do.
    both = (
        sides > 1
        and candidate.kind == "physics"
        and parameter.sign == 0
        and parameter.lower <= off[parameter.name] - step <= parameter.upper
    )
    for offset in (step, -step) if both else (step,):
        at = {**base, **off, parameter.name: off[parameter.name] + offset}
        tables.append(run(f"{candidate.name}: {parameter.name}", at, (candidate.name,)))
    return (tables[0] - tables[1]) / (2.0 * step) if both else (tables[0] - middle) / step
