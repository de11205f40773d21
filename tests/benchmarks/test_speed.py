"""``splatsoil benchmark speed``: ratios, and that both sides of them do the same work. No times."""

from __future__ import annotations

from pathlib import Path

import pytest
from splatsoil.benchmarks import speed
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


def test_effects_cost_something(task: Task) -> None:
    (row,) = speed.effects(task).rows
    assert float(row.found) > 0.0 and "8 effects" not in row.expected
