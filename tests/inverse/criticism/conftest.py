"""An experiment whose models are known functions, so that the right answer of a comparison is known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from splatsoil.experiment.base import Candidate
from splatsoil.experiment.emulated import EmulatedExperiment
from splatsoil.experiment.features import Layout, Site
from splatsoil.parameters import Parameter

ROWS, SIDE = 6, 5
ANGLE = Parameter("friction_angle", "deg", 20.0, 50.0, 35.0)
Make = Callable[..., EmulatedExperiment]


def smooth_field(seed: int, layout: Layout) -> np.ndarray:
    """(t, s) a smooth pattern of unit size, another one for each seed."""
    rng = np.random.default_rng([seed, 5])
    t = np.arange(layout.shape[0])[:, None] / layout.shape[0]
    xy = np.array([[0.0 if np.isnan(v) else v for v in (s.x, s.y)] for s in layout.sites])
    out = sum(
        rng.normal() * np.cos(2.0 * np.pi * (f * t + kx * xy[None, :, 0] + ky * xy[None, :, 1]) + rng.uniform(0, 6.3))
        for f in (0.5, 1.0)
        for kx in (1.0, 2.0)
        for ky in (1.0, 2.0)
    )
    out = out * np.where(np.array([s.channel for s in layout.sites]) == "right", 0.8, 1.0)
    return np.asarray(out / np.sqrt(np.mean(out**2)))


def candidate(name: str, sign: int = 1, kind: str = "physics") -> Candidate:
    size = Parameter(f"{name}_size", "1", 0.0 if sign else -16.0, 16.0, 0.0, off=0.0, meaningful=1.0, sign=sign)
    return Candidate(name, "observation" if kind == "observation" else "physics", (size,), size.name)


@pytest.fixture(scope="session", name="smooth_field")
def _smooth_field() -> Callable[[int, Layout], np.ndarray]:
    """Smooth patterns of unit size."""
    return smooth_field


@pytest.fixture(scope="session", name="candidate")
def _candidate() -> Callable[..., Candidate]:
    """Makes an effect of one size."""
    return candidate


@pytest.fixture(scope="session")
def make() -> Make:
    """Makes an experiment: truth by name, particles' seed, and what is there besides."""
    sites = [
        Site(camera, 0.1 * x, 0.1 * y) for camera in ("left", "right") for x in range(SIDE) for y in range(SIDE)
    ] + [Site("force", unit="N")]
    shape = (ROWS, len(sites))
    layout = Layout(
        tuple(float(10 * i) for i in range(ROWS)),
        tuple(sites),
        "frame",
        "grey levels",
        ("pushing",) * 4 + ("withdrawal",) * 2,
        np.full(shape, "trench"),
    )
    names = ("one", "two", "three", "blurred")

    def made(
        truth: dict[str, float] | None = None,
        seed: int = 0,
        extra: np.ndarray | None = None,
        discretisation: float = 0.5,
    ) -> EmulatedExperiment:
        candidates = (
            candidate("one"),
            candidate("two", sign=0),
            candidate("three"),
            candidate("blurred", 1, "observation"),
        )
        rng = np.random.default_rng(2)
        root = 1.0 * np.eye(shape[0] * shape[1])
        experiment = EmulatedExperiment(
            layout,
            8.0 * smooth_field(1, layout),
            {"friction_angle": 35.0},
            {
                "friction_angle": 0.8 * smooth_field(2, layout),
                **{f"{n}_size": 1.5 * smooth_field(10 + i, layout) for i, n in enumerate(names)},
            },
            (ANGLE,),
            candidates,
            root,
            np.full(shape, 0.5),
            np.zeros(shape),
            curves={"friction_angle": 0.02 * smooth_field(3, layout)},
            patterns={"fine": discretisation * smooth_field(4, layout)},
            albedo_patterns={"guess 1": 0.3 * smooth_field(6, layout), "guess 2": 0.3 * rng.normal(size=shape)},
        )
        values = {"friction_angle": 33.0, **(truth or {})}
        observed = experiment.measured(values, [1000 + seed], extra)
        # Nature is the fine one, and as far from it again.
        observed = observed + experiment.patterns["fine"] + discretisation * smooth_field(100 + seed, layout)
        return EmulatedExperiment(**{**vars(experiment), "observed": observed})

    return made
