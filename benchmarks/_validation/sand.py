"""Part ``triaxial``: one sand through its triaxial tests, from some of them to the others, and its diagnoses.

Misfits are root mean squares in units of what specimens of one density differ by (q/p: 0.04, volume strain: 0.005).
Tests right of an arrow are predicted. Data: docs/real-sand.md.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from splatsoil.benchmarks._common import FloatArray
from splatsoil.benchmarks._parts import Row, Section
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.errors import MeasurementError
from splatsoil.experiment.base import Run
from splatsoil.experiment.laboratory import Specimen
from splatsoil.experiment.triaxial import TriaxialExperiment
from splatsoil.laboratory.answer import diagnosed, search
from splatsoil.laboratory.folder import read_curve, together
from splatsoil.report.text import probability, verdict
from splatsoil.soil.packing import at_void_ratio, of_limits

LIMITS = (0.677, 1.054)
"""Void ratios of Karlsruhe fine sand in index tests, densest and loosest (Wichtmann & Triantafyllidis 2016)."""
VOID_RATIOS = {"TMD2": 0.9753, "TMD22": 0.7351}
CULLINAN = {"TX13": ("CD400", 4e5, 0.7734), "TX16": ("CD50", 5e4, 0.6757), "TX17": ("CD100", 1e5, 0.7018)}
"""File, confining pressure in Pa and void ratio of the drained tests on Cullinan sand."""
LADDER: tuple[tuple[str, ...], ...] = (
    (),
    ("critical_state",),
    ("critical_state", "hardening"),
    ("critical_state", "hardening", "pressure_dependence"),
)
"""Models, each with an effect more."""
HUNDRED = {"pressure_reference": 1e5}
"""The friction angle of a curved envelope is that at 100 kPa, Pa."""


def karlsruhe(folder: Path) -> dict[str, Specimen]:
    """The loose and the dense test, by name.

    Raises:
        MeasurementError: the file is missing.
    """
    file = folder / "karlsruhe_triaxial" / "tmd2_loose_tmd22_dense_subset.csv"
    try:
        with file.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
    except OSError as error:
        raise MeasurementError(f"cannot be read ({error.strerror})", file=file) from error
    out = {}
    for name, void_ratio in VOID_RATIOS.items():
        columns = ("eps_a[%]", "eps_v[%]", "sigma_r[kPa]", "sigma_v[kPa]")
        table = np.array([[float(row[c]) for c in columns] for row in rows if row["test_id"] == name])[1:]
        radial, axial = 1e3 * table[:, 2], 1e3 * table[:, 3]
        ratio = (axial - radial) / ((axial + 2.0 * radial) / 3.0)
        out[name] = Specimen(name, table[:, 0] / 100.0, table[:, 1] / 100.0, ratio, 1e5, void_ratio=void_ratio)
    return out


def cullinan(folder: Path) -> dict[str, Specimen]:
    """The drained tests, by name.

    Raises:
        MeasurementError: a file is missing or damaged.
    """
    curves = [
        read_curve(folder / "cullinan_sand" / f"triaxial_{name}_{what}.csv", pressure, void_ratio)
        for name, (what, pressure, void_ratio) in CULLINAN.items()
    ]
    return dict(zip(CULLINAN, together(curves), strict=True))


def calibrated(
    curves: Sequence[Specimen], effects: tuple[str, ...], known: Mapping[str, float] | None = None
) -> dict[str, float]:
    """All parameters of a model, those of least squares and those known, at the first curve's void ratio."""
    experiment = TriaxialExperiment(curves, effects, candidates=(), known=known)
    values, _ = search(experiment, Simulations(experiment), 0, lambda what, share: None)
    return experiment.values(values)


def misfit(curve: Specimen, effects: tuple[str, ...], values: Mapping[str, float], before: float) -> FloatArray:
    """(2,) root mean squares of q/p and volume strain, in spreads between specimens, by parameters at another void
    ratio."""
    experiment = TriaxialExperiment([curve], effects, candidates=())
    table = experiment.predict(Run(at_void_ratio(values, before, curve.void_ratio)))
    return np.asarray(np.sqrt(np.mean((table - experiment.observed) ** 2, axis=0)))


def from_one_to_another(
    name: str,
    curves: Mapping[str, Specimen],
    fit: Sequence[str],
    ladder: Sequence[tuple[str, ...]],
    known: Mapping[str, float],
) -> list[Row]:
    """A ladder of models, fitted on some tests and held against the others."""
    rows, errors = [], []
    for effects in ladder:
        values = calibrated([curves[test] for test in fit], effects, known)
        before = curves[fit[0]].void_ratio
        found = {test: misfit(curve, effects, values, before) for test, curve in curves.items() if test not in fit}
        errors.append(float(np.mean([np.sum(f**2) for f in found.values()])))
        text = "; ".join(f"{test} q/p {f[0]:.1f}, volume {f[1]:.1f}" for test, f in found.items())
        better = None if len(errors) == 1 else errors[-1] < errors[-2]
        told = "reported" if better is None else "less than without the last effect"
        model = " + ".join(("base", *effects))
        rows.append(Row(f"{name}: {model}; φ = {values['friction_angle']:.1f}°", text, told, better))
    return rows


def told(name: str, curves: Sequence[Specimen], effects: tuple[str, ...]) -> Row:
    """What a diagnosis says of a model."""
    experiment = TriaxialExperiment(curves, effects)
    found = diagnosed(experiment, None, 0, lambda what, share: None)
    likely = [m for m in found["models"] if m["name"] and m["kind"] != "discrepancy"][:2]
    shares = ", ".join(f"{m['name']} {probability(m['probability'])}" for m in likely)
    angle = found["estimates"]["friction_angle"]
    model = " + ".join(("base", *effects))
    text = f"{verdict(found)} Most probable: {shares}. φ = {angle['value']:.1f} ± {angle['std']:.1f}°"
    return Row(f"{name}: diagnosis of {model}", text, "reported")


def validate(device: str, folder: Path) -> Section:
    """Every way from some tests to others."""
    del device
    sand, other = karlsruhe(folder), cullinan(folder)
    rows: list[Row] = []
    for way, test in (("loose → dense", "TMD2"), ("dense → loose", "TMD22")):
        known = of_limits(sand[test].void_ratio, *LIMITS)
        rows += from_one_to_another(f"Karlsruhe, {way}", sand, [test], LADDER[:3], known)
    for test in other:
        fit = [name for name in other if name != test]
        rows += from_one_to_another(f"Cullinan, {' and '.join(fit)} → {test}", other, fit, LADDER, HUNDRED)
    for effects in LADDER[:3]:
        rows.append(told("Karlsruhe, dense", [sand["TMD22"]], effects))
    for effects in LADDER:
        rows.append(told("Cullinan, all three", list(other.values()), effects))
    try:
        read_curve(folder / "cullinan_sand" / "triaxial_TX4_CU100.csv", 1e5)
    except MeasurementError as error:
        rows.append(Row("Cullinan, TX4", str(error).split(": ", 1)[-1], "undrained: refused", True))
    return Section("Triaxial tests", rows)
