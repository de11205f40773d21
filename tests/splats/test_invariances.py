"""What must not change the picture, or change it in a known way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splatsoil.measurement import Camera
from splatsoil.splats import Gaussians, rasterise

CameraMaker = Callable[..., Camera]
CloudMaker = Callable[..., Gaussians]

POSE = np.diag([1.0, -1.0, -1.0, 1.0])


def assert_same_picture(a: torch.Tensor, b: torch.Tensor, pixels: float = 0.0) -> None:
    """Equal but for rounding, which may also move a pixel across the 1/255 step: a share of ``pixels`` may differ."""
    wrong = (a - b).abs() > 2e-5
    assert float(wrong.double().mean()) <= pixels
    assert float((a - b).abs().max()) < 2 / 255


def test_order_of_the_input(camera_at: CameraMaker, cloud: CloudMaker) -> None:
    g = cloud(300)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(0))
    shuffled = rasterise(g[order], camera_at())
    plain = rasterise(g, camera_at())
    assert torch.equal(shuffled.colour, plain.colour)
    assert torch.equal(shuffled.depth, plain.depth)


@pytest.mark.parametrize(("x0", "y0"), [(0, 0), (16, 16), (3, 7), (21, 13)])
def test_crop_and_tile_grid(x0: int, y0: int, camera_at: CameraMaker, cloud: CloudMaker) -> None:
    """A crop with its off-centre principal point is the crop of the picture; odd offsets move the tiles' grid."""
    g = cloud(300, sigma=3.0)
    camera = camera_at(width=80, height=64)
    whole = rasterise(g, camera)
    part = rasterise(g, camera.cropped(x0, y0, 37, 29))
    for name in ("colour", "alpha", "depth"):
        full = getattr(whole, name)[y0 : y0 + 29, x0 : x0 + 37]
        assert_same_picture(getattr(part, name), full, pixels=2e-3)


def test_rigid_motion_of_scene_and_camera(camera_at: CameraMaker, cloud: CloudMaker) -> None:
    g = cloud(200)
    turn, shift = Rotation.from_euler("xyz", [0.4, -1.1, 2.0]), np.array([0.3, -2.0, 0.7])
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn.as_matrix(), shift
    own = Rotation.from_quat(g.quaternions.double().numpy()[:, [1, 2, 3, 0]])
    moved = g.replace(
        means=(g.means.double() @ torch.from_numpy(turn.as_matrix()).T + torch.from_numpy(shift)).float(),
        quaternions=torch.from_numpy((turn * own).as_quat()[:, [3, 0, 1, 2]]).float(),
    )
    before = rasterise(g, camera_at())
    after = rasterise(moved, camera_at(camera_to_world=motion @ POSE))
    assert_same_picture(after.colour, before.colour, pixels=2e-3)
    assert_same_picture(after.depth, before.depth, pixels=2e-3)


def test_length_of_quaternions(camera_at: CameraMaker, cloud: CloudMaker) -> None:
    g = cloud(100)
    lengths = torch.rand(100, 1, generator=torch.Generator().manual_seed(3)) * 5 + 0.1
    longer = rasterise(g.replace(quaternions=-g.quaternions * lengths), camera_at())
    assert_same_picture(longer.colour, rasterise(g, camera_at()).colour, pixels=2e-3)


def test_a_subset_is_one_of_every_tensor(cloud: CloudMaker) -> None:
    g = cloud(10)
    chosen = torch.arange(10) % 3 == 0
    for subset, numbers in ((g[:4], range(4)), (g[torch.tensor([7, 2])], (7, 2)), (g[chosen], (0, 3, 6, 9))):
        for field in fields(Gaussians):
            assert torch.equal(getattr(subset, field.name), torch.stack([getattr(g, field.name)[k] for k in numbers]))
