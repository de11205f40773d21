from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def analytic() -> ModuleType:
    """The problem with a known answer that the tests of ``inverse`` use."""
    path = Path(__file__).parents[1] / "inverse" / "analytic.py"
    spec = importlib.util.spec_from_file_location("analytic_problem", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
