"""``splatsoil posterior``: samples of the posterior of a fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from splatsoil import __version__
from splatsoil.commands import _model, _stages, _workers
from splatsoil.commands._options import ComputingOptions, check_seed, command_line
from splatsoil.commands._output import print_parameters, print_result, stages
from splatsoil.devices import resolve_device
from splatsoil.errors import ParameterError
from splatsoil.files import code_of
from splatsoil.options import option
from splatsoil.quiet import hush
from splatsoil.report.text import duration, model_name

INTERRUPTED = "what was simulated is kept; go on with"


@dataclass(frozen=True)
class Config(ComputingOptions):
    """Sample the posterior: intervals, correlations, ArviZ file.

    Estimate and ± of the latest fit are its mean and standard deviation.
    """

    checks: int = option(3, "Simulations at draws from the posterior, which test the emulator.", expert=True)
    device: str = option("auto", "Where to compute: auto (what the fit used), cpu, cuda:0, …")
    seed: int = option(0, "Of chains and checks.", expert=True)


def run(config: Config) -> int:
    """Compare as the fit did, sample and check; write ``posterior.json`` and the folder ``posterior``."""
    from splatsoil.inverse.posterior import Density, run_posterior

    check_seed(config.seed)
    if config.checks < 0:
        raise ParameterError(f"--checks: must be 0 or more, not {config.checks}")
    hush()
    folder = _model.opened(config)
    fit = folder.fit()
    compare = command_line("compare", folder.path)
    _model.require_answer(folder, fit, f"so there is nothing to sample; `{compare}` shows where")
    setup = fit["setup"]
    wanted = ("cuda:0" if setup["device"] == "cuda" else "cpu") if config.device == "auto" else config.device
    device = resolve_device(wanted)
    if device.split(":")[0] != setup["device"]:
        raise ParameterError(
            f"--device {config.device}: the fit in {folder.path} was made on {setup['device']}; give the same or fit "
            "again"
        )
    if (setup["version"], setup["code"]) != (__version__, code_of(setup["effects"])):
        raise ParameterError(
            f"{folder.path}: the fit was made by other sources of splatsoil; fit again before the posterior"
        )
    folder.check_writable()
    spec = _model.ModelSpec.of(fit)
    with stages(quiet=config.json) as begin:
        model = _model.model_of(folder, device, begin("reconstruct"))
        experiment, simulate = _model.experiment_of(folder, model, spec, ())
        with (
            folder.lock(),
            _workers.Workers(folder, device, ()) as workers,
            workers.simulating(spec, experiment, simulate),
        ):
            seed = folder.description["seed"]
            found = _stages.compare_models(experiment, simulate, fit, begin("models"), seed, with_effects=False)
            result = run_posterior(
                folder,
                experiment,
                simulate,
                Density.of(found.evidence.noise, _stages.prior_of(experiment, fit), seed),
                checks=config.checks,
                seed=config.seed,
                progress=begin("posterior"),
            )
    return print_result(config, result, lambda: show(result, str(folder.path)), run=folder)


def show(result: Mapping[str, Any], folder: str) -> None:
    """Print the parameters and notes."""
    more = {"width / prior": lambda p: f"{p['contraction']:.2f}", "": lambda p: str(p["verdict"])}
    chains = result["chains"]
    print_parameters(
        f"posterior, {model_name(result['fit'])}",
        result,
        "mean",
        more,
        f"{result['simulations']} simulations; R-hat {chains['r_hat']:.3f}, acceptance {chains['acceptance']:.2f}, "
        f"{chains['effective']:.0f} independent samples; {duration(result['seconds'])}",
        f"kept in {folder}: posterior.json, posterior/",
    )
