"""Sealed truths of synthetic experiments: what is hidden, its size, and all else that their sets do not state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from splatsoil.benchmarks import _scenes
from splatsoil.benchmarks._common import FloatArray, sized
from splatsoil.benchmarks._newton import Soil
from splatsoil.benchmarks._scenes import ANGLES, BEDS, TOOLS, Scene

from splatsoil.experiment.base import candidate_of
from splatsoil.observation import Observation
from splatsoil.reconstruction import fill
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects, library
from splatsoil.synthetic import Setup

NOTHING, FIELD, CRUST = "nothing", "friction_field", "crust"
OUTSIDE = (FIELD, CRUST)
"""Kinds that no effect of the library is."""
KINDS = (
    *(NOTHING, "cohesion", "dilatancy", "viscosity", "tool_friction", "tool_adhesion", "tilt", "gravity", "layering"),
    *("buried_obstacle", "exposure", "time_offset", *OUTSIDE),
)
TIMES = (0.5, 8.0)
"""Sizes of effects, over the smallest meaningful one."""
STONE = 0.045
"""Largest radius of an obstacle, m."""
MIDDLE = (0.4, 0.25)
"""Of the bed, m; see `splatsoil.benchmarks._scenes`."""
BESIDE = 0.01
"""Between an obstacle and the tool that passes it, m."""
COVER = 0.015
"""Of soil on an obstacle, m, so that no photograph shows it."""


@dataclass(frozen=True)
class Hidden:
    """The truth of one synthetic experiment.

    Attributes:
        kind: name of the effect that is hidden, or one of the kinds without.
        number: of the experiment of its kind.
        scene: what is ploughed, but for what is hidden.
        values: the hidden parameters, the effect's size first: those of the library's effect by their names there;
            ``across`` is the change of the friction angle from the middle to a side, degrees, ``crust`` the cohesion,
            Pa, and ``crust_thickness``, m, of the topmost soil.
    """

    kind: str
    number: int
    scene: Scene
    values: Mapping[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Of its folders."""
        return f"{self.kind.replace(' ', '-')}-{self.number}"

    @property
    def angle(self) -> float:
        """Friction angle, degrees."""
        return self.scene.angle

    @property
    def effects(self) -> tuple[str, ...]:
        """The library's that is hidden, if it is one."""
        return (self.kind,) if self.kind in library() else ()

    def observation(self) -> Observation:
        """How the cameras err."""
        law = Law(find_effects(self.effects))
        return law.observation(law.require_on(self.values)) if self.effects else Observation()

    def soil(self, setup: Setup, spacing: float) -> Soil:
        """What the other solver ploughs, of particles so far apart; the library's effects in that solver's terms."""
        has, x = self.values, fill(setup.surface, setup.bed, spacing, seed=self.scene.seed)
        angle: float | FloatArray = self.angle
        cohesion: float | FloatArray = has.get("cohesion", 0.0)
        deep = setup.surface.sample(x[:, :2]) - x[:, 2]
        obstacle = None
        if "layer_friction" in has:
            angle = self.angle + np.where(deep > has["layer_depth"], has["layer_friction"], 0.0)
        if "across" in has:
            half = 0.5 * setup.bed.extents[1]
            angle = self.angle + has["across"] * (x[:, 1] - setup.bed.lower[1] - half) / half
        if "crust" in has:
            cohesion = np.where(deep < has["crust_thickness"], has["crust"], 0.0)
        if "obstacle_radius" in has:
            place = MIDDLE[0] + has["obstacle_x"], MIDDLE[1] + has["obstacle_y"], has["obstacle_height"]
            obstacle = (*place, has["obstacle_radius"])
            x = x[np.linalg.norm(x - place, axis=1) > has["obstacle_radius"]]
        lean, weight = np.radians(has.get("tilt_x", 0.0)), 9.81 * has.get("gravity_factor", 1.0)
        return Soil(
            setup.experiment(),
            angle,
            x,
            spacing,
            cohesion=cohesion,
            dilatancy=has.get("dilatancy_angle", 0.0) / self.angle,
            viscosity=has.get("viscosity", 0.0),
            tool_friction=setup.tool.friction + has.get("tool_friction_change", 0.0),
            tool_adhesion=has.get("tool_adhesion", 0.0),
            obstacle=obstacle,
            gravity=(weight * np.sin(lean), 0.0, -weight * np.cos(lean)),
        )


@dataclass(frozen=True)
class Stream:
    """Random numbers, and the range of effects' sizes over the smallest meaningful one."""

    rng: np.random.Generator
    times: tuple[float, float]

    def side(self) -> float:
        """Either sign."""
        return float(self.rng.choice([-1.0, 1.0]))

    def within(self, scene: Scene, least: float, most: float) -> Scene:
        """The same with an angle between these, and within the range of all, so that no soil leaves it."""
        return replace(scene, angle=float(self.rng.uniform(max(least, ANGLES[0]), min(most, ANGLES[1]))))

    def size(self, name: str) -> tuple[str, float]:
        """An effect's parameter and its value: log-uniform in the range of sizes, on either side of off where it has
        two, and at most what the model takes."""
        candidate = candidate_of(library()[name])
        assert candidate is not None
        times = float(np.exp(self.rng.uniform(*np.log(self.times))))
        return candidate.size, sized(candidate.measure, times if candidate.measure.sign else times * self.side())

    def hide(self, kind: str, scene: Scene) -> tuple[Scene, dict[str, float]]:
        """Hidden parameters of a kind, and the scene that suits them."""
        rng = self.rng
        match kind:
            case "nothing":
                return scene, {}
            case "friction_field":
                across = rng.uniform(6.0, 10.0) * self.side()
                return self.within(scene, ANGLES[0] + abs(across), ANGLES[1] - abs(across)), {"across": across}
            case "crust":
                return scene, {"crust": rng.uniform(500.0, 1500.0), "crust_thickness": rng.uniform(0.01, 0.02)}
        name, size = self.size(kind)
        match kind:
            case "dilatancy":  # associated flow is the most that any soil has
                size = min(size, scene.angle)
            case "gravity":
                size = max(size, 1.0 / 6.0)
            case "layering":
                depth = rng.uniform(0.02, 0.06)
                scene = self.within(scene, ANGLES[0] - min(size, 0.0), ANGLES[1] - max(size, 0.0))
                return scene, {name: size, "layer_depth": depth}
            case "buried_obstacle":
                return scene, self.obstacle(scene, min(size, STONE))
        return scene, {name: size}

    def obstacle(self, scene: Scene, radius: float) -> dict[str, float]:
        """A sphere beside the tool's way, or under it: it must not touch the tool."""
        rng = self.rng
        beside = bool(rng.integers(2))
        y = self.side() * (0.5 * scene.width + BESIDE + radius) if beside else rng.uniform(-0.03, 0.03)
        x = rng.uniform(0.32, 0.45)
        over = np.array([[x + s * radius, MIDDLE[1] + y + t * radius] for s in (-1, 0, 1) for t in (-1, 0, 1)])
        cover = COVER if beside else scene.depth + BESIDE
        z = min(0.06, float(scene.setup().surface.sample(over).min()) - cover - radius)
        return {"obstacle_radius": radius, "obstacle_x": x - MIDDLE[0], "obstacle_y": y, "obstacle_height": z}


def draw(kind: str, number: int, seed: int, times: tuple[float, float] = TIMES) -> Hidden:
    """A sealed truth; effects have sizes of so many ``times`` the smallest meaningful one."""
    rng = np.random.default_rng([seed, KINDS.index(kind), number])
    bed, tool = BEDS[int(rng.integers(len(BEDS)))], TOOLS[int(rng.integers(len(TOOLS)))]
    return Hidden(kind, number, *Stream(rng, times).hide(kind, _scenes.draw(rng, bed, tool)))
