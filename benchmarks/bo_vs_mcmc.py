"""Bayesian optimisation, Markov chains and other agents: what each makes of the same episodes of PlowSand.

    splatsoil benchmark bo-vs-mcmc --out runs/bo-vs-mcmc
    splatsoil benchmark bo-vs-mcmc --env PlowSandFast-v0 --agent examples.agents.optuna_tpe:search

| agent | on | what it does |
|---|---|---|
| `random` | all | actions at random |
| `bo` | guesses | the search of `splatsoil fit`: log noisy expected improvement of the loss, and where that is least |
| `paper` | guesses | the same with Hsiao and Kumar's settings: one random start, expected improvement |
| `mcmc` | guesses | emcee on a comparison's posterior, by an emulator of the features trained on space-filling calls |
| `both` | guesses | the same, trained on the calls that `bo` chose: what `splatsoil fit` says |
| `direct` | emulated guesses | emcee on the calls themselves: each is a step of a walker |
| `lda` | naming | linear discriminant analysis, trained on other episodes |
| `greedy` | design | the stroke of most expected information, of 25 |

An agent of one's own is a function (env, seed) that resets the environment with the seed and plays one whole episode;
of guesses it may return an Answer: otherwise its best guess counts.
"""

from __future__ import annotations

import argparse
import pkgutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import emcee
import gymnasium as gym
import numpy as np
from splatsoil.benchmarks._common import Clock, FloatArray, at_least, markdown, parser_of, stamp, tell
from splatsoil.benchmarks._simulations import FEWEST, density_of
from splatsoil.envs.emulated import EmulatedProblem
from splatsoil.envs.plow_sand import PlowSandEnv
from splatsoil.envs.recording import EpisodeRecorder
from splatsoil.envs.strokes import LOGITS, DesignEnv, NamingEnv
from splatsoil.inverse.bayesopt import BayesianOptimiser, sobol
from splatsoil.inverse.mcmc import sample

from splatsoil.errors import ParameterError
from splatsoil.files import plain
from splatsoil.quiet import hush

ENVS = ("PlowSandFast-v0", "PlowSandSeveralFast-v0", "PlowSandNamingFast-v0", "PlowSandDesignFast-v0")
NAMING_EPISODES, TRAINING = 4000, 10**6
"""Episodes that an agent learns from, and the first one's seed."""
OUTCOMES = 32
"""Simulated outcomes of a stroke that its expected information is averaged over."""


@dataclass(frozen=True)
class Answer:
    """What an agent says: estimate (n,) and 90 % interval (n,) each, in [-1, 1]^n."""

    estimate: FloatArray
    low: FloatArray
    high: FloatArray


class Counted(gym.Wrapper[Any, Any, Any, Any]):
    """Counts steps and rewards of the one episode that an agent may play, and the CPU's seconds that they take."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.resets, self.steps, self.total, self.seconds, self.over = 0, 0, 0.0, 0.0, False
        self.last: dict[str, Any] = {}

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        began = time.process_time()
        found = self.env.reset(**options)
        self.resets += 1
        self.seconds += time.process_time() - began
        return found

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        began = time.process_time()
        found = self.env.step(action)
        self.steps, self.total, self.last = self.steps + 1, self.total + float(found[1]), found[4]
        self.over = found[2] or found[3]
        self.seconds += time.process_time() - began
        return found


def at_random(env: Counted, seed: int) -> None:
    """Actions drawn from the action space."""
    env.reset(seed=seed)
    env.action_space.seed(seed)
    while not env.over:
        env.step(env.action_space.sample())


def told(env: Counted, seed: int, optimiser: BayesianOptimiser) -> tuple[FloatArray, FloatArray]:
    """Let an optimiser play an episode: its guesses (k, n) and their features (k, b), predicted minus observed."""
    env.reset(seed=seed)
    points, features = [], []
    while not env.over:
        (action,) = optimiser.ask()
        observation, reward, _, _, info = env.step(action)
        failed = info["status"] == "failed"
        optimiser.tell(action, None if failed else -float(reward))
        if not failed:
            points.append(action)
            features.append(-observation["block_residuals"])
    return np.array(points, dtype=np.float64), np.array(features, dtype=np.float64)


def by_optimiser(env: Counted, seed: int, **options: Any) -> Answer:
    """Bayesian optimisation with options of its own."""
    optimiser = BayesianOptimiser(env.action_space.shape[0], seed=seed, **options)  # type: ignore[index]
    told(env, seed, optimiser)
    found = optimiser.result()
    return Answer(found.estimate, *found.interval()[1:])


def by_chains(env: Counted, seed: int, *, search: bool) -> Answer:
    """emcee on an emulator of the features of an episode's guesses, which a search chose or a Sobol sequence."""
    space, budget = env.unwrapped.problem.space, env.unwrapped.budget  # type: ignore[attr-defined]
    if budget < FEWEST:
        raise ParameterError(f"agents mcmc and both need budgets of {FEWEST} or more, not {budget}")
    start = {} if search else {"start": budget}
    points, features = told(env, seed, BayesianOptimiser(len(space), seed=seed, **start))
    density = density_of(space, points, features, np.zeros(features.shape[1]), 0.0, seed)
    chains = sample(density, len(space), seed=seed, ensembles=2, most_steps=1000)
    return Answer(chains.flat.mean(axis=0), *np.quantile(chains.flat, [0.05, 0.95], axis=0))


def directly(env: Counted, seed: int) -> Answer:
    """emcee on the calls: each density is one. Chance is that of the response surface, in call and observation."""
    surface, n, budget = env.unwrapped.problem.surface, env.action_space.shape[0], env.unwrapped.budget  # type: ignore
    inverse = np.linalg.pinv(surface.patches @ surface.factor)
    env.reset(seed=seed)

    def density(point: FloatArray) -> float:
        # A point outside has density 0 whatever the call says; it is a call nonetheless.
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
    return Answer(chain.mean(axis=0), *np.quantile(chain, [0.05, 0.95], axis=0))


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


def by_discriminant(env: Counted, seed: int) -> None:
    """Log densities of normal distributions of equal covariance (Fisher 1936), as logits."""
    assert env.spec is not None
    means, inverse = _classes(env.spec.id)
    evidence, _ = env.reset(seed=seed)
    off = evidence - means
    logs = -0.5 * np.einsum("eb,bc,ec->e", off, inverse, off)
    env.step(((logs - logs.max()) / LOGITS + 1.0).astype(np.float32))


def greedily(env: Counted, seed: int) -> None:
    """The stroke whose outcomes, drawn from the posterior, leave the most information on average."""
    inner, rng = env.unwrapped, np.random.default_rng([seed, 43])
    assert isinstance(inner, DesignEnv)
    strokes = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 5)] * 2), axis=-1).reshape(-1, 2)
    env.reset(seed=seed)
    while not env.over:
        expected = [inner.expected_information(stroke, OUTCOMES, rng) for stroke in strokes]
        env.step(strokes[int(np.argmax(expected))].astype(np.float32))


Agent = Callable[[Counted, int], Any]
AGENTS: dict[str, tuple[Agent, type | tuple[type, ...]]] = {
    "random": (at_random, (PlowSandEnv, NamingEnv, DesignEnv)),
    "paper": (partial(by_optimiser, start=1, acquisition="best"), PlowSandEnv),
    "bo": (by_optimiser, PlowSandEnv),
    "mcmc": (partial(by_chains, search=False), PlowSandEnv),
    "both": (partial(by_chains, search=True), PlowSandEnv),
    "direct": (directly, PlowSandEnv),
    "lda": (by_discriminant, NamingEnv),
    "greedy": (greedily, DesignEnv),
}
"""And the environments that they play; `direct` needs emulated guesses."""


def own_agent(name: str) -> Agent:
    """The function that MODULE:FUNCTION names, modules of the working folder included.

    Raises:
        ParameterError: there is none.
    """
    sys.path.insert(0, str(Path.cwd()))
    try:
        found = pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ParameterError(f"agent {name}: give MODULE:FUNCTION ({error})") from error
    finally:
        sys.path.pop(0)
    if not callable(found):
        raise ParameterError(f"agent {name}: give MODULE:FUNCTION (it is not a function)")
    return found


def chosen_agents(names: Sequence[str], env: gym.Env[Any, Any]) -> dict[str, Agent]:
    """Those of the named agents that play such an environment."""
    inner: Any = env.unwrapped
    emulated = isinstance(inner, PlowSandEnv) and isinstance(inner.problem, EmulatedProblem)
    return {
        name: AGENTS[name][0] for name in names if isinstance(inner, AGENTS[name][1]) and (name != "direct" or emulated)
    }


def play(env: gym.Env[Any, Any], name: str, agent: Agent, seed: int) -> dict[str, Any]:
    """An agent's episode: total reward, its own seconds of the CPU, and of guesses the regret, errors and intervals.

    Raises:
        ParameterError: the agent has not played one whole episode.
    """
    counted, began = Counted(env), time.process_time()
    answer = agent(counted, seed)
    seconds = time.process_time() - began - counted.seconds
    if counted.resets != 1 or not counted.over:
        raise ParameterError(
            f"agent {name}: has to play one whole episode; it made {counted.steps} steps in {counted.resets} episodes"
        )
    found: dict[str, Any] = {"return": counted.total, "steps": counted.steps, "seconds": seconds}
    if not isinstance(env.unwrapped, PlowSandEnv):
        return found
    space, truth = env.unwrapped.problem.space, counted.last["truth"]
    if isinstance(answer, Answer):
        low, high = space.from_unit(answer.low), space.from_unit(answer.high)
        values = space.to_vector(truth)
        found |= {"width": high - low, "inside": (low <= values) & (values <= high)}
        error = space.from_unit(answer.estimate) - values
    else:
        best = counted.last.get("error", {})  # none where every simulation failed
        error = np.array([best.get(name, np.nan) for name in space.names])
    return found | {"regret": counted.last.get("regret", np.nan), "error": error}


def summary(agent: str, episodes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over an agent's episodes, and the standard deviations of what is called a score."""
    column = {key: np.array([e[key] for e in episodes], dtype=np.float64) for key in episodes[0]}
    spread = 1 if len(episodes) > 1 else 0
    entry: dict[str, Any] = {"agent": agent, "steps": int(column["steps"][0]), "seconds": column["seconds"].mean()}
    entry |= {"return": column["return"].mean(), "return_std": column["return"].std(ddof=spread)}
    if "error" in column:
        size = np.abs(column["error"])
        entry |= {"mae": size.mean(axis=0), "mae_std": size.std(axis=0, ddof=spread), "errors": column["error"]}
        entry["regret"] = np.nanmean(column["regret"])
    if "inside" in column:
        entry |= {"width_90": column["width"].mean(axis=0), "coverage_90": column["inside"].mean(axis=0)}
    return entry


def environment(env_id: str, budget: int | None, device: str) -> gym.Env[Any, Any]:
    """An environment by its id; ParameterError where there is none, or it has no budget to choose."""
    chosen: dict[str, Any] = {} if budget is None else {"budget": budget}
    try:
        return gym.make(env_id, device=device, **chosen)
    except (gym.error.Error, TypeError) as error:
        raise ParameterError(f"--env {env_id}: cannot be made ({error})") from error


def run(env: gym.Env[Any, Any], agents: Mapping[str, Agent], seeds: int, data_set: str = "") -> list[dict[str, Any]]:
    """What agents come to; the episodes are kept as a Minari data set where one is named."""
    assert env.spec is not None
    name, recorder = env.spec.id, EpisodeRecorder(env) if data_set else None
    found, say = [], Clock()
    for agent in agents:
        episodes = [play(recorder or env, agent, agents[agent], seed) for seed in range(seeds)]
        found.append(summary(agent, episodes))
        say(f"{name}: {agent}, {found[-1]['steps']} steps")
    if recorder:
        words = f"{seeds} episodes of each agent on {name}"
        recorder.write(data_set, algorithm=", ".join(agents), description=words)
    return found


def compared(env_id: str, options: argparse.Namespace) -> dict[str, Any]:
    """All agents on one environment, at each budget."""
    entries: list[dict[str, Any]] = []
    for budget in options.budgets or [None]:
        env = environment(env_id, budget, options.device)
        agents = chosen_agents(options.agents, env) | {name: own_agent(name) for name in options.agent}
        entries += run(env, agents, options.seeds, options.minari)
    problem = getattr(env.unwrapped, "problem", None)
    units = [] if problem is None else [{"name": p.name, "unit": p.unit} for p in problem.space]
    return {"env": env_id, "parameters": units, "seeds": options.seeds, "entries": plain(entries)}


def table(found: Mapping[str, Any]) -> str:
    """One environment's results as Markdown."""
    head, rows = ["agent", "steps"], []
    if found["parameters"]:
        head += [f"error, {p['name']} [{'°' if p['unit'] == 'deg' else p['unit']}]" for p in found["parameters"]]
        head += ["regret", "90 % interval", "holds the truth"]
    else:
        head.append("return [nats]")
    for e in found["entries"]:
        row = [e["agent"], str(e["steps"])]
        if found["parameters"]:
            row += [f"{mean:.3g} ± {std:.2g}" for mean, std in zip(e["mae"], e["mae_std"], strict=True)]
            row.append(f"{e['regret']:.3f}")
            row.append(" / ".join(f"{w:.3g}" for w in e.get("width_90", [])) or "–")
            row.append(" / ".join(f"{100.0 * c:.0f} %" for c in e.get("coverage_90", [])) or "–")
        else:
            row.append(f"{e['return']:.2f} ± {e['return_std']:.2f}")
        rows.append([*row, f"{e['seconds']:.2g} s"])
    return f"**{found['env']}**\n\n{markdown([*head, 'own CPU time'], rows)}"


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = parser_of(__doc__, "runs/bo-vs-mcmc")
    parser.add_argument("--env", nargs="+", default=list(ENVS), help="ids of environments whose truth is hidden")
    parser.add_argument("--budgets", type=at_least(1), nargs="+", help="steps in an episode; by default the id's own")
    parser.add_argument("--seeds", type=at_least(1), default=10, help="episodes, each with a truth of its own")
    built_in = "built-in ones, where they fit"
    parser.add_argument("--agents", nargs="*", choices=AGENTS, default=list(AGENTS), help=built_in)
    parser.add_argument("--agent", action="append", default=[], metavar="MODULE:FUNCTION", help="one of your own")
    parser.add_argument("--minari", default="", metavar="ID", help="keep the episodes of guesses as a Minari data set")
    options = parser.parse_args(arguments)
    if options.minari and (len(options.env) > 1 or len(options.budgets or [0]) > 1):
        raise ParameterError("--minari: a data set is of one environment and one budget; give one of each")
    hush()
    found = [compared(env, options) for env in options.env]
    words = f"{options.seeds} episodes of each agent: mean ± standard deviation over them."
    text = "\n\n".join([words, *map(table, found)])
    tell(options, {"made_by": stamp(options.device), "environments": found}, text)
    return 0
