"""Triaxial tests as experiments: a law's own test, and real sand where the data are at hand.

``SPLATSOIL_MEASURED`` names a folder that holds ``karlsruhe_triaxial`` (Wichtmann & Triantafyllidis 2016).
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from splatsoil.inverse.criticism.diagnosis import Diagnosis, diagnose
from splatsoil.inverse.criticism.evidence import AS_IT_IS, ELSE

from splatsoil.errors import MeasurementError
from splatsoil.experiment.triaxial import Curve, TriaxialExperiment, read_triaxial
from splatsoil.soil.element import triaxial
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects

MEASURED = os.environ.get("SPLATSOIL_MEASURED", "")
KARLSRUHE = Path(MEASURED) / "karlsruhe_triaxial" / "tmd2_loose_tmd22_dense_subset.csv"
STRAINS = np.concatenate([np.linspace(0.005, 0.02, 4), np.linspace(0.03, 0.2, 18)])


def criticised(curve: Curve, void_ratio: float) -> Diagnosis:
    experiment = TriaxialExperiment(curve, void_ratio=void_ratio)
    return diagnose(experiment, {p.name: p.default for p in experiment.parameters})


def effects(found: Diagnosis) -> dict[str, float]:
    """Probabilities of the library's effects, the most probable first."""
    known = {name: p for name, p in found.evidence.probability.items() if name not in (AS_IT_IS, ELSE)}
    return dict(sorted(known.items(), key=lambda item: -item[1]))


def made(effects: tuple[str, ...], values: dict[str, float]) -> Curve:
    """A specimen of a known law with readings as a laboratory's."""
    test = triaxial(
        Law(find_effects(effects)), values, confining=1e5, strains=-np.log(1.0 - STRAINS), young=2e7, void_ratio=0.8
    )
    generator = np.random.default_rng(0)
    ratio = (test.q / test.p)[0, 1:] + 0.005 * generator.normal(size=STRAINS.size)
    volume = 1.0 - np.exp(-test.volume_strain[0, 1:]) + 0.0005 * generator.normal(size=STRAINS.size)
    return Curve("made", STRAINS, volume, ratio, 1e5)


def test_sand_of_the_base_law_is_not_said_to_miss_anything() -> None:
    found = criticised(made((), {"friction_angle": 34.0}), 0.8)
    assert found.verdict in ("adequate", "undecided"), found.evidence.probability
    value, std = found.estimates["friction_angle"]
    assert abs(value - 34.0) < 2.0 * std and value == pytest.approx(34.0, abs=1.0)


def test_hidden_dilatancy_is_named_and_takes_the_error_away() -> None:
    found = criticised(made(("dilatancy",), {"friction_angle": 38.0, "dilatancy_angle": 12.0}), 0.8)
    assert (found.verdict, found.members) == ("missing", ("dilatancy",)), found.evidence.probability
    value, std = found.estimates["friction_angle"]
    assert abs(value - 38.0) < 2.0 * std
    before, after = found.held_out
    assert after.model == "dilatancy" and after.error < 0.5 * before.error


@pytest.mark.skipif(not KARLSRUHE.is_file(), reason="SPLATSOIL_MEASURED names no folder with karlsruhe_triaxial")
def test_dilatancy_is_the_likeliest_effect_on_dense_real_sand_and_not_on_loose() -> None:
    tests = read_triaxial(KARLSRUHE)
    dense = criticised(tests["TMD22"], 0.7351)
    assert dense.members[:1] == ("dilatancy",)
    # Published: 16.7° at most; the law's angle is that at the start, before it decays.
    assert 8.0 < dense.evidence.models["dilatancy"].moments("dilatancy_angle")[0] < 25.0
    # Dense sand also softens: dilatancy is not all.
    assert dense.verdict == "something else"
    before, after = dense.held_out
    assert after.model == "dilatancy" and after.error < 0.5 * before.error
    loose = criticised(tests["TMD2"], 0.9753)
    assert "dilatancy" not in loose.members


def test_a_bad_file_is_refused_with_its_line(tmp_path: Path) -> None:
    file = tmp_path / "tests.csv"
    head = "test_id,eps_a[%],eps_v[%],sigma_r[kPa],sigma_v[kPa]\n"
    for text, says in (
        ("test_id,eps_a[%]\nA,1\n", "eps_v"),
        (head + "A,1,0.1,100,x\n", "line 2"),
        (head + "A,1,0.1,100,nan\n", "not finite"),
    ):
        file.write_text(text)
        with pytest.raises(MeasurementError, match=says.replace("[", r"\[")):
            read_triaxial(file)
    with pytest.raises(MeasurementError, match="cannot be read"):
        read_triaxial(tmp_path / "nothing.csv")
