"""Response surfaces of simulations of the synthetic experiment, which the ``Fast`` environments answer from.

    python -m splatsoil.envs.emulator FILE

makes the file that is shipped as ``emulated.npz``: 608 simulations at preset ``tiny``, about half an hour on a core.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import qmc

from splatsoil.errors import SimulationError
from splatsoil.parameters import Parameter, ParameterSpace

from .problem import Image
from .synthetic import SyntheticProblem, blurred, patches
from .synthetic_experiment import Stroke, SyntheticExperiment

FloatArray = npt.NDArray[np.float64]

FILE = Path(__file__).with_name("emulated.npz")
SEED = 0
#: Tasks of guessing parameters: free parameters, effects, simulations.
GUESSED: dict[str, tuple[tuple[str, ...], tuple[str, ...], int]] = {
    "one": (("friction_angle",), (), 32),
    "several": (("friction_angle", "cohesion", "dilatancy_angle"), ("cohesion", "dilatancy"), 96),
}
#: Soils that strokes are made in, by the effect that is on: the parameter that measures its strength.
STRENGTHS = {
    "none": None,
    "cohesion": "cohesion",
    "dilatancy": "dilatancy_angle",
    "compaction": "looseness",
    "viscosity": "viscosity",
}
STROKE_SIMULATIONS = 96
#: What a stroke may be.
STROKES = ParameterSpace([Parameter("depth", "m", 0.01, 0.045, 0.035), Parameter("rake", "deg", -30.0, 30.0, 0.0)])
#: Principal components of pictures, and of patches.
PICTURE_COMPONENTS, PATCH_COMPONENTS = 24, 16
HIGHEST_DEGREE = 6


def soil_of(effect: str) -> SyntheticProblem:
    """The synthetic experiment with one effect on, or ``none``: friction angle and the effect's strength are free."""
    strength = STRENGTHS[effect]
    return SyntheticProblem(["friction_angle", *([strength] if strength else [])], [effect] if strength else [])


Seen = Callable[[SyntheticExperiment, Image], FloatArray]
"""What an experiment's pictures (k, h, w, 3) show."""


def change(experiment: SyntheticExperiment, pictures: Image) -> FloatArray:
    """(k, h, w, 3) how much brighter soil that moves makes blurred pictures."""
    return blurred(pictures) - blurred(experiment.still())


def evidence(experiment: SyntheticExperiment, pictures: Image) -> FloatArray:
    """(72,) how much brighter a stroke makes each patch of its pictures, in grey levels."""
    return patches(change(experiment, pictures))


@dataclass(frozen=True)
class Surface:
    """Polynomials of total degree ``degree`` in n inputs, for k components of pictures.

    Attributes:
        degree: with the smallest leave-one-out error.
        coefficients: (m, k) of products of the inputs' powers.
        factor: (k, k) Cholesky factor of the residuals' covariance, in units of :meth:`scale`: what scatter adds to one
            simulation.
        growth: (n,) slopes of ln :meth:`scale`.
        patches: (72, k) what a unit of each component adds to the patches, in grey levels.
        left: mean square sum of what scatter adds beside the components, in the same units.
    """

    degree: int
    coefficients: FloatArray
    factor: FloatArray
    growth: FloatArray
    patches: FloatArray
    left: float

    @classmethod
    def fit(cls, points: FloatArray, features: FloatArray, basis: FloatArray, shown: FloatArray) -> Surface:
        """By least squares.

        Args:
            points: (N, n) in [-1, 1].
            features: (N, p) of simulations.
            basis: (p, k) orthonormal components.
            shown: (72, k) patches of these.
        """
        highest = [d for d in range(1, HIGHEST_DEGREE + 1) if 2 * len(_exponents(points.shape[1], d)) <= len(points)]
        scores = features @ basis
        degree = min(highest, key=lambda d: float(np.sum(_left_out(_terms(points, d), scores) ** 2)))
        terms = _terms(points, degree)
        freedom = len(points) - terms.shape[1]
        residual = features - terms @ np.linalg.lstsq(terms, features, rcond=None)[0]
        # Scatter grows along inputs: multiplicative heteroscedasticity (Harvey 1976).
        straight = np.column_stack([np.ones(len(points)), points])
        growth = np.linalg.lstsq(straight, 0.5 * np.log(np.sum(residual**2, axis=1)), rcond=None)[0][1:]
        residual /= np.exp(points @ growth)[:, None]
        covariance = (residual @ basis).T @ (residual @ basis) / freedom
        return cls(
            degree=degree,
            coefficients=np.asarray(np.linalg.lstsq(terms, scores, rcond=None)[0], dtype=np.float64),
            factor=np.linalg.cholesky(covariance),
            growth=growth,
            patches=shown,
            left=float(np.sum(residual**2) / freedom - np.trace(covariance)),
        )

    def mean(self, points: FloatArray) -> FloatArray:
        """(q, k) at points (q, n) of [-1, 1]^n."""
        return _terms(points, self.degree) @ self.coefficients

    def scale(self, points: FloatArray) -> FloatArray:
        """(q,) how large scatter is at points (q, n)."""
        return np.asarray(np.exp(points @ self.growth))

    def draw(self, point: FloatArray, seed: int) -> tuple[FloatArray, float]:
        """One simulation at a point (n,): components (k,), and the square sum of what is beside them."""
        scale = float(np.exp(point @ self.growth))
        scatter = self.factor @ np.random.default_rng(seed).standard_normal(len(self.factor))
        return self.mean(point[None])[0] + scale * scatter, scale**2 * self.left


@cache
def surfaces() -> dict[str, Surface]:
    """Those that are shipped, by task: one of GUESSED, or ``stroke/EFFECT``."""
    with np.load(FILE, allow_pickle=False) as file:
        of: dict[str, dict[str, Any]] = {}
        for name, value in file.items():
            task, _, key = name.rpartition(".")
            of.setdefault(task, {})[key] = value.astype(np.float64) if value.ndim else value.item()
    return {task: Surface(**found) for task, found in of.items()}


@cache
def _exponents(count: int, degree: int) -> npt.NDArray[np.intp]:
    """(m, count) degrees in each input of all terms up to a total degree."""
    return np.array([e for e in itertools.product(range(degree + 1), repeat=count) if sum(e) <= degree])


def _terms(points: FloatArray, degree: int) -> FloatArray:
    """(q, m) products of powers at points (q, n)."""
    powers, exponents = points[:, :, None] ** np.arange(degree + 1), _exponents(points.shape[1], degree)
    out = powers[:, 0, exponents[:, 0]]
    for k in range(1, points.shape[1]):
        out = out * powers[:, k, exponents[:, k]]
    return np.asarray(out)


def _left_out(terms: FloatArray, scores: FloatArray) -> FloatArray:
    """(N, k) leave-one-out errors of least squares (N, m) to scores (N, k)."""
    orthonormal = np.linalg.qr(terms)[0]
    leverage = np.sum(orthonormal**2, axis=1)
    return (scores - orthonormal @ (orthonormal.T @ scores)) / (1.0 - leverage)[:, None]


def _components(features: FloatArray, count: int) -> FloatArray:
    """(p, count) leading right singular vectors of features (N, p)."""
    return np.linalg.svd(features, full_matrices=False)[2][:count].T


def guessed_surface(points: FloatArray, pictures: FloatArray) -> Surface:
    """Of blurred changes of pictures (N, k, h, w, 3) at points (N, n)."""
    features = pictures.reshape(len(pictures), -1)
    basis = _components(features, min(PICTURE_COMPONENTS, len(features) // 2))
    shown = np.stack([patches(column.reshape(pictures.shape[1:])) for column in basis.T], axis=1)
    return Surface.fit(points, features, basis, shown)


def stroke_surfaces(points: Mapping[str, FloatArray], evidences: Mapping[str, FloatArray]) -> dict[str, Surface]:
    """Of evidences (N, 72) by effect, all in the same components, so that none betrays its effect."""
    basis = _components(np.concatenate([*evidences.values()]), PATCH_COMPONENTS)
    return {f"stroke/{name}": Surface.fit(points[name], evidences[name], basis, basis) for name in evidences}


def simulated(problem: SyntheticProblem, count: int, seen: Seen, *, strokes: bool) -> tuple[FloatArray, FloatArray]:
    """Points (N, n) of the parameters, with ``strokes`` (N, n + 2), and what is seen of each; a simulation that fails
    is left out."""
    n, kept = len(problem.space), []
    for seed, point in enumerate(sobol(count, n + len(STROKES) * strokes)):
        stroke = stroke_at(point[n:]) if strokes else None
        experiment = SyntheticExperiment(problem.effects, "tiny", "cpu", stroke) if strokes else problem.experiment
        (made,) = experiment.simulated([(problem.space.to_dict(problem.space.from_unit(point[:n])), seed)])
        if not isinstance(made, SimulationError):
            kept.append((point, seen(experiment, made)))
    return np.array([point for point, _ in kept]), np.array([features for _, features in kept])


def stroke_at(point: FloatArray) -> Stroke:
    """The stroke at a point (2,) of [-1, 1]^2."""
    return Stroke(**STROKES.to_dict(STROKES.from_unit(point)))


def sobol(count: int, dimension: int) -> FloatArray:
    """Scrambled Sobol points (count, dimension) in [-1, 1]."""
    return 2.0 * qmc.Sobol(dimension, rng=np.random.default_rng(SEED)).random(count) - 1.0


def save(file: Path, made: Mapping[str, Surface]) -> None:
    """Arrays by name, in single precision, without pickle."""
    arrays = {f"{task}.{f.name}": np.asarray(getattr(s, f.name)) for task, s in made.items() for f in fields(s)}
    np.savez_compressed(file, **{k: v.astype(np.float32) if v.ndim else v for k, v in arrays.items()})  # type: ignore[arg-type]


def main(arguments: Sequence[str]) -> int:
    """Simulate, fit, save."""
    if len(arguments) != 1 or arguments[0].startswith("-"):
        print(__doc__, file=sys.stderr)
        return 2
    made = {
        name: guessed_surface(*simulated(SyntheticProblem(free, on), count, change, strokes=False))
        for name, (free, on, count) in GUESSED.items()
    }
    strokes = {e: simulated(soil_of(e), STROKE_SIMULATIONS, evidence, strokes=True) for e in STRENGTHS}
    made |= stroke_surfaces(*({effect: pair[k] for effect, pair in strokes.items()} for k in (0, 1)))
    save(Path(arguments[0]), made)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
