"""``splatsoil simulate``: a synthetic measurement set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from splatsoil.commands import _laboratory
from splatsoil.commands._options import ACTING, VALUES, Preset, check_seed
from splatsoil.commands._output import print_result, print_table, stages
from splatsoil.errors import ParameterError
from splatsoil.options import JSON, argument, option
from splatsoil.quiet import hush

if TYPE_CHECKING:
    from splatsoil.synthetic import Setup, World

INTERRUPTED = "nothing was written; start again with"


@dataclass(frozen=True)
class Config:
    """Make a synthetic set of known soil.

    Simulated sand, photographed by a path tracer; truth.json has the parameters.
    """

    out: Path = argument("Folder of the new set; must not exist, or be empty.")
    friction_angle: float = option(35.0, "Of the sand, degrees.")
    effects: tuple[str, ...] = option((), ACTING, name="with", metavar="EFFECT")
    values: tuple[str, ...] = option((), VALUES, name="set", metavar="NAME=VALUE")
    scene: Literal["plow", "paper", "triaxial", "shear_box", "plate", "repose", "column"] = option(
        "plow",
        "plow: a plate of 12 cm in a bed of 0.8 x 0.5 m; paper: Hsiao and Kumar's cube of 1 m, pictures of 1280 x 720; "
        "the others: a laboratory's test, without cameras.",
        expert=True,
    )
    like: Path | None = option(
        None, "Take bed, tool, motion and cameras from this set instead of a scene.", expert=True
    )
    container: Literal["bin", "transparent", "open", "heap"] | None = option(
        None, "Container of the soil of the scene plow; a bin of opaque walls if not given.", expert=True
    )
    depth: float | None = option(None, "Mean depth of the soil in metres; not of the paper's scene.", expert=True)
    preset: Preset | None = option(None, "Resolution of the solver; small unless given, paper for the paper's scene.")
    seed: int = option(0, "Of surface, appearance and noise; one seed gives one set on one processor.", expert=True)
    particle_seed: int | None = option(None, "Of the particles' places; by --seed if not given.", expert=True)
    device: str = option("cpu", "Where to simulate and draw: auto, cpu, cuda:0, …")
    views: int | None = option(None, "Photographs beforehand; 40, or those of --like.", expert=True)
    picture_scale: float = option(1.0, "Size of the pictures, as a multiple of the scene's.", expert=True)
    heights: bool = option(False, "Measure grids of heights, too.", expert=True)
    depth_maps: bool = option(False, "Measure depths by the fixed cameras, too.", expert=True)
    json: bool = option(False, JSON)


def run(config: Config) -> int:
    """Make the set; ParameterError for invalid options."""
    from splatsoil.synthetic import Recipe, make_set
    from splatsoil.synthetic.world import check_place

    values = parse_values(config.values)
    if config.scene not in ("plow", "paper"):
        return _laboratory.simulate(config, {"friction_angle": config.friction_angle, **values})
    hush()
    check_place(config.out)
    setup = choose_setup(config)
    preset = config.preset or ("paper" if config.scene == "paper" and config.like is None else "small")
    with stages(quiet=config.json) as begin:
        recipe = Recipe(
            friction_angle=config.friction_angle,
            effects=config.effects,
            values=values,
            preset=preset,
            seed=config.seed,
            particle_seed=config.particle_seed,
            device=config.device,
            heights=config.heights,
            depth_maps=config.depth_maps,
        )
        world = make_set(config.out, setup, recipe, begin("simulate"))
    summary = _summary(world)
    return print_result(config, summary, lambda: _show(summary))


def parse_values(words: Sequence[str]) -> dict[str, float]:
    """Numbers by name from ``NAME=VALUE`` words; ParameterError for anything else."""
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
        if name == "friction_angle":
            raise ParameterError("the friction angle is given by --friction-angle, not by --set")
        out[name] = number
    return out


def choose_setup(config: Config) -> Setup:
    """The scene of the options."""
    from splatsoil.measurement import BIN, Measurement
    from splatsoil.synthetic import like, paper, plow
    from splatsoil.synthetic.setups import VIEWS

    if config.views is not None and config.views < 1:
        raise ParameterError(f"--views {config.views}: a set needs at least one photograph")
    check_seed(config.seed)
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
        "set": str(measurement.folder),
        "name": measurement.name,
        "hash": measurement.hash,
        **{key: world.truth[key] for key in ("parameters", "effects", "preset", "seed", "particle_seed")},
        "particles": world.particles,
        "views": len(measurement.views),
        "video": len(measurement.video),
        "seconds": dict(world.seconds),
    }


def _show(summary: dict[str, Any]) -> None:
    rows = [(name, f"{value:g}") for name, value in summary["parameters"].items()]
    rows += [
        ("effects", ", ".join(summary["effects"]) or "none"),
        ("particles", f"{summary['particles']}, preset {summary['preset']}, seed {summary['seed']}"),
        ("pictures", f"{summary['views']} views, {summary['video']} of video"),
        ("time", ", ".join(f"{what} {seconds:.0f} s" for what, seconds in summary["seconds"].items())),
    ]
    print_table(f"synthetic set {summary['name']}", (), rows)
    print(f"written to {summary['set']}")
