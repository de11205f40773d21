"""Which of the refitted effects are named."""

from __future__ import annotations

from collections.abc import Mapping

from scipy.stats import chi2

from splatsoil.parameters import Parameter

from .confirmation import Confirmation
from .score import Score
from .verdicts import CERTAIN, DENIES, EQUIVALENT, LEVEL, RELEVANT

CONTRARY = float(chi2.isf(CERTAIN, 1))
"""Rise of χ² on times that a refit hasn't seen, over what each number still holds, by which features deny beyond doubt
what other pictures say beyond doubt."""


def members_of(
    confirmations: Mapping[str, Confirmation],
    costs: Mapping[str, float],
    off: bool,
    scores: Mapping[str, Score],
    measures: Mapping[str, Parameter],
) -> tuple[str, ...]:
    """The equivalence class, the best effect first; empty where the best one doesn't stand.

    What other pictures say of an effect beyond doubt comes first, even if another one would explain more of what soil
    shows: the next diagnosis, with the first one on, tells of that. What they rule out isn't it, however well it
    explains soil, nor is what another effect left behind in its first steps.

    Args:
        confirmations: of the model as it is, under the empty name, and with each effect.
        costs: χ² by effect, up to a constant.
        off: the model as it is leaves more than noise; see :func:`~splatsoil.inverse.criticism.verdicts.amiss`.
        scores: of each effect.
        measures: the parameter that measures each effect.
    """
    costs = {n: cost for n, cost in costs.items() if not (confirmations[n].ruled_out or confirmations[n].stopped)}
    if not costs:
        return ()
    standing = [name for name in costs if stands(confirmations, name, off, scores[name], measures[name])]
    certain = {name: costs[name] for name in standing if confirmations[name].told < CERTAIN}
    among = certain or costs
    best = min(among, key=lambda name: among[name])
    if best not in standing:
        return ()
    # What explains nothing, or nothing that its refit hasn't seen, equals nothing, however wide the doubt.
    told = {name: confirmations[name] for name in among}
    explaining = {n: among[n] for n, c in told.items() if n in certain or (c.fall > 0.0 and c.unseen > 0.0)}
    return _equals(explaining, best, max(confirmations[best].dispersion, scores[best].dispersion))


def stands(confirmations: Mapping[str, Confirmation], name: str, off: bool, score: Score, measure: Parameter) -> bool:
    """Something is to be explained, and the refit does: χ² falls, on times that it hasn't seen too, by more than chance
    does in what is left.

    Where the model leaves no more than noise, either the effect is significant among all of the library, or the model
    is off by more than noise on those times; it must take away a relevant share of the squared error there; and its
    refit, all that is systematic counted, must tell its size from none. What other pictures say of an effect beyond
    doubt needs no more of the features than that they don't speak against it beyond doubt: χ² of two models on times
    that neither has seen differs by tens by chance.
    """
    before, after = confirmations[""], confirmations[name]
    dispersion = max(after.dispersion, score.dispersion)
    if after.fall <= EQUIVALENT * dispersion:
        return False
    if after.told < CERTAIN:
        return after.unseen > -CONTRARY * dispersion
    wanting = score.adjusted < LEVEL or before.held_out > before.floor
    relevant = after.held_out**2 < (1.0 - RELEVANT) * before.held_out**2
    told = abs(after.values[measure.name] - float(measure.off or 0.0)) > DENIES * after.stds[measure.name]
    return (off or (wanting and relevant and told)) and after.unseen > 0.0


def _equals(costs: Mapping[str, float], best: str, dispersion: float) -> tuple[str, ...]:
    """Effects whose χ² after refitting lies as near to the best as equals do; wider where a misfit remains."""
    wide = EQUIVALENT * dispersion
    close = [name for name, cost in costs.items() if cost - costs[best] < wide]
    return tuple(sorted(close, key=lambda name: costs[name]))
