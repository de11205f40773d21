"""Batches of simulations that share a scene."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from threading import Event
from typing import Protocol

import numpy as np
import numpy.typing as npt

from splatsoil.errors import SimulationError
from splatsoil.measurement import Measurement
from splatsoil.mpm.presets import Resolution
from splatsoil.mpm.simulate import Trajectory, simulate
from splatsoil.soil.law import Law
from splatsoil.threads import cores

_BUILT: set[tuple[str, ...]] = set()
"""Combinations of effects whose kernels were built in this process."""


class World(Protocol):
    """Soil law, resolution, Warp device, and frames to record."""

    @property
    def law(self) -> Law: ...
    @property
    def resolution(self) -> Resolution: ...
    @property
    def device(self) -> str: ...
    @property
    def recorded(self) -> Sequence[int]: ...


def simulate_together(
    measurement: Measurement,
    particles: Sequence[npt.NDArray[np.floating]],
    values: Sequence[Mapping[str, float]],
    world: World,
    progress: Callable[[int, int], None] | None = None,
) -> list[Trajectory | SimulationError]:
    """Trajectories of simulations that share a scene: on a GPU one batch, on a CPU one thread for each core's share.

    Args:
        measurement: bed, tool and motion.
        particles: (n, 3) for each simulation; those with the same n go together.
        values: parameters by name for each.
        world: how they are computed.
        progress: called with (frame, last frame) of the first one.
    """
    out: list[Trajectory | SimulationError] = [SimulationError("not run")] * len(values)
    stopped = Event()

    def told(job: int, frame: int, last: int) -> None:
        if stopped.is_set():
            raise SimulationError("interrupted")
        if job == 0 and progress is not None:
            progress(frame, last)

    def run(rows: Sequence[int]) -> None:
        stack = np.stack([particles[k] for k in rows])
        try:
            found: Sequence[Trajectory | SimulationError] = simulate(
                measurement,
                stack,
                [values[k] for k in rows],
                law=world.law,
                resolution=world.resolution,
                frames=world.recorded,
                device=world.device,
                progress=partial(told, rows[0]),
            )
        except SimulationError as error:
            if len(rows) > 1:
                # One that fails takes its batch along: the others deserve a run of their own.
                for row in rows:
                    run([row])
                return
            found = [error]
        for row, trajectory in zip(rows, found, strict=True):
            out[row] = trajectory

    groups: dict[int, list[int]] = defaultdict(list)
    for k, x in enumerate(particles):
        groups[len(x)].append(k)
    if world.device != "cpu":
        for rows in groups.values():
            run(rows)
        return out
    # Warp's CPU kernels are serial and let other Python threads run meanwhile. The first simulation of a kind builds
    # its kernels, which is no work for two threads at once.
    singles = [k for rows in groups.values() for k in rows]
    kind = tuple(effect.name for effect in world.law.effects)
    if kind not in _BUILT:
        run([singles.pop(0)])
        _BUILT.add(kind)
    with ThreadPoolExecutor(cores()) as threads:
        try:
            list(threads.map(run, [[k] for k in singles]))
        except BaseException:
            stopped.set()  # whoever interrupts this doesn't want to wait for the others
            raise
    return out
