"""Memory and time of a run, told from the set before work begins."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from splatsoil.errors import ParameterError

if TYPE_CHECKING:
    from splatsoil.measurement import Measurement

#: Bytes of a particle and its part of the grid (docs/performance.md), and of each frame that is drawn: its position and
#: deformation.
PARTICLE, FRAME = 275, 48
#: Bytes of a pixel: red, green and blue in single precision.
PIXEL = 12
#: Of a video frame as many pictures are held at once: observed, predicted, and what they are compared in.
PICTURES = 6
#: GiB that a process takes before it knows of any set: Python, torch, Warp, compiled kernels.
PROGRAM = 1.0
#: Particle substeps a second: one core of the processor, and the GPU, of docs/performance.md.
RATE = {"cpu": 1.2e8, "cuda": 2.7e9}
#: Simulations of a comparison beside the search's, of the model as it is.
COMPARISON = 20


@dataclass(frozen=True)
class Needs:
    """What a fit takes.

    Attributes:
        particles: in one simulation.
        memory: GiB in this process.
        simulation: GiB of it that lie where it is simulated.
        seconds: of one simulation, about.
        simulations: about how many there will be.
    """

    particles: int
    memory: float
    simulation: float
    seconds: float
    simulations: int

    def sentence(self, device: str) -> str:
        """The needs in one line, where the soil isn't known yet."""
        from splatsoil.report.text import duration

        return (
            f"needs up to {self.memory:.2g} of {memory():.2g} GiB of memory and {duration(self.seconds)} a simulation "
            f"({self.particles} particles, {device}), {self.simulations} simulations"
        )


def needs(measurement: Measurement, preset: str, device: str, simulations: int, particles: int | None = None) -> Needs:
    """What a fit takes.

    Args:
        measurement: the set.
        preset: of the solver and the reconstruction.
        device: ``cpu`` or ``cuda:N``.
        simulations: about how many there will be.
        particles: of the soil; those of a bed that is full to its top if not given.
    """
    from splatsoil.mpm import Resolution
    from splatsoil.reconstruction.presets import preset_named

    resolution = Resolution.derive(measurement, preset)
    count = particles or int(measurement.bed.domain.extents.prod() / resolution.spacing**3)
    side = preset_named(preset).longest_side
    views = [_pixels(f.camera.width, f.camera.height, side) for f in measurement.views]
    video = sum(f.camera.width * f.camera.height for f in measurement.video)
    pictures = PIXEL * (PICTURES * video + sum(views)) / 2**30
    simulation = count * (PARTICLE + FRAME * len(measurement.frames)) / 2**30
    substeps = resolution.steps * resolution.substeps(resolution.steps)
    work = count * substeps * max(measurement.frames, default=0)
    return Needs(
        particles=count,
        memory=PROGRAM + pictures + (simulation if device == "cpu" else 0.0),
        simulation=simulation,
        seconds=work / RATE[device.split(":")[0]],
        simulations=simulations,
    )


def check_memory(need: Needs, device: str, file: Path) -> None:
    """See that the memory there is can hold a simulation.

    Raises:
        ParameterError: it can't.
    """
    places = [("this machine", need.memory, memory())]
    if device != "cpu":
        places.append((device, need.simulation, on_device(device)))
    for where, wanted, there in places:
        if wanted > there:
            raise ParameterError(
                f"{file}: {need.particles} particles, and the pictures, need {wanted:.3g} GiB of memory, and {where} "
                f"has {there:.3g} GiB; choose a coarser --preset, fewer frames, or a larger machine"
            )


def _pixels(width: int, height: int, side: int) -> float:
    """Of a photograph that is shrunk to its longest side."""
    shrunk = min(1.0, side / max(width, height))
    return width * height * shrunk**2


def memory() -> float:
    """What this process may use of the machine's memory, GiB: all, or as much as its control group has."""
    there = [float("inf")]
    with suppress(AttributeError, ValueError, OSError):  # not every system tells
        there.append(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30)
    for limit in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with suppress(OSError, ValueError):  # no control group, or "max"
            there.append(int(Path(limit).read_text()) / 2**30)
    return min(there)


def on_device(device: str) -> float:
    """A GPU's memory, GiB."""
    import torch

    return float(torch.cuda.mem_get_info(device)[1]) / 2**30
