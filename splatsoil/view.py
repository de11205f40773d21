"""A measurement set and predictions of it in a browser: Gaussians, particles, tool and cameras at each video frame."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatsoil.arrays import FloatArray
from splatsoil.comparison import Comparator
from splatsoil.export.replay import Floats, Moment
from splatsoil.export.splats import lit_gaussians
from splatsoil.measurement import Camera, Frame, Measurement
from splatsoil.model import Model
from splatsoil.mpm import Trajectory

Bytes = npt.NDArray[np.uint8]

GAUSSIANS = "Gaussians"
PICTURES = ("observed", "predicted", "difference")
UNITS = {"speed": "m/s", "shear strain": "", "plastic shear": "", "misfit": "grey levels"}
QUANTILE = 0.995  # of a quantity, which its last colour stands for
WIDEST = 640  # pixels of a photograph in the scene
PAUSE = 0.15  # seconds from frame to frame while playing


@dataclass
class Column:
    """The prediction of one model; a writer for `export.replay` of the frames in ``model.recorded``.

    Args:
        title: stands over it.
        model, values: what is replayed, and its parameters by name.
        comparator: of the same measurement and frames.

    Attributes:
        positions: particles (n, 3) in m by frame.
        splats: Gaussians over the bed by frame, where photographs show the soil: centres (n, 3) in m, covariances
            (n, 3, 3), colours (n, 3), opacities (n, 1).
        quantities: by name and frame, (n,) of each particle in `UNITS`. The misfit is that of the block of the bed that
            the particle is in, in the camera in which it is largest: |observed − predicted| change since frame 0.
        pictures: (h, w, 3) by one of `PICTURES`, camera and frame.
    """

    title: str
    model: Model
    values: dict[str, float]
    comparator: Comparator
    positions: dict[int, Floats] = field(default_factory=dict)
    splats: dict[int, tuple[Floats, ...]] = field(default_factory=dict)
    quantities: dict[str, dict[int, Floats]] = field(default_factory=dict)
    pictures: dict[tuple[str, str, int], Bytes] = field(default_factory=dict)
    _deformations: dict[int, Floats] = field(default_factory=dict)

    def add(self, moment: Moment) -> None:
        """Take the next moment."""
        self.positions[moment.frame], self._deformations[moment.frame] = moment.positions, moment.deformations
        if moment.frame not in self.model.frames:
            return
        if self.model.photographed:
            self.splats[moment.frame] = self._gaussians(moment)
        self._keep("speed", moment.frame, np.linalg.norm(moment.velocities, axis=1))
        self._keep("shear strain", moment.frame, shear_strain(moment.deformations))
        if moment.plastic_strains is not None:
            self._keep("plastic shear", moment.frame, moment.plastic_strains)

    def _gaussians(self, moment: Moment) -> tuple[Floats, ...]:
        scene = self.model.scene()
        g = lit_gaussians(scene, scene.pose(moment.positions, moment.deformations, moment.tool))
        bed, arrays = self.model.measurement.bed, (g.means, g.covariances(), g.colours, g.opacities[:, None])
        # What surrounds the bed would hide what stands beside it.
        outside = np.abs(arrays[0].numpy() - 0.5 * (bed.lower + bed.upper))[:, :2] > 0.55 * bed.extents[:2]
        return tuple(array.numpy()[~outside.any(axis=1)] for array in arrays)

    def finish(self, force: FloatArray) -> None:
        """Draw the pictures and compare them."""
        positions, deformations = (np.stack(list(kept.values())) for kept in (self.positions, self._deformations))
        frames, resolution = tuple(self.positions), self.model.resolution
        trajectory = Trajectory(frames, positions, deformations, force, resolution.spacing, resolution)
        images = self.model.draw(trajectory, values=self.values)
        for camera, frame in images:
            for kind, picture in self.comparator.pictures(images, camera, frame).items():
                self.pictures[kind, camera, frame] = _bytes(picture)
        if images:
            self._compare(self.comparator.blocks(images))
        self._deformations.clear()

    def _compare(self, blocks: FloatArray) -> None:
        """Misfit of every particle, from the residual of each block of the comparison."""
        bed, size = self.model.measurement.bed, self.comparator.block
        count = np.round(bed.extents[:2] / size).astype(int)

        def cell(places: npt.NDArray[np.floating]) -> tuple[npt.NDArray[np.int64], ...]:
            return tuple(np.clip(((places - bed.lower[:2]) / size).astype(int), 0, count - 1).T)

        labels = np.array([(label.frame, label.x, label.y) for label in self.comparator.labels])
        for frame in self.model.frames:
            largest, here = np.zeros(count), labels[:, 0] == frame
            np.maximum.at(largest, cell(labels[here, 1:]), np.abs(blocks[here]))
            self._keep("misfit", frame, largest[cell(self.positions[frame][:, :2])])

    def _keep(self, name: str, frame: int, values: npt.NDArray[np.floating]) -> None:
        self.quantities.setdefault(name, {})[frame] = values.astype(np.float32)


def shear_strain(deformations: npt.NDArray[np.floating]) -> Floats:
    """Equivalent shear strain √(2/3 e : e) of deformations (n, 3, 3); e is the deviator of the Hencky strain."""
    stretches = np.linalg.svd(deformations.astype(np.float64), compute_uv=False)
    logarithms = np.log(np.maximum(stretches, np.finfo(np.float32).tiny))
    return np.asarray(np.sqrt(2.0) * logarithms.std(axis=1), dtype=np.float32)


class Viewer:
    """A set, with predictions side by side or none, in the browsers that a `viser.ViserServer` serves."""

    def __init__(self, server: Any, measurement: Measurement, columns: Sequence[Column] = ()) -> None:
        self.server, self.measurement, self.columns = server, measurement, tuple(columns)
        self.frames = self.columns[0].model.frames if columns else measurement.frames
        self._lock = threading.Lock()
        self.limits: dict[str, float] = {}
        for name in UNITS if columns else ():
            if all(name in column.quantities for column in columns):
                values = [v for column in columns for v in column.quantities[name].values()]
                self.limits[name] = float(np.quantile(np.concatenate(values), QUANTILE)) or 1.0
        self._add_controls()
        self._add_scene()
        self.show()

    def show(self) -> None:
        """Update the scene by the controls."""
        with self._lock, self.server.atomic():
            frame = self.frames[self.slider.value]
            moment = frame / self.measurement.frame_rate
            name, largest = self.colour.value, self.limits.get(self.colour.value)
            scale = f"; {name} from 0 (blue) to {largest:.3g} {UNITS[name]} (yellow)" if largest else ""
            self.text.content = f"frame {frame}, {moment:.2f} s{scale}"
            rotation, position = self.measurement.tool.motion.pose(moment)
            for tool in self._tools:
                tool.wxyz, tool.position = _quaternion(rotation), position
            for camera, node in self._video.items():
                node.image = self._picture(camera, frame)
            for column, (splats, particles) in zip(self.columns, self._soil, strict=True):
                particles.visible = largest is not None
                if splats is not None:
                    splats.visible = largest is None
                    if largest is None:
                        splats.set_gaussians(*column.splats[frame])
                if largest is not None:
                    particles.points = column.positions[frame]
                    shares = np.clip(column.quantities[name][frame] / largest, 0.0, 1.0)
                    particles.colors = _bytes(matplotlib.colormaps["viridis"](shares)[:, :3])
            for node in self._photographs:
                node.visible = self.photographs.value

    def play(self) -> None:
        """Move from frame to frame while the control is on; never returns."""
        while True:
            time.sleep(PAUSE)
            if self.playing.value:
                self.slider.value = (self.slider.value + 1) % len(self.frames)

    def _add_controls(self) -> None:
        gui = self.server.gui
        # The share button would send the scene to a server of others.
        gui.configure_theme(show_logo=False, show_share_button=False)
        gui.set_panel_label(f"splatsoil: {self.measurement.name}")
        self.text = gui.add_markdown("")
        self.slider = gui.add_slider("frame", 0, len(self.frames) - 1, 1, 0)
        self.playing = gui.add_checkbox("play", False)
        splats = (GAUSSIANS,) if all(column.splats for column in self.columns) else ()
        self.colour = gui.add_dropdown("soil", (*splats, *self.limits), visible=bool(self.columns))
        self.picture = gui.add_dropdown("video", PICTURES, visible=bool(self.columns))
        self.photographs = gui.add_checkbox("photographs", not self.columns)
        for control in (self.slider, self.colour, self.picture, self.photographs):
            control.on_update(lambda _: self.show())

    def _add_scene(self) -> None:
        scene, bed, mesh = self.server.scene, self.measurement.bed, self.measurement.tool.mesh
        centre, size = 0.5 * (bed.lower + bed.upper), float(np.linalg.norm(bed.extents[:2]))
        aside = np.array([0.0, 1.4 * bed.extents[1], 0.0])
        others = max(len(self.columns) - 1, 0)
        scene.set_up_direction("+z")
        self.server.initial_camera.look_at = middle = centre - 0.5 * others * aside
        # Photographs are taken from farther away than a prediction is looked at.
        distance = size * (0.6 + 0.3 * others if self.columns else 1.2)
        self.server.initial_camera.position = middle + distance * np.array([-0.3, -1.2, 1.0])
        self._tools, self._soil = [], []
        for k in range(max(len(self.columns), 1)):
            # The first stands at the back, where labels don't hide another.
            name, shift = f"/prediction {k}" if self.columns else "/set", -k * aside
            scene.add_frame(name, show_axes=False, position=shift)
            scene.add_box(f"{name}/bed", (128, 128, 128), bed.extents, wireframe=True, position=centre)
            tool = scene.add_mesh_simple(f"{name}/tool", mesh.vertices, mesh.faces, color=(60, 90, 160), side="double")
            self._tools.append(tool)
            if self.columns:
                column, above = self.columns[k], [centre[0], bed.upper[1], bed.upper[2]]
                scene.add_label(f"{name}/title", column.title, position=above, anchor="bottom-center")
                first = self.frames[0]
                splats = scene.add_gaussian_splats(f"{name}/splats", *column.splats[first]) if column.splats else None
                points, spacing = column.positions[first], column.model.resolution.spacing
                how: dict[str, Any] = {"point_size": spacing, "point_shape": "circle", "precision": "float32"}
                particles = scene.add_point_cloud(f"{name}/particles", points, (0, 0, 0), visible=False, **how)
                self._soil.append((splats, particles))
        self._photographs = [
            self._add_camera(f"/photographs/{k}", view.camera, _small(view), 0.05 * size)
            for k, view in enumerate(self.measurement.views)
        ]
        self._video = {
            name: self._add_camera(f"/video/{name}", camera, self._picture(name, self.frames[0]), 0.08 * size)
            for name, camera in self.measurement.cameras.items()
        }

    def _add_camera(self, name: str, camera: Camera, picture: Bytes, scale: float) -> Any:
        """A frustum with its image; a click moves the viewer's camera there. viser centres the principal point."""
        opencv = camera.camera_to_world[:3, :3] * [1.0, -1.0, -1.0]
        shape = 2.0 * math.atan(0.5 * camera.height / camera.fy), camera.width / camera.height
        pose: dict[str, Any] = {"wxyz": _quaternion(opencv), "position": camera.position}
        how: dict[str, Any] = {"scale": scale, "thickness": 0.01 * scale, "image": picture}
        node = self.server.scene.add_camera_frustum(name, *shape, **pose, **how)

        @node.on_click
        def _(event: Any) -> None:
            with event.client.atomic():
                event.client.camera.wxyz, event.client.camera.position = pose["wxyz"], pose["position"]

        return node

    def _picture(self, camera: str, frame: int) -> Bytes:
        if self.columns:
            return self.columns[0].pictures[self.picture.value, camera, frame]
        return _small(self.measurement.video_frame(camera, frame))


def _small(frame: Frame) -> Bytes:
    step = math.ceil(frame.camera.width / WIDEST)
    return _bytes(frame.undistorted_image()[::step, ::step])


def _bytes(colours: npt.NDArray[np.floating]) -> Bytes:
    return np.rint(255.0 * np.clip(colours, 0.0, 1.0)).astype(np.uint8)


def _quaternion(rotation: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_matrix(rotation).as_quat(scalar_first=True))
