"""Folders that hold a test: ``experiment.json`` with its ``kind``, and tables of readings beside it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from splatsoil.arrays import FloatArray
from splatsoil.errors import MeasurementError, ParameterError
from splatsoil.experiment.base import Run
from splatsoil.experiment.column import Collapse, ColumnExperiment
from splatsoil.experiment.laboratory import LaboratoryExperiment, Specimen
from splatsoil.experiment.plate import GRAVITY, Loading, PlateExperiment
from splatsoil.experiment.shear_box import ReposeExperiment, ShearBoxExperiment
from splatsoil.experiment.triaxial import TriaxialExperiment
from splatsoil.files import write_text
from splatsoil.measurement.fields import Fields, read_table, read_text
from splatsoil.measurement.measurement import EXPERIMENT
from splatsoil.measurement.writer import whole_folder, write_json
from splatsoil.soil.effect import Effect
from splatsoil.soil.packing import of_limits

FORMAT = "splatsoil-laboratory/1"
STRAINS = np.concatenate([np.arange(0.005, 0.0201, 0.005), np.arange(0.03, 0.301, 0.01)])
"""At which curves are read."""
FEWEST = 4
"""Readings of a curve."""
PORE_PRESSURE = 0.1
"""Of the confining pressure: a specimen in which it changes by more is not drained."""
HEIGHT = 0.02
"""Of the example's shear box, m."""
GRAINS = 2650.0
"""Density of quartz, kg/m³."""
PLATE_READINGS = 12
"""Depths at which a plate's force is read, evenly from a twelfth of the largest on."""
ANGLES = (3.0, 80.0)
"""Of friction, °, that soils mobilise, cohesive ones at small stresses included."""
CRUSHING = 1e7
"""Pressure at which grains of sand crush (Yamamuro, Bopp & Lade 1996, J. Geotech. Eng. 122:147), Pa."""
SINKAGES = (0.01, 3.0)
"""Of a plate, in its diameters."""
SPREADING = (0.8, 10.0)
"""Square of a deposit's radius times its height, by the column's: 3 for a cone, about 5 where columns were high (Lube
et al. 2004, J. Fluid Mech. 508:175)."""
DENSITIES = (-0.25, 1.25)
"""Relative densities that are poured or tamped, beyond those of index tests."""
TRIALS_DIFFER = 0.1
"""Relative standard deviation of a plate's force between trials, where too few estimate it: the nine trials
of Pavlov & Johnson (github.com/robomechanics/3d-terramechanics) have ranges of 5 to 21 %."""


@dataclass(frozen=True)
class Options:
    """How a test is modelled.

    Attributes:
        effects: that are on.
        candidates: effects to consider; all that can act if None.
        preset: resolution of the solver, where there is one.
        device: Warp device name.
    """

    effects: tuple[str | Effect, ...] = ()
    candidates: tuple[str | Effect, ...] | None = None
    preset: str = "small"
    device: str = "cpu"

    @property
    def model(self) -> dict[str, Any]:
        """What a test at one stress point takes."""
        return {"effects": self.effects, "candidates": self.candidates}

    @property
    def simulation(self) -> dict[str, Any]:
        """What a test that the solver runs takes."""
        return {**self.model, "preset": self.preset, "device": self.device}


def load(folder: Path, options: Options | None = None) -> LaboratoryExperiment:
    """The test in a folder.

    Raises:
        MeasurementError: what is wrong with it, by file and field.
        ParameterError: an effect or preset that is unknown.
    """
    fields = Fields.read(folder / EXPERIMENT)
    kind = fields.text("kind")
    if kind not in KINDS:
        fields.fail("kind", f"{kind!r} is no kind of test; known are {', '.join(KINDS)}")
    if fields.text("format") != FORMAT:
        fields.fail("format", f"expected {FORMAT!r}")
    fields.name("name")
    repeated = "tests" if "file" in KINDS[kind].each else "trials"
    fields.check_names(("format", "kind", "name", repeated, *KINDS[kind].fields))
    for one in fields.children(repeated):
        one.check_names(KINDS[kind].each)
    return KINDS[kind].read(fields, folder, options or Options())


def simulate(
    kind: str, out: Path, values: Mapping[str, float], effects: Sequence[str | Effect], preset: str, seed: int
) -> LaboratoryExperiment:
    """Write a test of known soil, without errors of reading.

    Raises:
        ParameterError: values that the model doesn't take.
        MeasurementError: the folder is not empty, or its name is none for a set.
    """
    shape = KINDS[kind].example(out.name or kind, Options(tuple(effects), preset=preset))
    shape.law(()).require_on({**shape.values(values), **_off(shape, values)})
    with whole_folder(out) as root:
        description, tables = KINDS[kind].write(shape, shape.readings(Run(values, seed=seed)))
        write_json(root / EXPERIMENT, {"format": FORMAT, "kind": kind, "name": out.name or kind, **description})
        for name, text in tables.items():
            write_text(root / name, text)
        load(root)
    return shape


def _off(shape: LaboratoryExperiment, values: Mapping[str, float]) -> dict[str, float]:
    """A stiffness that nobody asked for, where tests always have one: as if it were asked for."""
    always = "stiffness" in shape.always and "stiffness_factor" not in values
    return {"stiffness_factor": 1.0 + 1e-9} if always else {}


def _csv(columns: Mapping[str, FloatArray]) -> str:
    rows = zip(*columns.values(), strict=True)
    return "\n".join([",".join(columns), *(",".join(f"{v:.6g}" for v in row) for row in rows)]) + "\n"


def _header(file: Path) -> str:
    """The names of a table's columns, in small letters."""
    lines = [line for line in read_text(file).splitlines() if line.strip()]
    return lines[0].lower() if lines else ""


def _tests(fields: Fields, folder: Path) -> Iterator[tuple[Fields, Path]]:
    """Each test and its table."""
    seen: set[Path] = set()
    for test in fields.children("tests"):
        file = test.path("file", folder, folder)
        if file in seen:
            test.fail("file", f"{file.name} is given twice")
        seen.add(file)
        yield test, file


def _first(values: FloatArray) -> npt.NDArray[np.bool_]:
    """Which of the values (n,) are larger than all before: readings of first loading, without what was unloaded and
    loaded again in between."""
    return np.concatenate([[True], values[1:] > np.maximum.accumulate(values)[:-1]])


def _at_strains(file: Path, what: str, strain: FloatArray, *curves: FloatArray) -> tuple[FloatArray, ...]:
    """Those of `STRAINS` that are reached, and curves (n,) over strains (n,) there, in first loading.

    Raises:
        MeasurementError: too few readings, or strains in another unit.
    """
    loading, largest = _first(strain), float(strain.max())
    kept = STRAINS[largest * 1.0001 >= STRAINS]
    if len(kept) < FEWEST:
        fault = f"ends before {what} {100 * STRAINS[FEWEST - 1]:g} %; is it positive, and in its column's unit?"
        raise MeasurementError(fault, file=file)
    if largest > 10.0:
        raise MeasurementError(f"reaches {what} {100 * largest:g} %; is it in its column's unit?", file=file)
    if loading.sum() < FEWEST:
        raise MeasurementError(f"has {loading.sum()} readings of first loading, fewer than {FEWEST}", file=file)
    return kept, *(np.interp(kept, strain[loading], curve[loading]) for curve in curves)


def _check_strength(file: Path, column: str, degrees: float) -> None:
    if not ANGLES[0] <= degrees <= ANGLES[1]:
        raise MeasurementError(
            f"its largest value means a friction angle of {degrees:.3g}°, which no soil has; are stresses positive, in"
            " Pa in experiment.json and in kPa in tables?",
            file=file,
            field=column,
        )


def _check_volume(file: Path, column: str, lost: FloatArray) -> None:
    if np.abs(lost).max() > 0.5:
        fault = f"reaches {100 * np.abs(lost).max():g} % of the volume, more than all pores"
        raise MeasurementError(fault, file=file, field=column)


def read_curve(file: Path, confining: float, void_ratio: float = 0.8, *, drained: bool = True) -> Specimen:
    """A triaxial test's curve at `STRAINS`, as far as it reaches, from a CSV table.

    Columns are ``axial_strain_percent``, ``q_kPa`` and ``volume_strain_percent`` or ``void_ratio``; ``p_kPa``, the mean
    effective stress, shows whether the specimen drained.

    Args:
        file: the table.
        confining: lateral stress, Pa.
        void_ratio: at the start.
        drained: whether it was.

    Raises:
        MeasurementError: what is wrong with it, or that it is undrained.
    """
    header = _header(file)
    by_ratio = "void_ratio" in header and "volume_strain_percent" not in header
    volume = "void_ratio" if by_ratio else "volume_strain_percent"
    table = read_table(file, ("axial_strain_percent", "q_kpa", volume))
    strain, q = table[:, 0] / 100.0, 1e3 * table[:, 1]
    _check_strength(file, "q_kPa", 2.0 * np.rad2deg(np.arctan(np.sqrt(max(0.0, 1.0 + q.max() / confining)))) - 90.0)
    if "p_kpa" in header:
        pore = confining + q / 3.0 - 1e3 * read_table(file, ("p_kpa",))[:, 0]
        drained = drained and bool(np.abs(pore).max() <= PORE_PRESSURE * confining)
    if not drained:
        raise MeasurementError(
            "is undrained: pore water bears a part of the stress, and the law knows none; give drained tests", file=file
        )
    lost = (table[0, 2] - table[:, 2]) / (1.0 + table[0, 2]) if by_ratio else table[:, 2] / 100.0
    _check_volume(file, volume, lost)
    kept, lost, ratio = _at_strains(file, "a strain of", strain, lost, q / (confining + q / 3.0))
    return Specimen(file.stem, kept, lost, ratio, confining, void_ratio=void_ratio)


def _read_triaxial(fields: Fields, folder: Path, options: Options) -> TriaxialExperiment:
    curves = [
        read_curve(
            file,
            test.number("confining", 1e2, 1e8, hint="it is in Pa"),
            test.number("void_ratio", 0.1, 3.0, default=0.8),
            drained=not test.has("drained") or test.flag("drained"),
        )
        for test, file in _tests(fields, folder)
    ]
    return TriaxialExperiment(together(curves), known=_limits(fields, curves[0].void_ratio), **options.model)


def together(tests: Sequence[Specimen]) -> list[Specimen]:
    """Tests at the strains that all of them reach."""
    kept = min((test.strain for test in tests), key=len)
    n = len(kept)
    return [replace(test, strain=kept, volume=test.volume[:n], ratio=test.ratio[:n]) for test in tests]


def _limits(fields: Fields, void_ratio: float) -> dict[str, float]:
    """What is known of the density by index tests; nothing without them."""
    if not fields.has("void_ratio_limits"):
        return {}
    least, most = fields.vector("void_ratio_limits", 2)
    try:
        found = of_limits(void_ratio, float(least), float(most))
    except ParameterError as error:
        fields.fail("void_ratio_limits", str(error))
    if not DENSITIES[0] <= found["relative_density"] <= DENSITIES[1]:
        fields.fail("void_ratio_limits", f"the void ratio of {void_ratio:g} is not between {least:g} and {most:g}")
    return found


def _untested(*stresses: float) -> list[Specimen]:
    """Specimens to a strain of 20 % under stresses in kPa, with nothing measured yet."""
    strains = STRAINS[STRAINS <= 0.2 + 1e-9]
    nothing = np.zeros(len(strains))
    return [Specimen(f"{stress:g}kPa", strains, nothing, nothing, 1e3 * stress) for stress in stresses]


def _write_triaxial(shape: TriaxialExperiment, readings: FloatArray) -> tuple[dict[str, object], dict[str, str]]:
    tests, tables = [], {}
    for k, curve in enumerate(shape.tests):
        file = f"{curve.name}.csv"
        ratio, volume = readings[:, 2 * k], readings[:, 2 * k + 1]
        q = curve.stress * ratio / (1.0 - ratio / 3.0)
        tests.append({"file": file, "confining": curve.stress, "void_ratio": curve.void_ratio, "drained": True})
        tables[file] = _csv(
            {"axial_strain_percent": 100 * curve.strain, "q_kPa": q / 1e3, "volume_strain_percent": 100 * volume}
        )
    return {"tests": tests}, tables


def _read_shear_box(fields: Fields, folder: Path, options: Options) -> ShearBoxExperiment:
    height = fields.number("height", 1e-3, 1.0, hint="it is in m")
    found = []
    for test, file in _tests(fields, folder):
        normal = test.number("normal_stress", 1e1, 1e8, hint="it is in Pa")
        table = read_table(file, ("displacement_mm", "shear_stress_kpa", "vertical_displacement_mm"))
        strain, lost = 1e-3 * table[:, 0] / height, -1e-3 * table[:, 2] / height
        _check_strength(file, "shear_stress_kPa", np.rad2deg(np.arctan(1e3 * table[:, 1].max() / normal)))
        _check_volume(file, "vertical_displacement_mm", lost)
        what = "a displacement over the height of"
        kept, ratio, lost = _at_strains(file, what, strain, 1e3 * table[:, 1] / normal, lost)
        found.append(Specimen(file.stem, kept, lost, ratio, normal, test.number("void_ratio", 0.1, 3.0, default=0.8)))
    return ShearBoxExperiment(together(found), known=_limits(fields, found[0].void_ratio), **options.model)


def _write_shear_box(shape: ShearBoxExperiment, readings: FloatArray) -> tuple[dict[str, object], dict[str, str]]:
    tests, tables = [], {}
    for k, test in enumerate(shape.tests):
        file = f"{test.name}.csv"
        tests.append({"file": file, "normal_stress": test.stress, "void_ratio": test.void_ratio})
        tables[file] = _csv(
            {
                "displacement_mm": 1e3 * HEIGHT * test.strain,
                "shear_stress_kPa": readings[:, 2 * k] * test.stress / 1e3,
                "vertical_displacement_mm": -1e3 * HEIGHT * readings[:, 2 * k + 1],
            }
        )
    return {"height": HEIGHT, "tests": tests}, tables


def _read_plate(fields: Fields, folder: Path, options: Options) -> PlateExperiment:
    diameter = fields.number("diameter", 1e-3, 10.0, hint="it is in m")
    area = 0.25 * np.pi * diameter**2
    density = fields.number("density", 100.0, 20_000.0, hint="it is in kg/m³")
    grains = fields.number("grain_density", 500.0, 20_000.0, default=GRAINS, hint="it is in kg/m³")
    if grains <= density:
        fields.fail("grain_density", f"grains of {grains:g} kg/m³ make no soil of {density:g} kg/m³")
    curves = []
    for _, file in _tests(fields, folder):
        as_pressure = "pressure_kpa" in _header(file)
        table = read_table(file, ("sinkage_mm", "pressure_kpa" if as_pressure else "force_n"))
        down = _first(table[:, 0])
        depth, force = 1e-3 * table[down, 0], table[down, 1] * (1e3 * area if as_pressure else 1.0)
        if depth[-1] > 0.0:
            _check_plate(file, depth[-1] / diameter, force[-1] / area, GRAVITY * density * depth[-1])
        curves.append((depth, force))
    deepest = min(float(depth[-1]) for depth, _ in curves)
    if not deepest > 0.0:
        fields.fail("tests", "sinkage grows downwards from 0 where the plate touches the soil; one never does")
    depths = deepest * (np.arange(PLATE_READINGS) + 1.0) / PLATE_READINGS
    forces = np.array([np.interp(depths, *curve) for curve in curves])
    mean = forces.mean(axis=0)
    spread = forces.std(axis=0, ddof=1) if len(forces) > 2 else TRIALS_DIFFER * mean
    friction = fields.number("friction", 0.0, 2.0, default=0.3)
    test = Loading(diameter, depths, mean, spread, density, friction, fields.text("name"))
    return PlateExperiment(test, known=_limits(fields, grains / density - 1.0), **options.simulation)


def _check_plate(file: Path, depth: float, pressure: float, least: float) -> None:
    """A plate's largest sinkage, in diameters, and its pressure there, Pa: as large as the weight of the soil that was
    there before, and too small to crush the grains."""
    if not SINKAGES[0] <= depth <= SINKAGES[1]:
        fault = f"reaches {depth:.3g} diameters of the plate; sinkages are in mm, the diameter in m"
        raise MeasurementError(fault, file=file, field="sinkage_mm")
    if not least <= pressure <= CRUSHING:
        raise MeasurementError(
            f"the plate bears {pressure:.3g} Pa in the end, outside [{least:.3g}, {CRUSHING:.3g}]: soil bears its own"
            " weight, and grains crush; is it in its column's unit?",
            file=file,
        )


def _example_plate(name: str, options: Options) -> PlateExperiment:
    depths = 0.03 * (np.arange(PLATE_READINGS) + 1.0) / PLATE_READINGS
    test = Loading(0.1, depths, np.ones(len(depths)), np.array(0.1), name=name)
    return PlateExperiment(test, **options.simulation)


def _write_plate(shape: PlateExperiment, readings: FloatArray) -> tuple[dict[str, object], dict[str, str]]:
    table = _csv({"sinkage_mm": 1e3 * shape.test.depths, "force_N": readings[:, 0]})
    about = {key: getattr(shape.test, key) for key in ("diameter", "density", "friction")}
    return {**about, "tests": [{"file": "plate.csv"}]}, {"plate.csv": table}


def _read_repose(fields: Fields, folder: Path, options: Options) -> ReposeExperiment:
    del folder
    return ReposeExperiment(
        [trial.number("angle", *ANGLES, hint="it is in degrees") for trial in fields.children("trials")],
        height=fields.number("height", 1e-3, 100.0, default=0.1, hint="it is in m"),
        density=fields.number("density", 100.0, 20_000.0, default=1600.0, hint="it is in kg/m³"),
        **options.model,
        name=fields.text("name"),
    )


def _read_column(fields: Fields, folder: Path, options: Options) -> ColumnExperiment:
    del folder
    metres = "it is in m"
    radius, height = (fields.number(key, 1e-3, 100.0, hint=metres) for key in ("radius", "height"))
    trials = []
    for trial in fields.children("trials"):
        end = trial.number("final_radius", radius, 1e3, hint=f"{metres}, and a column spreads")
        left = trial.number("final_height", 1e-4, height, hint=f"{metres}, and a column sinks")
        spread = end**2 * left / (radius**2 * height)
        if not SPREADING[0] <= spread <= SPREADING[1]:
            trial.fail("final_radius", f"a deposit of {end:g} x {left:g} m has not the volume of the column")
        trials.append([end, left])
    test = Collapse(
        radius,
        height,
        np.array(trials).reshape(-1, 2),
        density=fields.number("density", 100.0, 20_000.0, default=1600.0, hint="it is in kg/m³"),
        floor_friction=fields.number("floor_friction", 0.0, 10.0, default=0.6),
        name=fields.text("name"),
    )
    return ColumnExperiment(test, **options.simulation)


@dataclass(frozen=True)
class Kind:
    """A kind of test.

    Attributes:
        read: the experiment of a folder.
        example: one of usual size, with nothing measured yet, by its name.
        write: what describes readings in ``experiment.json``, and the tables beside it by file name.
        fields: of ``experiment.json``, beside those that all have.
        each: of each of its tests or trials.
    """

    read: Callable[[Fields, Path, Options], LaboratoryExperiment]
    example: Callable[[str, Options], LaboratoryExperiment]
    write: Callable[..., tuple[dict[str, object], dict[str, str]]]
    fields: tuple[str, ...]
    each: tuple[str, ...]


def _trials(*keys: str) -> Callable[[LaboratoryExperiment, FloatArray], tuple[dict[str, object], dict[str, str]]]:
    def write(shape: LaboratoryExperiment, readings: FloatArray) -> tuple[dict[str, object], dict[str, str]]:
        about: dict[str, object] = {}
        if isinstance(shape, ColumnExperiment):
            about = {"radius": shape.test.radius, "height": shape.test.height}
        trial = {key: round(float(value), 6) for key, value in zip(keys, readings[0], strict=True)}
        return {**about, "trials": [trial]}, {}

    return write


KINDS: dict[str, Kind] = {
    "triaxial": Kind(
        _read_triaxial,
        lambda name, o: TriaxialExperiment(_untested(50.0, 100.0, 200.0), **o.model),
        _write_triaxial,
        ("void_ratio_limits",),
        ("file", "confining", "void_ratio", "drained"),
    ),
    "shear_box": Kind(
        _read_shear_box,
        lambda name, o: ShearBoxExperiment(_untested(25.0, 50.0, 100.0), **o.model),
        _write_shear_box,
        ("height", "void_ratio_limits"),
        ("file", "normal_stress", "void_ratio"),
    ),
    "plate": Kind(
        _read_plate,
        _example_plate,
        _write_plate,
        ("diameter", "density", "grain_density", "friction", "void_ratio_limits"),
        ("file",),
    ),
    "repose": Kind(
        _read_repose,
        lambda name, o: ReposeExperiment([30.0], name=name, **o.model),
        _trials("angle"),
        ("height", "density"),
        ("angle",),
    ),
    "column": Kind(
        _read_column,
        lambda name, o: ColumnExperiment(Collapse(0.1, 0.1, np.array([[0.2, 0.05]]), name=name), **o.simulation),
        _trials("final_radius", "final_height"),
        ("radius", "height", "density", "floor_friction"),
        ("final_radius", "final_height"),
    ),
}
