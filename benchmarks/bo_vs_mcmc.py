"""Bayesian optimisation, Markov chains and other agents: what each makes of the same episodes of PlowSand.

    splatsoil benchmark bo-vs-mcmc --out runs/bo-vs-mcmc
    splatsoil benchmark bo-vs-mcmc --env PlowSandFast-v0 --agent examples.agents.optuna_tpe:search

| agent | on | what it does |
|---|---|---|
| `random` | all | actions at random |
| `bo` | guesses | the search of `splatsoil fit`: log noisy expected improvement of the loss, and where that is least |
| `paper` | guesses | the same with Hsiao and Kumar's settings: one random start, expected improvement |
| `mcmc` | guesses | emcee on a comparison's posterior, by an emulator of the features trained on space-filling calls |
| `both` | guesses | the same, trained on the calls that `bo` chose: what `splatsoil fit` reports |
| `direct` | emulated guesses | emcee on the calls themselves: each is a step of a walker |
| `lda` | naming | linear discriminant analysis, trained on other episodes |
| `greedy` | design | the stroke of most expected information, of 25 |

An agent of one's own is a function (env, seed) that resets the environment with the seed and plays one whole episode;
of guesses it may return an Answer: otherwise its best guess counts.

With many episodes this is simulation-based calibration (Talts et al. 2018, arXiv:1804.06788): 50 and 90 % intervals
should contain the truth in 50 and 90 % of the episodes, and the truth's rank among the draws should be uniform.
"""

from __future__ import annotations

import argparse
import pkgutil
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from scipy.stats import kstest
from splatsoil.benchmarks._agents import AGENTS, Agent, Answer
from splatsoil.benchmarks._common import Clock, at_least, markdown, parser_of, stamp, tell
from splatsoil.envs.emulated import EmulatedProblem
from splatsoil.envs.plow_sand import PlowSandEnv
from splatsoil.envs.recording import recorded, write

from splatsoil.errors import ParameterError
from splatsoil.files import plain
from splatsoil.parameters import ParameterSpace
from splatsoil.quiet import hush

ENVS = ("PlowSandFast-v0", "PlowSandSeveralFast-v0", "PlowSandNamingFast-v0", "PlowSandDesignFast-v0")


class Counted(gym.Wrapper[Any, Any, Any, Any]):
    """Counts what an agent does in the one episode that it may play, and the CPU's seconds that the steps take."""

    def __init__(self, env: gym.Env[Any, Any]) -> None:
        super().__init__(env)
        self.resets, self.rewards, self.seconds, self.over = 0, list[float](), 0.0, False
        self.info: dict[str, Any] = {}

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        began = time.process_time()
        found = self.env.reset(**options)
        self.resets, self.seconds = self.resets + 1, self.seconds + time.process_time() - began
        return found

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        began = time.process_time()
        found = self.env.step(action)
        self.rewards.append(float(found[1]))
        self.over, self.info = found[2] or found[3], found[4]
        self.seconds += time.process_time() - began
        return found


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
    """An agent's episode: total reward, its own seconds of the CPU, and of guesses the regret and what `scored` gives.

    Raises:
        ParameterError: the agent has not played one whole episode.
    """
    counted, began = Counted(env), time.process_time()
    answer = agent(counted, seed)
    seconds, steps = time.process_time() - began - counted.seconds, len(counted.rewards)
    if counted.resets != 1 or not counted.over:
        raise ParameterError(
            f"agent {name}: has to play one whole episode; it made {steps} steps in {counted.resets} episodes"
        )
    found: dict[str, Any] = {"return": sum(counted.rewards), "steps": steps, "seconds": seconds}
    if not isinstance(env.unwrapped, PlowSandEnv):
        return found
    space, info = env.unwrapped.problem.space, counted.info
    if isinstance(answer, Answer):
        found |= scored(answer, space, info["truth"])
    else:  # where every simulation failed there is no best guess
        found["error"] = np.array([info.get("error", {}).get(name, np.nan) for name in space.names])
    return found | {"regret": info.get("regret", np.nan)}


def scored(answer: Answer, space: ParameterSpace, truth: Mapping[str, float]) -> dict[str, Any]:
    """Error of the estimate, width of the 90 % interval, the truth's rank among the draws (0 to 1); (n,) each."""
    values, ends = space.to_vector(truth), np.quantile(answer.draws, [0.05, 0.95], axis=0)
    return {
        "error": space.from_unit(answer.estimate) - values,
        "width": np.ptp(space.from_unit(ends), axis=0),
        "rank": np.mean(answer.draws < space.to_unit(values), axis=0),
    }


def accuracy(episodes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Of what was `scored`: mean absolute error and bias with their standard deviations, how often central intervals
    contain the truth, and the p-value of uniform ranks by Kolmogorov and Smirnov; (n,) each."""
    error = np.array([e["error"] for e in episodes], dtype=np.float64)
    size, ddof = np.abs(error), 1 if len(episodes) > 1 else 0
    entry = {"mae": size.mean(axis=0), "mae_std": size.std(axis=0, ddof=ddof), "errors": error}
    entry |= {"bias": error.mean(axis=0), "scatter": error.std(axis=0, ddof=ddof)}
    if "rank" in episodes[0]:
        rank, width = (np.array([e[key] for e in episodes]) for key in ("rank", "width"))
        entry |= {f"coverage_{level}": np.mean(np.abs(rank - 0.5) <= 0.005 * level, axis=0) for level in (50, 90)}
        entry |= {"width_90": width.mean(axis=0), "p_uniform": kstest(rank, "uniform", axis=0).pvalue}
    return entry


def summary(agent: str, episodes: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Means over an agent's episodes, and the accuracy of guesses."""
    returns, seconds = (np.array([e[key] for e in episodes]) for key in ("return", "seconds"))
    entry: dict[str, Any] = {"agent": agent, "steps": episodes[0]["steps"], "seconds": seconds.mean()}
    entry |= {"return": returns.mean(), "return_std": returns.std(ddof=1 if len(returns) > 1 else 0)}
    if "error" in episodes[0]:
        entry |= {"regret": np.nanmean([e["regret"] for e in episodes]), **accuracy(episodes)}
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
    name, recorder = env.spec.id, recorded(env) if data_set else None
    found, say = [], Clock()
    for agent in agents:
        episodes = [play(recorder or env, agent, agents[agent], seed) for seed in range(seeds)]
        found.append(summary(agent, episodes))
        say(f"{name}: {agent}, {found[-1]['steps']} steps")
    if recorder:
        words = f"{seeds} episodes of each agent on {name}"
        write(recorder, data_set, algorithm_name=", ".join(agents), description=words)
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
        head += ["regret", "90 % interval", "50, 90 % intervals contain the truth", "ranks uniform, p"]
    else:
        head.append("return [nats]")
    for e in found["entries"]:
        row = [e["agent"], str(e["steps"])]
        if found["parameters"]:
            pairs = zip(e.get("coverage_50", []), e.get("coverage_90", []), strict=True)
            row += [f"{mean:.3g} ± {std:.2g}" for mean, std in zip(e["mae"], e["mae_std"], strict=True)]
            row.append(f"{e['regret']:.3f}")
            row.append(" / ".join(f"{w:.3g}" for w in e.get("width_90", [])) or "–")
            row.append(" / ".join(f"{100.0 * half:.0f}, {100.0 * most:.0f} %" for half, most in pairs) or "–")
            row.append(" / ".join(f"{p:.2f}" for p in e.get("p_uniform", [])) or "–")
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
