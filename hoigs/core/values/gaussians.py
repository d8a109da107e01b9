"""Gaussians: the one value that every deformation returns and every rasterizer draws."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.errors import NotFiniteError
from hoigs.core.maths.nearest import nearest, surface_normals
from hoigs.core.maths.rotations import quats_to_matrices, turned_quats
from hoigs.core.values.shown import one_line

FIELDS = ("means", "quats", "log_scales", "opacity_logits", "sh")  # raw, of all Gaussians
SH_C0 = 0.28209479177387814  # Y_00, so that color = 0.5 + SH_C0 * sh[:, 0]


@dataclass(frozen=True)
class GaussianDelta:
    """What a delta-style deformation adds to its canonical Gaussians; None leaves a field alone.

    Attributes:
        means: displacement, metres.
        quats: offset from the identity quaternion: the rotation normalise((1,0,0,0) + quats) is
            applied after the canonical rotation, so zero is no rotation.
        log_scales, opacity_logits, sh: added to the raw values.
    """

    means: Float[Tensor, "N 3"] | None = None
    quats: Float[Tensor, "N 4"] | None = None
    log_scales: Float[Tensor, "N 3"] | None = None
    opacity_logits: Float[Tensor, " N"] | None = None
    sh: Float[Tensor, "N K 3"] | None = None


@dataclass(frozen=True)
class Gaussians:
    """N anisotropic 3D Gaussians in raw (pre-activation) space.

    The rasterizer activates them, once: exp of `log_scales`, sigmoid of `opacity_logits`,
    normalisation of `quats`, 0.5 + SH for colour. What a deformation returns and a rasterizer draws
    is in world coordinates; canonical Gaussians are in their deformation's `input_space`.

    Attributes:
        means: centres, metres.
        quats: rotations wxyz, not necessarily normalised.
        log_scales: natural logarithm of the standard deviations in metres.
        opacity_logits: logit of the opacity; +infinity is drawn as opaque and does not learn.
        sh: spherical-harmonics colour coefficients, K = (degree + 1)^2.
        channels: what else a decoder reads of each (`hoigs.core.interfaces.decoder`); canonical
            Gaussians have none, a deformation gives them.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    log_scales: Float[Tensor, "N 3"]
    opacity_logits: Float[Tensor, " N"]
    sh: Float[Tensor, "N K 3"]
    channels: Float[Tensor, "N F"] | None = field(default=None, repr=False)

    __repr__ = one_line

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def scales(self) -> Float[Tensor, "N 3"]:
        """Standard deviations, metres (activated)."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, " N"]:
        """Opacities in [0, 1] (activated)."""
        return torch.sigmoid(self.opacity_logits)

    @property
    def colors(self) -> Float[Tensor, "N 3"]:
        """Colour of the constant SH band, not clamped (activated)."""
        return 0.5 + SH_C0 * self.sh[:, 0]

    @property
    def sh_degree(self) -> int:
        return int(self.sh.shape[1] ** 0.5 + 0.5) - 1

    def covariances(self) -> Float[Tensor, "N 3 3"]:
        """R S S^T R^T, square metres (3DGS, Kerbl et al. 2023, eq. 6)."""
        axes = quats_to_matrices(self.quats) * self.scales[:, None, :]
        return axes @ axes.mT

    def map(self, function: Callable[[Tensor], Tensor]) -> Gaussians:
        """Apply `function` to each field."""
        return Gaussians(**{name: function(value) for name, value in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """Every field that there is, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    def __getitem__(self, index: Any) -> Gaussians:
        """Rows chosen by a slice, an index tensor or a boolean mask."""
        return self.map(lambda x: x[index])

    def to(self, *args: Any, **kwargs: Any) -> Gaussians:
        return self.map(lambda x: x.to(*args, **kwargs))

    def detach(self) -> Gaussians:
        return self.map(lambda x: x.detach())

    def clone(self) -> Gaussians:
        return self.map(lambda x: x.clone())

    def replace(self, **changes: Tensor) -> Gaussians:
        return replace(self, **changes)

    def moved(self, delta: GaussianDelta) -> Gaussians:
        """These Gaussians with a delta applied (see GaussianDelta for the rule of each field)."""
        quats = self.quats
        if delta.quats is not None:
            quats = turned_quats(delta.quats, quats)
        plus = lambda raw, change: raw if change is None else raw + change  # noqa: E731
        return Gaussians(
            means=plus(self.means, delta.means),
            quats=quats,
            log_scales=plus(self.log_scales, delta.log_scales),
            opacity_logits=plus(self.opacity_logits, delta.opacity_logits),
            sh=plus(self.sh, delta.sh),
            channels=self.channels,
        )

    def check_finite(self, owner: str = "gaussians") -> None:
        """Raise NotFiniteError naming the first field with NaN or infinity."""
        for name, value in self.tensors().items():
            if not torch.isfinite(value).all():
                bad = int((~torch.isfinite(value)).reshape(len(self), -1).any(1).sum())
                raise NotFiniteError(f"{owner}.{name}: {bad} of {len(self)} rows are not finite")

    @staticmethod
    def cat(parts: Sequence[Gaussians]) -> Gaussians:
        """All parts in order; lower SH degrees are padded with zeros to the highest, and parts
        without channels have zeros where others have some."""
        if not parts:
            raise ValueError("Gaussians.cat needs at least one part")
        bands = max(p.sh.shape[1] for p in parts)

        def padded(sh: Tensor) -> Tensor:
            missing = bands - sh.shape[1]
            return torch.cat((sh, sh.new_zeros(sh.shape[0], missing, 3)), 1) if missing else sh

        wide = next((p.channels.shape[1] for p in parts if p.channels is not None), None)
        channels = None
        if wide is not None:
            channels = torch.cat([
                p.means.new_zeros(len(p), wide) if p.channels is None else p.channels
                for p in parts
            ])  # fmt: skip
        return Gaussians(
            means=torch.cat([p.means for p in parts]),
            quats=torch.cat([p.quats for p in parts]),
            log_scales=torch.cat([p.log_scales for p in parts]),
            opacity_logits=torch.cat([p.opacity_logits for p in parts]),
            sh=torch.cat([padded(p.sh) for p in parts]),
            channels=channels,
        )

    @staticmethod
    def from_points(
        points: Float[Tensor, "N 3"] | Float[np.ndarray, "N 3"],
        colors: Float[Tensor, "N 3"] | Float[np.ndarray, "N 3"] | None = None,
        *,
        scales: Float[Tensor, " N"] | float | None = None,
        opacity: float = 0.1,
        sh_degree: int = 0,
        thickness: float = 1.0,
        normals: Float[Tensor, "N 3"] | None = None,
    ) -> Gaussians:
        """Gaussians at points, isotropic by 3DGS's rule (Kerbl et al. 2023, sec. 5.1), or flat.

        Args:
            points: metres, a tensor or a NumPy array (which becomes torch's default type).
            colors: RGB in [0, 1]; grey when absent.
            scales: standard deviations in metres; by default the mean distance to the three
                nearest neighbours.
            opacity: initial opacity in (0, 1]. 1 is taken as 1 - 2^-24, the largest number below it
                in float32, so that its logit is finite.
            sh_degree: bands to allocate; all but the first start at zero.
            thickness: standard deviation along the surface's normal, as a share of `scales`.
            normals: unit surface normals, either sign; by default those of the plane through
                each point's nearest neighbours. Not used where `thickness` is 1.

        Raises:
            TypeError: points, colors or normals are neither, or no floats.
            ValueError: they have another shape; `opacity` is NaN, or outside (0, 1].
        """
        if not 0.0 < opacity <= 1.0:
            raise ValueError(
                f"Gaussians.from_points: opacity is {opacity}, expected more than 0 (invisible) "
                "and at most 1 (opaque)"
            )
        points = _rows("points", points)
        count = points.shape[0]
        colors = None if colors is None else _rows("colors", colors, count)
        normals = None if normals is None else _rows("normals", normals, count)
        if scales is None:
            scales = neighbour_distances(points)
        if not isinstance(scales, Tensor):
            scales = points.new_full((count,), float(scales))
        scales = scales.to(points).clamp_min(1e-6)
        sh = points.new_zeros(count, (sh_degree + 1) ** 2, 3)
        if colors is not None:
            sh[:, 0] = (colors.to(points) - 0.5) / SH_C0
        quats = points.new_zeros(count, 4)
        quats[:, 0] = 1.0
        log_scales = scales.log()[:, None].repeat(1, 3)
        if thickness != 1.0:
            quats = _facing(surface_normals(points) if normals is None else normals)
            log_scales[:, 2] += math.log(thickness)
        logit = torch.logit(torch.tensor(min(opacity, 1 - 2**-24))).item()
        return Gaussians(
            means=points.clone(),
            quats=quats,
            log_scales=log_scales,
            opacity_logits=points.new_full((count,), logit),
            sh=sh,
        )


def _rows(name: str, value: object, count: int | None = None) -> Float[Tensor, "N 3"]:
    """An argument of `from_points` as a tensor [N, 3] of floats."""
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        value = torch.from_numpy(value).to(torch.get_default_dtype())
    if not isinstance(value, Tensor) or not value.is_floating_point():
        kind = f" of {value.dtype}" if isinstance(value, np.ndarray | Tensor) else ""
        raise TypeError(
            f"Gaussians.from_points: {name} is a {type(value).__name__}{kind}, expected floats in "
            "a tensor or a NumPy array"
        )
    if value.dim() != 2 or value.shape[1] != 3 or count not in (None, len(value)):
        raise ValueError(
            f"Gaussians.from_points: {name} has shape {list(value.shape)}, expected "
            f"[{'N' if count is None else count}, 3]"
        )
    return value


def _facing(normals: Float[Tensor, "N 3"]) -> Float[Tensor, "N 4"]:
    """Rotations that take the z axis to `normals` or to their opposites, wxyz."""
    x, y, z = torch.where(normals[:, 2:] < 0, -normals, normals).unbind(-1)
    return torch.nn.functional.normalize(
        torch.stack((1 + z, -y, x, torch.zeros_like(z)), -1), dim=-1
    )


def neighbour_distances(points: Float[Tensor, "N 3"], neighbours: int = 3) -> Float[Tensor, " N"]:
    """Mean distance to the nearest neighbours, metres; 0.01 where there are too few points."""
    if len(points) <= neighbours:
        return points.new_full((len(points),), 0.01)
    return nearest(points, neighbours)[1].mean(1).to(points)
