"""An effect that is off leaves nothing behind: the base law's generated kernel, and what compiles when."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import pytest
from splatsoil.benchmarks.effects import strong

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


def test_the_block_blocks() -> None:
    words = [sys.executable, "-c", BLOCK + "import splatsoil.soil.effects.cohesion"]
    assert (
        "ImportError: splatsoil.soil.effects.cohesion" in subprocess.run(words, capture_output=True, text=True).stderr
    )


def test_values_and_order_are_no_part_of_the_kernel() -> None:
    assert module(["softening", "cohesion"]) == module(["cohesion", "softening"])
    one, other = (Law(find_effects(names)) for names in (["softening", "cohesion"], ["cohesion", "softening"]))
    assert make_stress_kernel(one.update, one.history) is make_stress_kernel(other.update, other.history)


#: Simulates with the effects that are named, in this order, and prints how many modules Warp has compiled since.
COMPILE = """
import sys
from pathlib import Path
import warp as wp
wp.config.log_level = wp.LOG_ERROR
wp.init()
from splatsoil.benchmarks._validation.columns import column
from splatsoil.soil.matching import Matching
from dataclasses import replace
names, factor = sys.argv[1].split(",") if sys.argv[1] else [], float(sys.argv[2])
values = {}
if names:
    from splatsoil.benchmarks.effects import acting
    from splatsoil.soil.library import find_effects
    values = {name: factor * value for effect in find_effects(names) for name, value in acting(effect).items()}
folder = Path(str(wp.config.kernel_cache_dir))
before = len(list(folder.glob("*/*.meta")))
scene = column(1.0, 30.0, planar=False, matching=Matching.COMPRESSION, particles=300.0)
replace(scene, effects=tuple(names), values=values).solver("cpu").advance(1)
print(len(list(folder.glob("*/*.meta"))) - before)
"""


@pytest.mark.slow
def test_a_combination_compiles_once_and_an_effect_that_is_off_not_at_all(tmp_path: Path) -> None:
    """In processes that share a cache of compiled kernels; one of them cannot import any effect."""

    def compiled(names: list[str], factor: float = 1.0, before: str = "") -> int:
        words = [sys.executable, "-c", before + COMPILE, ",".join(names), str(factor)]
        env = os.environ | {"WARP_CACHE_PATH": str(tmp_path)}
        return int(subprocess.run(words, capture_output=True, text=True, check=True, env=env).stdout.split()[-1])

    names = strong()
    assert compiled([]) > 0
    assert compiled([], before=BLOCK) == 0
    assert compiled(names) > 0
    assert compiled(names[::-1], 0.5) == 0
