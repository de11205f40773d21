"""The paper's protocol in code, on an experiment whose losses are known in closed form."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from splatsoil.benchmarks import paper_table
from splatsoil.benchmarks._agents import FEWEST, Answer
from splatsoil.benchmarks.paper_table import CELLS, FRAMES, SPACE, collect, preset, published_loss, table, trial
from splatsoil.envs.problem import Evaluation, Image

from splatsoil.errors import SimulationError
from splatsoil.files import write_json
from splatsoil.mpm import Resolution
from splatsoil.synthetic import paper

TRUTH = 41.0


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


class KnownProblem:
    """Losses are parabolas about 41°; features are straight lines, with scatter that depends on the seed; simulations
    at angles above 50° fail."""

    space, block_count, worst_loss, image_size = SPACE, 6, 10.0, (4, 6)

    def __init__(self) -> None:
        self.calls: list[tuple[float, int]] = []

    def begin(self, seed: int) -> None: ...

    def evaluate(self, parameters: Mapping[str, float], seed: int) -> Evaluation:
        angle = parameters["friction_angle"]
        self.calls.append((angle, seed))
        if angle > 50.0:
            raise SimulationError("it flies")
        scatter = 0.2 * np.random.default_rng(seed).normal(size=6)
        return Evaluation(((angle - TRUTH) / 10.0) ** 2, (TRUTH - angle) * np.arange(1.0, 7.0) + scatter)

    def observed_image(self) -> Image:
        return np.zeros((4, 6, 3), np.float32)

    def truth(self) -> None: ...


@pytest.mark.slow
def test_features_find_the_angle() -> None:
    for number in (0, 1):
        found = trial(KnownProblem(), "ours", number, 10, 0.1, {"friction_angle": TRUTH})["features"]
        assert found["error"] == pytest.approx([0.0], abs=0.5) and 0.02 < found["rank"][0] < 0.98


def test_trials_begin_apart_and_find_the_angle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Searches only: a posterior takes as long as all of them together."""
    monkeypatch.setattr(paper_table, "posterior", lambda *_, **__: Answer(np.zeros(1), np.zeros((2, 1))))
    calls = []
    for way, number in itertools.product(("published", "ours"), (0, 1)):
        problem = KnownProblem()
        found = trial(problem, way, number, 8, 0.1, {"friction_angle": TRUTH})
        assert way == "published" or found["ours"]["error"] == pytest.approx([0.0], abs=0.5)
        assert ("features" in found) == (way == "ours" and sum(angle <= 50.0 for angle, _ in problem.calls) >= FEWEST)
        calls.append(problem.calls)
    assert {len(made) for made in calls} == {8} and any(angle > 50.0 for made in calls for angle, _ in made)
    assert len({seed for made in calls for _, seed in made}) == 32, "every simulation has its own particles"
    # the paper's search begins at one random point, ours with a Sobol sequence
    firsts = {made[0][0] for made in calls}
    assert len(firsts) == 4 and all(25.0 <= a <= 55.0 for a in firsts)


def test_the_published_loss_is_the_mean_square_over_four_frames() -> None:
    rng = np.random.default_rng(0)
    keys = tuple((c, f) for c in ("left", "right") for f in (10, *FRAMES))
    observed, images = ({k: rng.uniform(size=(3, 4, 3)).astype(np.float32) for k in keys} for _ in range(2))
    found = published_loss(SimpleNamespace(keys=keys, observed=observed), images)  # type: ignore[arg-type]
    by_hand = [(observed[k] - images[k]) ** 2 for k in keys if k[1] in (50, 100, 150, 199)]
    assert len(by_hand) == 8 and found == pytest.approx(float(np.mean(by_hand)), rel=1e-5)


def test_the_protocol_is_the_papers() -> None:
    scene = paper()
    assert len(scene.views) == 40 and {(c.width, c.height) for c in scene.video.values()} == {(1280, 720)}
    assert {p.lower for p in SPACE} == {25.0} and {p.upper for p in SPACE} == {55.0}
    experiment = scene.experiment()
    theirs, ours, truth = (Resolution.derive(experiment, preset(which)) for which in CELLS)
    assert [r.cell for r in (theirs, ours, truth)] == pytest.approx([1.0 / 32.0, 1.0 / 64.0, 1.0 / 87.0])
    for model in (theirs, ours):  # no node of the one is a node of the other inside the bed
        nodes = [np.arange(1, round(1.0 / r.cell)) * r.cell for r in (model, truth)]
        assert np.abs(nodes[0][:, None] - nodes[1][None]).min() > 1e-4


def test_errors_are_counted(tmp_path: Path) -> None:
    for number, (error, rank) in enumerate(((1.0, 0.5), (-2.0, 0.99))):
        for way in ("published", "ours"):
            told = {"error": [error], "width": [2.0], "rank": [rank]}
            write_json(tmp_path / "trials" / f"35-{number}-{way}.json", {way: told})
    entries = collect([35.0], 2, tmp_path)
    first = entries[0]
    assert (first["mae"], first["bias"], first["width_90"], first["coverage_90"]) == (1.5, -0.5, 2.0, 0.5)
    assert first["mae_std"] == pytest.approx(0.5**0.5) and first["scatter"] == pytest.approx(4.5**0.5)
    assert len(entries) == 2 and "| 35° | 1.24 ± 0.96° | 1.50 ± 0.71° | 1.50 ± 0.71° | – |" in table(entries)
    assert "| 35° | ours | -0.50° | 2.12° | 2.00° | 50% |" in table(entries)
