"""Gymnasium environments: one step is one simulate-and-compare."""

from __future__ import annotations

from typing import Any

PLOW_SAND = "PlowSand-v0"

_SEVERAL = {
    "parameters": ["friction_angle", "cohesion", "dilatancy_angle"],
    "effects": ["cohesion", "dilatancy"],
    "budget": 20,
}
#: Each is registered twice: ``…-v0`` is simulated, ``…Fast-v0`` emulated. Name, class, its options.
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "PlowSand": ("plow_sand:PlowSandEnv", {}),
    "PlowSandSeveral": ("plow_sand:PlowSandEnv", _SEVERAL),
    "PlowSandNaming": ("strokes:NamingEnv", {}),
    "PlowSandDesign": ("strokes:DesignEnv", {}),
}


def register() -> None:
    """Make ``gymnasium.make("PlowSand-v0")`` and its variants work; calling it again changes nothing."""
    import gymnasium

    if PLOW_SAND in gymnasium.registry:
        return
    for name, (where, options) in VARIANTS.items():
        together = "splatsoil.envs.vector:PlowSandVectorEnv" if where == "plow_sand:PlowSandEnv" else None
        for speed, chosen in (("", options), ("Fast", options | {"fast": True})):
            gymnasium.register(
                id=f"{name}{speed}-v0",
                entry_point=f"splatsoil.envs.{where}",
                vector_entry_point=together,
                kwargs=chosen,
            )
