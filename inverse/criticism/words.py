"""A comparison of models in plain words. Each sentence says no more than the numbers do."""

from __future__ import annotations

from collections.abc import Mapping

from splatsoil.experiment.base import Candidate
from splatsoil.report.text import amount, listed, probability, title, undetermined

from .checks import SIGNIFICANT
from .diagnosis import Diagnosis
from .evidence import AS_IT_IS


def sentences(diagnosis: Diagnosis, candidates: Mapping[str, Candidate]) -> list[str]:
    """What was found, the most important first."""
    evidence = diagnosis.evidence
    out = []
    if diagnosis.verdict == "missing":
        (name,) = diagnosis.members
        out.append(
            f"{title(name)} is missing{_size(diagnosis, candidates[name])}: of all models that were compared, its "
            f"probability is {probability(evidence.probability[name])}."
        )
    elif diagnosis.verdict == "one of":
        told = [f"{n.replace('_', ' ')} ({probability(evidence.probability[n])})" for n in diagnosis.members]
        out.append(f"One of these is missing: {listed(told)}. The data do not tell them apart.")
    elif diagnosis.verdict == "something else":
        none = ", and no effect of the library explains it" if candidates else ""
        out.append(f"The residual is larger than noise and discretisation error{none}.")
    elif diagnosis.verdict == "undecided":
        shares = [
            f"{(name or 'the model as it is').replace('_', ' ')} {probability(evidence.probability[name])}"
            for name in sorted(evidence.probability, key=lambda n: -evidence.probability[n])[:4]
        ]
        out.append(f"No model is probable enough to be named: {listed(shares)}.")
    else:
        others = "" if not candidates else f" Its probability is {probability(evidence.probability[AS_IT_IS])}."
        out.append(f"The model as it is explains the data.{others}")
    out += [undetermined(name) for name, determined in diagnosis.determined.items() if not determined]
    if len(diagnosis.held_out) > 1:
        before, after = diagnosis.held_out[:2]
        out.append(
            f"On {diagnosis.aside}, which were set aside, the error is {before.error:.2g} without and "
            f"{after.error:.2g} with {after.model.replace('_', ' ')}; the noise level is {after.noise:.2g}."
        )
    worst = next((c for c in diagnosis.checks if c.p < SIGNIFICANT), None)
    if worst is not None:
        out.append(
            f"The most probable model fails most clearly here: {worst.region}, {worst.stage}, {worst.channel}, with "
            f"{worst.ratio:.1f} times what is expected."
        )
    if candidates:
        out += _sight(diagnosis, candidates)
    return out


def _size(diagnosis: Diagnosis, candidate: Candidate) -> str:
    measure, model = candidate.measure, diagnosis.evidence.models[candidate.name]
    if measure.name not in model.values:
        return ""
    return f", about {amount(*model.moments(measure.name), measure.unit)}"


def _sight(diagnosis: Diagnosis, candidates: Mapping[str, Candidate]) -> list[str]:
    """What would have been seen, and what not."""
    seen, blind = [], []
    for name, size in diagnosis.detectable.items():
        if diagnosis.verdict == "missing" and name in diagnosis.members:
            continue
        plain = name.replace("_", " ")
        if size is None:
            blind.append(plain)
        else:
            seen.append(f"{plain} of {amount(size, 0.0, candidates[name].measure.unit)}")
    out = []
    if seen and diagnosis.verdict != "missing":
        out.append(f"These would have been named in 8 of 10 cases: {listed(seen)}.")
    if blind:
        out.append(f"These data cannot show {listed(blind)}.")
    return out
