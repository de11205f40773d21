"""Part ``plates``: plates pressed into dry sand, from triaxial tests of the same sand and from one plate to another."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from splatsoil.benchmarks._validation.page import Row, Section
from splatsoil.benchmarks._validation.sand import LADDER, calibrated, cullinan
from splatsoil.benchmarks._validation.scene import FloatArray

from splatsoil.errors import MeasurementError
from splatsoil.experiment.plate import PlateExperiment
from splatsoil.measurement.fields import read_table
from splatsoil.mpm import Preset, Resolution
from splatsoil.soil.packing import at_void_ratio

DENSITY = 1330.0
DEPTHS = (0.005, 0.010, 0.015, 0.018)
DIAMETERS = (0.06, 0.08, 0.10)
TOUCH = 0.5
"""Force in N at which a plate is taken to stand on the sand."""
TARGET = 0.15
"""Asked of a prediction at every depth of the CMU plates."""
AREA, GRAINS = 0.018, 2650.0
"""Of the plate on Cullinan sand, m²; density of quartz, kg/m³."""
SINKAGES = (0.010, 0.020, 0.040, 0.080)
"""At which pressures on Cullinan sand are compared, m."""
COMPACTED = 1511.0
"""Dry density of the strongly compacted bed (method 4), kg/m³; that of method 2 is not told."""
WITHIN = 0.30
"""Asked of a prediction there."""
ANGLES = (28.0, 34.0, 40.0, 46.0)
"""Of the base law, between which friction is read off a plate, degrees."""
REACHED = np.arange(1, 54) * 0.01
"""Depths over the diameter at which the base law's plate is read."""
CELLS = (4, 8, 16)
"""Across the plate, to see what they do, at an angle of 35°."""
GRAVITY = 9.81


def measured(folder: Path, diameter: float) -> FloatArray:
    """Forces (trials, depths) in N at ``DEPTHS`` below where the plate first bears ``TOUCH``.

    Raises:
        MeasurementError: no trials of that diameter, or one that does not go deep enough.
    """
    files = sorted((folder / "cmu_plates").glob(f"plate_{1000 * diameter:.0f}mm_trial*.csv"))
    if not files:
        raise MeasurementError(f"no trials of the plate of {1000 * diameter:.0f} mm", file=folder / "cmu_plates")
    trials = []
    for file in files:
        with file.open(newline="") as stream:
            rows = [(1e-3 * float(row["Z_mm"]), -float(row["Fz_N"])) for row in csv.DictReader(stream)]
        table = np.array(rows)
        table = table[: int(np.argmin(table[:, 0])) + 1]
        table = table[int(np.argmax(table[:, 1] > TOUCH)) :]
        depth = np.maximum.accumulate(table[0, 0] - table[:, 0])
        if depth[-1] < DEPTHS[-1]:
            raise MeasurementError(f"the plate goes only {1000 * depth[-1]:.1f} mm deep", file=file)
        trials.append(np.interp(DEPTHS, depth, table[:, 1]))
    return np.array(trials)


def bearing(
    depth: FloatArray,
    values: Mapping[str, float],
    effects: tuple[str, ...] = (),
    *,
    diameter: float = 0.1,
    density: float = 1600.0,
    pressure: float = 0.0,
    cells: int | None = None,
    per_edge: int = 2,
    device: str = "cpu",
) -> FloatArray:
    """Pressures (n,) under a plate over half of density, gravity and diameter, at depths (n,) over the diameter.

    Args:
        depth: increasing.
        values: parameters of the model.
        effects: that are on.
        diameter: m.
        density: kg/m³.
        pressure: largest that is expected, Pa; the skeleton is as stiff as that asks for.
        cells: across the plate; those of the preset `small` if None.
        per_edge: particles along a cell's edge; for other cells only.
        device: Warp device name.
    """
    area = 0.25 * math.pi * diameter**2
    forces = np.full(len(depth), max(pressure * area, 1.0))
    experiment = PlateExperiment(
        diameter, depth * diameter, forces, 0.1, density=density, effects=effects, candidates=(), device=device
    )
    if cells is not None:
        chosen = Preset("study", cells_across_tool=cells, particles_per_edge=per_edge)
        experiment.resolution = Resolution.derive(experiment.set_up(), chosen)
    return np.asarray(experiment.readings(values)[:, 0] / area / (0.5 * density * GRAVITY * diameter))


def vesic(angle: float, depth: float) -> float:
    """Bearing capacity of a circle over half of density, gravity and diameter, at a depth over the diameter: Vesic
    (1973), J. Soil Mech. Found. Div. 99(1)."""
    tangent = math.tan(math.radians(angle))
    surcharge = math.exp(math.pi * tangent) * math.tan(math.radians(45.0 + 0.5 * angle)) ** 2
    return 0.6 * 2.0 * (surcharge + 1.0) * tangent + 2.0 * depth * surcharge * (1.0 + tangent)


def meyerhof(angle: float, depth: float) -> float:
    """The same by Meyerhof (1963, Can. Geotech. J. 1(1))."""
    passive = math.tan(math.radians(45.0 + 0.5 * angle)) ** 2
    surcharge = math.exp(math.pi * math.tan(math.radians(angle))) * passive
    weight = (surcharge - 1.0) * math.tan(math.radians(1.4 * angle))
    return (weight + 2.0 * depth * surcharge) * (1.0 + 0.1 * passive)


def read_off(curves: Mapping[float, FloatArray], depths: FloatArray, measured: FloatArray) -> FloatArray:
    """Friction angles (n,) in degrees at which the base law bears measured pressures (n,) at depths (n,), both over the
    plate's own units; linear in the pressure's logarithm, at most the ends of what was simulated."""
    angles = np.array(sorted(curves))
    borne = np.array([np.interp(depths, REACHED, curves[angle]) for angle in angles])
    # rising with friction, as far as the cell's wave lets it
    rising = np.maximum.accumulate(np.log(borne), axis=0)
    return np.array([np.interp(math.log(p), rising[:, k], angles) for k, p in enumerate(measured)])


def at(curves: Mapping[float, FloatArray], angle: float, depths: FloatArray) -> FloatArray:
    """Pressures (n,) of the base law at an angle in degrees and at depths (n,), in the plate's own units."""
    angles = np.array(sorted(curves))
    borne = np.log([np.interp(depths, REACHED, curves[a]) for a in angles])
    return np.exp([np.interp(angle, angles, borne[:, k]) for k in range(len(depths))])


def similar(forces: FloatArray, diameter: float) -> float:
    """Force in N at the largest depth that forces (depths,) on the smallest plate mean for another diameter.

    Sand without cohesion whose law has no stress of its own bears D^3 f(z / D), whatever its friction or dilatancy.
    """
    factor = diameter / DIAMETERS[0]
    return float(np.interp(DEPTHS[-1] / factor, (0.0, *DEPTHS), (0.0, *forces))) * factor**3


def refinement(device: str) -> list[Row]:
    """What cells and particles do, and theory."""
    rows, depth = [], np.arange(1, 31) * 0.01
    asked = np.array([0.1, 0.2, 0.3])
    for angle in (30.0, 35.0):
        text = "; ".join(f"{vesic(angle, z):.0f} … {meyerhof(angle, z):.0f}" for z in asked)
        rows.append(Row(f"theory, φ = {angle:g}°, z/D = 0.1; 0.2; 0.3: Vesic … Meyerhof", text, "reported"))
    for cells, per_edge in (*((c, 2) for c in CELLS), (8, 3)):
        reach = depth if cells < 16 else depth[:20]
        found = bearing(reach, {"friction_angle": 35.0}, cells=cells, per_edge=per_edge, device=device)
        # over one cell's depth, because forces wave by the cell
        half = 0.5 / cells
        means = [float(found[np.abs(reach - z) <= half].mean()) for z in asked if z <= reach[-1]]
        inside = all(vesic(30.0, z) <= m <= meyerhof(35.0, z) for z, m in zip(asked, means, strict=False))
        text = "; ".join(f"{m:.0f}" for m in means)
        rows.append(
            Row(
                f"φ = 35°, {cells} cells across, {per_edge}³ particles a cell", text, "Vesic 30° … Meyerhof 35°", inside
            )
        )
    return rows


def cmu(folder: Path, curves: Mapping[float, FloatArray]) -> list[Row]:
    """Friction from the smallest plate, the others predicted."""
    rows = []
    forces = {d: measured(folder, d).mean(axis=0) for d in DIAMETERS}
    unit = {d: 0.5 * DENSITY * GRAVITY * d * 0.25 * math.pi * d**2 for d in DIAMETERS}
    depths = np.array(DEPTHS)
    angles = read_off(curves, depths / DIAMETERS[0], forces[DIAMETERS[0]] / unit[DIAMETERS[0]])
    angle = float(angles.mean())
    text = "/".join(f"{a:.0f}" for a in angles)
    rows.append(Row("CMU, 60 mm: φ read off at 5/10/15/18 mm", f"{text}°; mean {angle:.1f}°", "one angle; repose 29°"))
    for d in DIAMETERS[1:]:
        found = at(curves, angle, depths / d) * unit[d]
        error = found / forces[d] - 1.0
        text = "/".join(f"{f:.0f}" for f in found) + " N (" + "/".join(f"{100 * e:+.0f}" for e in error) + " %)"
        rows.append(Row(f"CMU, {1000 * d:.0f} mm from 60 mm", text, "each ± 15 %", bool(np.abs(error).max() <= TARGET)))
        borne, wanted = similar(forces[DIAMETERS[0]], d), forces[d][-1]
        text = f"{borne:.0f} N ({100 * (borne / wanted - 1):+.0f} %)"
        case = f"CMU, {1000 * d:.0f} mm at 18 mm by similarity alone, no model"
        rows.append(Row(case, text, f"{wanted:.0f} N ± 15 %", abs(borne / wanted - 1.0) <= TARGET))
    return rows


def pressures(folder: Path, name: str) -> FloatArray:
    """(4,) measured pressures in Pa at `SINKAGES`."""
    table = read_table(folder / "cullinan_sand" / f"plate_{name}.csv", ("sinkage_mm", "pressure_kpa"))
    # the plate was lifted in between
    return 1e3 * np.interp(SINKAGES, 1e-3 * np.maximum.accumulate(table[:, 0]), table[:, 1])


def of_cullinan(folder: Path, curves: Mapping[float, FloatArray], device: str) -> list[Row]:
    """Plates by triaxial tests, and friction by plates."""
    rows = []
    diameter = math.sqrt(4.0 * AREA / math.pi)
    unit = 0.5 * COMPACTED * GRAVITY * diameter
    borne = {
        "method 4": pressures(folder, "method4_test_1"),
        "method 2": 0.5 * (pressures(folder, "method2_test_1") + pressures(folder, "method2_test_2")),
    }
    for name, wanted in borne.items():
        rows.append(Row(f"Cullinan, {name}, measured at 10/20/40/80 mm", _kilo(wanted), "reported"))
    tests = cullinan(folder)
    before = tests["TX13"].void_ratio
    for effects in LADDER[:3]:
        values = calibrated(list(tests.values()), effects)
        values = {n: v for n, v in values.items() if n != "stiffness_factor"}
        values = at_void_ratio(values, before, GRAINS / COMPACTED - 1.0)
        found = (
            unit
            * bearing(
                np.array([0.5 * SINKAGES[0], *SINKAGES]) / diameter,
                values,
                effects,
                diameter=diameter,
                density=COMPACTED,
                pressure=4e5,
                device=device,
            )[1:]
        )
        error = found / borne["method 4"] - 1.0
        text = f"{_kilo(found)} (" + "/".join(f"{100 * e:+.0f}" for e in error) + " %)"
        dense = f", I_D = {values['relative_density']:.2f}" if effects else ""
        case = f"Cullinan, method 4 from triaxial tests: {' + '.join(('base', *effects))}{dense}"
        rows.append(Row(case, text, "each ± 30 %", bool(np.abs(error).max() <= WITHIN)))
    for name, wanted in borne.items():
        angles = read_off(curves, np.array(SINKAGES) / diameter, wanted / unit)
        beyond = angles >= ANGLES[-1]
        text = "/".join("> 46" if over else f"{a:.0f}" for a, over in zip(angles, beyond, strict=True)) + "°"
        held = not beyond.any() and abs(float(angles.mean()) - 35.0) <= 2.0 * float(angles.std(ddof=1))
        rows.append(
            Row(f"Cullinan, {name}: φ read off at 10/20/40/80 mm", text, "one angle, 32 to 36° (triaxial)", held)
        )
    return rows


def _kilo(pressure: FloatArray) -> str:
    return "/".join(f"{p / 1e3:.0f}" for p in pressure) + " kPa"


def validate(folder: Path, device: str) -> Section:
    """Refinement, both sands."""
    curves = {angle: bearing(REACHED, {"friction_angle": angle}, device=device) for angle in ANGLES}
    rows = [*refinement(device), *cmu(folder, curves), *of_cullinan(folder, curves, device)]
    figure = Figure(figsize=(4.5, 3), layout="constrained")
    axes = figure.subplots()
    for angle, curve in curves.items():
        axes.plot(REACHED, curve, label=f"{angle:g}°")
    axes.set(xlabel="depth over diameter", ylabel="pressure / (ρ g D / 2)")
    axes.legend(fontsize=7)
    return Section(
        "Plates",
        "Flat circular plates, of which a quarter is simulated with 8 cells across and Matsuoka and Nakai's surface "
        "unless a row says otherwise. Pressures of cohesionless sand without a stress of its own are ρ g D f(z/D)/2: "
        "one curve for each friction angle serves all plates. CMU: 60, 80 and 100 mm on dry sand of 1330 kg/m³ "
        "(Pavlov & Johnson, github.com/robomechanics/3d-terramechanics, MIT licence). Cullinan: 0.018 m², strongly "
        "(method 4, 1511 kg/m³) and lightly (method 2) compacted (Kruger, Els & Hamersma 2023, CC BY 4.0).",
        tuple(rows),
        figure=figure,
    )
