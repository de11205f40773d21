"""Synthetic measurement sets: simulate, photograph, write."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from splatsoil import __version__
from splatsoil.devices import resolve_device
from splatsoil.errors import ParameterError
from splatsoil.files import check_folder
from splatsoil.measurement import Contents, Measurement, write_measurement
from splatsoil.mpm import Preset, Resolution, Trajectory, frames_around, simulate
from splatsoil.mpm.simulate import base_settings
from splatsoil.reconstruction.filling import fill
from splatsoil.soil.effect import Effect
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.synthetic.appearance import Appearance
from splatsoil.synthetic.recording import DEPTH_NOISE, GRID_NOISE, NOISE, Recorder
from splatsoil.synthetic.setups import Setup

Report = Callable[[str, float], None]

QUALITY = 96
"""Of JPEG files."""


@dataclass(frozen=True)
class World:
    """A world that has been made.

    Attributes:
        measurement: the set, as loaded from its folder.
        truth: what ``truth.json`` says.
        particles: their number.
        seconds: spent on simulation and on pictures.
    """

    measurement: Measurement
    truth: Mapping[str, Any]
    particles: int
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class Recipe:
    """What a synthetic set is made of, besides its setup.

    Attributes:
        friction_angle: degrees.
        effects: those that act, by name or from files that define some.
        values: their parameters by name; each effect needs one that differs from its off value.
        preset: resolution of the solver.
        seed: of looks, noise and, unless given, particles.
        particle_seed: of the particles' places. A model fills its bed by seeds 0, 1, 2 and so on; the default is none
            of them, so that no fit starts from the very particles of the world.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        heights: whether grids of heights are measured, too.
        depth_maps: whether the fixed cameras measure depths, too.
    """

    friction_angle: float = 35.0
    effects: Iterable[str | Effect] = ()
    values: Mapping[str, float] = field(default_factory=dict)
    preset: Preset | str = "small"
    seed: int = 0
    particle_seed: int | None = None
    device: str = "cpu"
    heights: bool = False
    depth_maps: bool = False


def make_set(out: str | Path, setup: Setup, recipe: Recipe, progress: Report = lambda what, share: None) -> World:
    """Make a synthetic measurement set with ``truth.json`` and ``truth_particles.npz``.

    Nothing is written before everything is computed; the folder then appears whole or not at all.

    Args:
        out: the set's folder; must not exist, or be empty.
        setup: bed, surface, tool, motion and cameras.
        recipe: soil, solver, seeds and instruments.
        progress: called with (what, share done).

    Raises:
        ParameterError: unknown or meaningless options, or a place that is taken.
        SimulationError: the simulation could not go on.
    """
    target, seed, particle_seed = Path(out), recipe.seed, recipe.particle_seed
    check_place(target)
    device = resolve_device(recipe.device)
    if seed < 0 or (particle_seed is not None and particle_seed < 0):
        raise ParameterError(f"seeds are whole numbers from 0 on, not {seed if seed < 0 else particle_seed}")
    experiment = setup.experiment()
    law = Law(effect.for_measurement(experiment) for effect in find_effects(recipe.effects))
    parameters = law.require_on({**recipe.values, "friction_angle": recipe.friction_angle})
    observation = law.observation(parameters)
    settings = law.settings(base_settings(experiment), parameters)
    resolution = Resolution.derive(experiment, recipe.preset)
    appearance = Appearance.drawn(seed)
    if particle_seed is None:
        particle_seed = int(np.random.default_rng([seed, 3]).integers(2**16, 2**31))
    particles = fill(setup.surface, setup.bed, resolution.spacing, seed=particle_seed)

    began = time.perf_counter()
    recorded = frames_around(setup.frames, observation.time_offset * setup.frame_rate)
    last = max(int(setup.tool.motion.frames[-1]), recorded[-1])
    trajectory = simulate(
        experiment,
        particles,
        parameters,
        law=law,
        resolution=resolution,
        frames={*recorded, last},
        device=device,
        progress=lambda frame, end: progress("sand", frame / max(end, 1)),
    )[0]
    simulated = time.perf_counter()
    truth: dict[str, Any] = {
        "made_by": f"splatsoil {__version__}",
        "parameters": parameters,
        "effects": [effect.name for effect in law.effects],
        "settings": {k: str(v) if k == "matching" else v for k, v in asdict(settings).items()},
        "seed": seed,
        "particle_seed": particle_seed,
        "particles": len(particles),
        "preset": recipe.preset if isinstance(recipe.preset, str) else recipe.preset.name,
        "resolution": asdict(resolution),
        "device": device,
        "appearance": asdict(appearance),
        "sensor_noise": NOISE,
        **({"height_noise": GRID_NOISE} if recipe.heights else {}),
        **({"depth_noise": DEPTH_NOISE} if recipe.depth_maps else {}),
    }
    recorder = Recorder(
        setup, trajectory, appearance, seed, device, observation, progress=lambda share: progress("pictures", share)
    )
    measurement = photograph_run(target, recorder, truth, heights=recipe.heights, depth_maps=recipe.depth_maps)
    seconds = {"simulation": simulated - began, "pictures": time.perf_counter() - simulated}
    return World(measurement, truth, len(particles), seconds)


def photograph_run(
    out: str | Path, recorder: Recorder, truth: Mapping[str, Any], *, heights: bool = False, depth_maps: bool = False
) -> Measurement:
    """Make a measurement set from a run of any simulator; the folder appears whole or not at all.

    Args:
        out: the set's folder; must not exist, or be empty.
        recorder: the run, and how it looks.
        truth: what ``truth.json`` is to say.
        heights: whether grids of heights are measured, too.
        depth_maps: whether the fixed cameras measure depths, too.

    Raises:
        ParameterError: a place that is taken.
        MeasurementError: one that cannot be written.
    """
    target, setup, trajectory = Path(out), recorder.setup, recorder.trajectory
    check_place(target)
    views, video = recorder.photographs()
    video = recorder.with_depth(video) if depth_maps else video
    frames = np.arange(1, len(trajectory.force) + 1)
    force = np.column_stack([frames, frames / setup.frame_rate, trajectory.force]) if len(frames) else None
    contents = Contents(
        name=target.resolve().name,
        bed=setup.bed,
        tool=replace(setup.tool, force=force),
        views=views,
        video=video,
        frame_rate=setup.frame_rate,
        gravity=setup.gravity,
        heights=recorder.heights() if heights else None,
    )
    return write_measurement(
        target,
        contents,
        quality=QUALITY,
        truth=truth,
        beside=lambda place: save_particles(place / "truth_particles.npz", trajectory, truth_frames(setup.frames)),
    )


def check_place(target: Path) -> None:
    """Raise ParameterError where something stands at ``target``, RunError unless a new folder can be made there."""
    if (target.is_dir() and any(target.iterdir())) or (target.exists() and not target.is_dir()):
        raise ParameterError(f"{target}: already there and not an empty folder; nothing is overwritten")
    check_folder(target)


def truth_frames(frames: tuple[int, ...]) -> tuple[int, ...]:
    """Video frames nearest to 0, 1/4, 1/2, 3/4 and 1 of the run."""
    numbers = np.array(frames)
    return tuple(
        sorted({int(numbers[np.abs(numbers - s * numbers[-1]).argmin()]) for s in (0.0, 0.25, 0.5, 0.75, 1.0)})
    )


def save_particles(path: Path, trajectory: Trajectory, frames: Iterable[int]) -> None:
    """Positions as ``fNNN`` (n, 3) uint16: times ``scale`` plus ``origin`` they are metres; with ``spacing``."""
    rows = {frame: k for k, frame in enumerate(trajectory.frames)}
    chosen = {frame: trajectory.positions[rows[frame]].astype(np.float64) for frame in frames}
    lowest = np.min([p.min(axis=0) for p in chosen.values()], axis=0)
    origin = np.minimum(np.floor(lowest * 100.0) / 100.0, 0.0)
    reach = max(float((p - origin).max()) for p in chosen.values())
    # 12.5 micrometres up to 0.82 m; coarser where the bed is larger.
    scale = 1.25e-5 * max(1, math.ceil(reach / (1.25e-5 * 65535)))
    arrays: dict[str, Any] = {
        f"f{frame:03d}": np.round((p - origin) / scale).astype(np.uint16) for frame, p in chosen.items()
    }
    np.savez_compressed(path, **arrays, scale=scale, origin=origin, spacing=trajectory.spacing)
