"""Base classes of laboratory tests: instruments without a place, read over a strain or a depth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from splatsoil.arrays import FloatArray
from splatsoil.errors import ParameterError, SimulationError
from splatsoil.experiment.base import Run, candidates_of
from splatsoil.experiment.features import Layout, Site
from splatsoil.parameters import Parameter
from splatsoil.soil.effect import Effect
from splatsoil.soil.law import Law
from splatsoil.soil.library import find_effects, library
from splatsoil.soil.packing import at_void_ratio

MEMORY = 0.8
"""Correlation of neighbouring readings: the deviation of a specimen persists."""
SLOW = 1.0e-5
"""Strain rate of a laboratory test, 1/s."""
ONE_ANGLE = {"intermediate_share": 1.0}
"""Parameters that are not fitted: the friction angle has the same meaning in every test, see `intermediate_stress`."""


class LaboratoryExperiment(ABC):
    """A test without cameras, and a model of it: an :class:`~splatsoil.experiment.base.Experiment`.

    Attributes:
        kind: of the test, as in ``experiment.json``.
        always: effects that are on in every model of such a test.
        of_strength: whether the measurement depends only on effects on strength.
        known: parameters from other tests, by name; they are not fitted.
    """

    kind: ClassVar[str]
    always: ClassVar[tuple[str, ...]] = ("intermediate_stress",)
    of_strength: ClassVar[bool] = False
    stochastic: bool = False
    sensor_memory: float = MEMORY
    discretisations: tuple[str, ...] = ()
    renderings: tuple[str, ...] = ()
    albedo_draws: tuple[str, ...] = ()

    def __init__(
        self,
        name: str,
        effects: Iterable[str | Effect],
        candidates: Iterable[str | Effect] | None,
        known: Mapping[str, float] | None = None,
    ) -> None:
        self.name = name
        chosen = find_effects(effects)
        on = (*(e for e in find_effects(self.always) if e.name not in {c.name for c in chosen}), *chosen)
        law = Law(on)
        self.model = tuple(effect.name for effect in on)
        names = {p.name for p in law.parameters}
        self.known = {name: v for name, v in {**ONE_ANGLE, **(known or {})}.items() if name in names}
        shapes = {shape for effect in on for shape in effect.shapes}
        self.parameters: tuple[Parameter, ...] = tuple(
            p
            for p in law.parameters
            if (p.off is not None or p.name == "friction_angle" or p.name in shapes) and p.name not in self.known
        )
        wanted = tuple(library().values()) if candidates is None else find_effects(candidates)
        self._known = {effect.name: effect for effect in (*wanted, *on)}
        self.candidates = candidates_of((e for e in wanted if self.acts(e)), on)

    def acts(self, effect: Effect) -> bool:
        """Whether an effect can change the measurement."""
        return effect.strength is not None if self.of_strength else not (effect.numerical or effect.observes)

    def law(self, effects: Iterable[str]) -> Law:
        """The model's law with further effects on."""
        return Law(self._known[name] for name in dict.fromkeys((*self.model, *effects)))

    def values(self, values: Mapping[str, float]) -> dict[str, float]:
        """All parameters of the model, including those that are not fitted."""
        return {**self.known, **values}

    def _set_observation(
        self,
        observed: FloatArray,
        sensor: FloatArray,
        times: npt.ArrayLike,
        time_name: str,
        unit: str,
        channels: Sequence[str],
        region: str,
    ) -> None:
        """Set features (t, s) and their standard deviations (t, s); the stages are the halves of the test."""
        along = np.asarray(times, dtype=np.float64).reshape(-1)
        middle = 0.5 * float(along[-1])
        self.layout = Layout(
            times=tuple(float(t) for t in along),
            sites=tuple(Site(channel) for channel in channels),
            time_name=time_name,
            unit=unit,
            stages=tuple("first half" if t <= middle else "second half" for t in along),
            regions=np.full((len(along), len(channels)), region),
        )
        self.observed, self.sensor = observed, sensor
        self.seen = np.ones(self.layout.shape, dtype=bool)
        self.quiet = np.zeros(self.layout.shape, dtype=bool)

    @abstractmethod
    def readings(self, run: Run) -> FloatArray:
        """(t, s) predicted readings in SI units."""

    @abstractmethod
    def features(self, readings: FloatArray) -> FloatArray:
        """(t, s) features of readings (t, s)."""

    def predict(self, run: Run) -> FloatArray:
        """(t, s) features; see :class:`~splatsoil.experiment.base.Experiment`."""
        return self.features(self.readings(run))


@dataclass(frozen=True, eq=False)
class Specimen:
    """A measured test of one specimen; compression is positive.

    Attributes:
        name: of the test.
        strain: (n,) nominal axial strain, or displacement over height.
        volume: (n,) nominal volume strain, or loss of height over height.
        ratio: (n,) q/p, or shear over normal stress.
        stress: confining, or normal stress, Pa.
        void_ratio: at the start.
        strain_rate: 1/s.
    """

    name: str
    strain: FloatArray
    volume: FloatArray
    ratio: FloatArray
    stress: float
    void_ratio: float = 0.8
    strain_rate: float = SLOW


class SpecimenExperiment(LaboratoryExperiment):
    """Tests of specimens of one soil, and a model of it: the law at a single point; deterministic.

    Features are the stress ratio and the volume strain, each in units of its spread between specimens. The elastic
    stiffness is a parameter of the model. Parameters refer to the first test's void ratio,
    see :func:`~splatsoil.soil.packing.at_void_ratio`.

    Args:
        tests: of one soil, at the same strains.
        effects: that are on.
        candidates: effects to consider; all that act on strength by default.
        known: parameters that are not fitted, at the first test's void ratio.

    Attributes:
        spreads: of the stress ratio and of the volume strain between specimens.
        strain_name: name of the strain, in %.

    Raises:
        ParameterError: tests whose strains differ.
    """

    always = (*LaboratoryExperiment.always, "stiffness")
    of_strength = True
    spreads: ClassVar[tuple[float, float]]
    strain_name: ClassVar[str]

    def __init__(
        self,
        tests: Sequence[Specimen],
        effects: Iterable[str | Effect] = (),
        *,
        candidates: Iterable[str | Effect] | None = None,
        known: Mapping[str, float] | None = None,
    ) -> None:
        self.tests = tuple(tests)
        if not self.tests or any(not np.array_equal(t.strain, self.tests[0].strain) for t in self.tests):
            raise ParameterError(f"{self.kind}: tests of one soil need the same strains; interpolate their curves")
        super().__init__(", ".join(t.name for t in self.tests), effects, candidates, known)
        observed = self.features(np.concatenate([np.stack([t.ratio, t.volume], axis=1) for t in self.tests], axis=1))
        names = [f", {t.name}" for t in self.tests] if len(self.tests) > 1 else [""]
        self._set_observation(
            observed,
            np.ones_like(observed),
            100.0 * self.tests[0].strain,
            self.strain_name,
            "spreads between specimens",
            [f"{what}{name}" for name in names for what in ("stress ratio", "volume strain")],
            "specimen",
        )

    @abstractmethod
    def tested(self, law: Law, values: Mapping[str, float], test: Specimen) -> tuple[FloatArray, FloatArray]:
        """Stress ratio (t,) and logarithmic volume strain (t,), compression positive, of one test."""

    def readings(self, run: Run) -> FloatArray:
        """(t, 2 tests) stress ratio and nominal volume strain; the test is deterministic."""
        law, out = self.law(run.effects), []
        for test in self.tests:
            own = at_void_ratio(self.values(run.values), self.tests[0].void_ratio, test.void_ratio)
            ratio, volume = self.tested(law, own, test)
            if not np.all(np.isfinite(ratio)):
                raise SimulationError(f"the {self.kind} test with {dict(run.values)} gave no finite stress")
            out += [ratio, 1.0 - np.exp(-volume)]
        return np.stack(out, axis=1)

    def features(self, readings: FloatArray) -> FloatArray:
        """Readings in units of their spread."""
        return readings / np.tile(self.spreads, len(self.tests))
