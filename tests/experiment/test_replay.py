"""The control: a made-up bed with the same model."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from splatsoil.experiment import replay
from splatsoil.experiment.features import Site
from splatsoil.experiment.plow import PlowExperiment
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.reconstruction import HeightField
from splatsoil.soil.library import find_effects

SUCTION = Path(__file__).parents[2] / "examples" / "effects" / "suction.py"


class Enough(Exception):
    """What was to be seen has been."""


def test_a_users_own_effect_acts_in_the_control_too(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its name is none of the library's."""
    measurement = Measurement.load(small_set)
    surface = HeightField.over(measurement.bed.lower, measurement.bed.upper, 0.02, 0.12)
    model = Model(measurement, cast(Any, SimpleNamespace(surface=surface)), effects=[str(SUCTION)], preset="tiny")
    experiment = PlowExperiment(model, candidates=())
    acting: list[list[str]] = []

    def make_set(*_: Any, effects: Any, **__: Any) -> None:
        acting.append([effect.name for effect in find_effects(effects)])

    def made(*_: Any, effects: Any, **__: Any) -> None:
        acting.append([effect.name for effect in find_effects(effects)])
        raise Enough

    monkeypatch.setattr(replay, "make_set", make_set)
    monkeypatch.setattr(replay, "like", lambda *_, **__: None)
    monkeypatch.setattr(replay, "Measurement", SimpleNamespace(load=lambda _: measurement))
    monkeypatch.setattr(replay, "reconstruct", lambda *_, **__: model.reconstruction)
    monkeypatch.setattr(replay, "Model", made)
    with pytest.raises(Enough):
        replay.replay(experiment, {"friction_angle": 35.0, "suction_gradient": 1e4}, tmp_path / "place")
    assert acting == [["suction"], ["suction"]]


def test_squares_that_the_control_hides_are_unknown(
    small_set: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They used to count as right to a hair."""
    here = [Site("left", 0.1, 0.1), Site("left", 0.2, 0.1), Site("right", 0.1, 0.1)]
    measurement = SimpleNamespace(bed=SimpleNamespace(lower=np.zeros(3)))
    base = SimpleNamespace(
        measurement=measurement,
        reconstruction=SimpleNamespace(surface=SimpleNamespace(height=np.array([0.12, np.nan]))),
        effects=(),
        preset="tiny",
        device="cpu",
        frames=(0, 1),
    )
    experiment = SimpleNamespace(base=base, parameters=(), layout=SimpleNamespace(sites=here, shape=(2, 3)))
    made = SimpleNamespace(
        layout=SimpleNamespace(sites=[here[2], here[0]]),
        seen=np.array([[True, True], [False, True]]),
        observed=np.array([[5.0, 7.0], [6.0, 8.0]]),
        predict=lambda _: np.ones((2, 2)),
    )
    monkeypatch.setattr(replay, "make_set", lambda *_, **__: None)
    monkeypatch.setattr(replay, "like", lambda *_, **__: None)
    monkeypatch.setattr(replay, "Measurement", SimpleNamespace(load=lambda _: measurement))
    monkeypatch.setattr(replay, "reconstruct", lambda *_, **__: None)
    monkeypatch.setattr(replay, "Model", lambda *_, **__: None)
    monkeypatch.setattr(replay, "PlowExperiment", lambda *_, **__: made)
    found = replay.replay(cast(Any, experiment), {"friction_angle": 35.0}, tmp_path / "place")
    np.testing.assert_array_equal(found, [[6.0, np.nan, 4.0], [7.0, np.nan, np.nan]])
