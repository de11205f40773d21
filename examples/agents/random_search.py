"""Plain random search: the least that any agent should beat."""

import gymnasium as gym

import splatsoil  # noqa: F401 (registers PlowSand-v0)


def search(env: gym.Env, seed: int = 0) -> tuple[dict[str, float], float]:
    """The best guess of one episode, and its loss."""
    env.reset(seed=seed)
    env.action_space.seed(seed)
    guesses, truncated = [], False
    while not truncated:
        _, reward, _, truncated, info = env.step(env.action_space.sample())
        guesses.append((-reward, info["parameters"]))
    loss, parameters = min(guesses, key=lambda guess: guess[0])
    return parameters, loss


if __name__ == "__main__":
    print(search(gym.make("PlowSand-v0", budget=10)))
