"""The solver on CUDA against the solver on the CPU."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from splatsoil import deterministic
from splatsoil.mpm import Resolution, Solver
from splatsoil.mpm.tool import Pose
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects
from splatsoil.soil.settings import Settings

LOWER, UPPER = np.zeros(3), np.array([0.4, 0.2, 0.2])


def plow(device: str, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (2, n, 3) and mean force (frames, 2, 3) of a plate pushed through a dry and a damp bed."""
    resolution = Resolution(
        cell=0.02, spacing=0.01, frame_time=0.02, steps=2, courant=0.5, bulk=4.2e5, shear=1.9e5, density=1600.0
    )
    axes = [np.arange(0.005, high, 0.01) for high in (0.4, 0.2, 0.1)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    x += np.random.default_rng(0).uniform(-0.003, 0.003, x.shape)
    solver = Solver(
        np.stack([x, x]),
        LOWER,
        UPPER,
        trimesh.creation.box(extents=[0.012, 0.08, 0.08]),
        resolution,
        Law(find_effects(["cohesion"])),
        Settings(friction_angle=35.0),
        [{"friction_angle": 35.0}, {"friction_angle": 30.0, "cohesion": 400.0}],
        device,
    )
    speed = np.array([0.3, 0.0, 0.0])
    forces = []
    for frame in range(frames):
        start = [np.array([0.1, 0.1, 0.09]) + (frame + k / 2) * 0.02 * speed for k in range(2)]
        forces.append(solver.advance([Pose(s, np.array([0.0, 0.0, 0.0, 1.0]), speed, np.zeros(3)) for s in start]))
    return solver.positions(), np.array(forces)


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_agrees_with_the_cpu() -> None:
    """Grain by grain at first; later, when the order of sums has made chance of it, in the mean."""
    few = [plow(device, 3)[0] for device in ("cpu", "cuda:0")]
    assert np.abs(few[0] - few[1]).max() < 1e-4
    (here, force_here), (there, force_there) = (plow(device, 25) for device in ("cpu", "cuda:0"))
    moved = np.linalg.norm(here - there, axis=2)
    assert np.median(moved) < 5e-4
    np.testing.assert_allclose(here.mean(axis=1), there.mean(axis=1), atol=3e-4)
    np.testing.assert_allclose(force_here[10:, :, 0].mean(axis=0), force_there[10:, :, 0].mean(axis=0), rtol=0.03)


def in_fresh_process(code: str, device: str) -> subprocess.CompletedProcess[str]:
    """Run code where run-to-run equality is asked for, beside this file."""
    words = [sys.executable, "-c", f"from test_cuda import plow\nDEVICE = {device!r}\n{code}"]
    environment = {**os.environ, deterministic.VARIABLE: "1"}
    return subprocess.run(
        words, cwd=Path(__file__).parent, env=environment, capture_output=True, text=True, check=False
    )


def test_with_run_to_run_equality_kernels_compile_for_cuda() -> None:
    """Warp refuses kernels whose additions it can't put in order; its compiler needs no GPU."""
    done = in_fresh_process(
        """
import tempfile
import warp as wp
from splatsoil.mpm import substep, transfer
from splatsoil.scene import kernels_relief
from splatsoil.soil.law import Law

assert wp.config.deterministic == wp.DeterministicMode.RUN_TO_RUN
wp.init()
stress = substep.make_stress_kernel(Law().update, True)
for module in (transfer, substep, stress.module, kernels_relief):
    (artifact,) = wp.compile_aot_module(module, arch=90, module_dir=tempfile.mkdtemp(), use_ptx=True)
    # additions take a place in a list, which is then sorted, by compare and swap; ours have none of their own
    assert "atom.global.cas" in open(artifact).read(), "nothing is put in order"
""",
        "cpu",
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_with_run_to_run_equality_cuda_gives_the_same_bits() -> None:
    done = in_fresh_process(
        """
import numpy as np
import torch
from splatsoil.measurement import Camera
from splatsoil.splats import Gaussians, rasterise

(one, pull), (other, same_pull) = (plow(DEVICE, 25) for _ in range(2))
assert np.array_equal(one, other) and np.array_equal(pull, same_pull)

random = torch.Generator().manual_seed(0)
def rand(*shape):
    return torch.rand(*shape, generator=random)
count = 2000
made = [3.0 * rand(count, 3) - 1.5 + torch.tensor([0, 0, 4.0]), 0.05 + 0.1 * rand(count, 3), rand(count, 4) - 0.5]
made += [0.1 + 0.5 * rand(count), rand(count, 3)]
camera = Camera(96, 80, 60.0, 60.0, 48.0, 40.0, np.diag([1.0, -1.0, -1.0, 1.0]))
weight = rand(80, 96, 3).to(DEVICE)
def gradients():
    leaves = [t.to(DEVICE).requires_grad_() for t in made]
    return torch.autograd.grad((weight * rasterise(Gaussians(*leaves), camera).colour).sum(), leaves)
for _ in range(5):
    assert all(torch.equal(a, b) for a, b in zip(gradients(), gradients(), strict=True))
assert gradients()[0].abs().sum() > 0
""",
        "cuda:0",
    )
    assert done.returncode == 0, done.stderr
