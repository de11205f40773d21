"""``splatsoil benchmark whole-path``: what misses a target, the true surface, and its parts on few particles."""

from __future__ import annotations

import shutil
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks import whole_path
from splatsoil.benchmarks._truth import Truth
from splatsoil.benchmarks.whole_path import true_surface

from splatsoil.files import write_json
from splatsoil.reconstruction import HeightField


@pytest.fixture
def task(plow_dry: Path, plow_damp: Path, tmp_path: Path) -> Namespace:
    return Namespace(dry=plow_dry, damp=plow_damp, preset="tiny", device="cpu", out=tmp_path)


def test_the_surface_of_a_level_bed_is_level(plow_dry: Path) -> None:
    """A lattice 10 cm high: half of the bulk remains at the height of its topmost cubes' faces, 0.45 a little above."""
    truth = Truth.load(plow_dry)
    bed, spacing = truth.measurement.bed, 0.01
    axes = [np.arange(0.5 * spacing, length, spacing) for length in (*bed.extents[:2], 0.1)]
    x = bed.lower + np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    cells = HeightField(np.linspace(0.2, 0.6, 5), np.linspace(0.2, 0.3, 3), np.zeros((3, 5)))
    found = true_surface(replace(truth, particles={0: x}, volume=spacing**3), cells)
    assert found.height == pytest.approx(bed.lower[2] + 0.1, abs=2e-3)


def test_runs_are_held_against_the_truth_and_the_targets(task: Namespace, monkeypatch: pytest.MonkeyPatch) -> None:
    """36° dry; 33° and 300 Pa damp: what the commands answer is made up."""
    answer, took = {"angle": 37.0, "effects": ["cohesion"], "cohesion": 310.0}, whole_path.Ran(400.0, 2**30)

    def run(_: Namespace, folder: Path, seed: int, *words: str) -> tuple[Path, whole_path.Ran]:
        place = task.out / "runs" / f"{folder.name}-{seed}"
        angle = {"value": answer["angle"], "estimate": answer["angle"], "std": 1.0}
        fit = {"parameters": {"friction_angle": angle}, "setup": {"effects": answer["effects"]}}
        write_json(place / "fit.json", fit)
        estimates = {"friction_angle": angle, "cohesion": {"value": answer["cohesion"], "std": 50.0}}
        write_json(place / "diagnosis.json", {"estimates": estimates})
        return place, took

    monkeypatch.setattr(whole_path, "_run", run)
    angle, time = whole_path.dry(task).rows
    assert angle.held and time.held and time.found == "6.7 min; 1.0 GiB"
    answer["angle"] = 38.1
    (angle,) = whole_path.dry(task).rows  # a run that is there already is not timed
    assert angle.held is False
    shutil.rmtree(task.out / "runs")
    for took in (whole_path.Ran(481.0, 2**30), whole_path.Ran(400.0, 2**31 + 1)):  # noqa: B007 (run returns it)
        assert whole_path.dry(task).rows[1].held is False
        shutil.rmtree(task.out / "runs")
    answer["angle"] = 34.0
    assert [row.held for row in whole_path.damp(task).rows] == [True, True, True]
    answer |= {"angle": 35.1, "effects": ["cohesion", "tilt"], "cohesion": 380.0}
    assert [row.held for row in whole_path.damp(task).rows] == [False, False, False]


@pytest.mark.slow
def test_reconstruction_and_renderer_on_few_particles(task: Namespace) -> None:
    rows = whole_path.reconstruction(task).rows
    assert len(rows) == 2 and rows[1].held is not None
    loss, raw = whole_path.renderer(task).rows
    least, weak, strong = (float(word) for word in loss.found.replace(";", " and").split(" and"))
    assert 0.0 < least < min(weak, strong) and loss.held == (least < 0.5 * min(weak, strong))
    assert raw.held is None
