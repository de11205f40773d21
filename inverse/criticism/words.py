"""A diagnosis in plain words. Each sentence says no more than the numbers do."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

from splatsoil.experiment.base import Candidate
from splatsoil.experiment.strokes import MEASURED
from splatsoil.report.words import rounded, symbol, undetermined, with_std

from .confirmation import Confirmation
from .diagnosis import Diagnosis
from .estimates import Estimate
from .outside import CLEAR, FEW, StrengthReading
from .verdicts import CLEAN, GATE, WITHIN, amiss, beyond

#: Correlation of two effects' scores from which they are called alike.
ALIKE = 0.8

MAKES_UP = "what is refitted makes up for the rest as far as it can, so that it may be off by more than its ± says"


def sentences(
    diagnosis: Diagnosis,
    candidates: Mapping[str, Candidate],
    base: Mapping[str, float],
    still: Collection[str] = (),
) -> list[str]:
    """What was found, the most important first.

    Args:
        diagnosis: what to tell.
        candidates: effects by name.
        base: the model's parameters.
        still: regions in which none of the model's physics acts.
    """
    if diagnosis.verdict == "missing":
        out = _missing(diagnosis, candidates, base)
    elif diagnosis.verdict == "adequate":
        out = _adequate(diagnosis, candidates)
    else:
        out = _outside(diagnosis, candidates)
    ruled_out = [title(name) for name, c in diagnosis.confirmations.items() if c.ruled_out]
    if ruled_out:
        out.append(f"Soil would ask for {listed(ruled_out)} of a size that pictures rule out where soil plays no part.")
    out += of_strokes(diagnosis)
    worst = next((b for b in diagnosis.blocks if b.p < GATE), None)
    if worst is not None:
        out.append(
            f"Before anything is added, the model fails most clearly here: {worst.region}, {worst.stage}, "
            f"{worst.channel}, with {worst.ratio:.1f} times what noise leaves."
        )
        if worst.region in still and diagnosis.verdict == "outside the library":
            out.append("Nothing that is modelled acts there: look at cameras, light and what holds the soil, too.")
    blind = [name.replace("_", " ") for name, verdict in diagnosis.effects.items() if verdict == "cannot tell"]
    if blind:
        out.append(f"What these data cannot tell: {listed(blind)}.")
    return out


def _missing(diagnosis: Diagnosis, candidates: Mapping[str, Candidate], base: Mapping[str, float]) -> list[str]:
    best = diagnosis.members[0]
    confirmed, before = diagnosis.confirmations[best], diagnosis.confirmations[""]
    candidate = candidates[best]
    size = confirmed.values[candidate.size]
    std = confirmed.stds[candidate.size]
    out = [
        f"{title(best)} is missing: about {amount(size, std, candidate.measure.unit)}. Adding it lowers the error on "
        f"frames that the refit has not seen from {before.held_out:.2g} to "
        f"{confirmed.held_out:.2g} {diagnosis.unit}; noise alone leaves {_noise(before, confirmed)}."
    ]
    after, remainder = diagnosis.whole_after, diagnosis.remainder
    clean = remainder is not None and remainder.p >= CLEAN
    if after is not None and clean and confirmed.held_out > WITHIN * confirmed.floor:
        out.append(
            "Without what numerics and the refitted parameters can make up for, what is left in all is "
            f"{after.ratio:.2f} times what noise leaves{', which chance may do' if after.ratio > WITHIN else ''}: "
            "nothing more need be missing."
        )
    if diagnosis.where:
        (stage, region, channel), share = max(diagnosis.where.items(), key=lambda item: item[1])
        out.append(
            f"{100.0 * share:.0f} % of the evidence comes from one part of the data: {region}, {stage}, {channel}."
        )
    moved = [name for name in base if abs(confirmed.values[name] - base[name]) > 1e-6 * max(abs(base[name]), 1.0)]
    if moved:
        to = {name: amount(confirmed.values[name], confirmed.stds[name], "").rstrip() for name in moved}
        told = [f"{name.replace('_', ' ')} from {base[name]:.3g} to {to[name]}" for name in moved]
        # What is hardly known may as well not have moved.
        sure = all(abs(confirmed.values[name] - base[name]) > CLEAR * confirmed.stds[name] for name in moved)
        out.append(f"With it the refit moves {listed(told)}{': that much was bias' if sure else ''}.")
    if len(diagnosis.members) > 1:
        out.append(f"{listed([title(m) for m in diagnosis.members[1:]])} would explain it nearly as well.")
    if diagnosis.remainder is not None and diagnosis.remainder.p < CLEAN and diagnosis.misfit.p < GATE:
        out.append(
            f"It explains {100.0 * diagnosis.explained:.0f} % of the misfit beyond chance on slow waves; what remains "
            f"is more than noise, and {MAKES_UP}."
        )
    return out


def _adequate(diagnosis: Diagnosis, candidates: Mapping[str, Candidate]) -> list[str]:
    seen = [
        f"{name.replace('_', ' ')} of {amount(diagnosis.scores[name].detectable, 0.0, candidates[name].measure.unit)}"
        for name, verdict in diagnosis.effects.items()
        if verdict == "absent"
    ]
    out = ["The model is adequate: nothing stands above what noise, chance and numerics leave."]
    out += of_estimates(diagnosis.estimates)
    if seen:
        out.append(f"It would have shown {listed(seen)}.")
    return out


def of_estimates(estimates: Mapping[str, Estimate]) -> list[str]:
    """What an adequate model's parameters are once all of the floor is weighed."""
    known = []
    for name, estimate in estimates.items():
        if estimate.determined:
            value = amount(estimate.value, estimate.std, estimate.unit)
            noise, systematic = (
                f"± {float(f'{part:.2g}'):g}{symbol(estimate.unit)}" for part in (estimate.noise, estimate.systematic)
            )
            known.append(
                f"the {name.replace('_', ' ')} is {value} ({noise} by noise and chance, {systematic} systematic)"
            )
    out = [undetermined(name) for name, estimate in estimates.items() if not estimate.determined]
    if known:
        out = [
            f"With noise, chance and numerics weighed, {listed(known)}.",
            "Systematic is what numerics that weren't tried may do, which may be as far off as those that were, and "
            "how far solvers are apart; in soil that has an effect also parts of the data that contradict each other.",
            *out,
        ]
    return out


def _outside(diagnosis: Diagnosis, candidates: Mapping[str, Candidate]) -> list[str]:
    out = ["The model is not adequate, and no effect of the library explains all of it."]
    slow = diagnosis.misfit.p < GATE
    if amiss(diagnosis.misfit, diagnosis.whole):
        where, times = (
            ("on slow waves", math.sqrt(diagnosis.misfit.dispersion)) if slow else ("as a whole", diagnosis.whole.ratio)
        )
        out = [f"{out[0][:-1]}: the misfit {where} is {times:.3g} times what noise leaves."]
    if diagnosis.members:
        best = diagnosis.members[0]
        confirmed, before = diagnosis.confirmations[best], diagnosis.confirmations[""]
        candidate = candidates[best]
        size = amount(confirmed.values[candidate.size], confirmed.stds[candidate.size], candidate.measure.unit)
        share = f"{100.0 * diagnosis.explained:.0f} % of the {'misfit on slow waves' if slow else 'squared error'}"
        out.append(
            f"The nearest is {best.replace('_', ' ')} ({size}): with it the error on frames that the refit has not "
            f"seen goes from {before.held_out:.2g} to {confirmed.held_out:.2g} {diagnosis.unit} (noise alone leaves "
            f"{_noise(before, confirmed)}). It explains {share} beyond noise. "
            f"What remains is more than noise{_in_all(diagnosis)}, so it is not all that is missing; {MAKES_UP}."
        )
    return out if diagnosis.strength is None else [*out, *of_strength(diagnosis.strength)]


def _in_all(diagnosis: Diagnosis) -> str:
    """By how much, where that is the reason."""
    after = diagnosis.whole_after
    if after is None or not beyond(after):
        return ""
    return f" ({after.ratio:.2g} times what it leaves, without what numerics and what is refitted can make up for)"


def of_strokes(diagnosis: Diagnosis) -> list[str]:
    """What would tell the class's members apart."""
    out = []
    for advice in diagnosis.strokes:
        first, second = (name.replace("_", " ") for name in advice.pair)
        now = advice.alike[MEASURED]
        if advice.best:
            out.append(
                f"The same experiment {advice.best} would tell {first} and {second} apart better: their traces "
                f"correlate {advice.alike[advice.best]:.2f} there, {now:.2f} as measured."
            )
        else:
            out.append(
                f"None of {len(advice.alike) - 1} other ways to do it would tell {first} and {second} apart "
                f"much better: their traces correlate {now:.2f} as measured."
            )
    return out


def of_strength(found: StrengthReading) -> list[str]:
    """What a strength of free form looks like."""
    seen = listed([s.argument for s in found.shapes])
    if not found.readings:
        if found.explained < FEW:
            return [
                f"Friction that depends freely on {seen} explains {100.0 * found.explained:.0f} % of the misfit beyond "
                "chance: look for something other than strength (volume, contact, geometry, pictures)."
            ]
        return [f"Friction that depends freely on {seen} would explain it, but in no direction that is clear."]
    out = []
    for shape in sorted((s for s in found.shapes if s.reading), key=lambda s: -s.evidence):
        first, last = (f"{shape.at[k]:.2g}{' Pa' if shape.argument == 'pressure' else ''}" for k in (0, -1))
        times = math.exp(shape.change)
        out.append(
            f"What is missing looks {shape.reading}: friction at {shape.argument} {last} is {times:.2f} ± "
            f"{times * shape.std:.2f} times that at {first}. A strength of free form explains "
            f"{100.0 * found.explained:.0f} % of the misfit beyond chance."
        )
    return out


def title(name: str) -> str:
    """An effect's name at the beginning of a sentence."""
    return name.replace("_", " ").capitalize()


def listed(words: list[str]) -> str:
    """a, b and c."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def amount(value: float, std: float, unit: str) -> str:
    """A value with its spread, if it has one, and unit."""
    return (" ± ".join(with_std(value, std)) if 0.0 < std < math.inf else rounded(value)) + symbol(unit)


def _noise(before: Confirmation, confirmed: Confirmation) -> str:
    """What noise leaves on hidden times: soil that has an effect falls otherwise by chance."""
    there, here = f"{confirmed.floor:.2g}", f"{before.floor:.2g}"
    return there if there == here else f"{here} without it, and {there} in soil that has it"
