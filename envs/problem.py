"""What an environment needs: something that simulates a parameter vector and compares it with data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from splatsoil.parameters import ParameterSpace

FloatArray = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]
Job = tuple[Mapping[str, float], int]
"""Parameters by name in physical units, and the simulation's seed."""


@dataclass(frozen=True)
class Evaluation:
    """Outcome of one simulate-and-compare.

    Attributes:
        loss: how far the prediction is from the observation; None when the simulation failed.
        blocks: (b,) block residuals, always the same b; zeros when the simulation failed.
        message: why it failed.
        extras: further numbers worth keeping.
        seconds: wall time.
        observed: (h, w, 3) sRGB in [0, 1], a picture that shows what was compared; None where there is none at hand.
        predicted: (h, w, 3) the same view of the prediction.
    """

    loss: float | None
    blocks: FloatArray
    message: str = ""
    extras: Mapping[str, float] = field(default_factory=dict)
    seconds: float = 0.0
    observed: Image | None = None
    predicted: Image | None = None


@runtime_checkable
class Problem(Protocol):
    """Simulate and compare.

    Attributes:
        space: the free parameters.
        block_count: length of an evaluation's block residuals.
        worst_loss: larger than any loss a simulation can have; a failed one is rewarded with minus this.
        image_size: (height, width) of the pictures.
    """

    @property
    def space(self) -> ParameterSpace: ...
    @property
    def block_count(self) -> int: ...
    @property
    def worst_loss(self) -> float: ...
    @property
    def image_size(self) -> tuple[int, int]: ...

    def begin(self, seed: int) -> None:
        """Start an episode: a synthetic experiment draws its hidden truth here."""

    def evaluate(self, parameters: Mapping[str, float], seed: int) -> Evaluation:
        """Simulate ``parameters`` (physical units, by name) and compare.

        Raises:
            SimulationError: the simulation could not go on.
        """

    def observed_image(self) -> Image:
        """(h, w, 3) sRGB in [0, 1]: the observation as pictures show it."""

    def truth(self) -> Mapping[str, float] | None:
        """The hidden parameters of a synthetic experiment, None for a measured one."""


def simulation_seed(seed: int, step: int) -> int:
    """Seed of the particles in one step of an episode or a fit."""
    return int(np.random.SeedSequence([seed, step]).generate_state(1)[0] % 2**31)
