"""Figures as SVG whose colours are the page's CSS variables, so that they follow its light or dark theme.

Each has a text alternative.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from html import escape
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from splatsoil.report.data import Surface
from splatsoil.report.text import BEYOND, SIGNIFICANT, block

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Colours matplotlib draws with, and the variables they stand for: reserved, so that nothing else is replaced.
INK, FAINT, ACCENT, SECOND, PAPER = "#010203", "#010204", "#010205", "#010206", "#010207"
VARIABLES = {INK: "--ink", FAINT: "--faint", ACCENT: "--accent", SECOND: "--second", PAPER: "--paper"}

#: Small on purpose: at a phone's width the text is still as large as the page's.
SIZE = (3.7, 2.5)

STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "splatsoil",
    "font.size": 9.0,
    "text.color": INK,
    "text.parse_math": False,  # names may hold a $
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.facecolor": "none",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.facecolor": "none",
    "xtick.color": INK,
    "ytick.color": INK,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
}


def _draw(draw: Any, shows: str, size: tuple[float, float] = SIZE) -> Markup:
    """SVG of what ``draw(figure, axes)`` draws, and what that ``shows`` in words."""
    import matplotlib as mpl
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with mpl.rc_context(STYLE):  # type: ignore[arg-type]
        figure = Figure(figsize=size, layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure, figure.subplots())
        stream = io.StringIO()
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None}, transparent=True)
    svg = stream.getvalue()
    svg = svg[svg.index("<svg") :]
    # The page sets the size and the typeface.
    head, rest = svg.split(">", 1)
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    svg = f'{head} role="img" aria-label="{escape(shows)}">{rest}'
    svg = re.sub(r"font: (\d+(?:\.\d+)?)px [^;\"]*", r"font-size: \1px", svg)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    for colour, variable in VARIABLES.items():
        svg = svg.replace(colour, f"var({variable})")
    return Markup(svg)


def surrogate(fit: Mapping[str, Any], name: str) -> Markup:
    """The GP over one parameter with its evaluations: the paper's figure."""
    curve, entry = fit["curves"][name], fit["parameters"][name]
    x, mean, std = (np.array(curve[key]) for key in ("x", "mean", "std"))
    done = [step for step in fit["history"] if step["loss"] is not None]
    failed = [step for step in fit["history"] if step["loss"] is None]

    def draw(figure: Figure, axes: Axes) -> None:
        axes.fill_between(x, mean - 2.0 * std, mean + 2.0 * std, color=ACCENT, alpha=0.18, linewidth=0, label="± 2 std")
        axes.plot(x, mean, color=ACCENT, label="mean of the GP")
        axes.axvspan(entry["low"], entry["high"], color=SECOND, alpha=0.15, linewidth=0)
        axes.axvline(entry["estimate"], color=SECOND, label="estimate, 5 to 95 %")
        points = [step["parameters"][name] for step in done]
        axes.scatter(points, [step["loss"] for step in done], s=22, color=INK, zorder=3, label="evaluation")
        top = max(float(np.max(mean + 2.0 * std)), max(step["loss"] for step in done))
        for step in failed:
            axes.scatter(step["parameters"][name], top, marker="x", color=SECOND, zorder=3)
        axes.set_xlabel(entry["title"])
        axes.set_ylabel("loss")
        axes.margins(x=0.01)
        figure.legend(fontsize=8, loc="outside upper center", ncols=2, columnspacing=1.0)

    return _draw(draw, f"loss over the {name.replace('_', ' ')}", (SIZE[0], 2.9))


def marginal(entry: Mapping[str, Any]) -> Markup:
    """What the pictures leave possible of one parameter: its posterior density over its prior's, and both intervals.

    The axis is the prior's, on which the prior is flat: a logarithmic one where the parameter is searched on one.
    """
    edges, density = np.array(entry["histogram"]["edges"]), np.array(entry["histogram"]["density"])
    places = np.linspace(0.0, 1.0, len(edges))

    def place(value: float) -> float:
        return float(np.interp(value, edges, places))

    def draw(figure: Figure, axes: Axes) -> None:
        axes.stairs(density, places, fill=True, color=ACCENT, alpha=0.3)
        axes.stairs(density, places, color=ACCENT, linewidth=1.2, label="posterior")
        axes.axhline(1.0, color=FAINT, linestyle="--", linewidth=1.2, label="prior")
        if entry["verdict"] != "not determined":
            height = -0.06 * max(float(density.max()), 1.0)
            axes.plot([place(entry["low"]), place(entry["high"])], [height] * 2, color=SECOND, label="90 %, 50 %")
            axes.plot([place(entry["low_50"]), place(entry["high_50"])], [height] * 2, color=SECOND, linewidth=5.0)
        axes.axhline(0.0, color=FAINT, linewidth=0.8)
        ticks = np.linspace(0.0, 1.0, 5)
        axes.set_xticks(ticks, [f"{np.interp(t, places, edges):.4g}" for t in ticks])
        axes.set_xlim(0.0, 1.0)
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.set_xlabel(entry["title"])
        figure.legend(fontsize=8, loc="outside upper center", ncols=3, columnspacing=1.0)

    return _draw(draw, f"prior and posterior of the {entry['title']}", (SIZE[0], 2.2))


def losses(comparison: Mapping[str, Any]) -> Markup:
    """Loss of each compared frame, for each camera, and the noise level."""
    name = comparison["loss"]

    def draw(_: Figure, axes: Axes) -> None:
        for camera, colour, marker in zip(
            comparison["cameras"], cycle((ACCENT, SECOND, INK, FAINT)), cycle("os^Dv<>"), strict=False
        ):
            steps = sorted((f for f in comparison["frames"] if f["camera"] == camera), key=lambda f: f["frame"])
            frames = [f["frame"] for f in steps]
            axes.plot(frames, [f["losses"][name] for f in steps], color=colour, marker=marker, ms=3.5, label=camera)
        noise = comparison.get("noise", {}).get(name)
        if noise:
            axes.axhline(noise, color=FAINT, linestyle="--", linewidth=1.2, label="noise level")
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel("frame")
        axes.set_ylabel(f"loss ({name})")
        axes.legend(fontsize=8)

    return _draw(draw, "loss of each frame by camera")


def surface_map(surface: Surface) -> Markup:
    """The reconstructed surface seen from above."""

    def draw(figure: Figure, axes: Axes) -> None:
        half_x, half_y = 0.5 * (surface.x[1] - surface.x[0]), 0.5 * (surface.y[1] - surface.y[0])
        extent = (surface.x[0] - half_x, surface.x[-1] + half_x, surface.y[0] - half_y, surface.y[-1] + half_y)
        image = axes.imshow(1e3 * surface.height, origin="lower", extent=extent, cmap="cividis")
        bar = figure.colorbar(image, ax=axes, shrink=0.9, pad=0.02)
        bar.outline.set_visible(False)
        bar.set_label("height [mm]")
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")

    return _draw(draw, "height of the bed from above")


def falling(errors: Sequence[float], noise: Sequence[float], names: Sequence[str], unit: str) -> Markup:
    """The error on data set aside of models in turn, and the noise level."""

    def draw(_: Figure, axes: Axes) -> None:
        places = np.arange(len(errors))
        axes.bar(places, errors, color=ACCENT, alpha=0.75, width=0.55)
        for place, error in zip(places, errors, strict=True):
            axes.text(float(place), error, f"{error:.2g}", ha="center", va="bottom", color=INK)
        edges = [-0.45, *(places + 0.5)]
        axes.step(edges, [noise[0], *noise], color=SECOND, linestyle="--", linewidth=1.4, label="noise level")
        axes.set_xticks(places, names)
        axes.set_xlim(-0.5, len(errors) - 0.5)
        axes.set_ylim(0.0, 1.18 * max(*errors, *noise))
        axes.set_ylabel(f"error, {unit}")
        axes.legend(fontsize=8)

    rows = (f"{name}: {error:.2g}, noise {level:.2g}" for name, error, level in zip(names, errors, noise, strict=True))
    return _draw(draw, f"error of models on data set aside, {unit}; {'; '.join(rows)}")


def readings(
    channel: str,
    unit: str,
    measured: Sequence[np.ndarray],
    predicted: Mapping[str, Sequence[np.ndarray]],
    expected: Sequence[np.ndarray] | None,
    time_name: str,
) -> Markup:
    """What an instrument without a place measured, and what models predict.

    Args:
        channel: its name.
        unit: of what it reads.
        measured: times and readings (n,), NaN where there is none.
        predicted: times and readings by model.
        expected: times, and readings one expected standard deviation below and above what was measured; None where that
            has not been estimated.
        time_name: what the times are.
    """

    def draw(figure: Figure, axes: Axes) -> None:
        if expected is not None:
            times, low, high = expected
            axes.fill_between(times, low, high, color=FAINT, alpha=0.3, linewidth=0, label="± expected std")
        axes.plot(*measured, "o", markersize=3.5, color=INK, label="measured")
        for (title, line), colour, style in zip(predicted.items(), (ACCENT, SECOND), ("-", "--"), strict=False):
            axes.plot(*line, color=colour, linestyle=style, label=title)
        axes.axhline(0.0, color=FAINT, linewidth=0.6)
        axes.set_ylabel(f"{channel} [{unit}]")
        axes.set_xlabel(time_name)
        figure.legend(fontsize=8, loc="outside upper center", ncols=2, columnspacing=1.0)

    return _draw(draw, f"measured and predicted {channel} [{unit}]", (SIZE[0], 2.7))


def plan_maps(judged: Mapping[str, Any], which: Sequence[tuple[str, str]]) -> list[Markup]:
    """Residuals over expected noise from above: one row for each stage, one column for each instrument that has places.

    Args:
        judged: a diagnosis or a comparison.
        which: a title and a key of the maps for each figure; all have colours of one scale.
    """
    placed = [i for i, site in enumerate(judged["sites"]) if site[1] is not None]
    tables = [np.array(judged["maps"][key], dtype=np.float64)[:, placed] for _, key in which]
    limit = max(3.0, min(max(float(np.nanpercentile(np.abs(table), 99.0)) for table in tables), 15.0))
    return [_plan_map(judged, placed, table, limit, title) for table, (title, _) in zip(tables, which, strict=True)]


def _plan_map(judged: Mapping[str, Any], placed: Sequence[int], table: np.ndarray, limit: float, title: str) -> Markup:
    sites, stages = [judged["sites"][i] for i in placed], judged["stages"]
    channels = list(dict.fromkeys(site[0] for site in sites))
    names = list(dict.fromkeys(stages))
    failing = [check for check in judged["checks"] if check["p"] < SIGNIFICANT]

    def draw(figure: Figure, axes: Axes) -> None:
        axes.remove()
        grid = figure.subplots(len(names), len(channels), squeeze=False, sharex=True, sharey=True)
        shown = None
        for row, name in enumerate(names):
            own = [i for i, stage in enumerate(stages) if stage == name]
            rows = table[own]
            for column, channel in enumerate(channels):
                mine = [i for i, site in enumerate(sites) if site[0] == channel]
                x, y = np.array([sites[i][1:3] for i in mine], dtype=np.float64).round(6).T
                (xs, at_x), (ys, at_y) = (np.unique(places, return_inverse=True) for places in (x, y))
                image = np.full((len(ys), len(xs)), np.nan)
                image[at_y, at_x] = np.ma.masked_invalid(rows[:, mine]).mean(axis=0).filled(np.nan)
                place = grid[row][column]
                shown = place.pcolormesh(xs, ys, image, cmap="RdBu_r", vmin=-limit, vmax=limit, rasterized=False)
                failed = [c["region"] for c in failing if (c["stage"], c["channel"]) == (name, channel)]
                outlined = [i for i in mine if {judged["regions"][r][placed[i]] for r in own} & set(failed)]
                _outline(place, xs, ys, [sites[i][1:3] for i in outlined])
                place.set_aspect("equal")
                if row == 0:
                    place.set_title(channel, fontsize=9)
                if column == 0:
                    place.set_ylabel(name, fontsize=8)
                place.tick_params(labelsize=7)
        assert shown is not None
        for place in grid[-1]:
            place.set_xlabel("x [m]", fontsize=8)
        figure.supylabel("y [m]", fontsize=8)
        bar = figure.colorbar(shown, ax=grid.ravel().tolist(), shrink=0.8, pad=0.02)
        bar.set_label("residual / expected std")

    return _draw(draw, f"residual over expected noise from above: {title}", (SIZE[0], 0.7 + 0.82 * len(names)))


def _outline(place: Axes, xs: np.ndarray, ys: np.ndarray, centres: Sequence[Sequence[float]]) -> None:
    """Draw a line around cells of a plan, given their centres (x, y)."""
    from matplotlib.patches import Rectangle

    width, height = (float(np.diff(axis).min(initial=np.inf)) for axis in (xs, ys))
    for x, y in centres if np.isfinite([width, height]).all() else ():
        corner = (x - 0.5 * width, y - 0.5 * height)
        place.add_patch(Rectangle(corner, width, height, fill=False, edgecolor=INK, linewidth=0.7))


def outlined(check: Mapping[str, Any], judged: Mapping[str, Any], squares: Mapping[int, float]) -> Markup:
    """Squares of a block that fails, to lie over the picture in which they were seen.

    Args:
        check: the block.
        judged: a diagnosis or a comparison.
        squares: residual over expected standard deviation by site.
    """
    shapes = [
        f'<polygon points="{" ".join(f"{u},{v}" for u, v in judged["sites"][site][3])}"'
        f' class="{"beyond" if abs(value) > BEYOND else "within"}"/>'
        for site, value in sorted(squares.items(), key=lambda item: abs(item[1]))
    ]
    shows = f"outlined: {block(check)}"
    return Markup(
        f'<svg viewBox="0 0 1 1" preserveAspectRatio="none" role="img" aria-label="{escape(shows)}">'
        f"{''.join(shapes)}</svg>"
    )
