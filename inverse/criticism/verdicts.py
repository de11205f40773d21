"""Verdicts from numbers: pure functions, and the only place where thresholds become words."""

from __future__ import annotations

import math
from typing import Literal

from splatsoil.experiment.base import Candidate

from .misfit import Block, Omnibus
from .score import Score

EffectVerdict = Literal["missing", "trivial", "absent", "cannot tell"]
Verdict = Literal["adequate", "missing", "outside the library"]

LEVEL = 0.05
"""Family-wise chance of naming an effect when none is missing."""
GATE = 0.01
"""Chance below which what is left, on slow waves or in all, is called a remainder."""
CERTAIN = 1e-4
"""Chance below which what pictures say of an effect where soil plays no part needs no confirmation by soil."""
CLEAN = 0.05
"""Chance that what is left after an effect must have for the effect to be all that was missing."""
EQUIVALENT = 6.0
"""Fall of χ² within which effects count as equally good."""
RELEVANT = 0.1
"""Share of the squared error on times that a refit hasn't seen which an effect must take away where no misfit shows."""
DENIES, SEEN = 1.645, 1.960
"""Standard deviations within which an effect's size lies with 95 % to one side, and to both."""
LEAST_SURVIVAL = 0.05
"""Share of an effect's information that must survive the projection of everything else."""
ENOUGH = 0.6
"""Share of the misfit beyond chance that effects must explain where a remainder stands: another solver's soil, or a
real one, leaves one of its own. What imitates an effect is told by :data:`WITHIN`, hardly ever by this."""
WITHIN = 1.2
"""Residual over what noise leaves, up to which a model can be adequate, and an effect all there is, whatever the chance
of it: in all, or, where there is no chance, on times that a refit hasn't seen. Chosen on emulated worlds of
one effect of two and four times the smallest detectable size, by the latter (seed 61, a hundred each): 1.2 gives away 1
and 3 of the right ones, 1.1 gives away 5 and 12; of those that imitate a truth out of the library 1.2 lets 18 and 4
pass, 1.25 22 and 4."""


def of_effect(candidate: Candidate, score: Score, *, level: float = LEVEL, apart: float = 0.0) -> EffectVerdict:
    """Verdict on one effect that is off.

    Absent or trivial, unseen or seen, is one whose estimate denies that it matters (Schuirmann 1987, J. Pharmacokinet.
    Biopharm. 15:657), also on the side that shows less, and where another solver is right (``apart``: standard
    deviation between solvers of the size from which it would). Of one with several parameters each counts: a bed may
    lean one way or the other. What has a shape of its own was looked for in one shape, and isn't denied: an obstacle
    may lie elsewhere.
    """
    meaningful = candidate.measure.meaningful
    others = [p for p in candidate.parameters if p.name != candidate.size and p.meaningful > 0.0]
    sizes = {p.name: abs(score.steps[p.name]) for p in others}
    if score.adjusted < level:
        matters = abs(score.estimate) >= meaningful or any(sizes[p.name] >= p.meaningful for p in others)
        return "missing" if matters else "trivial"
    unsure = DENIES * math.hypot(score.lopsided * score.std, apart)
    denied = abs(score.estimate) + unsure <= meaningful and score.survival >= LEAST_SURVIVAL
    denied &= all(sizes[p.name] + DENIES * score.stds[p.name] <= p.meaningful for p in others)
    if denied and not candidate.shapes:
        return "trivial" if abs(score.z) > SEEN else "absent"
    return "cannot tell"


def ruled_out(told: float, agrees: float) -> bool:
    """Whether other pictures deny the size that soil asks for (their chance if it were so: ``agrees``), and don't ask
    for the effect themselves (their chance if it were off: ``told``)."""
    return agrees < CERTAIN <= told


def beyond(whole: Block) -> bool:
    """Whether more is left in all than an adequate model may leave."""
    return whole.ratio > WITHIN and whole.p < GATE


def amiss(misfit: Omnibus, whole: Block) -> bool:
    """Whether more is left than noise leaves: on slow waves, or in all by more than an adequate model may leave.

    What one part of the trench shows in one camera isn't slow: cohesive soil that passes for dry soil of a larger angle
    leaves twice the noise, and hardly anything on slow waves.
    """
    return misfit.p < GATE or beyond(whole)


def overall(
    named: bool,
    off: bool,
    misfit: Omnibus,
    remainder: Omnibus | None,
    *,
    left: bool = False,
    clean: float = CLEAN,
    enough: float = ENOUGH,
) -> Verdict:
    """Verdict on the model.

    Args:
        named: some effect is significant and large enough to matter.
        off: the model as it is leaves more than noise; see :func:`amiss`.
        misfit: slow waves before the best the library can do, on the floor by which the remainder is judged.
        remainder: after the best the library can do; None where nothing was named.
        left: with that best more is left in all than an adequate model may leave.
        clean: see :data:`CLEAN`.
        enough: see :data:`ENOUGH`.
    """
    if not named or remainder is None:
        return "outside the library" if off else "adequate"
    if not left and (remainder.p >= clean or explained(misfit, remainder) >= enough):
        return "missing"
    return "outside the library"


def explained(before: Omnibus, after: Omnibus) -> float:
    """Share of the misfit beyond chance that is gone from slow waves."""
    return _gone(before.excess, after.excess)


def explained_of_all(before: float, after: float) -> float:
    """Share of the squared error beyond noise that is gone, by errors over noise."""
    return _gone(*(max(error**2 - 1.0, 0.0) for error in (before, after)))


def _gone(before: float, after: float) -> float:
    if before <= 0.0:
        return 0.0 if after > 0.0 else 1.0
    return max(0.0, 1.0 - after / before)
