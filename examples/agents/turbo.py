"""TuRBO-1 (Eriksson et al. 2019, NeurIPS 32): Bayesian optimisation in a trust region, by BoTorch."""

import gymnasium as gym
import torch
from botorch.fit import fit_gpytorch_mll
from botorch.generation import MaxPosteriorSampling
from botorch.models import SingleTaskGP
from gpytorch.kernels import MaternKernel, ScaleKernel
from gpytorch.mlls import ExactMarginalLogLikelihood
from torch.quasirandom import SobolEngine

import splatsoil  # noqa: F401 (registers PlowSand-v0)

FIRST, LONGEST, SHORTEST = 0.8, 1.6, 0.5**7  # sides of the region in the unit cube, as in the paper
SUCCESSES = 3


def proposal(points: torch.Tensor, rewards: torch.Tensor, side: float, seed: int) -> torch.Tensor:
    """A Thompson sample (n,) from the region about the best of points (m, n) of the unit cube."""
    size = points.shape[1]
    kernel = ScaleKernel(MaternKernel(nu=2.5, ard_num_dims=size))
    model = SingleTaskGP(points, (rewards[:, None] - rewards.mean()) / rewards.std(), covar_module=kernel)
    fit_gpytorch_mll(ExactMarginalLogLikelihood(model.likelihood, model))
    sides = kernel.base_kernel.lengthscale.detach()[0]
    sides = 0.5 * side * sides / sides.log().mean().exp()
    best = points[rewards.argmax()]
    low, high = (best - sides).clamp(0.0, 1.0), (best + sides).clamp(0.0, 1.0)
    candidates = SobolEngine(size, scramble=True, seed=seed).draw(min(100 * size, 5000)).double()
    candidates = low + (high - low) * candidates
    with torch.no_grad():
        return MaxPosteriorSampling(model, replacement=False)(candidates)[0]


def search(env: gym.Env, seed: int = 0) -> tuple[dict[str, float], float]:
    """The best guess of one episode, and its loss."""
    env.reset(seed=seed)
    torch.manual_seed(seed)
    size = env.action_space.shape[0]
    start, sobol = max(4, 2 * size), SobolEngine(size, scramble=True, seed=seed)
    found, tried, rewards, truncated = [], [], [], False
    side, good, bad = FIRST, 0, 0
    while not truncated:
        inside = len(tried) >= start
        if inside:
            guess = proposal(torch.stack(tried), torch.tensor(rewards, dtype=torch.float64), side, len(found))
        else:
            guess = sobol.draw(1)[0].double()
        _, reward, _, truncated, info = env.step((2.0 * guess - 1.0).numpy().astype("float32"))
        found.append((-reward, info["parameters"]))
        if inside:
            better = reward > max(rewards) + 1e-3 * abs(max(rewards))
            good, bad = (good + 1, 0) if better else (0, bad + 1)
            if good == SUCCESSES:
                side, good = min(2.0 * side, LONGEST), 0
            elif bad == max(4, size):
                side, bad = 0.5 * side, 0
        tried.append(guess)
        rewards.append(float(reward))
        if side < SHORTEST:  # begin elsewhere
            tried, rewards, side = [], [], FIRST
    loss, parameters = min(found, key=lambda guess: guess[0])
    return parameters, loss


if __name__ == "__main__":
    print(search(gym.make("PlowSand-v0", budget=10)))
