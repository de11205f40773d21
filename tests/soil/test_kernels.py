"""An effect that is off leaves nothing behind: the base law's generated kernel, and what compiles when."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest
from splatsoil.benchmarks._validation import costs

from splatsoil.mpm.substep import make_stress_kernel
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects, library

PRINT = """
import warp as wp
wp.config.log_level = wp.LOG_ERROR
from splatsoil.mpm.substep import make_stress_kernel
from splatsoil.soil.law import Law
law = Law()
print(make_stress_kernel(law.update, law.history).module.name)
"""


def module(effects: Iterable[str] = ()) -> str:
    """Warp's name for a stress kernel of its own module, which ends in the hash of the generated code."""
    law = Law(find_effects(effects))
    return str(make_stress_kernel(law.update, law.history).module.name)


def test_the_base_kernel_is_that_of_a_world_without_effects() -> None:
    """A process in which no effect can be imported generates the same code as this one, which knows them all."""
    acting = {name: module([name]) for name, effect in library().items() if effect.strength is not None}
    alone = subprocess.run(
        [sys.executable, "-c", costs.BLOCK + PRINT], capture_output=True, text=True, check=True
    ).stdout.split()[-1]
    assert module() == alone
    # the comparison can fail: every effect on strength makes other code than the base law and than all others
    assert len({alone, *acting.values()}) == 1 + len(acting)


def test_the_block_blocks() -> None:
    words = [sys.executable, "-c", costs.BLOCK + "import splatsoil.soil.effects.cohesion"]
    assert (
        "ImportError: splatsoil.soil.effects.cohesion" in subprocess.run(words, capture_output=True, text=True).stderr
    )


def test_values_and_order_are_no_part_of_the_kernel() -> None:
    assert module(["softening", "cohesion"]) == module(["cohesion", "softening"])
    one, other = (Law(find_effects(names)) for names in (["softening", "cohesion"], ["cohesion", "softening"]))
    assert make_stress_kernel(one.update, one.history) is make_stress_kernel(other.update, other.history)


@pytest.mark.slow
def test_a_combination_compiles_once_and_soon(tmp_path: Path) -> None:
    """With a cache of their own: modules of kernels that first use, other values and a second process write."""
    first = costs.apart("compiling", tmp_path)
    assert first["all, modules"] >= 2.0
    assert first["all"] < costs.COMPILING
    assert first["other values, modules"] == 0.0
    assert costs.apart("without_effects", tmp_path, costs.BLOCK) == {"modules": 0.0, "effects": 0.0}
    assert costs.apart("compiling", tmp_path)["all, modules"] == 0.0
