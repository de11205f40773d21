"""What the command line does, in Python: ``import splatsoil as ss``.

Each function is the command of the same name, with its options as keywords, and keeps what it finds in the same files.
Results are read from these. What is wrong, missing or damaged is a `splatsoil.errors.SplatsoilError`, one sentence
each: MeasurementError of a set, ParameterError of an option, RunError of a run folder, SimulationError, and NoAnswer
where all is kept and means nothing. docs/api.md has a quick start.
"""

from __future__ import annotations

import dataclasses
import importlib
import io
import json
import webbrowser
from collections.abc import Iterable, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from splatsoil.errors import RunError

if TYPE_CHECKING:
    import arviz
    import numpy as np
    import numpy.typing as npt
    import xarray

    from splatsoil.measurement import Measurement, Remark
    from splatsoil.reconstruction import Reconstruction
    from splatsoil.report.data import RunData

PathLike = str | Path
Preset = Literal["tiny", "small", "paper", "fine"]


@dataclass(frozen=True)
class Estimate:
    """A parameter.

    Attributes:
        value: posterior mean, in ``unit``.
        std: posterior standard deviation, in ``unit``.
        unit: "deg", "Pa", …; "1" for none.
        determined: False where the data leave it as open as the bounds of its range do.
    """

    value: float
    std: float
    unit: str
    determined: bool


@dataclass(frozen=True)
class Run:
    """A run folder: what `fit`, `run` and `open_run` return.

    Attributes:
        path: the folder. Its files are described in docs/fit.md.
    """

    path: Path

    @property
    def data(self) -> RunData:
        """The contents of the folder's files, read anew each time."""
        from splatsoil.report.data import load

        return load(self.path)

    @property
    def estimates(self) -> dict[str, Estimate]:
        """The latest fit's parameters by name: averaged over models where the fit has been compared or diagnosed."""
        from splatsoil.report.text import averaged

        data = self.data
        better = averaged(data.fit, data.judged)
        return {
            name: Estimate(better[name]["value"], better[name]["std"], p["unit"], better[name]["determined"])
            if name in better
            else Estimate(p["estimate"], p["std"], p["unit"], p["determined"])
            for name, p in data.fit["parameters"].items()
        }

    @property
    def adequate(self) -> bool | None:
        """Whether the latest fit's model explains the data; None before `compare` or `diagnose`."""
        from splatsoil.report.text import called_adequate

        data = self.data
        return called_adequate(data.fit, data.judged)

    @property
    def probabilities(self) -> dict[str, float]:
        """Probability of each model that the latest diagnosis compared: "" as it is, an effect more, "something
        else"."""
        diagnosis = self.data.diagnosis
        if diagnosis is None:
            raise RunError(f"{self.path}: there is no diagnosis of its model yet; diagnose() makes one")
        return {model["name"]: float(model["probability"]) for model in diagnosis["models"]}

    @property
    def posterior(self) -> arviz.InferenceData:
        """Samples of the latest fit's posterior, once it was sampled."""
        file = self.path / "posterior" / "posterior.nc"
        if self.data.posterior is None or not file.is_file():
            raise RunError(f"{self.path}: the posterior of its latest fit has not been sampled yet; sample() does")
        import arviz

        return arviz.from_netcdf(str(file), engine="h5netcdf")

    @property
    def evaluations(self) -> xarray.Dataset:
        """Simulations of the latest fit over ``step``: its parameters in their units, ``loss`` (NaN where one
        failed), and ``seed`` of the particles."""
        import xarray

        fit = self.data.fit
        records = fit["history"]
        columns: dict[str, Any] = {name: [r["parameters"][name] for r in records] for name in fit["parameters"]}
        columns["loss"] = _numbers(r["loss"] for r in records)
        columns["seed"] = [r["seed"] for r in records]
        out = xarray.Dataset({n: ("step", v) for n, v in columns.items()}, {"step": [r["step"] for r in records]})
        for name, parameter in fit["parameters"].items():
            out[name].attrs["units"] = parameter["unit"]
        return out

    @property
    def force(self) -> xarray.Dataset:
        """Force on the tool around each compared frame: ``measured`` and ``predicted`` (channel, frame) in N, NaN where
        it was not measured; once the run was compared."""
        import xarray

        comparison = self.data.comparison
        record = None if comparison is None else comparison["force"]
        if record is None:
            raise RunError(f"{self.path}: there is no comparison with a measured force; compare() makes it")
        coordinates = {"channel": [c["channel"] for c in record["channels"]], "frame": record["frames"]}
        sides = ("measured", "predicted")
        table = {k: (("channel", "frame"), [_numbers(c[k]) for c in record["channels"]]) for k in sides}
        return xarray.Dataset(table, coordinates, {"units": record["unit"]})

    @property
    def surface(self) -> xarray.DataArray:
        """Height (y, x) in m of the reconstructed soil surface before anything moves; coordinates in m."""
        import xarray

        surface = self.data.surface
        if surface is None:
            raise RunError(f"{self.path}: holds no reconstruction; fit() makes one")
        return xarray.DataArray(
            surface.height, {"y": surface.y, "x": surface.x}, ("y", "x"), name="height", attrs={"units": "m"}
        )

    def picture(
        self, camera: str, frame: int, kind: Literal["observed", "predicted", "difference"]
    ) -> npt.NDArray[np.uint8]:
        """(h, w, 3) sRGB of a compared frame."""
        import numpy as np
        from PIL import Image

        from splatsoil.report.data import read_picture

        file = self.path / "comparison" / f"{camera}_{frame:04d}_{kind}.jpg"
        if self.data.comparison is None or not file.is_file():
            raise RunError(f"{file}: there is no such picture; compare() draws those of all compared frames")
        return np.asarray(Image.open(io.BytesIO(read_picture(file)[0])).convert("RGB"))

    def compare(self, **options: Any) -> Run:
        """`compare` of this run."""
        return compare(self, **options)

    def diagnose(self, effects: Iterable[str] = (), **options: Any) -> Run:
        """`diagnose` of this run."""
        return diagnose(self, effects, **options)

    def add(self, *effects: str, **options: Any) -> Run:
        """`add` to this run."""
        return add(self, *effects, **options)

    def sample(self, **options: Any) -> Run:
        """`sample` of this run."""
        return sample(self, **options)

    def report(self) -> Path:
        """Write the page ``report.html``, and return its path."""
        return write_report(self)

    def show(self) -> None:
        """Write the page and open it in a browser."""
        webbrowser.open(self.report().resolve().as_uri())


def load(folder: PathLike) -> Measurement:
    """Read and validate a measurement set; MeasurementError names file and field of what is wrong."""
    from splatsoil.measurement import Measurement

    return Measurement.load(folder)


def check(folder: PathLike) -> tuple[Remark, ...]:
    """What is odd about a measurement set; nothing where it is consistent. MeasurementError where it can't be used."""
    from splatsoil.measurement import remarks

    return remarks(load(folder))


def simulate(
    out: PathLike,
    *,
    friction_angle: float = 35.0,
    effects: Iterable[str] = (),
    values: Mapping[str, float] | None = None,
    preset: Preset = "small",
    seed: int = 0,
    device: str = "cpu",
    views: int | None = None,
    picture_scale: float = 1.0,
) -> Measurement:
    """Make a synthetic measurement set of known soil in a new folder; ``truth.json`` has the parameters.

    Args:
        out: the new folder.
        friction_angle: degrees.
        effects: that act, by name or from files.
        values: their parameters by name, in the units of docs/effects.md.
        preset: resolution.
        seed: of surface, appearance and noise.
        device: "cpu", "cuda:0", …
        views: photographs; 40 if not given.
        picture_scale: size of pictures, as a multiple of 320 x 240 pixels.
    """
    pairs = tuple(f"{name}={float(value)!r}" for name, value in (values or {}).items())
    options = {"friction_angle": friction_angle, "effects": tuple(effects), "values": pairs, "preset": preset}
    others = {"seed": seed, "device": device, "views": views, "picture_scale": picture_scale}
    _command("simulate", out=Path(out), **options, **others)
    return load(out)


def reconstruct(
    folder: PathLike, out: PathLike | None = None, *, preset: Preset = "small", seed: int = 0, device: str = "auto"
) -> Reconstruction:
    """Photographs to Gaussians, soil surface and mesh, written to ``out`` (runs/NAME-reconstruction if not given)."""
    from splatsoil.reconstruction import Reconstruction

    options = {"out": None if out is None else Path(out), "preset": preset, "seed": seed, "device": device}
    return Reconstruction.load(_command("reconstruct", set=Path(folder), **options)["out"])


def fit(
    folder: PathLike,
    *,
    parameters: Iterable[str] = (),
    effects: Iterable[str] = (),
    preset: Preset = "small",
    device: str = "auto",
    seed: int = 0,
    budget: int | None = None,
    run: PathLike | None = None,
) -> Run:
    """Estimate the parameters, with their uncertainty. A fit that was interrupted goes on.

    Args:
        folder: the measurement set.
        parameters: free ones; the friction angle and those of ``effects`` if not given.
        effects: of the model, by name or from files.
        preset: resolution.
        device: "auto", "cpu", "cuda:0", …
        seed: of random numbers.
        budget: evaluations; 10 for each free parameter if not given.
        run: folder of the run; runs/NAME-PRESET if not given.
    """
    return _run("fit", folder, parameters, effects, run, preset=preset, device=device, seed=seed, budget=budget)


def run(
    folder: PathLike,
    *,
    parameters: Iterable[str] = (),
    effects: Iterable[str] = (),
    preset: Preset = "small",
    device: str = "auto",
    seed: int = 0,
    budget: int | None = None,
    most_effects: int = 2,
    run: PathLike | None = None,
) -> Run:
    """From a set to the report: check, reconstruct, fit, compare, and name and add what the model lacks.

    As for `fit`; ``most_effects`` is the largest number of effects that are added.
    """
    options = {"preset": preset, "device": device, "seed": seed, "budget": budget, "most_effects": most_effects}
    return _run("run", folder, parameters, effects, run, **options)


def open_run(folder: PathLike) -> Run:
    """A run folder that is there already; RunError where it is none."""
    from splatsoil.run_files import read_description

    read_description(Path(folder))
    return Run(Path(folder))


def compare(run: Run | PathLike, *, quick: bool = False, device: str = "auto") -> Run:
    """Test whether the fitted model is adequate, and where and when it fails; ``quick`` only draws and measures
    losses."""
    return _of("compare", run, quick=quick, device=device)


def diagnose(run: Run | PathLike, effects: Iterable[str] = (), *, device: str = "auto") -> Run:
    """Name the effect that the model lacks, with its probability; ``effects`` are those to consider, all by default."""
    return _of("diagnose", run, effects=tuple(effects), device=device)


def add(run: Run | PathLike, *effects: str, budget: int | None = None, device: str = "auto") -> Run:
    """Add effects to the model, and fit again."""
    return _of("add", run, effects=effects, budget=budget, device=device)


def sample(run: Run | PathLike, *, checks: int = 3, seed: int = 0, device: str = "auto") -> Run:
    """Sample the posterior, for `Run.posterior`; ``checks`` simulations test the emulator."""
    return _of("posterior", run, checks=checks, seed=seed, device=device)


def write_report(run: Run | PathLike) -> Path:
    """Write the page ``report.html`` of a run, and return its path."""
    from splatsoil.report import write_report as write

    return write(_path(run))


def _run(
    command: str,
    folder: PathLike,
    parameters: Iterable[str],
    effects: Iterable[str],
    run: PathLike | None,
    **options: Any,
) -> Run:
    given = {"parameters": tuple(parameters), "effects": tuple(effects), "run": None if run is None else Path(run)}
    return Run(Path(_command(command, set=Path(folder), **given, **options)["run"]))


def _of(command: str, run: Run | PathLike, **options: Any) -> Run:
    _command(command, run=_path(run), **options)
    return Run(_path(run))


def _numbers(column: Iterable[float | None]) -> list[float]:
    return [float("nan") if value is None else value for value in column]


def _path(run: Run | PathLike) -> Path:
    return run.path if isinstance(run, Run) else Path(run)


def _command(name: str, **options: Any) -> dict[str, Any]:
    """The JSON object that a command prints."""
    module = importlib.import_module(f"splatsoil.commands.{name}")
    known = {field.name for field in dataclasses.fields(module.Config)}
    unknown = sorted(set(options) - known)
    if unknown:
        raise TypeError(f"{name}() got an unexpected keyword argument {unknown[0]!r}")
    with redirect_stdout(io.StringIO()) as printed:
        module.run(module.Config(**options, json=True))
    return dict(json.loads(printed.getvalue()))
