"""What an environment needs of the world: something that simulates a parameter vector and compares it with data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from splatsoil.parameters import ParameterSpace

FloatArray = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]


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


class WrappedProblem:
    """A problem that does what another one does, but for what a subclass changes.

    Args:
        inner: does the work.
    """

    def __init__(self, inner: Problem) -> None:
        self.inner = inner

    @property
    def space(self) -> ParameterSpace:
        """The free parameters."""
        return self.inner.space

    @property
    def block_count(self) -> int:
        """Length of the block residuals."""
        return self.inner.block_count

    @property
    def worst_loss(self) -> float:
        """Larger than any loss."""
        return self.inner.worst_loss

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width) of the pictures."""
        return self.inner.image_size

    def begin(self, seed: int) -> None:
        """Start an episode."""
        self.inner.begin(seed)

    def evaluate(self, parameters: Mapping[str, float], seed: int) -> Evaluation:
        """Simulate and compare; see :class:`Problem`."""
        return self.inner.evaluate(parameters, seed)

    def observed_image(self) -> Image:
        """The observation as pictures show it."""
        return self.inner.observed_image()

    def truth(self) -> Mapping[str, float] | None:
        """The hidden parameters of a synthetic experiment."""
        return self.inner.truth()
