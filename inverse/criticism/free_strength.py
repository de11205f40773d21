"""A strength of no particular form: friction times a smooth function of pressure, rate and strain.

    tan(phi) = mu0 exp(a_p(log p) + a_I(log I) + a_e(strain))

Each function is a sum of B-splines of degree 1 (hats) over the range that the soil goes through, constant beyond it. It
is no effect of the library: it reads what a missing law looks like, and would explain anything if it were always on.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt
import warp as wp

from splatsoil.experiment.states import States
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.settings import Settings
from splatsoil.soil.strength import SoilState, Strength

FloatArray = npt.NDArray[np.float64]

NODES = wp.constant(5)
"""Hats of each function."""
MOST = 1.5
"""Largest coefficient: a factor of 4.5 on friction."""
GRAIN, GRAIN_DENSITY = 1.0e-3, 2500.0
"""Grain diameter in m and density in kg/m³ of the inertial number I = rate d / sqrt(p / rho)."""
ARGUMENTS = ("pressure", "inertial number", "plastic strain")
SHORT = {"pressure": "pressure", "inertial number": "rate", "plastic strain": "strain"}
LEAST_WIDTH = {"pressure": math.log(1.5), "inertial number": math.log(2.0), "plastic strain": 0.02}
"""Ranges narrower than this (of log p, log I and strain) say nothing of a function's shape."""
TAILS = 0.02
"""Share of the states visited beyond either end of a range."""


@dataclass(frozen=True)
class Range:
    """Where an argument's function lives.

    Attributes:
        argument: one of :data:`ARGUMENTS`.
        low: its coordinate (log Pa, log I or strain) at the first hat.
        high: at the last one.
    """

    argument: str
    low: float
    high: float


def coordinates(states: States) -> dict[str, FloatArray]:
    """(n,) coordinate of each state, by argument."""
    inertial = states.rate * GRAIN * np.sqrt(GRAIN_DENSITY / states.pressure)
    return {
        "pressure": np.log(states.pressure),
        "inertial number": np.log(np.maximum(inertial, 1e-12)),
        "plastic strain": states.strain,
    }


def ranges(states: States) -> tuple[Range, ...]:
    """The arguments of which the soil has seen enough, each from one tail of what it went through to the other.

    The inertial number counts only where it varies at one pressure: at one rate it says what the pressure says.
    """
    out = []
    places = coordinates(states)
    for argument, values in places.items():
        if not values.size:
            continue
        low, high = _between(values, states.weight)
        width = high - low
        if argument == "inertial number":
            alone = np.log(states.rate)
            slowest, fastest = _between(alone, states.weight)
            width = min(width, fastest - slowest)
        if width >= LEAST_WIDTH[argument]:
            out.append(Range(argument, low, high))
    return tuple(out)


def _between(values: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Where the tails of weighted values (n,) begin."""
    order = np.argsort(values)
    reached = np.cumsum(weight[order])
    low, high = (values[order][min(int(np.searchsorted(reached, q)), len(order) - 1)] for q in (TAILS, 1.0 - TAILS))
    return float(low), float(high)


def hats(span: Range, places: FloatArray) -> FloatArray:
    """(n, 5) values of a function's hats at coordinates (n,)."""
    u = np.clip((places - span.low) / (span.high - span.low), 0.0, 1.0) * (NODES - 1)
    return np.maximum(0.0, 1.0 - np.abs(u[:, None] - np.arange(NODES)[None]))


@wp.func
def _height(values: wp.array2d(dtype=float), row: int, column: int, place: float) -> float:
    """A function at a coordinate: low end, 1 / width and the hats' heights stand from ``column`` on."""
    u = wp.clamp((place - values[row, column]) * values[row, column + 1], 0.0, 1.0) * float(NODES - 1)
    k = wp.min(int(u), NODES - 2)
    t = u - float(k)
    return (1.0 - t) * values[row, column + 2 + k] + t * values[row, column + 3 + k]


@wp.func
def free_strength(
    strength: Strength, state: SoilState, values: wp.array2d(dtype=float), row: int, column: int
) -> Strength:
    """Multiply friction by the exponential of three functions."""
    result = strength
    pressure = wp.max(state.pressure, 1.0)
    inertial = state.shear_rate * values[row, column] / wp.sqrt(pressure)
    total = _height(values, row, column + 1, wp.log(pressure))
    total = total + _height(values, row, column + 3 + NODES, wp.log(wp.max(inertial, 1.0e-12)))
    total = total + _height(values, row, column + 5 + 2 * NODES, state.plastic_strain)
    result.slope = strength.slope * wp.exp(wp.clamp(total, -2.0, 2.0))
    return result


class FreeStrength(Effect):
    """Friction times a free function of each argument over its range; see the module."""

    name = "free_strength"
    note = "Friction is a free smooth function of pressure, rate and strain."
    source = "generalised additive model: Hastie & Tibshirani (1990); B-splines: de Boor (1978)"
    strength = free_strength
    parameters: ClassVar[tuple[Parameter, ...]] = ()
    spans: ClassVar[tuple[Range, ...]] = ()

    @property
    def identity(self) -> str:
        """Tells it from free strengths over other ranges."""
        return f"{self.name} {[(s.argument, s.low, s.high) for s in self.spans]}"

    @staticmethod
    def over(spans: Sequence[Range]) -> FreeStrength:
        """The effect with hats over these ranges."""

        class Over(FreeStrength):
            parameters = tuple(
                Parameter(f"strength_{SHORT[s.argument]}_{k + 1}", "1", -MOST, MOST, 0.0, off=0.0, meaningful=0.05)
                for s in spans
                for k in range(NODES)
            )

        Over.spans = tuple(spans)
        return Over()

    def columns(self, settings: Settings, values: Mapping[str, float]) -> Sequence[float]:
        """Constant of the inertial number; for each argument the low end, 1 / width, and heights of the hats."""
        del settings
        known = {span.argument: span for span in self.spans}
        out = [GRAIN * math.sqrt(GRAIN_DENSITY)]
        for argument in ARGUMENTS:
            span = known.get(argument)
            if span is None:
                out += [0.0, 0.0, *(0.0 for _ in range(NODES))]
                continue
            heights = (values[f"strength_{SHORT[argument]}_{k + 1}"] for k in range(NODES))
            out += [span.low, 1.0 / (span.high - span.low), *heights]
        return out
