"""What of a run is measured once, beside its simulations, and kept in ``features/``: the control, the calibration."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import wait
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from concurrent.futures import Future

    import numpy as np
    import numpy.typing as npt

    from splatsoil.experiment.base import Calibration
    from splatsoil.experiment.plow import PlowExperiment
    from splatsoil.inverse.criticism.simulations import Simulations
    from splatsoil.inverse.run_folder import RunFolder

    FloatArray = npt.NDArray[np.float64]

Replay = Callable[[], "Future[None] | None"]
"""Has a helper make the replay control, if none is at it; None where there is no helper."""

#: Parts of the package that decide features, what criticism makes of simulations, besides those that simulate; the
#: replay control; the calibration; verdicts.
FEATURES = ("experiment/plow.py", "experiment/base.py")
REPLAY = ("synthetic", "experiment/replay.py")
CALIBRATION = ("experiment/bands.py", "experiment/calibration.py", "experiment/calibration_bench.py")
JUDGING = (
    *("inverse/criticism", "inverse/hyperparameters.py", "inverse/surrogate.py"),
    *("experiment/states.py", "experiment/strokes.py"),
)


#: How folders in a run are called in which a control is made, before a process's number.
PLACES = ".replay-"


def code_of(effects: Iterable[str]) -> str:
    """Digest of the code that decides features, users' own effects in it."""
    from splatsoil.files import FORWARD, code_digest

    return code_digest((*FORWARD, *FEATURES), own_files(effects))


def judged_by() -> str:
    """Digest of the code that draws verdicts from features."""
    from splatsoil.files import code_digest

    return code_digest(JUDGING)


def own_files(effects: Iterable[str]) -> list[str]:
    """Of effects' names those that are a user's own files."""
    return [name for name in effects if name.endswith(".py")]


def replay_path(folder: RunFolder, simulate: Simulations) -> Path:
    """Where the replay control of a model is kept. What pictures get wrong hardly hangs on a few degrees: one serves
    all estimates of a model."""
    from splatsoil.files import code_digest
    from splatsoil.inverse.evaluations import digest

    # Candidates, a user's own among them, are no part of it.
    own = {"code": code_of(folder.fit()["setup"]["effects"])}
    what = {**simulate.identity, **own, "replay code": code_digest(REPLAY)}
    return folder.path / "features" / f"replay-{digest(what)[:24]}.npy"


def replayed(
    folder: RunFolder,
    experiment: PlowExperiment,
    simulate: Simulations,
    place: Path,
    say: Callable[[str], None],
) -> FloatArray:
    """The replay control (1, t, s), made once for a model, at the latest fit's values, and kept in ``features/``.

    ``place`` is a folder for what lies about meanwhile, which is gone in the end.
    """
    import io

    import numpy as np

    from splatsoil.experiment.replay import replay
    from splatsoil.files import read_npy, write_bytes
    from splatsoil.report.data import estimates

    path = replay_path(folder, simulate)
    if not path.is_file():
        stream = io.BytesIO()
        values = estimates(folder.fit())
        made = replay(experiment, values, place, progress=lambda what, _: say(what))
        np.save(stream, made, allow_pickle=False)
        write_bytes(path, stream.getvalue())
    return read_npy(path)[None]


def control(
    folder: RunFolder,
    experiment: PlowExperiment,
    simulate: Simulations,
    helper: Replay,
    say: Callable[[str], None],
) -> Callable[[], FloatArray]:
    """Have the replay control made: by a helper, or here and now where there is none. What it returns waits for it."""

    def known() -> FloatArray:
        return replayed(folder, experiment, simulate, folder.path / f"{PLACES}{os.getpid()}", say)

    making = None if replay_path(folder, simulate).is_file() else helper()
    if making is None:
        # One that is kept is read here and now, too: if it is damaged, nothing has been simulated in vain.
        found = known()
        return lambda: found

    def result() -> FloatArray:
        say("a made-up bed through the whole chain")
        wait([making])
        return known()  # made here where no helper could

    return result


def calibrated(
    folder: RunFolder, experiment: PlowExperiment, simulate: Simulations, values: Mapping[str, float]
) -> Calibration | None:
    """What pictures say of cameras, light, clock and tool where soil plays no part, made once and kept in
    ``features/``."""
    import numpy as np

    from splatsoil.experiment.base import Calibration
    from splatsoil.files import code_digest, read_npz, write_npz
    from splatsoil.inverse.evaluations import digest

    names = [p.name for c in experiment.candidates if c.kind == "observation" for p in c.parameters]
    what = {
        **simulate.identity,
        "values": dict(values),
        "calibrated": names,
        "calibration code": code_digest(CALIBRATION),
    }
    path = folder.path / "features" / f"calibration-{digest(what)[:24]}.npz"
    if not path.is_file():
        found = experiment.calibrate(values)
        if found is None:
            return None
        write_npz(path, names=np.array(found.names), estimate=found.estimate, covariance=found.covariance)
    kept = read_npz(path, ("names", "estimate", "covariance"))
    return Calibration(tuple(str(name) for name in kept["names"]), kept["estimate"], kept["covariance"])
