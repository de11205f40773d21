"""VTK: a series of unstructured grids (.vtu) for each of particles, tool and surface, and its index (.pvd).

ParaView opens the .pvd files; their times are seconds. Format: "VTK XML file formats" and, of .pvd, ParaView's guide.
"""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import quoteattr

import meshio
import numpy as np
import numpy.typing as npt

from splatsoil.export.replay import Moment
from splatsoil.files import write_text
from splatsoil.model import Model


class VtkWriter:
    """Writes ``particles.pvd``, ``tool.pvd`` and ``surface.pvd`` and, beside each, a .vtu file a frame."""

    def __init__(self, folder: Path, model: Model, frames: tuple[int, ...]) -> None:
        """Args: an empty folder, the model, and its frames that come."""
        self.folder, self.mesh = folder, model.measurement.tool.mesh
        self.first: npt.NDArray[np.float32] | None = None
        self.times: list[tuple[int, float]] = []

    def add(self, moment: Moment) -> None:
        """Write one frame."""
        count = len(moment.positions)
        fields = {"velocity": moment.velocities, "displacement": moment.displacements, "pressure": moment.pressures}
        if moment.plastic_strains is not None:
            fields["plastic_strain"] = moment.plastic_strains
        self._write("particles", moment, moment.positions, ("vertex", np.arange(count)[:, None]), fields)
        rotation, position = moment.tool
        corners = self.mesh.vertices @ rotation.T + position
        self._write("tool", moment, corners, ("triangle", np.asarray(self.mesh.faces)), {})
        points = moment.surface_points
        if self.first is None:
            self.first = points[:, 2]
        rise = {"height_change": points[:, 2] - self.first}
        self._write("surface", moment, points, ("quad", moment.surface_quads), rise)
        self.times.append((moment.frame, moment.time))

    def finish(self, force: npt.NDArray[np.float64]) -> None:
        """Write the indices."""
        for part in ("particles", "tool", "surface"):
            rows = "".join(
                f'<DataSet timestep="{time!r}" part="0" file={quoteattr(_name(part, frame))}/>\n'
                for frame, time in self.times
            )
            head = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">\n'
            text = f"{head}<Collection>\n{rows}</Collection>\n</VTKFile>\n"
            write_text(self.folder / f"{part}.pvd", text)

    def _write(
        self,
        part: str,
        moment: Moment,
        points: npt.NDArray[np.floating],
        cells: tuple[str, npt.NDArray[np.integer]],
        fields: dict[str, npt.NDArray[np.float32]],
    ) -> None:
        meshio.Mesh(points, [cells], point_data=fields).write(self.folder / _name(part, moment.frame))


def _name(part: str, frame: int) -> str:
    return f"{part}_{frame:06d}.vtu"
