"""What a calibration looks at: drawn pictures, their derivatives, and how photographs and video differ from them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt
import trimesh
from scipy.ndimage import binary_dilation, gaussian_filter

from splatsoil.comparison import Comparator
from splatsoil.errors import ParameterError
from splatsoil.experiment.bands import Rows, misfit, rows_of, squares_of
from splatsoil.experiment.features import Site
from splatsoil.experiment.scene_parts import QUIET, regions_of
from splatsoil.measurement import Camera, Measurement
from splatsoil.model import Model
from splatsoil.mpm import Trajectory
from splatsoil.observation import Observation
from splatsoil.parameters import Parameter
from splatsoil.scene import Scene, ToolBody, silhouette
from splatsoil.soil.effect import Effect
from splatsoil.soil.library import library

FloatArray = npt.NDArray[np.float64]
BoolImage = npt.NDArray[np.bool_]
Pictures = dict[tuple[str, int], FloatArray]

STEP = 2.0
"""Of finite differences, in units of a parameter's meaningful change."""
VAGUE = 10.0
"""Standard deviation of what nothing tells, in units of a parameter's range."""
MOMENTS = 5
"""Frames, at most, in which the tool, or what it leaves alone, is looked at."""
CLEAR, AROUND = 0.01, 0.03
"""Height above all soil near the tool from which on it is looked at, and how far away soil is near it, m."""
EDGE, FEWEST = 5, 60
"""Pixels around the tool that count as its edges, and pixels that a look at it needs."""
BLUNT = 0.1
"""Pixels by which all edges of the tool may be drawn off together, beside what they tell of each other."""
UNEVEN = 0.001
"""Most that the tool may stray from an even motion around a frame that tells the clock, m."""
SHADE = 1.0 / 255.0
"""Change of a pixel (sRGB) by a step of the tool from which on it is left out before anything moves."""


class Bench:
    """Draws what calibrations look at. Values are distances from off; a blur's is its square, in which it is linear.

    Attributes:
        kinds: ``still``, ``tool`` or ``drift``: what tells each parameter.
        cameras: names of those whose pictures each parameter changes.
        poses: places of the parameters that move cameras.
        clocks: places of those that shift time.
        vague: (k,) standard deviation of each value where nothing tells it.
    """

    def __init__(
        self,
        model: Model,
        comparator: Comparator,
        parameters: Sequence[Parameter],
        trajectory: Trajectory,
        seed: int,
        scene: Scene,
    ) -> None:
        self.comparator, self.parameters, self.trajectory, self.seed = comparator, parameters, trajectory, seed
        names = {p.name for p in parameters}
        effects = {e.name: e for e in (*library().values(), *model.law.effects) if e.observes}
        self.effects = [e for e in effects.values() if names & {p.name for p in parameters_of(e, model.measurement)}]
        self.model = model.variant(effects=self.effects, frames=[comparator.reference], scene=scene)
        missing = names - {p.name for p in self.model.observation_parameters}
        if missing:
            raise ParameterError(f"no observation effect has {', '.join(sorted(missing))}")
        plain, changed = Observation(), [self.model.observation({p.name: _off(p) + _step(p)}) for p in parameters]
        self.squared = np.array([o.blur != plain.blur for o in changed])
        at_tool = [(o.tool_shift, o.tool_turn, o.time_offset) != (plain.tool_shift, 0.0, 0.0) for o in changed]
        kinds = zip(changed, at_tool, strict=True)
        self.kinds = ["drift" if o.drift != plain.drift else "tool" if t else "still" for o, t in kinds]
        views = {name: view.undistorted() for name, view in model.measurement.cameras.items()}
        own = [{c for i, (c, view) in enumerate(views.items()) if o.camera(view, i) is not view} for o in changed]
        self.cameras, self.poses = [c or set(views) for c in own], [k for k, c in enumerate(own) if c]
        self.clocks = [k for k, o in enumerate(changed) if o.time_offset != plain.time_offset]
        self.low, self.high = (np.array([getattr(p, e) - _off(p) for p in parameters]) for e in ("lower", "upper"))
        self.low, self.high = (np.where(self.squared, np.maximum(v, 0.0) ** 2, v) for v in (self.low, self.high))
        self.vague = VAGUE * (self.high - self.low)
        self._shade: dict[str, BoolImage] | None = None
        self._moments: list[int] | None = None

    def inside(self, value: FloatArray) -> FloatArray:
        """Values (k,), those beyond bounds moved to them."""
        return np.clip(value, self.low, self.high)

    def named(self, value: FloatArray) -> dict[str, float]:
        """Values (k,) by name, as the model takes them."""
        plain = np.where(self.squared, np.sqrt(np.maximum(value, 0.0)), value)
        return {p.name: float(_off(p) + v) for p, v in zip(self.parameters, plain, strict=True)}

    def reported(self, value: FloatArray, spread: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Estimate and covariance without squares: a root is as many deviations from 0 as its square is, beyond one."""
        root, deviation = np.sqrt(np.abs(value)), np.sqrt(np.diag(spread))
        factor = np.where(self.squared, 1.0 / np.maximum(root, np.sqrt(deviation)), 1.0)
        return np.where(self.squared, np.sign(value) * root, value), spread * np.outer(factor, factor)

    def draw(self, value: FloatArray, frames: Iterable[int]) -> Pictures:
        """Pictures (h, w, 3) by camera and frame."""
        self.model.frames = tuple(frames)
        drawn = self.model.draw(self.trajectory, self.seed, self.named(value))
        return {key: image.astype(np.float64) for key, image in drawn.items()}

    def slopes(self, value: FloatArray, wanted: Sequence[int], drawn: Pictures) -> dict[tuple[str, int], FloatArray]:
        """Derivatives (k, h, w, 3) of drawn pictures; parameters of different cameras share drawings."""
        out = {key: np.zeros((len(wanted), *image.shape)) for key, image in drawn.items()}
        groups: list[list[int]] = []
        for k in wanted:
            open_to = [g for g in groups if not any(self.cameras[k] & self.cameras[other] for other in g)]
            if open_to:
                open_to[0].append(k)
            else:
                groups.append([k])
        for group in groups:
            there = value.copy()
            for k in group:
                step = _step(self.parameters[k]) ** (2 if self.squared[k] else 1)
                there[k] += step if self.low[k] <= value[k] + step <= self.high[k] else -step
            for (camera, frame), image in self.draw(there, dict.fromkeys(f for _, f in drawn)).items():
                for k in group:
                    if camera in self.cameras[k]:
                        change = (image - drawn[camera, frame]) / (there[k] - value[k])
                        out[camera, frame][list(wanted).index(k)] = change
        return out

    def bed(self, value: FloatArray, wanted: Sequence[int]) -> list[Rows]:
        """The bed before anything moves, but for the tool and where its place changes the light."""
        seen, first, rows = self.comparator, self.comparator.reference, []
        drawn = self.draw(value, [first])
        if self._shade is None:
            tool = [k for k, kind in enumerate(self.kinds) if kind == "tool"]
            size = np.array([abs(_step(self.parameters[k])) for k in tool]).reshape(-1, 1, 1, 1)
            moved = self.slopes(value, tool, drawn)
            self._shade = {c: (abs(moved[c, first]) * size > SHADE).any(axis=(0, 3)) for c in seen.cameras}
        slopes = self.slopes(value, wanted, drawn)
        for camera in seen.cameras:
            tool = binary_dilation(seen.silhouettes[camera, first] | self._shade[camera], iterations=3)
            mask = seen.bed[camera] & ~tool
            residual = (seen.before[camera] - drawn[camera, first]).mean(axis=-1)
            rows.append(
                rows_of(residual, slopes[camera, first].mean(axis=-1), mask, squares_of(seen.ground[camera][mask]))
            )
        return rows

    def tool(self, value: FloatArray, wanted: Sequence[int]) -> list[Rows]:
        """The tool where it stands clear of the soil, and its edges, at a few moments."""
        seen, rows = self.comparator, []
        if self._moments is None:
            every = [f for f in (seen.reference, *seen.frames) if self._steady(f) and self._clear(value, f)]
            self._moments = [every[i] for i in _few(len(every))]
        drawn = self.draw(value, self._moments) if self._moments else {}
        slopes = self.slopes(value, wanted, drawn) if drawn else {}
        for number, frame in enumerate(self._moments):
            for camera, (tool, mask) in self._clear(value, frame).items():
                image, residual = drawn[camera, frame], seen.observed[camera, frame] - drawn[camera, frame]
                # The mixture of channels in which tool and soil differ most, in units of how the pictures do.
                apart = image[tool > 0.9].mean(axis=0) - image[mask & (tool < 0.1)].mean(axis=0)
                mixture = np.linalg.solve(np.cov(residual[mask].T) + 1e-6 * np.eye(3), apart)
                mixture /= np.linalg.norm(mixture)
                place = seen.cameras.index(camera)
                groups = np.array([[number * len(seen.cameras) + place], [number], [place]])
                groups = np.broadcast_to(groups, (3, int(mask.sum())))
                # How bright the tool is, and what is behind it, is not asked here.
                aside = (np.ones(mask.shape), tool)
                rows.append(rows_of(residual @ mixture, slopes[camera, frame] @ mixture, mask, groups, aside))
        return rows

    def tool_misfit(self, value: FloatArray) -> float:
        """How far the tool's pictures are off; 0 where it is never seen."""
        rows = self.tool(value, [])
        return misfit(rows) if rows else 0.0

    def early_and_late(self, value: FloatArray) -> list[FloatArray]:
        """Values (k,) with the clock right, early and late: a tool that is pixels away isn't found from its edges."""
        out = [value]
        for k in self.clocks:
            for share in (-2 / 3, -1 / 3, 1 / 3, 2 / 3):
                there = value.copy()
                there[k] = share * (self.high[k] if share > 0.0 else -self.low[k])
                out.append(there)
        return out

    def _steady(self, frame: int) -> bool:
        """Whether the tool moves evenly around a frame: where it starts or turns, early looks other than late."""
        reach = max((max(-self.low[k], self.high[k]) for k in self.clocks), default=0.0)
        middle = frame / self.model.measurement.frame_rate
        before, here, after = (
            self.model.measurement.tool.motion.matrix(middle + side * reach)[:3, 3] for side in (-1, 0, 1)
        )
        return bool(np.linalg.norm(before - 2.0 * here + after) < UNEVEN)

    def errors_of_edges(self, value: FloatArray, wanted: Sequence[int]) -> FloatArray:
        """(k,) squares of what moves the tool in pictures by as much as all its edges may be drawn off together."""

        def seen(at: FloatArray) -> FloatArray:
            pixels = []
            for frame in self._moments or []:
                corners, cameras = self._placed(at, frame)[:2]
                pixels += [camera.project(corners)[0] for camera in cameras.values()]
            return np.array(pixels)

        here, out = seen(value), np.zeros(len(wanted))
        for place, k in enumerate(wanted):
            there = value.copy()
            there[k] += (step := _step(self.parameters[k]))
            way = np.sqrt(np.nanmean(np.sum((seen(there) - here) ** 2, axis=-1)))
            out[place] = (BLUNT * step / max(float(way), 1e-9)) ** 2
        return out

    def _placed(self, value: FloatArray, frame: int) -> tuple[FloatArray, dict[str, Camera], float]:
        """The tool's corners (n, 3) at a frame, cameras by name, and the moment in frames that the frame shows."""
        measurement, seen = self.model.measurement, self.model.observation(self.named(value))
        moment = frame + seen.time_offset * measurement.frame_rate
        rotation, position = seen.tool(measurement.tool.motion.pose(moment / measurement.frame_rate))
        corners = np.asarray(measurement.tool.mesh.vertices) @ np.asarray(rotation).T + position
        views = enumerate(measurement.cameras.items())
        return corners, {name: seen.camera(view.undistorted(), i) for i, (name, view) in views}, moment

    def _clear(self, value: FloatArray, frame: int) -> dict[str, tuple[FloatArray, BoolImage]]:
        """Share of each pixel that the tool takes above all soil near it, and where it or its edges show, by camera."""
        corners, cameras, moment = self._placed(value, frame)
        soil, found = self.trajectory.at(moment)[0], {}
        low, high = corners.min(axis=0) - AROUND, corners.max(axis=0) + AROUND
        near = soil[np.all((soil > low)[:, :2] & (soil < high)[:, :2], axis=1), 2]
        level = np.array([0.0, 0.0, near.max(initial=-1e3) + CLEAR])
        for name, camera in cameras.items():
            shapes = []
            for up in (1.0, -1.0):
                part = trimesh.intersections.slice_faces_plane(
                    corners, self.model.measurement.tool.mesh.faces, np.array([0.0, 0.0, up]), level
                )
                body = ToolBody(trimesh.Trimesh(part[0], part[1], process=False) if len(part[1]) else None)
                shapes.append(silhouette(body.at(np.eye(3), np.zeros(3)), camera).numpy())
            share = gaussian_filter(shapes[0].astype(np.float64), 0.5)
            mask = binary_dilation(shapes[0], iterations=EDGE) & ~binary_dilation(shapes[1], iterations=2)
            if (
                name in self.comparator.cameras
                and min((mask & (share > 0.9)).sum(), (mask & (share < 0.1)).sum()) >= FEWEST
            ):
                found[name] = (share, mask)
        return found

    def quiet(self, value: FloatArray, wanted: Sequence[int]) -> list[Rows]:
        """How patches far from wherever the tool has been in the soil change from the first frame on."""
        seen, first, rows = self.comparator, self.comparator.reference, []
        frames = [seen.frames[i] for i in _few(len(seen.frames))]
        drawn = self.draw(value, [first, *frames])
        slopes = self.slopes(value, wanted, drawn)
        for number, camera in enumerate(seen.cameras):
            sites = [Site(camera, b.x, b.y) for b in seen.labels if (b.camera, b.frame) == (camera, seen.frames[0])]
            quiet = regions_of(self.model.measurement, self.model.reconstruction.surface, frames, sites) == QUIET
            before = seen.before[camera] - drawn[camera, first]
            for row, frame in enumerate(frames):
                mask = np.append(quiet[row], False)[seen.patches[camera]] & ~seen.silhouettes[camera, frame]
                change = (seen.observed[camera, frame] - drawn[camera, frame] - before).mean(axis=-1)
                squares = squares_of(seen.ground[camera][mask])
                ways = (row, 2 * row // len(frames), number)
                groups = np.stack([*squares, *(np.full_like(squares[0], way) for way in ways)])
                if mask.any():
                    by = slopes[camera, frame].mean(axis=-1)
                    # A change that comes with the tool and stays does not grow with time.
                    rows.append(rows_of(change, np.concatenate([by, by * frames[-1] / frame]), mask, groups))
        return rows


def parameters_of(effect: Effect, measurement: Measurement) -> tuple[Parameter, ...]:
    """An effect's parameters with a set's cameras."""
    return effect.for_measurement(measurement).parameters


def _off(parameter: Parameter) -> float:
    return parameter.default if parameter.off is None else parameter.off


def _step(parameter: Parameter) -> float:
    """How far a parameter is moved from its off value to see what it does."""
    step = STEP * parameter.meaningful or 0.02 * (parameter.upper - parameter.lower)
    return step if _off(parameter) + step <= parameter.upper else -step


def _few(count: int) -> list[int]:
    """Places, evenly spread over so many."""
    return sorted({round(i) for i in np.linspace(0, count - 1, min(MOMENTS, count))})
