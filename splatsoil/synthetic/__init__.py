"""Synthetic experiments: the solver moves the sand; a path tracer, which shares nothing with the splats, draws it."""

from splatsoil.synthetic.appearance import Appearance
from splatsoil.synthetic.recording import Recorder, Renderer
from splatsoil.synthetic.setups import Setup, like, paper, plow
from splatsoil.synthetic.soil_surface import soil_surface
from splatsoil.synthetic.stage import Body, Light, Stage, photograph
from splatsoil.synthetic.world import Recipe, World, make_set, photograph_run

__all__ = [
    "Appearance",
    "Body",
    "Light",
    "Recipe",
    "Recorder",
    "Renderer",
    "Setup",
    "Stage",
    "World",
    "like",
    "make_set",
    "paper",
    "photograph",
    "photograph_run",
    "plow",
    "soil_surface",
]
