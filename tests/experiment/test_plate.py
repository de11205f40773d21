"""A plate pressed into soil as an experiment."""

from __future__ import annotations

import numpy as np
import pytest
from splatsoil.inverse.criticism.diagnosis import MENTIONED, diagnose

from splatsoil.errors import ParameterError
from splatsoil.experiment.plate import PlateExperiment

DEPTHS = np.array([0.004, 0.006, 0.008, 0.010, 0.013, 0.016])


def plate(forces: np.ndarray | list[float], preset: str = "tiny") -> PlateExperiment:
    return PlateExperiment(0.1, DEPTHS, forces, 0.05 * np.abs(forces) + 0.2, preset=preset)


def test_force_grows_with_depth_and_with_friction_and_repeats_itself() -> None:
    experiment = plate(np.ones(6), "small")
    weak, strong = (experiment.readings({"friction_angle": angle})[:, 0] for angle in (28.0, 42.0))
    assert weak[-1] > weak[0] > 0.0
    # a footing's bearing capacity grows ninefold from 28 to 42 degrees (Vesic 1973), what its depth adds fivefold; soil
    # that gives way bears 1.45 times as much, which no depth would change
    assert strong.mean() > 2.5 * weak.mean()
    coarse = plate(np.ones(6))
    again = [coarse.readings({"friction_angle": 42.0}, seed=seed) for seed in (0, 0, 1)]
    assert np.array_equal(again[0], again[1])
    assert not np.array_equal(again[0], again[2])


def test_a_test_without_sense_is_refused() -> None:
    for depths, forces in (([0.01], [3.0]), ([0.02, 0.01], [1.0, 2.0]), ([0.01, 0.02], [1.0])):
        with pytest.raises(ParameterError, match="depths"):
            PlateExperiment(0.1, depths, forces, 0.1)


def test_six_forces_do_not_claim_what_they_cannot_tell() -> None:
    truth = plate(np.ones(6)).readings({"friction_angle": 33.0, "cohesion": 600.0}, effects=("cohesion",), seed=99)[
        :, 0
    ]
    found = diagnose(plate(truth), {"friction_angle": 33.0})
    # Friction and cohesion both lift the whole curve: nothing is named, and nothing would have been.
    assert found.verdict in ("adequate", "undecided"), found.evidence.probability
    assert (found.detectable["cohesion"] or np.inf) > 600.0
    # There is no strong evidence against cohesion, which is there, and the truth stays possible.
    models = found.evidence.models
    assert models["cohesion"].log_evidence - models[""].log_evidence > -np.log(MENTIONED)
    cohesion = models["cohesion"]
    assert cohesion.weights.sum(axis=0)[cohesion.values["cohesion"] > 600.0].sum() > 0.001
    for name, truth_of in (("friction_angle", 33.0), ("cohesion", 600.0)):
        value, std = cohesion.moments(name)
        assert abs(value - truth_of) < 3.0 * std
