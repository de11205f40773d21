"""Our solver beside an independent one and beside itself: scenes, what is kept of them, how they are compared."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from splatsoil.benchmarks import solvers
from splatsoil.benchmarks._common import Clock
from splatsoil.benchmarks._scenes import ANGLES, BEDS, RADIUS, TOOLS, Scene, scenes
from splatsoil.benchmarks._truth import Truth, in_patches
from splatsoil.benchmarks.solvers import Scan, agreement, compare_stages, main

from splatsoil.errors import ParameterError
from splatsoil.mpm import Resolution, Trajectory, simulate
from splatsoil.reconstruction import fill

SLOPING = Scene(seed=7, angle=34.0, bed="sloping", slope=6.0, towards=30.0)


def test_scenes_are_one_stream_in_which_every_bed_and_tool_has_its_turn() -> None:
    six, more = list(islice(scenes(3), 6)), list(islice(scenes(3), 15))
    assert six == more[:6] and six != list(islice(scenes(4), 6))
    for begin in range(0, 15, 3):
        assert {s.bed for s in more[begin : begin + 3]} == set(BEDS)
    for begin in range(0, 15, 5):
        assert {(s.tool, s.width, s.tilt) for s in more[begin : begin + 5]} == set(TOOLS)
    assert all(ANGLES[0] <= s.angle <= ANGLES[1] for s in more)


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


def test_soil_between_two_angles_is_estimated_between_them() -> None:
    # a ridge that grows with the angle by 1 mm a degree
    ridge = 1e-3 * np.exp(-((np.arange(40) - 20.0) ** 2) / 50.0) * np.ones((1, 30, 1))
    angles = np.array([27.0, 30.0, 33.0, 36.0, 39.0])
    found = Scan(
        Truth(SLOPING.setup().experiment(), {}, 0.0, {}, ()),
        angles,
        0.0 * ridge[0],
        angles[:, None, None, None] * ridge,
        np.zeros((5, 9, 3)),
    )
    assert found.best(34.3 * ridge) == (pytest.approx(34.3, abs=0.01), pytest.approx(0.0, abs=1e-6))
    angle, left = found.best(34.3 * ridge + 2e-3)
    assert angle > 36.0 and left > 1e-3


def test_stages_are_compared_by_the_size_of_the_others_force() -> None:
    truth = Truth(SLOPING.setup().experiment(), {}, 0.0, {}, ())
    theirs = np.tile([-3.0, 0.0, 4.0], (199, 1))
    ours = theirs.copy()
    ours[25:100] = [-3.5, 7.0, 4.0]  # across the way nothing is compared
    found = compare_stages(truth, ours, theirs)
    assert found["pushing"] == {"ours": (-3.5, 4.0), "other": (-3.0, 4.0), "off": pytest.approx(0.1)}
    assert found["lowering"]["off"] == pytest.approx(0.0)


@pytest.fixture(scope="module")
def ours() -> Truth:
    """A run of our own coarsest solver, of other particles than a scan begins with."""
    setup = Scene(seed=7, angle=36.0).setup()
    measurement, values = setup.experiment(), {"friction_angle": 36.0}
    resolution = Resolution.derive(measurement, "tiny")
    x = fill(setup.surface, setup.bed, resolution.spacing, seed=77)
    frames = (50, 100)
    run = simulate(measurement, x, values, resolution=resolution, frames=frames)[0]
    particles = {f: p.astype(np.float64) for f, p in zip((0, *frames), (x, *run.positions), strict=True)}
    return Truth(measurement, particles, resolution.spacing**3, values, (), run.force)


def test_our_own_run_is_found_to_be_one(ours: Truth) -> None:
    """By other particles, whose scatter is large with so few; an angle stated 6 degrees too low is found out."""
    tiny = Resolution.derive(ours.measurement, "tiny")
    found = agreement(Scan.simulated(ours, range(6), "cpu", tiny, (-6.0, 6.0)))
    one, other = (Scan.simulated(ours, [seed], "cpu", tiny).heights[0] for seed in (0, 1))
    assert found["best_angle"] == pytest.approx(36.0, abs=3.0)
    assert found["heights_mm"] < 1e3 * in_patches(one - other), "six seeds are nearer than one is to another"
    assert found["stages"]["pushing"]["off"] < 0.1
    for own, other in zip(found["cut_and_heaped_cm3"], found["their_cut_and_heaped_cm3"], strict=True):
        assert own == pytest.approx(other, rel=0.15) and 200.0 < other < 5000.0
    wrong = replace(ours, values={"friction_angle": 30.0})
    low = agreement(Scan.simulated(wrong, [0], "cpu", tiny, (6.0, 12.0)))
    assert low["best_angle"] > 33.0
    assert low["stages"]["pushing"]["off"] > 0.1


def test_what_newton_made_is_kept_and_another_scene_is_not_taken_for_it(
    ours: Truth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    positions = np.array(list(ours.particles.values()), dtype=np.float32)
    run = Trajectory(tuple(ours.particles), positions, np.zeros(0), ours.force, ours.spacing, None)  # type: ignore[arg-type]
    simulated: list[int] = []
    monkeypatch.setattr(solvers, "plough", lambda soils, *_: simulated.append(len(soils)) or [run] * len(soils))
    scene = Scene(seed=7, angle=36.0)
    for _ in range(2):
        (truth,) = solvers.ploughed({"one": scene}, tmp_path, "cpu", 4, Clock()).values()
    assert simulated == [1] and truth.frames == ours.frames and truth.values == ours.values
    assert truth.spacing == pytest.approx(ours.spacing) and np.array_equal(truth.force, ours.force)
    for frame, x in ours.particles.items():
        assert np.abs(truth.particles[frame] - x).max() < 2e-5
    with pytest.raises(ParameterError, match="another --out"):
        solvers.ploughed({"one": replace(scene, angle=30.0)}, tmp_path, "cpu", 4, Clock())


def test_a_change_of_nothing_shifts_nothing_and_each_change_is_of_one_thing(
    ours: Truth, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = Resolution.derive(ours.measurement, "tiny")
    for name, resolution in solvers.changed(base).items():
        apart = {k for k, v in vars(resolution).items() if v != getattr(base, k)}
        assert apart == ({"bulk", "shear"} if "Young" in name else apart) and len(apart) <= 2, name
    monkeypatch.setattr(solvers, "changed", lambda base: {"nothing": base})
    scan = partial(Scan.simulated, ours, [0], "cpu")
    (row,) = solvers.sensitivity(scan, base, scan(base, (-6.0, 6.0)))
    assert row == {"change": "nothing", "angle": 0.0, "force": 0.0}


def test_nothing_to_compare_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="nothing to compare"):
        main(["--count", "0", "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()
