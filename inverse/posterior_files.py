"""A posterior as files: ArviZ InferenceData, and figures."""

from __future__ import annotations

import io
import os
import tempfile
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from splatsoil.errors import RunError
from splatsoil.files import write_bytes

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

    A chain is an ensemble of walkers. Features are in the emulator's basis (``component``).
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # a remark on its next major version
        import arviz

    space, chains = posterior.data.space, posterior.chains
    n = len(space)
    unit = chains.samples[..., :n]
    values = space.from_unit(unit).reshape(unit.shape[0], -1, n)
    drawn: dict[str, Any] = {name: values[..., i] for i, name in enumerate(space.names)}
    if posterior.likelihood.with_misfit:
        drawn["ln_misfit"] = chains.samples[..., n].reshape(unit.shape[0], -1)
    rng = np.random.default_rng(0)
    prior = space.from_unit(rng.uniform(-1.0, 1.0, (1, 4000, n)))
    return arviz.from_dict(
        posterior=drawn,
        sample_stats={"lp": chains.log_density.reshape(unit.shape[0], -1)},
        posterior_predictive={"scores": predictive_scores(posterior, PREDICTIVE)[None]},
        observed_data={"scores": posterior.likelihood.scores},
        prior={name: prior[..., i] for i, name in enumerate(space.names)},
        dims={"scores": ["component"]},
        attrs={"made_by": "splatsoil", "units": ", ".join(f"{p.name}: {p.unit}" for p in space)},
    )


def write_inference_data(posterior: Posterior, path: Path) -> Path:
    """As NetCDF, whole or not at all; ``arviz.from_netcdf`` reads it."""
    data = inference_data(posterior)
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
    os.close(descriptor)
    temporary = Path(name)
    try:
        data.to_netcdf(name, engine="h5netcdf")
        temporary.replace(path)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error}); free some space and try again") from error
    finally:
        temporary.unlink(missing_ok=True)
    return path


def predictive_scores(posterior: Posterior, count: int, seed: int = 0) -> FloatArray:
    """(count, p) scores that would be observed again, every source of doubt included."""
    rng = np.random.default_rng(seed)
    points = posterior.chains.flat[rng.choice(len(posterior.chains.flat), count)]
    mean, covariance = posterior.likelihood.covariance(points)
    factor = np.linalg.cholesky(covariance)
    return mean + (factor @ rng.standard_normal(mean.shape)[..., None])[..., 0]


def write_figures(posterior: Posterior, folder: Path) -> list[str]:
    """Write corner, trace, scores and, where features have places, predictive ``.png``; their names."""
    import matplotlib

    with matplotlib.rc_context({"font.size": 9, "figure.dpi": 110}):
        figures = {"corner.png": corner_figure(posterior), "trace.png": trace_figure(posterior)}
        figures["scores.png"] = scores_figure(posterior)
        if posterior.data.places is not None:
            figures["predictive.png"] = predictive_figure(posterior)
        for name, figure in figures.items():
            stream = io.BytesIO()
            figure.savefig(stream, format="png", bbox_inches="tight")
            write_bytes(folder / name, stream.getvalue())
    return list(figures)


def corner_figure(posterior: Posterior) -> Figure:
    """Every parameter and every pair; the frame is the prior, and what is not determined gets no number."""
    import corner
    from matplotlib.figure import Figure

    space = posterior.data.space
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

    space, samples = posterior.data.space, posterior.chains.samples
    figure = Figure(figsize=(8.0, 1.8 * len(space) + 0.4), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(space), 1, sharex=True))
    values = space.from_unit(samples[..., : len(space)])
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
    """The observed features, in the emulator's basis, among those that the posterior predicts."""
    from matplotlib.figure import Figure

    draws = predictive_scores(posterior, PREDICTIVE)
    observed = posterior.likelihood.scores
    unit = draws.std(axis=0)
    figure = Figure(figsize=(0.7 * len(observed) + 2.5, 2.8), layout="constrained")
    axis = figure.subplots()
    centre = draws.mean(axis=0)
    axis.violinplot(list(((draws - centre) / unit).T), positions=range(1, len(observed) + 1), showextrema=False)
    axis.plot(range(1, len(observed) + 1), (observed - centre) / unit, "kx", label="observed")
    axis.axhline(0.0, color="grey", linewidth=0.5)
    axis.set_xticks(range(1, len(observed) + 1))
    axis.set_xlabel("component")
    axis.set_ylabel("predictive std")
    axis.legend(fontsize=7)
    return figure


def predictive_figure(posterior: Posterior) -> Figure:
    """The bed from above, for each camera at its last frame: residual at the posterior's mean, its spread, and both."""
    from matplotlib.figure import Figure

    places = posterior.data.places
    assert places is not None
    emulator = posterior.emulator
    rng = np.random.default_rng(0)
    draws = posterior.unit[rng.choice(len(posterior.unit), PREDICTIVE)]
    predicted = emulator.features(draws)
    mean, spread = predicted.mean(axis=0), predicted.std(axis=0)
    chance = np.sqrt(emulator.chance_variance() + posterior.likelihood.sensor)
    residual = posterior.likelihood.observed - mean
    cameras = sorted({p.camera for p in places})
    last = max(p.frame for p in places)
    figure = Figure(figsize=(10.0, 2.6 * len(cameras)), layout="constrained")
    axes = figure.subplots(len(cameras), 3, squeeze=False, sharex=True, sharey=True)
    for row, camera in zip(axes, cameras, strict=True):
        chosen = [k for k, p in enumerate(places) if p.camera == camera and p.frame == last]
        x, y = (np.array([getattr(places[k], name) for k in chosen]) for name in ("x", "y"))
        panels = (
            ("observed − mean [grey levels]", residual[chosen], "RdBu_r"),
            ("its spread over the posterior", spread[chosen], "viridis"),
            ("residual / (spread, chance and noise)", (residual / np.hypot(spread, chance))[chosen], "RdBu_r"),
        )
        for axis, (title, shown, colours) in zip(row, panels, strict=True):
            top = float(np.abs(shown).max()) or 1.0
            low = -top if colours == "RdBu_r" else 0.0
            image = axis.scatter(x, y, c=shown, cmap=colours, vmin=low, vmax=top, marker="s", s=60)
            axis.set_aspect("equal")
            axis.set_title(f"{camera}, frame {last}: {title}", fontsize=7)
            figure.colorbar(image, ax=axis, shrink=0.8)
    return figure
