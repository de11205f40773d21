"""Simulate-and-compare against a measurement set: the real thing."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatsoil.devices import resolve_device
from splatsoil.parameters import ParameterSpace
from splatsoil.quiet import hush

from .problem import Evaluation, FloatArray, Image

if TYPE_CHECKING:
    from splatsoil.experiment.plow import PlowExperiment
    from splatsoil.measurement import Measurement
    from splatsoil.model import Prediction
    from splatsoil.reconstruction import Reconstruction

#: Name of the loss that is fitted, part of what identifies an evaluation.
LOSS = "robust"
NO_PICTURE: Image = np.full((8, 8, 3), 0.5, dtype=np.float32)


class MeasuredProblem:
    """A model and a measured video.

    Args:
        experiment: predicts, and knows what was observed.
    """

    #: A loss of 1 is as good as predicting that nothing moves; ten times that is cut.
    worst_loss = 10.0

    def __init__(self, experiment: PlowExperiment) -> None:
        self.experiment = experiment
        self.model = experiment.base
        self.space = ParameterSpace(experiment.parameters)
        self.comparator = experiment.comparator
        self._shown = next(((camera, self.comparator.frames[-1]) for camera in self.comparator.cameras), None)

    @classmethod
    def load(
        cls,
        measurement: str | Path,
        parameters: Sequence[str] | None = None,
        effects: Sequence[str] = (),
        *,
        preset: str = "small",
        device: str = "cpu",
        reconstruction: str | Path | None = None,
    ) -> MeasuredProblem:
        """From names and folders, as ``gymnasium.make`` gives them.

        Args:
            measurement: folder of the set.
            parameters: names of the free parameters; None: friction angle and strengths of the effects.
            effects: names of effects that are on.
            preset: resolution of the solver, and of the reconstruction if one has to be made.
            device: ``auto``, ``cpu`` or ``cuda:N``.
            reconstruction: folder of a saved reconstruction; None takes it from the user's cache, and makes it
                (minutes) when it isn't there.

        Raises:
            MeasurementError, ParameterError, RunError: what is wrong, before anything is simulated.
        """
        from splatsoil.experiment.plow import PlowExperiment
        from splatsoil.measurement import Measurement
        from splatsoil.model import Model
        from splatsoil.reconstruction import Reconstruction

        hush()
        device = resolve_device(device)
        measured = Measurement.load(measurement)
        if reconstruction is None:
            scene = cached_reconstruction(measured, preset, device)
        else:
            scene = Reconstruction.load(reconstruction)
        model = Model(measured, scene, effects=effects, preset=preset, device=device)
        return cls(PlowExperiment(model, parameters, candidates=()))

    @property
    def block_count(self) -> int:
        """Length of the block residuals: the experiment's features, row by row."""
        return int(np.prod(self.experiment.layout.shape))

    @property
    def image_size(self) -> tuple[int, int]:
        """(height, width) of the pictures."""
        height, width = self.observed_image().shape[:2]
        return height, width

    def begin(self, seed: int) -> None:
        """Nothing is drawn: the soil is what was measured."""

    def truth(self) -> Mapping[str, float] | None:
        """None: nobody knows it."""
        return None

    def observed_image(self) -> Image:
        """The first camera's last frame; grey where there are no cameras."""
        return NO_PICTURE if self._shown is None else self.comparator.observed[self._shown]

    def evaluate(self, parameters: Mapping[str, float], seed: int) -> Evaluation:
        """Simulate, draw, compare.

        Raises:
            SimulationError: the simulation could not go on.
        """
        from splatsoil.experiment.base import Run

        return self.judge(self.experiment.prediction(Run(parameters, seed=seed)))

    def judge(self, prediction: Prediction) -> Evaluation:
        """A prediction compared with what was measured."""
        experiment = self.experiment
        comparison = self.comparator.compare(prediction.images)
        features = experiment.features_of(comparison.blocks, prediction)
        return Evaluation(
            loss=min(experiment.loss_of(comparison, prediction), self.worst_loss),
            blocks=np.where(experiment.seen, experiment.observed - features, 0.0).reshape(-1),
            extras={} if self._shown is None else {"rgb": comparison.rgb},
            observed=self.observed_image(),
            predicted=NO_PICTURE if self._shown is None else prediction.images[self._shown],
        )

    def features(self, blocks: Sequence[float]) -> FloatArray:
        """(t, s) predicted features of an evaluation with these block residuals, where they are seen."""
        return np.asarray(self.experiment.observed - np.reshape(blocks, self.experiment.layout.shape))


def cache_folder() -> Path:
    """Where reconstructions made for environments are kept: ``SPLATSOIL_CACHE``, or the user's cache folder."""
    chosen = os.environ.get("SPLATSOIL_CACHE")
    if chosen:
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "splatsoil"


def cached_reconstruction(measurement: Measurement, preset: str, device: str) -> Reconstruction:
    """The set's reconstruction with seed 0, made once for a set, a preset and the code that makes it."""
    from splatsoil.files import RECONSTRUCTING, code_digest

    place = cache_folder() / f"{measurement.hash[:16]}-{preset}-{code_digest(RECONSTRUCTING)}"
    return reconstructed(measurement, place, preset, device)


def reconstructed(measurement: Measurement, folder: Path, preset: str, device: str) -> Reconstruction:
    """The set's reconstruction with seed 0, from the folder or made and kept there."""
    from splatsoil.reconstruction import Reconstruction, reconstruct

    if not (folder / "reconstruction.json").is_file():
        reconstruct(measurement, preset=preset, device=device).save(folder)
    return Reconstruction.load(folder)
