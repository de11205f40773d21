"""Soil properties from photographs of a tool moving through it.

Importing the package registers its Gymnasium environments, so that ``import gymnasium, splatsoil`` is all that
``gymnasium.make("PlowSand-v0")`` needs.
"""

from splatsoil import starting as _starting

_starting.heed_interrupts()  # before what takes its time

from splatsoil import deterministic as _deterministic  # noqa: E402
from splatsoil._version import __version__  # noqa: E402
from splatsoil.envs import register as _register_environments  # noqa: E402

__all__ = ["__version__"]

if _deterministic.wanted():
    _deterministic.enforce()
_register_environments()
