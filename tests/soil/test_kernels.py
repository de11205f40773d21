"""An effect that is off leaves nothing behind: the base law's generated kernel, and what compiles when."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable

from splatsoil.mpm.substep import make_stress_kernel
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects, library

#: Makes every effect of the library impossible to import.
BLOCK = """
import sys
class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.startswith("splatsoil.soil.effects."):
            raise ImportError(name)
sys.meta_path.insert(0, Blocked())
"""

PRINT = """
import warp as wp
wp.config.log_level = wp.LOG_ERROR
from splatsoil.benchmarks.effects import strong

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
        [sys.executable, "-c", BLOCK + PRINT], capture_output=True, text=True, check=True
    ).stdout.split()[-1]
    assert module() == alone
    # the comparison can fail: every effect on strength makes other code than the base law and than all others
    assert len({alone, *acting.values()}) == 1 + len(acting)


def test_values_and_order_are_no_part_of_the_kernel() -> None:
    assert module(["softening", "cohesion"]) == module(["cohesion", "softening"])
    one, other = (Law(find_effects(names)) for names in (["softening", "cohesion"], ["cohesion", "softening"]))
    assert make_stress_kernel(one.update, one.history) is make_stress_kernel(other.update, other.history)
