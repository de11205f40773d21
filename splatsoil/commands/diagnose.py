"""``splatsoil diagnose``: is the model adequate, and if not, which effect is missing?"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tyro.conf import Positional

from splatsoil.commands._options import command_line
from splatsoil.commands._output import print_json

if TYPE_CHECKING:
    from splatsoil.commands._crew import Crew
    from splatsoil.inverse.run_folder import RunFolder


@dataclass(frozen=True)
class Config:
    """Say which effect, if any, a run's latest model lacks, how sure that is, and what cannot be told.

    Simulates the fit again with other seeds and other numerics, and once or twice for every effect that is off; refits
    the best ones on every other frame and judges them on the rest. All simulations are kept: an interrupted diagnosis
    goes on.
    """

    run: Positional[Path]
    """The run folder."""
    effects: tuple[str, ...] = ()
    """Effects to consider, by name, or files that define some; all of the library that are off, if not given."""
    repeats: int = 4
    """Simulations with other seeds, to know what chance does."""
    refits: int = 3
    """Effects, the best ones, to refit; three more where the model leaves more than noise or the fit lies on a bound:
    those that would explain most by themselves are tried there, too."""
    refit_steps: int = 5
    """First simulations of a refit at most; some ten to twenty more follow for what explains most."""
    no_replay: bool = False
    """Leave out the control: a made-up bed of the same soil, photographed and taken through the whole chain, that
    tells what pictures and reconstruction get wrong by themselves. Without it, their errors can pass for soil."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda:0, …"""
    json: bool = False
    """Print one JSON object instead of a table."""


def run(config: Config) -> int:
    """Diagnose; the result goes into the run folder."""
    from splatsoil.commands import _criticism as criticism
    from splatsoil.commands._crew import Crew
    from splatsoil.commands._diagnosis_table import show
    from splatsoil.inverse.run_folder import RunFolder

    criticism.check_budget(config.repeats, config.refits, config.refit_steps)
    folder = RunFolder.open(config.run)
    criticism.need_fit(folder)
    folder.check_writable()
    with Crew(folder, config.device, config.effects, control=not config.no_replay) as crew:
        result = _diagnosed(config, folder, crew)
    if config.json:
        print_json({"ok": True, "run": str(folder.path), **_finite(result)})
    else:
        show(result)
        print(f"kept in {folder.path / 'diagnosis.json'}")
    return 0


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

    from splatsoil.inverse.criticism.diagnosis import Options

    hush()
    options = Options(repeats=config.repeats, refits=config.refits, refit_steps=config.refit_steps)
    device = resolve_device(config.device)
    stage.note_other_sources(folder)
    with stages(quiet=config.json) as begin:
        model = experiments.model_of(folder, device, begin("reconstruct"))
        return criticism.diagnosed(
            folder, model, options, begin, config.effects, with_replay=not config.no_replay, crew=crew
        )


def interrupted(config: Config) -> str:
    """Simulations are kept one by one."""
    again = command_line(
        "diagnose",
        (config.run,),
        (
            ("--effects", config.effects, ()),
            ("--repeats", config.repeats, 4),
            ("--refits", config.refits, 3),
            ("--refit-steps", config.refit_steps, 5),
            ("--no-replay", config.no_replay, False),
            ("--device", config.device, "auto"),
            ("--json", config.json, False),
        ),
    )
    return f"finished simulations are kept; go on with: {again}"


def _finite(result: dict) -> dict:
    from splatsoil.files import plain

    return plain(result)
