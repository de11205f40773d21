"""``splatsoil simulate``: a synthetic measurement set, with any effect on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from tyro.conf import Positional

from splatsoil.commands._options import command_line
from splatsoil.commands._output import print_json
from splatsoil.errors import ParameterError

if TYPE_CHECKING:
    from splatsoil.synthetic import Setup, World


@dataclass(frozen=True)
class Config:
    """Make a synthetic set of known soil.

    Simulated sand, photographed by a path tracer; truth.json says the parameters.
    """

    out: Positional[Path]
    """Folder of the new set; must not exist, or be empty."""
    friction_angle: float = 35.0
    """Of the sand, degrees."""
    effects: Annotated[tuple[str, ...], tyro.conf.arg(name="with", metavar="EFFECT …")] = ()
    """Effects that act, or files that define some."""
    values: Annotated[tuple[str, ...], tyro.conf.arg(name="set", metavar="NAME=VALUE …")] = ()
    """Parameters of the effects."""
    scene: Literal["plow", "paper", "triaxial", "shear_box", "plate", "repose", "column"] = "plow"
    """plow: a plate of 12 cm in a bed of 0.8 x 0.5 m; paper: Hsiao and Kumar's cube of 1 m, pictures of 1280 x 720; the
    others: a laboratory's test, without cameras."""
    like: Path | None = None
    """Take bed, tool, motion and cameras from this set instead of a scene."""
    container: Literal["bin", "transparent", "open", "heap"] | None = None
    """What holds the soil of the scene plow; a bin of opaque walls if not given."""
    depth: float | None = None
    """Mean depth of the soil in metres (not for the paper's scene, whose surface is a formula)."""
    preset: Literal["tiny", "small", "paper", "fine"] | None = None
    """Resolution of the solver; small unless given, paper for the paper's scene."""
    seed: int = 0
    """Of surface, appearance and noise; one seed gives one set on one processor."""
    particle_seed: int | None = None
    """Of the particles' places; drawn by the seed unless given."""
    device: str = "cpu"
    """Where to simulate and draw: auto, cpu, cuda:0, …"""
    views: int | None = None
    """Photographs before anything moves; 40, or all of the set given by --like."""
    picture_scale: float = 1.0
    """Size of the pictures, as a multiple of the scene's."""
    json: bool = False
    """Print one JSON object instead of a table."""


def run(config: Config) -> int:
    """Make the set; ParameterError for options that make no sense, before anything is computed."""
    values = parse_values(config.values)
    if "friction_angle" in values:
        raise ParameterError("the friction angle is given by --friction-angle, not by --set")
    if config.scene not in ("plow", "paper"):
        from splatsoil.commands import _laboratory as laboratory

        values = {"friction_angle": config.friction_angle, **values}
        preset = config.preset or "small"
        return laboratory.simulate(
            config.scene, config.out, values, config.effects, preset, config.seed, quiet=config.json
        )
    from splatsoil.quiet import hush
    from splatsoil.reconstruction.progress import progress_bar
    from splatsoil.synthetic import make_set
    from splatsoil.synthetic.world import check_place

    hush()
    check_place(config.out)
    setup = choose_setup(config)
    preset = config.preset or ("paper" if config.scene == "paper" and config.like is None else "small")
    with progress_bar(quiet=config.json) as report:
        world = make_set(
            config.out,
            setup,
            friction_angle=config.friction_angle,
            effects=config.effects,
            values=values,
            preset=preset,
            seed=config.seed,
            particle_seed=config.particle_seed,
            device=config.device,
            progress=report,
        )
    if config.json:
        print_json({"ok": True, **_summary(world)})
    else:
        _show(world)
    return 0


def interrupted(config: Config) -> str:
    """A set is written when it is complete."""
    again = command_line(
        "simulate",
        (config.out,),
        (
            ("--friction-angle", config.friction_angle, 35.0),
            ("--with", config.effects, ()),
            ("--set", config.values, ()),
            ("--scene", config.scene, "plow"),
            ("--like", config.like, None),
            ("--container", config.container, None),
            ("--depth", config.depth, None),
            ("--preset", config.preset, None),
            ("--seed", config.seed, 0),
            ("--particle-seed", config.particle_seed, None),
            ("--device", config.device, "cpu"),
            ("--views", config.views, None),
            ("--picture-scale", config.picture_scale, 1.0),
            ("--json", config.json, False),
        ),
    )
    return f"nothing was written; start again with: {again}"


def parse_values(words: Sequence[str]) -> dict[str, float]:
    """``NAME=VALUE`` words to numbers by name; ParameterError for anything else."""
    out: dict[str, float] = {}
    for word in words:
        name, sign, text = word.partition("=")
        try:
            number = float(text)
        except ValueError:
            sign = ""
        if not sign or not name:
            raise ParameterError(f"--set {word}: write NAME=VALUE with a number, for example cohesion=300")
        if name in out:
            raise ParameterError(f"--set {word}: {name} is given twice")
        out[name] = number
    return out


def choose_setup(config: Config) -> Setup:
    """The scene that the options describe."""
    from splatsoil.measurement import BIN, Measurement
    from splatsoil.synthetic import like, paper, plow
    from splatsoil.synthetic.setups import VIEWS

    if config.views is not None and config.views < 1:
        raise ParameterError(f"--views {config.views}: a set needs at least one photograph")
    if config.seed < 0:
        raise ParameterError(f"--seed {config.seed}: seeds are whole numbers from 0 on")
    if config.scene == "paper" and (config.like is not None or config.depth is not None):
        raise ParameterError("--scene paper is a scene of its own; leave --like and --depth out")
    if config.container is not None and (config.scene == "paper" or config.like is not None):
        raise ParameterError("--container is for the scene plow; leave --scene paper and --like out")
    views = config.views or VIEWS
    if config.like is not None:
        setup = like(Measurement.load(config.like), config.seed, views=config.views, depth=config.depth)
    elif config.scene == "paper":
        setup = paper(views=views)
    else:
        setup = plow(config.seed, views=views, depth=config.depth, container=config.container or BIN)
    return setup if config.picture_scale == 1.0 else setup.resized(config.picture_scale)


def _summary(world: World) -> dict[str, Any]:
    measurement = world.measurement
    return {
        "out": str(measurement.folder),
        "name": measurement.name,
        "hash": measurement.hash,
        **{key: world.truth[key] for key in ("parameters", "effects", "preset", "seed", "particle_seed")},
        "particles": world.particles,
        "views": len(measurement.views),
        "video": len(measurement.video),
        "seconds": dict(world.seconds),
    }


def _show(world: World) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    summary = _summary(world)
    table = Table(title=f"synthetic set {escape(summary['name'])}", show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    for name, value in summary["parameters"].items():
        table.add_row(name, f"{value:g}")
    table.add_row("effects", escape(", ".join(summary["effects"])) or "none")
    table.add_row("particles", f"{summary['particles']}, preset {summary['preset']}, seed {summary['seed']}")
    table.add_row("pictures", f"{summary['views']} views, {summary['video']} of video")
    spent = ", ".join(f"{what} {seconds:.0f} s" for what, seconds in summary["seconds"].items())
    table.add_row("time", spent)
    console = Console(highlight=False)
    console.print(table)
    console.print(f"written to {escape(summary['out'])}")
