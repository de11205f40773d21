"""What tests of ``inverse`` share."""

from __future__ import annotations

import pytest
import torch


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """Matrices of ten points: threads only get in one another's way."""
    torch.set_num_threads(1)
