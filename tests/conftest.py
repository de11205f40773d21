"""Fixtures that all tests share: where the data lies, and small sets to spoil."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="session")
def repository() -> Path:
    """The source tree."""
    return REPOSITORY


@pytest.fixture(scope="session")
def plow_dry() -> Path:
    """The example set of dry sand, which no code here produced."""
    return REPOSITORY / "examples" / "plow-dry"


@pytest.fixture(scope="session")
def plow_damp() -> Path:
    """The example set of damp sand, which no code here produced."""
    return REPOSITORY / "examples" / "plow-damp"


@pytest.fixture(scope="session")
def measured_data() -> Path:
    """Real measurements, too large to ship, in the folder that $SPLATSOIL_MEASURED names."""
    folder = Path(os.environ.get("SPLATSOIL_MEASURED", "nowhere"))
    if not folder.is_dir():
        pytest.skip("SPLATSOIL_MEASURED names no folder of measured data")
    return folder


@pytest.fixture(scope="session")
def analytic() -> ModuleType:
    """A simulate-and-compare with a known answer."""
    spec = importlib.util.spec_from_file_location("analytic", REPOSITORY / "tests" / "inverse" / "analytic.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def imports() -> dict[str, set[str]]:
    """The package's modules by name, and those that each imports anywhere, for types alone aside."""
    files: dict[str, Path] = {}
    for package in ("splatsoil", "splatsoil.envs", "splatsoil.inverse", "splatsoil.benchmarks"):
        (root,) = importlib.util.find_spec(package).submodule_search_locations  # type: ignore[union-attr,misc]
        for file in Path(root).rglob("*.py"):
            parts = (package, *file.relative_to(root).with_suffix("").parts)
            files[".".join(parts).removesuffix(".__init__")] = file

    def imported(name: str, file: Path) -> Iterator[str]:
        nodes: list[ast.AST] = [ast.parse(file.read_text())]
        while nodes:
            node = nodes.pop()
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                package = name.split(".")[: -node.level if file.stem != "__init__" else 1 - node.level or None]
                base = ".".join((*(package if node.level else ()), *([node.module] if node.module else ())))
                yield from (base, *(f"{base}.{alias.name}" for alias in node.names))
            elif not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
                nodes += ast.iter_child_nodes(node)

    return {name: files.keys() & set(imported(name, file)) for name, file in files.items()}


@pytest.fixture
def small_set(plow_dry: Path, tmp_path: Path) -> Path:
    """A copy of plow-dry with 4 views, 2 cameras of 4 frames each (2 of them pre-roll) and 41 rows of motion."""
    folder = tmp_path / "small-set"
    (folder / "views" / "images").mkdir(parents=True)
    for name in ("experiment.json", "tool.stl"):
        shutil.copy(plow_dry / name, folder)
    for name in ("tool_motion.csv", "tool_force.csv"):
        lines = (plow_dry / name).read_text().splitlines()
        (folder / name).write_text("\n".join(lines[:42]) + "\n")
    views = json.loads((plow_dry / "views" / "transforms.json").read_text())
    views["frames"] = views["frames"][:4]
    video = json.loads((plow_dry / "video" / "transforms.json").read_text())
    video["frames"] = [f for f in video["frames"] if f["frame"] in (-2, -1, 0, 10)]
    for kind, data in (("views", views), ("video", video)):
        for frame in data["frames"]:
            target = folder / kind / frame["file_path"]
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(plow_dry / kind / frame["file_path"], target)
        (folder / kind / "transforms.json").write_text(json.dumps(data))
    return folder


@pytest.fixture(scope="session")
def fit_of() -> Callable[..., dict[str, Any]]:
    """Makes what ``fit.json`` holds of a model with some effects, by the sources as they are: a friction angle of
    35 ± 0.8° if no other is given, and other parameters by name."""
    from splatsoil import __version__
    from splatsoil.files import code_of

    def make(effects: Sequence[str] = (), friction_angle: float = 35.0, **others: float) -> dict[str, Any]:
        parameters, values = {}, {"friction_angle": friction_angle, **others}
        for name, value in values.items():
            about = {"std": 0.81, "at_bound": None, "off": None, "determined": True, "unit": "1", "title": name}
            ends = {"low": value - 1.6, "high": value + 1.5, "bounds": [value - 15.0, value + 15.0]}
            parameters[name] = {"estimate": value, **ends, **about}
        parameters["friction_angle"] |= {"unit": "deg", "title": "friction angle [°]"}
        tried = [(30.0, 31.0, ""), (40.0, 20.0, ""), (21.0, None, "particles left the grid")]
        curve = {"x": [20.0, 35.0, 50.0], "mean": [9.0, 0.1, 8.0], "std": [0.1] * 3}
        return {
            "format": "splatsoil-fit/2",
            "name": "+".join(sorted(effects)) or "base",
            "parameters": parameters,
            "minimum": {k: {n: p[n] for n in ("estimate", "low", "high")} for k, p in parameters.items()},
            "setup": {
                "effects": sorted(effects),
                "preset": "tiny",
                "device": "cpu",
                "version": __version__,
                "code": code_of(effects),
            },
            "history": [
                {
                    "step": step,
                    "seed": 7,
                    "parameters": dict.fromkeys(parameters, value),
                    "loss": loss,
                    "status": "failed" if message else "ok",
                    "message": message,
                    "seconds": 8.0,
                }
                for step, (value, loss, message) in enumerate(tried)
            ],
            "curves": dict.fromkeys(parameters, curve),
            "facts": {"cell": "20 mm", "time step": "0.25 ms"},
            "loss": 0.123,
            "loss_std": 0.01,
            "noise_std": 0.02,
            "best": {"loss": 0.12},
            "estimated_from": "loss",
            "evaluations": 3,
            "failed": 1,
            "seconds": 83.0,
            "notes": [],
            "preset": "small",
            "device": "cpu",
            "seed": 5,
            "version": "0.1.0",
        }

    return make


@pytest.fixture
def run(tmp_path: Path, fit_of: Callable[..., dict[str, Any]]) -> Any:
    """A run folder with a finished fit, which nothing was simulated for; a shell would split its name."""
    from splatsoil.inverse.run_folder import RunFolder

    measurement = {"name": "plow", "folder": str(tmp_path / "my set"), "hash": "a" * 64}
    made = RunFolder.prepare(tmp_path / "my run", measurement=measurement, preset="tiny", seed=0, version="1")
    made.write_fit("base", fit_of())
    return made


@pytest.fixture(scope="session")
def over_level_soil() -> Callable[..., Any]:
    """Makes a model at the preset tiny: of a measurement, over soil level at a height (m), with some effects."""
    from types import SimpleNamespace

    import numpy as np

    from splatsoil.model import Model
    from splatsoil.reconstruction import HeightField

    def make(measurement: Any, height: float, *effects: str) -> Model:
        surface = HeightField.over(measurement.bed.lower, measurement.bed.upper, 0.02, height)
        seen = SimpleNamespace(surface=surface, soil=np.ones(1, dtype=bool), standing=None)
        return Model(measurement, seen, effects=effects, preset="tiny")  # type: ignore[arg-type]

    return make


@pytest.fixture(scope="session")
def spotted() -> Callable[..., Any]:
    """Makes a scene: level soil of given particles with spots every 8 mm, under a steep sun."""
    import numpy as np
    import torch

    from splatsoil.scene import Light, Scene, ToolBody, encoded, relief_of_particles
    from splatsoil.splats import Gaussians

    def make(still: Any, spacing: float, bed: Any, spot: float, tool: Any) -> Scene:
        """Of particles (n, 3), their spacing, the bed, the spots' radius (all in m) and the tool's mesh."""
        particles = torch.from_numpy(still)
        relief = relief_of_particles(particles, spacing, bed.lower, bed.upper)
        axis = torch.arange(0.004, float(bed.upper[0]), 0.008)
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        flat = torch.stack([x.reshape(-1), y.reshape(-1)], dim=1)
        centres = torch.cat([flat, relief.sample(relief.height, flat)[:, None]], dim=1)
        shade = 0.3 + 0.3 * torch.rand(len(centres), 1, generator=torch.Generator().manual_seed(0))
        soil = Gaussians.discs(centres, spot, 0.001, 0.95, encoded(shade * torch.tensor([1.0, 0.8, 0.6])))
        return Scene.of(
            soil,
            particles,
            spacing,
            grain_albedo=encoded(torch.tensor([0.45, 0.36, 0.27])).expand(len(particles), 3).contiguous(),
            light=Light.from_angles(180.0, 60.0, [0.4, 0.5, 0.6]),
            tool=ToolBody(tool),
            tool_albedo=np.array([0.05, 0.1, 0.9]),
            bed=bed,
            background=np.zeros(3),
        )

    return make
