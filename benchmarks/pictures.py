"""Which soil do cameras see in another solver's particles, as ours reads it, and what of that is our numerics?

On a set's own bed, from its first particles, Newton's implicit MPM (extra ``independent``) ploughs soils that both
solvers know. Its particles and ours at the same parameters are drawn by one renderer, with the set's reconstruction, so
that neither photographs nor light have a part in what they differ by. That difference is read as one of the
parameters, for our solver as it is and with a piece of its numerics changed: 0 is what a solver should come to. A
fit's heights and slopes can say otherwise (:mod:`splatsoil.benchmarks.solvers`), as cameras look at rims and walls.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from splatsoil.benchmarks._common import here, output_options, stamp, write_result
from splatsoil.benchmarks._newton import Numerics, World, load_newton, plough
from splatsoil.benchmarks.numerics import Truth, variants

from splatsoil.commands._output import print_json
from splatsoil.errors import ParameterError, RunError
from splatsoil.experiment.forces import STAGE
from splatsoil.experiment.plow import PlowExperiment
from splatsoil.experiment.scene_parts import stages_of
from splatsoil.files import plain
from splatsoil.model import Model, Prediction
from splatsoil.mpm import Resolution, Trajectory, simulate_together
from splatsoil.quiet import hush
from splatsoil.reconstruction import Reconstruction, reconstruct
from splatsoil.reconstruction.progress import progress_bar
from splatsoil.soil.settings import FRICTION_ANGLE

FloatArray = npt.NDArray[np.float64]

SOILS: tuple[Mapping[str, float], ...] = (
    {"friction_angle": 31.0},
    {"friction_angle": 35.5},
    {"friction_angle": 40.0},
    {"friction_angle": 37.0, "cohesion": 400.0},
    {"friction_angle": 32.0, "cohesion": 450.0},
    {"friction_angle": 37.0, "viscosity": 100.0},
    {"friction_angle": 33.0, "viscosity": 140.0},
)
"""What is ploughed in each set's bed; degrees, Pa, Pa s."""
ANGLE = FRICTION_ANGLE.name
TURN, SHARE = 2.0, 0.3
"""Either way of the truth, in degrees and of a size, between which a reading takes features for linear."""
AS_IT_IS = "as it is"


@dataclass(frozen=True)
class Reading:
    """What another solver's soil looks like to ours.

    Attributes:
        soil: true parameters by name.
        numerics: what of ours was changed.
        off: by how much each is read too large; the angle in degrees, sizes over the true ones.
        chance: standard deviation of that by one particle seed.
        left: mean square of what features differ by at the truth, over chance and a grey level.
        force: along the tool's way while it pushes, ours over the other's.
    """

    soil: Mapping[str, float]
    numerics: str
    off: Mapping[str, float]
    chance: Mapping[str, float]
    left: float
    force: float


def amplitudes(
    difference: FloatArray, columns: FloatArray, weight: FloatArray, doubts: FloatArray | None = None
) -> FloatArray:
    """(k,) least squares of a difference (t, s) by columns (k, t, s), all times a weight (t, s).

    Columns that hold chance look as if they told more than they do, and read everything too small (regression
    dilution): ``doubts`` (n, k, t, s), whose squares' sum is that of the chance in them, are taken out of what they
    tell (Fuller 1987, Measurement Error Models, section 1.2).
    """
    flat = (columns * weight).reshape(len(columns), -1)
    chance = np.zeros((len(flat), len(flat)))
    for doubt in () if doubts is None else doubts:
        wrong = (doubt * weight).reshape(len(flat), -1)
        chance += wrong @ wrong.T
    values, vectors = np.linalg.eigh(flat @ flat.T - chance)
    informed = (vectors * np.maximum(values, 0.0)) @ vectors.T
    found = np.linalg.pinv(informed, hermitian=True) @ flat @ (difference * weight).ravel()
    return np.asarray(found, dtype=np.float64)


def ways(base: Resolution) -> dict[str, Resolution]:
    """Our solver as it is, and with a piece of its numerics changed."""
    return {AS_IT_IS: base, **variants(base)}


class Bench:
    """One set's bed, drawn by one renderer.

    Args:
        truth: the set.
        reconstruction: of its undisturbed bed.
        seeds: particle seeds that ours are averaged over, two at least.
        preset: of our solver.
        device: Warp device name.
    """

    def __init__(self, truth: Truth, reconstruction: Reconstruction, seeds: int, preset: str, device: str) -> None:
        frames = sorted(set(truth.particles) & {int(f) for f in truth.measurement.frames})
        self.truth, self.seeds, self.device = truth, range(seeds), device
        self.model = Model(truth.measurement, reconstruction, preset=preset, device=device, frames=frames)
        self.experiment = PlowExperiment(self.model)
        self.seen = self.experiment.seen & self.experiment.layout.common
        self._computed = {self.model.resolution: self.model}
        every = [float(frame) for frame in range(1, frames[-1] + 1)]
        self._pushing = np.array([stage == STAGE for stage in stages_of(truth.measurement, every)])

    def others(self, soils: Sequence[Mapping[str, float]], numerics: Numerics) -> list[tuple[FloatArray, float]]:
        """Features (t, s) of the other solver's soils, and the force along the tool's way while it pushes, N."""
        start, spacing = self.truth.particles[0], self.truth.volume ** (1.0 / 3.0)
        worlds = [
            World(
                str(k),
                self.truth.measurement,
                soil[ANGLE],
                start,
                spacing,
                cohesion=soil.get("cohesion", 0.0),
                viscosity=soil.get("viscosity", 0.0),
            )
            for k, soil in enumerate(soils)
        ]
        runs = plough(worlds, numerics, self.model.frames, self.device)
        return [(self.drawn({0: start, **run.particles}), self._force(run.force)) for run in runs]

    def drawn(self, particles: Mapping[int, FloatArray]) -> FloatArray:
        """(t, s) features of particles (n, 3) by frame, drawn as they lie."""
        frames = self.model.frames
        x = np.stack([particles[f] for f in frames]).astype(np.float32)
        still = np.broadcast_to(np.eye(3, dtype=np.float32), (*x.shape[:2], 3, 3))
        r = self.model.resolution
        trajectory = Trajectory(frames, x, still, np.zeros((frames[-1], 3)), r.spacing, r)
        return self._features(self.model.variant(scene=self.model.scene(0).with_particles(x[0])), trajectory, 0)

    def ours(self, values: Mapping[str, float], resolution: Resolution) -> tuple[FloatArray, float]:
        """(seeds, t, s) features at these parameters, and the force."""
        if resolution not in self._computed:
            self._computed[resolution] = self.model.variant(resolution=resolution)
        on = [name for name in values if name != ANGLE]
        model = self._computed[resolution].variant(effects=on, resolution=resolution)
        particles = [model.particles(seed) for seed in self.seeds]
        found = simulate_together(self.truth.measurement, particles, [values] * len(particles), model)
        for run in found:
            if not isinstance(run, Trajectory):
                raise run
        runs = [run for run in found if isinstance(run, Trajectory)]
        tables = [self._features(model, run, seed) for seed, run in zip(self.seeds, runs, strict=True)]
        return np.stack(tables), float(np.mean([self._force(run.force) for run in runs]))

    def read(self, soil: Mapping[str, float], other: tuple[FloatArray, float], changed: bool = True) -> list[Reading]:
        """What the other's soil is read as, by all numerics or by ours as they are."""
        base = self.model.resolution
        resolutions = ways(base) if changed else {AS_IT_IS: base}
        pairs = [self._either_way(soil, name) for name in soil]
        runs = {name: self.ours(soil, resolution) for name, resolution in resolutions.items()}
        spread = [runs[AS_IT_IS][0], *(table for pair in pairs for table in pair)]
        chance = np.mean([table.var(axis=0, ddof=1) for table in spread], axis=0)
        weight = np.sqrt(self.seen / (1.0 + chance))
        steps = [2.0 * (TURN if name == ANGLE else SHARE) for name in soil]
        slopes = np.stack([(high - low) / step for (low, high), step in zip(pairs, steps, strict=True)], axis=1)
        columns = slopes.mean(axis=0)
        doubts = (slopes - columns) / np.sqrt(len(slopes) * (len(slopes) - 1.0))
        out = []
        for name, (tables, force) in runs.items():
            each = np.array([amplitudes(other[0] - table, columns, weight, doubts) for table in tables])
            left = float(np.sum(((other[0] - tables.mean(axis=0)) * weight) ** 2) / np.count_nonzero(self.seen))
            off, scatter = each.mean(axis=0), each.std(axis=0, ddof=1)
            out.append(
                Reading(
                    soil,
                    name,
                    dict(zip(soil, map(float, off), strict=True)),
                    dict(zip(soil, map(float, scatter), strict=True)),
                    left,
                    force / other[1],
                )
            )
        return out

    def _either_way(self, soil: Mapping[str, float], name: str) -> tuple[FloatArray, FloatArray]:
        """(seeds, t, s) features below and above a parameter's true value."""
        way = TURN if name == ANGLE else SHARE * soil[name]
        low, high = (self.ours({**soil, name: soil[name] + d}, self.model.resolution)[0] for d in (-way, way))
        return low, high

    def _features(self, model: Model, trajectory: Trajectory, seed: int) -> FloatArray:
        return self.experiment.features(Prediction({}, seed, model.draw(trajectory, seed), trajectory, {}))

    def _force(self, force: FloatArray) -> float:
        return float(np.linalg.norm(force[self._pushing[: len(force)], :2].mean(axis=0)))


def table(readings: Sequence[Reading]) -> str:
    """The readings as Markdown: means over the soils of a kind."""
    kinds = list(dict.fromkeys(tuple(r.soil) for r in readings))
    lines = [
        "| soil | numerics | read too large: angle | size | left over chance | force over the other's |",
        "|---" * 6 + "|",
    ]
    for kind in kinds:
        for name in dict.fromkeys(r.numerics for r in readings):
            mine = [r for r in readings if tuple(r.soil) == kind and r.numerics == name]
            if not mine:
                continue
            angle = np.array([r.off[ANGLE] for r in mine])
            size = "" if len(kind) == 1 else f"{100 * np.mean([r.off[kind[1]] for r in mine]):+.0f} %"
            left, force = (float(np.mean([getattr(r, what) for r in mine])) for what in ("left", "force"))
            what = f"{'dry' if len(kind) == 1 else kind[1]}, {len(mine)}"
            spread = f" ± {angle.std(ddof=1):.1f}" if len(angle) > 1 else ""
            lines.append(f"| {what} | {name} | {angle.mean():+.1f}{spread}° | {size} | {left:.2f} | {force:.2f} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", type=Path, help="with truth.json and truth_particles.npz")
    parser.add_argument("--reconstructions", nargs="+", type=Path, help="of the sets, if there are some already")
    parser.add_argument("--seeds", type=int, default=4, help="particle seeds that ours are averaged over")
    parser.add_argument("--preset", default="small", help="of our solver")
    parser.add_argument("--as-it-is", action="store_true", help="leave out changed numerics")
    parser.add_argument(
        "--device", type=here, default="cpu", help="cuda:0; on a CPU each world takes ten minutes and more"
    )
    output_options(parser)
    options = parser.parse_args(arguments)
    if options.seeds < 2:
        raise ParameterError(f"--seeds {options.seeds}: two tell of chance, give at least so many")
    if options.reconstructions and len(options.reconstructions) != len(options.sets):
        raise ParameterError("--reconstructions: give one for each set, in their order")
    hush()
    try:
        newton = load_newton()
    except RunError as error:
        parser.error(str(error))
    readings: list[Reading] = []
    result: dict[str, Any] = {"newton": newton.__version__, "seeds": options.seeds, "made_by": stamp(options.device)}
    with progress_bar(quiet=options.json) as report:
        for k, folder in enumerate(options.sets):
            truth = Truth.load(folder)
            if options.reconstructions:
                found = Reconstruction.load(options.reconstructions[k])
            else:
                found = reconstruct(truth.measurement, device=options.device, progress=report)
            bench = Bench(truth, found, options.seeds, options.preset, options.device)
            others = bench.others(SOILS, Numerics.of(folder))
            for done, (soil, other) in enumerate(zip(SOILS, others, strict=True)):
                report(f"{folder.name}, read", done / len(SOILS))
                readings += bench.read(soil, other, changed=not options.as_it_is)
                result["readings"] = plain([asdict(r) for r in readings])
                if options.out:
                    write_result(options.out, result, table(readings), {})
    if options.json:
        print_json(result)
    else:
        print(table(readings))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
