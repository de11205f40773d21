"""Whole measurement sets, mutated by Hypothesis: `check` ends in a set or in one sentence, and writes nothing."""

from __future__ import annotations

import json
import shutil
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from PIL import Image

from splatsoil.cli import main
from splatsoil.measurement import Bed, Camera, Contents, Measurement, Picture, Tool, ToolMotion, write_measurement

SET, VIEWS, VIDEO = "experiment.json", "views/transforms.json", "video/transforms.json"
MOTION, FORCE, MESH = "tool_motion.csv", "tool_force.csv", "tool.stl"
Mutation = Callable[[Path], None]


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set with all that one can have, in few and small files: masks, depth, a force and a lens that distorts."""
    folder = tmp_path_factory.mktemp("base")
    random = np.random.default_rng(0)
    pose = np.array([[1.0, 0, 0, 0.4], [0, 0.8, -0.6, -0.35], [0, 0.6, 0.8, 1.05], [0, 0, 0, 1]])
    camera = Camera(32, 24, 30.0, 30.0, 16.0, 12.0, pose, k1=-0.05)

    def picture(camera: Camera, **when: Any) -> Picture:
        return Picture(camera, random.random((24, 32, 3)), **when)

    tool = trimesh.creation.box((0.02, 0.1, 0.1))
    times = np.arange(5) / 50.0
    way = np.column_stack([0.2 + 0.5 * times, np.full(5, 0.25), np.full(5, 0.15)])
    motion = ToolMotion(np.arange(5), times, way, np.tile([1.0, 0, 0, 0], (5, 1)))
    force = np.column_stack([np.arange(5), times, np.full(5, -4.0), np.zeros(5), np.ones(5)])
    video = [
        picture(replace(camera, name=name), frame=n, time=n / 50.0) for n in (-1, 0, 4) for name in ("left", "right")
    ]
    contents = Contents(
        name="base",
        bed=Bed(np.zeros(3), np.array([0.8, 0.5, 0.25]), 1600.0),
        tool=Tool(tool, motion, force=force),
        frame_rate=50.0,
        views=[picture(camera) for _ in range(3)],
        video=video,
    )
    plain = write_measurement(folder / "plain", contents, suffix=".png")
    mask = folder / "mask.png"
    Image.fromarray(np.uint8(255 * (random.random((24, 32)) > 0.2))).save(mask)
    np.save(folder / "depth.npy", np.full((24, 32), 1.2, dtype=np.float32))
    Image.fromarray(np.full((24, 32), 1200, dtype=np.uint16)).save(folder / "depth.png")
    first, second, third = plain.views
    first = replace(first, mask_path=mask, depth_path=folder / "depth.npy")
    second = replace(second, depth_path=folder / "depth.png")
    write_measurement(folder / "set", replace(contents, views=[first, second, third]), suffix=".png")
    return folder / "set"


@pytest.fixture(scope="module")
def photographed(plow_dry: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set that can be reconstructed in seconds: every fifth view and three frames of plow-dry, at a fifth of their
    size."""
    folder = tmp_path_factory.mktemp("photographed") / "set"
    folder.mkdir()
    for name in (SET, MESH, MOTION, FORCE):
        shutil.copy(plow_dry / name, folder)
    for name, kept in ((VIEWS, slice(None, None, 5)), (VIDEO, slice(None, 3))):
        data = json.loads((plow_dry / name).read_text())
        data["frames"] = data["frames"][kept]
        for entry in (data, *data["frames"]):
            for key in {"w", "h", "fl_x", "fl_y", "cx", "cy"} & entry.keys():
                entry[key] = entry[key] // 5 if key in "wh" else entry[key] / 5
        for frame in data["frames"]:
            target = (folder / name).parent / frame["file_path"]
            target.parent.mkdir(parents=True, exist_ok=True)
            with Image.open((plow_dry / name).parent / frame["file_path"]) as image:
                image.reduce(5).save(target, quality=95)
        (folder / name).write_text(json.dumps(data))
    return folder


ODD: st.SearchStrategy[Any] = st.sampled_from(
    [None, True, False, 0, -1, 1, 0.5, 1e-300, 1e300, -1e9, 10**400, float("nan"), float("inf"), "", " ", ".", "..",
     "/", "a\0b", "\ud800", "ü", "😀" * 100, "images", MESH, SET, VIEWS, "C:\\x", "<b>[red]x[/red]</b>", [], {}, [[]],
     {"a": 1}, [0, 0, 0], [1e300] * 3, "OPENCV_FISHEYE", "RADIAL", "PINHOLE", "z", "left"]
)  # fmt: skip
FACTORS = st.sampled_from(
    [-1.0, 0.0, 1e-3, 1 / 39.37, 0.1, 0.5, 0.99, 1.05, 2.0, 3.0, 10.0, 39.37, 180 / np.pi, 1e3, 1e9]
)
CELLS = st.one_of(
    st.sampled_from(["", "nan", "inf", "-0", "1e999", "0x1", "1_0", "1,5", '"', "#", ";", "\0", "1.7e9", "１", "−1"]),
    st.floats().map(str),
    st.text(max_size=4),
)


def places(data: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Ways to all values inside of JSON data."""
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in items:
        yield (*way, key)
        yield from places(value, (*way, key))


def all_files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file() and not p.is_symlink())


@st.composite
def in_json(draw: st.DrawFn) -> Mutation:
    """One value of a JSON file: another one, gone, scaled, under a misspelt name, or listed again."""
    name = draw(st.sampled_from([SET, VIEWS, VIDEO]))
    where, how = draw(st.integers(0, 10**6)), draw(st.sampled_from(["odd", "drop", "scale", "rename", "again", "swap"]))
    odd, factor, letter = draw(ODD), draw(FACTORS), draw(st.integers(0, 30))

    def mutate(folder: Path) -> None:
        data = json.loads((folder / name).read_text())
        ways = list(places(data))
        *above, key = ways[where % len(ways)]
        holder = data
        for step in above:
            holder = holder[step]
        value = holder[key]
        if how == "odd":
            holder[key] = odd
        elif how == "drop":
            del holder[key]
        elif how == "scale" and isinstance(value, int | float):
            holder[key] = value * factor
        elif how == "scale" and isinstance(value, list) and all(isinstance(v, int | float) for v in value):
            holder[key] = [v * factor for v in value]
        elif how == "rename" and isinstance(holder, dict):
            holder[key[: letter % len(key)] + key[letter % len(key) + 1 :]] = holder.pop(key)
        elif how == "again" and isinstance(holder, list):
            holder.append(value)
        elif how == "swap" and isinstance(holder, list):
            holder[key], holder[-1] = holder[-1], holder[key]
        (folder / name).write_text(json.dumps(data))

    return mutate


@st.composite
def in_table(draw: st.DrawFn) -> Mutation:
    """A cell, a row or a column of a CSV file, or what parts its cells."""
    name, how = draw(st.sampled_from([MOTION, FORCE])), draw(st.sampled_from(["cell", "row", "scale", "mark", "swap"]))
    i, j, cell, factor = draw(st.integers(0, 5)), draw(st.integers(0, 8)), draw(CELLS), draw(FACTORS)
    mark = draw(st.sampled_from([";", "\t", " ", "|", ",,", ", "]))

    def mutate(folder: Path) -> None:
        rows = [line.split(",") for line in (folder / name).read_text(errors="replace").splitlines()]
        row, column = i % len(rows), j % len(rows[0])
        if how == "cell":
            rows[row][column % len(rows[row])] = cell
        elif how == "row":
            rows.insert(j % len(rows), rows.pop(row))
        elif how == "swap":
            rows = [[*r[column:], *r[:column]] for r in rows]
        elif how == "scale":
            for r in rows[1:]:
                try:
                    r[column] = repr(float(r[column]) * factor)
                except (ValueError, IndexError):
                    return
        joined = (mark if how == "mark" else ",").join
        (folder / name).write_text("\n".join(joined(r) for r in rows), errors="replace")

    return mutate


@st.composite
def in_bytes(draw: st.DrawFn) -> Mutation:
    """Any file: truncated, bits turned, bytes put in, or written in another encoding."""
    which, at, count = draw(st.integers(0, 10**6)), draw(st.floats(0, 1)), draw(st.integers(1, 8))
    how, put = draw(st.sampled_from(["cut", "turn", "put", "begin", "utf16"])), draw(st.binary(min_size=1, max_size=8))

    def mutate(folder: Path) -> None:
        files = all_files(folder)
        file = files[which % len(files)]
        raw = bytearray(file.read_bytes())
        place = int(at * len(raw))
        if how == "cut":
            raw = raw[:place]
        elif how == "turn":
            for k in range(place, min(place + count, len(raw))):
                raw[k] ^= 1 << (k % 8)
        elif how == "utf16":
            raw = bytearray(raw.decode("utf-8", "replace").encode("utf-16"))
        else:
            place = 0 if how == "begin" else place
            raw[place:place] = put
        file.write_bytes(raw)

    return mutate


@st.composite
def in_files(draw: st.DrawFn) -> Mutation:
    """Any file: gone, empty, a folder, a link out of the set, or another file's content."""
    which, other = draw(st.integers(0, 10**6)), draw(st.integers(0, 10**6))
    how = draw(st.sampled_from(["gone", "empty", "folder", "link", "loop", "other"]))

    def mutate(folder: Path) -> None:
        files = all_files(folder)
        file, source = files[which % len(files)], files[other % len(files)]
        content = source.read_bytes()
        file.unlink()
        if how == "folder":
            file.mkdir()
        elif how == "link":
            file.symlink_to("/etc/passwd")
        elif how == "loop":
            file.symlink_to(file.name)
        elif how != "gone":
            file.write_bytes(content if how == "other" else b"")

    return mutate


@st.composite
def in_images(draw: st.DrawFn) -> Mutation:
    """A photograph, mask or frame: of another size, mode, type or brightness."""
    which = draw(st.integers(0, 10**6))
    mode = draw(st.sampled_from(["1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr", "I;16", "I", "F"]))
    kind = draw(st.sampled_from(["PNG", "JPEG", "TIFF", "GIF", "BMP", "WEBP", "PPM"]))
    size = draw(st.sampled_from([(32, 24), (24, 32), (1, 1), (31, 24)]))
    level = draw(st.sampled_from([None, 0, 1, 127, 255]))
    turn = draw(st.sampled_from([None, 3, 6, 99]))

    def mutate(folder: Path) -> None:
        files = [p for p in all_files(folder) if p.suffix in (".png", ".jpg")]
        if not files:
            return
        file = files[which % len(files)]
        noise = np.random.default_rng(1).integers(0, 256, (*size[::-1], 3), dtype=np.uint8)
        image = Image.fromarray(noise if level is None else np.full_like(noise, level))
        exif = Image.Exif()
        if turn is not None:
            exif[0x0112] = turn
        stream = BytesIO()
        try:
            image.convert("RGB" if mode == "RGB" else "L" if mode in ("I;16", "F", "I") else mode).convert(mode).save(
                stream, format=kind, exif=exif
            )
        except (OSError, ValueError, KeyError):  # not every format has every mode
            return
        file.write_bytes(stream.getvalue())

    return mutate


@st.composite
def in_mesh(draw: st.DrawFn) -> Mutation:
    """The tool: scaled, moved, open, inside out, of two bodies, or of another format."""
    factor, shift, drop = draw(FACTORS), draw(st.floats(-1, 1)), draw(st.integers(0, 3))
    how = draw(st.sampled_from(["scale", "shift", "open", "invert", "two", "flat"]))
    kind = draw(st.sampled_from(["stl", "stl_ascii", "obj", "ply", "off", "glb"]))

    def mutate(folder: Path) -> None:
        mesh = trimesh.creation.box((0.02, 0.1, 0.1))
        if how == "scale":
            mesh.apply_scale(factor or 1e-9)
        elif how == "shift":
            mesh.apply_translation([shift, 0, shift])
        elif how == "invert":
            mesh.invert()
        elif how == "two":
            second = mesh.copy().apply_translation([shift, 0, 0])
            second.invert()
            mesh = trimesh.util.concatenate([mesh, second])
        elif how == "flat":
            mesh.vertices[:, drop % 3] = 0.0
        else:
            mesh = trimesh.Trimesh(mesh.vertices, mesh.faces[drop:], process=False)
        data = mesh.export(file_type=kind)
        (folder / MESH).write_bytes(data.encode() if isinstance(data, str) else data)

    return mutate


MUTATIONS = st.lists(
    st.one_of(in_json(), in_json(), in_table(), in_bytes(), in_files(), in_images(), in_mesh()), min_size=1, max_size=3
)


def everything(folder: Path) -> dict[str, bytes | None]:
    return {
        str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None
        for p in sorted(folder.rglob("*"))
        if not p.is_symlink()
    }


def checked(base: Path, mutations: list[Mutation], as_json: bool, command: Sequence[str] = ("check",)) -> int:
    """The exit code of a command on a mutated copy of the set, having seen that it is one of the promised ends."""
    folder = base.parent / "mutated"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(base, folder)
    for mutate in mutations:
        try:
            mutate(folder)
        except (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError):
            break  # the mutation before left nothing that this one could change
    before = everything(base.parent)
    out, err = StringIO(), StringIO()
    with redirect_stdout(out), redirect_stderr(err), warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("default")
        name, *options = command
        code = main([name, str(folder), *options, *(["--json"] if as_json else [])])
    assert code in (0, 2)
    assert not [w for w in warned if not issubclass(w.category, DeprecationWarning)], "nothing else on stderr"
    if code == 2:
        print(err.getvalue())
        said = [line for line in err.getvalue().splitlines(keepends=True) if not line.startswith("remark ")]
        sentence = "".join(said).removeprefix("splatsoil: ")
        assert sentence.startswith(str(folder)), "names the file"
        assert sentence.count("\n") == 1 and len(sentence) < 1000, "one sentence"
    if as_json:
        assert json.loads(out.getvalue(), parse_constant=pytest.fail)["ok"] == (code == 0)
    else:
        out.getvalue().encode()
    assert everything(base.parent) == before, "nothing written"
    return code


def some(count: int) -> settings:
    return settings(
        max_examples=count,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )


@some(100)
@given(mutations=MUTATIONS, as_json=st.booleans())
@example(mutations=[], as_json=True)
def test_check_on_mutated_sets(base: Path, mutations: list[Mutation], as_json: bool) -> None:
    checked(base, mutations, as_json)


@pytest.mark.slow
@some(1000)
@given(mutations=MUTATIONS, as_json=st.booleans())
def test_check_on_many_mutated_sets(base: Path, mutations: list[Mutation], as_json: bool) -> None:
    checked(base, mutations, as_json)


@pytest.mark.slow
@some(200)
@given(mutations=MUTATIONS)
@example(mutations=[])
def test_reconstruct_on_mutated_sets(
    photographed: Path, tmp_path_factory: pytest.TempPathFactory, mutations: list[Mutation]
) -> None:
    out = tmp_path_factory.mktemp("out") / "made"
    options = ("--preset", "tiny", "--holdout", "0", "--device", "cpu", "--out", str(out))
    began = time.monotonic()
    code = checked(photographed, mutations, as_json=True, command=("reconstruct", *options))
    assert time.monotonic() - began < 60.0
    assert out.is_dir() == (code == 0)
    shutil.rmtree(out, ignore_errors=True)


def test_the_set_that_is_mutated_is_in_order(base: Path) -> None:
    assert checked(base, [], as_json=True) == 0
    assert len(Measurement.load(base).views) == 3
