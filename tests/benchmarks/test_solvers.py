"""Our solver beside converged worlds: scenes, what is kept of them, and how they are compared."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from splatsoil.benchmarks import solvers
from splatsoil.benchmarks._newton import Numerics, Run, World
from splatsoil.benchmarks._scenes import ANGLES, BEDS, RADIUS, SOIL, TOOLS, Scene, pair, scenes
from splatsoil.benchmarks.solvers import (
    FRAMES,
    Case,
    Kept,
    compare_forces,
    cut_and_heaped,
    in_patches,
    judge,
    main,
    moved,
    plough_missing,
    stage_forces,
    told,
)

from splatsoil.errors import ParameterError
from splatsoil.measurement import Measurement, ToolMotion
from splatsoil.mpm import Resolution, simulate
from splatsoil.reconstruction import fill
from splatsoil.synthetic import plow

COARSE = Numerics(voxel=0.08)
SLOPING = Scene(seed=7, angle=34.0, bed="sloping", slope=6.0, towards=30.0)


def say(_: str) -> None:
    """Nothing."""


def test_scenes_are_one_stream_in_which_every_bed_and_tool_has_its_turn() -> None:
    six, more = list(islice(scenes(3), 6)), list(islice(scenes(3), 15))
    assert six == more[:6] and six != list(islice(scenes(4), 6))
    for begin in range(0, 15, 3):
        assert {s.bed for s in more[begin : begin + 3]} == set(BEDS)
    for begin in range(0, 15, 5):
        assert {(s.tool, s.width, s.tilt) for s in more[begin : begin + 5]} == set(TOOLS)
    assert all(ANGLES[0] <= s.angle <= ANGLES[1] for s in more)


def test_a_pair_differs_by_the_tools_friction_alone() -> None:
    smooth, rough = pair(3)
    assert (smooth.tool_friction, rough.tool_friction) == (0.3, 0.9)
    assert replace(rough, tool_friction=0.3) == smooth
    assert smooth.setup().tool.friction == 0.3


def test_a_sloping_bed_rises_as_steeply_and_where_it_says() -> None:
    surface = SLOPING.setup().surface
    down, across = np.gradient(surface.height, *surface.cell[::-1])
    rise = np.tan(np.radians(6.0))
    assert across == pytest.approx(rise * np.cos(np.radians(30.0)))
    assert down == pytest.approx(rise * np.sin(np.radians(30.0)))
    assert surface.height.mean() == pytest.approx(SOIL)


@pytest.mark.parametrize("seed", range(3))
def test_a_tool_starts_above_the_soil_and_sinks_in_as_deep_as_it_says(seed: int) -> None:
    for scene in islice(scenes(seed), 5):
        setup = scene.setup()
        surface, tool = setup.surface, setup.tool
        low, high = tool.bounds(0.0)
        x, y = (surface.points[..., k] for k in (0, 1))
        under = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
        assert under.any() and low[2] > surface.height[under].max() + 0.005
        begin, end = 25 / setup.frame_rate, 100 / setup.frame_rate
        way = (x >= 0.2) & (x <= 0.5) & (np.abs(y - 0.25) <= 0.5 * scene.width)
        depth = surface.height[way].mean() - tool.bounds(begin)[0][2]
        assert depth == pytest.approx(scene.depth, abs=1.5e-3)
        assert tool.bounds(begin)[0][2] == pytest.approx(tool.bounds(end)[0][2], abs=1e-3), "pushed level"
        assert tool.bounds(begin)[0][2] > setup.bed.lower[2] + 0.01
        assert tool.motion.positions[100] - tool.motion.positions[25] == pytest.approx([0.3, 0.0, 0.0])


def test_a_drum_that_rolls_stands_still_where_it_touches() -> None:
    """v + w x r at its lowest point, for turns of a wheel that doesn't slip, and of one that slips by a fifth."""
    for rolling, slip in ((1.0, 0.0), (0.8, 0.2)):
        tool = Scene(seed=1, angle=35.0, tool="drum", tilt=0.0, rolling=rolling).setup().tool
        velocity, spin = tool.motion.twist(1.0)
        at_rest = velocity + np.cross(spin, [0.0, 0.0, -RADIUS])
        assert at_rest == pytest.approx([slip * 0.2, 0.0, 0.0], abs=1e-9)
        assert tool.mesh.is_watertight
        assert tool.mesh.extents == pytest.approx([2 * RADIUS, 0.12, 2 * RADIUS])


def test_the_usual_scene_is_as_before() -> None:
    """The plate of `plow`, which neither turns nor starts elsewhere."""
    setup = plow(3)
    assert setup.tool.mesh.extents == pytest.approx([0.012, 0.12, 0.12])
    assert setup.tool.motion.positions[25] == pytest.approx([0.2, 0.25, 0.11])
    turn = [np.cos(np.radians(10.0)), 0.0, np.sin(np.radians(10.0)), 0.0]
    assert setup.tool.motion.quaternions == pytest.approx(np.tile(turn, (201, 1)))


def staged(measurement: Measurement, heading: np.ndarray) -> tuple[np.ndarray, dict[str, tuple[float, float]]]:
    """A force (199, 3) that is constant in each stage, but for a part across the way, and what it is along and up."""
    expected = {"lowering": (2.0, 60.0), "pushing": (-150.0, 70.0), "pause": (-40.0, 25.0), "withdrawal": (30.0, 5.0)}
    force = np.zeros((199, 3))
    across = np.array([-heading[1], heading[0]])
    rows = {
        "lowering": slice(0, 25),
        "pushing": slice(25, 100),
        "pause": slice(100, 125),
        "withdrawal": slice(125, 199),
    }
    for name, (along, up) in expected.items():
        force[rows[name], :2] = along * heading + 9.0 * across
        force[rows[name], 2] = up
    # a mean doesn't know of what comes and goes
    force[25:55] += 20.0
    force[55:85] -= 20.0
    return force, expected


def turned(measurement: Measurement) -> Measurement:
    """The same with its way along y."""
    motion = measurement.tool.motion
    places = motion.positions[:, [1, 0, 2]]
    tool = replace(measurement.tool, motion=ToolMotion(motion.frames, motion.times, places, motion.quaternions))
    return replace(measurement, tool=tool)


@pytest.mark.parametrize("heading", [(1.0, 0.0), (0.0, 1.0)])
def test_forces_are_told_by_stage_along_the_way_and_upwards(heading: tuple[float, float]) -> None:
    measurement = SLOPING.setup().experiment()
    measurement = turned(measurement) if heading[1] else measurement
    force, expected = staged(measurement, np.array(heading))
    found = stage_forces(measurement, force)
    assert list(found) == list(expected)
    for name, parts in expected.items():
        assert found[name] == pytest.approx(parts, abs=1e-9)


def test_a_ratio_is_told_of_what_counts() -> None:
    measurement = SLOPING.setup().experiment()
    theirs, expected = staged(measurement, np.array([1.0, 0.0]))
    found = compare_forces(measurement, 1.1 * theirs, theirs)
    assert found["pushing"]["ratio"] == pytest.approx([1.1, 1.1])
    assert found["pushing"]["off"] == pytest.approx(0.1)
    assert found["lowering"]["ratio"] == [None, pytest.approx(1.1)], "2 of 60 N is nothing to divide by"
    assert found["lowering"]["newton"] == pytest.approx(expected["lowering"])
    weaker = theirs.copy()
    weaker[100:125] = 0.0
    assert compare_forces(measurement, weaker, theirs)["pause"]["off"] == pytest.approx(1.0)
    assert compare_forces(measurement, weaker, theirs)["pushing"]["off"] == pytest.approx(0.0)


def test_patches_keep_what_is_wide_and_drop_what_is_narrow() -> None:
    """A blur of s cells leaves exp(-(2 pi s / length)^2 / 2) of a wave."""
    assert in_patches(np.full((4, 50, 80), 2e-3)) == pytest.approx(2e-3)
    x = np.arange(80.0)
    for length in (40.0, 16.0):
        wave = 1e-3 * np.cos(2.0 * np.pi * (x + 0.5) / length) * np.ones((2, 50, 1))
        left = np.exp(-0.5 * (2.0 * np.pi * 1.5 / length) ** 2)
        assert in_patches(wave) == pytest.approx(1e-3 * left / np.sqrt(2.0), rel=0.01)
    assert in_patches(2e-3 * (-1.0) ** x * np.ones((2, 50, 1))) < 0.1e-3


def test_soil_cut_and_heaped_is_told_apart_and_without_what_settles() -> None:
    """A trench of 20 x 12 cm and 5 cm deep, a heap of half its soil beside it; a millimetre everywhere is settling."""
    before = np.full((50, 80), 0.12)
    after = np.repeat(before[None], 2, axis=0)
    after[1, 10:22, 20:40] -= 0.05
    after[1, 30:42, 20:40] += 0.025
    (nothing, none), (cut, heaped) = cut_and_heaped(before, after)
    assert (nothing, none) == (0.0, 0.0)
    assert cut == pytest.approx(20 * 12 * 5, rel=0.02)
    assert heaped == pytest.approx(20 * 12 * 2.5, rel=0.03)
    assert cut_and_heaped(before, after[:1] - 1e-3)[0] == pytest.approx([0.0, 0.0])
    noisy = after[:1] + 1e-3 * np.random.default_rng(0).standard_normal((1, 50, 80))
    assert cut_and_heaped(before, noisy).max() < 5.0


@pytest.mark.parametrize(
    ("raised", "stronger", "converged"), [(0.5e-3, 1.03, True), (2e-3, 1.0, False), (0.0, 1.08, False)]
)
def test_what_a_refinement_moves_too_far_has_not_converged(raised: float, stronger: float, converged: bool) -> None:
    measurement = SLOPING.setup().experiment()
    force, _ = staged(measurement, np.array([1.0, 0.0]))
    heights = np.full((4, 50, 80), 0.12)
    found = moved(measurement, (heights + raised, stronger * force), (heights, force))
    assert found["heights_mm"] == pytest.approx(1e3 * raised)
    assert found["stages"]["pushing"]["off"] == pytest.approx(stronger - 1.0)
    assert found["converged"] is converged


def still(world: World) -> Run:
    """Soil that nothing moves, and a force that grows."""
    return Run(dict.fromkeys(FRAMES, world.particles), np.outer(np.arange(1.0, 200.0), [-1.0, 0.0, 0.5]))


@pytest.fixture
def groups(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Names of the worlds that were ploughed together; nothing moves in them."""
    found: list[list[str]] = []

    def plough(worlds: Sequence[World], *_: Any, **__: Any) -> list[Run]:
        found.append([world.label for world in worlds])
        return [still(world) for world in worlds]

    monkeypatch.setattr(solvers, "plough", plough)
    monkeypatch.setattr(solvers, "load_newton", lambda: SimpleNamespace(__version__="0"))
    return found


def test_only_missing_worlds_are_ploughed_so_many_at_a_time(groups: list[list[str]], tmp_path: Path) -> None:
    cases = [Case.drawn(f"scene-{k}", scene, COARSE) for k, scene in enumerate(islice(scenes(1), 5))]
    plough_missing(cases[:1], tmp_path, "cpu", 4, say)
    plough_missing(cases, tmp_path, "cpu", 3, say)
    plough_missing(cases, tmp_path, "cpu", 3, say)
    assert groups == [["scene-0"], ["scene-1", "scene-2", "scene-3"], ["scene-4"]]


def test_a_kept_world_is_the_one_that_was_ploughed(groups: list[list[str]], tmp_path: Path) -> None:
    case = Case.drawn("scene", SLOPING, COARSE)
    plough_missing([case], tmp_path, "cpu", 1, say)
    world = case.world()
    kept = Kept.load(tmp_path / "scene.npz", told(case))
    assert sorted(kept.particles) == [0, *FRAMES]
    for x in kept.particles.values():
        assert np.abs(x - world.particles).max() <= 0.5 * solvers.SCALE + 1e-9
    assert kept.force == pytest.approx(still(world).force)
    assert kept.spacing == pytest.approx(0.04)


def test_another_scene_or_other_numerics_are_not_taken_for_it(groups: list[list[str]], tmp_path: Path) -> None:
    plough_missing([Case.drawn("scene", SLOPING, COARSE)], tmp_path, "cpu", 1, say)
    steeper = Case.drawn("scene", replace(SLOPING, slope=6.5), COARSE)
    with pytest.raises(ParameterError, match="another --out"):
        plough_missing([steeper], tmp_path, "cpu", 1, say)
    for change in ({"iterations": 99}, {"tolerance": 1.0e-4}):
        with pytest.raises(ParameterError, match="another --out"):
            Kept.load(tmp_path / "scene.npz", told(Case.drawn("scene", SLOPING, replace(COARSE, **change))))


def test_a_refined_world_is_kept_beside_as_heights(groups: list[list[str]], tmp_path: Path) -> None:
    case = Case.drawn("scene", SLOPING, Numerics(voxel=0.03))
    plough_missing([case], tmp_path, "cpu", 1, say)
    plough_missing([case.finer()], tmp_path, "cpu", 1, say, fine=True)
    with np.load(tmp_path / "scene.fine.npz") as stored:
        assert set(stored.files) == {"heights", "force", "about"}
        assert stored["heights"].shape == (4, 50, 80)
        assert float(stored["heights"].mean()) == pytest.approx(SOIL, rel=0.01)
    kept = Kept.load(tmp_path / "scene.npz", told(case))
    found = solvers.refinement(case, kept, tmp_path)
    assert found is not None and found["converged"], "nothing moves"


def test_one_world_of_each_kind_is_ploughed_with_finer_voxels(groups: list[list[str]], tmp_path: Path) -> None:
    """Six scenes take five tools in turns, so the sixth is of a tool that was checked."""
    words = ["--voxel", "0.08", "--worlds-only", "--side-by-side", "6", "--out", str(tmp_path), "--refine"]
    assert main(words) == 0 and main(words) == 0
    assert groups == [[f"scene-1-{k}" for k in range(6)], [f"scene-1-{k}" for k in range(5)]]
    assert main([*words, "scene-1-5"]) == 0
    assert groups[2:] == [["scene-1-5"]]


def test_a_narrower_tool_gets_as_many_voxels_and_is_ploughed_by_itself(
    groups: list[list[str]], plow_dry: Path, tmp_path: Path
) -> None:
    narrow = tmp_path / "narrow"
    shutil.copytree(plow_dry, narrow)
    mesh = Measurement.load(plow_dry).tool.mesh.copy()
    mesh.apply_scale([1.0, 0.5, 1.0])
    mesh.export(narrow / Measurement.load(plow_dry).tool.mesh_path.name)
    usual, case = (Case.of_set(folder, Numerics()) for folder in (plow_dry, narrow))
    assert usual.numerics == Numerics() and usual.made is not None
    assert case.made is None, "the set's own voxels are too coarse for it"
    assert case.numerics.voxel == pytest.approx(0.06 / 9.0)
    assert (case.numerics.substeps, case.numerics.iterations) == (6, 3000)
    coarse = replace(case, numerics=COARSE.across(0.06))
    scene = Case.drawn("scene", SLOPING, COARSE)
    plough_missing([scene, coarse, replace(scene, name="other")], tmp_path / "out", "cpu", 4, say)
    assert groups == [["scene", "other"], [case.name]]


@pytest.fixture(scope="module")
def ours() -> tuple[Case, Kept]:
    """A world of our own coarsest solver, of other particles than a judge begins with."""
    scene = Scene(seed=7, angle=36.0)
    case, setup = Case.drawn("wavy", scene, Numerics()), scene.setup()
    resolution = Resolution.derive(case.measurement, "tiny")
    x = fill(setup.surface, setup.bed, resolution.spacing, seed=77)
    run = simulate(case.measurement, x, case.values, resolution=resolution, frames=FRAMES)[0]
    particles = {f: p.astype(np.float64) for f, p in zip((0, *FRAMES), (x, *run.positions), strict=True)}
    return case, Kept(particles, resolution.spacing, run.force)


def test_a_world_of_our_own_is_told_to_be_one(ours: tuple[Case, Kept]) -> None:
    """By other particles, whose chance is large with so few; a truth that is told too low by 6 degrees is found out."""
    case, kept = ours
    found = judge(case, kept, "tiny", (-6.0, 6.0), (0, 1), "cpu")
    assert found["best_angle"] == pytest.approx(36.0, abs=3.0)
    assert found["heights_mm"] < 1.3 * found["chance_mm"]
    assert found["stages"]["pushing"]["off"] < 0.1
    for own, other in zip(found["cut_and_heaped_cm3"][1], found["newton_cut_and_heaped_cm3"][1], strict=True):
        assert own == pytest.approx(other, rel=0.15) and 200.0 < other < 5000.0
    low = judge(replace(case, values={"friction_angle": 30.0}), kept, "tiny", (6.0, 12.0), (0,), "cpu")
    assert low["best_angle"] > 33.0
    assert low["stages"]["pushing"]["off"] > 0.1


def test_kept_worlds_are_judged_without_the_package(
    ours: tuple[Case, Kept], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "newton", None)
    case = Case.drawn("scene-1-0", next(scenes(1)), Numerics())
    ours[1].save(tmp_path / "scene-1-0.npz", told(case))
    words = ["--presets", "tiny", "--seeds", "1", "--offsets", "-3", "3", "--no-plough", "--out", str(tmp_path)]
    assert main(["--count", "1", *words]) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    entry = result["worlds"]["scene-1-0"]
    assert entry["scene"] == asdict(next(scenes(1)))
    assert entry["presets"]["tiny"]["angles"] == pytest.approx([case.angle + o for o in (-3.0, 0.0, 3.0)])
    assert main(["--count", "2", *words]) == 1, "one of two is there"
    assert "Not judged: scene-1-1." in capsys.readouterr().out


def test_a_set_that_these_numerics_made_needs_no_ploughing(
    plow_dry: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "newton", None)
    words = ["--sets", str(plow_dry), "--presets", "tiny", "--seeds", "1", "--offsets", "--out"]
    assert main([*words, str(tmp_path)]) == 0
    stages = json.loads((tmp_path / "result.json").read_text())["worlds"]["plow-dry"]["presets"]["tiny"]["stages"]
    force = np.loadtxt(plow_dry / "tool_force.csv", delimiter=",", skiprows=1)
    pushing = force[(force[:, 0] > 25) & (force[:, 0] <= 100)]
    assert stages["pushing"]["newton"] == pytest.approx(pushing[:, [2, 4]].mean(axis=0))


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["--voxel", "0"], "--voxel"),
        (["--only", "scene-9-9"], "scene-9-9"),
        (["--count", "0"], "no world"),
    ],
)
def test_what_cannot_be_asked_for_is_refused(words: list[str], match: str, tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=match):
        main([*words, "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()
