"""Stable-Baselines3's PPO learns to guess from what earlier guesses left; needs the extra ``agents``.

The emulated environment gives it thousands of steps in a minute.
"""

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env

import splatsoil  # noqa: F401 (registers PlowSandFast-v0)


def train(env: gym.Env, steps: int = 4096, seed: int = 0) -> PPO:
    """An agent after so many guesses."""
    check_env(env)
    return PPO("MultiInputPolicy", env, n_steps=32, batch_size=32, seed=seed, device="cpu").learn(steps)


if __name__ == "__main__":
    env = gym.make("PlowSandFast-v0", budget=4)
    agent = train(env)
    observation, _ = env.reset(seed=1)
    truncated = False
    while not truncated:
        action, _ = agent.predict(observation, deterministic=True)
        observation, reward, _, truncated, info = env.step(action)
        print(info["parameters"], reward)
    print("the truth was", info["truth"])
