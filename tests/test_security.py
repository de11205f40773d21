"""Measurement sets and run folders of strangers: nothing in them runs, leads outside of them, or fills the machine."""

from __future__ import annotations

import ast
import io
import json
import os
import resource
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from splatsoil.inverse.run_folder import RunFolder

from splatsoil import cli, trust
from splatsoil.cli import main
from splatsoil.errors import MeasurementError, RunError
from splatsoil.files import MOST_UNPACKED, read_json, read_npy, read_npz, write_json
from splatsoil.measurement import Measurement
from splatsoil.measurement.images import read_depth, read_image
from splatsoil.measurement.tool import read_mesh
from splatsoil.report.data import load
from splatsoil.run_files import read_description, read_fit

#: What unpacks to objects, or runs text or other programs, but for ffmpeg.
FORBIDDEN = {
    *("eval", "exec", "compile", "__import__", "os.system", "os.popen", "torch.load", "joblib.load", "yaml.load"),
    *("pickle.load", "pickle.loads", "pickle.Unpickler", "marshal.load", "marshal.loads", "shelve.open"),
    *("subprocess.run", "subprocess.call", "subprocess.Popen", "subprocess.check_output", "subprocess.check_call"),
}


def called(node: ast.expr) -> str:
    """``a.b`` of what is called."""
    if isinstance(node, ast.Name):
        return node.id
    return f"{called(node.value)}.{node.attr}" if isinstance(node, ast.Attribute) else ""


def test_the_package_never_runs_or_unpickles_what_it_reads(repository: Path) -> None:
    found = set()
    for package in ("splatsoil", "envs", "inverse"):
        for file in (repository / package).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text())):
                if not isinstance(node, ast.Call):
                    continue
                name, where = called(node.func), file.relative_to(repository).as_posix()
                pickles = [k for k in node.keywords if k.arg == "allow_pickle" and ast.literal_eval(k.value)]
                shell = [k for k in node.keywords if k.arg == "shell"]
                if name in FORBIDDEN or pickles or shell:
                    found.add((where, name))
                if name == "np.load":
                    assert "allow_pickle" in {k.arg for k in node.keywords}, where
    assert found == {("splatsoil/importing/video.py", "subprocess.run")}


# Run folders.


@pytest.mark.parametrize("command", ["compare", "diagnose", "add", "posterior", "export"])
def test_a_run_folders_program_is_not_run_before_its_user_names_it(
    run: RunFolder,
    fit_of: Callable[..., dict[str, Any]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    repository: Path,
    command: str,
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(trust, "_named", set())
    mark, program = tmp_path / "has run", run.path / "features" / "my effect.py"
    program.parent.mkdir()
    source = (repository / "examples" / "effects" / "suction.py").read_text()
    program.write_text(f"{source}\nopen({str(mark)!r}, 'w')\n")
    write_json(run.path / "fit.json", {**fit_of([str(program)]), "name": "my effect"})
    words = [command, str(run.path), *{"add": ["cohesion"], "export": ["--to", "csv"]}.get(command, [])]
    assert cli.main(words) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"splatsoil element --with '{program}'" in said and not mark.exists()
    # naming it runs it, and lets it run; another content is another program
    assert cli.main(["fit", "no set", "--with", str(program)]) == 2
    assert mark.exists()
    monkeypatch.setattr(trust, "_named", set())
    assert RunFolder.open(run.path).fit()["name"] == "my effect", "another process knows it"
    program.write_text(program.read_text() + "# changed")
    with pytest.raises(RunError, match="haven't run before"):
        RunFolder.open(run.path).fit()


@pytest.mark.parametrize("name", ["../../evil", "/etc/evil", "a/b", "a\\b", "..", ""])
def test_a_fits_name_leads_nowhere(run: RunFolder, fit_of: Callable[..., dict[str, Any]], name: str) -> None:
    write_json(run.path / "fit.json", {**fit_of(), "name": name})
    with pytest.raises(RunError, match=r"fit\.json: is damaged, it lacks name"):
        read_fit(run.path)


COMPARISON = {"format": "splatsoil-comparison/1", "parameters": {}}
EVIL = [{"name": "evil.py", "probability": 1.0}]


@pytest.mark.parametrize(
    ("file", "data", "lacks"),
    [
        *(
            ("comparison/comparison.json", {**COMPARISON, "frames": [{"observed": place}]}, "frames")
            for place in ("../../secret.png", "/secret.png", "a/../../b.png")
        ),
        ("diagnoses/base.json", {"format": "splatsoil-diagnosis/3", "model": [], "models": EVIL}, "models.0.name"),
    ],
)
def test_a_runs_files_name_no_file_outside_and_no_program(
    run: RunFolder, file: str, data: dict[str, Any], lacks: str
) -> None:
    write_json(run.path / file, {"fit": "base", "values": {}, **data})
    with pytest.raises(RunError, match=rf"{file}: is damaged, it lacks {lacks}"):
        load(run.path)


@pytest.mark.parametrize("link", ["fits", "comparison", "features", "evaluations.db", "writer.lock", "a/b/c.npy"])
def test_links_out_of_a_run_folder_are_refused(run: RunFolder, tmp_path: Path, link: str) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    place = run.path / link
    if place.is_dir():
        (place / "base.json").unlink()
        place.rmdir()
    place.unlink(missing_ok=True)
    place.parent.mkdir(parents=True, exist_ok=True)
    place.symlink_to(outside if link.count(".") == 0 else outside / "file")
    with pytest.raises(RunError, match="a link that leads out of the run folder"):
        RunFolder.open(run.path)
    assert list(outside.iterdir()) == []


def test_links_inside_a_run_folder_are_followed(run: RunFolder) -> None:
    (run.path / "large").mkdir()
    (run.path / "features").symlink_to("large")
    (run.path / "loop").symlink_to("loop")
    (run.path / "loop").unlink()
    assert RunFolder.open(run.path).fit()["name"] == "base"


def test_text_that_acts_on_a_terminal_is_refused(run: RunFolder) -> None:
    write_json(run.path / "run.json", {**read_json(run.path / "run.json"), "preset": "tiny\x1b]0;owned\x07"})
    with pytest.raises(RunError, match="control characters"):
        read_description(run.path)


def test_commands_that_are_printed_can_be_pasted(run: RunFolder, capsys: pytest.CaptureFixture[str]) -> None:
    """A shell takes nothing in a folder's name for a command."""
    evil = run.path.rename(run.path.parent / "run; touch `owned` $(owned) 'x'")
    assert cli.main(["compare", str(evil)]) == 2
    said = capsys.readouterr().err
    printed = said[said.rindex("splatsoil report") : said.index("` notes")]
    script = f"set -f; splatsoil() {{ printf '%s\\n' \"$@\"; }}; {printed}"
    done = subprocess.run(["sh", "-c", script], cwd=evil.parent, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[1] == str(evil) and not (evil.parent / "owned").exists()


# Measurement sets.


def png(width: int, height: int) -> bytes:
    """A PNG file that says it is that large, of few bytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"\0" * 9)) + chunk(b"IEND", b"")


def npy(*shape: int) -> bytes:
    """A NumPy file that says it has that shape, of few bytes."""
    stream = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue() + bytes(64)


def archive(contents: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, data in contents.items():
            opened.writestr(name, data)
    return stream.getvalue()


def swollen(name: str) -> bytes:
    """A ZIP archive of few bytes whose one entry says that it unpacks to 4 GB."""
    data = archive({name: bytes(2**16)})
    there, size = struct.pack("<I", 2**16), struct.pack("<I", 2**32 - 2)
    return data.replace(there, size)


@pytest.mark.parametrize(
    ("name", "data", "read"),
    [
        ("header.png", png(100_000, 100_000), read_image),
        ("claims.png", png(13_000, 13_000), read_image),
        ("claims.npy", npy(10**6, 10**6), read_depth),
        ("claims.npy", npy(10**6, 10**6), read_npy),
        ("claims.npz", archive({"a.npy": npy(10**6, 10**6)}), lambda path: read_npz(path, ["a"])),
        ("bomb.npz", swollen("a.npy"), lambda path: read_npz(path, ["a"])),
        ("bomb.3mf", swollen("3D/3dmodel.model"), read_mesh),
    ],
)
def test_what_claims_to_be_huge_fills_no_memory(
    tmp_path: Path, name: str, data: bytes, read: Callable[[Path], Any]
) -> None:
    (tmp_path / name).write_bytes(data)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = 1024 * int(Path("/proc/self/statm").read_text().split()[0]) * (os.sysconf("SC_PAGE_SIZE") // 1024)
    resource.setrlimit(resource.RLIMIT_AS, (used + 2 * MOST_UNPACKED, hard))
    try:
        with pytest.raises((MeasurementError, RunError), match=name.replace(".", r"\.")):
            read(tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


READS = """
import sys
from pathlib import Path
seen = []
sys.addaudithook(lambda event, given: seen.append(str(given)) if event in ("open", "subprocess.Popen", "os.system",
    "socket.connect", "os.posix_spawn", "pickle.find_class") else None)
from splatsoil.errors import MeasurementError
from splatsoil.measurement.images import read_image
from splatsoil.measurement.tool import read_mesh
for file in map(Path, sys.argv[2:]):
    try:
        (read_image if file.suffix in (".png", ".eps") else read_mesh)(file)
        print(file.name, "read")
    except MeasurementError as error:
        print(file.name, "refused")
print([what for what in seen if ("secret" in what and "secrets." not in what) or "gs" in what.split("'")[1:2]])
"""


def test_files_named_in_meshes_and_programs_in_images_are_left_alone(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    folder.mkdir()
    (tmp_path / "secret.mtl").write_text("newmtl a\nmap_Kd secret.png\n")
    box = trimesh.creation.box()
    (folder / "a.obj").write_text("mtllib ../secret.mtl\nusemtl a\n" + trimesh.exchange.obj.export_obj(box))
    parts = trimesh.exchange.gltf.export_gltf(trimesh.Scene(box))
    tree = json.loads(parts["model.gltf"])
    for number, buffer in enumerate(tree["buffers"]):
        (folder / f"secret{number}.bin").write_bytes(parts[buffer["uri"]])
        buffer["uri"] = f"secret{number}.bin"
    (folder / "b.gltf").write_text(json.dumps(tree))
    entity = f'<!DOCTYPE model [<!ENTITY x SYSTEM "file://{tmp_path}/secret.mtl">]>'
    laughs = "".join(f'<!ENTITY a{n} "{f"&a{n - 1};" * 10}">' for n in range(1, 12))
    for name, head, body in (
        ("c.3mf", entity, "&x;"),
        ("d.3mf", f'<!DOCTYPE model [<!ENTITY a0 "aaaaaaaaaa">{laughs}]>', "&a11;"),
    ):
        model = f'<?xml version="1.0"?>{head}<model unit="millimeter">{body}</model>'
        (folder / name).write_bytes(archive({"3D/3dmodel.model": model.encode()}))
    (folder / "e.dae").write_text(f'<?xml version="1.0"?>{entity}<COLLADA>&x;</COLLADA>')
    (folder / "f.zip").write_bytes(archive({"../../secret.stl": box.export(file_type="stl")}))
    page = "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n(secret) (r) file\nshowpage\n"
    for name in ("g.eps", "h.png"):
        (folder / name).write_text(page)
    files = sorted(f for f in folder.iterdir() if f.suffix != ".bin")
    done = subprocess.run(
        [sys.executable, "-c", READS, "", *map(str, files)], capture_output=True, text=True, check=True, timeout=100
    )
    assert done.stdout.splitlines() == ["a.obj read", *(f"{f.name} refused" for f in files[1:]), "[]"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["secret.mtl", "set"], "nothing was written"


@pytest.mark.parametrize("name", ["experiment.json", "tool.stl", "views/transforms.json", "views/images/000.jpg"])
def test_links_out_of_a_set_are_refused(small_set: Path, tmp_path: Path, name: str) -> None:
    outside = tmp_path / "outside"
    (small_set / name).rename(outside)
    (small_set / name).symlink_to(outside)
    with pytest.raises(MeasurementError, match="leaves the measurement set"):
        Measurement.load(small_set)


@pytest.mark.parametrize("name", ["images/\x1b[31mred.jpg", "images/\udcff.jpg", "images/\u202egpj.exe"])
def test_an_error_does_not_act_on_the_terminal(name: str, small_set: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = small_set / "views" / "transforms.json"
    views = json.loads(file.read_text())
    views["frames"][1]["file_path"] = name
    file.write_text(json.dumps(views))
    assert main(["check", str(small_set)]) == 2
    said = capsys.readouterr().err.rstrip("\n")
    assert said.isprintable() and said.count("frames[1].file_path") == 1


def test_names_in_a_set_reach_terminal_and_page_as_they_are(
    small_set: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither rich's markup, nor mathematics, nor the shell's."""
    name = "[red]$a_{$ <img src=x onerror=alert(1)> $(x) [link=x]"
    experiment = json.loads((small_set / "experiment.json").read_text())
    (small_set / "experiment.json").write_text(json.dumps({**experiment, "name": name}))
    assert cli.main(["check", str(small_set)]) == 0
    assert name.split()[0] in capsys.readouterr().out
