"""Work whose memory is full is done in smaller batches; a GPU's errors are raised here on a CPU."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from splatsoil.envs.measured import MeasuredProblem
from splatsoil.envs.problem import Evaluation
from splatsoil.envs.together import evaluate_together

from splatsoil import batches, cli
from splatsoil.batches import in_batches
from splatsoil.errors import SetWarning
from splatsoil.experiment.base import Run
from splatsoil.experiment.plow import PlowExperiment
from splatsoil.mpm import Trajectory
from splatsoil.scene import Scene

ERRORS = [
    RuntimeError("Failed to allocate 5368709120 bytes on device 'cuda:0'"),
    torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 5.00 GiB."),
    RuntimeError("Failed to allocate 5368709120 bytes on device 'cpu'"),
]


@pytest.fixture(autouse=True)
def forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """What earlier tests found."""
    monkeypatch.setattr(batches, "_most", {})


@pytest.fixture
def full() -> Callable[..., Any]:
    """Makes work that holds so many at once, and tells how many it was asked for."""

    def make(room: int, error: Exception, result: Callable[[Any], Any] = lambda item: item) -> Any:
        asked: list[int] = []

        def work(items: Sequence[Any]) -> list[Any]:
            asked.append(len(items))
            if len(items) > room:
                raise error
            return [result(item) for item in items]

        return work, asked

    return make


@pytest.mark.parametrize(
    ("error", "memory"),
    list(zip(ERRORS, ("GPU memory", "GPU memory", "memory"), strict=True)),
    ids=("warp", "torch", "cpu"),
)
def test_a_full_memory_halves_the_batch_and_is_told_once(
    full: Callable[..., Any], error: Exception, memory: str
) -> None:
    work, asked = full(4, error, lambda item: 10 * item)
    with pytest.warns(SetWarning) as said:
        assert in_batches(work, range(8), "simulations") == [10 * k for k in range(8)]
        assert in_batches(work, range(5), "simulations") == [10 * k for k in range(5)]
    assert [str(w.message) for w in said] == [f"{memory} is full: 4 instead of 8 simulations at a time"]
    assert asked == [8, 4, 4, 4, 1]


@pytest.mark.filterwarnings("ignore::splatsoil.errors.SetWarning")
def test_other_errors_and_a_single_one_without_room_are_raised(full: Callable[..., Any]) -> None:
    for room, error, count in ((0, ERRORS[0], 2), (0, RuntimeError("a kernel is wrong"), 1)):
        work, asked = full(room, error)
        with pytest.raises(RuntimeError, match=str(error)[:9]):
            in_batches(work, [1, 2], "pictures")
        assert len(asked) == count


@pytest.mark.filterwarnings("ignore::splatsoil.errors.SetWarning")
def test_simulations_for_criticism_and_for_a_fit_go_on(
    full: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def trajectory(value: dict[str, float]) -> Trajectory:
        return Trajectory((0,), np.full((1, 1, 3), value["angle"]), np.zeros((1, 1, 3, 3)), np.zeros((0, 3)), 0.1, None)  # type: ignore[arg-type]

    work, asked = full(1, ERRORS[0], trajectory)
    simulate = lambda measurement, particles, values, *_: work(values)  # noqa: E731
    monkeypatch.setattr("splatsoil.experiment.plow.simulate_together", simulate)
    monkeypatch.setattr("splatsoil.mpm.simulate_together", simulate)
    base: Any = SimpleNamespace(
        law=SimpleNamespace(effects=()), observation_parameters=(), recorded=(0,), particles=len, measurement=None
    )
    base.particles, base.reported = (lambda seed: None), (lambda made, seed, values: SimpleNamespace(values=values))
    experiment: Any = object.__new__(PlowExperiment)
    experiment.__dict__ |= {"base": base, "progress": None, "_trajectories": {}, "batch_size": 3}
    experiment._model_of = lambda run: (base, run.variant)
    angles = [1.0, 2.0, 3.0]
    experiment.prepare([Run({"angle": a}) for a in angles])
    assert [float(kept.positions[0, 0, 0]) for kept in experiment._trajectories.values()] == angles
    problem = cast(Any, object.__new__(MeasuredProblem))
    problem.__dict__ |= {"model": base, "experiment": SimpleNamespace(progress=None)}
    monkeypatch.setattr(MeasuredProblem, "judge", lambda self, p: Evaluation(p.values["angle"], np.zeros(1)))
    found = evaluate_together([problem] * 3, [({"angle": a}, 0) for a in angles])
    assert [evaluation.loss for evaluation in found] == angles and asked == [3, *[1] * 6]


@pytest.mark.filterwarnings("ignore::splatsoil.errors.SetWarning")
def test_pictures_and_moments_go_on(full: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> None:
    scene = cast(Any, object.__new__(Scene))
    camera = SimpleNamespace(width=4, height=3)
    work, asked = full(2, ERRORS[1], lambda view: np.full((3, 4, 3), view[0]))
    monkeypatch.setattr(Scene, "device", SimpleNamespace(type="cuda"))
    monkeypatch.setattr(Scene, "_images", lambda self, views: work(views))
    assert [p[0, 0, 0] for p in scene.pictures([(k, camera) for k in range(5)])] == list(range(5))
    assert asked == [5, 2, 2, 1]
    monkeypatch.setattr(Scene, "_posing", lambda self, number: number)
    work, asked = full(2, ERRORS[1])
    monkeypatch.setattr("splatsoil.scene.render.together", work)
    assert scene.poses((k,) for k in range(5)) == list(range(5)) and asked == [5, 2, 2, 1]


def test_a_command_without_any_room_says_so(
    monkeypatch: pytest.MonkeyPatch, plow_dry: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def too_much(*_: object) -> None:
        raise ERRORS[1]

    monkeypatch.setattr("splatsoil.measurement.Measurement.load", too_much)
    assert cli.main(["check", str(plow_dry), "--json"]) == 2
    out, err = capsys.readouterr()
    assert json.loads(out)["error"] in err and err == f"splatsoil: {json.loads(out)['error']}\n"
