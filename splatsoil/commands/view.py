"""``splatsoil view``: a run or a measurement set in a browser."""

from __future__ import annotations

import importlib.util
import io
import logging
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from splatsoil.commands import _model
from splatsoil.commands._options import DEVICE
from splatsoil.commands._output import by_frame
from splatsoil.errors import ParameterError, RunError
from splatsoil.inverse.run_folder import RunFolder
from splatsoil.options import argument, option
from splatsoil.report.data import estimates, load
from splatsoil.report.text import amount

if TYPE_CHECKING:
    from splatsoil.measurement import Measurement
    from splatsoil.view import Column

INTERRUPTED = "show it again with"


@dataclass(frozen=True)
class Config:
    """Show a run or a measurement set in a browser.

    A run: Gaussians or particles of its latest fit, simulated once, with tool and cameras. A set: tool and cameras.
    """

    folder: Path = argument("A run folder, or a measurement set.")
    compare_with: str | None = option(None, "Another fit of the run to show next to the latest.")
    port: int = option(8080, "Of 127.0.0.1; the next free one where it is taken.")
    device: str = option("auto", DEVICE)


def run(config: Config) -> int:
    """Simulate, then serve until Ctrl-C."""
    if importlib.util.find_spec("viser") is None:
        raise ParameterError("view needs viser, which isn't installed; pip install 'splatsoil[view]'")
    if not 0 < config.port < 65536:
        raise ParameterError(f"--port: must be from 1 to 65535, not {config.port}")
    measurement, columns = _loaded(config)

    import viser

    from splatsoil.view import Viewer

    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # a closed browser is no error
    with redirect_stdout(io.StringIO()):  # viser's banner
        # Local only: there is no password.
        server = viser.ViserServer("127.0.0.1", config.port, verbose=False)
    try:
        viewer = Viewer(server, measurement, columns)
        print(f"http://127.0.0.1:{server.get_port()} shows {measurement.name}; Ctrl-C ends it", flush=True)
        viewer.play()
    finally:
        server.stop()
    return 0


def _loaded(config: Config) -> tuple[Measurement, list[Column]]:
    """The set, and predictions of a run's fits, the latest first."""
    from splatsoil.comparison import Comparator
    from splatsoil.export import replay
    from splatsoil.measurement import Measurement
    from splatsoil.view import Column

    if not (config.folder / "run.json").is_file():
        if config.compare_with is not None:
            raise ParameterError(f"--compare-with: {config.folder} is no run folder; only a run has fits")
        return Measurement.load(config.folder), []
    folder = RunFolder.open(config.folder)
    data = load(folder.path)
    if config.compare_with is not None and config.compare_with not in data.fits:
        raise RunError(
            f"--compare-with: {folder.path} has no fit {config.compare_with!r}; it has {', '.join(data.fits)}"
        )
    columns = []
    with _model.loaded(config, folder) as (model, begin):
        made = model.reconstruction
        comparator = Comparator(
            model.measurement, surface=made.surface, frames=model.frames, surroundings=made.standing
        )
        for fit in (data.fit, *([data.fits[config.compare_with]] if config.compare_with else [])):
            values, report = estimates(fit), begin(fit["name"])
            texts = (f"{n} {amount(p['estimate'], p['std'], p['unit'])}" for n, p in fit["parameters"].items())
            shown = model.variant(effects=_model.ModelSpec.of(fit).effects)
            column = Column(f"{fit['name']}: {', '.join(texts)}", shown, values, comparator)
            replay(shown, values, shown.recorded, [column], progress=by_frame(report))
            columns.append(column)
    return model.measurement, columns
