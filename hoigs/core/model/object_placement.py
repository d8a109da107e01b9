"""Object initialisation: scale and place of a generated shape in the world.

HOIGS, Sec. "Object Initialization". A generator (SDS, MASt3R, a mesh) gives
canonical points; masks, depth and cameras give its place and size:

    S = mean_t sqrt(A_mask^t / A_proj^t)
    mu_world^t = R_t^-1 ((S R_obj^t C mu_can + v_t) - t_t)

with box areas A, the camera's R_t and t_t, the object's place v_t in camera space, and, beyond the
paper, its rotation R_obj^t and the axes C of the generator.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.maths.frame_times import fill_gaps
from hoigs.core.maths.frame_times import smooth as smoothed
from hoigs.core.values.camera import Camera, pinhole_pixels, pinhole_rays
from hoigs.core.values.clip import ObjectTrack

Reduce = Literal["median", "mean"]
Frames = Literal["whole", "all"]

CELLS = 24  # across the grid in which the front of an object is found
SMOOTHED = 7  # frames that the smoothing of an object's places looks at
HALF_ALPHA = (2 * math.log(2)) ** 0.5  # standard deviations at which a Gaussian is at one half

# Camera axes of OpenGL (y up, looking along -z), in which DreamGaussian and others generate,
# to those of OpenCV: `canonical_to_camera` of shapes from there
OPENGL_TO_OPENCV = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))


@dataclass(frozen=True)
class ScaleFit:
    """What `fit_scale` found.

    Attributes:
        scale: S, metres a canonical unit.
        spread: standard deviation of the counted frames' ratios over their mean; 0 is agreement.
        ratios: sqrt(A_mask / A_proj) at the last evaluation; NaN where it is undefined.
        counted: frames that S was taken over.
    """

    scale: float
    spread: float
    ratios: Float[Tensor, " F"]
    counted: Bool[Tensor, " F"]


@dataclass(frozen=True)
class Reading:
    """One reading of what the paper leaves open in S and v_t.

    The defaults differ from the paper, which is `reduce="mean", frames="all", iterations=1`,
    because a mask that the border or a hand cuts has too small a box, which pulls a mean down and
    leaves a median alone; and because A_proj of a thick object depends on its own size, so that one
    evaluation of the unscaled object is biased. Evaluations after the first, at S, converge fast as
    area is nearly quadratic in S.

    Attributes:
        reduce: how the ratios of the frames become one.
        frames: "whole" counts masks that the image's border does not cut and that are at least as
            large as the median one; "all" counts every mask.
        iterations: evaluations. One places the object unscaled, as the paper does; more start from
            the size that a flat object at v_t would have.
        quantile: see `projected_area`.
        front: False takes the middle of the visible front for v_t, as the paper's words read.
        smooth: median of 5, then Savitzky-Golay, over v_t; False keeps every frame's own.
    """

    reduce: Reduce = "median"
    frames: Frames = "whole"
    iterations: int = 3
    quantile: float = 0.001
    front: bool = True
    smooth: bool = True


READING = Reading()


def mask_box(mask: Bool[Tensor, "H W"]) -> tuple[int, int, int, int] | None:
    """Left, top, right, bottom (exclusive) of a mask, pixels; None of an empty one."""
    rows, columns = mask.any(1).nonzero().squeeze(1), mask.any(0).nonzero().squeeze(1)
    if len(rows) == 0:
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def projected_area(
    points: Float[Tensor, "P 3"],
    camera: Camera,
    quantile: float = 0.001,
    sigmas: Float[Tensor, " P"] | None = None,
) -> float | None:
    """A_proj: area of the box around the projected object, pixels squared.

    The paper does not define whether it boxes centres or splats. Centres by default, as most shapes
    come as points; with `sigmas` the discs in which an opaque splat's alpha is above one half. Both
    without the `quantile` outermost at each side, as generators leave stray Gaussians about; 0
    takes all of them. A larger share cuts the object itself: 0.01 makes S 4 % too large on a ball,
    10 % on an L.

    Args:
        points: in *camera* space, metres. sigmas: standard deviations there, metres.

    Returns:
        None when a point is not in front of the camera: there is no box then.
    """
    if not bool((points[:, 2] > 1e-6).all()):
        return None
    xy = pinhole_pixels(camera.K, points)
    radius = torch.zeros_like(xy)
    if sigmas is not None:
        radius = HALF_ALPHA * sigmas[:, None] * camera.focal / points[:, 2:]
    low = torch.quantile(xy - radius, quantile, dim=0)
    high = torch.quantile(xy + radius, 1 - quantile, dim=0)
    return float((high - low).prod())


def fit_scale(
    canonical: Float[Tensor, "P 3"],
    masks: Sequence[Bool[Tensor, "H W"]],
    cameras: Sequence[Camera],
    shifts: Float[Tensor, "F 3"],
    rotations: Float[Tensor, "F 3 3"] | None = None,
    reading: Reading = READING,
    *,
    sigmas: Float[Tensor, " P"] | None = None,
) -> ScaleFit:
    """S of the paper.

    Args:
        canonical: about the object's centre, any unit.
        masks: visible pixels, one a frame; empty ones do not count.
        shifts: v_t, the object's centre in camera space, metres.
        rotations: R_obj^t C, canonical axes to camera axes; None is the identity.
        sigmas: see `projected_area`, in canonical units.

    Raises:
        ValueError: no frame counts, or, with one iteration, the unscaled object reaches behind
            the camera.
    """
    iterations = reading.iterations
    if iterations < 1:
        raise ValueError(f"fit_scale needs at least 1 iteration, got {iterations}")
    areas, counted = _mask_areas(masks, reading.frames)
    turned = canonical if rotations is None else canonical @ rotations.mT
    turned = turned.expand(len(cameras), -1, 3)
    scale = 1.0 if iterations == 1 else _flat_scale(turned, areas, counted, cameras, shifts)
    ratios, used = areas, counted
    for _ in range(iterations):
        found = [
            projected_area(
                scale * turned[i] + shifts[i],
                camera,
                reading.quantile,
                None if sigmas is None else scale * sigmas,
            )
            for i, camera in enumerate(cameras)
        ]
        projected = torch.tensor([float("nan") if a is None else a for a in found])
        ratios = (areas / projected).sqrt()
        used = counted & torch.isfinite(ratios)
        if not used.any():
            raise ValueError(
                f"at a scale of {scale:.3g} the object reaches behind the camera in every frame "
                "that counts; give more iterations, or a smaller canonical shape"
            )
        chosen = ratios[used]
        scale *= float(chosen.mean() if reading.reduce == "mean" else chosen.median())
    spread = float(ratios[used].std(correction=0) / ratios[used].mean())
    return ScaleFit(scale, spread, ratios, used)


def _mask_areas(
    masks: Sequence[Tensor], frames: Frames
) -> tuple[Float[Tensor, " F"], Bool[Tensor, " F"]]:
    """Box area of each mask, NaN of empty ones, and which frames count."""
    boxes = [mask_box(m) for m in masks]
    areas = torch.tensor(
        [float("nan") if b is None else float((b[2] - b[0]) * (b[3] - b[1])) for b in boxes]
    )
    seen = torch.tensor([b is not None for b in boxes])
    if not seen.any():
        raise ValueError("the object's mask is empty in every frame: its scale is unknown")
    if frames == "all":
        return areas, seen
    sizes = torch.tensor([float(m.sum()) for m in masks])
    cut = [bool(m[0].any() | m[-1].any() | m[:, 0].any() | m[:, -1].any()) for m in masks]
    whole = seen & ~torch.tensor(cut)
    if not whole.any():
        raise ValueError(
            "the image's border cuts the object in every frame: its scale is unknown; "
            'frames="all" takes the cut masks as they are'
        )
    return areas, whole & (sizes >= sizes[whole].median())


def _flat_scale(
    turned: Float[Tensor, "F P 3"],
    areas: Float[Tensor, " F"],
    counted: Bool[Tensor, " F"],
    cameras: Sequence[Camera],
    shifts: Float[Tensor, "F 3"],
) -> float:
    """S if all points of the object had the depth of its centre: defined wherever it is."""
    extent = (turned.amax(1) - turned.amin(1))[:, :2]
    focal = torch.stack([camera.focal for camera in cameras])
    flat = (extent * focal / shifts[:, 2:]).prod(1)
    ratios = (areas / flat).sqrt()
    usable = counted & torch.isfinite(ratios) & (shifts[:, 2] > 0)
    if not usable.any():
        raise ValueError("the object's place is behind the camera in every frame that counts")
    return float(ratios[usable].median())


def masked_depths(
    masks: Sequence[Bool[Tensor, "H W"]], depths: Sequence[Float[Tensor, "H W"] | None]
) -> tuple[Float[Tensor, " F"], Float[Tensor, "F 2"], Bool[Tensor, " F"]]:
    """Depth under each mask (see `_middle`), the mask's centroid (x, y), where both are known.

    Args:
        depths: along z, metres, 0 where unknown; or None.
    """
    middle, centers, known = [], [], []
    for mask, depth in zip(masks, depths, strict=True):
        rows, columns = mask.nonzero(as_tuple=True)
        inside = torch.zeros(0) if depth is None else depth[mask]
        inside = inside[inside > 0]
        known.append(len(inside) > 0)
        middle.append(_middle(inside) if len(inside) else 0.0)
        center = (columns.float().mean() + 0.5, rows.float().mean() + 0.5) if len(rows) else (0, 0)
        centers.append([float(c) for c in center])
    return torch.tensor(middle), torch.tensor(centers), torch.tensor(known)


def _middle(values: Float[Tensor, " N"]) -> float:
    """Mean of the central four fifths: depth bleeds at a mask's edge, so the ends are cut, and a
    median would jump between the surfaces of an object that has one behind the other."""
    ordered = values.sort().values
    cut = len(values) // 10
    return float(ordered[cut : len(values) - cut].mean())


def seen_middle(turned: Float[Tensor, "P 3"]) -> Float[Tensor, " 3"]:
    """The place that mask and masked depth give an object, relative to its centre, in its own unit.

    The mask's centroid is that of the silhouette, and depth sees the front: on a ball that is two
    thirds of the radius too near. The front is the nearest point of each cell of a grid across.

    Args:
        turned: about the centre, in camera axes.
    """
    low, high = turned[:, :2].amin(0), turned[:, :2].amax(0)
    step = ((high - low) / (CELLS - 1)).clamp_min(1e-9)
    at = ((turned[:, :2] - low) / step).round().long()
    nearest = turned.new_full((CELLS * CELLS,), torch.inf)
    nearest.scatter_reduce_(0, at[:, 1] * CELLS + at[:, 0], turned[:, 2], "amin")
    filled = torch.isfinite(nearest).nonzero().squeeze(1)
    across = low + step * torch.stack((filled % CELLS, filled // CELLS), 1).to(turned).mean(0)
    return torch.cat((across, turned.new_tensor([_middle(nearest[filled])])))


@dataclass(frozen=True)
class Placement:
    """Where a canonical shape stands in every frame.

    Attributes:
        fit: its scale. shifts: v_t, its centre in camera space, metres, smooth over time.
        observed: frames in which mask and depth gave v_t; the others are interpolated.
    """

    fit: ScaleFit
    shifts: Float[Tensor, "F 3"]
    observed: Bool[Tensor, " F"]


def locate(
    canonical: Float[Tensor, "P 3"],
    masks: Sequence[Bool[Tensor, "H W"]],
    depths: Sequence[Float[Tensor, "H W"] | None],
    cameras: Sequence[Camera],
    rotations: Float[Tensor, "F 3 3"] | None = None,
    reading: Reading = READING,
) -> Placement:
    """S and v_t together, from masks and masked depth.

    v_t is the mask's centroid at the masked depth ("derived from the object's masked depth"), led
    from there, the middle of what is seen, to the object's centre: that way grows with S, and S
    with v_t, so the two take turns.

    Args:
        canonical: about the object's centre. masks, rotations: as `fit_scale`.
        depths: metres, 0 where unknown.

    Raises:
        ValueError: no frame has both mask and depth, or see `fit_scale`.
    """
    middle, pixels, observed = masked_depths(masks, depths)
    if not observed.any():
        raise ValueError("no frame has known depth under the object's mask: its place is unknown")
    turned = canonical if rotations is None else canonical @ rotations.mT
    turned = turned.expand(len(cameras), -1, 3)
    seen_at = torch.stack([seen_middle(t) for t in turned]) * float(reading.front)
    rays = pinhole_rays(torch.stack([camera.K for camera in cameras]), pixels)
    rays = torch.nn.functional.pad(rays, (0, 1), value=1.0)
    known = [m if o else torch.zeros_like(m) for m, o in zip(masks, observed.tolist(), strict=True)]
    scale = 0.0
    for _ in range(max(2, reading.iterations) if reading.front else 1):
        depth = middle - scale * seen_at[:, 2]
        across = torch.nn.functional.pad(scale * seen_at[:, :2], (0, 1))
        centers = (rays * depth[:, None] - across).numpy()
        shifts = torch.from_numpy(fill_gaps(centers, observed.numpy())).to(rays)
        fit = fit_scale(canonical, known, cameras, shifts, rotations, reading)
        scale = fit.scale
    if reading.smooth and len(shifts) >= SMOOTHED:
        shifts = torch.from_numpy(smoothed(shifts.numpy(), SMOOTHED)).to(shifts)
    return Placement(fit, shifts, observed)


def place_in_world(
    canonical: Float[Tensor, "P 3"],
    scale: float,
    shift: Float[Tensor, " 3"],
    camera: Camera,
    rotation: Float[Tensor, "3 3"] | None = None,
) -> Float[Tensor, "P 3"]:
    """mu_world^t = R_t^-1 ((S R_obj^t C mu_can + v_t) - t_t), metres.

    Without `rotation` it is the paper's formula: the object keeps one orientation relative to the
    *camera*, so it counter-rotates in the world when the camera turns, and a turning object
    stands still. Hence the option of a rotation per frame.

    Args:
        rotation: R_obj^t C, canonical axes to this camera's axes. A canonical shape in OpenGL's
            axes needs C = OPENGL_TO_OPENCV even when R_obj is the identity.
    """
    points = scale * canonical if rotation is None else scale * canonical @ rotation.mT
    return camera.to_world(points + shift)


def placed_track(
    canonical: Float[Tensor, "P 3"],
    colors: Float[Tensor, "P 3"],
    placement: Placement,
    cameras: Sequence[Camera],
    rotations: Float[Tensor, "F 3 3"] | None = None,
    *,
    provenance: str,
) -> ObjectTrack:
    """The ObjectTrack that deformations start from: `place_in_world` of every frame, as poses.

    Args:
        colors: RGB in [0, 1], of the generator. rotations: as `fit_scale`.
    """
    to_world = torch.stack([c.world_to_camera[:3, :3].mT for c in cameras])
    turns = to_world if rotations is None else to_world @ rotations
    places = [c.to_world(v) for c, v in zip(cameras, placement.shifts, strict=True)]
    return ObjectTrack(
        points=placement.fit.scale * canonical,
        colors=colors,
        rotations=turns,
        translations=torch.stack(places),
        observed=placement.observed,
        provenance=provenance,
        rotation_known=rotations is not None,
    )
