"""Features: a low-dimensional table (times, sites) of what an experiment's instruments saw."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Site:
    """Where one column of a feature table was taken.

    Attributes:
        channel: the instrument (a camera's name, ``force z``, ``volume strain``).
        x: place in m; NaN for an instrument that has none.
        y: place in m; NaN for an instrument that has none.
        unit: of its readings; empty for the layout's.
        reading: increasing function from features to what the instrument reads; None where they are the same.
        outline: corners in the channel's undistorted picture, as shares of its width and height; empty where there is
            none.
    """

    channel: str
    x: float = math.nan
    y: float = math.nan
    unit: str = ""
    reading: Callable[[npt.NDArray[np.float64]], npt.NDArray[np.float64]] | None = None
    outline: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, eq=False)
class Layout:
    """Labels of a feature table; the same only as itself.

    Attributes:
        times: (t,) what orders the rows (frame numbers, strains, depths), increasing.
        sites: (s,) the columns.
        time_name: what ``times`` are ("frame", "axial strain").
        unit: of the features ("grey levels", "1"), sites that have one of their own aside.
        stages: (t,) the part of the experiment that each row belongs to ("pushing").
        regions: (t, s) the part of the scene that each feature shows ("trench").
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
    def common(self) -> npt.NDArray[np.bool_]:
        """(s,) sites in the layout's unit."""
        return np.array([site.unit in ("", self.unit) for site in self.sites])

    @cached_property
    def placed(self) -> npt.NDArray[np.bool_]:
        """(s,) sites that have a place."""
        return np.array([math.isfinite(site.x) and math.isfinite(site.y) for site in self.sites])
