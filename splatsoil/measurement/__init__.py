"""Measurement sets: cameras, photographs, video, the tool and its motion; read, checked and written.

Nothing here imports torch until an image is undistorted, so that looking at a set is quick.
"""

from splatsoil.measurement.camera import CAMERA_MODELS, Camera
from splatsoil.measurement.colmap import read_colmap
from splatsoil.measurement.frames import Frame, read_blender
from splatsoil.measurement.heights import HeightMaps
from splatsoil.measurement.measurement import BIN, CONTAINERS, FORMAT, HEAP, OPEN, TRANSPARENT, Bed, Measurement
from splatsoil.measurement.motion import ToolMotion
from splatsoil.measurement.remarks import Remark, remarks
from splatsoil.measurement.tool import Tool
from splatsoil.measurement.writer import Contents, Picture, write_measurement

__all__ = [
    "BIN",
    "CAMERA_MODELS",
    "CONTAINERS",
    "FORMAT",
    "HEAP",
    "OPEN",
    "TRANSPARENT",
    "Bed",
    "Camera",
    "Contents",
    "Frame",
    "HeightMaps",
    "Measurement",
    "Picture",
    "Remark",
    "Tool",
    "ToolMotion",
    "read_blender",
    "read_colmap",
    "remarks",
    "write_measurement",
]
