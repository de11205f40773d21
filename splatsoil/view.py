"""A measurement set and predictions of it in a browser: Gaussians, particles, tool and cameras at each video frame."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
import viser
from PIL import Image
from scipy.spatial.transform import Rotation

from splatsoil.comparison import Comparator
from splatsoil.export.replay import FloatArray, Floats, Moment
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
        splats: Gaussians by frame: centres (n, 3) and covariances (n, 3, 3) in m, colours (n, 3), opacities (n, 1).
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
        scene = self.model.scene()
        g = lit_gaussians(scene, scene.pose(moment.positions, moment.deformations, moment.tool))
        arrays = (g.means, g.covariances(), g.colours, g.opacities[:, None])
        self.splats[moment.frame] = tuple(array.numpy() for array in arrays)
        self._keep("speed", moment.frame, np.linalg.norm(moment.velocities, axis=1))
        self._keep("shear strain", moment.frame, shear_strain(moment.deformations))
        if moment.plastic_strains is not None:
            self._keep("plastic shear", moment.frame, moment.plastic_strains)

    def finish(self, force: FloatArray) -> None:
        """Draw the pictures and compare them."""
        states = (np.stack(list(by_frame.values())) for by_frame in (self.positions, self._deformations))
        resolution = self.model.resolution
        trajectory = Trajectory(tuple(self.positions), *states, force, resolution.spacing, resolution)
        images = self.model.draw(trajectory, values=self.values)
        for camera, frame in images:
            strip = _bytes(self.comparator.picture(images, camera, frame))
            for kind, picture in zip(PICTURES, np.split(strip, 3, axis=1), strict=True):
                self.pictures[kind, camera, frame] = picture
        self._compare(self.comparator.blocks(images))
        self._deformations.clear()

    def _compare(self, blocks: FloatArray) -> None:
        """Misfit of every particle, from the residual of each block of the comparison."""
        bed, size = self.model.measurement.bed, self.comparator.block
        count = np.round(bed.extents[:2] / size).astype(int)
        largest = {frame: np.zeros(count, dtype=np.float32) for frame in self.model.frames}
        for label, residual in zip(self.comparator.labels, blocks, strict=True):
            place = tuple(((np.array([label.x, label.y]) - bed.lower[:2]) / size).astype(int))
            largest[label.frame][place] = max(largest[label.frame][place], abs(residual))
        for frame, plan in largest.items():
            place = ((self.positions[frame][:, :2] - bed.lower[:2]) / size).astype(int)
            x, y = np.clip(place, 0, count - 1).T
            self._keep("misfit", frame, plan[x, y])

    def _keep(self, name: str, frame: int, values: npt.NDArray[np.floating]) -> None:
        self.quantities.setdefault(name, {})[frame] = values.astype(np.float32)


def shear_strain(deformations: npt.NDArray[np.floating]) -> Floats:
    """Equivalent shear strain √(2/3 e : e) of deformations (n, 3, 3); e is the deviator of the Hencky strain."""
    stretches = np.linalg.svd(deformations.astype(np.float64), compute_uv=False)
    logarithms = np.log(np.maximum(stretches, np.finfo(np.float32).tiny))
    return np.asarray(np.sqrt(2.0) * logarithms.std(axis=1), dtype=np.float32)


class Viewer:
    """What a browser shows of a set, with predictions side by side.

    Args:
        server: of viser.
        measurement: bed, tool, cameras and their pictures.
        columns: finished predictions of it; none shows the set alone.
    """

    def __init__(self, server: viser.ViserServer, measurement: Measurement, columns: Sequence[Column] = ()) -> None:
        self.server, self.measurement, self.columns = server, measurement, tuple(columns)
        self.frames = self.columns[0].model.frames if columns else measurement.frames
        self._lock = threading.Lock()
        common = set.intersection(*(set(c.quantities) for c in columns)) if columns else set()
        self.limits = {name: self._limit(name) for name in UNITS if name in common}
        self._add_controls()
        self._add_scene()
        self.show()

    def show(self) -> None:
        """Bring the scene to what the controls say."""
        with self._lock, self.server.atomic():
            frame = self.frames[self.slider.value]
            moment = frame / self.measurement.frame_rate
            self.text.content = f"frame {frame}, {moment:.2f} s{self._scale()}"
            rotation, position = self.measurement.tool.motion.pose(moment)
            for tool in self._tools:
                tool.wxyz, tool.position = _quaternion(rotation), position
            for name, node in self._video.items():
                node.image = self._picture(name, frame)
            for column, (splats, particles) in zip(self.columns, self._soil, strict=True):
                splats.visible = self.colour.value == GAUSSIANS
                particles.visible = not splats.visible
                if splats.visible:
                    splats.set_gaussians(*self._within(column.splats[frame]))
                else:
                    particles.points = column.positions[frame]
                    particles.colors = self._colours(column.quantities[self.colour.value][frame])
            for node in self._photographs:
                node.visible = self.photographs.value

    def play(self) -> None:
        """Move from frame to frame while the control says so; never returns."""
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
        self.colour = gui.add_dropdown("soil", (GAUSSIANS, *self.limits), visible=bool(self.columns))
        self.picture = gui.add_dropdown("video", PICTURES, visible=bool(self.columns))
        self.photographs = gui.add_checkbox("photographs", not self.columns)
        for control in (self.slider, self.colour, self.picture, self.photographs):
            control.on_update(lambda _: self.show())

    def _add_scene(self) -> None:
        scene, bed, mesh = self.server.scene, self.measurement.bed, self.measurement.tool.mesh
        centre, size = 0.5 * (bed.lower + bed.upper), float(np.linalg.norm(bed.extents[:2]))
        aside = np.array([0.0, 1.2 * bed.extents[1], 0.0])
        middle = centre - 0.5 * max(len(self.columns) - 1, 0) * aside
        scene.set_up_direction("+z")
        self.server.initial_camera.look_at = middle
        self.server.initial_camera.position = middle + size * np.array([-0.3, -1.5, 1.1])
        self._tools: list[Any] = []
        self._soil: list[tuple[Any, Any]] = []
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
                splats = scene.add_gaussian_splats(f"{name}/splats", *self._within(column.splats[first]))
                points, spacing = column.positions[first], column.model.resolution.spacing
                particles = scene.add_point_cloud(
                    f"{name}/particles", points, (0, 0, 0), point_size=spacing, point_shape="circle", visible=False
                )
                self._soil.append((splats, particles))
        self._photographs = [
            self._add_camera(f"/photographs/{k}", view.camera, _small(view), 0.05 * size)
            for k, view in enumerate(self.measurement.views)
        ]
        self._video = {
            name: self._add_camera(f"/video/{name}", camera, self._picture(name, self.frames[0]), 0.12 * size)
            for name, camera in self.measurement.cameras.items()
        }

    def _add_camera(self, name: str, camera: Camera, picture: Bytes, scale: float) -> Any:
        """A frustum with its picture, through which a click looks. That its axis pierces the middle is viser's idea."""
        opencv = camera.camera_to_world[:3, :3] * [1.0, -1.0, -1.0]
        field_of_view, aspect = 2.0 * np.arctan(0.5 * camera.height / camera.fy), camera.width / camera.height
        pose = {"wxyz": _quaternion(opencv), "position": camera.position}
        node = self.server.scene.add_camera_frustum(
            name, float(field_of_view), aspect, scale=scale, thickness=0.01 * scale, image=picture, **pose
        )

        @node.on_click
        def _(event: Any) -> None:
            with event.client.atomic():
                event.client.camera.wxyz, event.client.camera.position = pose["wxyz"], pose["position"]

        return node

    def _picture(self, camera: str, frame: int) -> Bytes:
        if self.columns:
            return self.columns[0].pictures[self.picture.value, camera, frame]
        return _small(self.measurement.video_frame(camera, frame))

    def _within(self, splats: tuple[Floats, ...]) -> tuple[Floats, ...]:
        """Gaussians at the bed alone, where the surroundings of one prediction would cover another."""
        if len(self.columns) == 1:
            return splats
        bed = self.measurement.bed
        slack = 0.05 * bed.extents[:2]
        plan = splats[0][:, :2]
        inside = np.all((plan > bed.lower[:2] - slack) & (plan < bed.upper[:2] + slack), axis=1)
        return tuple(array[inside] for array in splats)

    def _limit(self, name: str) -> float:
        values = np.concatenate([v for column in self.columns for v in column.quantities[name].values()])
        return float(np.quantile(values, QUANTILE)) or 1.0

    def _colours(self, values: Floats) -> Bytes:
        """(n, 3), from dark blue at 0 to yellow at the limit."""
        shares = np.clip(values / self.limits[self.colour.value], 0.0, 1.0)
        return _bytes(matplotlib.colormaps["viridis"](shares)[:, :3])

    def _scale(self) -> str:
        name = self.colour.value
        return f"; {name} from 0 (blue) to {self.limits[name]:.3g} {UNITS[name]} (yellow)" if name in UNITS else ""


def _small(frame: Frame) -> Bytes:
    """A photograph without distortion, no wider than `WIDEST`."""
    picture = Image.fromarray(_bytes(frame.undistorted_image()))
    picture.thumbnail((WIDEST, WIDEST))
    return np.asarray(picture)


def _bytes(colours: npt.NDArray[np.floating]) -> Bytes:
    """Colours in [0, 1] as whole numbers."""
    return np.rint(255.0 * np.clip(colours, 0.0, 1.0)).astype(np.uint8)


def _quaternion(rotation: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_matrix(rotation).as_quat(scalar_first=True))
