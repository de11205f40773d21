"""Soil properties from photographs of a tool moving through it.

    import splatsoil as ss

    run = ss.fit("examples/plow-dry")  # the commands' names and options: docs/api.md, help(ss.fit)
    run.compare()
    run.adequate, run.estimates["friction_angle"]
    run.show()

``load``, ``check`` and ``simulate`` read and make measurement sets. ``reconstruct``, ``fit``, ``compare``,
``diagnose``, ``add`` and ``sample`` are the stages, and ``run`` is all of them. ``open_run`` and ``write_report`` read
and show a run. They are loaded when they are first used. Importing the package registers its Gymnasium environments, so
that ``import gymnasium, splatsoil`` is all that ``gymnasium.make("PlowSand-v0")`` needs.
"""

from splatsoil import starting as _starting

_starting.heed_interrupts()  # before anything that takes its time

from typing import TYPE_CHECKING, Any  # noqa: E402

from splatsoil import deterministic as _deterministic  # noqa: E402
from splatsoil._version import __version__  # noqa: E402
from splatsoil.envs import register as _register_environments  # noqa: E402

if TYPE_CHECKING:
    from splatsoil.api import (
        Estimate,
        Run,
        add,
        check,
        compare,
        diagnose,
        fit,
        load,
        open_run,
        reconstruct,
        run,
        sample,
        simulate,
        write_report,
    )

__all__ = [
    "Estimate",
    "Run",
    "__version__",
    "add",
    "check",
    "compare",
    "diagnose",
    "fit",
    "load",
    "open_run",
    "reconstruct",
    "run",
    "sample",
    "simulate",
    "write_report",
]

if _deterministic.wanted():
    _deterministic.enforce()
_register_environments()


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from splatsoil import api

    return getattr(api, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
