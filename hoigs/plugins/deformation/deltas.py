"""What delta-style deformations share: the heads that predict offsets, and how these are added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.context import BuildContext
from hoigs.core.gaussians import GaussianDelta, Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.rotation import normalize_quats

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
        features: F. width: W. depth: D; 0 is as 1.
        heads: which fields have one. bands: harmonics coefficients a Gaussian, for the head "sh".
    """

    def __init__(
        self, features: int, width: int, depth: int, heads: Sequence[Head], bands: int = 1
    ) -> None:
        super().__init__()
        unknown = [head for head in heads if head not in get_args(Head)]
        if unknown or not heads:
            raise ValueError(f"heads are of {get_args(Head)}, got {list(heads)}")
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
    rest: Gaussians,
    delta: GaussianDelta,
    *,
    space: Space = "raw",
    turning: Turning = "composed",
    share: float = 1.0,
) -> Gaussians:
    """`rest` with `delta` added as a method's authors do.

    Args:
        space: where scales are added: "raw" to their logarithm (4DGS), or "activated" to the
            standard deviations themselves, whose sign then has no meaning (D3DGS).
        turning: "composed" turns by the delta after the rest rotation (GaussianDelta); "added"
            adds quaternions: the raw ones, or in activated space the normalised (methods B.9).
        share: of the delta that is applied.
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
    moved = rest.moved(plain)
    if turning == "added" and turned is not None:
        quats = normalize_quats(rest.quats) if space == "activated" else rest.quats
        moved = replace(moved, quats=quats + turned)
    if space == "activated" and scaled is not None:
        scales = (rest.scales + scaled).abs().clamp_min(1e-6)
        moved = replace(moved, log_scales=scales.log())
    return moved


def with_residual(gaussians: Gaussians, residual: Residual | None) -> Gaussians:
    """Displaced by the interaction's residual, if there is one."""
    if residual is None or residual.means is None:
        return gaussians
    return replace(gaussians, means=gaussians.means + residual.means)


def clamped_time(time: float) -> float:
    """Times outside the clip are held at its ends."""
    return min(max(time, 0.0), 1.0)


def half_the_frames(context: BuildContext) -> int:
    """Cells of time for the clip that is being reconstructed: one for two frames, at least 8."""
    if context.clip is None:
        raise ValueError("a resolution in time of None is derived from a clip, and there is none")
    return max(8, context.clip.num_frames // 2)


def second_differences(table: Float[Tensor, "T C"]) -> Float[Tensor, ""]:
    """Mean squared second difference of a table along time; 0 with fewer than three rows."""
    if len(table) < 3:
        return table.new_zeros(())
    return (table[2:] - 2 * table[1:-1] + table[:-2]).square().mean()


def nearest_squared(
    points: Float[Tensor, "N 3"], count: int
) -> tuple[Tensor, Float[Tensor, "N k"]]:
    """Indices and squared distances, m^2, of each point's nearest neighbours (fewer if too few)."""
    from scipy.spatial import cKDTree  # on use: scipy takes a while to import

    count = min(count, len(points) - 1)
    if count < 1:
        empty = torch.zeros(len(points), 0, device=points.device)
        return empty.long(), empty
    array = points.detach().cpu().double().numpy()
    distances, indices = cKDTree(array).query(array, k=count + 1)
    return (
        torch.as_tensor(indices[:, 1:], dtype=torch.int64, device=points.device),
        torch.as_tensor(distances[:, 1:] ** 2).to(points),
    )
