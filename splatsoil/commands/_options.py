"""Options that `fit` and `run` share."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import Positional

from splatsoil.errors import ParameterError

Option = tuple[str, object, object]
"""Name, value and usual value of an option."""

#: Commands as help lists them, by what they are for.
ORDER = {
    "all at once": ("run",),
    "into a measurement set": ("import", "check", "simulate"),
    "step by step": ("reconstruct", "fit", "compare", "diagnose", "add", "report"),
    "more of a run": ("posterior", "export"),
    "by themselves": ("element", "benchmark"),
}

#: Options that a first run does without.
EXPERT = frozenset(
    (
        *("budget", "criticise", "most_effects", "seed", "particle_seed", "holdout", "checks"),
        *("scene", "like", "depth", "views", "picture_scale", "model", "every", "records", "void_ratio", "young"),
        *("poisson", "strain_rate", "matching", "known", "points", "robot_to_world", "mesh_to_flange", "video_every"),
    )
)

#: Evaluations for each free parameter, unless the user says how many.
EVALUATIONS = 10


@dataclass(frozen=True)
class FitOptions:
    """What decides a fit."""

    set: Positional[Path]
    """Folder of the measurement set."""
    parameters: tuple[str, ...] = ()
    """Free parameters; friction angle and those of effects that are on if not given."""
    effects: Annotated[tuple[str, ...], tyro.conf.arg(name="with", metavar="EFFECT …")] = ()
    """Effects of the model, by name, or files that define some."""
    budget: int | None = None
    """Evaluations; 10 for each free parameter if not given."""
    preset: Literal["tiny", "small", "paper", "fine"] = "small"
    """Resolution; small suits a laptop without a graphics card."""
    device: str = "auto"
    """Where to compute: auto, cpu, cuda:0, …"""
    seed: int = 0
    """Of random numbers; one seed gives one result on one processor."""
    run: Path | None = None
    """Run folder; runs/NAME-PRESET, with the seed if it is not 0, if not given."""
    json: bool = False
    """Print one JSON object and nothing else."""

    def folder(self, name: str) -> Path:
        """The run folder for a measurement set of this name."""
        if self.run is not None:
            return self.run
        return Path("runs") / (f"{name}-{self.preset}" + (f"-seed{self.seed}" if self.seed else ""))

    def again(self, command: str, *others: Option) -> str:
        """The command line that means this, and other options besides."""
        return command_line(
            command,
            (self.set,),
            (
                ("--parameters", self.parameters, ()),
                ("--with", self.effects, ()),
                ("--budget", self.budget, None),
                ("--preset", self.preset, "small"),
                ("--device", self.device, "auto"),
                ("--seed", self.seed, 0),
                ("--run", self.run, None),
                *others,
                ("--json", self.json, False),
            ),
        )


@dataclass(frozen=True)
class RunOptions:
    """What a command on a run folder takes."""

    run: Positional[Path]
    """The run folder."""
    set: Path | None = field(default=None, kw_only=True)
    """Where the measurement set is now, if it has moved; later commands know it, too."""

    def again(self, command: str, *others: Option, positional: Iterable[object] = ()) -> str:
        """The command line that means this, with other words and options besides."""
        return command_line(command, (self.run, *positional), (("--set", self.set, None), *others))


def command_line(command: str, positional: Iterable[object], options: Iterable[Option] = ()) -> str:
    """A command as a shell takes it; options are (name, value, usual value), and usual ones are left out.

    What is True is a flag.
    """
    words = ["splatsoil", command, *(str(word) for word in positional)]
    for name, value, usual in options:
        if value is True and usual is False:
            words.append(name)
        elif value != usual:
            words += [name, *map(str, value)] if isinstance(value, tuple) else [name, str(value)]
    return shlex.join(words)


def check_evaluations(budget: int | None) -> None:
    """ParameterError for a fit of too few evaluations.

    Raises:
        ParameterError: see above.
    """
    if budget is not None and budget < 2:
        raise ParameterError(f"--budget: a fit needs at least 2 evaluations, not {budget}")
