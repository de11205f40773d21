"""Controls of the benchmark of hidden effects, and what it counts."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks._hidden import NOTHING, Kind, Truth, hidden_and_named
from splatsoil.benchmarks._tally import Found, confusion, tally
from splatsoil.benchmarks.hidden_effects import KINDS, diagnosed, emulated, main, shuffled, smallest_error
from splatsoil.inverse.criticism.diagnosis import Options
from splatsoil.inverse.criticism.verdicts import Verdict

from splatsoil.errors import ParameterError


def found(verdict: Verdict, *members: str, blind: str | None = None) -> Found:
    values = {"angle": 0.0, "effect 1": 3.0}
    stds = {"angle": 1.0, "effect 1": 1.0}
    return Found(verdict, members, 0.0, values, stds, (2.0, 1.0), ("effect 1",), 30, blind)


def test_a_shuffled_library_keeps_each_cameras_values_and_the_models_own_trace() -> None:
    world = emulated(77)
    other = shuffled(world, np.random.default_rng(3))
    channel = world.layout.channel_numbers
    assert np.array_equal(other.slopes["angle"], world.slopes["angle"])
    for name in (c.name for c in world.candidates):
        assert not np.array_equal(other.slopes[name], world.slopes[name])
        for number in np.unique(channel):
            here = channel == number
            assert np.array_equal(np.sort(other.slopes[name][:, here]), np.sort(world.slopes[name][:, here]))
    # The observation is the true world's.
    assert np.array_equal(other.expected({"angle": 1.0}), world.expected({"angle": 1.0}))


def test_the_smallest_error_of_all_refits_names_something_where_nothing_is_hidden() -> None:
    world = emulated(78)
    large = replace(world, observed=world.measured({"angle": 0.5, "effect 2": 9.0}, [78, 99]))
    options = Options(repeats=4)
    assert smallest_error(large, diagnosed(large, options), options) == "effect 2"
    # Eight refits with a parameter more than the model as it is: one of them is luckier.
    nothing = [replace(w, observed=w.measured({"angle": 0.5}, [78, k])) for k, w in enumerate(map(emulated, (78, 79)))]
    assert any(smallest_error(w, diagnosed(w, options), options) for w in nothing)


def test_names_are_counted_against_what_is_hidden() -> None:
    single, foreign = Kind("one", 2.0, 1), Kind("gone", 2.0, 1, dropped=True)
    truth = Truth(0.0, {"effect 1": 3.0}, 1000)
    rows = {
        NOTHING: [(Truth(0.0, {}, 1001), found("adequate")), (Truth(0.0, {}, 1002), found("missing", "effect 2"))],
        single: [
            (truth, found("missing", "effect 1", blind="effect 1")),
            (truth, found("outside the library", "effect 1", blind="effect 2")),
        ],
        foreign: [(truth, found("missing", "effect 2"))],
    }
    pairs = hidden_and_named(rows)
    assert pairs == [("nothing", n) for n in ("nothing", "effect 2")] + [
        ("effect 1", n) for n in ("effect 1", "nothing")
    ]
    assert confusion(pairs).splitlines()[2:] == ["| nothing | 1 | – | 1 |", "| effect 1 | 1 | 1 | – |"]
    kinds = {"effect 1": "physics", "effect 2": "physics"}
    row = tally("one", [t.sizes for t, _ in rows[single]], [f for _, f in rows[single]], [0.0, 0.0], kinds)
    assert row.blind == (2, 1) and row.simulations == 30
    assert tally("none", [{}], [found("adequate")], [0.0], kinds).blind is None


def test_the_command_keeps_what_it_judged_and_goes_on_from_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--count", "1", "--only", "nothing", "--seed", "5", "--out", str(tmp_path), "--json"]
    assert main(words) == 0
    first = json.loads(capsys.readouterr().out)
    (kept,) = (tmp_path / "judged").iterdir()
    written = kept.stat().st_mtime_ns
    assert main(words) == 0 and kept.stat().st_mtime_ns == written
    assert json.loads(capsys.readouterr().out)["rows"] == first["rows"] and first["rows"][0]["count"] == 1
    with pytest.raises(ParameterError, match="another protocol"):
        main([*words, "--repeats", "5"])
    with pytest.raises(ParameterError, match="no kind"):
        main(["--only", "no such", "--out", str(tmp_path)])


def test_kinds_have_names_of_their_own() -> None:
    assert len({kind.number for kind in KINDS}) == len(KINDS)
    assert [kind.name for kind in KINDS if kind.foreign] == [k.name for k in KINDS if k.dropped or k.shuffled] != []
