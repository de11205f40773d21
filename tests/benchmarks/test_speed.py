"""``splatsoil benchmark speed``: its table and page, parts that can't run, and the yardstick in Taichi. No times."""

from __future__ import annotations

import json
import math
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from splatsoil.benchmarks import speed
from splatsoil.benchmarks._speed import (
    against_newton,
    against_taichi,
    clock,
    kernels,
    machine,
    mpm,
    page,
    pictures,
    scenes,
    whole,
)
from splatsoil.benchmarks._speed.rows import Group, Row, Sample, judged, missing, number, table, told

from splatsoil.cli import main as command_line
from splatsoil.errors import RunError, SimulationError
from splatsoil.measurement import Camera
from splatsoil.soil.matching import cone_slope
from splatsoil.splats import Gaussians, rasterise

FAST = Sample((2.0, 1.0, 4.0))


@pytest.fixture(scope="module")
def tiny(plow_dry: Path) -> scenes.Plough:
    """The example with few particles."""
    return scenes.plough(plow_dry, "tiny")


def test_a_sample_tells_its_middle_and_half_its_range() -> None:
    assert (FAST.median, FAST.spread) == (2.0, 1.5)
    assert told(FAST, "s") == "2.00 ± 1.50 s"
    assert told(Sample((0.01234,), "alone"), "ms") == "0.0123 ms (alone)", "one repetition has no spread"
    assert FAST.inverted(8.0).values == (4.0, 8.0, 2.0)
    assert [number(v) for v in (0.0, 0.5, 12.345, 678.9, 12345.6)] == ["0", "0.500", "12.3", "679", "12346"]


def test_a_ratio_says_how_many_times_as_fast_ours_is() -> None:
    slow = Sample((10.0,))
    assert Row("time", "s", FAST, slow).ratio == 5.0
    assert Row("rate", "it/s", slow, FAST, "more").ratio == 5.0
    assert Row("alone", "s", FAST).ratio is None


def test_a_target_missed_on_cores_that_others_used_is_not_judged() -> None:
    assert judged(Sample((9.0,), cores=2.0), 10.0, "more", 2) is False
    assert judged(Sample((9.0,), cores=1.2), 10.0, "more", 2) is None
    assert judged(Sample((11.0,), cores=1.2), 10.0, "more", 2) is True, "reached although disturbed"
    assert judged(Sample((9.0,)), 10.0, "less") is True


def test_the_table_has_a_line_for_every_row_and_says_what_was_not_measured() -> None:
    rows = [
        Row("a", "s", FAST, Sample((8.0,)), target="≥ 3 times", met=True),
        Row("b", "s", FAST, target="≤ 1 s", met=False),
        missing("c", "there is no such thing", "≥ 2"),
    ]
    lines = table(rows).splitlines()
    assert len(lines) == 2 + len(rows)
    assert {line.count("|") for line in lines} == {7}
    assert "4.00 ×" in lines[2] and lines[2].endswith("| met |")
    assert lines[3].endswith("| **not met** |")
    assert "not measured: there is no such thing" in lines[4] and lines[4].endswith("| – |")


def test_a_group_comes_back_from_json() -> None:
    group = Group("title", (Row("a", "s", FAST, Sample((8.0,), "x", 1.5), "less", "t", True, "n"),), ("note",))
    assert Group.restored(json.loads(json.dumps(group.data()))) == group
    assert group.data()["rows"][0]["ratio"] == 4.0


def test_tasks_side_by_side_all_run_and_a_failure_is_told() -> None:
    seen: list[int] = []
    seconds, cores = clock.together([lambda k=k: seen.append(k) for k in range(2)])  # type: ignore[misc]
    assert sorted(seen) == [0, 1] and seconds >= 0.0 and cores >= 0.0

    def fail() -> None:
        raise SimulationError("broken")

    with pytest.raises(SimulationError, match="broken"):
        clock.together([fail, lambda: None])


def test_sections_are_replaced_and_everything_else_stays() -> None:
    text = page.fresh() + "\n## Reading\n\nBy hand.\n"
    both = page.replaced(page.replaced(text, "cpu", "fast"), "cuda", "faster")
    again = page.replaced(both, "cpu", "slow \\1")
    assert "slow \\1" in again and "fast\n" not in again and "faster" in again
    assert again.endswith("By hand.\n") and page.EMPTY not in again
    assert page.replaced(again, "cpu", "fast") == both


def test_a_file_that_is_no_page_is_left_alone(tmp_path: Path) -> None:
    other = tmp_path / "README.md"
    other.write_text("# Mine\n")
    with pytest.raises(RunError, match="no page of this benchmark"):
        page.current(other)
    assert speed_exit("--page", str(other)) == 2
    assert other.read_text() == "# Mine\n"


def speed_exit(*words: str) -> int:
    """Exit code of the command, as the shell sees it."""
    return command_line(["benchmark", "speed", *words])


@pytest.mark.parametrize(
    ("words", "told_of"),
    [
        (("--only", "nonsense"), "'nonsense' is not among solver, taichi, newton"),
        (("--device", "abacus"), "'abacus'"),
        (("--set", "nowhere"), "nowhere"),
        (("--repeats", "0"), "1 or more"),
        (("--preset", "enormous"), "enormous"),
    ],
)
def test_bad_names_are_one_line_and_code_2(
    words: tuple[str, ...], told_of: str, plow_dry: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = () if "--set" in words else ("--set", str(plow_dry))
    assert speed_exit(*known, "--out", str(tmp_path / "out"), *words) == 2
    shown = capsys.readouterr()
    assert told_of in shown.err.splitlines()[-1] and "Traceback" not in shown.err
    assert not (tmp_path / "out").exists(), "nothing is written before all is found good"


def test_parts_that_cannot_run_do_not_stop_the_others(
    plow_dry: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def lacking() -> Any:
        raise RunError("the package newton is missing")

    monkeypatch.setattr(against_newton, "load_newton", lacking)
    monkeypatch.setattr(against_taichi, "installed", lambda: False)
    file, out = tmp_path / "performance.md", tmp_path / "out"
    words = ["--set", str(plow_dry), "--preset", "tiny", "--repeats", "1", "--out", str(out), "--page", str(file)]
    names = ["solver", "taichi", "newton", "kernels"]
    assert speed_exit(*words, "--json", "--only", *names) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["ok"] and list(result["parts"]) == names
    rows = {name: part["group"]["rows"] for name, part in result["parts"].items()}
    for name in ("taichi", "newton"):
        assert f"{name} is missing" in rows[name][0]["note"] and rows[name][0]["met"] is None
    assert rows["solver"][0]["ours"]["median"] > 0.0
    shares = {row["what"].split("`")[1]: row["ours"]["median"] for row in rows["kernels"] if row["what"][0] == "`"}
    assert {"stress_forces", "move_nodes", "particles_to_grid", "grid_to_particles"} <= set(shares)
    assert all(0.0 < share < 100.0 for share in shares.values()) and sum(shares.values()) < 101.0

    written = file.read_text()
    assert "newton is missing" in written and page.EMPTY in written.split("## GPU")[1]
    assert "same bits" in written, "two runs side by side compute what one does"
    # drawn again from what is kept, with what was written beside it
    file.write_text(written.replace("### Solver: plow-dry", "### gone") + "\nBy hand.\n")
    assert speed_exit(*words, "--render") == 0
    assert file.read_text() == written + "\nBy hand.\n"


def test_a_fault_is_told_and_the_other_parts_go_on(
    plow_dry: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: Any) -> Any:
        raise ZeroDivisionError("by nothing")

    monkeypatch.setattr(mpm, "cpu", broken)
    monkeypatch.setattr(pictures, "rasteriser", lambda repeats: Group("Rasteriser", (Row("x", "ms", FAST),)))
    words = ["--set", str(plow_dry), "--preset", "tiny", "--out", str(tmp_path), "--only", "solver", "rasteriser"]
    assert speed_exit(*words) == 1
    shown = capsys.readouterr()
    assert "ZeroDivisionError: by nothing" in shown.out and "2.00 ± 1.50 ms" in shown.out


def test_what_another_machine_measured_is_not_put_on_the_page(tmp_path: Path) -> None:
    here = machine.describe("cpu")
    assert machine.same(here, {**here, "made": "earlier", "load": "7"})
    assert not machine.same(here, {**here, "processor": "abacus"})
    with pytest.raises(RunError, match="nothing that this code measured"):
        speed.write_page(tmp_path / "page.md", "cpu", tmp_path, ["solver"], here)


def test_the_rasteriser_draws_what_the_reference_draws() -> None:
    group = pictures.rasteriser(1, count=500, size=32)
    forward = group.rows[0]
    assert forward.ours is not None and forward.ratio is not None and forward.ratio > 1.0
    assert float(forward.note.split("by ")[1].split()[0]) < 1e-5
    assert len(pictures.against_gsplat("cpu", 1, ((200, 32),)).rows) >= 2, "also where gsplat is missing"


def test_finer_scenes_have_the_particles_asked_for_and_tell_their_memory(tiny: scenes.Plough) -> None:
    finer = tiny.refined(20_000)
    assert len(finer.x) == pytest.approx(20_000, rel=0.05)
    assert finer.resolution.spacing == pytest.approx(0.5 * finer.resolution.cell)
    group = mpm.large(tiny, "cpu", 1, counts=(4_000, 8_000), steps=1)
    assert len(group.rows) == 3 and all(row.ours is not None for row in group.rows)
    own, whole = mpm.held_bytes(tiny.solver("cpu"))
    # 16 vectors and matrices' worth: position to drift, counted by hand in splatsoil/mpm/state.py
    assert 200.0 < own < 260.0 < whole


def test_a_batch_on_the_device_is_the_runs_one_by_one(tiny: scenes.Plough) -> None:
    short = scenes.replace(tiny, last=3)
    together = short.run(batch=2)
    assert np.array_equal(together[0].positions, short.run()[0].positions)
    group = mpm.gpu(short, "cpu", 1, short)
    assert [row.ours is not None for row in group.rows] == [True] * 3


def test_the_yardstick_gets_the_same_scene(tiny: scenes.Plough) -> None:
    given = scenes.explicit(tiny, 0.5)
    r, motion = tiny.resolution, tiny.measurement.tool.motion
    assert given["step"] * given["frame_steps"] == pytest.approx(r.frame_time)
    assert given["step"] * r.wave_speed <= 0.5 * r.cell * (1.0 + 1e-6)
    assert given["frame_steps"] == r.steps * r.substeps(r.steps), "at the same Courant number, as many steps as ours"
    assert len(given["poses"]) == tiny.last
    for frame in (0, 40, 150):
        place, turn, velocity = np.split(given["poses"][frame], [3, 12])
        rotation, position = motion.pose(frame * r.frame_time)
        assert place == pytest.approx(position) and turn.reshape(3, 3) == pytest.approx(rotation)
        following = motion.pose((frame + 1) * r.frame_time)[1]
        assert place + velocity * r.frame_time == pytest.approx(following)
    deepest = int(np.argmin(tiny.x[:, 2]))
    weight = 9.81 * r.density * (tiny.x[:, 2].max() - tiny.x[deepest, 2])
    assert -given["elastic"][deepest] * r.bulk == pytest.approx(weight, rel=0.3), "both start from the weight above"


def test_heights_of_the_truth_itself_are_not_off(tiny: scenes.Plough) -> None:
    truth = tiny.truth
    assert truth is not None
    fine = scenes.replace(tiny, resolution=scenes.replace(tiny.resolution, spacing=truth.volume ** (1.0 / 3.0)))
    assert scenes.height_error(fine, {50: truth.particles[50]}) == pytest.approx(0.0, abs=1e-6)
    lifted = scenes.height_error(fine, {50: truth.particles[50] + np.array([0.0, 0.0, 2e-3])})
    assert lifted == pytest.approx(2.0, abs=0.2)
    assert scenes.height_error(fine, {7: truth.particles[50]}) is None, "there is no truth at that frame"


def test_gsplat_is_given_the_same_gaussians_and_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, Any]] = []

    def rasterization(
        means: torch.Tensor, quats: torch.Tensor, scales: torch.Tensor, opacities: torch.Tensor, colors: torch.Tensor,
        viewmats: torch.Tensor, Ks: torch.Tensor, width: int, height: int, **more: Any,
    ) -> tuple[torch.Tensor]:  # fmt: skip
        # a gsplat that draws with our rasteriser what it is told, from the camera it is told
        back = np.linalg.inv(viewmats[0].numpy().astype(float)) @ np.diag([1.0, -1.0, -1.0, 1.0])
        (fx, _, cx), (_, fy, cy), _ = Ks[0].tolist()
        camera = Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, camera_to_world=back)
        drawn = rasterise(Gaussians(means, scales, quats, opacities, colors), camera, normals=False)
        asked.append(more)
        return (torch.cat([drawn.colour, drawn.depth[..., None]], dim=2)[None],)

    fake = types.SimpleNamespace(rasterization=rasterization, __version__="1.0")
    monkeypatch.setattr(pictures, "load_gsplat", lambda: fake)
    group = pictures.against_gsplat("cpu", 1, ((300, 32),))
    assert asked and asked[0]["render_mode"] == "RGB+ED"
    difference, *times = group.rows
    assert difference.ours is not None and difference.ours.median < 1e-5 and difference.met
    assert len(times) == 2
    for row in times:
        assert row.other is not None and row.other.label == "gsplat 1.0" and row.ratio is not None
        assert row.met == (row.ratio >= 1.0 / pictures.GSPLAT)

    def failing(*_: Any, **__: Any) -> Any:
        raise ValueError("no compiler")

    monkeypatch.setattr(pictures, "load_gsplat", lambda: types.SimpleNamespace(rasterization=failing))
    rows = pictures.against_gsplat("cpu", 1, ((300, 32),)).rows
    assert all("no compiler" in row.note and row.met is None and row.ours is not None for row in rows)


@pytest.mark.parametrize(("seconds", "psnr", "met"), [(10.0, 34.6, True), (30.0, 34.6, False), (10.0, 33.0, False)])
def test_training_on_a_gpu_must_be_fast_and_as_good_as_the_cpus(
    seconds: float, psnr: float, met: bool, plow_dry: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def trained(measurement: Any, preset: str, device: str, seed: int = 0) -> Any:
        found = types.SimpleNamespace(psnr=34.63 if device == "cpu" else psnr)
        return found, 40.0 if device == "cpu" else seconds, Sample((20.0,))

    monkeypatch.setattr(pictures, "trained", trained)
    rows = pictures.training(plow_dry, "small", "cuda:0").rows
    assert rows[1].met is met and rows[1].ratio == 40.0 / seconds
    assert f"{psnr:.2f} dB" in rows[1].note and "34.63 dB by the CPU" in rows[1].note


def test_a_diagnosis_goes_on_from_the_inversions_run(
    plow_dry: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fits: list[Any] = []
    diagnoses: list[Any] = []

    def fitted(config: Any) -> int:
        fits.append(config)
        config.run.mkdir(parents=True)
        print("a table")
        return 0

    monkeypatch.setattr(whole.fit, "run", fitted)
    monkeypatch.setattr(whole.diagnose, "run", lambda config: diagnoses.append(config) or 0)
    inverted = whole.inversion(plow_dry, "small", "cpu", tmp_path)
    assert [(c.preset, c.budget) for c in fits] == [("tiny", 2), ("small", whole.EVALUATIONS)]
    assert inverted.rows[0].met is True
    whole.diagnosis(plow_dry, "small", "cpu", tmp_path)
    assert len(fits) == 2 and diagnoses[0].run == fits[1].run and len(diagnoses[0].effects) == whole.EFFECTS
    whole.diagnosis(plow_dry, "small", "cpu", tmp_path / "elsewhere")
    assert len(fits) == 3, "without an inversion it makes a fit of its own"
    assert capsys.readouterr().out == ""


def test_kernels_are_known_by_our_names() -> None:
    assert kernels.known("forward kernel stress_forces_1a2b") == "stress_forces"
    assert kernels.known("memset") == "memset"


def sand(positions: np.ndarray, upper: tuple[float, ...], cell: float, angle: float) -> dict[str, Any]:
    """A scene without a tool for the program in Taichi: frames of 0.02 s, a stiffness of 0.2 MPa."""
    density, young, poisson = 1600.0, 2.0e5, 0.3
    bulk, shear = young / (3.0 - 6.0 * poisson), young / (2.0 + 2.0 * poisson)
    speed_of_waves = math.sqrt((bulk + 4.0 * shear / 3.0) / density)
    steps = math.ceil(0.02 * speed_of_waves / (against_taichi.COURANT * cell))
    return {
        "positions": positions,
        "lower": np.zeros(3),
        "upper": np.array(upper),
        "cell": np.full(3, cell),
        "step": 0.02 / steps,
        "spacing": 0.5 * cell,
        "density": density,
        "bulk": bulk,
        "shear": shear,
        "slope": cone_slope(angle),
        "gravity": [0.0, 0.0, -9.81],
        "elastic": np.zeros(len(positions)),
        "floor_friction": 0.6,
        "wall_friction": 0.0,
        "tool_friction": 0.0,
        "tool": np.zeros(3),
        "poses": np.zeros((1, 15)),
        "frame_steps": steps,
    }


def block(lower: tuple[float, ...], upper: tuple[float, ...], spacing: float) -> np.ndarray:
    """A lattice of particles."""
    axes = [np.arange(a + 0.5 * spacing, b, spacing) for a, b in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


@pytest.mark.parametrize(("threads", "atomic"), [(2, False), (1, True)])
def test_falling_sand_in_taichi_keeps_mass_and_gains_its_weights_momentum(threads: int, atomic: bool) -> None:
    pytest.importorskip("taichi")
    x = block((0.1, 0.1, 0.12), (0.2, 0.18, 0.2), 0.01)
    run = against_taichi.run(sand(x, (0.3, 0.3, 0.3), 0.02, 30.0), 3, threads, atomic)
    mass = 1600.0 * len(x) * 0.01**3
    assert run.state["mass"] == pytest.approx(mass)
    assert run.state["grid_mass"] == pytest.approx(mass, rel=1e-5)
    gained = np.array([0.0, 0.0, -9.81 * mass * 0.06])
    assert run.state["momentum"] == pytest.approx(gained, abs=1e-3 * abs(gained[2]))
    fallen = 0.5 * 9.81 * 0.06**2
    assert (x - run.positions[3])[:, 2] == pytest.approx(np.full(len(x), fallen), rel=0.05)


def test_a_column_in_taichi_collapses_to_a_heap_and_stronger_sand_to_a_steeper_one() -> None:
    pytest.importorskip("taichi")
    runout = {}
    for angle in (20.0, 40.0):
        scene = sand(block((0.0, 0.0, 0.0), (0.1, 0.03, 0.1), 0.005), (0.4, 0.03, 0.15), 0.01, angle)
        heap = against_taichi.run(scene, 30).positions[30]
        front = float(np.quantile(heap[:, 0], 0.99))
        top = float(np.quantile(heap[heap[:, 0] < 0.02, 2], 0.99))
        runout[angle] = (front - 0.1) / 0.1
        slope = math.degrees(math.atan2(top, front))
        assert top < 0.1 and 5.0 < slope < angle + 5.0
    # planar columns as high as long run out by about 1.2 lengths in laboratories (Lube et al. 2005)
    assert 0.3 < runout[40.0] < runout[20.0] < 2.5
