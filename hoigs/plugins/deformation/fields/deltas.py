"""Offsets of Gaussians: the heads that predict them, and how they are added."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

from jaxtyping import Float
from torch import Tensor, nn

from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import normalize_quats
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
