"""Each kind of container, from photographs to a friction angle: the table in docs/scenes.md.

``splatsoil benchmark scenes --page docs/scenes.md`` makes a set of each kind, of one surface and seed, and runs
``splatsoil run SET --no-effects`` on it. Sets and runs are kept in the folder, and a second call continues from there.
With ``--published SET``, a set of the published scene is reconstructed, and its surface compared with the formula.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from splatsoil.benchmarks._common import Clock, markdown, parser_of, stamp, tell, with_section
from splatsoil.envs.measured import reconstructed

from splatsoil.errors import RunError
from splatsoil.files import read_json, write_text
from splatsoil.measurement import CONTAINERS, Measurement
from splatsoil.mpm import PRESETS
from splatsoil.quiet import hush
from splatsoil.reconstruction import Reconstruction
from splatsoil.report.text import no_answer
from splatsoil.run_files import read_fit
from splatsoil.synthetic import Recipe, Setup, make_set, paper, plow

ANGLE, SEED, VIEWS, PICTURE_SCALE = 33.0, 3, 16, 0.5
"""Of the soil, degrees; of surface, looks and noise; photographs; their size over that of the scene."""


def off(made: Reconstruction, setup: Setup) -> tuple[float, float]:
    """Root mean square and median of the surface's error, mm."""
    error = 1e3 * made.surface.difference(setup.surface)
    return float(np.sqrt(np.nanmean(error**2))), float(np.nanmedian(np.abs(error)))


def scene(container: str) -> Setup:
    """The experiment in a container of that kind."""
    return plow(SEED, views=VIEWS, container=container).resized(PICTURE_SCALE)


def found(run: Path, container: str) -> dict[str, Any]:
    """What a run of a set of that kind found, against the truth: dB, mm, degrees."""
    made, fit = Reconstruction.load(run / "reconstruction"), read_fit(run)
    surface, median = off(made, scene(container))
    angle, misfit = fit["parameters"]["friction_angle"], read_json(run / "comparison" / "misfit.json")
    return {
        "container": container,
        "psnr": made.psnr,
        "surface": surface,
        "surface_median": median,
        "estimate": angle["estimate"],
        "std": angle["std"],
        "adequate": bool(misfit["adequate"]),
        "no_answer": no_answer(fit),
    }


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown."""
    head = ("set", "photographs set aside", "surface, root mean square; median", f"angle ({ANGLE:g}°)", "model")
    cells = [
        (
            f"`{row['container']}`",
            f"{row['psnr']:.1f} dB",
            f"{row['surface']:.1f}; {row['surface_median']:.1f} mm",
            row["no_answer"] or f"{row['estimate']:.1f} ± {row['std']:.1f}°",
            "adequate" if row["adequate"] else "not adequate",
        )
        for row in rows
    ]
    return markdown(head, cells)


def answered(container: str, preset: str, device: str, out: Path) -> Path:
    """The run of a set of that kind, which is made, and run, where the folder lacks it.

    Raises:
        RunError: the command ended without a comparison of models.
    """
    place, run = out / "sets" / container, out / "runs" / container
    if not (place / "truth.json").is_file():
        make_set(place, scene(container), Recipe(ANGLE, preset=preset, seed=SEED, device=device))
    if not (run / "comparison" / "misfit.json").is_file():
        words = ["run", str(place), "--run", str(run), "--preset", preset, "--device", device, "--no-effects"]
        code = subprocess.run([sys.executable, "-m", "splatsoil", *words], stdout=sys.stderr, check=False).returncode
        if not (run / "comparison" / "misfit.json").is_file():
            raise RunError(f"{run}: ended with exit code {code} before the comparison of models")
    return run


def published(place: Path, preset: str, device: str, out: Path) -> dict[str, Any]:
    """What a reconstruction of the published scene has, against its formula: dB, mm."""
    made = reconstructed(Measurement.load(place), out / f"published-{preset}", preset, device)
    surface, median = off(made, paper())
    decibels = [view.psnr for view in made.held_out]
    return {
        "preset": preset,
        "psnr": made.psnr,
        "least": min(decibels),
        "most": max(decibels),
        "threshold": float(np.mean([view.displaced for view in made.held_out])),
        "surface": surface,
        "surface_median": median,
    }


def table_of_published(row: Mapping[str, Any]) -> str:
    """Markdown."""
    head = ("preset", "photographs set aside", "threshold", "surface, root mean square; median")
    decibels = f"{row['psnr']:.1f} dB ({row['least']:.1f} to {row['most']:.1f})"
    cells = (f"`{row['preset']}`", decibels, f"{row['threshold']:.1f} dB")
    return markdown(head, [(*cells, f"{row['surface']:.1f}; {row['surface_median']:.1f} mm")])


def main(arguments: Sequence[str] | None = None) -> int:
    """Make, run, print the table, and write it into a page; exit code 0."""
    parser = parser_of(__doc__, "runs/scenes", page=True)
    parser.add_argument("--preset", default="tiny", choices=sorted(PRESETS))
    parser.add_argument("--published", type=Path, metavar="SET", help="a set of the published scene")
    options = parser.parse_args(arguments)
    hush()
    mark, say, rows = f"{'published' if options.published else 'scenes'} {options.preset}", Clock(), []
    if options.page:
        with_section(options.page, mark, "")  # a page without a place for the table fails now, not at the end
    if options.published:
        rows.append(published(options.published, options.preset, options.device, options.out))
    for container in () if options.published else CONTAINERS:
        say(container)
        rows.append(found(answered(container, options.preset, options.device, options.out), container))
    text = table_of_published(rows[0]) if options.published else table(rows)
    if options.page:
        write_text(options.page, with_section(options.page, mark, text))
    tell(options, {"made_by": stamp(options.device), "preset": options.preset, "rows": rows}, text)
    return 0
