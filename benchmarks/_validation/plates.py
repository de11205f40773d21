"""Part ``plates``: plates pressed into dry sand, Pavlov and Johnson's measurements and the solver's prediction."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh
from matplotlib.figure import Figure
from scipy.optimize import minimize
from splatsoil.benchmarks._validation.page import Row, Section, percent
from splatsoil.benchmarks._validation.scene import STILL, FloatArray, Scene, lattice, resolution

from splatsoil.errors import MeasurementError, SimulationError
from splatsoil.mpm import Solver
from splatsoil.mpm.tool import Pose
from splatsoil.soil.matching import Matching
from splatsoil.soil.settings import Settings

DENSITY = 1330.0
DEPTHS = (0.005, 0.010, 0.015, 0.018)
DIAMETERS = (0.06, 0.08, 0.10)
TOUCH = 0.5
"""Force in N at which a plate is taken to stand on the sand."""
SPEED = 0.1
CELL, FINE = 0.0075, 0.005
"""Cells in m: the same under every plate, and finer to see what they do."""


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


@dataclass(frozen=True)
class Plate:
    """A quarter of a plate on a quarter of a bed, between smooth walls that stand for its symmetry; m, degrees, "
    "Pa."""

    diameter: float
    friction_angle: float
    young: float = 5.0e6
    tool_friction: float = 0.4
    cell: float = CELL
    seed: int = 0
    matching: Matching = Matching.COMPRESSION
    effects: tuple[str, ...] = ()
    values: tuple[tuple[str, float], ...] = ()

    def measure(self, device: str) -> FloatArray:
        """Forces (depths,) in N on the whole plate at ``DEPTHS`` below where it bears ``TOUCH``, each the mean of 1 mm.

        Raises:
            SimulationError: the plate does not bear as much on its way.
        """
        radius = 0.5 * self.diameter
        cell = self.cell
        wide, bed = cell * round(3.5 * radius / cell), cell * round(3.0 * radius / cell)
        x = lattice([0.0, 0.0, 0.0], [wide, wide, bed], 0.5 * cell, self.seed)
        thick = 0.03
        mesh = trimesh.creation.cylinder(radius=radius, height=thick, sections=64)
        settings = Settings(
            friction_angle=self.friction_angle,
            tool_friction=self.tool_friction,
            wall_friction=0.0,
            floor_friction=0.6,
            matching=self.matching,
        )
        scene = Scene(
            x,
            (wide, wide, bed + 4 * cell),
            resolution(cell, SPEED, density=DENSITY, young=self.young, transport=0.05),
            settings,
            self.effects,
            dict(self.values),
            mesh,
        )
        run = scene.solver(device)
        surface = settled(run, x[:, 2] > bed - 0.5 * cell, bed + 10.0 * thick)
        # contact begins where the plate's face reaches the uppermost particles
        start = np.array([0.0, 0.0, surface + 0.5 * thick])
        step = scene.resolution.frame_time
        way: list[float] = []
        force: list[float] = []
        touched = np.inf
        while not way or way[-1] - min(touched, DEPTHS[0]) < DEPTHS[-1] + 0.0005:
            k = len(way)
            pose = Pose(start - [0.0, 0.0, k * step * SPEED], STILL, np.array([0.0, 0.0, -SPEED]), np.zeros(3))
            force.append(4.0 * float(run.advance([pose])[0, 2]))
            way.append((k + 0.5) * step * SPEED)
            if force[-1] > TOUCH:
                touched = min(touched, way[-1])
        if not np.isfinite(touched):
            raise SimulationError(f"a plate of {1000 * self.diameter:g} mm never bears {TOUCH:g} N on its way")
        below, borne = np.array(way) - touched, np.array(force)
        return np.array([borne[np.abs(below - depth) < 0.0005].mean() for depth in DEPTHS])


def settled(run: Solver, top: npt.NDArray[np.bool_], away: float) -> float:
    """Mean height in m of the particles ``top`` (n,) once they rest; the plate waits at a height ``away``, m.

    Soil that gives way under its own weight has done so before a plate is set on it.
    """
    pose = Pose(np.array([0.0, 0.0, away]), STILL, np.zeros(3), np.zeros(3))
    height = float(run.positions()[0, top, 2].mean())
    for _ in range(30):
        for _ in range(5):
            run.advance([pose])
        before, height = height, float(run.positions()[0, top, 2].mean())
        if abs(height - before) < 2.0e-3 * run.resolution.cell:
            break
    return height


TARGET = 0.15
"""Asked of a prediction at every depth."""
#: What is fitted on the smallest plate, with start, first step and bounds; the exponents are decimal logarithms.
BASE = {"friction_angle": (28.0, 4.0, 20.0, 45.0)}
ELASTIC = {**BASE, "log_young": (6.0, -0.5, 5.0, 7.0)}
LOOSE = {
    "friction_angle": (33.0, 3.0, 20.0, 45.0),
    "looseness": (0.06, 0.03, 0.0, 0.1),
    "log_compaction_pressure": (3.5, 0.5, 2.0, 5.0),
}
MODELS = {
    "friction alone": (BASE, ()),
    "friction and a soft skeleton": (ELASTIC, ()),
    "friction and compaction": (LOOSE, ("compaction",)),
}


def similar(forces: FloatArray, diameter: float) -> float:
    """Force in N at the largest depth that forces (depths,) on the smallest plate mean for another diameter.

    Sand without cohesion whose law has no stress of its own bears D^3 f(z / D), whatever its friction or dilatancy.
    """
    factor = diameter / DIAMETERS[0]
    return float(np.interp(DEPTHS[-1] / factor, (0.0, *DEPTHS), (0.0, *forces))) * factor**3


def plate(names: tuple[str, ...], theta: FloatArray, effects: tuple[str, ...]) -> Plate:
    """The smallest plate under a model's parameters."""
    values = {n.removeprefix("log_"): 10.0**v if n.startswith("log_") else v for n, v in zip(names, theta, strict=True)}
    young = values.pop("young", 5.0e6)
    angle = values.pop("friction_angle")
    return Plate(DIAMETERS[0], float(angle), float(young), effects=effects, values=tuple(values.items()))


def fit(model: str, forces: FloatArray, device: str, most: int) -> Plate:
    """Parameters whose relative errors on the smallest plate are least, by Nelder and Mead's simplex."""
    parameters, effects = MODELS[model]
    names = tuple(parameters)
    start, step, low, high = (np.array(v) for v in zip(*parameters.values(), strict=True))

    def loss(theta: FloatArray) -> float:
        found = plate(names, theta, effects).measure(device)
        return float(np.mean((found / forces - 1.0) ** 2))

    simplex = np.vstack([start, start + np.diag(step)])
    options = {"maxfev": most, "xatol": 0.05, "fatol": 1e-4, "initial_simplex": simplex}
    best = minimize(loss, start, method="Nelder-Mead", bounds=list(zip(low, high, strict=True)), options=options)
    return plate(names, best.x, effects)


def validate(folder: Path, device: str) -> Section:
    """Fit each model on the 60 mm plate, predict the others."""
    trials = {d: measured(folder, d) for d in DIAMETERS}
    forces = {d: t.mean(axis=0) for d, t in trials.items()}
    rows, curves = [], {}
    for d, t in trials.items():
        spread = 100.0 * (t.max(axis=0) / t.min(axis=0) - 1.0)
        text = "/".join(f"{f:.1f}" for f in forces[d])
        rows.append(
            Row(
                f"measured, {1000 * d:.0f} mm",
                f"{text} N",
                f"trials differ by {spread.min():.0f} to {spread.max():.0f} %",
            )
        )
    for d in DIAMETERS[1:]:
        found, wanted = similar(forces[DIAMETERS[0]], d), forces[d][-1]
        held = abs(found / wanted - 1.0) <= TARGET
        case = f"no model: {1000 * d:.0f} mm at 18 mm from the 60 mm plate by similarity"
        rows.append(Row(case, f"{found:.1f} N ({percent(found, wanted)})", f"{wanted:.1f} N ± 15 %", held))
    for model in MODELS:
        best = fit(model, forces[DIAMETERS[0]], device, 15 * len(MODELS[model][0]))
        rows.append(Row(f"**{model}**, fitted on 60 mm", _values(best), "angle of repose 29°"))
        fine = replace(best, cell=FINE).measure(device)
        text = "/".join(f"{f:.1f}" for f in fine)
        rows.append(Row(f"{model}, 60 mm, the same on cells of {1000 * FINE:g} mm", f"{text} N", "reported"))
        for d in DIAMETERS:
            pressed = replace(best, diameter=d).measure(device)
            curves[model, d] = pressed
            error = pressed / forces[d] - 1.0
            worst = float(np.abs(error).max())
            held = None if d == DIAMETERS[0] else worst <= TARGET
            text = "/".join(f"{f:.1f}" for f in pressed)
            errors = "/".join(f"{100 * e:+.0f}" for e in error)
            name = "fit" if d == DIAMETERS[0] else "prediction"
            rows.append(Row(f"{model}, {1000 * d:.0f} mm ({name})", f"{text} N ({errors} %)", "each ± 15 %", held))
    return Section(
        "Real sand: plates",
        "Rigid circular plates pressed into dry sand of 1330 kg/m³ (Pavlov & Johnson, github.com/robomechanics/"
        "3d-terramechanics, MIT licence), three trials each; forces at 5/10/15/18 mm below where a plate bears "
        "0.5 N. A "
        f"quarter of plate and bed is simulated, with cells of {1000 * CELL:g} mm, pressed at {SPEED:g} m/s, "
        f"plate friction "
        "0.4, matched in compression. Each model is fitted on the 60 mm plate and predicts the others.",
        tuple(rows),
        "The target is missed, and the reason is not in the fit. Sand that is rigid until it fails bears a finite "
        "force at once and little more below, while the measured force grows from nothing: friction alone cannot have "
        "that curve. Compaction comes nearer to it: at 1330 kg/m³ half of the volume is voids, and loose sand gives "
        "way before it flows. But no law of cohesionless sand without a stress of its own can have the size: it bears "
        "D³ f(z/D), and by that similarity alone, without a model, the 60 mm plate gives far less than the larger "
        "plates measured. A stress scale (stiffness, compaction, falling friction) only makes larger plates "
        "softer. What is missing makes them stiffer: a floor near the plate, or a denser bed under the larger "
        "plates. Neither the box's depth nor the density of single beds is published with the data.",
        _figure(trials, curves),
    )


def _values(best: Plate) -> str:
    others = ", ".join(f"{name} {value:.3g}" for name, value in best.values)
    return f"φ = {best.friction_angle:.1f}°, E = {best.young:.2g} Pa" + (f", {others}" if others else "")


def _figure(trials: dict[float, FloatArray], curves: dict[tuple[str, float], FloatArray]) -> Figure:
    """Forces over depth, one panel a plate."""
    figure = Figure(figsize=(9, 3), layout="constrained")
    for axes, d in zip(figure.subplots(1, len(DIAMETERS)), DIAMETERS, strict=True):
        depth = 1000.0 * np.array(DEPTHS)
        for trial in trials[d]:
            axes.plot(depth, trial, "k.", markersize=4)
        for model in MODELS:
            axes.plot(depth, curves[model, d], label=model)
        axes.set(title=f"{1000 * d:.0f} mm", xlabel="depth, mm", ylabel="force, N", ylim=(0, None))
    axes.legend(fontsize=7)
    return figure
