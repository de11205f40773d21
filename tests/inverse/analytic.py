"""A simulate-and-compare with a known answer."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
from splatsoil.envs.problem import Evaluation, Image
from splatsoil.inverse.fitting import FitSetup
from splatsoil.inverse.run_folder import RunFolder

from splatsoil.errors import SimulationError
from splatsoil.parameters import Parameter, ParameterSpace

FRICTION = Parameter("friction_angle", "deg", 20.0, 50.0, 35.0)
#: What one degree and the model's own error do to the blocks.
DIRECTIONS = np.linalg.qr(np.random.default_rng(7).normal(size=(24, 2)))[0].T
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
    """Loss = 0.1 + ((φ − 36)/10)² + noise that depends on the seed; fails where told to."""

    worst_loss = 100.0
    block_count = DIRECTIONS.shape[1]
    image_size = (4, 6)

    def __init__(
        self,
        *,
        noise: float = 0.02,
        fails_below: float = -np.inf,
        delay: float = 0.0,
        constant: bool = False,
        truth: float = 36.0,
    ) -> None:
        self.space = ParameterSpace([FRICTION])
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
        off = 0.0 if self.constant else parameters["friction_angle"] - self.target
        return np.array([off, 1.0]) @ DIRECTIONS

    def observed_image(self) -> Image:
        return np.full((*self.image_size, 3), 0.5, dtype=np.float32)

    def truth(self) -> Mapping[str, float] | None:
        return {"friction_angle": self.target}


def prepare(folder: str | Path) -> RunFolder:
    measurement = {"name": "analytic", "folder": "nowhere", "hash": SETUP.measurement}
    return RunFolder.prepare(folder, measurement=measurement, preset="tiny", seed=SETUP.seed, version=SETUP.version)
