"""The replay control: a known soil, photographed by a path tracer, reconstructed and predicted like the real one.

What is left between its pictures and their prediction is what pictures, reconstruction and chance do with nothing wrong
in the soil's model. It cannot contain what another solver of the same equations would do: numerics are a part of their
own.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatsoil.experiment.features import Site
from splatsoil.experiment.plow import PlowExperiment
from splatsoil.measurement import Measurement
from splatsoil.model import Model
from splatsoil.reconstruction import reconstruct
from splatsoil.synthetic import like, make_set

FloatArray = npt.NDArray[np.float64]

SEED = 1
"""Of the replay's surface, looks, noise and particles."""


def replay(
    experiment: PlowExperiment,
    values: Mapping[str, float],
    folder: Path,
    *,
    progress: Callable[[str, float], None] | None = None,
) -> FloatArray:
    """(t, s) observed minus predicted features of a made-up bed with the same tool, cameras and parameters; NaN where
    that hides what the experiment's own bed shows.

    Args:
        experiment: whose bed, tool, motion, cameras, model and preset are used.
        values: the truth of the replay, and what is predicted with.
        folder: working place; emptied before and after.
        progress: called with (what, share done).
    """
    told = progress or (lambda what, share: None)
    base = experiment.base
    depth = float(np.nanmean(base.reconstruction.surface.height) - base.measurement.bed.lower[2])
    shutil.rmtree(folder, ignore_errors=True)
    try:
        make_set(
            folder / "set",
            like(base.measurement, SEED, depth=depth),
            friction_angle=values.get("friction_angle", 35.0),
            effects=base.effects,
            values={name: value for name, value in values.items() if name != "friction_angle"},
            preset=base.preset,
            seed=SEED,
            device=base.device,
            progress=lambda what, share: told(f"replay: {what}", 0.5 * share),
        )
        measurement = Measurement.load(folder / "set")
        scene = reconstruct(
            measurement,
            preset=base.preset,
            device=base.device,
            progress=lambda what, share: told(f"replay: {what}", 0.5 + 0.3 * share),
        )
        model = Model(
            measurement, scene, effects=base.effects, preset=base.preset, device=base.device, frames=base.frames
        )
        made = PlowExperiment(model, [p.name for p in experiment.parameters], candidates=(), numerics=())
        told("replay: prediction", 0.85)
        left = np.where(made.seen, made.observed - made.predict(values), np.nan)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    place = {_key(site): i for i, site in enumerate(made.layout.sites)}
    out = np.full(experiment.layout.shape, np.nan)
    for column, site in enumerate(experiment.layout.sites):
        found = place.get(_key(site))
        if found is not None:
            out[:, column] = left[:, found]
    return out


def _key(site: Site) -> str:
    """What two experiments call the same site, whether it has a place or not."""
    return f"{site.channel} {site.x:.6f} {site.y:.6f}"
