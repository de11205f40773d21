"""Environments whose steps are strokes: name the effect that is in the soil, or choose the stroke that tells most."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from splatsoil.devices import resolve_device
from splatsoil.errors import ParameterError

from .emulator import STRENGTHS, STROKES, FloatArray, evidence, sobol, soil_of, stroke_at, surfaces
from .episode import Array, EpisodeEnv
from .synthetic_experiment import SyntheticExperiment

#: Patches' changes are clipped to this many grey levels.
LIMIT = 255.0
#: Half-widths of what friction angle and strength are drawn from, in [-1, 1].
SPREAD = (0.6, 1.0)
#: Logit of an action of 1.
LOGITS = 5.0
#: Particles of the design environment's posterior.
PARTICLES = 512


class HiddenSoil:
    """Soil with one of several effects, whose strength and friction angle are hidden; it can be plowed again and again.

    Args:
        effects: names, of those that have been simulated; ``none`` is one.
        fast: emulate strokes instead of simulating them at preset ``tiny``.
        device: for the simulations.

    Raises:
        ParameterError: an unknown effect, none, or one twice.
    """

    def __init__(self, effects: Sequence[str], fast: bool, device: str) -> None:
        unknown = [name for name in effects if name not in STRENGTHS]
        if unknown or not effects or len(set(effects)) < len(effects):
            raise ParameterError(f"effects: give some of {', '.join(STRENGTHS)}, each once, not {', '.join(effects)}")
        self.effects, self.fast, self.device = tuple(effects), fast, resolve_device(device)
        self.spaces = {name: soil_of(name).space for name in self.effects}
        self.effect, self.point = self.effects[0], np.zeros(0)

    def begin(self, seed: int) -> None:
        """Hide another effect and other values."""
        rng = np.random.default_rng(seed)
        self.effect = self.effects[int(rng.integers(len(self.effects)))]
        self.point = (np.array(SPREAD) * rng.uniform(-1.0, 1.0, len(SPREAD)))[: len(self.spaces[self.effect])]

    def truth(self) -> dict[str, float]:
        """The hidden values by name."""
        space = self.spaces[self.effect]
        return space.to_dict(space.from_unit(self.point))

    def plowed(self, stroke: FloatArray, seed: int) -> FloatArray:
        """(72,) how much brighter a stroke (2,) of [-1, 1]^2 makes each patch, in grey levels.

        Raises:
            SimulationError: the simulation could not go on, whatever the particles.
        """
        if self.fast:
            surface = surfaces()[f"stroke/{self.effect}"]
            seen = surface.patches @ surface.draw(np.append(self.point, stroke), seed)[0]
        else:
            effects = soil_of(self.effect).effects
            experiment = SyntheticExperiment(effects, "tiny", self.device, stroke_at(stroke))
            seen = evidence(experiment, experiment.surely(self.truth(), seed))
        return np.clip(seen, -LIMIT, LIMIT)


class NamingEnv(EpisodeEnv[Array]):
    """Which effect is in the soil? One step, scored by log probability.

    **Observation**: Box(-255, 255, (72,)), how much brighter a stroke makes each patch of the pictures.
    **Action**: Box(-1, 1, (e,)), a fifth of each effect's logit, in the order of ``info["effects"]``.
    **Reward**: ln of the probability given to the true effect (the logarithmic score; 0 is the best, -ln e for knowing
    nothing). The step is terminal.

    Args:
        effects: names of those that may be hidden.
        fast: emulated strokes.
        device: for the simulations.
    """

    def __init__(self, effects: Sequence[str] = tuple(STRENGTHS), fast: bool = False, device: str = "cpu") -> None:
        super().__init__(budget=1, least=1)
        self.soil = HiddenSoil(effects, fast, device)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (len(self.soil.effects),), np.float32)
        self.observation_space = gym.spaces.Box(-LIMIT, LIMIT, (72,), np.float32)
        self._seen = np.zeros(self.observation_space.shape, dtype=np.float32)

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Answer; see :meth:`EpisodeEnv.step`."""
        observation, reward, _, over, info = super().step(action)
        return observation, reward, over, False, info

    def outcome(self) -> dict[str, Any]:
        """The effect and its values."""
        return {"truth": {"effect": self.soil.effect, **self.soil.truth()}}

    def _begin(self, seed: int) -> dict[str, Any]:
        self.soil.begin(seed)
        usual = STROKES.to_unit([p.default for p in STROKES])
        self._seen = self.soil.plowed(usual, self.step_seed()).astype(np.float32)
        return {"effects": list(self.soil.effects)}

    def _act(self, action: Array) -> tuple[float, dict[str, Any]]:
        logits = LOGITS * action.astype(np.float64)
        logs = logits - np.logaddexp.reduce(logits)
        named = dict(zip(self.soil.effects, np.exp(logs).tolist(), strict=True))
        return float(logs[self.soil.effects.index(self.soil.effect)]), {"probabilities": named}

    def _observation(self) -> Array:
        return self._seen.copy()


class DesignEnv(EpisodeEnv[dict[str, Array]]):
    """Which stroke tells most about friction angle and strength of an effect? Bayesian experimental design.

    The environment keeps the posterior, by the response surface: particles of the prior, weighted by the likelihood of
    what each stroke showed.

    **Action**: Box(-1, 1, (2,)), depth and rake of the next stroke, from their lower to their upper bounds.
    **Observation**: a Dict: ``evidence`` (72,) of the last stroke, ``mean`` and ``std`` (n,) of the posterior in
    [-1, 1]^n, ``strokes_left`` (1,).
    **Reward**: how much the relative entropy of the posterior to the prior has grown, in nats (Lindley 1956).
    **End**: truncated when the budget is spent.

    Args:
        effect: the effect that is on, or ``none``.
        budget: strokes in an episode.
        fast: emulated strokes.
        device: for the simulations.
    """

    def __init__(self, effect: str = "cohesion", budget: int = 3, fast: bool = False, device: str = "cpu") -> None:
        super().__init__(budget, least=1)
        self.soil = HiddenSoil([effect], fast, device)
        (self.space,) = self.soil.spaces.values()
        self._surface = surfaces()[f"stroke/{effect}"]
        self._whitening = np.linalg.inv(self._surface.factor).T
        self._particles = np.array(SPREAD[: len(self.space)]) * sobol(PARTICLES, len(self.space))
        box, n = gym.spaces.Box, len(self.space)
        self.action_space = box(-1.0, 1.0, (len(STROKES),), np.float32)
        self.observation_space = gym.spaces.Dict(  # type: ignore[assignment]
            {
                "evidence": box(-LIMIT, LIMIT, (72,), np.float32),
                "mean": box(-1.0, 1.0, (n,), np.float32),
                "std": box(0.0, 1.0, (n,), np.float32),
                "strokes_left": box(0.0, float(budget), (1,), np.float32),
            }
        )
        self._clear()

    def _clear(self) -> None:
        self._logs = np.full(PARTICLES, -np.log(PARTICLES))
        self._seen = np.zeros(72)

    def outcome(self) -> dict[str, Any]:
        """Truth, and the posterior mean's error."""
        truth, mean = self.soil.truth(), self.space.from_unit(self._moments()[0])
        return {"truth": truth, "error": {k: float(m) - v for m, (k, v) in zip(mean, truth.items(), strict=True)}}

    def expected_information(self, stroke: FloatArray, outcomes: int, rng: np.random.Generator) -> float:
        """Information after a stroke (2,), nats, on average over outcomes drawn from what the posterior predicts."""
        means, scales = self._predicted(stroke)
        drawn = rng.choice(PARTICLES, outcomes, p=np.exp(self._logs))
        seen = means[drawn] + scales[drawn, None] * rng.standard_normal((outcomes, means.shape[1]))
        return float(np.mean([_information(self._updated(means, scales, one)) for one in seen]))

    def _predicted(self, stroke: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Means (512, k) of what each particle shows, where scatter has covariance 1, and factors (512,) of scatter."""
        points = np.column_stack([self._particles, np.tile(stroke, (PARTICLES, 1))])
        return self._surface.mean(points) @ self._whitening, self._surface.scale(points)

    def _updated(self, means: FloatArray, scales: FloatArray, seen: FloatArray) -> FloatArray:
        """(512,) logarithms of the particles' weights once (k,) has been seen."""
        squares = np.sum((seen - means) ** 2, axis=1) / scales**2
        logs = self._logs - 0.5 * squares - len(seen) * np.log(scales)
        return np.asarray(logs - np.logaddexp.reduce(logs))

    def _begin(self, seed: int) -> dict[str, Any]:
        self.soil.begin(seed)
        self._clear()
        return {"parameter_names": list(self.space.names), "stroke_names": list(STROKES.names)}

    def _act(self, action: Array) -> tuple[float, dict[str, Any]]:
        before, stroke = _information(self._logs), action.astype(np.float64)
        self._seen = self.soil.plowed(stroke, self.step_seed())
        seen = self._seen @ self._surface.patches @ self._whitening
        self._logs = self._updated(*self._predicted(stroke), seen)
        information = _information(self._logs)
        return information - before, {"stroke": STROKES.to_dict(STROKES.from_unit(stroke)), "information": information}

    def _moments(self) -> tuple[FloatArray, FloatArray]:
        weights = np.exp(self._logs)
        mean = weights @ self._particles
        return mean, np.sqrt(weights @ (self._particles - mean) ** 2)

    def _observation(self) -> dict[str, Array]:
        mean, std = self._moments()
        found = {"evidence": self._seen, "mean": mean, "std": std, "strokes_left": np.array([self._left])}
        return {name: np.asarray(value, dtype=np.float32) for name, value in found.items()}


def _information(logs: FloatArray) -> float:
    """Relative entropy of weights, given as logarithms, to equal ones, nats."""
    return float(np.exp(logs) @ logs + np.log(len(logs)))
