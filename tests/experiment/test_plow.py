"""What a plow experiment draws without simulating anew."""

from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from splatsoil.commands._model import off_effects
from splatsoil.comparison import PATCH
from splatsoil.errors import ParameterError, SimulationError
from splatsoil.experiment.base import Run
from splatsoil.experiment.plow import PlowExperiment
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.soil.library import library


@pytest.fixture
def model(small_set: Path, over_level_soil: Callable[..., Model]) -> Model:
    return over_level_soil(Measurement.load(small_set), 0.12)


def test_what_is_numerics_or_takes_a_laboratory_is_no_candidate(model: Model) -> None:
    others = {"stiffness", "critical_state", "hardening", "intermediate_stress"}
    assert {c.name for c in PlowExperiment(model).candidates} == set(library()) - others
    assert [c.name for c in PlowExperiment(model, candidates=["hardening"]).candidates] == ["hardening"]
    with pytest.raises(ParameterError, match="discretisation error"):
        off_effects(["stiffness"], ())


def test_what_one_camera_sees_is_in_its_columns_and_where_it_is(model: Model) -> None:
    """A spot of the bed a little darker in one camera's prediction: columns of that camera, of patches at the spot."""
    experiment = PlowExperiment(model)
    comparator, layout, force = experiment.comparator, experiment.layout, np.zeros((10, 3))
    still = comparator.still_blocks()
    for site, noise in zip(layout.sites, experiment.sensor[0], strict=True):
        assert noise == pytest.approx(np.sqrt(np.mean(still[site.channel] ** 2))), "of three frames before it moves"

    def features(images: dict[tuple[str, int], np.ndarray]) -> np.ndarray:
        return experiment.features(cast(Any, SimpleNamespace(images=images, trajectory=SimpleNamespace(force=force))))

    for camera, x, y in (("left", 0.5, 0.12), ("right", 0.3, 0.3)):
        images = dict(comparator.observed)
        spot = np.linalg.norm(comparator.ground[camera] - [x, y], axis=-1) < 0.06
        images[camera, 10] = images[camera, 10] - np.float32(0.02) * spot[..., None]
        (change,) = features(dict(comparator.observed)) - features(images)
        assert change.max() == pytest.approx(0.02 * 255.0, rel=1e-3)
        for k in np.flatnonzero(np.abs(change) > 1e-3):
            assert layout.sites[k].channel == camera
            assert np.hypot(layout.sites[k].x - x, layout.sites[k].y - y) < 0.06 + PATCH


def test_soil_prepared_together_is_that_of_single_simulations(model: Model, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[tuple[int, int | None, float]] = []

    def draw(_: Model, trajectory: Any, seed: int, values: Any, *, albedo: int | None, rounding: float) -> dict:
        drawn.append((seed, albedo, rounding))
        return {}

    monkeypatch.setattr(Model, "draw", draw)

    def experiment() -> PlowExperiment:
        return PlowExperiment(model, candidates=("buried_obstacle", "cohesion", "exposure"))

    def run(seed: int = 0, variant: str = "", effects: tuple[str, ...] = (), **values: float) -> Run:
        return Run({"friction_angle": 35.0, **values}, effects, seed, variant)

    runs = [
        run(),
        run(1),
        run(variant="albedo 2"),
        run(effects=("exposure",), exposure_gain=0.9),
        run(effects=("cohesion",), cohesion=300.0),
        run(1, effects=("cohesion",), cohesion=300.0),
        run(variant="fine"),
    ]
    unseen = run(effects=("buried_obstacle",), obstacle_radius=0.001)
    alone = [experiment().prediction(each).trajectory.positions for each in runs]
    assert drawn[:3] == [(0, None, 1.0), (1, None, 1.0), (0, 2, 1.0)]
    prepared = experiment()
    assert prepared.batch_size == 1, "a CPU makes one at a time, and keeps one"
    prepared.__dict__["batch_size"] = 5
    prepared.prepare([unseen, *runs])
    assert len(prepared._trajectories) == 5
    with pytest.raises(SimulationError, match="no node"):
        prepared.prediction(unseen)
    monkeypatch.delattr(Model, "simulate")
    for each, positions in zip(runs, alone, strict=True):
        assert np.array_equal(prepared.prediction(each).trajectory.positions, positions)
    different = [alone[0], alone[1], *alone[4:]]
    assert not any(np.array_equal(a, b) for a, b in combinations(different, 2))
    prepared.prepare([run(2)])
    assert len(prepared._trajectories) == 5, "the cache doesn't grow"
    drawn.clear()
    prepared.prediction(run(2, variant="rounding"))
    assert drawn == [(2, None, 2.0)], "another drawing of the same simulation"
    with pytest.raises(KeyError, match="finer"):
        prepared.prediction(run(variant="finer"))
