"""The .ply layout, against the published property list and against numbers worked out by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from splatsoil.errors import MeasurementError
from splatsoil.splats import Gaussians, load_ply, save_ply

LAYOUT = (
    ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    + [f"f_rest_{i}" for i in range(45)]
    + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
)


@pytest.fixture
def gaussians() -> Gaussians:
    g = torch.Generator().manual_seed(1)
    return Gaussians(
        means=torch.randn(7, 3, generator=g),
        scales=torch.rand(7, 3, generator=g) * 0.1 + 1e-3,
        quaternions=torch.randn(7, 4, generator=g),
        opacities=torch.rand(7, generator=g) * 0.9 + 0.05,
        colours=torch.rand(7, 3, generator=g),
    )


def test_layout_is_the_published_one(tmp_path: Path, gaussians: Gaussians) -> None:
    save_ply(tmp_path / "g.ply", gaussians)
    header, body = (tmp_path / "g.ply").read_bytes().split(b"end_header\n", 1)
    expected = ["ply", "format binary_little_endian 1.0", "element vertex 7", *(f"property float {n}" for n in LAYOUT)]
    assert header.decode().split("\n")[:-1] == expected
    table = np.frombuffer(body, "<f4").reshape(7, 62)
    np.testing.assert_array_equal(table[:, :3], gaussians.means.numpy())
    np.testing.assert_array_equal(table[:, 3:6], 0)
    np.testing.assert_array_equal(table[:, 9:54], 0)
    np.testing.assert_allclose(1 / (1 + np.exp(-table[:, 54])), gaussians.opacities.numpy(), rtol=1e-5)
    np.testing.assert_allclose(np.exp(table[:, 55:58]), gaussians.scales.numpy(), rtol=1e-5)


def test_round_trip(tmp_path: Path, gaussians: Gaussians) -> None:
    save_ply(tmp_path / "g.ply", gaussians)
    again = load_ply(tmp_path / "g.ply")
    for name in ("means", "scales", "quaternions", "opacities", "colours"):
        torch.testing.assert_close(getattr(again, name), getattr(gaussians, name), rtol=1e-5, atol=1e-6)


def test_hand_made_file_with_other_order_and_extra_property(tmp_path: Path) -> None:
    names = ["extra", *[n for n in LAYOUT if not n.startswith(("f_rest", "n"))][::-1]]
    row = np.zeros(1, dtype=[(n, "<f8") for n in names])
    row["x"], row["f_dc_1"], row["scale_2"], row["rot_0"] = 3.0, 1.0, np.log(0.02), 5.0
    PlyData([PlyElement.describe(row, "vertex")], text=True).write(str(tmp_path / "h.ply"))
    g = load_ply(tmp_path / "h.ply")
    assert g.means.tolist() == [[3.0, 0.0, 0.0]]
    assert g.opacities.item() == 0.5
    torch.testing.assert_close(g.colours, torch.tensor([[0.5, 0.78209479, 0.5]]))
    torch.testing.assert_close(g.scales, torch.tensor([[1.0, 1.0, 0.02]]))
    assert g.quaternions.tolist() == [[5.0, 0.0, 0.0, 0.0]]


def test_opaque_and_clear_gaussians_stay_finite(tmp_path: Path, gaussians: Gaussians) -> None:
    opacities = gaussians.opacities.clone()
    opacities[0], opacities[1] = 0.0, 1.0
    save_ply(tmp_path / "g.ply", gaussians.replace(opacities=opacities, scales=gaussians.scales * 0))
    again = load_ply(tmp_path / "g.ply")
    assert torch.isfinite(again.scales).all()
    torch.testing.assert_close(again.opacities, opacities, rtol=0, atol=2e-6)


def test_bad_files_name_file_and_property(tmp_path: Path, gaussians: Gaussians) -> None:
    with pytest.raises(MeasurementError, match=r"none\.ply"):
        load_ply(tmp_path / "none.ply")
    (tmp_path / "junk.ply").write_bytes(b"not a ply")
    with pytest.raises(MeasurementError, match=r"junk\.ply"):
        load_ply(tmp_path / "junk.ply")
    mesh = np.zeros(2, dtype=[(n, "<f4") for n in "xyz"])
    PlyData([PlyElement.describe(mesh, "vertex")]).write(str(tmp_path / "mesh.ply"))
    with pytest.raises(MeasurementError, match=r"mesh\.ply: f_dc_0"):
        load_ply(tmp_path / "mesh.ply")
    save_ply(tmp_path / "nan.ply", gaussians.replace(means=gaussians.means * float("nan")))
    with pytest.raises(MeasurementError, match=r"nan\.ply: x"):
        load_ply(tmp_path / "nan.ply")
