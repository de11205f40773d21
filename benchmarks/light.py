"""Is a scene's light read rightly from photographs? Sun and sky found in made-up worlds, against the true ones.

``python -m splatsoil.benchmarks.light SET…`` takes sets whose ``truth.json`` tells their light: those of ``splatsoil
simulate`` and of ``hidden-worlds``. Without sets, ``--count`` worlds of drawn looks are simulated, about 3 minutes each
on two cores, and kept in ``--out``. Each is reconstructed and its light read as any fit does it, with soil, albedo and
shape unknown.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from rich.console import Console
from splatsoil.benchmarks._common import at_least, here, output_options, stamp, write_result

from splatsoil.commands._output import print_json
from splatsoil.errors import MeasurementError, ParameterError
from splatsoil.files import plain, read_json
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.quiet import hush
from splatsoil.reconstruction import reconstruct
from splatsoil.reconstruction.progress import progress_bar
from splatsoil.synthetic import Appearance, make_set, plow

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Score:
    """What one set gave.

    Attributes:
        name: the set.
        turned: angle between the sun's estimated and true directions, degrees.
        share: true share of the light on level ground that comes from the sky, green.
        off: what was estimated minus that; the worst of red, green, blue.
    """

    name: str
    turned: float
    share: float
    off: float


def true_light(folder: Path) -> tuple[FloatArray, FloatArray]:
    """Direction (3,) to the sun, and the sky's share (3,) of the light on level ground, as a set's truth tells them.

    Raises:
        MeasurementError: it doesn't.
    """
    file = folder / "truth.json"
    told = read_json(file) if file.is_file() else {}
    if "appearance" in told:
        light = Appearance(**told["appearance"]).light
    elif "hidden" in told:
        light = Appearance.drawn(int(told["seed"])).light
    else:
        raise MeasurementError(f"{file}: tells nothing of the light; sets of `splatsoil simulate` do")
    return light.direction, light.sky / (light.sky + light.direction[2] * light.sun)


def judge(folder: Path, preset: str, device: str) -> Score:
    """Reconstruct one set and compare its light."""
    direction, share = true_light(folder)
    measurement = Measurement.load(folder)
    with progress_bar(quiet=False) as report:
        reconstruction = reconstruct(measurement, preset=preset, device=device, progress=report)
    light = Model(measurement, reconstruction, preset=preset, device=device).scene().light
    off = light.ambient - share
    turned = math.degrees(math.acos(min(1.0, float(direction @ light.direction))))
    return Score(folder.name, turned, float(share[1]), float(off[np.argmax(np.abs(off))]))


def table(scores: Sequence[Score]) -> str:
    """All sets, and root mean squares, as Markdown."""
    lines = [
        "| set | sun's direction off by | sky's share, true (green) | off by (worst channel) |",
        "|---|---|---|---|",
    ]
    lines += [f"| {s.name} | {s.turned:.2f}° | {s.share:.3f} | {s.off:+.3f} |" for s in scores]
    turned, off = (float(np.sqrt(np.mean(np.square(v)))) for v in ([s.turned for s in scores], [s.off for s in scores]))
    lines.append(f"| root mean square | {turned:.2f}° | | {off:.3f} |")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Command line; exit code 0."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", type=Path, nargs="*", metavar="SET")
    parser.add_argument("--count", type=at_least(1), default=3, help="worlds to make where no sets are given")
    parser.add_argument("--seed", type=int, default=0, help="of the first one")
    parser.add_argument("--preset", default="small", help="of worlds and models")
    parser.add_argument("--device", type=here, default="cpu")
    output_options(parser)
    options = parser.parse_args(arguments)
    hush()
    folders = list(options.sets)
    for folder in folders:
        true_light(folder)  # says what is missing before anything is computed
    if not folders:
        if options.out is None:
            raise ParameterError("worlds to make need a folder, --out DIR")
        folders = [options.out / f"world-{options.seed + k}" for k in range(options.count)]
        for k, folder in enumerate(folders):
            if not (folder / "truth.json").is_file():
                seed = options.seed + k
                with progress_bar(quiet=False) as report:
                    make_set(
                        folder, plow(seed), preset=options.preset, seed=seed, device=options.device, progress=report
                    )
    scores = []
    for folder in folders:
        scores.append(judge(folder, options.preset, options.device))
        Console(stderr=True).print(f"{scores[-1].name}: {scores[-1].turned:.2f}°, {scores[-1].off:+.3f}")
    result = {"ok": True, "made_by": stamp(options.device), "sets": [asdict(s) for s in scores]}
    if options.out is not None:
        write_result(options.out, plain(result), table(scores), {})
    if options.json:
        print_json(plain(result))
    else:
        print(table(scores))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
