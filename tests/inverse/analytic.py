"""A simulate-and-compare with a known answer, for tests; as a script it fits one slowly, so that it can be killed.

Usage: ``python analytic.py RUN BUDGET DELAY``.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
from splatsoil.envs.problem import Evaluation, Image
from splatsoil.inverse.fitting import FitSetup, fit
from splatsoil.inverse.run_folder import RunFolder

from splatsoil.errors import SimulationError
from splatsoil.parameters import Parameter, ParameterSpace

FRICTION = Parameter("friction_angle", "deg", 20.0, 50.0, 35.0)
COHESION = Parameter("cohesion", "Pa", 0.0, 1000.0, 0.0, off=0.0)
#: What one degree, 500 Pa and the model's own error do to the blocks.
DIRECTIONS = np.linalg.qr(np.random.default_rng(7).normal(size=(24, 3)))[0].T
SETUP = FitSetup(
    measurement="m" * 64,
    reconstruction="r" * 64,
    parameters=("friction_angle",),
    effects=(),
    preset="tiny",
    device="cpu",
    seed=3,
    version="0.0.test",
)


class AnalyticProblem:
    """Loss = 0.1 + ((φ − 36)/10)² (+ a term in cohesion) + noise that depends on the seed; fails where told to."""

    worst_loss = 100.0
    block_count = DIRECTIONS.shape[1]
    image_size = (4, 6)

    def __init__(
        self,
        parameters: tuple[Parameter, ...] = (FRICTION,),
        *,
        noise: float = 0.02,
        fails_below: float = -np.inf,
        delay: float = 0.0,
        constant: bool = False,
        truth: float = 36.0,
    ) -> None:
        self.space = ParameterSpace(parameters)
        self.noise, self.fails_below, self.delay, self.constant = noise, fails_below, delay, constant
        self.target = truth
        self.calls = 0

    def begin(self, seed: int) -> None:
        self.calls = 0

    def evaluate(self, parameters: Mapping[str, float], seed: int) -> Evaluation:
        self.calls += 1
        time.sleep(self.delay)
        angle = parameters["friction_angle"]
        if angle < self.fails_below:
            raise SimulationError(f"nothing holds at {angle:.1f} degrees")
        loss = 0.1 + ((angle - self.target) / 10.0) ** 2
        if "cohesion" in parameters:
            loss += ((parameters["cohesion"] - 300.0) / 500.0) ** 2
        loss += self.noise * np.random.default_rng(seed).normal()
        picture = np.full((*self.image_size, 3), 0.5, dtype=np.float32)
        return Evaluation(
            loss=0.5 if self.constant else float(max(loss, 0.0)),
            blocks=self._blocks(parameters),
            extras={"rgb": 0.01},
            observed=picture,
            predicted=picture + 0.1,
        )

    def _blocks(self, parameters: Mapping[str, float]) -> npt.NDArray[np.float64]:
        off = [parameters["friction_angle"] - self.target, 0.0, 1.0]
        if "cohesion" in parameters:
            off[1] = 10.0 * (parameters["cohesion"] - 300.0) / 500.0
        return (np.array([0.0, 0.0, 1.0]) if self.constant else np.array(off)) @ DIRECTIONS

    def observed_image(self) -> Image:
        return np.full((*self.image_size, 3), 0.5, dtype=np.float32)

    def truth(self) -> Mapping[str, float] | None:
        return {"friction_angle": self.target}


def prepare(folder: str | Path) -> RunFolder:
    measurement = {"name": "analytic", "folder": "nowhere", "hash": SETUP.measurement}
    return RunFolder.prepare(folder, measurement=measurement, preset="tiny", seed=SETUP.seed, version=SETUP.version)


if __name__ == "__main__":
    fit(
        AnalyticProblem(delay=float(sys.argv[3])),
        prepare(sys.argv[1]),
        SETUP,
        budget=int(sys.argv[2]),
        after_evaluation=lambda done, record: print(done, record.loss, flush=True),
    )
