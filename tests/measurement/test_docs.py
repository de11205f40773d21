"""What docs/measurement-set.md says is so."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from splatsoil.measurement import CAMERA_MODELS, FORMAT
from splatsoil.measurement.motion import MOTION_COLUMNS
from splatsoil.measurement.tool import FORCE_COLUMNS


@pytest.fixture(scope="module")
def page(repository: Path) -> str:
    return (repository / "docs" / "measurement-set.md").read_text(encoding="utf-8")


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page, flags=re.DOTALL)


def test_the_experiment_shown_is_plow_drys(page: str, plow_dry: Path) -> None:
    assert json.loads(blocks(page, "json")[0]) == json.loads((plow_dry / "experiment.json").read_text())


def test_headers_models_and_format_are_the_codes(page: str) -> None:
    assert f"\n{','.join(MOTION_COLUMNS)}\n" in page and f"\n{','.join(FORCE_COLUMNS)}\n" in page
    assert f'"{FORMAT}"' in page
    for model in CAMERA_MODELS:
        assert f"`{model}`" in page


def test_the_python_example_runs(page: str, repository: Path) -> None:
    code = blocks(page, "python")[0] + "print(image.shape, pixels.tolist(), depth.tolist(), position.tolist())"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=repository, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("(240, 320, 3)")
    numbers = [float(v) for v in re.findall(r"-?\d+\.\d+", done.stdout)]
    assert len(numbers) == 6 and np.isfinite(numbers).all()
