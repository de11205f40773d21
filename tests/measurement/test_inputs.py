"""docs/inputs.md is what the code does: every row of it is tried. Run as a program, this file writes it anew."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from splatsoil.errors import MeasurementError
from splatsoil.measurement import Camera, Frame, ToolMotion
from splatsoil.measurement import measurement as limits
from splatsoil.measurement.images import check_photograph
from splatsoil.measurement.motion import MOTION_COLUMNS
from splatsoil.measurement.remarks import _FORCES
from splatsoil.measurement.tool import read_mesh

PAGE = Path(__file__).resolve().parents[2] / "docs" / "inputs.md"
HALF = np.tile(np.linspace(0.0, 1.0, 16), (16, 1))
CAMERA = Camera(16, 16, 16.0, 16.0, 8.0, 8.0, np.eye(4))


def outcome(attempt: Callable[[], str]) -> str:
    """What an attempt gives, or the sentence that refuses it, without the file's name."""
    try:
        return attempt()
    except MeasurementError as error:
        said = str(error).removeprefix(f"{error.file}: ").removeprefix(f"{error.field}: ")
        return f"refused: *{said}*"


def images(folder: Path) -> Iterator[tuple[str, str]]:
    """Photographs: a ramp from 0 to 1 whose largest value is told."""

    def of(image: Image.Image, name: str, **options: object) -> Callable[[], str]:
        def attempt() -> str:
            path = folder / name
            image.save(path, **options)
            check_photograph(path, (16, 16), sizes_from="w and h")
            frame = Frame(CAMERA, path)
            mask = frame.mask()
            seen = "" if mask is None else f"; {100 * mask.mean():.0f} % of it is used"
            return f"read, {frame.image().min():.3g} to {frame.image().max():.3g}{seen}"

        return attempt

    def white_is_zero() -> str:
        Image.fromarray((65535 * HALF).astype(np.uint16)).save(folder / "w.tif", tiffinfo={262: 0})
        check_photograph(folder / "w.tif", (16, 16), sizes_from="w and h")
        return f"read, 0 is {Frame(CAMERA, folder / 'w.tif').image()[0, 0, 0]:g}"

    def heic() -> str:
        (folder / "a.heic").write_bytes(b"ftypheic")
        check_photograph(folder / "a.heic", (16, 16), sizes_from="w and h")
        return "read"

    def turned() -> str:
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.fromarray((255 * HALF[:12]).round().astype(np.uint8)).save(folder / "a.jpg", exif=exif)
        check_photograph(folder / "a.jpg", (12, 16), sizes_from="w and h")
        return "read"

    eight = Image.fromarray((255 * HALF).round().astype(np.uint8))
    see_through = eight.convert("RGBA")
    see_through.putalpha(eight)
    yield "8 bits, grey or colour (JPEG, PNG …)", outcome(of(eight, "a.png"))
    yield "16 bits, grey", outcome(of(Image.fromarray((65535 * HALF).astype(np.uint16)), "b.png"))
    yield "floating-point TIFF in [0, 1]", outcome(of(Image.fromarray(HALF.astype(np.float32)), "c.tif"))
    yield "floating-point TIFF to 255", outcome(of(Image.fromarray((255 * HALF).astype(np.float32)), "d.tif"))
    yield "alpha from 0 to 255 (opaque by half or more is used)", outcome(of(see_through, "e.png"))
    yield "16 bits, grey, TIFF in which 0 is white", outcome(white_is_zero)
    yield "a transparent colour, here the darkest (palette, tRNS)", outcome(of(eight, "f.png", transparency=0))
    yield "turned by EXIF, where `w` and `h` are as displayed", outcome(turned)
    yield "one even grey", outcome(of(Image.new("RGB", (16, 16), (127, 127, 127)), "g.png"))
    yield "HEIC", outcome(heic)


def depths(folder: Path) -> Iterator[tuple[str, str]]:
    for name, values in (
        ("16-bit image of 1500", np.full((16, 16), 1500, np.uint16)),
        ("`.npy` of whole numbers, 1500", np.full((16, 16), 1500, np.int32)),
        ("floating-point TIFF of 1.5", np.full((16, 16), 1.5, np.float32)),
        ("`.npy` of floating-point numbers, 1.5", np.full((16, 16), 1.5)),
        ("`.npy` of NaN", np.full((16, 16), np.nan)),
        ("8-bit image of 150", np.full((16, 16), 150, np.uint8)),
    ):
        path = folder / ("depth.npy" if "npy" in name else "depth.tif")
        if path.suffix == ".npy":
            np.save(path, values)
        else:
            Image.fromarray(values).save(path)

        def attempt(path: Path = path) -> str:
            depth = Frame(CAMERA, path, depth_path=path).depth()
            assert depth is not None
            return f"{depth.max():.3g} m" if depth.max() > 0.0 else "unknown"

        yield name, outcome(attempt)


def meshes(folder: Path) -> Iterator[tuple[str, str]]:
    """A box of a litre."""
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    away = box.copy()
    away.apply_translation([1.0, 0.0, 0.0])
    away.invert()
    below, aside = box.copy(), box.copy()
    below.apply_translation([0.0, 0.0, -0.1])
    aside.apply_translation([0.1, 0.0, -0.1])
    doubled = trimesh.Trimesh(box.vertices, np.vstack([box.faces, box.faces[:1]]), process=False)
    for name, mesh, suffix in (
        *((f"{kind.upper()}", box, kind) for kind in ("stl", "obj", "ply", "off", "glb")),
        ("two bodies, one inside out", trimesh.util.concatenate([box, away]), "stl"),
        ("a face given twice", doubled, "ply"),
        ("two bodies that touch along a face", trimesh.util.concatenate([box, below]), "stl"),
        ("two bodies that touch along an edge", trimesh.util.concatenate([box, aside]), "stl"),
        ("a face missing", trimesh.Trimesh(box.vertices, box.faces[1:]), "stl"),
    ):
        mesh.export(folder / f"tool.{suffix}")

        def attempt(path: Path = folder / f"tool.{suffix}") -> str:
            return f"read, {1000.0 * read_mesh(path).volume:.3g} l"

        yield name, outcome(attempt)


def tables(folder: Path) -> Iterator[tuple[str, str]]:
    head, rows = ",".join(MOTION_COLUMNS), "0,0.5,0,0,0,1,0,0,0\n1,0.75,0,0,0,1,0,0,0\n"
    plain = f"{head}\n{rows}"
    for name, text in (
        ("commas", plain),
        ("tabs", plain.replace(",", "\t")),
        ("semicolons and decimal commas", plain.replace(",", ";").replace(".", ",")),
        ("comments (#), or the header in one", "# by hand\n# " + plain),
        ("capitals, commas at the ends of lines", plain.upper().replace("\n", ",\n")),
        ("a further column", plain.replace("\n", ",7\n").replace("qz,7", "qz,torque")),
        ("other units by the header", plain.replace("x,y", "x [mm],y")),
        ("commas and decimal commas", plain.replace(".", ",")),
        ("semicolons, decimal commas and points", plain.replace(",", ";").replace("0.5", "0,5")),
    ):
        (folder / "motion.csv").write_text(text, encoding="utf-8")

        def attempt() -> str:
            return f"read, {', '.join(f'{t:g}' for t in ToolMotion.read(folder / 'motion.csv').times)} s"

        yield name, outcome(attempt)


def sizes() -> Iterator[tuple[str, str]]:
    yield "an edge of the bed", f"{limits._SMALLEST_BED:g} to {limits._LARGEST_BED:g} m"
    yield "the bed's distance from the origin", f"to {limits._FARTHEST_BED:g} m"
    yield "bulk density", "{:g} to {:g} kg/m³".format(*limits._DENSITIES)
    yield "gravity", "{:g} to {:g} m/s², downwards".format(*limits._GRAVITIES)
    yield "a camera's distance", f"to {limits._FAR_CAMERA:g} diagonals of the bed"
    yield (
        "the tool's width (the second of its three extents)",
        f"a bed holds {limits._SMALL_TOOL:g} of its cubes at most",
    )
    yield "the tool under the floor, or beyond two opposite walls", f"to {100 * limits._SLACK:g} % of the bed"
    yield "the tool's speed", f"to {limits._FASTEST_TOOL:g} m/s"
    yield "time in motion and video", "frame number by `frame_rate`, within a frame"
    yield "the force's work on a tool that does not turn", "negative"
    yield (
        "the largest force, by the weight of a cube of soil as wide as the tool",
        "{:g} to {:g}, else a remark".format(*_FORCES),
    )


def page() -> str:
    out = [
        "# What is read, and how",
        "",
        "Made from the code by `python tests/measurement/test_inputs.py`: each row was tried. The format is in",
        "[measurement-set.md](measurement-set.md). What is refused ends with exit code 2 and a sentence that names",
        "file and field.",
    ]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for title, rows in (
            ("Photographs and video frames", images(folder)),
            ("Depth", depths(folder)),
            ("The tool's mesh", meshes(folder)),
            ("Motion and force", tables(folder)),
            ("Sizes and units", sizes()),
        ):
            out += ["", f"## {title}", "", "| given | what becomes of it |", "|---|---|"]
            out += [f"| {given} | {becomes} |" for given, becomes in rows]
    return "\n".join(out) + "\n"


def test_the_page_is_what_the_code_does() -> None:
    assert PAGE.read_text(encoding="utf-8") == page(), "write it anew: python tests/measurement/test_inputs.py"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
