"""Triaxial tests as experiments: a law's own test, and real sand where the data are at hand.

``SPLATSOIL_MEASURED`` names a folder that holds ``karlsruhe_triaxial`` (Wichtmann & Triantafyllidis 2016).
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks._validation.sand import karlsruhe
from splatsoil.inverse.criticism.design import Prior
from splatsoil.inverse.criticism.diagnosis import Diagnosis, diagnose
from splatsoil.inverse.criticism.evidence import BASE_MODEL, DISCREPANCY
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.experiment.base import Run
from splatsoil.experiment.laboratory import Specimen
from splatsoil.experiment.triaxial import TriaxialExperiment
from splatsoil.laboratory.answer import search
from splatsoil.soil.element import triaxial
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects

MEASURED = os.environ.get("SPLATSOIL_MEASURED", "")
KARLSRUHE = Path(MEASURED) / "karlsruhe_triaxial" / "tmd2_loose_tmd22_dense_subset.csv"
STRAINS = np.concatenate([np.linspace(0.005, 0.02, 4), np.linspace(0.03, 0.2, 18)])


def criticised(curve: Specimen) -> Diagnosis:
    experiment = TriaxialExperiment([curve])
    simulations = Simulations(experiment)
    values, known = search(experiment, simulations, 0, lambda what, share: None)
    return diagnose(experiment, values, simulate=simulations, known=known, prior=Prior.of(experiment, values))


def effects(found: Diagnosis) -> dict[str, float]:
    """Probabilities of the library's effects, the most probable first."""
    known = {name: p for name, p in found.evidence.probability.items() if name not in (BASE_MODEL, DISCREPANCY)}
    return dict(sorted(known.items(), key=lambda item: -item[1]))


def made(effects: tuple[str, ...], values: dict[str, float]) -> Specimen:
    """A specimen of a known law with readings as a laboratory's."""
    test = triaxial(
        Law(find_effects(effects)), values, confining=1e5, strains=-np.log(1.0 - STRAINS), young=2e7, void_ratio=0.8
    )
    generator = np.random.default_rng(0)
    ratio = (test.q / test.p)[0, 1:] + 0.005 * generator.normal(size=STRAINS.size)
    volume = 1.0 - np.exp(-test.volume_strain[0, 1:]) + 0.0005 * generator.normal(size=STRAINS.size)
    return Specimen("made", STRAINS, volume, ratio, 1e5)


def test_sand_of_the_base_law_is_not_said_to_miss_anything() -> None:
    found = criticised(made((), {"friction_angle": 34.0}))
    assert found.verdict in ("adequate", "undecided"), found.evidence.probability
    value, std = found.estimates["friction_angle"]
    assert abs(value - 34.0) < 2.0 * std and value == pytest.approx(34.0, abs=1.0)


def test_hidden_dilatancy_is_named_and_takes_the_error_away() -> None:
    found = criticised(made(("dilatancy",), {"friction_angle": 38.0, "dilatancy_angle": 12.0}))
    assert (found.verdict, found.members) == ("missing", ("dilatancy",)), found.evidence.probability
    value, std = found.estimates["friction_angle"]
    assert abs(value - 38.0) < 2.0 * std
    before, after = found.held_out
    assert after.model == "dilatancy" and after.error < 0.5 * before.error


@pytest.mark.skipif(not KARLSRUHE.is_file(), reason="SPLATSOIL_MEASURED names no folder with karlsruhe_triaxial")
def test_effects_that_dilate_are_the_likeliest_on_dense_real_sand_and_not_on_loose() -> None:
    tests = karlsruhe(Path(MEASURED))
    dense = criticised(tests["TMD22"])
    assert set(list(effects(dense))[:2]) == {"critical_state", "dilatancy"}
    # it hardens as well: no single effect is all
    assert dense.verdict == "something else"
    loose = effects(criticised(tests["TMD2"]))
    for name in ("critical_state", "dilatancy"):
        assert loose[name] < 0.2 * effects(dense)[name]


def test_tests_of_one_soil_at_other_densities_and_pressures_make_one_experiment() -> None:
    """Each is the element test at its own void ratio; parameters are those of the first."""
    curves = [
        Specimen("loose", STRAINS, np.zeros(22), np.zeros(22), 1e5, void_ratio=0.9),
        Specimen("dense", STRAINS, np.zeros(22), np.zeros(22), 4e5, void_ratio=0.75),
    ]
    experiment = TriaxialExperiment(curves, ("critical_state",))
    values = {"friction_angle": 33.0, "stiffness_factor": 2.0, "relative_density": 0.3, "volume_range": 0.2}
    found = experiment.readings(Run(values))
    law = Law(find_effects(("critical_state",)))
    soil = {"friction_angle": 33.0, "relative_density": 0.3 + np.log(1.9 / 1.75) / 0.2, "volume_range": 0.2}
    test = triaxial(law, soil, confining=4e5, strains=-np.log(1.0 - STRAINS), young=8e7, void_ratio=0.75)
    np.testing.assert_allclose(found[:, 2], (test.q / test.p)[0, 1:], rtol=1e-3)
    np.testing.assert_allclose(found[:, 3], 1.0 - np.exp(-test.volume_strain[0, 1:]), atol=1e-4)
    assert [p.name for p in experiment.parameters] == list(values)
    known = TriaxialExperiment(curves, ("critical_state",), known={"relative_density": 0.3, "volume_range": 0.2})
    assert [p.name for p in known.parameters] == ["friction_angle", "stiffness_factor"]
    np.testing.assert_array_equal(known.readings(Run({"friction_angle": 33.0, "stiffness_factor": 2.0})), found)
