"""The noise model: closed forms, recovery of what samples were drawn with, and the false alarms it prevents."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from splatsoil.inverse.criticism import floor
from splatsoil.inverse.criticism.evidence import deviations
from splatsoil.inverse.criticism.misfit import omnibus, smooth_basis
from splatsoil.inverse.criticism.noise import Noise, Part, extra_noise, independent, orthonormal
from splatsoil.inverse.criticism.sampled_noise import estimate

from splatsoil.experiment.features import Layout, Site


def layout(times: int = 12, cameras: int = 2, across: int = 4) -> Layout:
    sites = tuple(Site(f"c{c}", 0.1 * i, 0.1 * j) for c in range(cameras) for i in range(across) for j in range(across))
    regions = np.full((times, len(sites)), "bed")
    return Layout(tuple(float(t) for t in range(times)), sites, "frame", "grey levels", ("push",) * times, regions)


LAYOUT = layout()
SEEN = np.ones(LAYOUT.shape, dtype=bool)
LINK = np.array([[1.0, 0.5], [0.5, 1.0]])
TRUE = Part(np.full(LAYOUT.shape, 2.0), memory=0.6, length=0.1, nugget=0.1, between=LINK)


def draw(part: Part, count: int, seed: int) -> np.ndarray:
    root = np.linalg.cholesky(Noise.of(LAYOUT, [(1.0, part)], SEEN).covariance)
    white = np.random.default_rng(seed).standard_normal((len(root), count))
    return (root @ white).T.reshape(count, *LAYOUT.shape)


def test_covariance_is_the_product_of_its_separate_laws() -> None:
    covariance = TRUE.covariance(LAYOUT, SEEN).reshape(*LAYOUT.shape, *LAYOUT.shape)
    far = np.sqrt(3.0) * 0.1 / 0.1
    matern = (1.0 + far) * np.exp(-far)
    # Same camera, neighbouring patch, three frames later.
    assert covariance[0, 0, 3, 1] == pytest.approx(4.0 * 0.6**3 * 0.9 * matern)
    # Other camera, same patch, same frame: the nugget is not shared.
    assert covariance[5, 0, 5, 16] == pytest.approx(4.0 * 0.5 * 0.9, rel=1e-5)
    assert covariance[5, 0, 5, 0] == pytest.approx(4.0, rel=1e-5)


def test_of_what_was_seen_it_is_the_same() -> None:
    """Against the whole of it, as a Kronecker product."""
    rng = np.random.default_rng(4)
    seen, scale = rng.random(LAYOUT.shape) < 0.7, rng.uniform(0.5, 3.0, LAYOUT.shape)
    part = replace(TRUE, scale=scale)
    ones = replace(TRUE, scale=np.ones(LAYOUT.shape)).covariance(LAYOUT, SEEN).reshape(*LAYOUT.shape, *LAYOUT.shape)
    times, across = ones[:, 0, :, 0] / ones[0, 0, 0, 0], ones[0, :, 0, :]
    whole = np.outer(scale, scale) * np.kron(times, across)
    np.testing.assert_allclose(part.covariance(LAYOUT, seen), whole[np.ix_(seen.ravel(), seen.ravel())], rtol=1e-9)


def test_independent_noise_is_independent() -> None:
    covariance = independent(np.full(LAYOUT.shape, 3.0)).covariance(LAYOUT, SEEN)
    assert np.allclose(covariance, 9.0 * np.eye(len(covariance)), atol=1e-3)


@pytest.mark.parametrize("hidden", [0.0, 0.04, 0.3])
def test_the_law_that_samples_were_drawn_with_is_found_again(hidden: float) -> None:
    """Also where each time hides sites of its own: few, so that several times are taken together, or many."""
    seen = np.random.default_rng(5).random(LAYOUT.shape) >= hidden
    found = estimate(LAYOUT, draw(TRUE, 40, 1), seen)
    assert found.memory == pytest.approx(0.6, abs=0.05)
    assert found.length == pytest.approx(0.1, rel=0.2)
    assert found.nugget == pytest.approx(0.1, abs=0.06)
    assert found.between is not None and found.between[0, 1] == pytest.approx(0.5, abs=0.1)
    assert np.mean(found.scale[seen]) == pytest.approx(2.0, rel=0.1)


def test_scales_that_vary_are_told_from_scales_that_do_not() -> None:
    place = np.array([s.x for s in LAYOUT.sites])
    steep = np.broadcast_to(0.3 + 3.0 * (place > 0.15), LAYOUT.shape)
    varied = estimate(LAYOUT, draw(Part(steep.copy(), 0.6, 0.1, 0.1, LINK), 6, 2), SEEN)
    level = estimate(LAYOUT, draw(TRUE, 6, 2), SEEN)
    assert np.log(varied.scale[:, place > 0.25].mean() / varied.scale[:, place < 0.05].mean()) > 1.5
    assert np.std(np.log(level.scale)) < 0.15


def test_the_law_is_found_where_soil_moves_in_one_place_and_lies_still_beside_it() -> None:
    """Scales over three decades with a sharp edge: what is too large a scale where nothing moves is no correlation."""
    place = np.array([[s.x, s.y] for s in LAYOUT.sites])
    moving = (place[:, 0] < 0.15) & (place[:, 1] < 0.25)
    steep = np.broadcast_to(np.where(moving, 3.0, 0.003), LAYOUT.shape).copy()
    for seed in range(3):
        found = estimate(LAYOUT, draw(replace(TRUE, scale=steep), 6, seed), SEEN)
        assert found.memory == pytest.approx(0.6, abs=0.15)
        assert 0.06 < found.length < 0.16
        assert found.nugget < 0.4
        assert np.sqrt(np.mean(found.scale[:, moving] ** 2)) == pytest.approx(3.0, rel=0.25)
        assert np.median(found.scale[:, ~moving]) < 0.3


def test_rows_and_unseen_features_are_the_matching_parts_of_the_whole() -> None:
    seen = SEEN.copy()
    seen[2, 5] = False
    whole, part = (Noise.of(LAYOUT, [(1.0, TRUE)], s) for s in (SEEN, seen))
    keep = seen.reshape(-1)
    assert np.allclose(part.covariance, whole.covariance[np.ix_(keep, keep)], atol=1e-6)
    early = part.rows(np.arange(LAYOUT.shape[0]) < 3)
    assert early.covariance.shape[0] == 3 * LAYOUT.shape[1] - 1
    table = np.arange(seen.size, dtype=float).reshape(seen.shape)
    assert np.array_equal(part.spread(part.pick(table)), np.where(seen, table, 0.0))


def rates(noise_of: object, count: int) -> float:
    """How often a misfit is seen at 5 % on data with none."""
    alarms = 0
    for k in range(count):
        samples = draw(TRUE, 5, 100 + k)
        rest, runs = samples[0], samples[1:]
        deviations = (runs - runs.mean(axis=0)) * np.sqrt(len(runs) / (len(runs) - 1))
        noise = noise_of(deviations, 1.0 + 1.0 / len(runs))  # type: ignore[operator]
        residual = (rest - runs.mean(axis=0))[SEEN]
        alarms += omnibus(noise, np.zeros((residual.size, 0)), residual, smooth_basis(LAYOUT, noise)).p < 0.05
    return alarms / count


def test_correlated_noise_raises_few_false_alarms_and_independent_pixels_nearly_always_do() -> None:
    def ours(samples: np.ndarray, factor: float) -> Noise:
        return Noise.of(LAYOUT, [(factor, estimate(LAYOUT, samples, SEEN))], SEEN)

    def pixels(samples: np.ndarray, factor: float) -> Noise:
        return Noise.of(LAYOUT, [(factor, independent(np.full(LAYOUT.shape, samples.std())))], SEEN)

    assert rates(pixels, 12) > 0.8
    # 5 % nominal; with 25 draws, more than 5 alarms have a chance of 0.1 % at that rate.
    assert rates(ours, 25) <= 0.2


def test_what_a_solver_says_of_low_rank_noise_is_what_the_whole_matrix_says() -> None:
    """Against NumPy's solution, refined in longer numbers: with such a condition its own eighth digit is another one on
    another processor. With nuisances from next to nothing to far above the noise, two of them the same, added
    in two goes; of a part by its scale and correlation, and of a covariance."""
    rng = np.random.default_rng(5)
    seen, scale = rng.random(LAYOUT.shape) < 0.2, rng.uniform(0.5, 3.0, LAYOUT.shape)
    part = replace(TRUE, scale=scale)
    noise = Noise.of(LAYOUT, [(1.0, part)], seen)
    count = len(noise.covariance)
    nuisance = rng.standard_normal((count, 6)) * [1e-9, 1e-2, 1.0, 30.0, 3000.0, 0.0]
    nuisance[:, 5] = nuisance[:, 4]
    whole = noise.covariance + nuisance @ nuisance.T
    columns, bare = rng.standard_normal((count, 3)), np.zeros((count, 0))
    exact = np.linalg.solve(whole, columns).astype(np.longdouble)
    for _ in range(5):
        exact += np.linalg.solve(whole, (columns - whole.astype(np.longdouble) @ exact).astype(float))
    expected = (columns.T @ exact).astype(float)
    # The ridge that a part's solver has isn't quite the covariance's.
    for solver, near in ((noise.solver, 1e-7), (part.solver(LAYOUT, seen), 1e-4)):
        assert solver.beside(bare).whiten(columns) == pytest.approx(solver.whiten(columns))
        solver = solver.beside(nuisance[:, :2]).beside(nuisance[:, 2:])
        assert columns.T @ solver.solve(columns) == pytest.approx(expected, rel=near, abs=near)
        white = solver.whiten(columns)
        assert white.T @ white == pytest.approx(expected, rel=near, abs=near)
        assert solver.whiten(columns[:, 0]) == pytest.approx(white[:, 0])
        root = solver.coloured(np.eye(count))
        assert np.abs(root @ root.T - whole).max() < near * np.abs(whole).max()
        with pytest.raises(ValueError, match="infs or NaNs"):
            solver.whiten(np.full(count, np.nan))
    with pytest.raises(np.linalg.LinAlgError):
        _ = Noise(np.diag([1.0, -1.0]), SEEN[:1, :2]).solver
    with pytest.raises(np.linalg.LinAlgError):
        _ = Noise(np.full((2, 2), np.nan), SEEN[:1, :2]).solver


@pytest.mark.parametrize("few", [3, 200])
def test_orthonormal_columns_span_what_they_are_made_of(few: int) -> None:
    """Against a singular value decomposition: some hardly differ, some are the same, one is tiny and one nothing."""
    rng = np.random.default_rng(6)
    columns = rng.standard_normal((few, 8))
    columns[:, 1] = columns[:, 0] + 1e-4 * columns[:, 1]
    columns[:, 2], columns[:, 3], columns[:, 4] = columns[:, 0], 1e-5 * columns[:, 3], 0.0
    found = orthonormal(columns)
    left, size, _ = np.linalg.svd(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300), full_matrices=False)
    left = left[:, size > 1e-6 * size[0]]
    assert found.shape == left.shape == (few, min(few, 6))
    assert np.abs(found.T @ found - np.eye(found.shape[1])).max() < 1e-10
    assert np.abs(found @ found.T - left @ left.T).max() < 1e-7
    assert orthonormal(np.zeros((few, 2))).shape == orthonormal(np.zeros((few, 0))).shape == (few, 0)


def scores(noise: Noise, direction: np.ndarray, samples: np.ndarray) -> float:
    """Mean square of standardised scores along a direction (n,): 1 where the noise is right."""
    solver = noise.solver
    column = solver.whiten(direction)
    white = solver.whiten(samples.reshape(len(samples), -1).T)
    return float(np.mean((column @ white) ** 2) / (column @ column))


def test_chance_that_acts_like_an_effect_widens_its_scores_and_nothing_else() -> None:
    generator = np.random.default_rng(3)
    act, elsewhere = np.zeros(LAYOUT.shape), np.zeros(LAYOUT.shape)
    act[3:6, 5:7], elsewhere[8:11, 24:26] = 1.0, 1.0

    def with_it(count: int, seed: int) -> np.ndarray:
        return draw(TRUE, count, seed) + 8.0 * generator.standard_normal((count, 1, 1)) * act

    part = estimate(LAYOUT, with_it(12, 1), SEEN, act.reshape(-1, 1))
    plain = Noise.of(LAYOUT, [(1.0, part)], SEEN)
    whole = plain.plus(extra_noise(LAYOUT, part, SEEN, act.reshape(-1, 1)))
    fresh = with_it(300, 2)
    assert scores(plain, act.reshape(-1), fresh) > 5.0
    # never too sure; twice too wide is what scales judged by the other samples cost
    assert 0.25 < scores(whole, act.reshape(-1), fresh) < 1.5
    assert 0.6 < scores(whole, elsewhere.reshape(-1), fresh) < 1.5
    # the part's own size stays what samples come to, wherever they are
    assert np.sqrt(np.mean(part.scale**2)) == pytest.approx(np.sqrt(np.mean(fresh**2)), rel=0.15)


def test_a_noise_known_from_few_samples_makes_a_misfit_less_sure() -> None:
    noise = Noise.of(LAYOUT, [(1.0, TRUE)], SEEN)
    residual = 1.25 * draw(TRUE, 1, 7)[0][SEEN]
    basis, nothing = smooth_basis(LAYOUT, noise), np.zeros((residual.size, 0))
    sure = omnibus(noise, nothing, residual, basis)
    doubtful = omnibus(Noise(noise.covariance, SEEN, freedom=10.0), nothing, residual, basis)
    assert sure.statistic == doubtful.statistic
    # F and χ² tables: the former's tail is the heavier
    assert doubtful.p > 2.0 * sure.p


MIXED = replace(
    LAYOUT,
    sites=(*LAYOUT.sites, Site("along", unit="%"), Site("up", unit="%")),
    regions=np.full((LAYOUT.shape[0], LAYOUT.shape[1] + 2), "bed"),
)


def mixed(count: int, seed: int) -> np.ndarray:
    """Pictures as before, and two forces that go together, ten times as large, of another memory."""
    generator = np.random.default_rng(seed)
    forces = generator.standard_normal((count, LAYOUT.shape[0], 2)) @ np.array([[20.0, 16.0], [0.0, 12.0]])
    return np.concatenate([draw(TRUE, count, seed), forces], axis=2)


def test_instruments_without_a_place_are_noisy_for_themselves() -> None:
    seen = np.ones(MIXED.shape, dtype=bool)
    part = estimate(MIXED, mixed(30, 1), seen)
    covariance = part.covariance(MIXED, seen).reshape(*MIXED.shape, *MIXED.shape)
    assert np.all(covariance[:, :32, :, 32:] == 0.0)
    assert np.mean(part.scale[:, 32:]) == pytest.approx(20.0, rel=0.1)
    together = covariance[5, 32, 5, 33] / np.sqrt(covariance[5, 32, 5, 32] * covariance[5, 33, 5, 33])
    assert together == pytest.approx(0.8, abs=0.15)
    # What the pictures' noise is found to be hardly hangs on what is beside them.
    alone = estimate(LAYOUT, draw(TRUE, 30, 1), SEEN)
    assert np.allclose(part.scale[:, :32], alone.scale, rtol=0.1)
    assert part.length == pytest.approx(alone.length, rel=0.2)


def test_an_instrument_that_never_changes_has_no_noise_and_changes_no_other() -> None:
    samples = mixed(6, 2)
    samples[..., 32:] = 0.0
    part, alone = estimate(MIXED, samples, np.ones(MIXED.shape, dtype=bool)), estimate(LAYOUT, samples[..., :32], SEEN)
    assert np.all(part.scale[:, 32:] < 1e-4)
    assert np.allclose(part.scale[:, :32], alone.scale, rtol=0.02)


def test_guesses_that_leave_an_instrument_alone_are_as_noisy_in_the_others() -> None:
    """Directions act on the force, too, by much; guesses of colours don't."""
    generator = np.random.default_rng(5)
    seen = np.ones(MIXED.shape, dtype=bool)
    waves = np.linspace(0.3, 1.3, LAYOUT.shape[0])[:, None] * np.sin(np.arange(LAYOUT.shape[1]))[None]
    directions = np.stack([waves, np.roll(waves, 3, axis=1)])
    samples = draw(TRUE, 6, 4) + np.tensordot(3.0 * generator.standard_normal((6, 2)), directions, axes=1)
    alone = estimate(LAYOUT, samples, SEEN, directions[:, SEEN].T)
    forces = np.full((2, LAYOUT.shape[0], 2), 9.0)
    wide = np.concatenate([directions, forces], axis=2)[:, seen].T
    still = np.concatenate([samples, np.zeros((6, LAYOUT.shape[0], 2))], axis=2)
    beside = estimate(MIXED, still, seen, wide)
    assert alone.on_directions > 2.0
    assert beside.on_directions == pytest.approx(alone.on_directions, rel=0.1)
    extra = extra_noise(MIXED, beside, seen, wide)
    pictures = np.broadcast_to(MIXED.placed, MIXED.shape)[seen]
    assert np.all(extra[~pictures] == 0.0)
    first = directions[0][SEEN] / np.linalg.norm(directions[0])
    more = [
        np.sum((first @ e) ** 2) for e in (extra_noise(LAYOUT, alone, SEEN, directions[:, SEEN].T), extra[pictures])
    ]
    assert more[1] == pytest.approx(more[0], rel=0.15)


def test_one_guess_that_was_drawn_of_another_simulation_makes_no_noise_of_an_instrument() -> None:
    """Its force is off by a percent where guesses change none; whichever of them it is, that is one of six."""
    generator = np.random.default_rng(6)
    seen = np.ones(MIXED.shape, dtype=bool)
    waves = np.linspace(0.3, 1.3, LAYOUT.shape[0])[:, None] * np.sin(np.arange(LAYOUT.shape[1]))[None]
    directions = np.concatenate(
        [np.stack([waves, np.roll(waves, 3, axis=1)]), np.full((2, len(waves), 2), 9.0)], axis=2
    )
    still = np.concatenate([draw(TRUE, 6, 7), np.full((6, len(waves), 2), 40.0)], axis=2)

    def told(guesses: np.ndarray) -> Part:
        return estimate(MIXED, floor._contrasts(deviations(guesses)), seen, directions[:, seen].T)

    usual = told(still)
    for odd in range(6):
        guesses = still.copy()
        guesses[odd, :, 32:] *= 1.0 + 0.01 * generator.standard_normal((len(waves), 2))
        part = told(guesses)
        assert 1.0 <= part.on_directions < 4.0 * usual.on_directions
        extra = extra_noise(MIXED, part, seen, directions[:, seen].T)
        assert np.all(np.isfinite(extra))
    # Nor where all but one are alike.
    alike = np.broadcast_to(still[:1], still.shape).copy()
    alike[5] = still[5]
    assert np.all(np.isfinite(extra_noise(MIXED, told(alike), seen, directions[:, seen].T)))


def test_degrees_of_freedom_are_those_of_features_in_one_unit() -> None:
    """A noise that is known well of a force, in numbers a hundred times as large, makes none of pictures known."""
    small = replace(TRUE, scale=np.ones(MIXED.shape), freedom=8.0, between=None)
    large = independent(np.broadcast_to(np.where(MIXED.placed, 0.01, 100.0), MIXED.shape).copy())
    noise = Noise.of(MIXED, [(1.0, small), (1.0, large)], np.ones(MIXED.shape, dtype=bool))
    assert noise.freedom == pytest.approx(8.0, rel=0.01)
