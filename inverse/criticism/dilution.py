"""Regression dilution: derivatives of simulations hold chance, and chance looks like information.

Sizes read along such derivatives come out too small, and as if they were known too well. Two seeds tell how much of the
information is chance: their derivatives' mean has as much of it as half their difference, which has nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from .evidence import Vantage
from .noise import Noise

FloatArray = npt.NDArray[np.float64]


def reliable(information: FloatArray, chance: FloatArray) -> FloatArray:
    """(k,) share of an information (k,) that isn't chance (k,).

    A derivative times that share is what is expected of it (regression calibration: Carroll et al. 2006, Measurement
    Error in Nonlinear Models, ch. 4): sizes come out right, known as well as they are, and their z stays.
    """
    return np.clip(1.0 - chance / np.maximum(information, 1e-300), 0.0, 1.0)


def informed(whole: FloatArray, chance: FloatArray) -> FloatArray:
    """(k, k) information of parameters together, by derivatives of whose own (k, k) a part is chance (Fuller 1987,
    Measurement Error Models, sec. 1.2)."""
    left = whole - chance
    values, vectors = np.linalg.eigh(0.5 * (left + left.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def undiluted(vantage: Vantage, noise: Noise, nuisance: FloatArray) -> Vantage:
    """The same predictions, every derivative of which doubts are known times its reliability under a noise with
    nuisances (n, q)."""
    solver = noise.solver.beside(nuisance)

    def scaled(tables: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        out = dict(tables)
        for name in tables.keys() & vantage.doubts.keys():
            size, chance = (
                np.sum(solver.whiten(np.moveaxis(table, (-2, -1), (0, 1))[noise.seen]) ** 2, axis=0)
                for table in (tables[name], vantage.doubts[name])
            )
            out[name] = reliable(size, chance)[..., None, None] * tables[name]
        return out

    return replace(vantage, slopes=scaled(vantage.slopes), directions=scaled(vantage.directions))
