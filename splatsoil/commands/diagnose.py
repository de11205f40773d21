"""``splatsoil diagnose``: is the model adequate, and if not, which effect is missing?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from splatsoil.commands._answer import why_none
from splatsoil.commands._options import RunOptions
from splatsoil.commands._output import print_json

if TYPE_CHECKING:
    from splatsoil.commands._crew import Crew
    from splatsoil.inverse.run_folder import RunFolder


@dataclass(frozen=True)
class Config(RunOptions):
    """Name the effect that the model lacks, with its probability.

    Simulates the model as it is and with each effect that is off, at several sizes; all are compared with all data. A
    diagnosis that was interrupted goes on.
    """

    effects: tuple[str, ...] = ()
    """Effects to consider, by name, or files that define some; the whole library if not given."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda:0, …"""
    json: bool = False
    """Print one JSON object instead of a table."""


def run(config: Config) -> int:
    """Diagnose; the result goes into the run folder."""
    from splatsoil.commands import _criticism as criticism
    from splatsoil.commands import _laboratory as laboratory
    from splatsoil.commands import _stages as stage
    from splatsoil.commands._crew import Crew
    from splatsoil.commands._diagnosis_table import show
    from splatsoil.errors import NoAnswer

    if laboratory.is_run(config.run) or laboratory.is_test(config.run):
        return laboratory.diagnose(config.run, config.effects, config.device, config.set, quiet=config.json)
    folder = stage.opened(config)
    none = why_none(criticism.need_fit(folder))
    folder.check_writable()
    with Crew(folder, config.device, config.effects) as crew:
        result = _diagnosed(config, folder, crew)
    if none:
        del result["estimates"]
    if config.json:
        print_json(
            {**({"ok": False, "error": none} if none else {"ok": True}), **_finite(result), "run": str(folder.path)}
        )
    else:
        if none:
            print(none)
        show(result)
        print(f"kept in {folder.path / 'diagnosis.json'}")
    return NoAnswer.code if none else 0


def _diagnosed(config: Config, folder: RunFolder, crew: Crew) -> dict[str, Any]:
    """What takes seconds to load is loaded here: helpers have begun by then."""
    from splatsoil.commands import _criticism as criticism
    from splatsoil.commands import _experiments as experiments
    from splatsoil.commands import _stages as stage
    from splatsoil.commands._progress import stages
    from splatsoil.envs.devices import resolve_device
    from splatsoil.quiet import hush
    from splatsoil.soil.library import find_effects

    # a name that is wrong is refused before the rest is loaded
    experiments.off_effects(config.effects, find_effects(folder.fit()["setup"]["effects"]))

    hush()
    device = resolve_device(config.device)
    stage.note_other_sources(folder)
    with stages(quiet=config.json) as begin:
        model = experiments.model_of(folder, device, begin("reconstruct"))
        return criticism.diagnosed(folder, model, begin, config.effects, crew=crew)


def interrupted(config: Config) -> str:
    """Simulations are kept one by one."""
    again = config.again(
        "diagnose",
        ("--effects", config.effects, ()),
        ("--device", config.device, "auto"),
        ("--json", config.json, False),
    )
    return f"finished simulations are kept; go on with: {again}"


def _finite(result: dict) -> dict:
    from splatsoil.files import plain

    return plain(result)
