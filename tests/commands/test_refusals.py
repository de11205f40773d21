"""What makes no sense: exit code 2, one line on stderr, the same as JSON; no work is begun, and nothing is written."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from splatsoil.inverse.run_folder import RunFolder

from splatsoil import cli

#: Words, in a folder with ``full/note.txt``, and what is said. SET is a set, and RUN a run with the effect tilt on.
REFUSED = [
    ("element --with dilatancy", "effect 'dilatancy' is on but all its parameters are at their off values"),
    ("element --confining -5", "confining: -5.0 is not a positive number"),
    ("element --with dilatancy compaction", "cannot both be on"),
    ("element --set cohesion=5", "unknown parameter cohesion"),
    ("element --with tilt --set tilt_x=5", "effect tilt does not act on a specimen"),
    ("element --with exposure --set exposure_gain=1.1", "effect exposure does not act on a specimen"),
    ("element --plot curve.txt", "ends in .png, .svg or .pdf"),
    ("element --records 1", "--records: a curve has 2 to 100000 points"),
    ("element --records 1000000000000", "--records: a curve has 2 to 100000 points"),
    ("element --strain 1e9", "--strain: 1e+09 is not a strain above 0 and up to 10"),
    ("element --strain 0", "--strain: 0 is not a strain above 0"),
    ("element --strain nan", "--strain: nan is not a strain above 0"),
    ("element --test isotropic --pressure 1e30", "6e+25 steps"),
    *(
        (f"{command} SET {words}", says)
        for command in ("fit", "run")
        for words, says in (
            ("--run new --budget 1", "--budget: a fit needs at least 2 evaluations"),
            ("--run new --seed -1", "--seed: must be 0 or more"),
            ("--run new --with antigravity", "effect 'antigravity' is unknown"),
            ("--run new --parameters phi", "--parameters: unknown phi; this model has friction_angle"),
            ("--run new --parameters cohesion", "unknown cohesion"),
            ("--run new --device cuda:77", "there is no device 'cuda:77' here"),
            ("--run full", "full: exists and isn't a run folder"),
        )
    ),
    ("run SET --most-effects -1", "--most-effects: must be 0 or more, not -1"),
    ("reconstruct SET --seed -1", "--seed: must be 0 or more"),
    (f"reconstruct SET --seed {2**63}", "--seed: must be 0 or more and less than 2^63"),
    ("reconstruct SET --device cuda:99", "there is no device 'cuda:99' here"),
    ("reconstruct SET --out full/note.txt", "full/note.txt is a file and no folder"),
    ("reconstruct SET --out full/note.txt/below", "full/note.txt is a file and no folder"),
    ("add RUN cohesion cohesion", "effect named twice: cohesion"),
    ("add RUN cohesion --budget 1", "--budget: a fit needs at least 2 evaluations, not 1"),
    ("add RUN nonsense", "effect 'nonsense' is unknown"),
    ("add RUN tilt", "effect tilt is on already; name one that is off"),
    ("diagnose RUN --effects nonsense", "effect 'nonsense' is unknown"),
    ("diagnose RUN --effects tilt", "effect tilt is on already; name one that is off"),
    ("posterior RUN --checks -1", "--checks: must be 0 or more, not -1"),
    ("design RUN --draws 2", "--draws: between 3 and 32 simulations, not 2"),
    ("export RUN --to csv --every 0", "--every: must be 1 or more, not 0"),
    ("export RUN --to csv --out full", "--out: full is not empty; nothing is overwritten"),
    ("export RUN --to csv --out full/note.txt", "is a file and no folder"),
    ("export RUN --to", "--to: name a format: vtk, usd, csv or ply"),
    ("export RUN --to csv --device abacus", "there is no device 'abacus' here"),
    ("export RUN --to csv usd", "--to usd: needs packages that aren't installed; pip install 'splatsoil[export]'"),
    *(
        (f"{command} {place} {words}", says)
        for command in ("compare", "report", "diagnose", "add", "posterior", "design", "export")
        for words in ({"add": "tilt", "export": "--to csv"}.get(command, ""),)
        for place, says in (("nothing", "nothing: there is no such run folder"), ("full", "full: has no run.json"))
    ),
    ("view SET", "view needs viser, which isn't installed; pip install 'splatsoil[view]'"),
    ("view nowhere", "nowhere: no such folder"),
    ("view SET --port 0", "--port: must be from 1 to 65535, not 0"),
    ("view SET --compare-with base", "is no run folder; only a run has fits"),
    ("benchmark nix", "benchmark 'nix' is unknown; there are bo-vs-mcmc"),
]


@pytest.mark.usefixtures("no_work")
@pytest.mark.parametrize(("words", "says"), REFUSED)
def test_it_is_refused_in_a_sentence(
    run: RunFolder,
    fit_of: Callable[..., dict[str, Any]],
    plow_dry: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: str,
    says: str,
) -> None:
    run.write_fit("tilt", fit_of(["tilt"], tilt_x=1.0))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "note.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    there = importlib.util.find_spec
    absent = [name for name in ("pxr", "viser") if name == "pxr" or "viser" in says]
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *_: None if name in absent else there(name))
    monkeypatch.setattr("splatsoil.reconstruction.reconstruct", lambda *_, **__: pytest.fail("work has begun"))
    before = {p: p.is_file() and p.read_bytes() for p in tmp_path.rglob("*")}
    in_json = [] if words.startswith(("view", "benchmark")) else ["--json"]
    places = {"SET": str(plow_dry), "RUN": str(run.path)}
    assert cli.main([*(places.get(word, word) for word in words.split()), *in_json]) == 2
    out, err = capsys.readouterr()
    (line,) = (line for line in err.splitlines() if not line.startswith("needs up to "))
    said = line.removeprefix("splatsoil: ")
    assert says in said and said != line, err
    assert json.loads(out) == {"ok": False, "error": said} if in_json else not out
    left = {p: p.is_file() and p.read_bytes() for p in tmp_path.rglob("*") if not p.name.startswith("writer.lock")}
    assert left == before
