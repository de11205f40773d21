"""Import of Blender / NeRF-synthetic camera files (transforms_train.json)."""

from __future__ import annotations

import math
from pathlib import Path

from splatsoil.errors import MeasurementError
from splatsoil.measurement.camera import Camera
from splatsoil.measurement.fields import Fields
from splatsoil.measurement.frames import Frame
from splatsoil.measurement.images import check_image, image_size
from splatsoil.measurement.rotations import nearest_rigid, why_not_rigid


def read_blender(file: str | Path) -> tuple[Frame, ...]:
    """Frames of a ``transforms_train.json``: one horizontal field of view, centred principal point, no distortion.

    File paths may lack their suffix (.png is meant, as in the NeRF-synthetic scenes); times, if any, are left out.

    Raises:
        MeasurementError: naming file and field.
    """
    path = Path(file)
    fields = Fields.read(path)
    angle = fields.number("camera_angle_x", 1e-3, math.pi - 1e-3, hint="it is the horizontal field of view in radians")
    frames = []
    for item in fields.children("frames"):
        name = item.text("file_path")
        image = path.parent / name
        if not image.is_file():
            image = path.parent / f"{name}.png"
        if not image.is_file():
            raise MeasurementError(f"no such image, though {path.name} names it", file=path.parent / name)
        matrix = item.matrix("transform_matrix", 4, 4)
        fault = why_not_rigid(matrix)
        if fault:
            item.fail("transform_matrix", f"not a rigid motion: {fault}")
        width, height = image_size(image)
        check_image(image, (width, height), sizes_from="its own header")
        focal = 0.5 * width / math.tan(0.5 * angle)
        camera = Camera(
            width,
            height,
            focal,
            focal,
            0.5 * width,
            0.5 * height,
            camera_to_world=nearest_rigid(matrix),
            model="PINHOLE",
        )
        frames.append(Frame(camera, image))
    return tuple(frames)
