"""docs/fit.md against the code."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType

from splatsoil.inverse.fitting import fit


def test_the_page_names_what_fit_json_has(repository: Path, analytic: ModuleType, tmp_path: Path) -> None:
    text = (repository / "docs" / "fit.md").read_text()
    described = text[text.index("the keys of `fit.json`") :].removeprefix("the keys of `fit.json`")
    result = fit(analytic.AnalyticProblem(), analytic.prepare(tmp_path), analytic.SETUP, budget=4)
    named = set(re.findall(r"`(\w+)`", described))
    assert named <= result.keys()
    (inner,) = re.findall(r"parameters\.NAME\.\{(.*?)\}", described, re.DOTALL)
    assert set(re.findall(r"\w+", inner)) <= result["parameters"]["friction_angle"].keys()
