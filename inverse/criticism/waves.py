"""Slow waves over time and place: what effects and misfits look like, whatever they are."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from splatsoil.experiment.features import Layout, Site

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

WAVES_IN_TIME = 4
WAVES_IN_SPACE = 3
"""Slow waves in each direction: what effects look like, where the noise must be known best."""


def smooth_waves(layout: Layout, seen: BoolArray) -> FloatArray:
    """(n, k) slow waves over time, and over the plane for each instrument; orthonormal columns, which are shared and
    can't be written to."""
    return _waves(len(layout.times), layout.sites, seen.tobytes())


@lru_cache(maxsize=16)
def _waves(times: int, sites: tuple[Site, ...], seen: bytes) -> FloatArray:
    """The same, made once: noise is told of the same features again and again."""
    rows = _cosines(np.linspace(0.0, 1.0, times), min(WAVES_IN_TIME, times))
    channel = np.array([site.channel for site in sites])
    columns = []
    for name in dict.fromkeys(site.channel for site in sites):
        mine = channel == name
        place = np.array([[site.x, site.y] for site in sites])[mine]
        if mine.sum() == 1 or not np.isfinite(place).all():
            waves = np.ones((int(mine.sum()), 1))
        else:
            low, high = place.min(axis=0), place.max(axis=0)
            unit = (place - low) / np.maximum(high - low, 1e-9)
            along, across = (_cosines(unit[:, i], WAVES_IN_SPACE if high[i] > low[i] else 1) for i in (0, 1))
            waves = (along[:, :, None] * across[:, None, :]).reshape(int(mine.sum()), -1)
        wide = np.zeros((len(sites), waves.shape[1]))
        wide[mine] = waves
        columns.append(wide)
    space = np.concatenate(columns, axis=1)
    table = (rows[:, None, :, None] * space[None, :, None, :]).reshape(times * len(sites), -1)
    left, singular, _ = np.linalg.svd(table[np.frombuffer(seen, dtype=bool)], full_matrices=False)
    out = left[:, singular > 1e-6 * singular[0]]
    out.flags.writeable = False
    return out


def _cosines(unit: FloatArray, count: int) -> FloatArray:
    return np.cos(np.pi * unit[:, None] * np.arange(count)[None])
