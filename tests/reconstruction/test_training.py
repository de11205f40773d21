"""Training that goes wrong."""

from __future__ import annotations

import pytest
import torch

from splatsoil.errors import SimulationError
from splatsoil.reconstruction.training import _check


@pytest.mark.parametrize(("count", "lost"), [(5, 3), (10, 0), (14, 13), (14, 4), (37, 30)])
def test_the_first_loss_that_is_none_is_named(count: int, lost: int) -> None:
    """It is looked for every ten steps, and before Gaussians are dropped."""
    losses = [torch.tensor(0.1)] * count
    _check([])
    _check(losses)
    losses[lost:] = [torch.tensor(torch.nan)] * (count - lost)
    with pytest.raises(SimulationError, match=f"at step {lost}: the loss is nan; try another seed"):
        _check(losses)
