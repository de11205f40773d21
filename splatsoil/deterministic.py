"""Run-to-run equality on a GPU, for those who set SPLATSOIL_DETERMINISTIC=1 before this package is imported.

On a CPU the same seed gives the same bits always. On CUDA threads add to sums in whatever order they come, so the last
bits vary from run to run, and soil in motion makes much of them. Here Warp sorts such additions before it sums them
(``wp.config.deterministic``), torch takes those of its ways that keep an order, and the rasteriser's backward pass
gives every warp of a tile a place of its own. Helper processes inherit the variable. What it costs:
docs/performance.md.
"""

from __future__ import annotations

import os
import warnings

VARIABLE = "SPLATSOIL_DETERMINISTIC"


def wanted() -> bool:
    """Whether the user asks for run-to-run equality."""
    return os.environ.get(VARIABLE, "0") not in ("", "0")


def enforce() -> None:
    """Tell Warp and torch, before any kernel of ours is made."""
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # cuBLAS keeps an order with this only
    import torch
    import warp as wp

    wp.config.deterministic = wp.DeterministicMode.RUN_TO_RUN
    # Warnings, not errors: torch counts every backward of grid_sample among those without an order. Of ours only the
    # places have gradients, and each place sums its own.
    torch.use_deterministic_algorithms(True, warn_only=True)
    warnings.filterwarnings("ignore", message="grid_sampler_2d_backward_cuda")
