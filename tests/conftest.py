"""Fixtures that all tests share: where the data lies, and small sets to spoil."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

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
