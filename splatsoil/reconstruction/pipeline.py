"""Reconstruction of a measurement set: stereo, training, segmentation, surface."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree

from splatsoil import __version__
from splatsoil.errors import MeasurementError, ParameterError
from splatsoil.files import RECONSTRUCTING, code_digest
from splatsoil.measurement import BIN, HEAP, TRANSPARENT, Bed, Measurement
from splatsoil.mpm.presets import Resolution
from splatsoil.reconstruction.height_field import HeightField
from splatsoil.reconstruction.heights import first_surface
from splatsoil.reconstruction.hidden import reaching_into_soil
from splatsoil.reconstruction.initial import SIDE, TOOL, first_gaussians
from splatsoil.reconstruction.likeness import Pictures
from splatsoil.reconstruction.presets import preset_named
from splatsoil.reconstruction.result import HeldOut, Reconstruction
from splatsoil.reconstruction.sides import sides_seen
from splatsoil.reconstruction.surface import find_geometry, scale_of, soil_mesh, surface_through
from splatsoil.reconstruction.training import train
from splatsoil.reconstruction.views import Views, load_views, silhouettes, still_video, surface_points
from splatsoil.splats import Gaussians, psnr, rasterise, ssim
from splatsoil.threads import one_thread

FEWEST_VIEWS = 3
NO_BACKGROUND = (0.0, 0.0, 0.0)
RESOLVED = 1.0
"""Displacement in a fixed camera's picture, px, beyond which its pose is not that of the views' world."""


@one_thread()
def reconstruct(
    measurement: Measurement,
    *,
    seed: int = 0,
    device: str = "cpu",
    preset: str = "small",
    holdout: int = 8,
    progress: Callable[[str, float], None] | None = None,
) -> Reconstruction:
    """Gaussians, surface and solid of the scene before anything moves, from a set's views.

    Of a set without views the first heights give the surface, and there are no Gaussians.

    Args:
        measurement: the set; its `views` show the bed and the tool at the first pose of its motion.
        seed: the same seed on the CPU gives the same bits.
        device: where the work is done, as torch names it.
        preset: how much work; see `presets.PRESETS`.
        holdout: every so many views one is set aside, the first among them, to judge by; 0 sets none aside.
        progress: called with what is being done and how much of that is done (0 to 1).

    Raises:
        MeasurementError: too few views, views that do not tell the soil's height, or a video that shows another scene.
        ParameterError: an unknown preset, a negative holdout.
    """
    report = progress or (lambda what, share: None)
    started = time.monotonic()
    chosen = preset_named(preset)
    if holdout < 0 or holdout == 1:
        raise ParameterError(f"holdout sets every so many views aside: 0 for none, or 2 and more, not {holdout}")
    if device != "cpu" and not torch.cuda.is_available():
        raise ParameterError(f"there is no device {device!r} here; choose cpu")
    about = {
        "measurement": measurement.name,
        "measurement_hash": measurement.hash,
        "version": __version__,
        "code": code_digest(RECONSTRUCTING),
        "preset": preset,
        "seed": seed,
        "device": device,
        "holdout": holdout,
    }
    if not measurement.views:
        surface = first_surface(measurement, scale_of(measurement.bed) / chosen.cells**0.5)
        solid, none = soil_mesh(surface, measurement.bed), torch.zeros(0, dtype=torch.bool)
        about |= {"container": measurement.bed.container or BIN, "remarks": []}
        return Reconstruction(
            no_gaussians(), none, none, surface, solid, NO_BACKGROUND, (), about, time.monotonic() - started
        )
    report("reading photographs", 0.0)
    every = load_views(measurement.views, chosen.longest_side)
    aside = list(range(0, len(every), holdout)) if holdout else []
    views = every.subset([k for k in range(len(every)) if k not in set(aside)])
    if len(views) < FEWEST_VIEWS:
        raise MeasurementError(
            f"{len(views)} views are left to reconstruct from and {FEWEST_VIEWS} are needed; take more photographs",
            file=measurement.folder,
            field="views",
        )
    bed = measurement.bed
    tool = measurement.tool.placed(float(measurement.tool.motion.times[0]))
    report("finding the tool", 0.0)
    hidden = silhouettes(views, tool)
    container, remarks = bed.container or BIN, []
    geometry = find_geometry(views.to(device), bed, hidden, chosen, report, container=container)
    if bed.container is None and sides_seen(views.to(device), bed, geometry):
        container = TRANSPARENT
        geometry = find_geometry(views.to(device), bed, hidden, chosen, report, container=container)
        remarks.append(
            "bed: bed.container is not given; photographs show soil at the bed's sides, so transparent walls are taken."
        )
    spacing = chosen.soil_spacing * max(geometry.surface.cell)
    report("placing Gaussians", 0.0)
    cameras: list[str] = []
    still = still_video(measurement, chosen.longest_side)
    if still is not None:
        # The fixed cameras see sides of things that no photograph needs to show.
        cameras = [camera.name for camera in still.cameras]
        views = views.joined(still)
        geometry = replace(geometry, usable=(views.valid * (1.0 - silhouettes(views, tool))).to(device))
    sides = container == TRANSPARENT
    first, label = first_gaussians(views.to(device), bed, tool, geometry, spacing, sides=sides)
    first = first.to(device)
    if cameras:
        # Before training, which bends the scene to what it is shown.
        level = float(np.median(geometry.surface.height))
        alike = Pictures(first, views, geometry.usable, bed, level, NO_BACKGROUND).likeness()
        usual = np.nanmedian(alike.correlation[: -len(cameras)])
        for k in np.flatnonzero(alike.unrelated(len(cameras))):
            value = alike.correlation[k - len(cameras)]
            raise MeasurementError(
                f"the bed that camera {cameras[k]!r} (its picture correlates with the reconstruction by {value:.2f},"
                f" the views by {usual:.2f}) sees is not that in the views: their poses and lenses must be of one world"
                " and scale, and the bed the same",
                file=measurement.folder,
                field="video",
            )
    trained = train(first, label, views, geometry.surface, float(bed.lower[2]), chosen, seed, report)
    on_top, on_tool = segments(trained.gaussians, trained.label, geometry.surface, bed, tool)
    if container == HEAP:
        on_top &= torch.from_numpy(geometry.surface.sample(trained.gaussians.means.numpy()[:, :2]) > bed.lower[2])
    surface = surface_through(trained.gaussians[on_top], geometry.surface)
    if container == HEAP:
        bare = geometry.surface.height <= bed.lower[2]
        surface = replace(surface, height=np.where(bare, bed.lower[2], np.maximum(surface.height, bed.lower[2])))
    soil = on_top | (at_sides(trained.gaussians, trained.label, surface, bed) & ~on_tool) if sides else on_top
    around = torch.nonzero(~soil & ~on_tool)[:, 0]
    kept = torch.ones(len(soil), dtype=torch.bool)
    kept[around] = ~reaching_into_soil(trained.gaussians[around], surface, float(bed.lower[2]))
    gaussians, soil, on_tool = trained.gaussians[kept], soil[kept], on_tool[kept]
    scene = gaussians.to(device)
    if cameras:
        report("comparing with the video", 0.0)
        level = float(np.median(surface.height))
        shown = Pictures(scene, views, geometry.usable, bed, level, trained.background)
        remarks += [
            f"video: The bed that camera {camera!r} sees is displaced by {value:.1f} px from that in the views; are"
            " their poses and lenses of one world and scale, and is the bed the same?"
            for camera, value in zip(cameras, shown.displacements(len(cameras)), strict=True)
            if value > RESOLVED
        ]
    cell = Resolution.derive(measurement, preset).cell
    held_out = judged(scene, every.subset(aside), trained.background, cell)
    made = Reconstruction(
        gaussians=gaussians,
        soil=soil,
        tool=on_tool,
        surface=surface,
        mesh=soil_mesh(surface, bed),
        background=trained.background,
        held_out=held_out,
        metadata={
            **about,
            "container": container,
            "ground": geometry.ground,
            "simulation_cell": cell,
            "first_loss": float(np.mean(trained.losses[: len(views)])),
            "last_loss": float(np.mean(trained.losses[-len(views) :])),
            "remarks": remarks,
        },
        seconds=time.monotonic() - started,
    )
    made.say_remarks()
    return made


def no_gaussians() -> Gaussians:
    """None at all."""
    return Gaussians(*(torch.zeros(0, *shape) for shape in ((3,), (3,), (4,), (), (3,))))


def segments(
    gaussians: Gaussians, label: torch.Tensor, surface: HeightField, bed: Bed, tool: trimesh.Trimesh
) -> tuple[torch.Tensor, torch.Tensor]:
    """Which Gaussians are the soil's surface and which are tool, each (n,) bool.

    By place, not by where they began: the tool's lie within their own size of its mesh; the soil's inside the bed's box
    within a few cells of the surface.
    """
    place = gaussians.means.numpy().astype(np.float64)
    reach = gaussians.scales.amax(dim=1).numpy().astype(np.float64)
    cell = max(surface.cell)
    skin, _ = surface_points(tool, cell)
    distance, _ = cKDTree(skin).query(place)
    began = label.numpy() == TOOL
    of_soil = (bed.beyond(place) < 0.0) & (np.abs(place[:, 2] - surface.sample(place[:, :2])) < 3.0 * cell)
    on_tool = (distance < cell + np.where(began, reach, 0.0)) & (began | ~of_soil)
    soil = of_soil & ~on_tool & (label.numpy() != SIDE)
    return torch.from_numpy(soil), torch.from_numpy(on_tool)


def at_sides(gaussians: Gaussians, label: torch.Tensor, surface: HeightField, bed: Bed) -> torch.Tensor:
    """Which Gaussians (n,) are the soil's sides: within a few cells of the box's, between its floor and the surface.

    Outside of the box only those that began there: beside it is something else.
    """
    place = gaussians.means.numpy().astype(np.float64)
    cell = max(surface.cell)
    beyond, began = bed.beyond(place), label.numpy() == SIDE
    near = (beyond > -3.0 * cell) & (beyond < np.where(began, 3.0 * cell, 0.0))
    high = (place[:, 2] > bed.lower[2]) & (place[:, 2] < surface.sample(place[:, :2]) + cell)
    return torch.from_numpy(near & high)


def judged(
    gaussians: Gaussians, views: Views, background: tuple[float, float, float], displacement: float
) -> tuple[HeldOut, ...]:
    """Likeness of the drawn pictures to photographs that were set aside (pixels that are masked do not count), and of
    the same pictures to those of the scene higher by ``displacement`` metres.

    A photograph of which nothing is left tells nothing and is left out.
    """
    raised = replace(gaussians, means=gaussians.means + gaussians.means.new_tensor([0.0, 0.0, displacement]))
    result = []
    for k, camera in enumerate(views.cameras):
        if not views.valid[k].any():
            continue
        photograph = views.photograph(k).contiguous().to(gaussians.device)
        valid = views.valid[k, : camera.height, : camera.width, None].to(gaussians.device)
        unmasked = 10.0 * np.log10(float(valid.mean()))
        with torch.no_grad():
            drawn, higher = (
                rasterise(g, camera, background=background, antialias=True).colour.clamp(0.0, 1.0)
                for g in (gaussians, raised)
            )
            mixed = drawn * valid + photograph * (1.0 - valid)
            value = float(psnr(mixed, photograph) + unmasked)
            displaced = float(psnr(higher * valid, drawn * valid) + unmasked)
            result.append(HeldOut(views.names[k], value, float(ssim(mixed, photograph)), displaced))
    return tuple(result)
