"""Features: a table (times, sites) of measurements, and its labels."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from splatsoil.arrays import BoolArray, FloatArray


@dataclass(frozen=True)
class Site:
    """One column of a feature table.

    Attributes:
        channel: the instrument (a camera's name, ``force z``, ``volume strain``).
        x: position in m; NaN for an instrument without a place.
        y: likewise.
        unit: of the readings; empty for the layout's.
        reading: increasing function from features to readings; None for the identity.
        outline: corners in the undistorted picture, as shares of its width and height; empty for none.
    """

    channel: str
    x: float = math.nan
    y: float = math.nan
    unit: str = ""
    reading: Callable[[FloatArray], FloatArray] | None = None
    outline: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, eq=False)
class Layout:
    """Labels of a feature table.

    Attributes:
        times: (t,) increasing: frame numbers, strains, depths.
        sites: (s,) the columns.
        time_name: name of ``times`` ("frame", "axial strain").
        unit: of the features ("grey levels", "1"), except for sites with their own.
        stages: (t,) stage of each row ("pushing").
        regions: (t, s) region of each feature ("trench").
    """

    times: tuple[float, ...]
    sites: tuple[Site, ...]
    time_name: str
    unit: str
    stages: tuple[str, ...]
    regions: npt.NDArray[np.str_]

    def __post_init__(self) -> None:
        if len(self.stages) != len(self.times) or self.regions.shape != self.shape:
            raise ValueError("stages and regions must match times and sites")
        if any(b <= a for a, b in zip(self.times, self.times[1:], strict=False)):
            raise ValueError("times must increase")

    @property
    def shape(self) -> tuple[int, int]:
        """(times, sites)."""
        return len(self.times), len(self.sites)

    @property
    def channels(self) -> tuple[str, ...]:
        """The instruments, in the order of their first site."""
        return tuple(dict.fromkeys(site.channel for site in self.sites))

    @cached_property
    def common(self) -> BoolArray:
        """(s,) sites in the layout's unit."""
        return np.array([site.unit in ("", self.unit) for site in self.sites])

    @cached_property
    def placed(self) -> BoolArray:
        """(s,) sites with a place."""
        return np.array([math.isfinite(site.x) and math.isfinite(site.y) for site in self.sites])
