"""A run folder as an experiment: its model, and its simulations."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from splatsoil.errors import ParameterError

if TYPE_CHECKING:
    from splatsoil.commands._progress import Report
    from splatsoil.experiment.plow import PlowExperiment
    from splatsoil.inverse.criticism.simulations import Simulations
    from splatsoil.inverse.run_folder import RunFolder
    from splatsoil.model import Model
    from splatsoil.soil.effect import Effect


@dataclass(frozen=True)
class Chosen:
    """What makes a run's model, beside its set and reconstruction.

    Attributes:
        effects: names of those that are on, or files.
        preset: resolution of the solver.
        parameters: names of the free ones.
    """

    effects: tuple[str, ...]
    preset: str
    parameters: tuple[str, ...]

    @classmethod
    def of(cls, fit: Mapping[str, Any]) -> Chosen:
        """What ``fit.json`` is a fit of."""
        setup = fit["setup"]
        return cls(tuple(setup["effects"]), setup["preset"], tuple(fit["parameters"]))


def model_of(
    folder: RunFolder, device: str, report: Report, *, chosen: Chosen | None = None, anew: bool = True
) -> Model:
    """The model that a run's latest fit is of, or a chosen one, on one device; a reconstruction that isn't kept is made
    ``anew``.

    Helpers, which don't make any, say no remarks on the set either: the first process has.

    Raises:
        RunError: it may not be.
    """
    from splatsoil.commands import _stages as stage
    from splatsoil.commands._output import say_remarks

    chosen = chosen or Chosen.of(folder.fit())
    measurement = stage.measurement_of(folder)
    if anew:
        say_remarks(measurement)
    reconstruction = stage.reconstructed(measurement, folder, device, report, anew=anew)
    return stage.model_on(measurement, folder, reconstruction, chosen.effects, chosen.preset, device)


def experiment_of(
    folder: RunFolder, model: Model, chosen: Chosen, effects: Iterable[str] | None = None
) -> tuple[PlowExperiment, Simulations]:
    """The run as criticism sees it, with some effects as candidates or all, and its simulations, kept in ``features/``.

    Raises:
        ParameterError: an effect that is unknown or on already.
    """
    from splatsoil import __version__
    from splatsoil.commands._control import code_of, own_files
    from splatsoil.commands._stages import digest_of
    from splatsoil.experiment.plow import PlowExperiment
    from splatsoil.files import code_digest
    from splatsoil.inverse.criticism.simulations import Simulations
    from splatsoil.soil.library import find_effects

    named = None if effects is None else tuple(effects)
    wanted = None if named is None else off_effects(named, model.law.effects)
    experiment = PlowExperiment(model, chosen.parameters, candidates=wanted)
    identity = {
        "measurement": folder.description["measurement"]["hash"],
        "reconstruction": digest_of(model.reconstruction),
        "model": sorted(experiment.model),
        "preset": model.preset,
        "device": model.device.split(":")[0],
        "version": __version__,
        "code": code_of(chosen.effects),
        "layout": list(experiment.layout.shape),
    }
    # A file counts for what it is on in alone: simulations of the model as it is are there already.
    own = {e.name: code_digest((), [file]) for file in own_files(named or ()) for e in find_effects([file])}
    return experiment, Simulations(experiment, folder.path / "features", identity, sources=own)


def off_effects(names: Iterable[str], on: Iterable[Effect]) -> tuple[Effect, ...]:
    """Effects by name, or from files, that are none of those that are on.

    Raises:
        ParameterError: one is unknown, on already, or no more than other numerics to a diagnosis.
    """
    from splatsoil.soil.library import find_effects

    wanted, taken = find_effects(names), {effect.name for effect in on}
    for effect in wanted:
        if effect.name in taken:
            raise ParameterError(f"effect {effect.name} is on already; name one that is off")
        if effect.numerical:
            raise ParameterError(
                f"effect {effect.name} can't be told from other numerics, which a diagnosis allows for; "
                f"fit it: splatsoil fit SET --with {effect.name}"
            )
    return wanted
