"""A plate pressed into soil as an experiment."""

from __future__ import annotations

import numpy as np
import pytest
from splatsoil.inverse.criticism.diagnosis import SUBSTANTIAL, diagnose

from splatsoil.errors import ParameterError
from splatsoil.experiment.base import Run
from splatsoil.experiment.plate import Loading, PlateExperiment

DEPTHS = np.array([0.004, 0.006, 0.008, 0.010, 0.013, 0.016])


def plate(forces: np.ndarray) -> PlateExperiment:
    return PlateExperiment(Loading(0.1, DEPTHS, forces, 0.05 * np.abs(forces) + 0.2), preset="tiny")


def test_a_seed_repeats_itself_and_another_one_differs() -> None:
    coarse = plate(np.ones(6))
    again = [coarse.readings(Run({"friction_angle": 42.0}, seed=seed)) for seed in (0, 0, 1)]
    assert np.array_equal(again[0], again[1])
    assert not np.array_equal(again[0], again[2])


def test_a_test_without_sense_is_refused() -> None:
    for depths, forces in (([0.01], [3.0]), ([0.02, 0.01], [1.0, 2.0]), ([0.01, 0.02], [1.0])):
        with pytest.raises(ParameterError, match="depths"):
            Loading(0.1, np.array(depths), np.array(forces), np.array(0.1))


def test_six_forces_do_not_claim_what_they_cannot_tell() -> None:
    truth = plate(np.ones(6)).readings(Run({"friction_angle": 33.0, "cohesion": 600.0}, ("cohesion",), 99))[:, 0]
    found = diagnose(plate(truth), {"friction_angle": 33.0})
    # Friction and cohesion both lift the whole curve: nothing is named, and nothing would have been.
    assert found.verdict in ("adequate", "undecided"), found.evidence.probability
    assert (found.detectable["cohesion"] or np.inf) > 600.0
    # There is no strong evidence against cohesion, which is there.
    models = found.evidence.models
    assert models["cohesion"].log_evidence - models[""].log_evidence > -np.log(SUBSTANTIAL)
