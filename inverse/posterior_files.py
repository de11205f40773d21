"""A posterior as files: ArviZ InferenceData, and figures."""

from __future__ import annotations

import io
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from splatsoil.errors import RunError
from splatsoil.files import write_bytes
from splatsoil.parameters import Parameter, ParameterSpace

from .posterior import verdicts

if TYPE_CHECKING:
    import arviz
    from matplotlib.figure import Figure

    from .posterior import Posterior

FloatArray = npt.NDArray[np.float64]

#: Draws from which posterior predictive features are made.
PREDICTIVE = 200


def inference_data(posterior: Posterior) -> arviz.InferenceData:
    """Groups ``posterior``, ``sample_stats``, ``posterior_predictive``, ``observed_data`` and ``prior``.

    A chain is an ensemble of walkers. Features are projected, as a comparison projects them (``score``).
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # a remark on its next major version
        import arviz

    space, chains = posterior.density.prior.space, posterior.chains
    n = len(space)
    values = space.from_unit(chains.samples).reshape(chains.samples.shape[0], -1, n)
    prior = space.from_unit(np.random.default_rng(0).uniform(-1.0, 1.0, (1, 4000, n)))
    return arviz.from_dict(
        posterior={name: values[..., i] for i, name in enumerate(space.names)},
        sample_stats={"lp": chains.log_density.reshape(values.shape[0], -1)},
        posterior_predictive={"scores": predictive_scores(posterior, PREDICTIVE)[None]},
        observed_data={"scores": posterior.density.noise.observed},
        prior={name: prior[..., i] for i, name in enumerate(space.names)},
        dims={"scores": ["score"]},
        attrs={"made_by": "splatsoil", "units": ", ".join(f"{p.name}: {p.unit}" for p in space)},
    )


def write_inference_data(posterior: Posterior, path: Path) -> Path:
    """As NetCDF, whole or not at all; ``arviz.from_netcdf`` reads it."""
    data = inference_data(posterior)
    try:
        with tempfile.TemporaryDirectory() as folder:
            made = Path(data.to_netcdf(str(Path(folder) / path.name), engine="h5netcdf"))
            return write_bytes(path, made.read_bytes())
    except OSError as error:
        raise RunError(f"{path}: cannot be made ({error}); free some space and try again") from error


def predictive_scores(posterior: Posterior, count: int, seed: int = 0) -> FloatArray:
    """(count, p) scores that would be observed again, every source of doubt included."""
    rng = np.random.default_rng(seed)
    points = posterior.unit[rng.choice(len(posterior.unit), count)]
    return posterior.density.replicates(points, rng)


def write_figures(posterior: Posterior, own: Sequence[Parameter], folder: Path) -> list[str]:
    """Write corner, trace and scores ``.png``; their names.

    Args:
        posterior: to draw.
        own: the parameters with their own bounds, which frame the corner.
        folder: where to.
    """
    import matplotlib

    with matplotlib.rc_context({"font.size": 9, "figure.dpi": 110}):
        figures = {
            "corner.png": corner_figure(posterior, own),
            "trace.png": trace_figure(posterior),
            "scores.png": scores_figure(posterior),
        }
        for name, figure in figures.items():
            stream = io.BytesIO()
            figure.savefig(stream, format="png", bbox_inches="tight")
            write_bytes(folder / name, stream.getvalue())
    return list(figures)


def corner_figure(posterior: Posterior, own: Sequence[Parameter]) -> Figure:
    """Every parameter and every pair; the frame is their own bounds, and what is not determined gets no number."""
    import corner
    from matplotlib.figure import Figure

    space = ParameterSpace(own)
    figure = Figure(figsize=(2.2 * len(space) + 1.0, 2.2 * len(space) + 1.0))
    corner.corner(
        posterior.values,
        fig=figure,
        labels=[p.title for p in space],
        range=[(p.lower, p.upper) for p in space],
        axes_scale=["log" if p.log else "linear" for p in space],
        quantiles=[0.05, 0.5, 0.95],
        bins=40,
        quiet=True,
    )
    axes = np.array(figure.axes).reshape(len(space), len(space))
    for i, (p, verdict) in enumerate(zip(space, verdicts(posterior.unit), strict=True)):
        low, median, high = (f"{q:.4g}" for q in np.quantile(posterior.values[:, i], [0.05, 0.5, 0.95]))
        told = "not identified" if verdict == "not determined" else f"{median} ({low} to {high})"
        axes[i, i].set_title(f"{p.label or p.name.replace('_', ' ')}: {told}", fontsize=8)
    return figure


def trace_figure(posterior: Posterior) -> Figure:
    """Each ensemble's median and central 90 % of walkers against steps."""
    from matplotlib.figure import Figure

    space, samples = posterior.density.prior.space, posterior.chains.samples
    figure = Figure(figsize=(8.0, 1.8 * len(space) + 0.4), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(space), 1, sharex=True))
    values = space.from_unit(samples)
    for i, (axis, p) in enumerate(zip(axes, space, strict=True)):
        for e in range(len(samples)):
            low, middle, high = np.quantile(values[e, :, :, i], [0.05, 0.5, 0.95], axis=1)
            axis.fill_between(np.arange(len(middle)), low, high, color=f"C{e}", alpha=0.12, linewidth=0)
            axis.plot(middle, color=f"C{e}", linewidth=0.8, label=f"ensemble {e}")
        axis.set_ylabel(p.title)
    axes[0].legend(ncols=len(samples), fontsize=7, loc="upper right")
    axes[-1].set_xlabel("kept steps")
    return figure


def scores_figure(posterior: Posterior) -> Figure:
    """The observed scores among those that the posterior predicts."""
    from matplotlib.figure import Figure

    draws = predictive_scores(posterior, PREDICTIVE)
    observed = posterior.density.noise.observed
    unit = draws.std(axis=0)
    figure = Figure(figsize=(min(0.7 * len(observed) + 2.5, 14.0), 2.8), layout="constrained")
    axis = figure.subplots()
    centre = draws.mean(axis=0)
    axis.violinplot(list(((draws - centre) / unit).T), positions=range(1, len(observed) + 1), showextrema=False)
    axis.plot(range(1, len(observed) + 1), (observed - centre) / unit, "kx", label="observed")
    axis.axhline(0.0, color="grey", linewidth=0.5)
    axis.set_xlabel("score")
    axis.set_ylabel("predictive std")
    axis.legend(fontsize=7)
    return figure
