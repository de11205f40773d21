"""``splatsoil element``: an element test of the soil law."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from splatsoil.commands._options import ACTING, VALUES
from splatsoil.commands._output import print_result, print_table
from splatsoil.commands.simulate import parse_values
from splatsoil.errors import ParameterError
from splatsoil.files import write_bytes
from splatsoil.options import JSON, option
from splatsoil.quiet import hush

if TYPE_CHECKING:
    from splatsoil.soil.law import Law

INTERRUPTED = "the plot was not written; start again with"


@dataclass(frozen=True)
class Config:
    """An element test of the soil law, as a table and a plot."""

    test: Literal["triaxial", "extension", "simple-shear", "isotropic"] = option(
        "triaxial", "Drained triaxial compression or extension, simple shear, or isotropic compression."
    )
    confining: float = option(100e3, "Confining stress in Pa.")
    friction_angle: float = option(35.0, "Of the soil, degrees.")
    effects: tuple[str, ...] = option((), ACTING, name="with", metavar="EFFECT")
    values: tuple[str, ...] = option((), VALUES, name="set", metavar="NAME=VALUE")
    strain: float = option(0.2, "Largest logarithmic strain: of the axis, or of shear; at most 10.")
    pressure: float | None = option(
        None, "Largest pressure of the isotropic test in Pa; ten times the confining stress unless given."
    )
    records: int = option(100, "Points of the curve, 2 to 100000.", expert=True)
    void_ratio: float = option(0.8, "At the start.", expert=True)
    young: float = option(5.0e7, "Young's modulus in Pa.", expert=True)
    poisson: float = option(0.2, "Poisson's ratio.", expert=True)
    strain_rate: float = option(1.0e-5, "In 1/s; used by effects of rate only.", expert=True)
    depth: float = option(0.0, "Below the undisturbed surface in metres; used by effects of depth only.", expert=True)
    matching: Literal["compression", "extension", "plane_strain", "simple_shear"] = option(
        "compression", "Where the Drucker-Prager cone agrees with Mohr-Coulomb.", expert=True
    )
    plot: Path = option(Path("element.png"), "File for the plot (png, svg or pdf).")
    json: bool = option(False, JSON)


LARGEST_STRAIN, MOST_RECORDS = 10.0, 100_000
#: Rows of the table.
ROWS = 12
#: Minimum span of a plot's axis: of stresses, relative to the largest; of volume strain and void ratio.
LEAST_SPAN, LEAST_STRAIN = 0.02, 1.0e-3


def run(config: Config) -> int:
    """Test, print and plot."""
    from splatsoil.soil.law import Law
    from splatsoil.soil.library import find_effects

    hush()
    values = parse_values(config.values)
    if not 2 <= config.records <= MOST_RECORDS:
        raise ParameterError(f"--records: a curve has 2 to {MOST_RECORDS} points, not {config.records}")
    if config.plot.suffix not in (".png", ".svg", ".pdf"):
        raise ParameterError(f"--plot {config.plot}: give a file that ends in .png, .svg or .pdf")
    law = Law(find_effects(config.effects))
    full = law.require_on({**values, "friction_angle": config.friction_angle})
    refuse_idle(law, full)
    parameters, columns = perform(law, full, config)
    draw(columns, config)
    data = {
        "test": config.test,
        "parameters": parameters,
        "effects": [effect.name for effect in law.effects],
        "plot": str(config.plot),
        "records": {name: [float(v) for v in column] for name, column in columns.items()},
    }
    return print_result(config, data, lambda: show(columns, config))


def refuse_idle(law: Law, values: dict[str, float]) -> None:
    """ParameterError for effects that do not act on a specimen, such as those of tools, gravity and cameras."""
    from splatsoil.soil.law import INTERCEPT_PER_COHESION, SLOPE, STIFFNESS, Law
    from splatsoil.soil.settings import Settings

    felt = [int(SLOPE), int(INTERCEPT_PER_COHESION), int(STIFFNESS)]
    angle = {"friction_angle": values["friction_angle"]}
    base = Settings(friction_angle=values["friction_angle"])
    for effect in law.effects:
        mine = {p.name: values[p.name] for p in effect.parameters} | angle
        with_it, without = Law([effect]).table(base, [mine])[0, felt], Law().table(base, [angle])[0, felt]
        if effect.strength is None and (with_it == without).all():
            raise ParameterError(f"effect {effect.name} does not act on a specimen; leave it out of the element test")


def perform(law: Law, values: dict[str, float], config: Config) -> tuple[dict[str, float], dict[str, Any]]:
    """Parameters, and the curve as columns (records + 1,); the first is the abscissa."""
    from splatsoil.soil.element import Options, isotropic_compression, simple_shear, triaxial
    from splatsoil.soil.matching import Matching

    if not 0.0 < config.strain <= LARGEST_STRAIN:
        raise ParameterError(f"--strain: {config.strain:g} is not a strain above 0 and up to {LARGEST_STRAIN:g}")
    options = Options(
        void_ratio=config.void_ratio,
        young=config.young,
        poisson=config.poisson,
        strain_rate=config.strain_rate,
        depth=config.depth,
        matching=Matching(config.matching),
    )
    confining, path = config.confining, np.linspace(0.0, 1.0, config.records + 1)[1:]
    strains = config.strain * path
    if config.test == "isotropic":
        top = 10.0 * confining if config.pressure is None else config.pressure
        pressures = confining + path * (top - confining)
        result = isotropic_compression(law, values, confining=confining, pressures=pressures, **options)
        columns = {"p [Pa]": result.p[0]}
    elif config.test == "simple-shear":
        result = simple_shear(law, values, confining=confining, strains=strains, **options)
        columns = {"shear strain": result.shear_strain[0], "shear stress [Pa]": result.shear_stress[0]}
        columns["normal stress [Pa]"] = result.stress[0, :, 2]
    else:
        sign = 1.0 if config.test == "triaxial" else -1.0
        result = triaxial(law, values, confining=confining, strains=sign * strains, **options)
        columns = {"axial strain": result.axial_strain[0], "q [Pa]": result.q[0], "p [Pa]": result.p[0]}
    columns |= {"volume strain": result.volume_strain[0], "void ratio": result.void_ratio[0]}
    return dict(result.values[0]), columns


def draw(columns: dict[str, Any], config: Config) -> None:
    """Plot each column over the first."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    (across, x), *others = columns.items()
    figure = Figure(figsize=(3.2 * len(others), 2.8), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (name, y) in zip(figure.subplots(1, len(others), squeeze=False)[0], others, strict=True):
        axes.plot(x, y)
        axes.ticklabel_format(useOffset=False)
        axes.locator_params(axis="x", nbins=4)
        # a constant is drawn as a constant, without its rounding error
        least = LEAST_SPAN * float(np.abs(y).max()) if "Pa" in name else LEAST_STRAIN
        middle = 0.5 * float(y.min() + y.max())
        if float(y.max() - y.min()) < least:
            axes.set_ylim(middle - 0.5 * least, middle + 0.5 * least)
        axes.set_xlabel(across)
        axes.set_ylabel("volume strain, + denser" if name == "volume strain" else name)
        axes.grid(alpha=0.3)
    on = ", ".join(Path(name).stem for name in config.effects) or "base law"
    title = f"{config.test}, {config.confining:g} Pa, φ = {config.friction_angle:g}°, {' '.join((on, *config.values))}"
    figure.suptitle(title, fontsize=10, parse_math=False)
    stream = io.BytesIO()
    figure.savefig(stream, format=config.plot.suffix[1:], dpi=150)
    write_bytes(config.plot, stream.getvalue())


def show(columns: dict[str, Any], config: Config) -> None:
    """Print a dozen rows of the curve."""
    shown = np.unique(np.linspace(0, config.records, min(ROWS, config.records + 1)).astype(int))
    rows = ([f"{column[k]:.5g}" for column in columns.values()] for k in shown)
    print_table(f"{config.test} test at {config.confining:g} Pa", tuple(columns), rows, left=())
    print(f"plot: {config.plot}")
