"""An instrument beside the cameras, that is believed to a share only, ends a valley that pictures leave open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from splatsoil.benchmarks.hidden_effects import detectable, emulated, fitted
from splatsoil.inverse.criticism.diagnosis import Diagnosis, Options, diagnose
from splatsoil.inverse.criticism.record import record

from splatsoil.experiment.emulated import EmulatedExperiment, FloatArray
from splatsoil.experiment.features import Layout, Site
from splatsoil.report import figures

NAME = "effect 2"
ERROR = 0.15
SEEN = 0.97
"""Share of the effect's trace in pictures that looks like the angle's."""


def valley(world: int) -> EmulatedExperiment:
    """A world in which the effect looks much like the angle."""
    made = emulated(world)
    own, angle = made.slopes[NAME], made.slopes["angle"]
    alike = angle * np.linalg.norm(own) / np.linalg.norm(angle)
    return replace(made, slopes={**made.slopes, NAME: SEEN * alike + np.sqrt(1.0 - SEEN**2) * own})


def weighed(made: EmulatedExperiment, share: float = 0.2) -> EmulatedExperiment:
    """The same world with a force beside its pictures that grows with the angle by a share a degree, and doesn't with
    the effect."""
    layout, (times, sites) = made.layout, made.layout.shape
    ramp = np.linspace(40.0, 100.0, times)[:, None]

    def beside(table: FloatArray, force: FloatArray) -> FloatArray:
        return np.concatenate([table, force], axis=-1)

    nothing = np.zeros((times, 1))
    forces = {"angle": share * ramp}
    root = np.zeros((times, sites + 1, times, sites + 1))
    root[:, :sites, :, :sites] = made.chance_root.reshape(times, sites, times, sites)
    root[np.arange(times), sites, np.arange(times), sites] = 1.0
    wide = Layout(
        layout.times,
        (*layout.sites, Site("force", unit="%")),
        layout.time_name,
        layout.unit,
        layout.stages,
        beside(layout.regions, np.full((times, 1), "tool")),  # type: ignore[arg-type]
    )
    middle = beside(made.middle, ramp)
    return replace(
        made,
        layout=wide,
        middle=middle,
        slopes={name: beside(table, forces.get(name, nothing)) for name, table in made.slopes.items()},
        curves={name: beside(table, nothing) for name, table in made.curves.items()},
        patterns={name: beside(table, nothing) for name, table in made.patterns.items()},
        chance_root=root.reshape(times * (sites + 1), -1),
        sensor=beside(made.sensor, nothing + 1.0),
        observed=np.zeros(wide.shape),
        quiet=np.zeros(wide.shape, dtype=bool),
        systematic=beside(np.zeros((1, times, sites)), ERROR * ramp[None]),
    )


def measured(experiment: EmulatedExperiment, truth: dict[str, float], world: int, off: float) -> EmulatedExperiment:
    """The world of a truth whose force is measured off by a share."""
    observed = experiment.measured(truth, [world, 99])
    observed[:, ~experiment.layout.placed] *= 1.0 + off
    return replace(experiment, observed=observed)


def judged(experiment: EmulatedExperiment, truth: dict[str, float], world: int, off: float) -> Diagnosis:
    """Diagnosis of it."""
    seen = measured(experiment, truth, world, off)
    return diagnose(seen, {"angle": fitted(seen)})


def test_a_force_tells_what_pictures_leave_open_even_if_it_is_off_as_a_whole() -> None:
    for world, off in ((1, ERROR), (4, -ERROR)):
        pictures = valley(world)
        truth = {"angle": 2.0, NAME: 12.0 * detectable(world, Options())[NAME]}
        without = judged(pictures, truth, world, 0.0)
        found = judged(weighed(pictures), truth, world, off)
        assert NAME in without.members
        assert NAME in found.members
        best = found.confirmations[NAME]
        # The force alone holds the angle to 15 / 20 of a degree; pictures do to 2.4 and 2.9.
        assert best.stds["angle"] < 0.4 * without.confirmations[NAME].stds["angle"]
        assert abs(best.values["angle"] - truth["angle"]) < 2.0 * best.stds["angle"]


@pytest.mark.parametrize("known", [True, False])
def test_a_force_that_is_off_as_a_whole_is_no_sign_of_missing_physics(known: bool) -> None:
    """Unless nobody knew that it could be."""
    made = weighed(emulated(1), 0.02)
    made = made if known else replace(made, systematic=np.zeros((0, *made.layout.shape)))
    found = judged(made, {"angle": 0.0}, 1, 1.5 * ERROR)
    assert (found.verdict == "adequate") is known


def test_the_error_on_hidden_frames_is_that_of_pictures() -> None:
    """In grey levels: a force that is four times too large, in percent, isn't put together with them."""
    found = judged(replace(weighed(emulated(1), 0.02), systematic=np.zeros((0, 12, 33))), {"angle": 0.0}, 1, 3.0)
    assert found.verdict != "adequate"
    assert found.confirmations[""].held_out < 15.0


def test_a_record_draws_forces_as_curves_and_pictures_on_the_plan() -> None:
    made = measured(weighed(emulated(1), 0.02), {"angle": 0.0}, 1, 1.5 * ERROR)
    told = record(made, diagnose(made, {"angle": fitted(made)}))
    (curve,) = told["curves"]
    ramp = np.linspace(40.0, 100.0, made.layout.shape[0])
    assert curve["channel"] == "force" and curve["unit"] == "%"
    assert curve["measured"] == pytest.approx((1.0 + 1.5 * ERROR) * ramp, rel=0.1)
    assert curve["predicted"]["before"] == pytest.approx(ramp, rel=0.15)
    # What it may be off as a whole is in its bars.
    assert np.all(np.array(curve["std"]) > 0.9 * ERROR * ramp)
    places = [site[1:] for site in told["sites"]]
    assert places[-1] == [None, None] and None not in places[0]
    assert "force" in figures.curves(told)
    assert ">force<" not in figures.plan_maps(told, ["before"])[0]
