"""The result of a reconstruction, in memory and on disk."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

from splatsoil.errors import RunError, SetWarning
from splatsoil.files import check_unpacked, read_json, write_bytes, write_json, write_npz
from splatsoil.measurement import BIN
from splatsoil.reconstruction.height_field import HeightField
from splatsoil.run_files import RECONSTRUCTION_FORMAT
from splatsoil.splats import Gaussians, save_ply

FILES = ("reconstruction.json", "gaussians.npz", "gaussians.ply", "surface.npz", "soil.ply")


@dataclass(frozen=True)
class HeldOut:
    """How well one photograph that training never saw is predicted.

    Attributes:
        name: the photograph's file name.
        psnr: peak signal-to-noise ratio, dB.
        ssim: structural similarity, 1 is perfect.
        displaced: PSNR between what is drawn and the same with the scene a cell of the simulation higher, dB.
    """

    name: str
    psnr: float
    ssim: float
    displaced: float


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The scene before anything moves.

    Attributes:
        gaussians: everything that was seen, float32 on the CPU, world frame in metres, colours in sRGB as seen;
            trained with ``antialias=True``, and to be drawn so.
        soil: (n,) bool, the Gaussians on the soil's surface, and on its sides where these are seen.
        tool: (n,) bool, those on the tool at its first pose.
        surface: the soil's surface over the bed's box.
        mesh: the soil as a watertight solid between the box's sides, floor and surface.
        background: (3,) sRGB colour behind all Gaussians.
        held_out: one entry a photograph that was set aside.
        metadata: what made it (version, preset, seed, device, measurement hash, …).
        seconds: how long it took.
    """

    gaussians: Gaussians
    soil: torch.Tensor
    tool: torch.Tensor
    surface: HeightField
    mesh: trimesh.Trimesh
    background: tuple[float, float, float]
    held_out: tuple[HeldOut, ...]
    metadata: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def surroundings(self) -> torch.Tensor:
        """(n,) bool, the Gaussians that belong neither to the soil nor to the tool."""
        return ~(self.soil | self.tool)

    @property
    def standing(self) -> Gaussians:
        """The Gaussians of the surroundings, which stay when soil and tool move."""
        return self.gaussians[self.surroundings]

    @property
    def container(self) -> str:
        """What holds the soil, see `measurement.Bed`; where the set doesn't say, what photographs show."""
        return str(self.metadata.get("container", BIN))

    @property
    def psnr(self) -> float:
        """Mean over the photographs that were set aside, dB; NaN if there are none."""
        return float(np.mean([view.psnr for view in self.held_out])) if self.held_out else float("nan")

    @property
    def ssim(self) -> float:
        """Mean over the photographs that were set aside; NaN if there are none."""
        return float(np.mean([view.ssim for view in self.held_out])) if self.held_out else float("nan")

    @property
    def fault(self) -> str:
        """Why photographs that were set aside rule the reconstruction out, in one clause; empty where they do not.

        They must be predicted better than an error of a cell of the simulation, which is what it resolves, would allow.
        """
        if not self.held_out:
            return ""
        displaced = float(np.mean([view.displaced for view in self.held_out]))
        if not self.psnr < displaced:
            return ""
        cell = 1e3 * float(self.metadata["simulation_cell"])
        return (
            f"photographs set aside are predicted to {self.psnr:.1f} dB only, as if the soil lay more than a cell of"
            f" the simulation ({cell:.3g} mm, {displaced:.1f} dB) from where it is; poses or lenses of the views are"
            " wrong, or photographs are blurred or of different scenes"
        )

    def say_remarks(self) -> None:
        """Warn of what was odd about the set when it was reconstructed."""
        for text in self.metadata.get("remarks", ()):
            warnings.warn(text, SetWarning, stacklevel=3)

    def summary(self) -> dict[str, Any]:
        """The numbers, in JSON's types: without photographs set aside there is no PSNR, and it is None."""
        return {
            "format": RECONSTRUCTION_FORMAT,
            **self.metadata,
            "seconds": self.seconds,
            "gaussians": len(self.gaussians),
            "soil_gaussians": int(self.soil.sum()),
            "tool_gaussians": int(self.tool.sum()),
            "background": list(self.background),
            "psnr": self.psnr if self.held_out else None,
            "ssim": self.ssim if self.held_out else None,
            "held_out": [asdict(view) for view in self.held_out],
            "surface": {
                "cells": [len(self.surface.x), len(self.surface.y)],
                "cell": list(self.surface.cell),
                "lowest": float(self.surface.height.min()),
                "highest": float(self.surface.height.max()),
            },
        }

    def save(self, folder: str | Path) -> Path:
        """Write the files of `FILES` into a folder, each whole or not at all; reconstruction.json comes last.

        Raises:
            RunError: the folder cannot be written to.
        """
        target = Path(folder)
        g = self.gaussians.detach().to("cpu")
        write_npz(target / "gaussians.npz", **vars(g), soil=self.soil, tool=self.tool)
        write_npz(target / "surface.npz", **{k: v for k, v in vars(self.surface).items() if v is not None})
        write_bytes(target / "soil.ply", trimesh.exchange.ply.export_ply(self.mesh))
        _whole_ply(target / "gaussians.ply", g)
        write_json(target / "reconstruction.json", self.summary())
        return target

    @classmethod
    def load(cls, folder: str | Path) -> Reconstruction:
        """Read what `save` wrote, and warn again of what was odd about the set.

        Raises:
            RunError: a file is missing, damaged or of another format.
        """
        source = Path(folder)
        facts = read_json(source / "reconstruction.json")
        if not isinstance(facts, dict) or facts.get("format") != RECONSTRUCTION_FORMAT:
            raise RunError(
                f"{source / 'reconstruction.json'}: is not of the format {RECONSTRUCTION_FORMAT}; reconstruct again"
            )
        try:
            tensors = {name: torch.from_numpy(array) for name, array in _load_npz(source / "gaussians.npz").items()}
            soil, tool = tensors.pop("soil"), tensors.pop("tool")
            red, green, blue = facts["background"]
            out = cls(
                gaussians=Gaussians(**tensors),
                soil=soil,
                tool=tool,
                surface=HeightField(**_load_npz(source / "surface.npz")),
                mesh=trimesh.load_mesh(source / "soil.ply", process=False),
                background=(float(red), float(green), float(blue)),
                held_out=tuple(
                    HeldOut(v["name"], *(_number(v.get(key)) for key in ("psnr", "ssim", "displaced")))
                    for v in facts["held_out"]
                ),
                seconds=float(facts["seconds"]),
            )
            out = replace(out, metadata={k: v for k, v in facts.items() if k not in out.summary()})
        except (OSError, KeyError, TypeError, ValueError, BadZipFile) as error:
            raise RunError(f"{source}: the reconstruction cannot be read ({error}); reconstruct again") from error
        out.say_remarks()
        return out


def _number(value: float | None) -> float:
    """JSON has no NaN and no infinity; they were written as null."""
    return float("nan") if value is None else float(value)


def _load_npz(path: Path) -> dict[str, NDArray[Any]]:
    check_unpacked(path)
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def _whole_ply(path: Path, gaussians: Gaussians) -> None:
    """`save_ply` writes to a path of its own; move the finished file into place."""
    beside = path.with_name(f".{path.name}.tmp")
    try:
        save_ply(beside, gaussians)
        beside.replace(path)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror}); free some space and try again") from error
    finally:
        beside.unlink(missing_ok=True)
