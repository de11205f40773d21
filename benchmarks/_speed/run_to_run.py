"""What run-to-run equality costs on a GPU: the same work with and without it, each in a process of its own."""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from splatsoil.benchmarks._speed.clock import synchronise
from splatsoil.benchmarks._speed.pictures import kept_preset
from splatsoil.benchmarks._speed.rows import Group, Row, Sample
from splatsoil.benchmarks._speed.scenes import paper_scene, plough

from splatsoil import deterministic
from splatsoil.errors import SimulationError
from splatsoil.measurement import Measurement
from splatsoil.reconstruction import reconstruct


def compare(folder: Path, preset: str, device: str, repeats: int) -> Group:
    """A simulation and a reconstruction with the option and without it.

    Raises:
        SimulationError: a process failed.
    """
    free, ordered = (_measure(folder, preset, device, repeats, wanted) for wanted in (False, True))
    rows = [
        Row(
            f"{what}, run-to-run equal: {_same(ordered[key])}",
            "s",
            _sample(ordered[key]),
            _sample(free[key], "without"),
        )
        for key, what in (
            ("simulation", "the paper's scene" if device != "cpu" else f"a simulation of {folder.name}"),
            ("reconstruction", f"reconstruction of {folder.name}"),
        )
    ]
    apart = free["simulation"]["apart"]
    note = (
        f"`{deterministic.VARIABLE}=1`. Without it, two runs of the first row leave a particle {1e3 * apart:.2g} mm "
        "from where it was (root mean square)."
    )
    return Group("Run-to-run equality", tuple(rows), (note,))


def _same(found: dict[str, Any]) -> str:
    return "the same bits" if found["same"] else "NOT THE SAME BITS"


def _sample(found: dict[str, Any], label: str = "") -> Sample:
    return Sample(tuple(found["seconds"]), label)


def _measure(folder: Path, preset: str, device: str, repeats: int, wanted: bool) -> dict[str, Any]:
    words = [sys.executable, "-m", "splatsoil.benchmarks._speed.run_to_run", str(folder), preset, device, str(repeats)]
    environment = {**os.environ, deterministic.VARIABLE: str(int(wanted))}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SimulationError(f"with {deterministic.VARIABLE}={int(wanted)}: {' '.join(done.stderr.split())[-300:]}")
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def _repeated(task: Any, repeats: int, device: str) -> dict[str, Any]:
    """Seconds of each repetition after the first, whether all gave the same bits, and how far apart two were."""
    states, seconds = [], []
    for _ in range(repeats + 1):
        synchronise(device)
        began = time.perf_counter()
        states.append(task())
        synchronise(device)
        seconds.append(time.perf_counter() - began)
    same = all(np.array_equal(states[0], state) for state in states[1:])
    one, other = states[-2:]
    # where there are as many: reconstructions may end with more Gaussians or fewer
    apart = float(np.sqrt(np.square(one - other).sum(axis=1).mean())) if one.shape == other.shape else None
    return {"seconds": seconds[1:], "same": same, "apart": apart}


def main() -> None:
    """Measure in this process; one JSON object on stdout."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("preset")
    parser.add_argument("device")
    parser.add_argument("repeats", type=int)
    o = parser.parse_args()
    scene = paper_scene() if o.device != "cpu" else plough(o.folder, o.preset)
    measurement = Measurement.load(o.folder)

    def simulated() -> np.ndarray[Any, Any]:
        return scene.run(o.device)[0].positions[-1]

    def reconstructed() -> np.ndarray[Any, Any]:
        made = reconstruct(measurement, seed=0, device=o.device, preset=kept_preset(o.preset))
        return made.gaussians.means.detach().cpu().numpy()

    found = {
        "simulation": _repeated(simulated, o.repeats, o.device),
        "reconstruction": _repeated(reconstructed, 1, o.device),
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
