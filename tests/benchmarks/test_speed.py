"""``splatsoil benchmark speed``: ratios. No times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from splatsoil.benchmarks import speed
from splatsoil.benchmarks.speed import Task, ratio, shown


def test_a_ratio_tells_how_many_times_as_fast_the_first_is() -> None:
    ours, other = np.array([2.0, 1.0, 4.0]), np.array([0.05])
    assert shown(ours) == "2 ± 1.5 s" and shown(other) == "50 ms"
    assert ratio(ours, other, "other") == "2 ± 1.5 s; other 50 ms: 0.025 × as fast"


def test_effects_cost_something(plow_dry: Path) -> None:
    (row,) = speed.effects(Task(plow_dry, "tiny", "cpu", 1)).rows
    assert float(row.found) > 0.0 and "8 effects" not in row.expected
