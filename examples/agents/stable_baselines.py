"""Stable-Baselines3's soft actor-critic learns to act on what earlier steps showed; needs the extra ``agents``.

It learns in an emulated environment, from other episodes than those that it is asked to play.
"""

from functools import cache

import gymnasium as gym
from stable_baselines3 import SAC
from stable_baselines3.common.env_checker import check_env

import splatsoil  # noqa: F401 (registers PlowSand-v0)


@cache
def train(env_id: str, budget: int, steps: int = 10000, seed: int = 10**6) -> SAC:
    """An agent after so many steps."""
    env = gym.make(env_id, budget=budget)
    check_env(env)
    agent = SAC("MultiInputPolicy", env, gamma=1.0, train_freq=8, gradient_steps=4, seed=seed, device="cpu")
    return agent.learn(steps)


def play(env: gym.Env, seed: int = 0) -> dict:
    """The last step's info of one episode, without the noise that it learns with."""
    agent = train(env.spec.id, env.unwrapped.budget)
    observation, _ = env.reset(seed=seed)
    truncated = False
    while not truncated:
        action, _ = agent.predict(observation, deterministic=True)
        observation, _, _, truncated, info = env.step(action)
    return info


if __name__ == "__main__":
    print(play(gym.make("PlowSandFast-v0", budget=4)))
