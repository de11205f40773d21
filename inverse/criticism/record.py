"""The contents of ``diagnosis.json`` and ``misfit.json``: a comparison of models as data and sentences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from splatsoil.experiment.base import Candidate, Experiment
from splatsoil.report.text import amount, listed, probability, title, undetermined
from splatsoil.run_files import DIAGNOSIS_FORMAT, MISFIT_FORMAT

from .checks import SIGNIFICANT
from .diagnosis import Diagnosis
from .evidence import BASE_MODEL, DISCREPANCY

MISFIT_KEYS = (
    *("estimates", "sentences", "checks", "passes", "discretisation_factor", "unit", "time_name", "times", "stages"),
    *("sites", "curves", "regions", "maps", "simulations", "fit", "values"),
)


def record(experiment: Experiment, diagnosis: Diagnosis, simulations: int) -> dict[str, Any]:
    """The diagnosis as plain data, after so many simulations."""
    layout = experiment.layout
    candidates = {c.name: c for c in experiment.candidates}
    evidence = diagnosis.evidence
    order = sorted(evidence.probability, key=lambda name: -evidence.probability[name])
    return {
        "format": DIAGNOSIS_FORMAT,
        "experiment": experiment.name,
        "model": list(experiment.model),
        "verdict": diagnosis.verdict,
        "class": list(diagnosis.members),
        "sentences": sentences(diagnosis, candidates),
        "estimates": {
            p.name: {
                **dict(zip(("value", "std"), diagnosis.estimates[p.name], strict=True)),
                "unit": p.unit,
                "determined": bool(diagnosis.determined[p.name]),
            }
            for p in experiment.parameters
        },
        "models": [_model(diagnosis, name, candidates.get(name)) for name in order],
        "held_out": [dict(vars(one)) for one in diagnosis.held_out],
        "held_out_data": diagnosis.held_out_data,
        "checks": [dict(vars(check)) for check in diagnosis.checks],
        "passes": diagnosis.passes,
        "discretisation_factor": float(evidence.models[evidence.best].factors.max()),
        "unit": layout.unit,
        "time_name": layout.time_name,
        "times": list(layout.times),
        "stages": list(layout.stages),
        # Instruments without a place are drawn as curves instead.
        "sites": [
            [s.channel, *((s.x, s.y) if there else (None, None)), [[round(u, 5), round(v, 5)] for u, v in s.outline]]
            for s, there in zip(layout.sites, layout.placed, strict=True)
        ],
        "regions": layout.regions.tolist(),
        "curves": [_curve(experiment, diagnosis, column) for column, there in enumerate(layout.placed) if not there],
        # Residuals over their expected standard deviation; null where nothing is compared.
        "maps": {name or "before": _map(table, diagnosis) for name, table in diagnosis.residuals.items()},
        "simulations": simulations,
        "notes": list(diagnosis.notes),
    }


def misfit_of(whole: Mapping[str, Any]) -> dict[str, Any]:
    """``misfit.json`` from a diagnosis without effects: whether the model is adequate, and where it fails."""
    probability = {model["name"]: model["probability"] for model in whole["models"]}
    return {
        "format": MISFIT_FORMAT,
        "adequate": whole["verdict"] == "adequate",
        "probability": probability[BASE_MODEL],
        **{key: whole[key] for key in MISFIT_KEYS},
    }


def sentences(diagnosis: Diagnosis, candidates: Mapping[str, Candidate]) -> list[str]:
    """The result in sentences, the most important first."""
    evidence = diagnosis.evidence
    out = []
    if diagnosis.verdict == "missing":
        (name,) = diagnosis.members
        out.append(
            f"{title(name)} is missing{_size(diagnosis, candidates[name])}: of all models that were compared, its "
            f"probability is {probability(evidence.probability[name])}."
        )
    elif diagnosis.verdict == "one of":
        named = [f"{n.replace('_', ' ')} ({probability(evidence.probability[n])})" for n in diagnosis.members]
        out.append(f"One of these is missing: {listed(named)}. The data do not tell them apart.")
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
        others = "" if not candidates else f" Its probability is {probability(evidence.probability[BASE_MODEL])}."
        out.append(f"The model as it is explains the data.{others}")
    out += [undetermined(name) for name, determined in diagnosis.determined.items() if not determined]
    if len(diagnosis.held_out) > 1:
        before, after = diagnosis.held_out[:2]
        out.append(
            f"On held-out data ({diagnosis.held_out_data}), the error is {before.error:.2g} without and "
            f"{after.error:.2g} with {after.model.replace('_', ' ')}; the noise level is {after.noise:.2g}."
        )
    worst = next((c for c in diagnosis.checks if c.p < SIGNIFICANT), None)
    if worst is not None:
        out.append(
            f"The most probable model fails most clearly here: {worst.region}, {worst.stage}, {worst.channel}, with "
            f"{worst.ratio:.1f} times the expected residual. The prediction there is {100.0 * worst.amplitude:.0f} %"
            " of the measurement (root mean squares)."
        )
    if candidates:
        out += _power(diagnosis, candidates)
    return out


def _size(diagnosis: Diagnosis, candidate: Candidate) -> str:
    measure, model = candidate.measure, diagnosis.evidence.models[candidate.name]
    return f", about {amount(*model.moments(measure.name), measure.unit)}" if measure.name in model.values else ""


def _power(diagnosis: Diagnosis, candidates: Mapping[str, Candidate]) -> list[str]:
    """Which effects the data can and cannot detect."""
    named = diagnosis.members if diagnosis.verdict == "missing" else ()
    sizes = {name: size for name, size in diagnosis.detectable.items() if name not in named}
    detected = [
        f"{name.replace('_', ' ')} of {amount(size, 0.0, candidates[name].measure.unit)}"
        for name, size in sizes.items()
        if size is not None
    ]
    hidden = [name.replace("_", " ") for name, size in sizes.items() if size is None]
    out = []
    if detected and diagnosis.verdict != "missing":
        out.append(f"These would have been named in 8 of 10 cases: {listed(detected)}.")
    if hidden:
        out.append(f"These data cannot show {listed(hidden)}.")
    return out


def _model(diagnosis: Diagnosis, name: str, candidate: Candidate | None) -> dict[str, Any]:
    model = diagnosis.evidence.models[name]
    moments = {parameter: model.moments(parameter) for parameter in model.values}
    measure = None if candidate is None else candidate.measure
    size = (None, None) if measure is None else moments.get(measure.name, (None, None))
    return {
        "name": name,
        "kind": candidate.kind if candidate is not None else "discrepancy" if name == DISCREPANCY else "base",
        "note": "" if candidate is None else candidate.note,
        "probability": diagnosis.evidence.probability[name],
        "log_evidence": model.log_evidence - diagnosis.evidence.models[BASE_MODEL].log_evidence,
        "values": {parameter: value for parameter, (value, _) in moments.items()},
        "stds": {parameter: std for parameter, (_, std) in moments.items()},
        "parameter": None if measure is None else measure.name,
        "estimate": size[0],
        "std": size[1],
        "unit": "" if measure is None else measure.unit,
        "off": None if measure is None else measure.off,
        "meaningful": None if measure is None else measure.meaningful,
        "detectable": diagnosis.detectable.get(name),
    }


def _curve(experiment: Experiment, diagnosis: Diagnosis, column: int) -> dict[str, Any]:
    """Readings of an instrument without a place, plus and minus one expected standard deviation, and predictions."""
    site, seen = experiment.layout.sites[column], experiment.seen
    std = np.sqrt(diagnosis.expected)

    def values(table: np.ndarray) -> list[float | None]:
        read = table[:, column] if site.reading is None else site.reading(table[:, column])
        return [float(v) if there else None for v, there in zip(read, seen[:, column], strict=True)]

    return {
        "channel": site.channel,
        "unit": site.unit or experiment.layout.unit,
        "measured": values(experiment.observed),
        "low": values(experiment.observed - std),
        "high": values(experiment.observed + std),
        "predicted": {name or "before": values(table) for name, table in diagnosis.predictions.items()},
    }


def _map(residual: np.ndarray, diagnosis: Diagnosis) -> list[list[float | None]]:
    ratio = np.where(diagnosis.mask, residual / np.sqrt(np.maximum(diagnosis.expected, 1e-300)), np.nan)
    return [[None if not np.isfinite(v) else round(float(v), 2) for v in row] for row in ratio]
