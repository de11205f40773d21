"""Files of a posterior: ArviZ InferenceData and a corner plot."""

from __future__ import annotations

import io
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatsoil.errors import RunError
from splatsoil.files import write_bytes
from splatsoil.parameters import Parameter, ParameterSpace

from .posterior import verdicts

if TYPE_CHECKING:
    import arviz
    from matplotlib.figure import Figure

    from .posterior import Posterior


#: Draws for the posterior predictive.
PREDICTIVE_DRAWS = 200


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
    random = np.random.default_rng(0)
    draws = posterior.unit[random.choice(len(posterior.unit), PREDICTIVE_DRAWS)]
    return arviz.from_dict(
        posterior={name: values[..., i] for i, name in enumerate(space.names)},
        sample_stats={"lp": chains.log_density.reshape(values.shape[0], -1)},
        posterior_predictive={"scores": posterior.density.replicates(draws, random)[None]},
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
            file = Path(data.to_netcdf(str(Path(folder) / path.name), engine="h5netcdf"))
            return write_bytes(path, file.read_bytes())
    except OSError as error:
        raise RunError(f"{path}: cannot be made ({error}); free some space and try again") from error


def write_corner(posterior: Posterior, own: Sequence[Parameter], path: Path) -> Path:
    """As PNG; see :func:`corner_figure`."""
    import matplotlib

    stream = io.BytesIO()
    with matplotlib.rc_context({"font.size": 9, "figure.dpi": 110}):
        corner_figure(posterior, own).savefig(stream, format="png", bbox_inches="tight")
    return write_bytes(path, stream.getvalue())


def corner_figure(posterior: Posterior, own: Sequence[Parameter]) -> Figure:
    """Corner plot within the parameters' bounds; a parameter that is not determined gets no number."""
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
        label = "not identified" if verdict == "not determined" else f"{median} ({low} to {high})"
        axes[i, i].set_title(f"{p.label or p.name.replace('_', ' ')}: {label}", fontsize=8)
    return figure
