"""The paper's protocol in code, on a world whose losses are known in closed form."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from splatsoil.benchmarks import _paper, _paper_budget, paper_table
from splatsoil.benchmarks._common import keep_to_one_protocol
from splatsoil.benchmarks._paper import FRAMES, Look, Protocol, Trial
from splatsoil.inverse import bayesopt
from splatsoil.inverse.executors import Serial

from splatsoil.comparison import Block
from splatsoil.errors import ParameterError
from splatsoil.files import read_json, write_json
from splatsoil.mpm import Resolution
from splatsoil.synthetic import paper

TRUTH = 41.0


@pytest.fixture(autouse=True)
def one_thread() -> None:
    torch.set_num_threads(1)


class KnownSight:
    """Losses are parabolas about 41°; features are straight lines, with chance that hangs on the seed."""

    def __init__(self, evaluations: int = 6) -> None:
        self.protocol = Protocol(trials=2, evaluations=evaluations)
        labels = tuple(Block("left", 50, float(k), 0.0) for k in range(6))
        self.comparator = SimpleNamespace(labels=labels, block_noise=lambda: 0.1)
        self.batches: list[list[tuple[float, int]]] = []

    def evaluate(self, way: str, jobs: Sequence[tuple[float, int]]) -> list[Look | None]:
        self.batches.append(list(jobs))
        out: list[Look | None] = []
        for angle, seed in jobs:
            chance = np.random.default_rng(seed).normal(size=6)
            loss = ((angle - TRUTH) / 10.0) ** 2
            slopes = np.arange(1.0, 7.0)
            out.append(Look(loss) if way == "published" else Look(loss, loss, (angle - TRUTH) * slopes + 0.2 * chance))
        return out


def quiet(_: str) -> None:
    return


def run(sight: Any, out: Path) -> dict[str, Any]:
    _paper.search(sight, TRUTH, [0, 1], out, "41-0", quiet)
    return {f.name: read_json(f) for f in sorted((out / "trials").glob("*.json"))}


@pytest.fixture
def no_features(monkeypatch: pytest.MonkeyPatch) -> None:
    """Searches only: a posterior takes as long as all of them together."""
    monkeypatch.setattr(_paper, "by_features", lambda *_: None)


@pytest.mark.slow
def test_features_find_the_angle(tmp_path: Path) -> None:
    found = run(KnownSight(8), tmp_path)
    for t in (0, 1):
        told = found[f"41-{t}-ours.json"]["features"]
        assert told["estimate"] == pytest.approx(TRUTH, abs=0.5) and told["low"] < TRUTH < told["high"]


@pytest.mark.usefixtures("no_features")
def test_trials_of_a_world_go_on_side_by_side_and_find_its_angle(tmp_path: Path) -> None:
    sight = KnownSight(8)
    found = run(sight, tmp_path)
    assert set(found) == {f"41-{t}-{way}.json" for t in (0, 1) for way in ("published", "ours")}
    # One batch for each way and step, with both trials in it.
    assert [len(batch) for batch in sight.batches] == [2] * 16
    assert len({seed for batch in sight.batches for _, seed in batch}) == 32, "every simulation has its own particles"
    for trial in found.values():
        assert len(trial["calls"]) == 8
    for t in (0, 1):
        assert found[f"41-{t}-ours.json"]["ours"]["estimate"] == pytest.approx(TRUTH, abs=0.5)
        assert "features" not in found[f"41-{t}-published.json"]
    # The paper's search begins at one random point, ours with a Sobol sequence: trials begin apart.
    firsts = {found[name]["calls"][0]["angle"] for name in found}
    assert len(firsts) == 4 and all(25.0 <= a <= 55.0 for a in firsts)


@pytest.mark.usefixtures("no_features")
def test_an_interrupted_table_makes_no_evaluation_twice(tmp_path: Path) -> None:
    whole = run(KnownSight(), tmp_path / "whole")

    class StopError(Exception):
        """What ends the first run."""

    class Stopping(KnownSight):
        def evaluate(self, way: str, jobs: Sequence[tuple[float, int]]) -> list[Look | None]:
            if len(self.batches) == 7:
                raise StopError
            return super().evaluate(way, jobs)

    with pytest.raises(StopError):
        run(Stopping(), tmp_path / "cut")
    sight = KnownSight()
    again = run(sight, tmp_path / "cut")
    assert sum(len(b) for b in sight.batches) == 2 * 2 * 6 - 2 * 7
    for name, trial in whole.items():
        trial.pop("seconds"), again[name].pop("seconds")
    assert again == whole


@pytest.mark.usefixtures("no_features")
def test_trials_in_parts_on_several_devices_come_to_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    used: list[tuple[str, str]] = []

    def made(protocol: Protocol, angle: float, number: int, out: Path, say: Any) -> tuple[str, str]:
        used.append(("world", protocol.device))
        return "measurement", "reconstruction"

    def seen(measurement: str, reconstruction: str, protocol: Protocol) -> KnownSight:
        used.append(("sight", protocol.device))
        return KnownSight(protocol.evaluations)

    monkeypatch.setattr(paper_table, "world", made)
    monkeypatch.setattr(paper_table, "Sight", seen)
    protocol = Protocol(angles=(TRUTH,), trials=4, evaluations=3, scan=(0, 9))
    results = []
    for name, devices, parts in (("whole", (), 1), ("parts", ("first", "second"), 3)):
        used.clear()
        out = tmp_path / name
        results.append(paper_table.run(protocol, out, Serial(), quiet, devices=devices, parts=parts)["entries"])
        assert len(list((out / "trials").glob("*.json"))) == 2 * 4
    assert results[0] == results[1]
    sights = [device for what, device in used if what == "sight"]
    assert sights == ["second", "first", "second"], "the world took the first device"


@pytest.mark.usefixtures("no_features")
def test_failed_simulations_are_left_out(tmp_path: Path) -> None:
    class Failing(KnownSight):
        def evaluate(self, way: str, jobs: Sequence[tuple[float, int]]) -> list[Look | None]:
            found = super().evaluate(way, jobs)
            return [None if angle > 45.0 else k for (angle, _), k in zip(jobs, found, strict=True)]

    found = run(Failing(6), tmp_path)
    for name in ("41-0-ours.json", "41-1-ours.json"):
        failed = [c for c in found[name]["calls"] if "ours" not in c]
        assert failed and all(c["angle"] > 45.0 for c in failed)
        assert found[name]["ours"]["estimate"] == pytest.approx(TRUTH, abs=2.5)


def test_what_is_asked_hangs_on_what_was_told_alone() -> None:
    trial = Trial(3, "ours", [30.0, 50.0], [Look(1.0, 1.21, np.array([0.5, -0.25])), None])
    first, second = trial.told
    assert first.action == pytest.approx(-2.0 / 3.0) and first.loss == 1.21
    assert second.action == pytest.approx(2.0 / 3.0) and second.loss is None
    assert _paper.propose("ours", 3, trial.told) == _paper.propose("ours", 3, trial.told)


def test_the_published_loss_is_the_mean_square_over_four_frames() -> None:
    rng = np.random.default_rng(0)
    keys = tuple((c, f) for c in ("left", "right") for f in (10, *FRAMES))
    observed, images = ({k: rng.uniform(size=(3, 4, 3)).astype(np.float32) for k in keys} for _ in range(2))
    told = _paper.look(SimpleNamespace(keys=keys, observed=observed), images, False)  # type: ignore[arg-type]
    by_hand = [(observed[k] - images[k]) ** 2 for k in keys if k[1] in (50, 100, 150, 199)]
    assert len(by_hand) == 8 and told.published == pytest.approx(float(np.mean(by_hand)), rel=1e-5)
    assert told.ours is None


def test_the_protocol_is_the_papers() -> None:
    protocol, scene = Protocol(), paper()
    assert (protocol.angles, protocol.trials, protocol.evaluations) == ((25.0, 30.0, 35.0, 45.0), 10, 10)
    assert len(scene.views) == 40 and {(c.width, c.height) for c in scene.video.values()} == {(1280, 720)}
    assert {p.lower for p in _paper.SPACE} == {25.0} and {p.upper for p in _paper.SPACE} == {55.0}
    experiment = scene.experiment()
    cells = (protocol.published_cells, protocol.cells, protocol.truth_cells)
    theirs, ours, truth = (Resolution.derive(experiment, protocol.preset("some", c)) for c in cells)
    assert [r.cell for r in (theirs, ours, truth)] == pytest.approx([1.0 / 32.0, 1.0 / 64.0, 1.0 / 87.0])
    # Finer, and no node of the one's is a node of the other's inside the bed.
    assert truth.cell < 0.8 * ours.cell
    for model in (theirs, ours):
        nodes = [np.arange(1, round(1.0 / r.cell)) * r.cell for r in (model, truth)]
        assert np.abs(nodes[0][:, None] - nodes[1][None]).min() > 1e-4


def test_errors_are_counted(tmp_path: Path) -> None:
    protocol = Protocol(angles=(35.0,), trials=2)
    for trial, error in enumerate((1.0, -2.0)):
        for way in ("published", "ours"):
            told = {"estimate": 35.0 + error, "low": 34.5, "high": 36.5}
            write_json(tmp_path / "trials" / f"35-{trial}-{way}.json", {way: told, "features": None})
    (first, _) = paper_table.collect(protocol, tmp_path)["entries"]
    assert (first["mae"], first["bias"]) == (1.5, -0.5)
    assert first["std"] == pytest.approx(0.5**0.5) and first["scatter"] == pytest.approx(4.5**0.5)
    text = paper_table.table(paper_table.collect(protocol, tmp_path))
    assert "| 35° | 1.24 ± 0.96° | 1.50 ± 0.71° |" in text
    one = paper_table.collect(Protocol(angles=(35.0,), trials=1), tmp_path)
    assert "| 35° | 1.24 ± 0.96° | 1.00° |" in paper_table.table(one), "one trial has no spread"


def test_the_parts_of_the_error_add_up() -> None:
    minima = {"photographs": [[38.0, 40.0]], "grid": [[36.0, 37.0], [36.5, 36.5]], "same": [[35.0, 35.4], [35.2, 35.2]]}
    told = _paper_budget.shares(minima, 35.0)
    assert told is not None
    assert told["total"] == pytest.approx(4.0) and told["loss"] == pytest.approx(0.2)
    assert told["grid"] == pytest.approx(1.3) and told["reconstruction"] == pytest.approx(2.5)
    assert told["total"] == pytest.approx(told["loss"] + told["grid"] + told["reconstruction"])
    # Variances within each landscape's seeds: 2, 0.5, 0, 0.08, 0.
    assert told["chance"] == pytest.approx((2.58 / 5) ** 0.5)
    # Means of the landscapes of stand-ins, which differ by their particles only: all the same here, then 36 and 38.
    assert told["world"] == 0.0
    apart = _paper_budget.shares({**minima, "grid": [[35.0, 37.0], [38.0]]}, 35.0)
    assert apart is not None and apart["world"] == pytest.approx((2.0 / 2) ** 0.5)
    assert _paper_budget.shares({"photographs": [[38.0]], "grid": [[]], "same": [[35.0]]}, 35.0) is None
    text = "\n".join(
        _paper_budget.budget_table([{"angle": 35.0, "ways": {"published": told, "ours": told, "features": None}}])
    )
    assert text.count("| 35° |") == 2 and "| +4.00° | +0.20° | +1.30° | +2.50° | ± 0.72° | ± 0.00° |" in text


def test_the_minimum_of_a_landscape() -> None:
    scan = [(float(a), (a - 36.7) ** 2) for a in np.linspace(28.0, 44.0, 9)]
    space = _paper.SPACE
    assert _paper_budget.minimum(space, scan) == pytest.approx(36.7, abs=0.1)


def test_a_folder_keeps_one_protocol(tmp_path: Path) -> None:
    keep_to_one_protocol(tmp_path, paper_table.kept_protocol(Protocol()))
    keep_to_one_protocol(tmp_path, paper_table.kept_protocol(Protocol(trials=3, angles=(30.0,), scan=(0, 9))))
    with pytest.raises(ParameterError, match="another protocol"):
        keep_to_one_protocol(tmp_path, paper_table.kept_protocol(Protocol(views=8)))


def test_trials_of_another_search_are_not_gone_on_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep_to_one_protocol(tmp_path, paper_table.kept_protocol(Protocol()))
    other = tmp_path / "inverse"
    shutil.copytree(Path(bayesopt.__file__).parent, other)
    changed = other / "bayesopt.py"
    changed.write_text(changed.read_text() + "\n# another surrogate\n")
    monkeypatch.setattr(importlib.util.find_spec("splatsoil.inverse"), "submodule_search_locations", [str(other)])
    with pytest.raises(ParameterError, match="other sources"):
        keep_to_one_protocol(tmp_path, paper_table.kept_protocol(Protocol()))


def test_the_budget_tells_apart_what_was_put_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """Photographs whose landscape is lowest at 38.5°, a finer grid's at 36.5°, the model's own at 35.2 and 34.8°."""

    def observer(lowest: float) -> Any:
        return SimpleNamespace(lowest=lowest, labels=(), block_noise=lambda: 0.0)

    def seen(at: Any, images: Any, whole: bool) -> Look:
        loss = ((images["angle"] - at.lowest) / 10.0) ** 2
        return Look(loss, 2.0 * loss, np.array([images["angle"] - at.lowest]))

    batches: list[int] = []

    def drawn(_: Any, jobs: Sequence[tuple[float, int]]) -> Any:
        batches.append(len(jobs))
        # The last simulation of each landscape fails.
        yield from [None if k == len(jobs) - 1 else {"angle": a} for k, (a, _) in enumerate(jobs)]

    monkeypatch.setattr(_paper_budget, "look", seen)
    monkeypatch.setattr(
        _paper_budget, "by_features", lambda space, angles, blocks, *_: {"estimate": float((angles - blocks[:, 0])[0])}
    )
    stand_ins = {"grid": [observer(36.5), observer(36.5)], "same": [observer(35.2), observer(34.8)]}
    monkeypatch.setattr(_paper_budget, "_stand_ins", lambda *_: stand_ins)
    sight: Any = SimpleNamespace(protocol=Protocol(scan=(2, 7)), model=None, comparator=observer(38.5), drawn=drawn)
    told = _paper_budget.error_budget(sight, 35.0, quiet)
    assert batches == [7, 7] and told["range"] == [27.0, 43.0]
    for way in ("published", "ours", "features"):
        parts = told["ways"][way]
        assert parts["reconstruction"] == pytest.approx(2.0, abs=0.2)
        assert parts["grid"] == pytest.approx(1.5, abs=0.2)
        assert parts["loss"] == pytest.approx(0.0, abs=0.2)
        assert parts["total"] == pytest.approx(3.5, abs=0.2)
    assert [len(mine) for mine in told["ways"]["ours"]["minima"]["same"]] == [2, 2]
