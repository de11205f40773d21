"""An effect from a user's own file or package takes part like a built-in: element test, model, fit's parameters."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from splatsoil.errors import ParameterError
from splatsoil.measurement import Bed, Camera, Frame, Measurement, Tool, ToolMotion
from splatsoil.model import Model
from splatsoil.reconstruction import HeightField
from splatsoil.soil.element import triaxial
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects


@pytest.fixture
def suction(repository: Path) -> str:
    return str(repository / "examples" / "effects" / "suction.py")


def tiny(effects: list[str]) -> Model:
    """A box of 4 cm ploughs a bed of 20 x 16 x 6 cm for three frames."""
    bed = Bed(np.zeros(3), np.array([0.2, 0.16, 0.12]), 1600.0)
    times = np.arange(4) / 20.0
    x = 0.06 + 0.3 * times
    positions = np.stack([x, np.full(4, 0.08), np.full(4, 0.06)], axis=1)
    motion = ToolMotion(np.arange(4), times, positions, np.tile([1.0, 0.0, 0.0, 0.0], (4, 1)))
    pose = np.eye(4)
    pose[2, 3] = 1.0
    view = Camera(32, 32, 50.0, 50.0, 16.0, 16.0, pose, model="PINHOLE")
    video = tuple(Frame(view, Path(), "above", f, f / 20.0) for f in (0, 3))
    tool = Tool(trimesh.creation.box((0.02, 0.04, 0.04)), motion)
    measurement = Measurement(Path(), "made", np.array([0.0, 0.0, -9.81]), 20.0, bed, tool, (), video)
    surface = HeightField.over(bed.lower, bed.upper, 0.01, 0.06)
    return Model(measurement, SimpleNamespace(surface=surface), effects=effects, preset="tiny")  # type: ignore[arg-type]


def test_the_example_is_the_effect_it_says_it_is(suction: str) -> None:
    """Apparent cohesion gradient * depth * tan(phi_b), exact in a triaxial test."""
    law = Law(find_effects([suction]))
    values = {"friction_angle": 33.0, "suction_gradient": 1e4}
    flow = math.tan(math.radians(45.0 + 33.0 / 2.0)) ** 2
    for depth in (0.0, 0.1):
        cohesion = 1e4 * depth * math.tan(math.radians(15.0))
        test = triaxial(law, values, confining=1e3, strains=[0.01], young=1e7, depth=depth)
        assert test.q[0, -1] == pytest.approx(1e3 * (flow - 1.0) + 2.0 * cohesion * math.sqrt(flow), rel=1e-3)


def test_a_variant_of_a_model_keeps_an_effect_from_a_file(suction: str) -> None:
    """Criticism names effects; those of a user's file are in no library."""
    model = tiny([suction])
    more = model.variant(effects=("suction", "cohesion"))
    assert [effect.name for effect in more.law.effects] == ["suction", "cohesion"]
    assert [effect.name for effect in model.variant().law.effects] == ["suction"]


def test_a_model_with_the_example_fits_and_simulates_it(suction: str) -> None:
    model, base = tiny([suction]), tiny([])
    assert model.space().names == ("friction_angle", "suction_gradient")
    assert "suction_angle" in {p.name for p in model.parameters}
    dry, off, held = (
        m.simulate({"friction_angle": 30.0, **values}).positions[-1]
        for m, values in ((base, {}), (model, {"suction_gradient": 0.0}), (model, {"suction_gradient": 5e4}))
    )
    chance = np.abs(off - dry).max()
    assert chance < 2e-4
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


def test_the_documents_show_the_example_as_it_is(repository: Path, suction: str) -> None:
    text = (repository / "docs" / "effects.md").read_text()
    assert Path(suction).read_text() in text


def test_the_documents_have_the_table_of_the_library(repository: Path) -> None:
    from splatsoil.benchmarks.effects import table

    assert table() in (repository / "docs" / "effects.md").read_text()
