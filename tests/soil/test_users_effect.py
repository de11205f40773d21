"""An effect from a user's own file or package takes part like a built-in: element test, model, fit's parameters."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from splatsoil.benchmarks.effects import table

from splatsoil.errors import ParameterError
from splatsoil.measurement import Measurement
from splatsoil.soil.element import triaxial
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects


@pytest.fixture
def suction(repository: Path) -> str:
    return str(repository / "examples" / "effects" / "suction.py")


def test_the_example_is_the_effect_it_says_it_is(suction: str) -> None:
    """Apparent cohesion gradient * depth * tan(phi_b), exact in a triaxial test."""
    law = Law(find_effects([suction]))
    values = {"friction_angle": 33.0, "suction_gradient": 1e4}
    flow = math.tan(math.radians(45.0 + 33.0 / 2.0)) ** 2
    for depth in (0.0, 0.1):
        cohesion = 1e4 * depth * math.tan(math.radians(15.0))
        test = triaxial(law, values, confining=1e3, strains=[0.01], young=1e7, depth=depth)
        assert test.q[0, -1] == pytest.approx(1e3 * (flow - 1.0) + 2.0 * cohesion * math.sqrt(flow), rel=1e-3)


def test_a_model_with_the_example_fits_and_simulates_it(
    suction: str, small_set: Path, over_level_soil: Callable[..., Any]
) -> None:
    """Variants keep it: criticism names effects, and those of a user's file are in no library."""
    measurement = Measurement.load(small_set)
    base, model = (over_level_soil(measurement, 0.16, *effects) for effects in ((), (suction,)))
    assert model.space().names == ("friction_angle", "suction_gradient")
    assert "suction_angle" in {p.name for p in model.parameters}
    names = [
        [effect.name for effect in m.law.effects] for m in (model.variant(), model.variant(effects=("suction", "tilt")))
    ]
    assert names == [["suction"], ["suction", "tilt"]]
    dry, off, held = (
        m.simulate({"friction_angle": 30.0, **values}).positions[-1]
        for m, values in ((base, {}), (model, {"suction_gradient": 0.0}), (model, {"suction_gradient": 5e4}))
    )
    assert np.abs(off - dry).max() < 2e-4
    assert np.abs(held - dry).max() > 1e-3


def test_the_command_finds_the_effect_of_an_installed_package(suction: str, tmp_path: Path) -> None:
    """A package as pip leaves it: a module, and the metadata that docs/effects.md tells to write."""
    (tmp_path / "my_package").mkdir()
    (tmp_path / "my_package" / "__init__.py").touch()
    (tmp_path / "my_package" / "suction.py").write_text(Path(suction).read_text())
    metadata = tmp_path / "my_package-0.1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 0.1\n")
    (metadata / "entry_points.txt").write_text("[splatsoil.effects]\nsuction = my_package.suction:Suction\n")
    words = ["element", "--with", "suction", "--set", "suction_gradient=1e4", "--depth", "0.1", "--json"]
    done = subprocess.run(
        [sys.executable, "-m", "splatsoil", *words, "--plot", str(tmp_path / "curve.png"), "--records", "2"],
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["effects"] == ["suction"] and told["parameters"]["suction_gradient"] == 1e4


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("import nothing_of_this_name", r"cannot be imported: ModuleNotFoundError"),
        ("from splatsoil.soil.effect import Effect\nclass E(Effect): pass", r"effect E has no name"),
        (
            "from splatsoil.soil.effect import Effect\nfrom splatsoil.parameters import Parameter\n"
            "class E(Effect):\n name = 'e'\n parameters = (Parameter('a', '1', 0.0, 1.0, 0.5),)",
            r"first parameter, a, measures its size and needs a value off",
        ),
        (
            "from splatsoil.soil.effect import Effect\nfrom splatsoil.parameters import Parameter\n"
            "class E(Effect):\n name = 'e'\n parameters = (Parameter('a', '1', 0.0, 1.0, 0.0, off=0.0),)\n"
            " shapes = ('a', 'b')",
            r"a, b among its shapes is none of its parameters without off",
        ),
    ],
)
def test_a_file_that_is_no_effect_says_what_is_missing(text: str, says: str, tmp_path: Path) -> None:
    file = tmp_path / "effect.py"
    file.write_text(text)
    with pytest.raises(ParameterError, match=says):
        find_effects([str(file)])


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"nothing\.py cannot be read"):
        find_effects([str(tmp_path / "nothing.py")])


def test_the_documents_show_the_example_and_the_table_of_the_library(repository: Path, suction: str) -> None:
    text = (repository / "docs" / "effects.md").read_text()
    assert Path(suction).read_text() in text and table() in text
