"""A comparison of models as plain data: what ``diagnosis.json`` and ``misfit.json`` hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from splatsoil.experiment.base import Candidate, Experiment
from splatsoil.run_files import DIAGNOSIS_FORMAT, MISFIT_FORMAT

from .diagnosis import Diagnosis
from .evidence import AS_IT_IS, ELSE, Model
from .words import sentences

ABOUT_MISFIT = (
    *("estimates", "sentences", "checks", "passes", "numerics", "unit", "time_name", "times", "stages", "sites"),
    *("curves", "regions", "maps", "simulations", "fit", "values"),
)


def record(experiment: Experiment, diagnosis: Diagnosis, simulations: int) -> dict[str, Any]:
    """Everything a reader, a report or another command may ask for."""
    layout = experiment.layout
    candidates = {c.name: c for c in experiment.candidates}
    evidence = diagnosis.evidence
    order = sorted(evidence.probability, key=lambda name: -evidence.probability[name])
    names = {AS_IT_IS: "before"}
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
        "held_out": [
            {"model": h.model, "error": h.error, "noise": h.noise, "log_score": h.log_score} for h in diagnosis.held_out
        ],
        "aside": diagnosis.aside,
        "checks": [
            {"stage": c.stage, "region": c.region, "channel": c.channel, "ratio": c.ratio, "p": c.p, "n": c.features}
            for c in diagnosis.checks
        ],
        "passes": diagnosis.passes,
        "numerics": float(evidence.models[evidence.best].factors.max()),
        "unit": layout.unit,
        "time_name": layout.time_name,
        "times": list(layout.times),
        "stages": list(layout.stages),
        # What has no place is drawn as curves instead.
        "sites": [
            [s.channel, *((s.x, s.y) if there else (None, None)), [[round(u, 5), round(v, 5)] for u, v in s.outline]]
            for s, there in zip(layout.sites, layout.placed, strict=True)
        ],
        "regions": layout.regions.tolist(),
        "curves": [_curve(experiment, diagnosis, column) for column, there in enumerate(layout.placed) if not there],
        # In units of what each feature is expected to be off; null where nothing is compared.
        "maps": {names.get(name, name): _map(table, diagnosis) for name, table in diagnosis.residuals.items()},
        "simulations": simulations,
        "notes": list(diagnosis.notes),
    }


def misfit_of(whole: Mapping[str, Any]) -> dict[str, Any]:
    """Of a comparison without effects: whether the model is adequate, where and when it isn't."""
    probability = {model["name"]: model["probability"] for model in whole["models"]}
    return {
        "format": MISFIT_FORMAT,
        "adequate": whole["verdict"] == "adequate",
        "probability": probability[AS_IT_IS],
        **{key: whole[key] for key in ABOUT_MISFIT},
    }


def _model(diagnosis: Diagnosis, name: str, candidate: Candidate | None) -> dict[str, Any]:
    evidence = diagnosis.evidence
    model: Model = evidence.models[name]
    moments = {parameter: model.moments(parameter) for parameter in model.values}
    measure = None if candidate is None else candidate.measure
    known = measure is not None and measure.name in moments
    kind = candidate.kind if candidate is not None else "discrepancy" if name == ELSE else "base"
    return {
        "name": name,
        "kind": kind,
        "note": "" if candidate is None else candidate.note,
        "probability": evidence.probability[name],
        "log_evidence": model.log_evidence - evidence.models[AS_IT_IS].log_evidence,
        "values": {parameter: value for parameter, (value, _) in moments.items()},
        "stds": {parameter: std for parameter, (_, std) in moments.items()},
        "parameter": None if measure is None else measure.name,
        "estimate": moments[measure.name][0] if measure is not None and known else None,
        "std": moments[measure.name][1] if measure is not None and known else None,
        "unit": "" if measure is None else measure.unit,
        "off": None if measure is None else measure.off,
        "meaningful": None if measure is None else measure.meaningful,
        "detectable": diagnosis.detectable.get(name),
    }


def _curve(experiment: Experiment, diagnosis: Diagnosis, column: int) -> dict[str, Any]:
    """An instrument without a place, in its unit: what it measured, one expected standard deviation below and above
    that, and what is predicted."""
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
