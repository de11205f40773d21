"""CSV: the force on the tool over time, measured and predicted; heights of the soil's surface on a grid."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatsoil.export.replay import Moment
from splatsoil.files import write_text
from splatsoil.model import Model

FORCE_COLUMNS = ("frame", "time", *(f"f{axis}_{kind}" for kind in ("measured", "predicted") for axis in "xyz"))
"""N, world axes, the soil's on the tool, mean over the frame that ends at the time; empty where not measured."""


class CsvWriter:
    """Writes ``force.csv``, and ``surface.csv``: x, y, the height that photographs show before anything moves
    (``reconstructed``), and the simulated one at each frame (``frame_N``), all in m."""

    def __init__(self, folder: Path, model: Model, frames: tuple[int, ...]) -> None:
        """Args: an empty folder, the model, and its frames that come."""
        self.folder, self.model = folder, model
        self.columns: dict[str, npt.NDArray[np.floating]] = {}

    def add(self, moment: Moment) -> None:
        """Keep one frame's heights."""
        points = moment.surface_points
        if not self.columns:
            heights = self.model.reconstruction.surface.sample(points[:, :2].astype(np.float64))
            self.columns = {"x": points[:, 0], "y": points[:, 1], "reconstructed": heights}
        self.columns[f"frame_{moment.frame}"] = points[:, 2]

    def finish(self, force: npt.NDArray[np.float64]) -> None:
        """Write both tables."""
        rows = ([f"{v:.6g}" for v in row] for row in zip(*self.columns.values(), strict=True))
        write_text(self.folder / "surface.csv", _table(tuple(self.columns), rows))
        measured = self.model.measurement.tool.force
        known = {} if measured is None else {int(row[0]): [f"{v:.6g}" for v in row[2:]] for row in measured}
        time = self.model.resolution.frame_time
        forces = (
            [str(k), f"{k * time:.6g}", *known.get(k, ["", "", ""]), *(f"{v:.6g}" for v in row)]
            for k, row in enumerate(force, start=1)
        )
        write_text(self.folder / "force.csv", _table(FORCE_COLUMNS, forces))


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return stream.getvalue()
