"""What a run was made on: hardware and versions."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from splatsoil.benchmarks._common import sources, stamp
from splatsoil.benchmarks._validation.costs import processor

from splatsoil.threads import cores

PACKAGES = ("numpy", "torch", "warp-lang", "newton", "taichi", "gsplat")


def versions() -> dict[str, str]:
    """Of the packages that are installed and that numbers hang on."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def memory() -> float:
    """Of the machine, GiB; 0 where the system doesn't tell."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return 0.0
    return next((int(line.split()[1]) / 2**20 for line in lines if line.startswith("MemTotal")), 0.0)


def load() -> float:
    """Programs that wanted a core in the last minute, on the average; 0 where the system doesn't tell."""
    try:
        return os.getloadavg()[0]
    except (AttributeError, OSError):
        return 0.0


def same(one: Mapping[str, str], other: Mapping[str, str]) -> bool:
    """Whether two descriptions are of one machine with one state of the code."""
    passing = {"made", "load"}
    return {k: v for k, v in one.items() if k not in passing} == {k: v for k, v in other.items() if k not in passing}


def describe(device: str) -> dict[str, str]:
    """The machine, its GPU if that is the device, and the versions."""
    made, own = stamp(device), sorted(Path(__file__).parent.glob("*.py"))
    told = {
        "made": str(made["made"]),
        "splatsoil": str(made["version"]),
        "code": sources(own),
        "device": device.split(":")[0],
        "processor": processor(),
        "cores": str(cores()),
        "memory": f"{memory():.0f} GiB",
        "load": f"{load():.1f}",
        "system": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
        **versions(),
    }
    if device != "cpu":
        import torch

        properties = torch.cuda.get_device_properties(device)
        told["gpu"] = f"{properties.name}, {properties.total_memory / 2**30:.0f} GiB"
        told["cuda"] = str(torch.version.cuda)
    return told


def sentence(told: dict[str, str]) -> str:
    """The same for a page."""
    gpu = f"{told['gpu']} (CUDA {told['cuda']}), " if "gpu" in told else ""
    packages = ", ".join(f"{name} {told[name]}" for name in PACKAGES if name in told)
    return (
        f"{gpu}{told['processor']}, {told['cores']} cores, {told['memory']}; {told['system']}; splatsoil "
        f"{told['splatsoil']} (code {told['code']}), {packages}. Load before: {told['load']}."
    )
