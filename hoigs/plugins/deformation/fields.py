"""What coordinate fields share: encodings, a network, and offsets of Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import normalize_quats
from hoigs.core.maths.splines import neighbours
from hoigs.core.values.gaussians import GaussianDelta, Gaussians
from hoigs.core.values.tokens import Residual

Head = Literal["means", "scales", "rotations", "opacity", "sh"]
Space = Literal["raw", "activated"]
Turning = Literal["composed", "added"]
FIELDS = {
    "means": "means",
    "scales": "log_scales",
    "rotations": "quats",
    "opacity": "opacity_logits",
    "sh": "sh",
}


class DeltaHeads(nn.Module):
    """Linear(F, W) (ReLU Linear)^(D-1), then ReLU Linear(W, W) ReLU Linear(W, k) for each head.

    All weights start Xavier-uniform, so the deformation starts small but not at zero (4DGS,
    E-D3DGS: scene/deformation.py).

    Args:
        features: F. width: W. depth: D; 0 is the same as 1.
        heads: the fields that have one. bands: spherical harmonics coefficients of each Gaussian
            and colour, for the head "sh".

    Raises:
        ValueError: no head, or one that does not exist.
    """

    def __init__(
        self, features: int, width: int, depth: int, heads: Sequence[Head], bands: int = 1
    ) -> None:
        super().__init__()
        unknown = [head for head in heads if head not in get_args(Head)]
        if unknown or not heads:
            raise ValueError(f"heads must be some of {get_args(Head)}, got {list(heads)}")
        sizes = {"means": 3, "scales": 3, "rotations": 4, "opacity": 1, "sh": 3 * bands}
        trunk: list[nn.Module] = [nn.Linear(features, width)]
        for _ in range(depth - 1):
            trunk += [nn.ReLU(), nn.Linear(width, width)]
        self.trunk = nn.Sequential(*trunk)
        self.heads = nn.ModuleDict(
            {
                head: nn.Sequential(
                    nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, sizes[head])
                )
                for head in heads
            }
        )
        for module in self.modules():
            if isinstance(module, nn.Linear):
                nn.init.xavier_uniform_(module.weight)

    def forward(self, features: Float[Tensor, "N F"]) -> GaussianDelta:
        hidden = self.trunk(features)
        out = {FIELDS[name]: head(hidden) for name, head in self.heads.items()}
        if "opacity_logits" in out:
            out["opacity_logits"] = out["opacity_logits"].squeeze(-1)
        if "sh" in out:
            out["sh"] = out["sh"].unflatten(1, (-1, 3))
        return GaussianDelta(**out)


def apply_delta(
    canonical: Gaussians,
    delta: GaussianDelta,
    *,
    space: Space = "raw",
    turning: Turning = "composed",
    share: float = 1.0,
) -> Gaussians:
    """`canonical` with `delta` added.

    Args:
        space: where scales are added: "raw" to their logarithm (4DGS), or "activated" to the
            standard deviations themselves, whose sign then has no meaning (D3DGS).
        turning: "composed" rotates by the delta after the canonical rotation (GaussianDelta);
            "added" adds quaternions: to the raw ones (4DGS), or in activated space to the
            normalised ones (D3DGS).
        share: fraction of the delta that is applied.
    """
    if share != 1.0:
        fields = {k: v if v is None else share * v for k, v in vars(delta).items()}
        delta = GaussianDelta(**fields)
    turned, scaled = delta.quats, delta.log_scales
    plain = replace(
        delta,
        quats=None if turning == "added" else turned,
        log_scales=None if space == "activated" else scaled,
    )
    moved = canonical.moved(plain)
    if turning == "added" and turned is not None:
        quats = normalize_quats(canonical.quats) if space == "activated" else canonical.quats
        moved = replace(moved, quats=quats + turned)
    if space == "activated" and scaled is not None:
        scales = (canonical.scales + scaled).abs().clamp_min(1e-6)
        moved = replace(moved, log_scales=scales.log())
    return moved


def with_residual(gaussians: Gaussians, residual: Residual | None) -> Gaussians:
    """`gaussians` displaced by the residual of the interaction, if there is one."""
    if residual is None or residual.means is None:
        return gaussians
    return replace(gaussians, means=gaussians.means + residual.means)


def clamped_time(time: float) -> float:
    """`time` in [0, 1]: outside the clip, its nearest end."""
    return min(max(time, 0.0), 1.0)


def clip_length(context: BuildContext) -> int | None:
    """Number of frames of the clip that is reconstructed; None without one."""
    return None if context.clip is None else context.clip.num_frames


def half_the_frames(num_frames: int | None) -> int:
    """Cells along time for a clip: one for two frames, at least 8.

    Raises:
        ValueError: the number of frames is not known.
    """
    if num_frames is None:
        raise ValueError(
            "a resolution in time of None is half the frames of a clip, but no clip was given: "
            "give num_frames, or a resolution"
        )
    return max(8, num_frames // 2)


# Encodings of place and time, and the network that reads them.


def positional_encoding(
    x: Float[Tensor, "*batch D"], frequencies: int, window: float | None = None
) -> Float[Tensor, "*batch E"]:
    """[x, sin(2^0 x), ..., sin(2^(L-1) x), cos(2^0 x), ...], E = D (1 + 2 L) (D3DGS, time_utils).

    Args:
        window: number of octaves with a weight, from 0 to `frequencies`; the weight of the last is
            between 0 and 1 (Nerfies, Park et al. 2021, arXiv:2011.12948). None is all.
    """
    octaves = torch.arange(frequencies, dtype=x.dtype, device=x.device)
    angles = x[..., None, :] * (2.0**octaves)[:, None]
    waves = torch.stack((angles.sin(), angles.cos()), dim=-3)
    if window is not None:
        weights = (1 - torch.cos(math.pi * (window - octaves).clamp(0, 1))) / 2
        waves = waves * weights[:, None]
    return torch.cat((x, waves.flatten(-3)), dim=-1)


def encoded_width(size: int, frequencies: int) -> int:
    """E of `positional_encoding`."""
    return size * (1 + 2 * frequencies)


class SkipTrunk(nn.Module):
    """ReLU layers, of which one takes the input again (NeRF's trunk).

    Args:
        entry: width of the input. width, depth: size of the layers.
        skip: index of the layer whose input is [input, hidden]; None for none.
    """

    def __init__(self, entry: int, width: int, depth: int, skip: int | None) -> None:
        super().__init__()
        sizes = [entry] + [width] * (depth - 1)
        if skip is not None and 0 < skip < depth:
            sizes[skip] += entry
        self.skip = skip
        self.layers = nn.ModuleList(nn.Linear(size, width) for size in sizes)

    def forward(self, entry: Float[Tensor, "N E"]) -> Float[Tensor, "N W"]:
        hidden = entry
        for i, layer in enumerate(self.layers):
            if i == self.skip and i > 0:
                hidden = torch.cat((entry, hidden), dim=-1)
            hidden = torch.relu(layer(hidden))
        return hidden


class UnitBox(nn.Module):
    """Maps points to [-1, 1] in the bounding box of the Gaussians at the start.

    Points may leave it later.
    """

    low: Tensor
    high: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("low", torch.zeros(3))
        self.register_buffer("high", torch.ones(3))

    def bind(self, canonical: Gaussians) -> None:
        means = canonical.means.detach()
        if len(means) == 0:
            return
        low, high = means.amin(0), means.amax(0)
        grown = (high - low).clamp_min(1e-3) - (high - low)  # the box of a flat cloud is not flat
        self.low, self.high = low - grown / 2, high + grown / 2

    def forward(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        return 2 * (points - self.low) / (self.high - self.low) - 1


class TimeTable(nn.Module):
    """Learned codes at given times, linear between them and constant outside.

    Args:
        size: length of each code. times: times of the codes, in [0, 1], ascending.
        spread: standard deviation of the codes at the start.

    Raises:
        ValueError: there are no times, or they do not ascend.
    """

    times: Tensor

    def __init__(self, size: int, times: Sequence[float], spread: float = 0.05) -> None:
        super().__init__()
        if not times or list(times) != sorted(times):
            raise ValueError(f"a table needs ascending times, got {list(times)[:5]}")
        self.register_buffer("times", torch.tensor(list(times), dtype=torch.float64))
        self.codes = nn.Parameter(torch.randn(len(times), size) * spread)

    def forward(self, time: float) -> Float[Tensor, " C"]:
        low, high, r = neighbours(time, self.times.tolist())
        return torch.lerp(self.codes[low], self.codes[high], r)
