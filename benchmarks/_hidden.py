"""Sealed truths of synthetic experiments: what is hidden, its size, and all else that their sets do not state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from splatsoil.benchmarks import _scenes
from splatsoil.benchmarks._common import sized
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

    def observation(self) -> Observation:
        """How the cameras err."""
        if not self.values:
            return Observation()
        law = Law(find_effects([self.kind]))
        return law.observation(law.require_on(self.values))


@dataclass(frozen=True)
class Stream:
    """Random numbers, and the range of effects' sizes over the smallest meaningful one."""

    rng: np.random.Generator
    times: tuple[float, float]

    def value(self, name: str) -> float:
        """Of an effect's parameter: log-uniform in the range of sizes, on either side of off where it has two, and at
        most what the model takes."""
        candidate = candidate_of(library()[name])
        assert candidate is not None
        times = float(np.exp(self.rng.uniform(*np.log(self.times))))
        return sized(candidate.measure, times if candidate.measure.sign else times * self.side())

    def side(self) -> float:
        """Either sign."""
        return float(self.rng.choice([-1.0, 1.0]))

    def within(self, hidden: Hidden, least: float, most: float) -> Hidden:
        """The same with an angle between these, and within the range of all, so that no soil leaves it."""
        angle = float(self.rng.uniform(max(least, ANGLES[0]), min(most, ANGLES[1])))
        return replace(hidden, scene=replace(hidden.scene, angle=angle))


def _effect(name: str, parameter: str = "", *, of_soil: bool = True) -> Callable[[Stream, Hidden], Hidden]:
    """An effect of one parameter, which Newton takes by the same name and in the same unit where it is of the soil."""

    def hide(stream: Stream, hidden: Hidden) -> Hidden:
        size = stream.value(name)
        return replace(hidden, size=size, values={parameter or name: size}, soil={name: size} if of_soil else {})

    return hide


def _dilatancy(stream: Stream, hidden: Hidden) -> Hidden:
    # associated flow is the most that any soil has
    size = min(stream.value("dilatancy"), hidden.angle)
    return replace(hidden, size=size, values={"dilatancy_angle": size}, soil={"dilatancy": size / hidden.angle})


def _tool_friction(stream: Stream, hidden: Hidden) -> Hidden:
    change = stream.value("tool_friction")
    size = NOTED + change
    return replace(hidden, size=size, values={"tool_friction_change": change}, soil={"tool_friction": size})


def _tilt(stream: Stream, hidden: Hidden) -> Hidden:
    size = stream.value("tilt")
    lean = np.radians(size)
    gravity = (9.81 * np.sin(lean), 0.0, -9.81 * np.cos(lean))
    return replace(hidden, size=size, values={"tilt_x": size}, gravity=gravity)


def _gravity(stream: Stream, hidden: Hidden) -> Hidden:
    size = max(stream.value("gravity"), 1.0 / 6.0)
    return replace(hidden, size=size, values={"gravity_factor": size}, gravity=(0.0, 0.0, -9.81 * size))


def _layering(stream: Stream, hidden: Hidden) -> Hidden:
    size = stream.value("layering")
    depth = stream.rng.uniform(0.02, 0.06)
    return replace(
        stream.within(hidden, ANGLES[0] - min(size, 0.0), ANGLES[1] - max(size, 0.0)),
        size=size,
        values={"layer_friction": size, "layer_depth": depth},
        soil={"layer": (size, depth)},
    )


def _buried_obstacle(stream: Stream, hidden: Hidden) -> Hidden:
    size, rng = min(stream.value("buried_obstacle"), STONE), stream.rng
    # beside the tool's way, or under it: it must not touch the tool
    beside = bool(rng.integers(2))
    y = stream.side() * (0.5 * hidden.scene.width + BESIDE + size) if beside else rng.uniform(-0.03, 0.03)
    x = rng.uniform(0.32, 0.45)
    over = np.array([[x + s * size, MIDDLE[1] + y + t * size] for s in (-1, 0, 1) for t in (-1, 0, 1)])
    cover = COVER if beside else hidden.scene.depth + BESIDE
    z = min(0.06, float(hidden.scene.setup().surface.sample(over).min()) - cover - size)
    values = {"obstacle_radius": size, "obstacle_x": x - MIDDLE[0], "obstacle_y": y, "obstacle_height": z}
    return replace(hidden, size=size, values=values, soil={"obstacle": (x, MIDDLE[1] + y, z, size)})


def _friction_field(stream: Stream, hidden: Hidden) -> Hidden:
    size = stream.rng.uniform(6.0, 10.0) * stream.side()
    hidden = stream.within(hidden, ANGLES[0] + abs(size), ANGLES[1] - abs(size))
    return replace(hidden, size=size, soil={"across": size})


def _crust(stream: Stream, hidden: Hidden) -> Hidden:
    size = stream.rng.uniform(500.0, 1500.0)
    return replace(hidden, size=size, soil={"crust": (size, stream.rng.uniform(0.01, 0.02))})


KINDS: dict[str, Callable[[Stream, Hidden], Hidden]] = {
    NOTHING: lambda stream, hidden: hidden,
    "cohesion": _effect("cohesion"),
    "dilatancy": _dilatancy,
    "viscosity": _effect("viscosity"),
    "tool_friction": _tool_friction,
    "tool_adhesion": _effect("tool_adhesion"),
    "tilt": _tilt,
    "gravity": _gravity,
    "layering": _layering,
    "buried_obstacle": _buried_obstacle,
    "exposure": _effect("exposure", "exposure_gain", of_soil=False),
    "time_offset": _effect("time_offset", of_soil=False),
    FIELD: _friction_field,
    CRUST: _crust,
}


def draw(kind: str, number: int, seed: int, times: tuple[float, float] = TIMES) -> Hidden:
    """A sealed truth; effects have sizes of so many ``times`` the smallest meaningful one."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind), number])
    bed, tool = BEDS[int(rng.integers(len(BEDS)))], TOOLS[int(rng.integers(len(TOOLS)))]
    return KINDS[kind](Stream(rng, times), Hidden(kind, number, _scenes.draw(rng, bed, tool)))
