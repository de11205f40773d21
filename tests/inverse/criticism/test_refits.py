"""Refits side by side: which go on after their first steps, and what is simulated for them beforehand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from splatsoil.benchmarks.hidden_effects import emulated
from splatsoil.inverse.criticism import refits
from splatsoil.inverse.criticism.bench import Bench
from splatsoil.inverse.criticism.confirmation import Confirmation, confirm, judged, split_times
from splatsoil.inverse.criticism.evidence import gather, switched_on
from splatsoil.inverse.criticism.looks import look
from splatsoil.inverse.criticism.refit import Known, Refit
from splatsoil.inverse.criticism.refits import Trial, stop
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.errors import SimulationError
from splatsoil.experiment.base import Candidate
from splatsoil.experiment.emulated import EmulatedExperiment

WORLDS, HIDDEN, SIZE = range(2), "effect 2", 8.0
EXPERIMENT = emulated(0, chaos=0.9)


def confirmed(world: int) -> tuple[dict[str, Confirmation], int]:
    """Three effects refitted where the second one is hidden, and how many simulations that took."""
    base = emulated(world, chaos=0.9)
    experiment = replace(base, observed=base.measured({"angle": 0.3, HIDDEN: SIZE}, [world, 99]))
    simulate = Simulations(experiment)
    evidence = switched_on(experiment, simulate, gather(experiment, simulate, {"angle": 0.0}))
    bench = Bench.of(experiment, evidence, level=0.05, seed=0)
    few = bench.candidates[:3]
    found = confirm(experiment, evidence, bench.floor, few, simulate, 5, bench.basis, lambda what, share: None)
    return found, simulate.asked


def test_what_explains_much_less_stops_early_and_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    stopped = [confirmed(world) for world in WORLDS]
    monkeypatch.setattr(refits, "LEAST_SHARE", -np.inf)
    for (some, fewer), (every, more) in zip(stopped, map(confirmed, WORLDS), strict=True):
        assert not any(c.stopped for name, c in every.items() if name)
        assert any(c.stopped for name, c in some.items() if name)
        assert fewer < more
        best = max(every, key=lambda name: every[name].fall)
        assert best == HIDDEN
        assert best == max(some, key=lambda name: some[name].fall)
        # What goes on is what it would have been: no seed hangs on who else does.
        for name in (name for name, c in some.items() if not c.stopped):
            assert some[name].values == every[name].values
            assert some[name].chi2 == every[name].chi2
        # And what stopped would have been far behind.
        assert all(every[n].fall < 0.6 * every[best].fall for n, c in some.items() if c.stopped)


def test_what_leaves_least_is_explored_once_more_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    seen, explored = [], refits.explored

    def spy(*args: Any, **more: Any) -> Refit:
        seen.extend(p.name for p in args[4] if p.name != "angle")
        return explored(*args, **more)

    monkeypatch.setattr(refits, "explored", spy)
    monkeypatch.setattr(refits, "LEAST_SHARE", -np.inf)
    found, _ = confirmed(0)
    assert {name: seen.count(name) for name in found if name} == {n: 1 + (n == HIDDEN) for n in found if n}


def trial(fall: float, known: Known | None = None, size: float = 0.0) -> Trial:
    """An effect that has taken as much off χ² = 1000 in its first steps, at some size of it."""
    candidate: Candidate = EXPERIMENT.candidates[0]
    made = Trial(EXPERIMENT, candidate, known or Known.nothing(2), Simulations(EXPERIMENT), [0], [])
    values = {"angle": 0.0, candidate.parameters[0].name: size}
    chi2 = 1000.0 - fall + made.known.chi2(np.array([0.0, size]))
    made.fit = Refit(values, chi2, EXPERIMENT.middle, 5, np.zeros((*EXPERIMENT.layout.shape, 2)))
    return made


def goes_on(*others: Trial, count: int = 1000, experiment: EmulatedExperiment = EXPERIMENT) -> list[bool]:
    """Whether each goes on, as an effect of its own, and the model as it is, of as many numbers in χ²."""
    for number, other in enumerate(others):
        other.candidate = EXPERIMENT.candidates[number]
    asis = Trial(experiment, None, Known.nothing(1), Simulations(experiment), [0], [])
    asis.fit = Refit({"angle": 0.0}, 1000.0, EXPERIMENT.middle, 3, np.zeros((*EXPERIMENT.layout.shape, 1)))
    stop([asis, *others], count)
    return [not trial.stopped for trial in (*others, asis)]


def test_what_first_steps_cannot_tell_apart_goes_on() -> None:
    assert goes_on(trial(100.0), trial(60.0), trial(45.0), trial(-20.0)) == [True, True, False, False, False]
    assert goes_on(trial(26.0), trial(4.0), trial(1.0)) == [True, True, False, False]
    assert goes_on(trial(20.0), trial(-2.0), trial(-5.0)) == [True, True, False, True]
    # Where each number still holds ten times its noise, a fall of 45 less than another is chance, and so are both.
    assert goes_on(trial(100.0), trial(45.0), count=90) == [True, True, True]


def test_what_other_pictures_ask_for_goes_on_and_what_they_deny_stops_nothing() -> None:
    """They say that the size is 5 ± 0.5."""
    told = Known(np.array([[0.0, 2.0]]), np.array([0.0, 5.0]))
    assert goes_on(trial(400.0), trial(0.0, told, size=5.0)) == [True, True, False]
    nothing = Known(np.array([[0.0, 2.0]]), np.array([0.0, 0.0]))
    assert goes_on(trial(400.0, nothing, size=5.0), trial(100.0), trial(45.0)) == [True, True, False, False]


def test_a_model_whose_parameters_make_up_for_each_other_goes_on() -> None:
    """It took no steps, so that nothing is known of how much these parameters would take off χ²."""
    second = replace(EXPERIMENT.parameters[0], name="second")
    two = replace(EXPERIMENT, parameters=(*EXPERIMENT.parameters, second))
    assert goes_on(trial(100.0), trial(45.0)) == [True, False, False]
    assert goes_on(trial(100.0), trial(45.0), experiment=two) == [True, False, True]


def test_the_model_as_it_is_alone_stops_nothing() -> None:
    assert goes_on() == [True]


def test_what_stopped_costs_no_more_and_is_told_by_its_last_simulation() -> None:
    base = emulated(0, chaos=0.9)
    experiment = replace(base, observed=base.measured({"angle": 0.3, HIDDEN: SIZE}, [0, 99]))
    asked: list[str] = []

    class Counted(Simulations):
        def __call__(self, values: Mapping[str, float], **what: Any) -> np.ndarray:
            asked.append(what.get("purpose", ""))
            return super().__call__(values, **what)

    simulate = Counted(experiment)
    looks = look(experiment, gather(experiment, simulate, {"angle": 0.0}), simulate)
    asked.clear()
    found = confirm(
        *(experiment, looks.evidence, looks.bench.floor, experiment.candidates[:3], simulate, 5),
        *(looks.bench.basis, lambda what, share: None),
    )
    stopped = [name for name, c in found.items() if name and c.stopped]
    assert stopped
    for name in stopped:
        spent = [purpose for purpose in asked if purpose.startswith(f"refit {name}")]
        assert len(spent) == found[name].fit.simulations <= 5
        left = experiment.observed - found[name].fit.prediction
        hidden = judged(experiment, split_times(experiment)[1])
        assert found[name].held_out == pytest.approx(np.sqrt(np.mean(left[hidden] ** 2)))
    assert found[""].stopped
    assert sum("of the model once more" in purpose for purpose in asked) == 4


class Noted(Simulations):
    """Notes what is asked for, ahead and in turn; the second point can't be simulated."""

    def __init__(self) -> None:
        super().__init__(EXPERIMENT)
        self.early: list[dict[str, Any]] = []
        self.late: list[dict[str, Any]] = []

    def ahead(self, work: Callable[..., object], *, apart: bool = False) -> None:
        assert apart
        work(lambda values, **what: self.early.append({"values": values, **what}))

    def __call__(self, values: Mapping[str, float], **what: Any) -> np.ndarray:
        self.late.append({"values": values, **what})
        if len(self.late) == 2:
            raise SimulationError("no simulation comes to an end")
        return super().__call__(values, **what)


def test_what_is_made_ahead_is_what_is_asked_for_next() -> None:
    simulate = Noted()
    (candidate,) = EXPERIMENT.candidates[:1]
    made = Trial(EXPERIMENT, candidate, Known.nothing(2), simulate, [0, 5, 6], [])
    points = [{"angle": 0.1 * k, candidate.parameters[0].name: 1.0} for k in range(5)]
    for some in (points[:2], points[2:]):
        made.ahead(some)
        for point in some:
            with suppress(SimulationError):
                made.predict(point)
    assert simulate.early == simulate.late
    assert [visit.seed for visit in made.visits] == [0, 6, 0, 5]
    assert all(visit.effects == (candidate.name,) for visit in made.visits)
