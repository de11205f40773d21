"""Estimates of a run's memory and time from its measurement set."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from splatsoil.errors import ParameterError
from splatsoil.report.text import duration

if TYPE_CHECKING:
    from splatsoil.measurement import Measurement

#: Bytes of a particle and its part of the grid (docs/performance.md), and of its recorded state in each frame.
PARTICLE, FRAME = 275, 48
#: Bytes of a pixel: red, green and blue in single precision.
PIXEL = 12
#: Copies of a video frame in memory: observed, predicted, and temporary ones.
PICTURES = 6
#: Memory of a process without data, GiB: Python, torch, Warp, compiled kernels.
PROGRAM = 1.0
#: Particle substeps per second of one CPU core and of the GPU in docs/performance.md.
RATE = {"cpu": 1.2e8, "cuda": 2.7e9}
#: Simulations of a comparison besides those of the search.
COMPARISON = 20
#: Seconds of a year: a run that takes longer is a mistake.
YEAR = 365 * 86400


@dataclass(frozen=True)
class Needs:
    """Resources of a fit.

    Attributes:
        particles: in one simulation.
        memory: of this process, GiB.
        simulation: of a simulation on its device, GiB.
        seconds: of one simulation.
        simulations: number of them.
    """

    particles: int
    memory: float
    simulation: float
    seconds: float
    simulations: int

    def sentence(self, device: str) -> str:
        """The needs in one line, for an unknown amount of soil."""
        return (
            f"needs up to {self.memory:.2g} of {memory():.2g} GiB of memory and {duration(self.seconds)} a simulation "
            f"({self.particles} particles, {device}), {self.simulations} simulations, "
            f"{duration(self.seconds * self.simulations)} in all"
        )


def needs(measurement: Measurement, preset: str, device: str, simulations: int, particles: int | None = None) -> Needs:
    """Estimate the resources of a fit.

    Args:
        measurement: the set.
        preset: of the solver and the reconstruction.
        device: ``cpu`` or ``cuda:N``.
        simulations: number of them.
        particles: of the soil; those of a full bed if not given.
    """
    from splatsoil.mpm import Resolution
    from splatsoil.reconstruction.presets import preset_named

    resolution = Resolution.derive(measurement, preset)
    count = particles or int(measurement.bed.domain.extents.prod() / resolution.spacing**3)
    side = preset_named(preset).longest_side
    cameras = [f.camera for f in measurement.views]
    views = sum(c.width * c.height * min(1.0, side / max(c.width, c.height)) ** 2 for c in cameras)  # shrunk
    video = sum(f.camera.width * f.camera.height for f in measurement.video)
    simulation = count * (PARTICLE + FRAME * len(measurement.frames)) / 2**30
    substeps = resolution.steps * resolution.substeps(resolution.steps)
    return Needs(
        particles=count,
        memory=PROGRAM + PIXEL * (PICTURES * video + views) / 2**30 + (simulation if device == "cpu" else 0.0),
        simulation=simulation,
        seconds=count * substeps * max(measurement.frames, default=0) / RATE[device.split(":")[0]],
        simulations=simulations,
    )


def check_time(need: Needs, device: str, measurement: Measurement) -> None:
    """Check that the run ends within a year.

    Raises:
        ParameterError: it does not.
    """
    if need.seconds * need.simulations > YEAR:
        raise ParameterError(
            f"{measurement.folder}: {need.simulations} simulations to frame {max(measurement.frames)} take"
            f" {duration(need.seconds)} each on {device} ({need.particles} particles); leave out late frames of the"
            " video, or choose a coarser --preset"
        )


def check_memory(need: Needs, device: str, file: Path) -> None:
    """Check that the memory suffices.

    Raises:
        ParameterError: it does not.
    """
    places = [("this machine", need.memory, memory())]
    if device != "cpu":
        places.append((device, need.simulation, gpu_memory(device)[1]))
    for where, wanted, there in places:
        if wanted > there:
            raise ParameterError(
                f"{file}: {need.particles} particles, and the pictures, need {wanted:.3g} GiB of memory, and {where} "
                f"has {there:.3g} GiB; choose a coarser --preset, fewer frames, or a larger machine"
            )


def memory() -> float:
    """Memory available to this process, GiB: of the machine, or of its control group."""
    there = [float("inf")]
    with suppress(AttributeError, ValueError, OSError):  # not on every system
        there.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30)
    for limit in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with suppress(OSError, ValueError):  # no control group, or "max"
            there.append(int(Path(limit).read_text()) / 2**30)
    return min(there)


def gpu_memory(device: str) -> tuple[float, float]:
    """Free and total memory of a GPU, GiB."""
    import torch

    free, whole = torch.cuda.mem_get_info(device)
    return free / 2**30, whole / 2**30
