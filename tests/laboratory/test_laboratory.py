"""Tests without cameras: folders that are written, read and answered, and what is refused."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks._validation.plates import meyerhof, vesic

from splatsoil.cli import main
from splatsoil.errors import MeasurementError, ParameterError
from splatsoil.experiment.base import Run
from splatsoil.experiment.column import Collapse, ColumnExperiment
from splatsoil.experiment.laboratory import Specimen
from splatsoil.experiment.plate import Loading, PlateExperiment
from splatsoil.experiment.shear_box import ReposeExperiment, ShearBoxExperiment
from splatsoil.laboratory.answer import fitted
from splatsoil.laboratory.folder import KINDS, Options, load, read_curve, simulate


def quiet(what: str, share: float) -> None:
    """No progress."""


@pytest.mark.parametrize("kind", list(KINDS))
def test_a_simulated_test_is_read_as_it_was_simulated(kind: str, tmp_path: Path) -> None:
    values = {"friction_angle": 36.0}
    made = simulate(kind, tmp_path / "set", values, (), "tiny", 0)
    read = load(tmp_path / "set", Options(preset="tiny"))
    assert (read.kind, read.layout.shape) == (kind, made.layout.shape)
    np.testing.assert_allclose(read.observed, read.features(made.readings(Run(values))), rtol=1e-3, atol=2e-2)


def test_an_effect_without_a_size_makes_no_folder(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="'dilatancy' is on but all its parameters are at their off values"):
        simulate("repose", tmp_path / "set", {"friction_angle": 36.0}, ("dilatancy",), "tiny", 0)
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize("kind", ["triaxial", "shear_box"])
def test_the_angle_that_was_hidden_is_found(kind: str, tmp_path: Path) -> None:
    simulate(kind, tmp_path / "set", {"friction_angle": 36.0, "relative_density": 0.6}, ("critical_state",), "tiny", 0)
    found = fitted(load(tmp_path / "set", Options(("critical_state",))), None, 0, quiet)
    angle = found["estimates"]["friction_angle"]
    assert found["values"]["friction_angle"] == pytest.approx(36.0, abs=0.2)
    assert found["values"]["relative_density"] == pytest.approx(0.6, abs=0.02)
    assert abs(angle["value"] - 36.0) < 2.5 * angle["std"]


def test_a_shear_box_and_a_slope_fail_by_matsuoka_and_nakai() -> None:
    """At constant volume principal strains and stresses turn to 45 degrees: tau / sigma = sin phi of plane strain."""
    sine = math.sin(math.radians(34.0))
    constant = (9.0 - sine**2) / (1.0 - sine**2)
    # plane strain without dilation: s2 = sqrt(s1 s3) on the surface I1 I2 = k I3 (Satake 1976)
    ratio = np.linspace(1.1, 12.0, 100_000)
    s1, s2, s3 = ratio, np.sqrt(ratio), np.ones_like(ratio)
    surface = (s1 + s2 + s3) * (s1 * s2 + s2 * s3 + s3 * s1) / (s1 * s2 * s3)
    critical = ratio[np.argmin(np.abs(surface - constant))]
    plane = (critical - 1.0) / (critical + 1.0)
    strain = np.array([0.1, 0.5, 1.0])
    box = ShearBoxExperiment([Specimen("a", strain, np.zeros(3), np.zeros(3), 5e4)])
    found = box.readings(Run({"friction_angle": 34.0, "stiffness_factor": 5.0}))
    # the intermediate stress is the law's own, not the one of an associated flow
    assert found[-1, 0] == pytest.approx(plane, rel=0.04)
    slope = ReposeExperiment([30.0]).readings(Run({"friction_angle": 34.0}))[0, 0]
    assert math.tan(math.radians(slope)) == pytest.approx(plane, rel=0.04)
    assert slope < 34.0


def test_a_plate_bears_what_theory_says() -> None:
    """Between Vesic's and Meyerhof's bearing capacity, for angles within two degrees."""
    depths = np.arange(1, 13) * 0.02
    plate = PlateExperiment(Loading(0.1, 0.1 * depths, np.ones(12), np.array(0.1)))
    pressure = plate.readings(Run({"friction_angle": 33.0}))[:, 0] / (0.25 * math.pi * 0.01) / (1600 * 9.81 * 0.05)
    for z in (0.12, 0.2):
        mean = pressure[np.abs(depths - z) < 0.05].mean()
        assert vesic(31.0, z) < mean < meyerhof(35.0, z)


def test_a_column_runs_out_as_in_the_laboratory() -> None:
    """Lube et al. (2004): (R - R0) / R0 = 1.24 a, on sand near its angle of repose of 31 degrees."""
    column = ColumnExperiment(Collapse(0.1, 0.1, np.array([[0.2, 0.05]]), floor_friction=10.0))
    radius, height = column.readings(Run({"friction_angle": 31.0}))[0]
    assert radius / 0.1 - 1.0 == pytest.approx(1.24, rel=0.3)
    assert 0.03 < height < 0.1


def write(folder: Path, description: dict, table: str = "") -> Path:
    folder.mkdir(exist_ok=True)
    whole = {"format": "splatsoil-laboratory/1", "name": "sand", **description}
    (folder / "experiment.json").write_text(json.dumps(whole))
    (folder / "a.csv").write_text(table)
    return folder


TRIAXIAL = {"kind": "triaxial", "tests": [{"file": "a.csv", "confining": 1e5}]}
PLATE = {"kind": "plate", "diameter": 0.1, "density": 1500, "tests": [{"file": "a.csv"}]}
BOX = {"kind": "shear_box", "height": 0.02, "tests": [{"file": "a.csv", "normal_stress": 1e5}]}
COLUMN = {"kind": "column", "radius": 0.1, "height": 0.1}
HEAD = "axial_strain_percent,q_kPa,volume_strain_percent\n"
BOX_HEAD = "displacement_mm,shear_stress_kPa,vertical_displacement_mm\n"


def curve(stress: Callable[[float], float], unit: float = 1.0, volume: float = 0.0) -> str:
    """Six rows: a strain to 5 in a unit, the stress there, and a volume that grows with it."""
    return "".join(f"{unit * s},{stress(s)},{volume * s}\n" for s in range(6))


@pytest.mark.parametrize(
    ("description", "table", "says"),
    [
        ({"kind": "vane"}, "", "'vane' is no kind of test; known are triaxial"),
        ({"kind": "triaxial", "tests": [{"file": "a.csv", "confining": 1.0}]}, HEAD + "1,1,1\n", "it is in Pa"),
        (TRIAXIAL, "strain,q\n1,2\n", "axial_strain_percent"),
        (TRIAXIAL, HEAD + "0,0,0\n1,100,0.1\n", "ends before a strain of 2 %"),
        ({"kind": "column", "radius": 0.1, "height": 0.1, "trials": [{"final_radius": 0.2}]}, "", "final_height"),
        # another unit or sign
        (TRIAXIAL, HEAD + curve(lambda s: 4e4 * s), "q_kPa: its largest value means a friction angle of 87.4°"),
        (TRIAXIAL, HEAD + curve(lambda s: 0.04 * s), "angle of 0.0572°"),
        (TRIAXIAL, HEAD + curve(lambda s: -40.0 * s), "which no soil has"),
        ({**TRIAXIAL, "tests": [{"file": "a.csv", "confining": 100.0}]}, HEAD + curve(lambda s: 40.0 * s), "no soil"),
        (TRIAXIAL, HEAD + curve(lambda s: 40.0 * s, 1000.0), "reaches a strain of 5000 %"),
        (TRIAXIAL, HEAD + curve(lambda s: 40.0 * s, -1.0), "is it positive"),
        (TRIAXIAL, HEAD + curve(lambda s: 40.0 * s, volume=20.0), "more than all pores"),
        (BOX, BOX_HEAD + curve(lambda s: 1e4 * s), "shear_stress_kPa: its largest value means"),
        (PLATE, "sinkage_mm,force_N,note\n" + curve(lambda s: 0.01 * s, 6.0), "soil bears its own weight"),
        (PLATE, "sinkage_mm,force_N,note\n" + curve(lambda s: 1e6 * s, 6.0), "grains crush"),
        (PLATE, "sinkage_mm,force_N,note\n" + curve(lambda s: 10.0 * s, 0.006), "diameters of the plate"),
        ({**PLATE, "grain_density": 1400}, "sinkage_mm,force_N,note\n" + curve(lambda s: 10.0 * s), "make no soil"),
        ({"kind": "repose", "trials": [{"angle": 0.6}]}, "", "it is in degrees"),
        ({**COLUMN, "trials": [{"final_radius": 200.0, "final_height": 0.05}]}, "", "not the volume of the column"),
        ({**COLUMN, "trials": [{"final_radius": 0.05, "final_height": 0.05}]}, "", "a column spreads"),
        ({**COLUMN, "trials": [{"final_radius": 0.2, "final_height": 50.0}]}, "", "a column sinks"),
        # what does not fit together
        ({**TRIAXIAL, "void_ratio_limits": [0.9, 0.5]}, HEAD + curve(lambda s: 40.0 * s), "give the densest"),
        ({**TRIAXIAL, "void_ratio_limits": [0.3, 0.4]}, HEAD + curve(lambda s: 40.0 * s), "not between 0.3 and 0.4"),
        ({**TRIAXIAL, "void_ratio_limit": [0.5, 0.9]}, "", "did you mean 'void_ratio_limits'?"),
        ({**TRIAXIAL, "tests": 2 * TRIAXIAL["tests"]}, HEAD + curve(lambda s: 40.0 * s), "a.csv is given twice"),
        (TRIAXIAL, HEAD + "0,0,0\n3,90,0\n6,150,0\n", "3 readings of first loading"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_sentence_and_nothing_is_written(
    description: dict, table: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write(tmp_path / "set", description, table)
    assert main(["fit", str(folder), "--run", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert says in said[-1] and "Traceback" not in "".join(said)
    assert not (tmp_path / "run").exists()


def test_a_result_is_never_written_into_the_test(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write(tmp_path / "set", TRIAXIAL, HEAD + curve(lambda s: 40.0 * s))
    before = sorted(folder.iterdir())
    assert main(["fit", str(folder), "--run", str(folder)]) == 2
    assert "is a measurement set, which is not written to" in capsys.readouterr().err
    assert sorted(folder.iterdir()) == before


def test_undrained_tests_are_refused_by_word_and_by_their_pore_pressure(tmp_path: Path) -> None:
    rows = "".join(f"{s},{40 * s},0,{100 - 10 * s}\n" for s in range(6))
    folder = write(tmp_path / "set", TRIAXIAL, HEAD.strip() + ",p_kPa\n" + rows)
    with pytest.raises(MeasurementError, match="is undrained: pore water"):
        load(folder)
    drained = "".join(f"{s},{40 * s},0,{100 + 40 * s / 3}\n" for s in range(6))
    (folder / "a.csv").write_text(HEAD.strip() + ",p_kPa\n" + drained)
    assert load(folder).kind == "triaxial"
    with pytest.raises(MeasurementError, match="is undrained"):
        read_curve(folder / "a.csv", 1e5, drained=False)


def test_a_plate_that_was_lifted_in_between_and_one_in_kilopascals_are_read(tmp_path: Path) -> None:
    table = "sinkage_mm,pressure_kPa\n" + "".join(f"{z},{2 * z}\n" for z in (0, 4, 8, 5, 6, 8.5, 12))
    read = load(write(tmp_path / "set", PLATE, table), Options(preset="tiny"))
    np.testing.assert_allclose(read.layout.times, np.arange(1, 13))
    found = np.sinh(read.observed[:, 0] / 10.0)
    np.testing.assert_allclose(found / found[-1], np.arange(1, 13) / 12.0, rtol=1e-6)


def test_what_is_unloaded_and_loaded_again_in_between_is_left_out(tmp_path: Path) -> None:
    loop = [(2.0, 80), (1.8, 10), (1.9, 40)]
    rows = [f"{s},{q},0\n" for s, q in [*((0.5 * k, 20 * k) for k in range(4)), *loop, (3.0, 120), (5.0, 200)]]
    whole, bare = (
        read_curve(write(tmp_path / name, TRIAXIAL, HEAD + "".join(rows[k] for k in kept)) / "a.csv", 1e5)
        for name, kept in (("whole", range(9)), ("bare", (0, 1, 2, 3, 4, 7, 8)))
    )
    np.testing.assert_array_equal(whole.ratio, bare.ratio)
    assert 3.0 * whole.ratio[0] / (3.0 - whole.ratio[0]) == pytest.approx(0.2, rel=1e-6), (
        "20 kPa at 0.5 %, over 100 kPa"
    )


def test_a_shear_box_is_read_in_shares_of_its_height_and_stress(tmp_path: Path) -> None:
    """Stress grows by 10 kPa, and the lid rises by 0.1 mm, with each millimetre of a box of 20 mm under 100 kPa."""
    rows = "displacement_mm,shear_stress_kPa,vertical_displacement_mm\n" + "".join(
        f"{d},{10 * d},{0.1 * d}\n" for d in (0.0, 1.0, 3.0, 4.0)
    )
    (test,) = load(write(tmp_path / "set", BOX, rows)).tests
    assert test.strain[-1] == pytest.approx(0.2) and test.void_ratio == 0.8, "the usual one"
    np.testing.assert_allclose(test.ratio, 10e3 * 20.0 * test.strain / 1e5)
    np.testing.assert_allclose(test.volume, -0.1 * test.strain)


def test_index_tests_fix_the_density(tmp_path: Path) -> None:
    rows = HEAD + "".join(f"{s},{40 * s},0\n" for s in range(6))
    folder = write(tmp_path / "set", {**TRIAXIAL, "void_ratio_limits": [0.6, 1.0]}, rows)
    read = load(folder, Options(("critical_state",)))
    assert "relative_density" not in {p.name for p in read.parameters}
    assert read.known["relative_density"] == pytest.approx(math.log(2.0 / 1.8) / math.log(2.0 / 1.6))


def test_the_command_line_answers_from_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, run = tmp_path / "heap", tmp_path / "run"
    assert main(["simulate", str(folder), "--scene", "repose", "--friction-angle", "36", "--json"]) == 0
    assert main(["check", str(folder)]) == 0
    assert "1 readings of angle" in capsys.readouterr().out
    assert main(["fit", str(folder), "--run", str(run), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert abs(found["estimates"]["friction_angle"]["value"] - 36.0) < 2.0 * found["estimates"]["friction_angle"]["std"]
    assert main(["diagnose", str(run), "--effects", "cohesion", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["verdict"] in ("adequate", "undecided") and told["model"] == ["intermediate_stress"]
    assert {m["name"] for m in told["models"]} == {"", "cohesion", "something else"}
    assert (run / "fit.json").is_file() and (run / "diagnosis.json").is_file()
