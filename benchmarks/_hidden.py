"""Sealed truths of synthetic experiments: what is hidden, its size, and all else that their sets do not state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from splatsoil.benchmarks import _scenes
from splatsoil.benchmarks._scenes import ANGLES, BEDS, TOOLS, Scene

from splatsoil.experiment.base import candidate_of
from splatsoil.observation import Observation
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects, library

NOTHING, FIELD, CRUST = "nothing", "friction_field", "crust"
OUTSIDE = (FIELD, CRUST)
"""Kinds that no effect of the library is."""
TIMES = (0.5, 8.0)
"""Sizes of effects, over the smallest meaningful one."""
STONE = 0.045
"""Largest radius of an obstacle, m."""
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
        times: range of an effect's size, over the smallest meaningful one.
    """

    kind: str
    number: int
    scene: Scene
    size: float = 0.0
    values: Mapping[str, float] = field(default_factory=dict)
    soil: Mapping[str, Any] = field(default_factory=dict)
    gravity: tuple[float, float, float] | None = None
    times: tuple[float, float] = TIMES

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


def _same(name: str) -> Callable[[np.random.Generator, Hidden], Hidden]:
    """An effect whose parameter Newton takes by the same name and in the same unit."""

    def hide(rng: np.random.Generator, hidden: Hidden) -> Hidden:
        size = _size(rng, hidden, name)
        return replace(hidden, size=size, values={name: size}, soil={name: size})

    return hide


def _dilatancy(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    # associated flow is the most that any soil has
    size = min(_size(rng, hidden, "dilatancy"), hidden.angle)
    return replace(hidden, size=size, values={"dilatancy_angle": size}, soil={"dilatancy": size / hidden.angle})


def _tool_friction(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    change = max(_size(rng, hidden, "tool_friction"), -NOTED)
    size = NOTED + change
    return replace(hidden, size=size, values={"tool_friction_change": change}, soil={"tool_friction": size})


def _tilt(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = _size(rng, hidden, "tilt")
    lean = np.radians(size)
    gravity = (9.81 * np.sin(lean), 0.0, -9.81 * np.cos(lean))
    return replace(hidden, size=size, values={"tilt_x": size}, gravity=gravity)


def _gravity(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = max(1.0 + _size(rng, hidden, "gravity"), 1.0 / 6.0)
    return replace(hidden, size=size, values={"gravity_factor": size}, gravity=(0.0, 0.0, -9.81 * size))


def _layering(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = _size(rng, hidden, "layering")
    depth = rng.uniform(0.02, 0.06)
    return replace(
        hidden.within(rng, ANGLES[0] - min(size, 0.0), ANGLES[1] - max(size, 0.0)),
        size=size,
        values={"layer_friction": size, "layer_depth": depth},
        soil={"layer": (size, depth)},
    )


def _buried_obstacle(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = min(_size(rng, hidden, "buried_obstacle"), STONE)
    # beside the tool's way, or under it: it must not touch the tool
    beside = bool(rng.integers(2))
    y = rng.choice([-1.0, 1.0]) * (0.5 * hidden.scene.width + BESIDE + size) if beside else rng.uniform(-0.03, 0.03)
    x = rng.uniform(0.32, 0.45)
    over = np.array([[x + s * size, MIDDLE[1] + y + t * size] for s in (-1, 0, 1) for t in (-1, 0, 1)])
    surface = hidden.scene.setup().surface.sample(over)
    cover = COVER if beside else hidden.scene.depth + BESIDE
    z = min(0.06, float(surface.min()) - cover - size)
    values = {"obstacle_radius": size, "obstacle_x": x - MIDDLE[0], "obstacle_y": y, "obstacle_height": z}
    return replace(hidden, size=size, values=values, soil={"obstacle": (x, MIDDLE[1] + y, z, size)})


def _exposure(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = 1.0 + _size(rng, hidden, "exposure")
    return replace(hidden, size=size, values={"exposure_gain": size})


def _time_offset(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = _size(rng, hidden, "time_offset")
    return replace(hidden, size=size, values={"time_offset": size})


def _friction_field(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = rng.uniform(6.0, 10.0) * rng.choice([-1.0, 1.0])
    hidden = hidden.within(rng, ANGLES[0] + abs(size), ANGLES[1] - abs(size))
    return replace(hidden, size=size, soil={"across": size})


def _crust(rng: np.random.Generator, hidden: Hidden) -> Hidden:
    size = rng.uniform(500.0, 1500.0)
    return replace(hidden, size=size, soil={"crust": (size, rng.uniform(0.01, 0.02))})


def _size(rng: np.random.Generator, hidden: Hidden, name: str) -> float:
    """What an effect's parameter is away from off, drawn log-uniformly between ``hidden.times`` its smallest meaningful
    size; on either side where it has two."""
    candidate = candidate_of(library()[name])
    assert candidate is not None
    least, most = np.log(hidden.times)
    size = candidate.measure.meaningful * float(np.exp(rng.uniform(least, most)))
    return size * float(candidate.measure.sign or rng.choice([-1.0, 1.0]))


KINDS: dict[str, Callable[[np.random.Generator, Hidden], Hidden]] = {
    NOTHING: lambda rng, hidden: hidden,
    "cohesion": _same("cohesion"),
    "dilatancy": _dilatancy,
    "viscosity": _same("viscosity"),
    "tool_friction": _tool_friction,
    "tool_adhesion": _same("tool_adhesion"),
    "tilt": _tilt,
    "gravity": _gravity,
    "layering": _layering,
    "buried_obstacle": _buried_obstacle,
    "exposure": _exposure,
    "time_offset": _time_offset,
    FIELD: _friction_field,
    CRUST: _crust,
}
OBSERVATION = ("exposure", "time_offset")


def draw(kind: str, number: int, seed: int, times: tuple[float, float] = TIMES) -> Hidden:
    """A sealed truth; effects have sizes of so many ``times`` the smallest meaningful one."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind), number])
    bed, tool = BEDS[int(rng.integers(len(BEDS)))], TOOLS[int(rng.integers(len(TOOLS)))]
    return KINDS[kind](rng, Hidden(kind, number, _scenes.draw(rng, bed, tool), times=times))
