"""What a plow experiment draws without simulating anew."""

from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from splatsoil.commands._model import off_effects
from splatsoil.comparison import PATCH
from splatsoil.errors import ParameterError, SimulationError
from splatsoil.experiment.plow import MOST_TOGETHER, PlowExperiment
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.reconstruction import HeightField
from splatsoil.soil.library import library


def asked(numerics: str) -> tuple[list[Any], list[Any]]:
    """How a prediction was simulated (effects and numerics of the model, numerics), and drawn (seed, albedo, rounding)
    from it."""
    simulated: list[Any] = []
    drawn: list[Any] = []

    def draw(trajectory: Any, seed: int, values: Any, *, albedo: int | None, rounding: float) -> None:
        drawn.append((seed, albedo, rounding))

    model = SimpleNamespace(draw=draw)

    def variant(effects: tuple[str, ...], way: str) -> Any:
        simulated.append((effects, way))
        return model

    def trajectory(model: Any, values: Any, seed: int, way: str) -> None:
        simulated.append(way)

    experiment = SimpleNamespace(
        model=("cohesion",), guesses=PlowExperiment.guesses, _variant=variant, _trajectory=trajectory
    )
    experiment._computed = lambda effects, way: PlowExperiment._computed(cast(Any, experiment), effects, way)
    PlowExperiment.prediction(cast(Any, experiment), {}, effects=("tilt",), seed=3, numerics=numerics)
    return simulated, drawn


@pytest.mark.parametrize(
    ("numerics", "way", "drawing"),
    [
        ("", "", (None, 1.0)),
        ("fine", "fine", (None, 1.0)),
        ("albedo 1", "", (1, 1.0)),
        ("albedo 6", "", (6, 1.0)),
        ("rounding", "", (None, 2.0)),
    ],
)
def test_guesses_and_rounding_are_other_drawings_of_the_same_simulation(
    numerics: str, way: str, drawing: tuple[int | None, float]
) -> None:
    simulated, drawn = asked(numerics)
    assert simulated == [(("cohesion", "tilt"), way), way]
    assert drawn == [(3, *drawing)]


def test_an_unknown_way_is_not_taken_for_the_usual_one() -> None:
    assert asked("finer")[0] == [(("cohesion", "tilt"), "finer"), "finer"]
    base = SimpleNamespace(resolution=None, variant=lambda **changes: base)
    experiment: Any = SimpleNamespace(model=("cohesion",), base=base, _wanted={})
    assert PlowExperiment._variant(experiment, ("cohesion",), "") is base
    with pytest.raises(KeyError, match="finer"):
        PlowExperiment._variant(experiment, ("cohesion",), "finer")


def test_what_is_numerics_or_takes_a_laboratory_is_no_candidate(small_set: Path) -> None:
    measurement = Measurement.load(small_set)
    surface = HeightField.over(measurement.bed.lower, measurement.bed.upper, 0.02, 0.12)
    model = Model(measurement, cast(Any, SimpleNamespace(surface=surface)), preset="tiny")
    others = {"stiffness", "critical_state", "hardening", "intermediate_stress"}
    assert {c.name for c in PlowExperiment(model).candidates} == set(library()) - others
    assert [c.name for c in PlowExperiment(model, candidates=["hardening"]).candidates] == ["hardening"]
    with pytest.raises(ParameterError, match="other numerics"):
        off_effects(["stiffness"], ())


def test_what_one_camera_sees_is_in_its_columns_and_where_it_is(small_set: Path) -> None:
    """A spot of the bed a little darker in one camera's prediction: columns of that camera, of patches at the spot."""
    measurement = Measurement.load(small_set)
    surface = HeightField.over(measurement.bed.lower, measurement.bed.upper, 0.02, 0.12)
    experiment = PlowExperiment(Model(measurement, cast(Any, SimpleNamespace(surface=surface)), preset="tiny"))
    comparator, layout, force = experiment.comparator, experiment.layout, np.zeros((10, 3))

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


def test_soil_prepared_together_is_that_of_single_simulations(small_set: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measurement = Measurement.load(small_set)
    bed = measurement.bed
    surface = HeightField.over(bed.lower, bed.upper, 0.02, 0.12)
    model = Model(measurement, cast(Any, SimpleNamespace(surface=surface)), preset="tiny")
    monkeypatch.setattr(Model, "draw", lambda *_, **__: {})

    def experiment() -> PlowExperiment:
        return PlowExperiment(model, candidates=("buried_obstacle", "cohesion", "exposure"))

    def job(seed: int = 0, numerics: str = "", effects: tuple[str, ...] = (), **values: float) -> dict[str, Any]:
        return {"values": {"friction_angle": 35.0, **values}, "effects": effects, "seed": seed, "numerics": numerics}

    jobs = [
        job(),
        job(1),
        job(numerics="albedo 2"),
        job(effects=("exposure",), exposure_gain=0.9),
        job(effects=("cohesion",), cohesion=300.0),
        job(1, effects=("cohesion",), cohesion=300.0),
        job(numerics="fine"),
    ]
    unseen = job(effects=("buried_obstacle",), obstacle_radius=0.001)
    alone = [experiment().prediction(**each).trajectory.positions for each in jobs]
    prepared = experiment()
    assert prepared.together == 1, "a CPU makes one at a time, and keeps one"
    prepared.__dict__["together"] = 5
    prepared.prepare([unseen, *jobs])
    assert len(prepared._kept) == 5
    with pytest.raises(SimulationError, match="no node"):
        prepared.prediction(**unseen)
    monkeypatch.delattr(Model, "simulate")
    for each, positions in zip(jobs, alone, strict=True):
        assert np.array_equal(prepared.prediction(**each).trajectory.positions, positions)
    different = [alone[0], alone[1], *alone[4:]]
    assert not any(np.array_equal(a, b) for a, b in combinations(different, 2))
    prepared.prepare([job(2)])
    assert len(prepared._kept) == 5, "what is kept doesn't grow"


def test_more_cannot_be_made_together_than_there_is_room_for() -> None:
    def together(device: str, particles: int, frames: int) -> int:
        base = SimpleNamespace(device=device, particles=lambda: np.zeros((particles, 3)), recorded=tuple(range(frames)))
        experiment = SimpleNamespace(base=base)
        return cast(int, PlowExperiment.together.func(cast(Any, experiment)))

    assert together("cpu", 1000, 10) == 1
    assert together("cuda:0", 1000, 10) == MOST_TOGETHER
    assert together("cuda:0", 300_000, 10) == together("cuda:0", 50_000, 200) == 1


def test_what_cannot_be_prepared_is_left_to_predictions(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_memory(*_: Any) -> None:
        raise RuntimeError("out of memory")

    monkeypatch.setattr("splatsoil.experiment.plow.simulate_together", no_memory)
    base = SimpleNamespace(
        law=SimpleNamespace(effects=()),
        observation_parameters=(),
        recorded=(0,),
        particles=lambda seed: None,
        measurement=None,
    )
    experiment: Any = SimpleNamespace(base=base, progress=None, _kept={}, _computed=lambda effects, way: (base, way))
    jobs = [{"values": {"angle": a}, "effects": (), "seed": 0, "numerics": ""} for a in (1.0, 2.0)]
    PlowExperiment.prepare(experiment, jobs)
    assert not experiment._kept
