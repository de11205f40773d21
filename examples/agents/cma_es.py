"""Covariance matrix adaptation: generation after generation, until the budget is spent; needs the extra ``agents``."""

import gymnasium as gym
import numpy as np
from cmaes import CMA

import splatsoil  # noqa: F401 (registers PlowSand-v0)


def search(env: gym.Env, seed: int = 0) -> tuple[dict[str, float], float]:
    """The best guess of one episode, and its loss."""
    env.reset(seed=seed)
    size = max(env.action_space.shape[0], 2)  # the package wants two: a second one of nothing does no harm
    search = CMA(mean=np.zeros(size), sigma=0.5, bounds=np.tile([-1.0, 1.0], (size, 1)), seed=seed)
    found, generation, truncated = [], [], False
    while not truncated:
        guess = search.ask()
        _, reward, _, truncated, info = env.step(guess[: env.action_space.shape[0]].astype(np.float32))
        found.append((-reward, info["parameters"]))
        generation.append((guess, -reward))
        if len(generation) == search.population_size:
            search.tell(generation)
            generation = []
    loss, parameters = min(found, key=lambda guess: guess[0])
    return parameters, loss


if __name__ == "__main__":
    print(search(gym.make("PlowSand-v0", budget=20)))
