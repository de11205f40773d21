"""Gymnasium environments: one step is one simulate-and-compare."""

from __future__ import annotations

PLOW_SAND = "PlowSand-v0"


def register() -> None:
    """Make ``gymnasium.make("PlowSand-v0")`` work; calling it again changes nothing."""
    import gymnasium

    if PLOW_SAND not in gymnasium.registry:
        gymnasium.register(
            id=PLOW_SAND,
            entry_point="splatsoil.envs.plow_sand:PlowSandEnv",
            vector_entry_point="splatsoil.envs.vector:PlowSandVectorEnv",
        )
