"""The free strength of a diagnosis that ends outside the library: friction over what the soil went through."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from splatsoil.report.figures import ACCENT, FAINT, SIZE, _draw

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AXES = {"pressure": "pressure [Pa]", "inertial number": "inertial number", "plastic strain": "plastic shear strain"}


def curve(shape: Mapping[str, Any]) -> str:
    """One argument's curve with its 5 to 95 % band; nothing is drawn beyond what the soil went through."""
    at, factor, low, high = (np.array(shape[key], dtype=np.float64) for key in ("at", "factor", "low", "high"))

    def draw(_: Figure, axes: Axes) -> None:
        axes.fill_between(at, low, high, color=ACCENT, alpha=0.18, linewidth=0, label="5 to 95 %")
        axes.plot(at, factor, color=ACCENT, label="friction over its mean")
        axes.axhline(1.0, color=FAINT, linestyle="--", linewidth=1.0)
        if shape["argument"] != "plastic strain":
            axes.set_xscale("log")
        axes.set_xlim(float(at[0]), float(at[-1]))
        axes.set_xlabel(AXES.get(str(shape["argument"]), str(shape["argument"])))
        axes.set_ylabel("× friction")
        axes.legend(fontsize=8)

    return _draw(draw, (SIZE[0], 2.2))
