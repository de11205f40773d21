"""The control: a made-up bed with the same model."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from splatsoil.experiment import replay
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
