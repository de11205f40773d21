"""Soil properties from photographs of a tool moving through it."""

from splatsoil._version import __version__

__all__ = ["__version__"]
