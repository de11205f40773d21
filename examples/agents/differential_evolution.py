"""SciPy's differential evolution: an episode is a generation or more, and the budget decides when it ends."""

import gymnasium as gym
import numpy as np
from scipy.optimize import differential_evolution

import splatsoil  # noqa: F401 (registers PlowSand-v0)


def search(env: gym.Env, generations: int = 3, seed: int = 0) -> tuple[dict[str, float], float]:
    """The best guess and its loss. The budget should be (generations + 1) times 5 times the number of parameters."""
    env.reset(seed=seed)
    found: dict[float, dict[str, float]] = {}

    def loss(guess: np.ndarray) -> float:
        _, reward, _, _, info = env.step(guess.astype(np.float32))
        found[-reward] = info["parameters"]
        return -reward

    bounds = list(zip(env.action_space.low, env.action_space.high, strict=True))
    differential_evolution(loss, bounds, popsize=5, maxiter=generations, polish=False, tol=0.0, seed=seed)
    return found[min(found)], min(found)


if __name__ == "__main__":
    print(search(gym.make("PlowSand-v0", budget=20)))
