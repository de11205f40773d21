"""Simulate-and-compare against a hidden truth of the experiment in `synthetic_experiment`.

The same solver and the same renderer make the observation and the predictions, with other particles, so that the best
loss is seed-to-seed scatter and not zero. Agents can be tried on it; an answer about real soil needs a measurement set.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from splatsoil.devices import resolve_device
from splatsoil.errors import ParameterError, SimulationError
from splatsoil.parameters import ParameterSpace

from .problem import Evaluation, Image
from .synthetic_experiment import COMPARED, HEIGHT, WIDTH, SyntheticExperiment

FloatArray = npt.NDArray[np.float64]

#: Standard deviation of the observation's sensor noise, sRGB.
SENSOR_NOISE = 0.006
#: Hidden values are drawn from this middle part of a parameter's range.
HIDDEN_RANGE = (0.2, 0.8)
#: Pictures are compared after a blur of this standard deviation in pixels: single grains differ from seed to seed.
BLUR = 1.5
#: Patches of residuals along each picture's height and width.
BLOCKS = (3, 4)


def blurred(pictures: Image) -> FloatArray:
    """Pictures (k, h, w, 3) as they are compared."""
    return gaussian_filter(pictures.astype(np.float64), (0.0, BLUR, BLUR, 0.0))


def noisy(pictures: Image, seed: int) -> Image:
    """Pictures (k, h, w, 3) with a sensor's noise."""
    noise = np.random.default_rng([seed, 1]).standard_normal(pictures.shape)
    return np.clip(pictures + SENSOR_NOISE * noise, 0.0, 1.0).astype(np.float32)


def patches(pictures: FloatArray) -> FloatArray:
    """Mean of each patch (k · 3 · 4,) of pictures (k, h, w, 3), in grey levels of 255."""
    count, height, width = pictures.shape[:3]
    rows, columns = BLOCKS
    parts = pictures.reshape(count, rows, height // rows, columns, width // columns, 3)
    return 255.0 * parts.mean(axis=(2, 4, 5)).reshape(-1)


def compare(observed: Image, predicted: Image, still: Image) -> tuple[float, FloatArray]:
    """Loss and block residuals of stacks of pictures (k, h, w, 3), all blurred first.

    Args:
        observed: what the cameras saw.
        predicted: what the model predicts.
        still: what they would have seen had the soil not moved.

    Returns:
        The mean square of the residual over that of ``still``'s: 1 is as good as no model at all. And the mean
        residual of each patch (k · 3 · 4,) in grey levels of 255.
    """
    seen = blurred(observed)
    residual = seen - blurred(predicted)
    loss = float(np.mean(residual**2) / np.mean((seen - blurred(still)) ** 2))
    return loss, patches(residual)


class HiddenTruth(ABC):
    """Parameters of a synthetic experiment, some of them free and hidden.

    Args:
        parameters: names of the free parameters, whose hidden values are drawn at ``begin``; the rest have defaults.
            None: those that a fit frees, friction angle and strengths of the effects.
        effects: names of effects that are on, in the experiment and in the model.

    Raises:
        ParameterError: unknown names.
    """

    #: Ten times as bad as soil that doesn't move; losses beyond are cut.
    worst_loss = 10.0
    image_size = (HEIGHT, WIDTH)
    block_count = 2 * len(COMPARED) * BLOCKS[0] * BLOCKS[1]

    def __init__(self, parameters: Sequence[str] | None = None, effects: Sequence[str] = ()) -> None:
        from splatsoil.soil.law import Law
        from splatsoil.soil.library import find_effects

        law = Law(find_effects(effects))
        seen = [effect.name for effect in law.effects if effect.observes]
        if seen:
            raise ParameterError(
                f"the synthetic experiment has no {seen[0]}: it is seen as it is; give a measurement set"
            )
        known = {p.name: p for p in law.parameters}
        parameters = law.free if parameters is None else parameters
        unknown = [name for name in parameters if name not in known]
        if unknown:
            raise ParameterError(f"unknown parameter {', '.join(unknown)}; this model has {', '.join(known)}")
        self.space = ParameterSpace(known[name] for name in parameters)
        self.effects = tuple(effects)
        self._truth: dict[str, float] | None = None
        self._truth_seed = 0
        self._observed: Any = None

    @abstractmethod
    def _recorded(self, truth: Mapping[str, float], seed: int) -> Any:
        """What the cameras see of a truth."""

    def observed(self) -> Any:
        """What the cameras saw; it is simulated when it is first needed."""
        if self._truth is None:
            raise RuntimeError("begin() has to be called before anything is observed")
        if self._observed is None:
            self._observed = self._recorded(self._truth, self._truth_seed)
        return self._observed

    def begin(self, seed: int) -> None:
        """Draw another hidden truth."""
        if self._truth is not None and seed == self._truth_seed:
            return
        unit = 2.0 * np.random.default_rng(seed).uniform(*HIDDEN_RANGE, len(self.space)) - 1.0
        self.place(self.space.to_dict(self.space.from_unit(unit)), seed)

    def place(self, truth: Mapping[str, float], seed: int) -> None:
        """Hide this truth instead of a drawn one; the seed decides its particles and noise."""
        self._truth = self.space.to_dict(self.space.to_vector(truth))
        self._truth_seed = seed
        self._observed = None

    def truth(self) -> Mapping[str, float] | None:
        """The hidden values."""
        return self._truth


class SyntheticProblem(HiddenTruth):
    """Simulate-and-compare against a hidden truth.

    Args:
        parameters, effects: see :class:`HiddenTruth`.
        preset: resolution of the solver.
        device: ``auto``, ``cpu`` or ``cuda:N``.

    Raises:
        ParameterError: unknown names.
    """

    def __init__(
        self,
        parameters: Sequence[str] | None = None,
        effects: Sequence[str] = (),
        *,
        preset: str = "tiny",
        device: str = "cpu",
    ) -> None:
        from splatsoil.mpm import PRESETS

        if preset not in PRESETS:
            raise ParameterError(f"preset {preset!r} is unknown; known are {', '.join(PRESETS)}")
        super().__init__(parameters, effects)
        self.preset = preset
        self.device = resolve_device(device)
        self._still: Image | None = None

    def _recorded(self, truth: Mapping[str, float], seed: int) -> Image:
        """(k, h, w, 3), sensor noise and all."""
        return noisy(self.experiment.surely(truth, seed), seed)

    def unobserved(self) -> tuple[Mapping[str, float], int] | None:
        """Values and seed of the experiment's own simulation, as long as it hasn't been made."""
        return (self._truth, self._truth_seed) if self._observed is None and self._truth is not None else None

    def record(self, clean: Image | SimulationError) -> None:
        """Take pictures (k, h, w, 3) of the experiment's own simulation, if it came to any, as what the cameras saw,
        but for their noise."""
        if not isinstance(clean, SimulationError):
            self._observed = noisy(clean, self._truth_seed)

    def observed_image(self) -> Image:
        """The left camera's last picture."""
        return np.asarray(self.observed()[len(COMPARED) - 1])

    def evaluate(self, parameters: Mapping[str, float], seed: int) -> Evaluation:
        """Simulate, draw, compare.

        Raises:
            SimulationError: the simulation could not go on.
        """
        return self.judge(self.predict(parameters, seed))

    def judge(self, predicted: Image) -> Evaluation:
        """Predicted pictures (k, h, w, 3) compared with the observed ones."""
        observed = self.observed()
        if self._still is None:
            self._still = self.experiment.still()
        loss, blocks = compare(observed, predicted, self._still)
        shown = len(COMPARED) - 1
        return Evaluation(
            loss=min(loss, self.worst_loss),
            blocks=blocks,
            extras={"rgb": float(np.mean((observed - predicted) ** 2))},
            observed=observed[shown],
            predicted=predicted[shown],
        )

    def predict(self, parameters: Mapping[str, float], seed: int) -> Image:
        """Pictures (k, h, w, 3), camera by camera, of a bed of other particles (by ``seed``) with these parameters.

        Raises:
            SimulationError: the simulation could not go on.
        """
        (made,) = self.experiment.simulated([(parameters, seed)])
        if isinstance(made, SimulationError):
            raise made
        return made

    def share(self, other: SyntheticProblem) -> None:
        """Use another problem's solver and scene, if they are for the same law, preset and device."""
        if (self.effects, self.preset, self.device) == (other.effects, other.preset, other.device):
            self.experiment = other.experiment

    @cached_property
    def experiment(self) -> SyntheticExperiment:
        """What all simulations share."""
        return SyntheticExperiment(self.effects, self.preset, self.device)

    def __getstate__(self) -> dict[str, Any]:
        # Solver and scene are made again from their names: kernels and meshes don't travel between processes.
        return {key: value for key, value in self.__dict__.items() if key != "experiment"}
