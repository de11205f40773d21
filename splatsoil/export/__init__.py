"""A prediction in formats that other programs read: VTK series, USD, CSV tables and splats.

One simulation is replayed, and every writer is handed each exported moment in turn, so that no more than one of them is
held in memory.
"""

from splatsoil.export.replay import Moment, Writer, replay
from splatsoil.export.writers import FORMATS, make_writers

__all__ = ["FORMATS", "Moment", "Writer", "make_writers", "replay"]
