"""Training Gaussians on photographs: Adam on L1 and structural similarity, with growth, pruning and shape priors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from splatsoil.errors import SimulationError
from splatsoil.reconstruction.height_field import HeightField
from splatsoil.reconstruction.hidden import reaching_into_soil
from splatsoil.reconstruction.initial import SOIL, SURROUNDINGS
from splatsoil.reconstruction.presets import Preset
from splatsoil.reconstruction.views import Views
from splatsoil.splats import Gaussians, rasterise, ssim
from splatsoil.splats.warp_torch import upload

Report = Callable[[str, float], None]

SIMILARITY = 0.2  # share of 1 − SSIM in the photometric loss, as in Kerbl et al. (2023)
RATES = {"means": 0.02, "scales": 0.01, "quaternions": 0.002, "opacities": 0.05, "colours": 0.005}
# of which `means` counts in the Gaussian's own first size, so that far and near, large beds and small, learn alike
LAST_RATE = 0.1  # of the means' rate, reached exponentially
# Weight of the soil's distance from the measured surface, in its standard deviations. Left alone, centres sink beneath
# the surface that their Gaussians draw: by 0.4 of their spacing on ray-cast scenes, and this keeps them within 0.02.
ANCHOR = 0.02
FLAT = 0.02  # weight of a Gaussian's thickness over its breadth beyond a third
# Weight of what shines through, mean of 1 − alpha: there is something behind every pixel. More costs likeness.
OPEN = 0.02
FAINTEST = 0.02
GROWING = 0.75  # share of the steps after which Gaussians are only dropped


@dataclass(frozen=True)
class Trained:
    """What training leaves.

    Attributes:
        gaussians: the Gaussians.
        label: (n,) int8 of each.
        background: (3,) colour behind them.
        losses: photometric loss of each step.
    """

    gaussians: Gaussians
    label: Tensor
    background: tuple[float, float, float]
    losses: list[float]


COLUMNS = {
    "means": slice(0, 3),
    "scales": slice(3, 6),
    "quaternions": slice(6, 10),
    "opacities": slice(10, 11),
    "colours": slice(11, 14),
}
"""Of what is learnt of a Gaussian: logarithms of its scales, its opacity's logit, the rest as it is."""


class _Optimiser:
    """Adam over Gaussians that may be picked from and added to between steps.

    All numbers of a Gaussian are a row of one tensor, by `COLUMNS`: a GPU waits for every call.
    """

    def __init__(self, gaussians: Gaussians) -> None:
        g = gaussians
        parts = (g.means, g.scales.log(), g.quaternions, torch.logit(g.opacities)[:, None], g.colours)
        self.rows = torch.cat(parts, dim=1)
        self.size = g.scales.amax(dim=1)
        self.first, self.second = torch.zeros_like(self.rows), torch.zeros_like(self.rows)
        self.age = torch.zeros((len(g), 1), device=g.device)

    def gaussians(self) -> Gaussians:
        """The Gaussians, with gradients to `rows`."""
        self.rows.requires_grad_(True)
        self.rows.grad = None
        means, scales, quaternions, opacities, colours = self.rows.split(
            [c.stop - c.start for c in COLUMNS.values()], 1
        )
        return Gaussians(means, scales.exp(), quaternions, torch.sigmoid(opacities[:, 0]), colours)

    def values(self, name: str) -> Tensor:
        """(n, k) columns, to read and to write, without gradients."""
        return self.rows.detach()[:, COLUMNS[name]]

    @torch.no_grad()
    def step(self, rates: dict[str, float]) -> None:
        """One step of Adam (β 0.9, 0.99) with bias correction by each Gaussian's own age."""
        gradient, value = self.rows.grad, self.rows.detach()
        assert gradient is not None
        self.age += 1.0
        self.first.mul_(0.9).add_(gradient, alpha=0.1)
        self.second.mul_(0.99).addcmul_(gradient, gradient, value=0.01)
        mean = self.first / (1.0 - 0.9**self.age)
        spread = self.second.sqrt() / (1.0 - 0.99**self.age).sqrt()
        columns = [rates[name] for name, c in COLUMNS.items() for _ in range(c.start, c.stop)]
        change = mean / (spread + 1e-12) * upload(columns, value.device)
        change[:, COLUMNS["means"]] *= self.size[:, None]
        value -= change
        value[:, COLUMNS["colours"]].clamp_(0.0, 1.0)

    @torch.no_grad()
    def rearrange(self, kept: Tensor, copied: Tensor, changes: dict[str, Tensor]) -> None:
        """Keep the Gaussians of index `kept`, then append those of index `copied` with some of their values changed."""
        order, fresh = torch.cat([kept, copied]), len(kept)
        self.rows, self.first, self.second, self.age, self.size = (
            values.detach()[order] for values in (self.rows, self.first, self.second, self.age, self.size)
        )
        for name, value in changes.items():
            self.rows[fresh:, COLUMNS[name]] = value
        for began in (self.first, self.second, self.age):
            began[fresh:] = 0.0


def train(
    gaussians: Gaussians,
    label: Tensor,
    views: Views,
    surface: HeightField,
    floor: float,
    preset: Preset,
    seed: int,
    report: Report,
) -> Trained:
    """Fit Gaussians to photographs.

    Args:
        gaussians: the first ones; the work is done where they are.
        label: (n,) int8 what each belongs to; the soil's are held near `surface`.
        views: photographs to fit.
        surface: the measured surface and its standard deviations.
        floor: height of the bed's floor, m; from there to the surface there is only soil.
        preset: how many steps, and how many times the first number of Gaussians at most.
        seed: of the order of photographs and of what splitting draws.
        report: called with what is being done and how much of it is done.
    """
    generator, device = torch.Generator().manual_seed(seed), gaussians.device
    photographs = [views.photograph(k).contiguous().to(device) for k in range(len(views))]
    valid = [
        views.valid[k, : camera.height, : camera.width, None].contiguous().to(device)
        for k, camera in enumerate(views.cameras)
    ]
    behind = torch.stack([p.reshape(-1, 3).median(dim=0).values for p in photographs]).median(dim=0).values.cpu()
    background = (float(behind[0]), float(behind[1]), float(behind[2]))
    anchor = _Anchor(surface, device)
    state = _Optimiser(gaussians)
    label = label.to(device)
    most = int(preset.growth * len(gaussians))
    every = max(preset.iterations // 7, 20)
    pull = torch.zeros(len(gaussians), device=device)
    hits = torch.zeros(len(gaussians), device=device)
    losses: list[Tensor] = []
    soil = torch.nonzero(label == SOIL)[:, 0]
    order: list[int] = []
    for step in range(preset.iterations):
        if step % 10 == 0:
            _check(losses)
            report("training Gaussians", step / preset.iterations)
        if not order:
            order = torch.randperm(len(views), generator=generator).tolist()
        k = order.pop()
        current = state.gaussians()
        rendering = rasterise(current, views.cameras[k], background=background, antialias=True)
        rendering.projection.centres.retain_grad()
        difference = (rendering.colour - photographs[k]) * valid[k]
        likeness = ssim(rendering.colour * valid[k], photographs[k] * valid[k])
        loss = (1.0 - SIMILARITY) * difference.abs().mean() + SIMILARITY * (1.0 - likeness)
        losses.append(loss.detach())
        through = ((1.0 - rendering.alpha[..., None]) * valid[k]).mean()
        total = loss + OPEN * through + ANCHOR * anchor(current.means[soil]) + FLAT * _thickness(current.scales)
        total.backward()
        gradient = rendering.projection.centres.grad
        assert gradient is not None
        seen = (rendering.projection.reaches > 0).all(dim=1)
        pull += torch.where(seen, gradient.norm(dim=1), 0.0)
        hits += seen
        progress = step / max(preset.iterations - 1, 1)
        state.step({**RATES, "means": RATES["means"] * LAST_RATE**progress})
        if (step + 1) % every == 0 and progress > 0.1:
            _check(losses)
            stray = _stray(state.gaussians().detach(), label, surface, floor)
            limit = most if progress < GROWING else 0
            label = _grow_and_prune(state, label, pull / hits.clamp_min(1.0), stray, limit, generator)
            soil = torch.nonzero(label == SOIL)[:, 0]
            pull = torch.zeros(len(label), device=device)
            hits = torch.zeros(len(label), device=device)
    _check(losses)
    with torch.no_grad():
        result = state.gaussians().detach()
        kept = result.opacities > FAINTEST
        # Quaternions of length 1 are what every reader of the file expects.
        unit = result.replace(quaternions=torch.nn.functional.normalize(result.quaternions, dim=1))
    report("training Gaussians", 1.0)
    return Trained(unit[kept].to("cpu"), label[kept].to("cpu"), background, torch.stack(losses).tolist())


def _check(losses: list[Tensor]) -> None:
    """Now and then: to ask for a number is to wait for a GPU.

    Raises:
        SimulationError: one is not finite.
    """
    if not losses:
        return
    lost = torch.nonzero(~torch.isfinite(torch.stack(losses[-10:])))
    if len(lost):
        step = max(len(losses) - 10, 0) + int(lost[0])
        raise SimulationError(f"training fell apart at step {step}: the loss is {losses[step]:g}; try another seed")


def _thickness(scales: Tensor) -> Tensor:
    ordered = scales.sort(dim=1).values
    return torch.relu(ordered[:, 0] / ordered[:, 1] - 1.0 / 3.0).mean()


class _Anchor:
    """Mean squared distance of points from a surface along z in standard deviations, bounded for strays."""

    def __init__(self, surface: HeightField, device: torch.device) -> None:
        spread = np.full_like(surface.height, min(surface.cell)) if surface.deviation is None else surface.deviation
        # Half a cell at least: discs are that coarse, and the photographs may know better than stereo did.
        spread = np.maximum(spread, 0.25 * min(surface.cell))
        self.map = torch.tensor(np.stack([surface.height, spread]), dtype=torch.float32, device=device)[None]
        cell = np.array(surface.cell)
        low = np.array([surface.x[0], surface.y[0]]) - cell / 2
        high = np.array([surface.x[-1], surface.y[-1]]) + cell / 2
        self.low = torch.tensor(low, dtype=torch.float32, device=device)
        self.scale = torch.tensor(2.0 / (high - low), dtype=torch.float32, device=device)

    def __call__(self, points: Tensor) -> Tensor:
        if len(points) == 0:
            return points.sum()
        where = (points[:, :2] - self.low) * self.scale - 1.0
        value = torch.nn.functional.grid_sample(
            self.map, where[None, None], mode="bilinear", padding_mode="border", align_corners=False
        )[0, :, 0]
        away = (points[:, 2] - value[0]) / value[1]
        return (away**2 / (1.0 + away**2 / 25.0)).mean()


def _stray(gaussians: Gaussians, label: Tensor, surface: HeightField, floor: float) -> Tensor:
    """Which (n,) are of the surroundings and reach into the soil: others are to take their place outside."""
    out = torch.zeros(len(label), dtype=torch.bool, device=label.device)
    around = torch.nonzero(label == SURROUNDINGS)[:, 0]
    out[around] = reaching_into_soil(gaussians[around], surface, floor)
    return out


@torch.no_grad()
def _grow_and_prune(
    state: _Optimiser, label: Tensor, pull: Tensor, stray: Tensor, most: int, generator: torch.Generator
) -> Tensor:
    """Split the Gaussians that the pictures pull hardest on, drop the faint and the stray; the new labels."""
    opacity = torch.sigmoid(state.values("opacities")[:, 0])
    visible = (opacity > FAINTEST) & ~stray
    room = most - int(visible.sum())
    share = min(max(room, 0), int(0.08 * len(pull)))
    threshold = pull[visible].sort(descending=True).values[share] if share else torch.inf
    split = torch.nonzero(visible & (pull > threshold))[:, 0]
    # Of a split Gaussian's two halves one stays in its place in the list; both move apart along its longest axis.
    whole = state.gaussians().detach()[split]
    longest = whole.scales.argmax(dim=1)
    axis = whole.rotations().gather(2, longest[:, None, None].expand(-1, 3, 1))[:, :, 0]
    away = 0.7 + 0.2 * torch.rand(len(split), generator=generator).to(axis)
    offset = axis * (away * whole.scales.amax(dim=1))[:, None]
    scales = state.values("scales")[split]
    narrowed = scales.scatter_add(1, longest[:, None], torch.full((len(split), 1), -0.6).to(scales))
    state.values("means").index_copy_(0, split, whole.means - offset)
    state.values("scales").index_copy_(0, split, narrowed)
    kept = torch.nonzero(visible)[:, 0]
    state.rearrange(kept, split, {"means": whole.means + offset, "scales": narrowed})
    return torch.cat([label[kept], label[split]])
