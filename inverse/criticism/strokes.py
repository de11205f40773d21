"""Which stroke would tell effects of one class apart? The one in which their traces are least alike."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate, Experiment
from splatsoil.experiment.strokes import MEASURED, Predict, Stroked

from .derivatives import around, step_of

FloatArray = npt.NDArray[np.float64]

MOST_MEMBERS = 3
"""Effects of a class, the best ones, that are told apart."""
BETTER = 0.1
"""By how much a correlation must be smaller for a stroke to be worth a suggestion."""
FAINT = 9.0
"""χ² of a trace that noise hides: effects of which no more is left cannot be told apart."""


@dataclass(frozen=True)
class StrokeAdvice:
    """How alike two effects are in each stroke.

    Attributes:
        pair: the effects.
        alike: size of the correlation of their traces by stroke, what the model's parameters can take up taken out.
        best: the stroke that tells them apart best; empty where none does better than the measured one.
    """

    pair: tuple[str, str]
    alike: Mapping[str, float]
    best: str


def advise(
    experiment: Experiment,
    values: Mapping[str, float],
    members: Sequence[Candidate],
    *,
    progress: Callable[[float], None] | None = None,
) -> tuple[StrokeAdvice, ...]:
    """Advice for each pair of a class; none where the experiment has no strokes.

    Args:
        experiment: with strokes, see :class:`~splatsoil.experiment.strokes.Stroked`.
        values: the model's parameters and, where they are known, the effects'.
        members: of the class.
        progress: called with the share done.
    """
    if len(members) < 2 or not isinstance(experiment, Stroked):
        return ()
    chosen = [m for m in members if m.kind == "physics"][:MOST_MEMBERS]
    told, strokes = progress or (lambda share: None), experiment.strokes()
    tables: dict[str, dict[str, FloatArray]] = {}
    for done, (name, predict) in enumerate(strokes.items()):
        told(done / len(strokes))
        try:
            tables[name] = _traces(experiment, values, chosen, predict)
        except SimulationError:
            continue
    out = []
    for a, b in itertools.combinations([c.name for c in chosen], 2):
        alike = {name: _alike(traces[a], traces[b]) for name, traces in tables.items()}
        if MEASURED not in alike:
            continue
        best = min(alike, key=lambda name: alike[name])
        worth = alike[best] < alike[MEASURED] - BETTER
        out.append(StrokeAdvice((a, b), alike, best if worth else ""))
    return tuple(out)


def _traces(
    experiment: Experiment, values: Mapping[str, float], members: Sequence[Candidate], predict: Predict
) -> dict[str, FloatArray]:
    """(n,) what each effect changes in a stroke that the model's parameters cannot."""
    base = {p.name: values[p.name] for p in experiment.parameters}
    middle = predict(base, ())
    columns = []
    for parameter in experiment.parameters:
        end = around(parameter, base[parameter.name])[0]
        columns.append(predict({**base, parameter.name: end}, ()) - middle)
    basis, _ = np.linalg.qr(np.stack(columns, axis=1))
    out = {}
    for candidate in members:
        measure = candidate.measure
        off = {p.name: float(p.off or 0.0) for p in candidate.parameters}
        size = values.get(measure.name, off[measure.name])
        if abs(size - off[measure.name]) < measure.meaningful:
            size = off[measure.name] + step_of(measure)
        shapes = {p.name: values[p.name] for p in candidate.shapes if p.name in values}
        trace = predict({**base, **off, **shapes, measure.name: size}, (candidate.name,)) - middle
        out[candidate.name] = trace - basis @ (basis.T @ trace)
    return out


def _alike(a: FloatArray, b: FloatArray) -> float:
    """Size of the correlation of two traces (n,) in units of noise: near 1 also where too little is left of both."""
    product, first, second = abs(float(a @ b)), float(a @ a), float(b @ b)
    return (product + FAINT) / float(np.sqrt((first + FAINT) * (second + FAINT)))
