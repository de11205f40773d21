"""What a residual is judged by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatsoil.experiment.base import Candidate, Experiment
from splatsoil.experiment.features import Layout

from .evidence import Evidence
from .floor import Floor, floor_of
from .misfit import Block, Omnibus, blocks, omnibus, smooth_basis
from .score import Scorer
from .verdicts import LEVEL, amiss

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Bench:
    """What a residual is judged by, made of the evidence.

    Attributes:
        floor: noise and nuisances.
        candidates: effects that could be simulated.
        scorer: of them; None where there are none.
        basis: (n, k) slow waves.
        layout: of the features.
        seed: of draws.
    """

    floor: Floor
    candidates: tuple[Candidate, ...]
    scorer: Scorer | None
    basis: FloatArray
    layout: Layout
    seed: int

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        evidence: Evidence,
        *,
        level: float = LEVEL,
        seed: int = 0,
        scored: bool = True,
        before: Floor | None = None,
    ) -> Bench:
        """Prepare, with ``level`` the family-wise chance of naming an effect when none is missing; for effects, too,
        unless they needn't be ``scored``. ``before`` is the floor of the same evidence with other effects' derivatives.
        """
        floor = floor_of(experiment, evidence, before)
        candidates = tuple(c for c in experiment.candidates if c.name in evidence.directions)
        bench = cls(floor, candidates, None, smooth_basis(experiment.layout, floor.noise), experiment.layout, seed)
        if not (candidates and scored):
            return bench
        return replace(bench, scorer=bench.scored(experiment, evidence, evidence.directions, level))

    def scored(
        self,
        experiment: Experiment,
        evidence: Evidence,
        directions: Mapping[str, FloatArray],
        level: float = LEVEL,
    ) -> Scorer:
        """A scorer of the candidates by their directions, each (k, t, s)."""
        seen, names = experiment.seen, [c.name for c in self.candidates]
        return Scorer.of(
            self.floor.noise,
            self.floor.free,
            {name: directions[name][:, seen].T for name in names},
            self.candidates,
            doubts={name: evidence.doubts[name][:, seen].T for name in names if name in evidence.doubts},
            calibration=evidence.calibration,
            level=level,
            seed=self.seed,
        )

    def misfit(self, residual: FloatArray) -> Omnibus:
        """What of a residual (n,) stands on slow waves."""
        return omnibus(self.floor.noise, self.floor.free, residual, self.basis)

    def off(self, residual: FloatArray) -> bool:
        """Whether a residual (n,) is more than noise leaves."""
        return amiss(self.misfit(residual), self.blocks(residual)[0])

    def blocks(self, residual: FloatArray) -> tuple[Block, tuple[Block, ...]]:
        """How far a residual (n,) is off, in all and where."""
        return blocks(self.layout, self.floor.noise, self.floor.free, residual, seed=self.seed)
