"""The benchmark with real simulations: what reaches the analysis, without simulating anything."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from splatsoil.benchmarks.hidden_effects import emulated, tally
from splatsoil.benchmarks.hidden_soil import Hidden, main
from splatsoil.inverse.criticism.diagnosis import diagnose


def test_the_analysis_sees_the_hidden_observation_and_nothing_else_of_it() -> None:
    world: Any = emulated(77)
    observed = world.measured({"angle": 1.0, "effect 2": 9.0}, [77, 99])
    hidden: Any = Hidden(world, observed)
    assert np.array_equal(hidden.observed, observed) and not np.any(world.observed)
    assert np.array_equal(hidden.predict({"angle": 1.0}), world.predict({"angle": 1.0}))
    found = diagnose(hidden, {"angle": 1.0})
    assert found.members[0] == "effect 2"
    kinds = {c.name: c.kind for c in world.candidates}
    row = tally("one", [{"effect 2": 9.0}], [found], [1.0], kinds)
    assert (row.named, row.first, row.held, row.intervals) == (1, 1, 1, 2)
    wrong = tally("one", [{"effect 1": 9.0}], [found], [1.0], kinds)
    assert (wrong.named, wrong.first, wrong.held, wrong.intervals) == (1, 0, 0, 0)
    far = tally("one", [{"effect 2": 90.0}], [found], [50.0], kinds)
    assert far.inside == (0, 0) and far.intervals == 2


def test_it_says_what_it_does(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0 and "own soil" in capsys.readouterr().out
