"""From a setup and parameters to a measurement set: simulate, photograph, write."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from splatsoil import __version__
from splatsoil.errors import ParameterError
from splatsoil.files import check_folder
from splatsoil.measurement import Contents, Measurement, write_measurement
from splatsoil.mpm import Preset, Resolution, Trajectory, frames_around, simulate
from splatsoil.mpm.simulate import base_settings
from splatsoil.observation import Observation
from splatsoil.reconstruction.filling import fill
from splatsoil.soil.effect import Effect
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.synthetic.appearance import Appearance
from splatsoil.synthetic.pictures import NOISE, Photographer, Renderer
from splatsoil.synthetic.scanning import DEPTH_NOISE, GRID_NOISE, Scanner
from splatsoil.synthetic.setups import Setup
from splatsoil.synthetic.stage import Stage

FloatArray = npt.NDArray[np.float64]
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


def make_set(
    out: str | Path,
    setup: Setup,
    *,
    friction_angle: float = 35.0,
    effects: Iterable[str | Effect] = (),
    values: Mapping[str, float] | None = None,
    preset: Preset | str = "small",
    seed: int = 0,
    particle_seed: int | None = None,
    device: str = "cpu",
    appearance: Appearance | None = None,
    heights: bool = False,
    depth_maps: bool = False,
    progress: Report | None = None,
) -> World:
    """Make a synthetic measurement set with ``truth.json`` and ``truth_particles.npz``.

    Nothing is written before everything is computed; the folder then appears whole or not at all.

    Args:
        out: the set's folder; must not exist, or be empty.
        setup: bed, surface, tool, motion and cameras.
        friction_angle: degrees.
        effects: those that act, by name or from files that define some.
        values: their parameters by name; each effect needs one that differs from its off value.
        preset: resolution of the solver.
        seed: of looks, noise and, unless given, particles.
        particle_seed: of the particles' places. A model fills its bed by seeds 0, 1, 2 and so on; the default is none
            of them, so that no fit starts from the very particles of the world.
        device: ``auto``, ``cpu`` or ``cuda:N``.
        appearance: looks; drawn by seed by default.
        heights: whether grids of heights are measured, too.
        depth_maps: whether the fixed cameras measure depths, too.
        progress: called with (what, share done).

    Raises:
        ParameterError: unknown or meaningless options, or a place that is taken.
        SimulationError: the simulation could not go on.
    """
    report = progress or (lambda what, share: None)
    target = Path(out)
    check_place(target)
    device = check_device(device)
    if seed < 0 or (particle_seed is not None and particle_seed < 0):
        raise ParameterError(f"seeds are whole numbers from 0 on, not {seed if seed < 0 else particle_seed}")
    experiment = setup.experiment()
    law = Law(effect.for_measurement(experiment) for effect in find_effects(effects))
    parameters = law.require_on({**(values or {}), "friction_angle": friction_angle})
    observation = law.observation(parameters)
    settings = law.settings(base_settings(experiment), parameters)
    resolution = Resolution.derive(experiment, preset)
    look = appearance or Appearance.drawn(seed)
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
        progress=lambda frame, end: report("sand", frame / max(end, 1)),
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
        "preset": preset if isinstance(preset, str) else preset.name,
        "resolution": asdict(resolution),
        "device": device,
        "appearance": asdict(look),
        "sensor_noise": NOISE,
        **({"height_noise": GRID_NOISE} if heights else {}),
        **({"depth_noise": DEPTH_NOISE} if depth_maps else {}),
    }
    measurement = photograph_run(
        target,
        setup,
        trajectory,
        truth,
        appearance=look,
        observation=observation,
        seed=seed,
        device=device,
        heights=heights,
        depth_maps=depth_maps,
        progress=lambda share: report("pictures", share),
    )
    seconds = {"simulation": simulated - began, "pictures": time.perf_counter() - simulated}
    return World(measurement, truth, len(particles), seconds)


def photograph_run(
    out: str | Path,
    setup: Setup,
    trajectory: Trajectory,
    truth: Mapping[str, Any],
    *,
    appearance: Appearance,
    observation: Observation | None = None,
    seed: int = 0,
    device: str = "cpu",
    heights: bool = False,
    depth_maps: bool = False,
    progress: Callable[[float], None] = lambda share: None,
    renderer: Callable[..., Renderer] = Stage,
) -> Measurement:
    """Make a measurement set from a run of any simulator; the folder appears whole or not at all.

    Args:
        out: the set's folder; must not exist, or be empty.
        setup: bed, surface, tool, motion and cameras.
        trajectory: particles at all frames of the video; without force where it has none of any frame.
        truth: what ``truth.json`` is to say.
        appearance: looks.
        observation: how the cameras err; not at all by default.
        seed: of light paths and noise.
        device: Warp device name.
        heights: whether grids of heights are measured, too.
        depth_maps: whether the fixed cameras measure depths, too.
        progress: called with the share of the pictures that is done.
        renderer: makes what pictures are taken of, from `Stage`'s arguments.

    Raises:
        ParameterError: a place that is taken.
        MeasurementError: one that cannot be written.
    """
    target = Path(out)
    check_place(target)
    observation = observation or Observation()
    photographer = Photographer(setup, trajectory, appearance, seed, device, progress, observation, renderer)
    views, video = photographer.take()
    scanner = Scanner(setup, trajectory, seed, device, observation)
    video = scanner.with_depth(video) if depth_maps else video
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
        heights=scanner.heights() if heights else None,
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


def check_device(device: str) -> str:
    """A device that is there; ``auto`` is the first CUDA device or else the CPU."""
    wp.config.quiet = True
    wp.init()
    cuda = [str(d) for d in wp.get_cuda_devices()]
    if device == "auto":
        return cuda[0] if cuda else "cpu"
    if device not in ("cpu", *cuda):
        raise ParameterError(f"device {device!r} is not here; there are {', '.join(['auto', 'cpu', *cuda])}")
    return device


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
