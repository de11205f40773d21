"""``splatsoil benchmark speed``: ratios, and that both sides of them do the same work. No times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks import speed
from splatsoil.benchmarks._newton import Run, World
from splatsoil.benchmarks.speed import SHARE, Task, Times


@pytest.fixture
def task(plow_dry: Path) -> Task:
    return Task(plow_dry, "tiny", "cpu", 1)


def test_a_ratio_says_how_many_times_as_fast_the_first_is() -> None:
    ours, other = Times((2.0, 1.0, 4.0)), Times((0.05,))
    assert ours.median == 2.0 and str(ours) == "2 ± 1.5 s" and str(other) == "50 ms"
    assert ours.over(other, "other") == "2 ± 1.5 s; other 50 ms: 0.025 × as fast"


def test_the_rasteriser_draws_what_the_reference_draws(task: Task) -> None:
    rows = speed.rasteriser(task, count=10 * SHARE, size=32).rows
    assert rows[0].held is True and 0.0 < float(rows[0].found) < 1e-4
    assert len(rows) == 3 and all("reference" in row.found for row in rows[1:])


def test_newton_is_given_as_much_soil_and_its_frames_make_the_whole_run(
    task: Task, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames of Newton take 2 s here, and those that compile an hour: 199 frames take 398 s."""
    scene, clock, worlds = task.scene, [0.0], list[tuple[int, World]]()

    def plough(
        given: list[World], numerics: object, frames: tuple[int], *_: object, begin: int, progress: object
    ) -> list:
        worlds.append((begin, given[0]))
        for k in range(frames[0] - begin):
            clock[0] += 2.0 if k else 3600.0
            progress(begin + k, frames[0])  # type: ignore[operator]
        return list[Run]()

    monkeypatch.setattr(speed, "plough", plough)
    monkeypatch.setattr(speed.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(speed.Scene, "run", lambda *_: clock.__setitem__(0, clock[0] + 4.0))
    (row,) = speed.newton(task).rows
    assert row.found == "4 s; Newton 398 ± 0 s: 99.5 × as fast" and row.held is True
    assert [begin for begin, _ in worlds] == [0, 50, 150]
    for begin, world in worlds:
        assert len(world.particles) == len(scene.x) and world.spacing == scene.resolution.spacing
        rows = task.truth.particles[begin]
        assert np.isin(world.particles[:5], rows).all(), "true particles of that frame"


def test_effects_cost_something(task: Task) -> None:
    (row,) = speed.effects(task).rows
    assert float(row.found) > 0.0 and "8 effects" not in row.expected
