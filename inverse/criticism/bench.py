"""What a residual is judged by."""

from __future__ import annotations

from dataclasses import dataclass

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
    def of(cls, experiment: Experiment, evidence: Evidence, *, level: float = LEVEL, seed: int = 0) -> Bench:
        """Prepare, with ``level`` the family-wise chance of naming an effect when none is missing."""
        floor = floor_of(experiment, evidence)
        seen = experiment.seen
        candidates = tuple(c for c in experiment.candidates if c.name in evidence.directions)
        columns = {c.name: evidence.directions[c.name][:, seen].T for c in candidates}
        doubts = {c.name: evidence.doubts[c.name][:, seen].T for c in candidates if c.name in evidence.doubts}
        scorer = None
        if candidates:
            scorer = Scorer.of(
                floor.noise,
                floor.free,
                columns,
                candidates,
                doubts=doubts,
                calibration=evidence.calibration,
                level=level,
                seed=seed,
            )
        layout = experiment.layout
        return cls(floor, candidates, scorer, smooth_basis(layout, floor.noise), layout, seed)

    def misfit(self, residual: FloatArray) -> Omnibus:
        """What of a residual (n,) stands on slow waves."""
        return omnibus(self.floor.noise, self.floor.free, residual, self.basis)

    def off(self, residual: FloatArray) -> bool:
        """Whether a residual (n,) is more than noise leaves."""
        return amiss(self.misfit(residual), self.blocks(residual)[0])

    def blocks(self, residual: FloatArray) -> tuple[Block, tuple[Block, ...]]:
        """How far a residual (n,) is off, in all and where."""
        return blocks(self.layout, self.floor.noise, self.floor.free, residual, seed=self.seed)
