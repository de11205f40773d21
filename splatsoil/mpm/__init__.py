"""The material point method: sand in a bed and a tool on its measured path."""

from splatsoil.mpm.presets import PRESETS, Preset, Resolution
from splatsoil.mpm.simulate import Trajectory, frames_around, simulate
from splatsoil.mpm.solver import Solver
from splatsoil.mpm.together import simulate_together

__all__ = ["PRESETS", "Preset", "Resolution", "Solver", "Trajectory", "frames_around", "simulate", "simulate_together"]
