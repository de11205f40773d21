"""Sealed truths of hidden worlds: what is hidden, how much of it, and everything else of a world that isn't told."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from splatsoil.benchmarks import _scenes
from splatsoil.benchmarks._scenes import ANGLES, BEDS, TOOLS, Scene

from splatsoil.observation import Observation
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects

NOTHING, FIELD = "nothing", "friction_field"
"""Kinds without an effect of the library: nothing is hidden, or something that the library doesn't have."""
MIDDLE, NOTED = (0.4, 0.25), 0.3
"""Of the bed, m, and the friction that is noted for the tool; see `splatsoil.benchmarks._scenes`."""
BESIDE = 0.01
"""Between an obstacle and the tool that passes it, m."""
COVER = 0.015
"""Of soil on an obstacle, m, so that no photograph shows it."""


@dataclass(frozen=True)
class Hidden:
    """The truth of one world.

    Attributes:
        kind: name of the effect that is hidden, or one of the kinds without.
        number: of the world of its kind.
        scene: what is ploughed, but for what is hidden.
        size: of what is hidden, in the effect's unit where it has one.
        values: the effect's parameters; none of the kinds without.
        soil: what differs from plain sand, as Newton takes it.
        gravity: (3,) m/s^2, likewise; None for what the set says.
    """

    kind: str
    number: int
    scene: Scene
    size: float = 0.0
    values: Mapping[str, float] = field(default_factory=dict)
    soil: Mapping[str, Any] = field(default_factory=dict)
    gravity: tuple[float, float, float] | None = None

    @property
    def name(self) -> str:
        """Of its folders."""
        return f"{self.kind.replace(' ', '-')}-{self.number}"

    @property
    def angle(self) -> float:
        """Friction angle, degrees."""
        return self.scene.angle

    @property
    def seed(self) -> int:
        """Of surface, looks, particles and noise."""
        return self.scene.seed

    def within(self, rng: np.random.Generator, least: float, most: float) -> Hidden:
        """The same with an angle between these, and within the range of all, so that no soil leaves it."""
        angle = float(rng.uniform(max(least, ANGLES[0]), min(most, ANGLES[1])))
        return replace(self, scene=replace(self.scene, angle=angle))

    def observation(self) -> Observation:
        """How the cameras err."""
        if not self.values:
            return Observation()
        law = Law(find_effects([self.kind]))
        return law.observation(law.require_on(self.values))


def _cohesion(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = rng.uniform(150.0, 500.0)
    return replace(hidden, size=size, values={"cohesion": size}, soil={"cohesion": size})


def _dilatancy(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    share = rng.uniform(0.15, 0.35)
    size = share * hidden.angle
    return replace(hidden, size=size, values={"dilatancy_angle": size}, soil={"dilatancy": share})


def _viscosity(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = rng.uniform(50.0, 200.0)
    return replace(hidden, size=size, values={"viscosity": size}, soil={"viscosity": size})


def _tool_friction(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = rng.uniform(0.6, 0.9)
    return replace(hidden, size=size, values={"tool_friction_change": size - NOTED}, soil={"tool_friction": size})


def _tool_adhesion(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = rng.uniform(200.0, 600.0)
    return replace(hidden, size=size, values={"tool_adhesion": size}, soil={"tool_adhesion": size})


def _tilt(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = rng.uniform(3.0, 6.0) * rng.choice([-1.0, 1.0])
    lean = np.radians(size)
    gravity = (9.81 * np.sin(lean), 0.0, -9.81 * np.cos(lean))
    return replace(hidden, size=size, values={"tilt_x": size}, gravity=gravity)


def _gravity(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = rng.uniform(0.3, 0.6)
    return replace(hidden, size=size, values={"gravity_factor": size}, gravity=(0.0, 0.0, -9.81 * size))


def _layering(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = rng.uniform(-12.0, -7.0)
    depth = rng.uniform(0.03, 0.06)
    return replace(
        hidden.within(rng, ANGLES[0] - size, ANGLES[1]),
        size=size,
        values={"layer_friction": size, "layer_depth": depth},
        soil={"layer": (size, depth)},
    )


def _buried_obstacle(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = rng.uniform(0.03, 0.045)
    # beside the tool's way, which it must not touch
    y = rng.choice([-1.0, 1.0]) * (0.5 * hidden.scene.width + BESIDE + size)
    x = rng.uniform(0.32, 0.45)
    over = np.array([[x + s * size, MIDDLE[1] + y + t * size] for s in (-1, 0, 1) for t in (-1, 0, 1)])
    z = min(0.06, float(hidden.scene.setup().surface.sample(over).min()) - COVER - size)
    values = {"obstacle_radius": size, "obstacle_x": x - MIDDLE[0], "obstacle_y": y, "obstacle_height": z}
    return replace(hidden, size=size, values=values, soil={"obstacle": (x, MIDDLE[1] + y, z, size)})


def _exposure(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = rng.uniform(0.85, 0.93)
    return replace(hidden, size=size, values={"exposure_gain": size})


def _time_offset(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = rng.uniform(0.02, 0.035) * rng.choice([-1.0, 1.0])
    return replace(hidden, size=size, values={"time_offset": size})


def _friction_field(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = rng.uniform(6.0, 10.0) * rng.choice([-1.0, 1.0])
    hidden = hidden.within(rng, ANGLES[0] + abs(size), ANGLES[1] - abs(size))
    return replace(hidden, size=size, soil={"across": size})


KINDS: dict[str, Callable[[np.random.Generator, Hidden], Hidden]] = {
    NOTHING: lambda rng, hidden: hidden,
    "cohesion": _cohesion,
    "dilatancy": _dilatancy,
    "viscosity": _viscosity,
    "tool_friction": _tool_friction,
    "tool_adhesion": _tool_adhesion,
    "tilt": _tilt,
    "gravity": _gravity,
    "layering": _layering,
    "buried_obstacle": _buried_obstacle,
    "exposure": _exposure,
    "time_offset": _time_offset,
    FIELD: _friction_field,
}
OBSERVATION = ("exposure", "time_offset")


def draw(kind: str, number: int, seed: int) -> Hidden:
    """A sealed truth."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind), number])
    bed, tool = BEDS[int(rng.integers(len(BEDS)))], TOOLS[int(rng.integers(len(TOOLS)))]
    return KINDS[kind](rng, Hidden(kind, number, _scenes.draw(rng, bed, tool)))
