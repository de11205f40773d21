"""Optuna's tree-structured Parzen estimator; needs the extra ``agents``."""

import gymnasium as gym
import numpy as np
import optuna

import splatsoil  # noqa: F401 (registers PlowSand-v0)


def search(env: gym.Env, seed: int = 0) -> tuple[dict[str, float], float]:
    """The best guess of one episode, and its loss."""
    env.reset(seed=seed)
    size = env.action_space.shape[0]

    def loss(trial: optuna.Trial) -> float:
        guess = [trial.suggest_float(f"action{k}", -1.0, 1.0) for k in range(size)]
        _, reward, _, truncated, info = env.step(np.array(guess, dtype=np.float32))
        trial.set_user_attr("parameters", info["parameters"])
        if truncated:
            trial.study.stop()
        return -reward

    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed, n_startup_trials=4))
    study.optimize(loss)
    return study.best_trial.user_attrs["parameters"], study.best_value


if __name__ == "__main__":
    print(search(gym.make("PlowSand-v0", budget=10)))
