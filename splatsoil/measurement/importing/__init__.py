"""Measurement sets out of what other programs and instruments recorded."""

from splatsoil.measurement.importing.build import Alignment, Imported, Parts, import_set, names_of
from splatsoil.measurement.importing.robot import UNITS
from splatsoil.measurement.importing.source import Source, read_source

__all__ = ["UNITS", "Alignment", "Imported", "Parts", "Source", "import_set", "names_of", "read_source"]
