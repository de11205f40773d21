"""Import of Blender / NeRF-synthetic camera files (transforms_train.json)."""

from __future__ import annotations

from pathlib import Path

from splatsoil.errors import MeasurementError
from splatsoil.measurement.fields import Fields, named
from splatsoil.measurement.frames import Frame, read_camera
from splatsoil.measurement.images import check_image, image_size


def read_blender(file: str | Path) -> tuple[Frame, ...]:
    """Frames of a ``transforms_train.json``, ordered by image name.

    Most give one horizontal field of view (``camera_angle_x``): the principal point is in the middle then, pixels are
    square, and nothing bends the image. What else of a lens a file gives (``camera_angle_y``, ``fl_x``, ``cx``, ``k1``
    …) is read as in nerfstudio's. File paths may lack their suffix; times, if any, are left out.

    Raises:
        MeasurementError: naming file and field.
    """
    path = Path(file)
    fields = Fields.read(path)
    if not fields.has("fl_x"):
        fields.raw("camera_angle_x")
    frames = []
    for item in fields.children("frames"):
        image = named(item.text("file_path"), path.parent, path, item.path_of("file_path"))
        if not image.is_file():
            raise MeasurementError(f"no such image, though {path.name} names it", file=image)
        camera = read_camera(item, "", image_size(image))
        sizes_from = f"w and h of {path.name}" if item.has("w") or item.has("h") else "its own header"
        check_image(image, (camera.width, camera.height), sizes_from=sizes_from)
        frames.append(Frame(camera, image))
    return tuple(sorted(frames, key=lambda frame: frame.path))
