"""Soil properties from photographs of a tool moving through it.

Importing the package registers its Gymnasium environments, so that ``import gymnasium, splatsoil`` is all that
``gymnasium.make("PlowSand-v0")`` needs.
"""

from splatsoil import deterministic as _deterministic
from splatsoil._version import __version__
from splatsoil.envs import register as _register_environments

__all__ = ["__version__"]

if _deterministic.wanted():
    _deterministic.enforce()
_register_environments()
