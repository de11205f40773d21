"""Camera pose: a fixed video camera stands differently from its calibration: it was bumped, or badly surveyed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from splatsoil.measurement import Measurement
from splatsoil.observation import CameraShift, Observation
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect

_TURNS = {"pan": "turn to the right", "tilt": "turn upwards", "roll": "turn clockwise"}
_SHIFTS = {"right": "shift to the right", "up": "shift upwards", "forward": "shift forwards"}


def pose_parameters(cameras: Sequence[str]) -> tuple[Parameter, ...]:
    """Six parameters for each of the named cameras, in their own axes; the parameters' names count cameras from 1."""
    found: list[Parameter] = []
    for number, camera in enumerate(cameras, start=1):
        for name, what in _TURNS.items():
            label = f"camera {camera}: {what}"
            found.append(
                Parameter(f"camera_{number}_{name}", "deg", -2.0, 2.0, 0.0, off=0.0, meaningful=0.05, label=label)
            )
        for name, what in _SHIFTS.items():
            label = f"camera {camera}: {what}"
            found.append(
                Parameter(f"camera_{number}_{name}", "m", -0.03, 0.03, 0.0, off=0.0, meaningful=0.001, label=label)
            )
    return tuple(found)


class CameraPose(Effect):
    """Turns and shifts every video camera by itself, for the whole video.

    A bumped camera is usually one of several, so each has six numbers of its own. A turn and a shift across the view
    look alike up to the parallax between near and far soil; both are there because that parallax is what could pass for
    soil that moved otherwise.
    """

    name = "camera_pose"
    parameters = pose_parameters(["1"])
    note = (
        "A video camera stands turned or shifted against its calibration, from before frame 0 to the end; "
        "the simulation does not change. A measurement set with several cameras has these parameters for each."
    )
    source = "rigid motion of a pinhole camera: Hartley & Zisserman (2004), Multiple View Geometry, sec. 6.1"

    def for_measurement(self, measurement: Measurement) -> Effect:
        """The effect with six parameters for each camera of the video."""
        found = pose_parameters(list(measurement.cameras))

        class OfMeasurement(CameraPose):
            parameters = found

        return OfMeasurement()

    def observe(self, observation: Observation, values: Mapping[str, float]) -> Observation:
        """Add turns and shifts to those of each camera."""
        cameras = list(observation.cameras)
        cameras += [CameraShift()] * (len(self.parameters) // 6 - len(cameras))
        for k in range(len(self.parameters) // 6):
            change = {name: values[f"camera_{k + 1}_{name}"] for name in (*_TURNS, *_SHIFTS)}
            cameras[k] = replace(cameras[k], **{n: getattr(cameras[k], n) + v for n, v in change.items()})
        return replace(observation, cameras=tuple(cameras))
