from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch


@pytest.fixture(scope="session")
def analytic() -> ModuleType:
    """The module beside this file, which is also a script."""
    spec = importlib.util.spec_from_file_location("analytic_problem", Path(__file__).with_name("analytic.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """Matrices of ten points: threads only get in one another's way."""
    torch.set_num_threads(1)
