"""Refits against features without chance, which only the emulated experiment knows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from splatsoil.benchmarks.hidden_effects import emulated
from splatsoil.inverse.criticism.bench import Bench
from splatsoil.inverse.criticism.confirmation import Confirmation, confirm
from splatsoil.inverse.criticism.evidence import gather, switched_on
from splatsoil.inverse.criticism.sight import Sight
from splatsoil.inverse.criticism.simulations import Simulations

from splatsoil.errors import SimulationError
from splatsoil.experiment.emulated import EmulatedExperiment

WORLDS, SIZE = range(24), 3.0


class Failing(Simulations):
    """Some seeds can't be simulated where a refit with an effect has ended."""

    lost: tuple[int, ...] = ()

    def __call__(self, values: Mapping[str, float], *, purpose: str = "", seed: int = 0, **others: Any) -> np.ndarray:
        if purpose == "refit effect 2 once more" and seed in self.lost:
            raise SimulationError("no simulation comes to an end")
        return super().__call__(values, purpose=purpose, seed=seed, **others)


def judged(world: int) -> tuple[float, float, float, float, float]:
    """Fall of χ² of a refit: as told (all times, hidden ones), of one simulation against another, without chance; and
    χ² over its freedom."""
    found, experiment, bench = confirmed(world)
    asis, fit = found[""].fit, found["effect 2"].fit
    sight = Sight.of(experiment, bench.floor, bench.basis, averaged=True)

    def fall(before: np.ndarray, after: np.ndarray) -> float:
        left = (experiment.observed - table for table in (before, after))
        return float(np.subtract(*[np.sum(sight(table) ** 2) for table in left]))

    exact = fall(experiment.expected(asis.values), experiment.expected(fit.values))
    best = found["effect 2"]
    return best.fall, best.unseen, fall(asis.prediction, fit.prediction), exact, best.chi2 / best.freedom


def confirmed(world: int, lost: tuple[int, ...] = ()) -> tuple[dict[str, Confirmation], EmulatedExperiment, Bench]:
    """The second effect refitted where it is hidden, with some seeds lost at its end."""
    base = emulated(world, chaos=0.9)
    candidate = base.candidates[1]
    truth = {"angle": 0.3, candidate.name: SIZE}
    experiment = replace(base, observed=base.measured(truth, [world, 99]))
    simulate = Failing(experiment)
    simulate.lost = lost
    evidence = switched_on(experiment, simulate, gather(experiment, simulate, {"angle": 0.0}))
    bench = Bench.of(experiment, evidence, level=0.05, seed=0)
    found = confirm(experiment, evidence, bench.floor, [candidate], simulate, 5, bench.basis, lambda what, share: None)
    return found, experiment, bench


def test_refits_are_compared_by_their_mean_features_and_not_by_one_simulation() -> None:
    told, unseen, single, exact, spread = np.array([judged(world) for world in WORLDS]).T
    off, hidden, lucky = (np.sqrt(np.mean((falls - exact) ** 2)) for falls in (told, unseen, single))
    # Of four seeds the mean has half of the chance; every other time tells nearly as much as all. Chance hangs on the
    # last bits of a refit, so on the processor: by these worlds, drawn anew, the ratio is 0.66 and 0.60, in 99 of 100
    # draws less than 0.95; it would be 1 by one simulation.
    assert off < 0.95 * lucky
    assert hidden < 0.95 * lucky
    # With the effect in, noise is all that is left.
    assert 0.7 < spread.mean() < 1.4


@pytest.mark.parametrize("world", [0, 1])
def test_an_effect_is_not_credited_with_what_the_models_own_parameters_do(world: int) -> None:
    """Nothing is hidden, and the fit, which weighs otherwise, lies three degrees off: an effect that explains nothing
    would seem to take 69 and 50 off χ² if its refit alone moved the angle."""
    base = emulated(world, chaos=0.9)
    candidate = base.candidates[1]
    experiment = replace(base, observed=base.measured({"angle": 4.0}, [world, 99]))
    simulate = Simulations(experiment)
    evidence = switched_on(experiment, simulate, gather(experiment, simulate, {"angle": 1.0}))
    bench = Bench.of(experiment, evidence, level=0.05, seed=0)
    found = confirm(experiment, evidence, bench.floor, [candidate], simulate, 5, bench.basis, lambda what, share: None)
    assert found[""].fit.values["angle"] > 2.5
    assert found["effect 2"].fall < 24.0


def test_seeds_that_one_refit_lacks_are_left_out_of_both() -> None:
    """Else χ² of fewer simulations would be larger by their chance alone."""
    whole, experiment, bench = confirmed(0)
    part, _, _ = confirmed(0, lost=(1, 3))
    sight = Sight.of(experiment, bench.floor, bench.basis, averaged=True)
    fits = [(whole[name].fit.values, (name,) if name else ()) for name in ("", "effect 2")]
    means = [np.mean([experiment.predict(at, effects=on, seed=s) for s in (0, 2)], axis=0) for at, on in fits]
    left = [np.sum(sight(experiment.observed - mean) ** 2) for mean in means]
    assert part["effect 2"].fall == pytest.approx(left[0] - left[1])
    assert part["effect 2"].fall != pytest.approx(whole["effect 2"].fall)
    assert set(confirmed(0, lost=(0, 1, 2, 3))[0]) == {""}


def test_the_error_on_hidden_times_is_that_of_a_simulation_whichever_its_seed() -> None:
    """Without luck: as the experiment's own simulations by all seeds at hand leave, or by those that weren't lost."""
    for lost in ((), (0, 3)):
        found, experiment, _ = confirmed(1, lost)
        fit, seeds = found["effect 2"].fit, [s for s in range(4) if s not in lost]
        hidden = experiment.seen & (np.arange(experiment.layout.shape[0]) % 2 == 1)[:, None]
        left = [
            (experiment.observed - experiment.predict(fit.values, effects=("effect 2",), seed=s))[hidden] for s in seeds
        ]
        assert found["effect 2"].held_out == pytest.approx(np.sqrt(np.mean(np.square(left))))
