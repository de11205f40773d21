"""Parameters of law, effects and observation; maps between dictionaries, vectors and the unit cube."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatsoil.arrays import FloatArray
from splatsoil.errors import ParameterError


@dataclass(frozen=True)
class Parameter:
    """A parameter of a model.

    Attributes:
        name: identifier, unique among all parameters of a model (``friction_angle``).
        unit: SI unit, or ``deg`` for angles, or ``1`` for a pure number.
        lower: lower bound of search and prior, in ``unit``.
        upper: upper bound, likewise.
        default: value of a parameter that is not free.
        off: value at which an effect's parameter has no influence; None for base parameters and for shape parameters.
        meaningful: smallest meaningful change, in ``unit``.
        log: search on a logarithmic scale (needs ``lower > 0``).
        sign: +1 or -1 if physics allows one direction from ``off`` only, else 0.
        label: for figures.
        limits: values that a model accepts, if wider than the bounds.
    """

    name: str
    unit: str
    lower: float
    upper: float
    default: float
    off: float | None = None
    meaningful: float = 0.0
    log: bool = False
    sign: int = 0
    label: str = ""
    limits: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.lower) and math.isfinite(self.upper) and self.lower < self.upper):
            raise ParameterError(f"parameter {self.name}: bounds [{self.lower}, {self.upper}] are not an interval")
        if self.log and self.lower <= 0.0:
            raise ParameterError(f"parameter {self.name}: a logarithmic scale needs a positive lower bound")
        if not self.lower <= self.default <= self.upper:
            raise ParameterError(
                f"parameter {self.name}: default {self.default} lies outside [{self.lower}, {self.upper}]"
            )

    @property
    def title(self) -> str:
        """Label with unit, for axes and tables."""
        text = self.label or self.name.replace("_", " ")
        return text if self.unit == "1" else f"{text} [{'°' if self.unit == 'deg' else self.unit}]"

    def check(self, value: float) -> float:
        """Return ``value`` as a float, or raise ParameterError when it is not finite or outside limits (or bounds)."""
        number = float(value)
        if not math.isfinite(number):
            raise ParameterError(f"parameter {self.name}: {value} is not a finite number")
        lower, upper = self.limits or (self.lower, self.upper)
        slack = 1e-9 * (upper - lower)
        if not lower - slack <= number <= upper + slack:
            raise ParameterError(f"parameter {self.name}: {number:g} {self.unit} lies outside [{lower:g}, {upper:g}]")
        return min(max(number, lower), upper)


def distance(parameter: Parameter, value: float, end: float) -> float:
    """From a value to another along the parameter's scale, in its unit at the value."""
    return value * math.log(end / value) if parameter.log else end - value


class ParameterSpace:
    """An ordered set of free parameters: dictionaries <-> vectors in physical units <-> vectors in [-1, 1]."""

    def __init__(self, parameters: Iterable[Parameter]) -> None:
        self.parameters: tuple[Parameter, ...] = tuple(parameters)
        if not self.parameters:
            raise ParameterError("a parameter space needs at least one free parameter")
        if len(set(self.names)) != len(self.parameters):
            raise ParameterError(f"parameter names repeat: {', '.join(self.names)}")

    def __len__(self) -> int:
        return len(self.parameters)

    def __iter__(self) -> Iterator[Parameter]:
        return iter(self.parameters)

    @property
    def names(self) -> tuple[str, ...]:
        """Names, in the order of the vector."""
        return tuple(p.name for p in self.parameters)

    def to_vector(self, values: Mapping[str, float]) -> FloatArray:
        """Values by name to a vector (n,) in physical units; every name must be given, bounds are checked."""
        missing = [n for n in self.names if n not in values]
        if missing:
            raise ParameterError(f"no value given for {', '.join(missing)}")
        return np.array([p.check(values[p.name]) for p in self.parameters])

    def to_dict(self, vector: npt.ArrayLike) -> dict[str, float]:
        """A vector (n,) in physical units to values by name; bounds are checked."""
        flat = np.asarray(vector, dtype=np.float64).reshape(-1)
        if flat.shape != (len(self),):
            raise ParameterError(f"expected {len(self)} values ({', '.join(self.names)}), got {flat.size}")
        return {p.name: p.check(float(v)) for p, v in zip(self.parameters, flat, strict=True)}

    def from_unit(self, unit: npt.ArrayLike) -> FloatArray:
        """A point (..., n) of [-1, 1]^n (clipped to it) to physical units."""
        t = 0.5 * (np.clip(np.asarray(unit, dtype=np.float64), -1.0, 1.0) + 1.0)
        lower, upper = self._scaled_bounds()
        return self._unscale(lower + t * (upper - lower))

    def to_unit(self, vector: npt.ArrayLike) -> FloatArray:
        """A point (..., n) in physical units to [-1, 1]^n."""
        lower, upper = self._scaled_bounds()
        scaled = self._scale(np.asarray(vector, dtype=np.float64))
        return 2.0 * (scaled - lower) / (upper - lower) - 1.0

    def _scaled_bounds(self) -> tuple[FloatArray, FloatArray]:
        lower = self._scale(np.array([p.lower for p in self.parameters]))
        upper = self._scale(np.array([p.upper for p in self.parameters]))
        return lower, upper

    def _scale(self, vector: FloatArray) -> FloatArray:
        out = np.array(vector, dtype=np.float64)
        for i, p in enumerate(self.parameters):
            if p.log:
                out[..., i] = np.log(out[..., i])
        return out

    def _unscale(self, vector: FloatArray) -> FloatArray:
        out = np.array(vector, dtype=np.float64)
        for i, p in enumerate(self.parameters):
            if p.log:
                out[..., i] = np.exp(out[..., i])
            out[..., i] = np.clip(out[..., i], p.lower, p.upper)
        return out
