"""What run-to-run equality costs: told as equal only where bits are. No times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks._speed import run_to_run


@pytest.mark.slow
def test_run_to_run_equality_is_seen_where_there_is_some(plow_dry: Path) -> None:
    """A CPU gives the same bits with the option and without it; each in a process of its own."""
    group = run_to_run.compare(plow_dry, "tiny", "cpu", 1)
    assert [row.what.split(": ")[1] for row in group.rows] == ["the same bits"] * 2
    assert "a particle 0 mm from" in group.notes[0]


def test_run_to_run_equality_is_not_told_where_bits_differ() -> None:
    noise = np.random.default_rng(0)
    found = run_to_run._repeated(lambda: noise.normal(size=(5, 3)), 2, "cpu")
    assert not found["same"] and found["apart"] > 0.1 and len(found["seconds"]) == 2
    assert run_to_run._same(found) == "NOT THE SAME BITS"
