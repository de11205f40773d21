"""Agents that play PlowSand: at random, Bayesian optimisation, Markov chains, and those of strokes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import emcee
import gymnasium as gym
import numpy as np
from splatsoil.benchmarks._common import FloatArray
from splatsoil.envs.plow_sand import PlowSandEnv
from splatsoil.envs.strokes import LOGITS, DesignEnv, NamingEnv
from splatsoil.inverse.bayesopt import BayesianOptimiser, sobol
from splatsoil.inverse.criticism.design import Prior
from splatsoil.inverse.criticism.diagnosis import BASE_RUNS
from splatsoil.inverse.criticism.noise import Tables, noise_of
from splatsoil.inverse.mcmc import sample
from splatsoil.inverse.posterior import Density

from splatsoil.errors import ParameterError
from splatsoil.experiment import Layout, Run, Site
from splatsoil.experiment.emulated import EmulatedExperiment
from splatsoil.parameters import ParameterSpace

FEWEST = BASE_RUNS // 2
"""Simulations that a comparison needs."""
NAMING_EPISODES, TRAINING = 4000, 10**6
"""Episodes that an agent learns from, and the first one's seed."""
OUTCOMES = 32
"""Simulated outcomes of a stroke that its expected information is averaged over."""

Env = gym.Env[Any, Any]


@dataclass(frozen=True)
class Answer:
    """What an agent estimates: a point (n,) and draws (k, n) that stand for its uncertainty, in [-1, 1]^n."""

    estimate: FloatArray
    draws: FloatArray


def at_random(env: Env, seed: int) -> None:
    """Actions drawn from the action space."""
    env.reset(seed=seed)
    env.action_space.seed(seed)
    over = False
    while not over:
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        over = terminated or truncated


def searched(env: Env, seed: int, optimiser: BayesianOptimiser) -> tuple[FloatArray, FloatArray]:
    """Let an optimiser play an episode: its guesses (k, n) and their features (k, b), predicted minus observed."""
    env.reset(seed=seed)
    points, features, over = [], [], False
    while not over:
        (action,) = optimiser.ask()
        observation, reward, _, over, info = env.step(action)
        failed = info["status"] == "failed"
        optimiser.tell(action, None if failed else -float(reward))
        if not failed:
            points.append(action)
            features.append(-observation["block_residuals"])
    return np.array(points, dtype=np.float64), np.array(features, dtype=np.float64)


def by_optimiser(env: Env, seed: int, **options: Any) -> Answer:
    """Bayesian optimisation with options of its own."""
    optimiser = BayesianOptimiser(env.action_space.shape[0], seed=seed, **options)  # type: ignore[index]
    searched(env, seed, optimiser)
    return least(optimiser)


def by_chains(env: Env, seed: int, *, search: bool) -> Answer:
    """emcee on an emulator of the features of an episode's guesses, which a search chose or a Sobol sequence."""
    space, budget = env.unwrapped.problem.space, env.unwrapped.budget  # type: ignore[attr-defined]
    if budget < FEWEST:
        raise ParameterError(f"agents mcmc and both need budgets of {FEWEST} or more, not {budget}")
    start = {} if search else {"start": budget}
    return posterior(space, *searched(env, seed, BayesianOptimiser(len(space), seed=seed, **start)), seed=seed)


def least(optimiser: BayesianOptimiser) -> Answer:
    """Where the optimiser expects the least loss."""
    found = optimiser.result()
    return Answer(found.estimate, found.minimisers)


def posterior(
    space: ParameterSpace, points: FloatArray, features: FloatArray, *, seed: int, sensor: float = 0.0
) -> Answer:
    """Posterior mean and draws, given points (m, n) and their features (m, b), predicted minus observed.

    ``sensor`` is the standard deviation of what instruments add to an observed feature.
    """
    seen = features[:, np.all(features != 0.0, axis=0)]  # 0 is what nobody has seen
    density = density_of(space, points, seen, np.zeros(seen.shape[1]), sensor, seed)
    draws = sample(density, len(space), seed=seed, ensembles=2, max_steps=1000).flat
    return Answer(draws.mean(axis=0), draws)


def density_of(
    space: ParameterSpace, points: FloatArray, features: FloatArray, observed: FloatArray, sensor: float, seed: int = 0
) -> Density:
    """The posterior where the model is right but for seed-to-seed scatter: there is no discretisation error.

    Args:
        space: the free parameters.
        points: (m, n) of simulations, in [-1, 1].
        features: (m, b) of these.
        observed: (b,).
        sensor: standard deviation of what instruments add to an observed one.
        seed: of sequences.
    """
    b = features.shape[1]
    nothing = np.zeros((1, b))
    experiment = EmulatedExperiment(
        layout=Layout((0.0,), tuple(Site("all", float(k), 0.0) for k in range(b)), "", "", ("",), np.full((1, b), "")),
        middle=nothing,
        home={},
        slopes={},
        parameters=tuple(space),
        candidates=(),
        scatter_root=np.zeros((b, b)),
        sensor=nothing + sensor,
        observed=observed[None],
    )
    prior = Prior(space)
    made = [Run(values) for values in prior.values(points)], features[:, None]
    tables = Tables(base=made, fine=([], np.zeros((0, 1, b))), effects={}, variants={}, reference=features[:1])
    noise = noise_of(experiment, prior, tables, ())
    return Density.of(replace(noise, discretisation=np.zeros_like(noise.discretisation)), prior, seed)


def directly(env: Env, seed: int) -> Answer:
    """emcee on the calls: each density is one. Scatter is that of the response surface, in call and observation."""
    surface, n, budget = env.unwrapped.problem.surface, env.action_space.shape[0], env.unwrapped.budget  # type: ignore
    inverse = np.linalg.pinv(surface.patches @ surface.factor)
    env.reset(seed=seed)

    def density(point: FloatArray) -> float:
        # A point outside has density 0 whatever the call returns; it is a call nonetheless.
        observation, *_ = env.step(point.astype(np.float32))
        scale = float(surface.scale(point[None])[0])
        off = inverse @ observation["block_residuals"] / scale
        return -0.25 * float(off @ off) - len(off) * np.log(scale) if np.all(np.abs(point) <= 1.0) else -np.inf

    walkers = max(4, 2 * n + 2)
    if budget < 2 * walkers:
        raise ParameterError(f"agent direct needs a budget of {2 * walkers} or more, not {budget}")
    sampler = emcee.EnsembleSampler(walkers, n, density)
    start = emcee.State(sobol(walkers, n, seed), random_state=np.random.RandomState(seed).get_state())
    steps = budget // walkers - 1  # walkers' starts are calls, too
    sampler.run_mcmc(start, steps, skip_initial_state_check=True)
    chain = sampler.get_chain()[steps // 4 :].reshape(-1, n)
    for _ in range(budget % walkers):
        env.step(chain.mean(axis=0).astype(np.float32))
    return Answer(chain.mean(axis=0), chain)


@cache
def _classes(env_id: str) -> tuple[FloatArray, FloatArray]:
    """Means (e, b) of each effect's evidence, and the inverse (b, b) of the covariance about them."""
    env: Any = gym.make(env_id)
    seen: dict[str, list[FloatArray]] = {effect: [] for effect in env.unwrapped.soil.effects}
    for k in range(NAMING_EPISODES):
        evidence, _ = env.reset(seed=TRAINING + k)
        seen[env.unwrapped.soil.effect].append(evidence)
    means = np.array([np.mean(rows, axis=0) for rows in seen.values()])
    off = np.concatenate([np.array(rows) - mean for rows, mean in zip(seen.values(), means, strict=True)])
    return means, np.linalg.pinv(off.T @ off / len(off), rcond=1e-6, hermitian=True)


def by_discriminant(env: Env, seed: int) -> None:
    """Log densities of normal distributions of equal covariance (Fisher 1936), as logits."""
    assert env.spec is not None
    means, inverse = _classes(env.spec.id)
    evidence, _ = env.reset(seed=seed)
    off = evidence - means
    logs = -0.5 * np.einsum("eb,bc,ec->e", off, inverse, off)
    env.step(((logs - logs.max()) / LOGITS + 1.0).astype(np.float32))


def greedily(env: Env, seed: int) -> None:
    """The stroke whose outcomes, drawn from the posterior, have the most information on average."""
    inner, rng, over = env.unwrapped, np.random.default_rng([seed, 43]), False
    assert isinstance(inner, DesignEnv)
    strokes = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 5)] * 2), axis=-1).reshape(-1, 2)
    env.reset(seed=seed)
    while not over:
        expected = [inner.expected_information(stroke, OUTCOMES, rng) for stroke in strokes]
        over = env.step(strokes[int(np.argmax(expected))].astype(np.float32))[3]


Agent = Callable[[Env, int], Any]
PAPER = partial(by_optimiser, start=1, acquisition="best")
"""Bayesian optimisation with the settings of Hsiao and Kumar."""
AGENTS: dict[str, tuple[Agent, type | tuple[type, ...]]] = {
    "random": (at_random, (PlowSandEnv, NamingEnv, DesignEnv)),
    "paper": (PAPER, PlowSandEnv),
    "bo": (by_optimiser, PlowSandEnv),
    "mcmc": (partial(by_chains, search=False), PlowSandEnv),
    "both": (partial(by_chains, search=True), PlowSandEnv),
    "direct": (directly, PlowSandEnv),
    "lda": (by_discriminant, NamingEnv),
    "greedy": (greedily, DesignEnv),
}
"""And the environments that they play; `direct` needs emulated guesses."""
