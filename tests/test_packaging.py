"""The built wheel, installed in another place: what a user gets, not what the source tree shows."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from pathlib import Path
from typing import Any

import pytest

FOLDERS = ("splatsoil", "envs", "inverse", "benchmarks")
FILES = ("pyproject.toml", "README.md", "LICENSE")


def run(*words: str | Path, cwd: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(word) for word in words],
        cwd=cwd,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.fixture(scope="module")
def project(repository: Path) -> dict[str, Any]:
    return tomllib.loads((repository / "pyproject.toml").read_text())


def test_the_developers_environment_leaves_no_test_out(project: dict[str, Any]) -> None:
    """Tests skip what is not installed, so `make test` installs every extra."""
    extras = project["project"]["optional-dependencies"]
    (with_all,) = (word for word in extras.pop("dev") if word.startswith("splatsoil["))
    assert set(with_all.removeprefix("splatsoil[").rstrip("]").split(",")) == extras.keys()


@pytest.fixture(scope="module")
def wheel(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy of the sources, so that no old build folder can slip into it."""
    sources = tmp_path_factory.mktemp("sources")
    for name in FOLDERS:
        shutil.copytree(repository / name, sources / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in FILES:
        shutil.copy(repository / name, sources)
    out = tmp_path_factory.mktemp("wheel")
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    built = run(*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", out, ".", cwd=sources)
    assert built.returncode == 0, built.stderr
    (file,) = out.glob("*.whl")
    return file


@pytest.fixture(scope="module")
def elsewhere(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fresh virtual environment with the wheel; its dependencies are lent by the one that runs the tests."""
    folder = tmp_path_factory.mktemp("elsewhere")
    venv.create(folder / "venv", with_pip=False)
    python = folder / "venv" / "bin" / "python"
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python)
    installed = run(*pip, "install", "--no-deps", "--no-index", wheel, cwd=folder)
    assert installed.returncode == 0, installed.stderr
    # A path file adds the folder but does not run the path files in it, so the editable install stays out of sight.
    site_packages(folder).joinpath("lent.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder


def site_packages(folder: Path) -> Path:
    (found,) = (folder / "venv" / "lib").glob("python*/site-packages")
    return found


def test_one_name_in_site_packages(elsewhere: Path) -> None:
    names = {p.name for p in site_packages(elsewhere).iterdir()} - {"lent.pth"}
    assert sorted(name.split("-")[0] for name in names) == ["splatsoil", "splatsoil"], names
    assert any(name.endswith(".dist-info") for name in names)


def test_the_wheel_holds_every_file_of_the_package_and_no_other(wheel: Path, repository: Path) -> None:
    """Modules, the marker of types, templates, styles and tables; beside them only what describes the wheel."""
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    files = {p for f in FOLDERS for p in (repository / f).rglob("*") if p.is_file() and p.suffix != ".pyc"}
    names = {f"splatsoil/{p.relative_to(repository).as_posix().removeprefix('splatsoil/')}" for p in files}
    assert inside == names and "splatsoil/py.typed" in names
    assert any(name.endswith("LICENSE") for name in zipfile.ZipFile(wheel).namelist())


def test_imports_come_from_the_wheel(elsewhere: Path) -> None:
    code = (
        "import json, splatsoil, splatsoil.envs, splatsoil.inverse, splatsoil.benchmarks\n"
        "modules = [splatsoil, splatsoil.envs, splatsoil.inverse, splatsoil.benchmarks]\n"
        "print(json.dumps([m.__file__ for m in modules]))\n"
        "for name in ('envs', 'inverse', 'benchmarks'):\n"
        "    try:\n"
        "        __import__(name)\n"
        "    except ModuleNotFoundError:\n"
        "        continue\n"
        "    raise AssertionError(name + ' is a top-level name')\n"
    )
    done = run(elsewhere / "venv/bin/python", "-c", code, cwd=elsewhere)
    assert done.returncode == 0, done.stderr
    for file in json.loads(done.stdout):
        assert Path(file).is_relative_to(site_packages(elsewhere) / "splatsoil"), file


def test_a_users_own_envs_folder_does_not_get_in_the_way(elsewhere: Path, tmp_path: Path) -> None:
    (tmp_path / "envs").mkdir()
    (tmp_path / "envs" / "__init__.py").write_text("mine = True\n")
    code = "import envs, splatsoil.envs; assert envs.mine and splatsoil.envs is not envs"
    done = run(elsewhere / "venv/bin/python", "-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_the_environment_is_registered(elsewhere: Path) -> None:
    code = "import gymnasium, splatsoil; print(gymnasium.spec('PlowSand-v0').id)"
    done = run(elsewhere / "venv/bin/python", "-c", code, cwd=elsewhere)
    assert (done.returncode, done.stdout) == (0, "PlowSand-v0\n"), done.stderr


def test_the_command_line_works(elsewhere: Path, plow_dry: Path, project: dict[str, Any]) -> None:
    helped = run(elsewhere / "venv/bin/splatsoil", "--help", cwd=elsewhere)
    assert helped.returncode == 0 and "check" in helped.stdout, helped.stderr
    version = run(elsewhere / "venv/bin/splatsoil", "--version", cwd=elsewhere)
    installed = next(site_packages(elsewhere).glob("splatsoil-*.dist-info")).name
    assert installed == f"splatsoil-{version.stdout.split()[1]}.dist-info"
    assert project["project"]["dynamic"] == ["version"], "one place for the version"
    checked = run(elsewhere / "venv/bin/python", "-m", "splatsoil", "check", plow_dry, "--json", cwd=elsewhere)
    assert checked.returncode == 0, checked.stderr
    assert json.loads(checked.stdout)["views"] == 40
