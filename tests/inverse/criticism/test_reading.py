"""Parameters read off all simulations of a refit, against least squares in closed form."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pytest
from splatsoil.inverse.criticism.derivatives import around
from splatsoil.inverse.criticism.evidence import Visit
from splatsoil.inverse.criticism.reading import explored, read
from splatsoil.inverse.criticism.refit import Known, Refit, refit
from splatsoil.inverse.criticism.surface import Surface, _Density

from splatsoil.errors import SimulationError
from splatsoil.parameters import Parameter, distance

ANGLE = Parameter("angle", "deg", 20.0, 50.0, 35.0, meaningful=1.0)
STICK = Parameter("stick", "Pa", 0.0, 1000.0, 0.0, off=0.0, meaningful=50.0, sign=1)
SHAPE = Parameter("shape", "1", 0.02, 20.0, 0.3, meaningful=0.1, log=True)
FREE = (ANGLE, STICK)
NOTHING = Known.nothing(2)
FEATURES = 120
START = {"angle": 38.0, "stick": 100.0}


class World:
    """Features that are linear in two parameters, which nearly make up for each other; simulations have chance."""

    def __init__(self, seed: int, *, alike: float = 0.98, chance: float = 0.0, size: float = 12.0) -> None:
        generator = np.random.default_rng(seed)
        one, other = np.linalg.qr(generator.standard_normal((FEATURES, 2)))[0].T
        self.slopes = size * np.stack([one / 5.0, (alike * one + np.sqrt(1.0 - alike**2) * other) / 100.0], axis=1)
        self.generator, self.chance = generator, chance
        self.truth = {"angle": generator.uniform(32.0, 40.0), "stick": generator.uniform(150.0, 500.0)}
        self.observed = self.mean(self.truth) + generator.standard_normal((1, FEATURES))

    def mean(self, values: Mapping[str, float]) -> np.ndarray:
        return (self.slopes @ np.array([values["angle"] - 35.0, values["stick"]]))[None]

    def __call__(self, values: Mapping[str, float]) -> np.ndarray:
        return self.mean(values) + self.chance * self.generator.standard_normal((1, FEATURES))

    def visits(self, count: int) -> list[Visit]:
        near = [
            {"angle": self.generator.uniform(28.0, 45.0), "stick": self.generator.uniform(0.0, 700.0)}
            for _ in range(count)
        ]
        return [Visit(values, ("stick",), self(values)) for values in near]


HOME, PRIOR = np.array([35.0, 0.0]), np.diag([1.0 / 7.5, 1.0 / 250.0])
"""Defaults, and the inverse of a quarter of each range: what is believed before anything is measured."""


def solved(columns: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Estimate and standard deviations by least squares, the prior being a measurement; columns act from HOME."""
    columns = np.concatenate([columns, PRIOR])
    target = np.concatenate([target, np.zeros(2)])
    return np.linalg.lstsq(columns, target, rcond=None)[0] + HOME, np.linalg.inv(columns.T @ columns).diagonal() ** 0.5


def whiten(table: np.ndarray) -> np.ndarray:
    """Of (t, s, …), the first two axes."""
    return table.reshape(-1, *table.shape[2:])


def test_a_surface_predicts_where_nothing_was_simulated_and_knows_its_error() -> None:
    generator = np.random.default_rng(1)
    points = generator.uniform(-1.0, 1.0, (30, 2))
    basis = np.linalg.qr(generator.standard_normal((60, 3)))[0]

    def scores(at: np.ndarray) -> np.ndarray:
        x, y = at.T
        return np.stack([30.0 * x - 20.0 * y, 15.0 * np.sin(x) * y, 10.0 * x**2], axis=1)

    surface = Surface.through(points, scores(points) @ basis.T + 0.5 * generator.standard_normal((30, 60)), range(30))
    elsewhere = generator.uniform(-0.9, 0.9, (200, 2))
    mean, variance = surface.predict(elsewhere)
    error = surface.centre + mean @ surface.basis.T - scores(elsewhere) @ basis.T
    assert surface.basis.shape[1] == 3
    assert np.sqrt(np.mean(surface.noise)) == pytest.approx(0.5, rel=0.2)
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 2.0
    z = (error @ surface.basis) / np.sqrt(variance)
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.6
    for at in elsewhere[:5]:
        ahead, behind = (surface.predict(at + side * 1e-4 * np.eye(2))[0] for side in (1.0, -1.0))
        assert surface.slopes(at) == pytest.approx((ahead - behind) / 2e-4, rel=1e-4, abs=1e-4)


def test_each_direction_has_its_own_chance() -> None:
    """The one with the smaller trend has six times the other's standard deviation of it."""
    generator = np.random.default_rng(3)
    points = generator.uniform(-1.0, 1.0, (40, 2))
    basis = np.linalg.qr(generator.standard_normal((60, 2)))[0]
    scores = points * [60.0, 25.0] + generator.standard_normal((40, 2)) * [0.5, 3.0]
    surface = Surface.through(points, scores @ basis.T + 0.5 * generator.standard_normal((40, 60)), range(40))
    assert np.abs(surface.basis.T @ basis) == pytest.approx(np.eye(2), abs=0.1)
    assert np.sqrt(surface.noise) == pytest.approx([0.5 * 2**0.5, 3.0], rel=0.35)


def test_the_density_of_what_a_surface_hangs_on_has_its_gradient() -> None:
    generator = np.random.default_rng(4)
    points, seeds = generator.uniform(-1.0, 1.0, (15, 2)), np.arange(15) % 5
    scores = points @ generator.standard_normal((2, 3)) + generator.standard_normal((15, 3))
    density = _Density(points, scores, np.equal.outer(seeds, seeds), np.array([2.0, 1.0, 0.3]), 0.2, True)
    for _ in range(3):
        at = 0.5 * generator.standard_normal(density.size)
        ahead, behind = (
            np.array([density(at + side * step)[0] for step in 1e-4 * np.eye(density.size)]) for side in (1.0, -1.0)
        )
        assert density(at)[1] == pytest.approx((ahead - behind) / 2e-4, rel=1e-3, abs=1e-3)


def test_what_simulations_of_one_seed_have_in_common_is_told_from_what_soil_does() -> None:
    """Differences within a seed tell slopes that an offset of every seed would hide; without any it is none."""
    off, told, alone = [], [], []
    for world in range(6):
        generator = np.random.default_rng(world)
        points, seeds = generator.uniform(-1.0, 1.0, (24, 2)), np.arange(24) % 6
        direction = np.linalg.qr(generator.standard_normal((60, 1)))[0][:, 0]
        noise, offsets = 0.5 * generator.standard_normal((24, 60)), 5.0 * generator.standard_normal(6)
        features = np.outer(points @ [6.0, -4.0], direction) + noise
        shifted = Surface.through(points, features + np.outer(offsets[seeds], direction), seeds)
        taken_for_soil = Surface.through(points, features + np.outer(offsets[seeds], direction), range(24))
        for surface, errors in ((shifted, off), (taken_for_soil, told)):
            slopes = surface.slopes(np.zeros(2)) @ surface.basis.T @ direction
            errors.append(np.linalg.norm(slopes - [6.0, -4.0]))
        alone.append((shifted.common, Surface.through(points, features, seeds).common))
    assert np.median(off) < 0.5 * np.median(told)
    with_offsets, without = np.median(alone, axis=0)
    assert with_offsets > 10.0
    assert without < 0.5


def test_estimate_and_spread_are_those_of_least_squares() -> None:
    for seed in range(3):
        world = World(seed, alike=0.8)
        found = read(world.visits(15), whiten, world.observed, FREE, NOTHING)
        exact, std = solved(world.slopes, world.observed[0])
        for k, p in enumerate(FREE):
            assert found.values[p.name] == pytest.approx(exact[k], abs=0.1 * std[k])
            assert found.stds[p.name] == pytest.approx(std[k], rel=0.25)


def test_what_is_known_of_a_parameter_counts_as_a_measurement() -> None:
    world = World(4, alike=0.9)
    root = np.array([[0.0, 1.0 / 30.0]])
    found = read(world.visits(15), whiten, world.observed, FREE, Known(root, np.array([0.0, 220.0])))
    columns = np.concatenate([world.slopes, root])
    exact, std = solved(columns, np.concatenate([world.observed[0], root @ np.array([0.0, 220.0])]))
    assert found.values["stick"] == pytest.approx(exact[1], abs=3.0)
    assert found.stds["stick"] == pytest.approx(std[1], rel=0.2)


def test_along_a_valley_chance_is_no_information() -> None:
    """Slopes that hold chance look as if they told the two parameters apart: the truth is far outside their spread."""
    inside, by_slopes = [], []
    for seed in range(24):
        world = World(seed, alike=0.995, chance=0.7, size=8.0)
        here, slopes, visits = world(START), [], []
        for p in FREE:
            end = around(p, START[p.name])[-1]
            visits.append(Visit({**START, p.name: end}, ("stick",), world({**START, p.name: end})))
            slopes.append((visits[-1].table - here) / distance(p, START[p.name], end))

        def predict(values: Mapping[str, float], world: World = world, visits: list[Visit] = visits) -> np.ndarray:
            visits.append(Visit(dict(values), ("stick",), world(values)))
            return visits[-1].table

        columns = np.stack(slopes, axis=-1)
        fit = refit(predict, whiten, world.observed, FREE, START, here, columns, chance=True)
        visits.append(Visit(START, ("stick",), here))
        explored(predict, visits, whiten, world.observed, FREE, NOTHING, fit)
        found = read(visits, whiten, world.observed, FREE, NOTHING)
        off = abs(found.values["stick"] - world.truth["stick"])
        inside.append(off < 1.645 * found.stds["stick"])
        white = whiten(fit.slopes)
        std = np.linalg.inv(white.T @ white)[1, 1] ** 0.5
        by_slopes.append(abs(fit.values["stick"] - world.truth["stick"]) < 1.645 * std)
    assert np.mean(inside) >= 0.75
    assert np.mean(by_slopes) < np.mean(inside) - 0.15


def test_a_lucky_simulation_keeps_no_refit_where_it_is() -> None:
    """One that chance made just like the observation, far from where all the others put the parameters."""
    world = World(2, alike=0.8, chance=0.5)
    visits = world.visits(15)

    def predict(values: Mapping[str, float]) -> np.ndarray:
        visits.append(Visit(dict(values), ("stick",), world(values)))
        return visits[-1].table

    astray = {"angle": 44.0, "stick": 650.0}
    lucky = Refit(astray, 0.0, world.observed, 0, world.slopes[None])
    fit = explored(predict, visits, whiten, world.observed, FREE, NOTHING, lucky)
    exact, std = solved(world.slopes, world.observed[0])
    for k, p in enumerate(FREE):
        assert fit.values[p.name] == pytest.approx(exact[k], abs=2.0 * std[k])


class Shaped:
    """Features of an effect that turns, as its shape grows, from one pattern into another."""

    free = (ANGLE, STICK, SHAPE)
    start: Mapping[str, float] = {"angle": 35.0, "stick": 300.0, "shape": 0.3}

    def __init__(self, seed: int = 0) -> None:
        generator = np.random.default_rng(seed)
        self.one, self.other = np.linalg.qr(generator.standard_normal((FEATURES, 2)))[0].T
        self.observed = self({"angle": 33.0, "stick": 400.0, "shape": 2.0}) + generator.standard_normal((1, FEATURES))
        places = [(35.0, 0.0), (31.0, 0.0), (39.0, 0.0), (35.0, 200.0), (35.0, 300.0), (32.0, 400.0)]
        # Nobody has varied the shape.
        self.visits = [
            Visit({"angle": a, "stick": s}, ("stick",), self({**self.start, "angle": a, "stick": s})) for a, s in places
        ]
        first = float(np.sum((self.observed - self(self.start)) ** 2))
        self.begun = Refit(self.start, first, self(self.start), 0, np.zeros((1, FEATURES, 3)))

    def __call__(self, values: Mapping[str, float]) -> np.ndarray:
        if values["shape"] > 10.0:
            raise SimulationError("too far")
        early = np.exp(-1.0 / values["shape"])
        both = early * self.other + (1.0 - early) * np.roll(self.other, 9)
        return ((values["angle"] - 35.0) * self.one + values["stick"] / 5.0 * both)[None]

    def predict(self, values: Mapping[str, float]) -> np.ndarray:
        table = self(values)
        self.visits.append(Visit(dict(values), ("stick",), table))
        return table

    def explored(self, predict: Callable[[Mapping[str, float]], np.ndarray], hidden: int = 0) -> Refit:
        """A refit that does not see the last features."""

        def seen(table: np.ndarray) -> np.ndarray:
            return whiten(table)[: FEATURES - hidden]

        return explored(predict, self.visits, seen, self.observed, self.free, Known.nothing(3), self.begun, (SHAPE,))

    def tangent(self, values: Mapping[str, float]) -> np.ndarray:
        """(t, s, k) exact derivatives."""
        return np.stack(
            [(self({**values, p.name: values[p.name] + 1e-4}) - self(values)) / 1e-4 for p in self.free], -1
        )


def test_a_shape_is_found_though_no_slope_tells_of_it() -> None:
    world = Shaped()
    known, first = len(world.visits), world.begun.chi2
    fit = world.explored(world.predict)
    assert fit.chi2 < 0.2 * first
    assert fit.values["shape"] == pytest.approx(2.0, rel=0.5)
    assert fit.values["stick"] == pytest.approx(400.0, rel=0.2)
    assert fit.simulations == len(world.visits) - known


def test_several_points_are_told_of_before_they_are_simulated() -> None:
    world, told = Shaped(), list[Sequence[Mapping[str, float]]]()
    known, nothing = len(world.visits), Known.nothing(3)
    explored(
        *(world.predict, world.visits, whiten, world.observed, world.free, nothing, world.begun, (SHAPE,)),
        ahead=told.append,
    )
    # All but the last one, the most probable by all the others; those with too large a shape couldn't be simulated.
    made = [point for some in told for point in some if point["shape"] <= 10.0]
    assert made == [visit.values for visit in world.visits[known:-1]]
    assert all(len(some) > 1 for some in told)


def off(found: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """(k,) by how much slopes are wrong, as a share of them."""
    return np.linalg.norm(whiten(found - exact), axis=0) / np.linalg.norm(whiten(exact), axis=0)


def test_slopes_are_those_where_the_refit_ends_in_features_too_that_it_does_not_see() -> None:
    hidden, wrong = slice(FEATURES // 2, None), []
    for seed in range(8):
        world = Shaped(seed)
        fit = world.explored(world.predict, hidden=FEATURES // 2)
        exact = world.tangent(fit.values)
        wrong.append([off(fit.slopes, exact), off(fit.slopes[:, hidden], exact[:, hidden])])
        # What the effect does has turned on the way, and so have its slopes.
        assert off(world.tangent(world.start), exact)[1] > 0.5
    # Points are drawn: of one world in ten they tell less of a slope.
    assert np.median(wrong, axis=0) == pytest.approx(np.zeros((2, 3)), abs=0.03)
    assert np.sort(wrong, axis=0)[-2] == pytest.approx(np.zeros((2, 3)), abs=0.15)


def test_slopes_are_right_where_a_refit_stays() -> None:
    world = Shaped()
    for shape in (0.15, 0.6):
        world.predict({**world.start, "shape": shape})

    def nowhere(values: Mapping[str, float]) -> np.ndarray:
        raise SimulationError("no simulation comes to an end")

    fit = world.explored(nowhere)
    assert (fit.values, fit.chi2, fit.simulations) == (world.begun.values, world.begun.chi2, 0)
    # From eight simulations.
    assert off(fit.slopes, world.tangent(fit.values)) == pytest.approx(np.zeros(3), abs=0.4)


def test_simulations_that_are_all_alike_tell_nothing() -> None:
    visits = [Visit({"angle": 30.0 + k}, (), np.ones((1, FEATURES))) for k in range(5)]
    with pytest.raises(ValueError, match="the same"):
        read(visits, whiten, np.zeros((1, FEATURES)), FREE, NOTHING)
    begun = Refit({"angle": 30.0, "stick": 0.0}, 1.0, np.ones((1, FEATURES)), 0, np.zeros((1, FEATURES, 2)))
    assert explored(lambda v: np.ones((1, FEATURES)), visits, whiten, visits[0].table, FREE, NOTHING, begun) is begun


def test_what_no_parameters_mend_is_no_reason_to_be_where_nothing_was_simulated() -> None:
    """The observation is off by four standard deviations more than any simulation, in a direction in which parameters
    act elsewhere: they are where all else puts them, known less well, and not wherever the surface is in doubt."""
    for seed in range(4):
        world = World(seed, alike=0.98)
        third = world.generator.standard_normal(FEATURES)
        third -= world.slopes @ np.linalg.lstsq(world.slopes, third, rcond=None)[0]
        third /= np.linalg.norm(third)

        def bent(values: Mapping[str, float], world: World = world, third: np.ndarray = third) -> np.ndarray:
            far = abs(values["stick"] - world.truth["stick"])
            return world.mean(values) + 4.0 * np.tanh((far - 300.0) / 50.0) * third

        spread = {"angle": 1.5, "stick": 60.0}
        places = [{n: world.generator.normal(v, spread[n]) for n, v in world.truth.items()} for _ in range(12)]
        places += [{"angle": 20.0, "stick": 0.0}, {"angle": 50.0, "stick": 1000.0}, {"angle": 48.0, "stick": 30.0}]
        visits = [Visit(values, ("stick",), bent(values)) for values in places]
        observed = bent(world.truth) + world.generator.standard_normal((1, FEATURES)) - 8.0 * third
        found = read(visits, whiten, observed, FREE, NOTHING)
        exact, std = solved(world.slopes, observed[0])
        for k, p in enumerate(FREE):
            assert found.values[p.name] == pytest.approx(exact[k], abs=1.5 * std[k])
            assert std[k] < found.stds[p.name] < 3.0 * std[k]
