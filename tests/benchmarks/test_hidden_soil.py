"""Hidden effects with real simulations: what reaches the analysis, is drawn and kept, without simulating anything."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splatsoil.benchmarks._hidden import FIRST_SEED, NOTHING, Truth, count_up, draw
from splatsoil.benchmarks._tally import Found, entry, table, tally
from splatsoil.benchmarks.hidden_effects import emulated
from splatsoil.benchmarks.hidden_soil import ANGLES, Hidden, Place, judge, kinds_of, main
from splatsoil.inverse.criticism.diagnosis import diagnose

from splatsoil.files import plain, write_json

LEAST = {"effect 1": 2.0, "effect 2": 30.0, "effect 7": 0.5}


def test_the_analysis_sees_the_hidden_observation_and_nothing_else_of_it() -> None:
    world: Any = emulated(77)
    observed = world.measured({"angle": 1.0, "effect 2": 9.0}, [77, 99])
    hidden: Any = Hidden(world, observed)
    assert np.array_equal(hidden.observed, observed) and not np.any(world.observed)
    assert np.array_equal(hidden.predict({"angle": 1.0}), world.predict({"angle": 1.0}))
    found = diagnose(hidden, {"angle": 1.0})
    assert found.members[0] == "effect 2"
    counted = [Found.of(found, "angle")]
    kinds = {c.name: c.kind for c in world.candidates}
    row = tally("one", [{"effect 2": 9.0}], counted, [1.0], kinds)
    assert (row.named, row.first, row.held, row.intervals) == (1, 1, 1, 2)
    wrong = tally("one", [{"effect 1": 9.0}], counted, [1.0], kinds)
    assert (wrong.named, wrong.first, wrong.held, wrong.intervals) == (1, 0, 0, 0)
    far = tally("one", [{"effect 2": 90.0}], counted, [50.0], kinds)
    assert far.inside == (0, 0) and far.intervals == 2


def test_truths_are_sealed_by_their_seed_and_of_the_size_that_their_row_says() -> None:
    world = emulated(77)
    nothing, single, reported, pair, dropped = kinds_of([2.0])
    assert draw(nothing, 0, 5, world.candidates, LEAST, ANGLES).sizes == {}
    drawn = [draw(single, k, 5, world.candidates, LEAST, ANGLES) for k in range(40)]
    assert drawn == [draw(single, k, 5, world.candidates, LEAST, ANGLES) for k in range(40)]
    assert drawn != [draw(single, k, 6, world.candidates, LEAST, ANGLES) for k in range(40)]
    assert len({truth.seed for truth in drawn}) == 40 and min(truth.seed for truth in drawn) >= FIRST_SEED
    assert all(30.0 <= truth.angle <= 40.0 for truth in drawn)
    # Twice 30 lies beyond the bounds of ±50; an effect without a detectable size is never drawn.
    assert {name for truth in drawn for name in truth.sizes} == {"effect 1"}
    assert {value for truth in drawn for value in truth.sizes.values()} == {-4.0, 4.0}
    assert {n for k in range(9) for n in draw(reported, k, 5, world.candidates, LEAST, ANGLES).sizes} == {"effect 7"}
    both = {**LEAST, "effect 2": 3.0}
    assert draw(pair, 0, 5, world.candidates, both, ANGLES).sizes.keys() == {"effect 1", "effect 2"}
    assert dropped.dropped and not single.dropped


def test_what_was_judged_is_read_and_not_judged_again(tmp_path: Path) -> None:
    truth = Truth(33.0, {}, 2000)
    found = Found("adequate", (), 34.5, {}, {}, (math.nan, math.nan), ("cohesion",), 40)
    place = Place(tmp_path / "no such set", "tiny", "cpu", ("cohesion",), tmp_path)
    with pytest.raises(Exception, match="no such set"):
        judge(place, NOTHING, 0, 1, {})
    write_json(
        tmp_path / "judged" / "22298ed7-0.json",
        plain({"kind": NOTHING.name, "truth": asdict(truth), "found": asdict(found)}),
    )
    read_truth, read_found = judge(place, NOTHING, 0, 1, {})
    assert read_truth == truth and read_found.error[0] is not None and math.isnan(read_found.error[0])
    row = tally("nothing", [read_truth.sizes], [read_found], [read_truth.angle], {"cohesion": "physics"}, "angle")
    assert row.named == 0 and row.bias[0] == pytest.approx(1.5)
    kept = json.loads(json.dumps(plain(entry(row))))
    assert "| nothing | 1 | 0 %" in table({"rows": [kept]}) == table({"rows": [entry(row)]}) != ""


def test_a_truth_that_was_taken_out_of_the_library_is_not_to_be_found() -> None:
    candidates = emulated(77).candidates
    single, dropped = (kind for kind in kinds_of([4.0]) if kind.effects == 1 and kind.among == "physics")
    found = Found("missing", ("effect 1",), 36.0, {"friction_angle": 33.5, "effect 1": 4.2}, {}, (2.0, 1.0), (), 40)
    judged = [(Truth(33.0, {"effect 1": 4.0}, 2000), found)]
    rows = [count_up(kind, judged, candidates, "friction_angle") for kind in (single, dropped)]
    assert [(row.named, row.held, row.first) for row in rows] == [(1, 1, 1), (1, 0, 0)]
    assert rows[0].bias == pytest.approx((3.0, 0.5)) and rows[0].error == (2.0, 1.0)


def test_it_says_what_it_does(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["--help"])
    assert stop.value.code == 0 and "own soil" in capsys.readouterr().out
