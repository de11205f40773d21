"""A diagnosis as plain data: what ``diagnosis.json`` holds."""

from __future__ import annotations

from typing import Any

import numpy as np

from splatsoil.experiment.base import Calibration, Candidate, Experiment
from splatsoil.run_files import DIAGNOSIS_FORMAT, MISFIT_FORMAT

from .confirmation import Confirmation
from .diagnosis import Diagnosis
from .misfit import Block, Omnibus
from .outside import StrengthReading
from .words import of_estimates, sentences


def record(experiment: Experiment, diagnosis: Diagnosis) -> dict[str, Any]:
    """Everything a reader, a report or another command may ask for."""
    candidates = {c.name: c for c in experiment.candidates}
    layout = experiment.layout
    scale = diagnosis.floor.noise.spread(diagnosis.floor.noise.scale)
    return {
        "format": DIAGNOSIS_FORMAT,
        "experiment": experiment.name,
        "model": list(experiment.model),
        "verdict": diagnosis.verdict,
        "class": list(diagnosis.members),
        "sentences": sentences(diagnosis, candidates, diagnosis.evidence.values, _still(experiment)),
        "effects": [_effect(diagnosis, candidates[name]) for name in _order(diagnosis)],
        "simulations": diagnosis.simulations,
        "values": dict(diagnosis.evidence.values),
        "estimates": {
            name: {
                "value": e.value,
                "std": e.std,
                "noise": e.noise,
                "systematic": e.systematic,
                "determined": bool(e.determined),
            }
            for name, e in diagnosis.estimates.items()
        },
        "misfit": _omnibus(diagnosis.misfit),
        "whole": _block(diagnosis.whole),
        "whole_after": None if diagnosis.whole_after is None else _block(diagnosis.whole_after),
        "remainder": None if diagnosis.remainder is None else _omnibus(diagnosis.remainder),
        "explained": diagnosis.explained,
        "refits": {name or "as it is": confirmation(c) for name, c in diagnosis.confirmations.items()},
        "confusion": [{"effects": [a, b], "correlation": round(v, 4)} for (a, b), v in diagnosis.confusion.items()],
        "blocks": [
            {"stage": b.stage, "region": b.region, "channel": b.channel, "ratio": b.ratio, "p": b.p, "n": b.features}
            for b in diagnosis.blocks
        ],
        "where": [
            {"stage": s, "region": r, "channel": c, "share": v}
            for (s, r, c), v in sorted(diagnosis.where.items(), key=lambda item: -item[1])
        ],
        "floor": {name: diagnosis.floor.share(name, layout.common) for name in diagnosis.floor.parts},
        "calibration": _calibration(experiment, diagnosis.evidence.calibration),
        "unit": layout.unit,
        "time_name": layout.time_name,
        "times": list(layout.times),
        "stages": list(layout.stages),
        # What has no place is drawn as curves instead.
        "sites": [
            [s.channel, *((s.x, s.y) if there else (None, None))]
            for s, there in zip(layout.sites, layout.placed, strict=True)
        ],
        "curves": [_curve(experiment, diagnosis, column) for column, there in enumerate(layout.placed) if not there],
        # In units of each feature's noise; null where nothing is seen.
        "maps": {
            "before": _map(diagnosis.residual, scale, experiment),
            **{
                name: _map(experiment.observed - c.fit.prediction, scale, experiment)
                for name, c in diagnosis.confirmations.items()
                if name
            },
        },
        "strength": None if diagnosis.strength is None else _strength(diagnosis.strength),
        "strokes": [{"effects": list(s.pair), "alike": dict(s.alike), "best": s.best} for s in diagnosis.strokes],
        "notes": list(diagnosis.notes),
    }


def misfit_record(experiment: Experiment, diagnosis: Diagnosis) -> dict[str, Any]:
    """Only how far the model is from the data, where and when."""
    whole = record(experiment, diagnosis)
    kept = ("misfit", "whole", "blocks", "floor", "values")
    drawn = ("unit", "time_name", "times", "stages", "sites", "curves", "maps")
    adequate = diagnosis.verdict == "adequate"
    return {
        "format": MISFIT_FORMAT,
        "adequate": adequate,
        "estimates": whole["estimates"] if adequate else {},
        "sentences": of_estimates(diagnosis.estimates) if adequate else [],
        "simulations": diagnosis.simulations,
        **{key: whole[key] for key in kept + drawn},
    }


def _order(diagnosis: Diagnosis) -> list[str]:
    """Members first, the rest by how much they would explain."""
    rest = sorted(
        (n for n in diagnosis.effects if n not in diagnosis.members),
        key=lambda name: diagnosis.scores[name].statistic,
        reverse=True,
    )
    return [*diagnosis.members, *rest]


def _still(experiment: Experiment) -> frozenset[str]:
    """Regions in which none of the model's physics acts."""
    regions, seen = experiment.layout.regions, experiment.seen
    return frozenset(str(r) for r in np.unique(regions[seen]) if experiment.quiet[seen & (regions == r)].all())


def _effect(diagnosis: Diagnosis, candidate: Candidate) -> dict[str, Any]:
    score, beside = diagnosis.scores[candidate.name], diagnosis.given.get(candidate.name)
    measure = candidate.measure
    off = float(measure.off or 0.0)
    entry = {
        "name": candidate.name,
        "kind": candidate.kind,
        "note": candidate.note,
        "verdict": diagnosis.effects[candidate.name],
        "parameter": measure.name,
        "z": score.z,
        "p": score.adjusted,
        "p_alone": score.p,
        "estimate": off + score.estimate,
        "std": score.std,
        "unit": measure.unit,
        "off": off,
        "meaningful": measure.meaningful,
        "mde": score.detectable,
        "predicted_fall": score.statistic,
        "survival": score.survival,
        "reliability": score.reliability,
        "given_best": None if beside is None else {"z": beside.z, "p": beside.adjusted, "mde": beside.detectable},
    }
    confirmed = diagnosis.confirmations.get(candidate.name)
    if confirmed is not None:
        entry["estimate"], entry["std"] = confirmed.values[measure.name], confirmed.stds[measure.name]
        entry["achieved_fall"] = confirmed.fall
    return entry


def confirmation(c: Confirmation) -> dict[str, Any]:
    """A refit and how it was judged."""
    return {
        "values": dict(c.values),
        "stds": dict(c.stds),
        "systematic": dict(c.systematic),
        "chi2": c.chi2,
        "dispersion": c.dispersion,
        "fall": c.fall,
        "told": c.told,
        "agrees": c.agrees,
        "held_out": c.held_out,
        "floor": c.floor,
        "remainder": _omnibus(c.remainder),
        "simulations": c.fit.simulations,
        "stopped": c.stopped,
    }


def _calibration(experiment: Experiment, found: Calibration | None) -> list[dict[str, Any]]:
    """What the pictures say of parameters of observation where soil plays no part."""
    if found is None:
        return []
    known = {p.name: p for c in experiment.candidates for p in c.parameters}
    return [
        {
            "parameter": name,
            "estimate": float(known[name].off or 0.0) + float(value),
            "std": float(std),
            "unit": known[name].unit,
            "meaningful": known[name].meaningful,
        }
        for name, value, std in zip(found.names, found.estimate, found.deviation, strict=True)
    ]


def _strength(found: StrengthReading) -> dict[str, Any]:
    """A free strength: curves over what the soil went through, and what they look like."""
    return {
        "readings": list(found.readings),
        "explained": found.explained,
        "misfit": _omnibus(found.misfit),
        "values": dict(found.held),
        "scale": found.scale,
        "shapes": [
            {
                "argument": s.argument,
                "reading": s.reading,
                "log_evidence": s.evidence,
                "change": s.change,
                "change_std": s.std,
                **{key: [float(v) for v in getattr(s, key)] for key in ("at", "factor", "low", "high")},
            }
            for s in found.shapes
        ],
    }


def _block(whole: Block) -> dict[str, float]:
    return {"ratio": whole.ratio, "p": whole.p, "n": whole.features}


def _omnibus(test: Omnibus) -> dict[str, float]:
    return {"chi2": test.statistic, "freedom": test.freedom, "p": test.p, "dispersion": test.dispersion}


def _curve(experiment: Experiment, diagnosis: Diagnosis, column: int) -> dict[str, Any]:
    """An instrument without a place: what it measured, what is predicted, and how far these may lie apart."""
    layout, seen, floor = experiment.layout, experiment.seen, diagnosis.floor
    std = floor.single.spread(floor.single.plus(floor.nuisance).scale)
    predicted = {"before": diagnosis.evidence.mean}
    predicted |= {name: c.fit.prediction for name, c in diagnosis.confirmations.items() if name}

    def values(table: np.ndarray) -> list[float | None]:
        return [float(v) if there else None for v, there in zip(table[:, column], seen[:, column], strict=True)]

    return {
        "channel": layout.sites[column].channel,
        "unit": layout.sites[column].unit or layout.unit,
        "measured": values(experiment.observed),
        "std": values(std),
        "predicted": {name: values(table) for name, table in predicted.items()},
    }


def _map(residual: np.ndarray, scale: np.ndarray, experiment: Experiment) -> list[list[float | None]]:
    ratio = np.where(experiment.seen, residual / np.maximum(scale, 1e-300), np.nan)
    return [[None if not np.isfinite(v) else round(float(v), 2) for v in row] for row in ratio]
