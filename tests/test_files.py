"""What decides results is in the digest of the code, and damaged files get one sentence."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from splatsoil.errors import ParameterError, RunError
from splatsoil.files import (
    CRITICISM,
    FORWARD,
    RECONSTRUCTING,
    check_folder,
    code_digest,
    digest,
    read_npy,
    read_npz,
    write_bytes,
    write_json,
    write_npz,
)

#: Modules that results are made with, and why they don't decide one.
NEUTRAL = {
    "__init__.py": "the version, which each key has by itself",
    "_version.py": "the version, which each key has by itself",
    "starting.py": "what Ctrl-C does while the package is being loaded",
    "deterministic.py": "the same numbers, always in the same order",
    "errors.py": "words",
    "arrays.py": "names of types",
    "batches.py": "how many at once, each of which comes out the same",
    "files.py": "files, and the digest itself",
    "run_files.py": "what kept files are called, and must hold",
    "threads.py": "how many work at once",
    "envs/__init__.py": "the names of environments",
    "devices.py": "the device, which each key has by itself",
    "envs/problem.py": "what an evaluation is",
    "quiet.py": "what libraries print",
}


@pytest.mark.parametrize(
    ("start", "parts"),
    [
        ("reconstruction.pipeline", RECONSTRUCTING),
        ("envs.measured", FORWARD),
        ("experiment.plow", FORWARD),
        ("inverse.criticism.diagnosis", (*FORWARD, *CRITICISM)),
    ],
)
def test_the_code_that_decides_a_result_is_in_its_digest(
    imports: dict[str, set[str]], start: str, parts: tuple[str, ...]
) -> None:
    """All that a module imports, directly or not, but for the commands as functions, which are loaded for who asks."""
    left, seen = {f"splatsoil.{start}"}, {"splatsoil", "splatsoil.api"}
    while left:
        seen |= left
        left = set().union(*(imports[name] for name in left)) - seen
    names = {name.removeprefix("splatsoil.").replace(".", "/") for name in seen - {"splatsoil", "splatsoil.api"}}
    files = {f"{name}/__init__.py" if any(n.startswith(f"{name}/") for n in names) else f"{name}.py" for name in names}
    assert len(files) > 10
    assert {f for f in files - {*NEUTRAL} if not any(f == p or f.startswith(f"{p}/") for p in parts)} == set()


def test_every_part_of_a_digest_is_there(tmp_path: Path) -> None:
    """One that were not would change nothing, unnoticed."""
    nothing = code_digest(())
    for name in (*FORWARD, *CRITICISM):
        assert code_digest((name,)) != nothing, name


def test_a_source_tree_and_what_is_installed_of_it_have_the_same_digest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = []
    for tree, envs in ("source", "envs"), ("installed", "splatsoil/envs"):
        for place, contents in ("splatsoil/soil", "1"), ("splatsoil/comparison", "2"), (f"{envs}/measured", "3"):
            file = tmp_path / tree / f"{place}.py"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(contents)
        monkeypatch.setattr("splatsoil.files.__file__", str(tmp_path / tree / "splatsoil" / "files.py"))
        found.append(code_digest(("soil.py", "envs/measured.py", "comparison.py")))
    assert found[0] == found[1] != code_digest(("soil.py", "envs/measured.py"))


DAMAGE = {"empty": 0, "cut": -100}


@pytest.mark.parametrize("length", DAMAGE.values(), ids=DAMAGE)
def test_arrays_that_were_cut_short_get_one_sentence(tmp_path: Path, length: int) -> None:
    one, several = tmp_path / "one.npy", tmp_path / "several.npz"
    np.save(one, np.arange(30.0))
    write_npz(several, a=np.arange(30.0), b=1.5)
    np.testing.assert_array_equal(read_npy(one), np.arange(30.0))
    assert read_npz(several, ("b",)) == {"b": 1.5}
    for path in (one, several):
        path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(RunError, match=r"one\.npy: cannot be read .*; delete it and run the command again"):
        read_npy(one)
    with pytest.raises(RunError, match=r"several\.npz: cannot be read .*; delete it and run the command again"):
        read_npz(several, ("a",))


def test_what_is_no_array_or_lacks_one_gets_one_sentence(tmp_path: Path) -> None:
    path = write_npz(tmp_path / "several.npz", a=1.0)
    with pytest.raises(RunError, match=r"several\.npz: cannot be read .*b.*; make another"):
        read_npz(path, ("a", "b"), remedy="make another")
    for read in (read_npy, lambda path: read_npz(path, ("a",))):
        text = tmp_path / "text"
        text.write_text("no array")
        with pytest.raises(RunError, match="text: cannot be read"):
            read(text)
    with pytest.raises(RunError, match="no single array"):
        read_npy(path)


def test_a_write_that_fails_leaves_the_old_file_and_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_json(tmp_path / "a.json", {"old": True})

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("splatsoil.files.os.fsync", full)
    with pytest.raises(RunError, match="No space left"):
        write_bytes(path, b"new")
    assert json.loads(path.read_text()) == {"old": True}
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_json_is_strict(tmp_path: Path) -> None:
    path = write_json(
        tmp_path / "a.json", {"nan": float("nan"), "array": np.arange(2), "path": tmp_path, "n": np.int64(3)}
    )
    assert json.loads(path.read_text(), parse_constant=lambda _: pytest.fail("not JSON")) == {
        "nan": None,
        "array": [0, 1],
        "path": str(tmp_path),
        "n": 3,
    }


def test_digests_know_contents_and_not_order() -> None:
    assert digest({"a": 1, "b": [1, 2]}) == digest({"b": [1, 2], "a": 1})
    assert digest({"a": 1.0}) != digest({"a": 1.0 + 2**-52})


@pytest.mark.parametrize(
    ("place", "says"),
    [
        ("a\0b", "no usable path"),
        ("a" * 300, "no usable path"),
        ("set", "is a measurement set"),
        ("file/x", "is a file"),
    ],
)
def test_a_folder_for_results_is_refused_before_work_is_spent_on_it(place: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "experiment.json").write_text("{}")
    (tmp_path / "file").write_text("")
    with pytest.raises((ParameterError, RunError), match=says):
        check_folder(tmp_path / place)
    check_folder(tmp_path / "set" / "runs" / "one")
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["experiment.json", "file", "set"]
