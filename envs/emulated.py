"""The synthetic simulate-and-compare by response surfaces of its simulations instead of the simulator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from splatsoil.errors import ParameterError

from .emulator import GUESSED, surfaces
from .problem import Evaluation, Image
from .synthetic import BLOCKS, FloatArray, HiddenTruth


class EmulatedProblem(HiddenTruth):
    """What SyntheticProblem would answer, on average, with scatter of the same covariance; without sensor noise.

    Args:
        parameters, effects: one of the combinations that have been simulated.

    Raises:
        ParameterError: others.
    """

    def __init__(self, parameters: Sequence[str] | None = None, effects: Sequence[str] = ()) -> None:
        super().__init__(parameters, effects)
        known = {(free, on): name for name, (free, on, _) in GUESSED.items()}
        name = known.get((self.space.names, self.effects))
        if name is None:
            choices = "; ".join(f"{', '.join(free)} with effects {', '.join(on) or 'none'}" for free, on in known)
            raise ParameterError(f"fast: nothing emulates these parameters and effects, only {choices}")
        self.surface = surfaces()[name]

    def evaluate(self, parameters: Mapping[str, float], seed: int) -> Evaluation:
        """One draw of what a simulation would come to."""
        (observed, beside), (predicted, as_well) = self.observed(), self._recorded(parameters, seed)
        residual = observed - predicted
        # What is beside the components is scatter: there is none in soil that doesn't move.
        loss = float((residual @ residual + beside + as_well) / (observed @ observed + beside))
        return Evaluation(
            loss=min(loss, self.worst_loss), blocks=self.surface.patches @ residual, predicted=self._picture(predicted)
        )

    def observed_image(self) -> Image:
        """The left camera's last picture: its patches' changes of brightness about grey, four times as strong."""
        return self._picture(self.observed()[0])

    def _recorded(self, truth: Mapping[str, float], seed: int) -> tuple[FloatArray, float]:
        """Components (k,) of what the cameras see, and the square sum of what is beside them."""
        return self.surface.draw(self.space.to_unit(self.space.to_vector(truth)), seed)

    def _picture(self, components: FloatArray) -> Image:
        shown = (self.surface.patches @ components).reshape(2, -1, *BLOCKS)[0, -1]
        grey = np.clip(0.5 + 4.0 * shown / 255.0, 0.0, 1.0).astype(np.float32)
        (rows, columns), (height, width) = BLOCKS, self.image_size
        patch = (rows, height // rows, columns, width // columns, 3)
        return np.broadcast_to(grey[:, None, :, None, None], patch).reshape(height, width, 3)
