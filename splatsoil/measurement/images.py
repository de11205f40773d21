"""Image files: checked without keeping them, read as stored."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, UnidentifiedImageError

from splatsoil.errors import MeasurementError

FloatImage = npt.NDArray[np.float32]


#: Pillow's names of the types that are read. It knows more, among them ones that it hands to other programs (EPS).
FORMATS = ("AVIF", "BMP", "GIF", "JPEG", "JPEG2000", "MPO", "PNG", "PPM", "TGA", "TIFF", "WEBP")
_ORIENTATION = 0x0112  # EXIF
_PHOTOMETRIC, _WHITE_IS_ZERO = 262, 0  # TIFF
_BLOCK = 8  # pixels over which noise is averaged before a photograph is asked for what it shows
_OPAQUE = 128  # of 255: half, so that the pixel's centre belongs to what is shown


def check_image(path: Path, size: tuple[int, int], *, sizes_from: str, field: str | None = None) -> None:
    """Raise MeasurementError unless ``path`` is a whole image of ``size`` (width, height) of the type its name says.

    Args:
        path: the image file.
        size: (width, height) in pixels.
        sizes_from: where the size is from, for the message.
        field: what named the file, for the message.
    """
    with _checked(path, size, sizes_from, field):
        pass


@contextmanager
def _checked(path: Path, size: tuple[int, int], sizes_from: str, field: str | None) -> Iterator[Image.Image]:
    """The image that `check_image` has checked, a JPEG at an eighth of its size."""
    expected = Image.registered_extensions().get(path.suffix.lower())
    if expected not in FORMATS:
        raise MeasurementError(
            f"{path.suffix or 'a name without suffix'} is no known type of image; convert it to JPEG or PNG",
            file=path,
            field=field,
        )
    with _opened(path, field) as image:
        if image.format != expected and {image.format, expected} != {"JPEG", "MPO"}:
            raise MeasurementError(
                f"the name says {expected}, the content is {image.format}; rename or convert it", file=path, field=field
            )
        if image.size != size:
            found, wanted = "{} x {}".format(*image.size), "{} x {}".format(*size)
            as_shown = image.size == size[::-1] and _turned(image)
            advice = ": its EXIF data turn it, and images are used as stored; save it turned, without EXIF"
            raise MeasurementError(
                f"the image is {found} pixels where {sizes_from} say {wanted}{advice if as_shown else ''}",
                file=path,
                field=field,
            )
        # A JPEG decoded at an eighth of its size still reads the whole stream, at a fraction of the cost.
        image.draft(None, (1, 1))
        _decode(image, path, field)
        yield image


def check_photograph(path: Path, size: tuple[int, int], *, sizes_from: str, field: str | None = None) -> None:
    """`check_image`, and that the image shows something: a uniform one has no information.

    Raises:
        MeasurementError: naming file and field.
    """
    with _checked(path, size, sizes_from, field) as image:
        values = _values(image, path, field)
    if values.shape[1::-1] == size:
        height, width = (max(1, n // _BLOCK) for n in values.shape[:2])
        rows, columns = values.shape[0] // height, values.shape[1] // width
        blocks = values[: height * rows, : width * columns].reshape(height, rows, width, columns, 3)
        values = blocks.mean(axis=(1, 3))
    # Averages of blocks are free of noise, and what differs by less than the step of 8-bit images isn't seen.
    if values.std(axis=(0, 1)).max() < 1.0 / 255.0:
        level = 255.0 * float(values.mean())
        raise MeasurementError(
            f"the photograph shows nothing but one even grey, {level:.0f} of 255; leave it out", file=path, field=field
        )


def turned(path: Path) -> bool:
    """Whether an image's EXIF data ask for it to be turned or mirrored."""
    with _opened(path) as image:
        return _turned(image)


def _turned(image: Image.Image) -> bool:
    return image.getexif().get(_ORIENTATION, 1) not in (0, 1)


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of an image file, from its header."""
    with _opened(path) as image:
        return image.size


def read_image(path: Path, field: str | None = None) -> FloatImage:
    """An image file's stored values: (height, width, 3) float32 in [0, 1]; grey is repeated, alpha left out.

    Raises:
        MeasurementError: it can't be read, or has floating-point values outside [0, 1].
    """
    with _opened(path, field) as image:
        _decode(image, path, field)
        return _values(image, path, field)


def read_mask(path: Path, field: str | None = None) -> npt.NDArray[np.bool_]:
    """Where a mask is brighter than half of its brightest pixel: (height, width) bool."""
    grey = read_image(path, field).max(axis=2)
    return grey > 0.5 * grey.max()


def read_alpha(path: Path) -> npt.NDArray[np.bool_] | None:
    """Where an image is opaque by half or more: (height, width) bool; None without transparency.

    Transparency is an alpha channel, a palette's, or that of one colour (PNG's tRNS).
    """
    with _opened(path) as image:
        if not image.has_transparency_data:
            return None
        _decode(image, path)
        if image.mode.startswith("I"):
            return np.asarray(image) != image.info["transparency"]
        return np.asarray(image.convert("RGBA").getchannel("A")) >= _OPAQUE


def read_depth(path: Path, field: str | None = None, *, scale: float = 1e-3) -> FloatImage:
    """Depths of an image or a .npy file: (height, width) float32 metres, 0 where unknown.

    Whole numbers are millimetres, as in nerfstudio's 16-bit images, or multiples of ``scale`` in m; floating-point ones
    are metres. What is not positive, or not finite, is unknown.

    Raises:
        MeasurementError: it can't be read, or has 8 bits.
    """
    values = read_numbers(path, field)
    if values.dtype.itemsize == 1:
        raise MeasurementError(
            "a depth is of 16-bit millimetres or floating-point metres, this one of 8 bits, which have no unit",
            file=path,
            field=field,
        )
    with np.errstate(invalid="ignore"):
        metres = values.astype(np.float64) * (1.0 if values.dtype.kind == "f" else scale)
        return np.where(np.isfinite(metres) & (metres > 0.0), metres, 0.0).astype(np.float32)


def read_numbers(path: Path, field: str | None = None) -> npt.NDArray[np.generic]:
    """What an image or a .npy file stores.

    Raises:
        MeasurementError: it can't be read, or stores something else than one array of numbers.
    """
    suffix = path.suffix.lower()
    if suffix == ".npy":
        try:
            values = np.load(path, allow_pickle=False)
        except (OSError, ValueError, EOFError, MemoryError) as error:
            raise MeasurementError("not a NumPy array of numbers", file=path, field=field) from error
    elif Image.registered_extensions().get(suffix) in FORMATS:
        with _opened(path, field) as image:
            _decode(image, path, field)
            values = np.asarray(image)
    else:
        raise MeasurementError(
            f"numbers are not read from {suffix or 'such'} files; save a .npy or a TIFF", file=path, field=field
        )
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "uif":
        raise MeasurementError("not one array of numbers", file=path, field=field)
    return values


def _values(image: Image.Image, path: Path, field: str | None = None) -> FloatImage:
    """(height, width, 3) float32 in [0, 1] of a decoded image."""
    if image.mode != "F" and not image.mode.startswith("I"):
        return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255.0)
    grey = np.asarray(image, dtype=np.float32) / np.float32(1.0 if image.mode == "F" else 65535.0)
    tags = getattr(image, "tag_v2", {})
    if tags.get(_PHOTOMETRIC) == _WHITE_IS_ZERO:  # Pillow turns 8 bits round alone
        grey = np.float32(1.0) - grey
    if not (grey.min() >= 0.0 and grey.max() <= 1.0):
        raise MeasurementError(
            f"values reach from {grey.min():g} to {grey.max():g}; those of floating-point images lie in [0, 1], whole"
            " numbers have 8 or 16 bits",
            file=path,
            field=field,
        )
    return np.repeat(grey[:, :, None], 3, axis=2)


@contextmanager
def _opened(path: Path, field: str | None = None) -> Iterator[Image.Image]:
    """The image; what Pillow has to remark on it meanwhile is left out."""
    Image.init()  # or types of the list are unknown yet
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image = Image.open(path, formats=[name for name in FORMATS if name in Image.OPEN])
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        faults = {
            FileNotFoundError: "no such image",
            UnidentifiedImageError: "not an image that is read: its beginning is damaged, or it is of another kind, as"
            " TIFFs of floating-point colours are; convert it to PNG",
            Image.DecompressionBombError: "the image claims to be larger than any photograph",
        }
        fault = faults.get(type(error), f"the image cannot be opened: {error}")
        raise MeasurementError(fault, file=path, field=field) from error
    with image, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield image


def _decode(image: Image.Image, path: Path, field: str | None = None) -> None:
    try:
        image.load()
    except (OSError, ValueError, SyntaxError, EOFError, MemoryError) as error:
        raise MeasurementError(
            f"the image is damaged or truncated ({error}); copy it again", file=path, field=field
        ) from error
