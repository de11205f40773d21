"""What image files of less usual kinds are read as."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatsoil.measurement import Camera, Frame

CAMERA = Camera(4, 2, 4.0, 4.0, 2.0, 1.0, np.eye(4))
GREY = np.array([[0, 64, 128, 255], [32, 1, 2, 3]], dtype=np.uint8)
SEEN = np.array([[True, False, True, True], [True, True, True, False]])


@pytest.mark.parametrize(
    ("stored", "name", "value"),
    [
        (GREY, "a.png", GREY / 255.0),
        (GREY.astype(np.uint16) * 257, "a.png", GREY / 255.0),
        (GREY.astype(np.uint16) * 257, "a.tif", GREY / 255.0),
        (GREY.astype(np.int32) * 257, "a.tif", GREY / 255.0),
        ((GREY / 255.0).astype(np.float32), "a.tif", GREY / 255.0),
        (np.full((2, 4), 0.5, dtype=np.float32), "a.tif", np.full((2, 4), 0.5)),
        (GREY > 40, "a.png", (GREY > 40) * 1.0),
    ],
    ids=["8", "16", "16-tiff", "32-tiff", "float", "float-half", "1"],
)
def test_values(stored: np.ndarray, name: str, value: np.ndarray, tmp_path: Path) -> None:
    Image.fromarray(stored).save(tmp_path / name)
    image = Frame(CAMERA, tmp_path / name).image()
    assert image.shape == (2, 4, 3) and image.dtype == np.float32
    np.testing.assert_allclose(image, np.repeat(value[:, :, None], 3, axis=2), atol=1e-6)


def test_a_tiff_of_16_bits_in_which_0_is_white(tmp_path: Path) -> None:
    Image.fromarray(65535 - GREY.astype(np.uint16) * 257).save(tmp_path / "a.tif", tiffinfo={262: 0})
    np.testing.assert_allclose(Frame(CAMERA, tmp_path / "a.tif").image()[:, :, 0], GREY / 255.0, atol=1e-6)


def palette(path: Path) -> None:
    """Colour 7 of a palette is transparent."""
    image = Image.fromarray(np.where(SEEN, 3, 7).astype(np.uint8)).convert("P")
    image.putpalette([v for k in range(256) for v in (k, 255 - k, 128)])
    image.putdata(np.where(SEEN, 3, 7).ravel().tolist())
    image.save(path, transparency=7)


def one_colour(mode: str, key: object) -> Callable[[Path], None]:
    """One colour is transparent (PNG's tRNS)."""

    def save(path: Path) -> None:
        if mode == "I;16":
            image = Image.fromarray(np.where(SEEN, 500, 70).astype(np.uint16))
        else:
            image = Image.fromarray(np.where(SEEN, 200, 70).astype(np.uint8)).convert(mode)
        image.save(path, transparency=key)

    return save


def alpha(mode: str) -> Callable[[Path], None]:
    """A channel of its own, of 127 and 1 where nothing counts and of 128 where all does."""

    def save(path: Path) -> None:
        image = Image.new(mode, (4, 2))
        values = np.where(SEEN, [[128], [255]], [[127], [1]]).astype(np.uint8)
        image.putalpha(Image.fromarray(values))
        image.save(path)

    return save


@pytest.mark.parametrize(
    "save",
    [palette, one_colour("L", 70), one_colour("RGB", (70, 70, 70)), one_colour("I;16", 70), alpha("RGBA"), alpha("LA")],
    ids=["palette", "tRNS-L", "tRNS-RGB", "tRNS-16", "RGBA", "LA"],
)
def test_transparency_is_a_mask(save: Callable[[Path], None], tmp_path: Path) -> None:
    save(tmp_path / "a.png")
    mask = Frame(CAMERA, tmp_path / "a.png").mask()
    np.testing.assert_array_equal(mask, SEEN)


@pytest.mark.parametrize(("dark", "bright"), [(0, 1), (0, 255), (60, 255), (0, 65535)])
def test_masks_keep_what_is_bright(dark: int, bright: int, tmp_path: Path) -> None:
    """Also of 0 and 1, and of black that a JPEG's compression made grey."""
    kind = np.uint16 if bright > 255 else np.uint8
    Image.fromarray(np.where(SEEN, bright, dark).astype(kind)).save(tmp_path / "mask.png")
    Image.fromarray(GREY).save(tmp_path / "a.png")
    np.testing.assert_array_equal(Frame(CAMERA, tmp_path / "a.png", mask_path=tmp_path / "mask.png").mask(), SEEN)


@pytest.mark.parametrize(
    ("name", "stored"),
    [
        ("d.png", np.uint16(1500)),
        ("d.tif", np.uint16(1500)),
        ("d.tif", np.int32(1500)),
        ("d.tif", np.float32(1.5)),
        ("d.npy", np.float32(1.5)),
        ("d.npy", np.float64(1.5)),
        ("d.npy", np.uint16(1500)),
        ("d.npy", np.int64(1500)),
    ],
    ids=lambda v: v if isinstance(v, str) else f"{type(v).__name__}",
)
def test_depths_of_one_and_a_half_metres(name: str, stored: np.generic, tmp_path: Path) -> None:
    """Whole numbers are millimetres, others metres; the upper left corner is unknown."""
    values = np.full((2, 4), stored)
    values[0, 0] = np.nan if values.dtype.kind == "f" else 0
    if name.endswith(".npy"):
        np.save(tmp_path / name, values)
    else:
        Image.fromarray(values).save(tmp_path / name)
    depth = Frame(CAMERA, tmp_path / "none.png", depth_path=tmp_path / name).depth()
    assert depth is not None and depth.dtype == np.float32
    np.testing.assert_allclose(depth, [[0.0, 1.5, 1.5, 1.5], [1.5] * 4], rtol=1e-6)
