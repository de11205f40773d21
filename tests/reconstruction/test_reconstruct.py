"""The whole path on a small ray-cast set: pictures, surface, segments, files, repeatability, command line."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatsoil.cli import main
from splatsoil.errors import MeasurementError, ParameterError, RunError, SetWarning
from splatsoil.measurement import Contents, Measurement, Picture, write_measurement
from splatsoil.reconstruction import HeightField, Reconstruction, reconstruct
from splatsoil.reconstruction.hidden import reaching_into_soil
from splatsoil.reconstruction.initial import SOIL, Seeds, discs
from splatsoil.reconstruction.likeness import Likeness, Pictures
from splatsoil.reconstruction.pipeline import judged
from splatsoil.reconstruction.surface import surface_through
from splatsoil.reconstruction.views import load_views
from splatsoil.splats import load_ply, rasterise

LENS = {"k1": -0.12, "k2": 0.02, "p1": 0.002, "p2": -0.001, "cx": 70.0, "cy": 44.0}


@pytest.fixture(scope="module")
def measurement(scene, tmp_path_factory) -> Measurement:
    """16 views through a lens that distorts and whose centre is off the image's."""
    cameras = scene.cameras(16, 128, 96, **LENS)
    pictures = [Picture(camera, scene.render(camera, seed=k)) for k, camera in enumerate(cameras)]
    video = [Picture(replace(cameras[0], name="left"), pictures[0].image, frame=0, time=0.0)]
    contents = Contents(name="waves", bed=scene.bed, tool=scene.tool(), frame_rate=50.0, views=pictures, video=video)
    return write_measurement(tmp_path_factory.mktemp("set") / "waves", contents, suffix=".png")


@pytest.fixture(scope="module")
def result(measurement) -> Reconstruction:
    return reconstruct(measurement, preset="tiny", seed=3)


def test_views_that_were_set_aside_are_predicted(measurement, result):
    assert [view.name for view in result.held_out] == [measurement.views[k].path.name for k in (0, 8)]
    assert result.psnr > 26.0
    assert result.ssim > 0.85
    # Drawn again from what is public, at the camera free of distortion.
    frame = measurement.views[8]
    seen = rasterise(result.gaussians, frame.camera.undistorted(), background=result.background, antialias=True)
    drawn = seen.colour.clamp(0, 1)
    valid = frame.undistorted_mask()
    error = (drawn.numpy() - frame.undistorted_image())[valid]
    assert -10 * np.log10((error**2).mean()) == pytest.approx(result.held_out[1].psnr, abs=1e-3)


def test_the_surface_is_metric_and_without_bias(scene, result):
    exact = scene.surface(result.surface)
    assert result.surface.rmse(exact) < 2.5e-3
    assert abs(result.surface.bias(exact)) < 0.7e-3


def test_gaussians_are_told_apart(scene, measurement, result):
    place = result.gaussians.means.numpy()
    colour = result.gaussians.colours.numpy()
    assert not (result.soil & result.tool).any()
    soil = place[result.soil.numpy()]
    assert np.all((soil[:, :2] > scene.bed.lower[:2]) & (soil[:, :2] < scene.bed.upper[:2]))
    away = np.abs(soil[:, 2] - scene.height(soil[:, 0], soil[:, 1]))
    assert np.median(away) < 2e-3
    assert result.soil.sum() > 1000
    tool = place[result.tool.numpy()] - scene.tool_centre
    assert result.tool.sum() > 50
    assert np.all(np.abs(tool) < np.array([0.01, 0.06, 0.05]) + 0.03)
    blue = colour[result.tool.numpy()]
    sand = colour[result.soil.numpy()]
    assert np.median(blue[:, 2] - blue[:, 0]) > 0.1 > np.median(sand[:, 2] - sand[:, 0])


def test_nothing_but_soil_reaches_into_the_bed(measurement, result):
    around = ~result.soil & ~result.tool
    assert around.any()
    floor = float(measurement.bed.lower[2])
    assert not reaching_into_soil(result.gaussians[around], result.surface, floor).any()


def test_the_surface_through_discs_is_theirs(scene):
    """A steep plane exactly, a wave to a small part of its height, and the start's heights where there are no discs."""
    field = HeightField.over(scene.bed.lower, scene.bed.upper, 0.01, height=0.42)
    dense = HeightField.over(scene.bed.lower, scene.bed.upper, 0.008)
    x, y = (a.ravel() for a in np.meshgrid(dense.x, dense.y))
    xs, ys = np.meshgrid(field.x, field.y)
    up = np.tile([0.0, 0.0, 1.0], (len(x), 1))

    def through(height, kept=slice(None)):
        seeds = Seeds.of(np.stack([x, y, height(x, y)], 1)[kept], up[kept], 0.008, SOIL)
        return surface_through(discs(seeds, np.full((len(seeds.points), 3), 0.5), 0.9), field).height

    plane = lambda x, y: 0.42 + 0.04 * (x - 1.3) + 0.06 * (y + 0.3)  # noqa: E731
    np.testing.assert_allclose(through(plane), plane(xs, ys), atol=1e-5)
    wave = lambda x, y: 0.42 + 0.01 * np.sin(2 * np.pi * x / 0.2)  # noqa: E731
    inner = (slice(None), slice(2, -2))
    np.testing.assert_allclose(through(wave)[inner], wave(xs, ys)[inner], atol=8e-4)
    half = through(plane, x < 1.3)
    np.testing.assert_array_equal(half[xs > 1.4], 0.42)


def test_what_is_saved_is_what_is_loaded(result, tmp_path):
    result.save(tmp_path / "out")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(
        ["gaussians.npz", "gaussians.ply", "reconstruction.json", "soil.ply", "surface.npz"]
    )
    again = Reconstruction.load(tmp_path / "out")
    for name in ("means", "scales", "quaternions", "opacities", "colours"):
        assert torch.equal(getattr(again.gaussians, name), getattr(result.gaussians, name))
    assert torch.equal(again.soil, result.soil) and torch.equal(again.tool, result.tool)
    np.testing.assert_array_equal(again.surface.height, result.surface.height)
    assert again.held_out == result.held_out
    assert again.metadata == result.metadata and again.background == pytest.approx(result.background)
    assert again.mesh.is_watertight
    assert again.mesh.volume == pytest.approx(result.mesh.volume, rel=1e-4)
    assert len(load_ply(tmp_path / "out" / "gaussians.ply")) == len(result.gaussians)
    facts = json.loads((tmp_path / "out" / "reconstruction.json").read_text())
    assert {"version", "preset", "seed", "device", "measurement_hash", "psnr", "ssim", "seconds"} <= facts.keys()


def test_a_damaged_result_is_an_error_of_one_line(result, tmp_path):
    with pytest.raises(RunError):
        Reconstruction.load(tmp_path / "nowhere")
    result.save(tmp_path)
    (tmp_path / "gaussians.npz").write_bytes(b"PK\x03\x04 no")
    with pytest.raises(RunError, match="reconstruct again"):
        Reconstruction.load(tmp_path)
    (tmp_path / "reconstruction.json").write_text('{"format": "something else"}')
    with pytest.raises(RunError, match="format"):
        Reconstruction.load(tmp_path)


def moved(measurement, scale=1.0, turn=0.0):
    """The set with its views scaled and turned (rad) about the bed's middle, and its video as it was."""
    centre = (measurement.bed.lower + measurement.bed.upper) / 2
    about = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    views = []
    for view in measurement.views:
        pose = view.camera.camera_to_world.copy()
        pose[:3, :3] = about @ pose[:3, :3]
        pose[:3, 3] = centre + scale * about @ (pose[:3, 3] - centre)
        views.append(replace(view, camera=replace(view.camera, camera_to_world=pose)))
    return replace(measurement, views=tuple(views))


def test_a_video_of_the_same_world_is_not_remarked_on(result):
    assert result.metadata["remarks"] == []


def test_views_of_another_scale_than_the_video_are_remarked_on(measurement, tmp_path):
    with pytest.warns(SetWarning, match=r"The bed that camera 'left' sees is displaced by \d\.\d px"):
        made = reconstruct(moved(measurement, scale=1.05), preset="tiny")
    made.save(tmp_path)
    with pytest.warns(SetWarning, match="camera 'left'"):
        again = Reconstruction.load(tmp_path)
    assert again.metadata["remarks"] == made.metadata["remarks"]


@pytest.mark.parametrize("change", [{"turn": np.pi}, {"turn": 0.5 * np.pi}, {"scale": 3.0}])
def test_views_of_another_world_than_the_video_are_refused(measurement, change):
    with pytest.raises(MeasurementError, match=r"camera 'left' \(.*\) sees is not that in the views"):
        reconstruct(moved(measurement, **change), preset="tiny")


def alike(measurement, result, change=lambda images: images, bed=None):
    """How like the reconstruction the first four views are, their pictures changed."""
    views = load_views(measurement.views[:4], 160)
    shown = replace(views, images=change(views.images))
    level = float(np.median(result.surface.height))
    return Pictures(result.gaussians, shown, views.valid, bed or measurement.bed, level, result.background).likeness()


def test_likeness_is_of_the_soil_and_whatever_the_exposure(measurement, result):
    plain = alike(measurement, result)
    assert plain.correlation.min() > 0.8 > 0.4 > np.abs(plain.control).max()
    dimmed = alike(measurement, result, lambda images: 0.2 + 0.5 * images)
    np.testing.assert_allclose(dimmed.correlation, plain.correlation, atol=1e-4)
    grey = alike(measurement, result, lambda images: torch.full_like(images, 0.5))
    assert np.isnan(grey.correlation).all()
    away = replace(measurement.bed, lower=measurement.bed.lower + 50.0, upper=measurement.bed.upper + 50.0)
    none = alike(measurement, result, bed=away)
    assert np.isnan(none.correlation).all() and not none.unrelated(2).any()


@pytest.mark.parametrize("share", [None, 8])
def test_displacements_are_found_whatever_a_wall_hides_and_however_light_it_is(measurement, result, share):
    """Pictures rolled by whole pixels, behind a white wall over an eighth of them."""

    def displaced(by):
        views = load_views(measurement.views[:4], 160)
        images = torch.roll(0.2 + 0.5 * views.images, by, dims=(2, 3))
        if share is not None:
            images[:, :, -images.shape[2] // share :] = 1.0
        level = float(np.median(result.surface.height))
        shown = replace(views, images=images)
        pictures = Pictures(result.gaussians, shown, views.valid, measurement.bed, level, result.background)
        return pictures.displacements(3)

    np.testing.assert_array_less(displaced((0, 0)), 0.5)
    np.testing.assert_allclose(displaced((0, 3)), 3.0, atol=0.5)
    np.testing.assert_allclose(displaced((-4, 3)), 5.0, atol=0.5)


def test_no_more_alike_than_by_chance():
    """Unexplained variances by construction."""
    views = 1.0 - np.array([0.08, 0.1, 0.1, 0.12, 0.2])
    fixed = 1.0 - np.array([0.19, 0.21, 0.96, np.nan])
    found = Likeness(np.sqrt(np.append(views, fixed)), np.full(9, 0.25))
    assert found.unrelated(4).tolist() == [False, False, True, False]
    found.control[0] = 0.9  # a view itself is no more alike than that
    assert not found.unrelated(4).any()


def test_views_that_tell_no_height_are_refused(measurement):
    one = measurement.views[1]
    same = tuple(replace(view, camera=one.camera, path=one.path) for view in measurement.views)
    with pytest.raises(MeasurementError, match="do not tell the height"):
        reconstruct(replace(measurement, views=same), preset="tiny")
    far = []
    for view in measurement.views:
        pose = view.camera.camera_to_world.copy()
        pose[:3, 3] += 20.0 * pose[:3, 2]
        far.append(replace(view, camera=replace(view.camera, camera_to_world=pose)))
    with pytest.raises(MeasurementError, match="from nearer"):
        reconstruct(replace(measurement, views=tuple(far)), preset="tiny")


def test_photographs_set_aside_that_are_not_predicted_leave_no_answer(measurement, result, tmp_path, capsys):
    """Two photographs have the poses of one another."""
    assert result.fault == ""
    folder = tmp_path / "set"
    shutil.copytree(measurement.folder, folder)
    file = folder / "views" / "transforms.json"
    data = json.loads(file.read_text())
    one, other = (data["frames"][k] for k in (0, 8))
    one["file_path"], other["file_path"] = other["file_path"], one["file_path"]
    file.write_text(json.dumps(data))
    run = tmp_path / "run"
    words = ["--preset", "tiny", "--device", "cpu"]
    assert main(["fit", str(folder), "--run", str(run), *words]) == 3
    out = capsys.readouterr().out
    assert out.startswith("no answer: photographs set aside are predicted to") and len(out.splitlines()) == 1
    assert (run / "reconstruction" / "reconstruction.json").is_file() and not (run / "fit.json").exists()
    assert main(["reconstruct", str(folder), "--out", str(tmp_path / "out"), *words, "--json"]) == 3
    said = json.loads(capsys.readouterr().out)
    assert said["ok"] is False and said["error"].startswith("no answer: photographs set aside")


def test_what_photographs_set_aside_must_be_nearer_than(measurement, result):
    """To the scene higher by a length: nothing for none, and the more the longer it is."""
    views = load_views(measurement.views[:2], 160)
    nothing, little, much = (
        [one.displaced for one in judged(result.gaussians, views, result.background, length)]
        for length in (0.0, 0.002, 0.02)
    )
    assert np.isinf(nothing).all() and (np.array(little) > np.array(much) + 3.0).all()


def test_without_photographs_to_judge_by_there_is_no_likeness(measurement, tmp_path, capsys):
    out = tmp_path / "none"
    command = ["reconstruct", str(measurement.folder), "--preset", "tiny", "--json"]
    assert main([*command, "--holdout", "0", "--out", str(out)]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["psnr"] is None and said["ssim"] is None and said["held_out"] == []
    assert np.isnan(Reconstruction.load(out).psnr)


def test_options_that_make_no_sense(measurement):
    for options in ({"preset": "huge"}, {"holdout": 1}, {"holdout": -2}, {"device": "cuda:99"}, {"device": "abacus"}):
        with pytest.raises(ParameterError):
            reconstruct(measurement, **options)
    few = replace(measurement, views=measurement.views[:3])
    with pytest.raises(MeasurementError, match="views"):
        reconstruct(few, preset="tiny")


def test_command_line_and_the_same_seed_gives_the_same_bits(measurement, result, tmp_path, capsys):
    out = tmp_path / "result"
    command = ["reconstruct", str(measurement.folder), "--out", str(out), "--preset", "tiny", "--seed", "3", "--json"]
    assert main([*command, "--device", "cpu"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["ok"] and said["preset"] == "tiny" and said["measurement_hash"] == measurement.hash
    again = Reconstruction.load(out)
    assert again.psnr == result.psnr == said["psnr"]
    for name in ("means", "scales", "quaternions", "opacities", "colours"):
        assert torch.equal(getattr(again.gaussians, name), getattr(result.gaussians, name)), name
    np.testing.assert_array_equal(again.surface.height, result.surface.height)


def test_the_command_line_says_remarks_once_and_on_stderr(measurement, result, tmp_path, monkeypatch, capsys):
    odd = replace(result, metadata={**result.metadata, "remarks": ["video: is it so?"]})

    def found(*_, **__):
        odd.say_remarks()
        odd.say_remarks()
        return odd

    monkeypatch.setattr("splatsoil.reconstruction.reconstruct", found)
    assert main(["reconstruct", str(measurement.folder), "--out", str(tmp_path / "r"), "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["remarks"] == ["video: is it so?"]
    assert err.count("remark video: is it so?\n") == 1 and "Warning" not in err
