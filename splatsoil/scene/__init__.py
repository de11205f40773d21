"""The renderer: Gaussians that move with particles, shaded by sun and sky, with the tool among them."""

from splatsoil.scene.binding import Binding, bind
from splatsoil.scene.build import build_scene
from splatsoil.scene.estimate import estimate_light, seen_colours, still_frames
from splatsoil.scene.ground import ground_of_pixels
from splatsoil.scene.intrinsic import Intrinsic
from splatsoil.scene.layers import Layers, Posed
from splatsoil.scene.light import Light, encoded, linear
from splatsoil.scene.relief import Relief, relief_of_particles
from splatsoil.scene.render import Scene
from splatsoil.scene.shading import Shading, shade
from splatsoil.scene.tool import ToolBody, silhouette

__all__ = [
    "Binding",
    "Intrinsic",
    "Layers",
    "Light",
    "Posed",
    "Relief",
    "Scene",
    "Shading",
    "ToolBody",
    "bind",
    "build_scene",
    "encoded",
    "estimate_light",
    "ground_of_pixels",
    "linear",
    "relief_of_particles",
    "seen_colours",
    "shade",
    "silhouette",
    "still_frames",
]
