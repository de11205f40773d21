"""The whole way on a GPU, as a user has it: photographs to the angle, and then what is missing."""

from __future__ import annotations

import time
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Literal, cast

from splatsoil.benchmarks._speed.clock import synchronise
from splatsoil.benchmarks._speed.rows import Group, Row, Sample, judged

from splatsoil.commands import diagnose, fit
from splatsoil.soil.library import library

EVALUATIONS = 10
INVERSION, DIAGNOSIS = 60.0, 60.0
"""Most seconds."""
EFFECTS = 8


def invert(folder: Path, run: Path, preset: str, device: str, budget: int = EVALUATIONS) -> float:
    """Seconds of ``splatsoil fit`` in a new run folder, the reconstruction in them."""
    # the command line's own check of a preset is its type
    known = cast(Literal["tiny", "small", "paper", "fine"], preset)
    began = time.perf_counter()
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        fit.run(fit.Config(folder, run=run, preset=known, device=device, budget=budget))
    synchronise(device)
    return time.perf_counter() - began


def inversion(folder: Path, preset: str, device: str, work: Path, evaluations: int = EVALUATIONS) -> Group:
    """Reconstruct and fit in ``work / "run"``; the kernels are compiled by a tiny fit before."""
    invert(folder, work / "warm", "tiny", device, 2)
    seconds = Sample((invert(folder, work / "run", preset, device, evaluations),))
    row = Row(
        f"photographs to the friction angle: reconstruction and {evaluations} evaluations",
        "s",
        seconds,
        target=f"≤ {INVERSION:g} s",
        met=judged(seconds, INVERSION, "less"),
    )
    return Group("Whole inversion", (row,), (f"Preset `{preset}`, what `splatsoil fit {folder.name}` does.",))


def considered(count: int = EFFECTS) -> tuple[str, ...]:
    """The first effects of the library, by name."""
    return tuple(sorted(library()))[:count]


def diagnosis(folder: Path, preset: str, device: str, work: Path, effects: tuple[str, ...] = ()) -> Group:
    """A diagnosis of eight effects of the fit in ``work / "run"``, which is made before if there is none."""
    chosen = effects or considered()
    run = work / "run"
    if not run.is_dir():
        invert(folder, run, preset, device)
    began = time.perf_counter()
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
        diagnose.run(diagnose.Config(run=run, effects=chosen, device=device))
    synchronise(device)
    seconds = Sample((time.perf_counter() - began,))
    row = Row(
        f"diagnosis of {len(chosen)} effects",
        "s",
        seconds,
        target=f"≤ {DIAGNOSIS:g} s",
        met=judged(seconds, DIAGNOSIS, "less"),
    )
    return Group("Diagnosis", (row,), (f"Effects {', '.join(chosen)}.",))
