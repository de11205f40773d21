"""Image files: checked without keeping them, read as stored."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

from splatsoil.errors import MeasurementError

FloatImage = npt.NDArray[np.float32]


def check_image(path: Path, size: tuple[int, int], *, sizes_from: str, field: str | None = None) -> None:
    """Raise MeasurementError unless ``path`` is a whole image of ``size`` (width, height) of the type its name says.

    Args:
        path: the image file.
        size: (width, height) in pixels.
        sizes_from: what told the size, for the message.
        field: what named the file, for the message.
    """
    known = Image.registered_extensions()
    with _opened(path, field) as image:
        expected = known.get(path.suffix.lower())
        if expected is None:
            raise MeasurementError(
                f"{path.suffix or 'a name without suffix'} is no known type of image", file=path, field=field
            )
        if image.format != expected and {image.format, expected} != {"JPEG", "MPO"}:
            raise MeasurementError(
                f"the name says {expected}, the content is {image.format}; rename or convert it", file=path, field=field
            )
        if image.size != size:
            found, wanted = "{} x {}".format(*image.size), "{} x {}".format(*size)
            raise MeasurementError(
                f"the image is {found} pixels where {sizes_from} say {wanted}", file=path, field=field
            )
        # A JPEG decoded at an eighth of its size still reads the whole stream, at a fraction of the cost.
        image.draft(None, (1, 1))
        _decode(image, path, field)


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image file, from its header."""
    with _opened(path) as image:
        return image.size


def read_image(path: Path) -> FloatImage:
    """An image file's stored values: (height, width, 3) float32 in [0, 1]; grey is repeated, alpha left out."""
    with _opened(path) as image:
        _decode(image, path)
        if image.mode.startswith("I;16") or image.mode == "I":
            grey = np.asarray(image, dtype=np.float32) / np.float32(65535.0)
            return np.repeat(grey[:, :, None], 3, axis=2)
        return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255.0)


def read_alpha(path: Path) -> npt.NDArray[np.bool_] | None:
    """Where an image is not wholly transparent: (height, width) bool; None without an alpha channel."""
    with _opened(path) as image:
        if image.mode not in ("RGBA", "LA", "PA"):
            return None
        _decode(image, path)
        return np.asarray(image.getchannel("A")) > 0


def _opened(path: Path, field: str | None = None) -> Image.Image:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            return Image.open(path)
    except FileNotFoundError as error:
        raise MeasurementError("no such image", file=path, field=field) from error
    except UnidentifiedImageError as error:
        raise MeasurementError("not an image, or its beginning is damaged", file=path, field=field) from error
    except Image.DecompressionBombError as error:
        raise MeasurementError("the image claims to be larger than any photograph", file=path, field=field) from error
    except (OSError, ValueError, SyntaxError) as error:
        raise MeasurementError(f"the image cannot be opened: {error}", file=path, field=field) from error


def _decode(image: Image.Image, path: Path, field: str | None = None) -> None:
    try:
        image.load()
    except (OSError, ValueError, SyntaxError, EOFError) as error:
        raise MeasurementError(
            f"the image is damaged or truncated ({error}); copy it again", file=path, field=field
        ) from error
