"""F13, F14, F16 to F20, F23, F24: direct checks of cameras, depth and object placement."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hoigs.core.clip_folder.health import depth_factor
from hoigs.core.model.object_placement import fit_scale, locate
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.lens import Lens
from hoigs.studies.stress.case import CheckResult
from hoigs.studies.stress.checks.toy import SIZE, cameras, component, toy_clip, wall
from hoigs.training.losses import depth_loss

RASTERIZERS = ("rasterizer:oracle", "rasterizer:torch", "rasterizer:warp")


def extent_of_a_static_camera() -> CheckResult:
    """The scene extent, which scales all position learning rates, without any baseline."""
    still, moving = toy_clip(arc=0.0).extent(), toy_clip(arc=0.4).extent()
    empty = replace(
        toy_clip(arc=0.0), points=torch.zeros(0, 3), point_colors=torch.zeros(0, 3)
    ).extent()
    return CheckResult(
        still > 0.5 and empty > 0,
        f"{still:.2f} m standing still, {moving:.2f} m on an arc, {empty:.2f} m without points",
    )


def depth_factor_found() -> CheckResult:
    """Depth times 0.5, 0.8, 1.25, 2: the factor is estimated from the scene points."""
    found = {f: depth_factor(toy_clip(depth_scale=f)) for f in (0.5, 0.8, 1.0, 1.25, 2.0)}
    worst = max(abs(value / factor - 1) for factor, value in found.items())
    estimates = ", ".join(f"{factor:g} as {value:.3f}" for factor, value in found.items())
    return CheckResult(worst < 0.05, f"{estimates}: off by {100 * worst:.1f} % at most")


def scale_about_the_camera() -> CheckResult:
    """The scene scaled about the camera centre: the image does not change, the depth loss does."""
    camera, scene = cameras(1, 0.0)[0], wall()
    alpha = torch.tensor(1.1, requires_grad=True)
    center = camera.center
    scaled = scene.replace(
        means=center + alpha * (scene.means - center), log_scales=scene.log_scales + alpha.log()
    )
    with torch.no_grad():
        truth = component("rasterizer:torch").render(scene, camera)
    drawn = component("rasterizer:torch").render(scaled, camera)
    image = (drawn.color - truth.color).abs().mean()
    (by_image,) = torch.autograd.grad(image, alpha, retain_graph=True)
    depth = depth_loss(drawn.depth, drawn.alpha, truth.expected_depth, "metric")
    assert depth is not None
    (by_depth,) = torch.autograd.grad(depth, alpha)
    return CheckResult(
        abs(float(by_image)) < 0.01 * float(by_depth) and float(by_depth) > 0.1,
        f"gradient by the scale {float(by_image):.1g} of the image, {float(by_depth):.2g} of depth",
    )


def _ball(count: int = 6000) -> Float[Tensor, "P 3"]:
    """Evenly spread points of a unit sphere, dense enough to hide its back."""
    i = torch.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, i * math.pi * (3 - 5**0.5)
    ring = (1 - z * z).sqrt()
    return torch.stack((ring * turn.cos(), ring * turn.sin(), z), 1)


def _seen(
    points: Float[Tensor, "P 3"], camera: Camera
) -> tuple[Bool[Tensor, "H W"], Float[Tensor, "H W"]]:
    """Mask and depth of the front of a cloud."""
    size = camera.width
    xy, z = camera.project(points)
    at = xy.floor().long()
    inside = ((at >= 0) & (at < size)).all(1)
    depth = torch.full((size * size,), torch.inf)
    depth.scatter_reduce_(0, (at[:, 1] * size + at[:, 0])[inside], z[inside], "amin")
    depth = depth.view(size, size)
    return torch.isfinite(depth), torch.where(torch.isfinite(depth), depth, 0.0)


def front_of_a_ball() -> CheckResult:
    """A ball whose radius is a tenth of its depth, from mask and depth of its front."""
    ball, radius = _ball(), 0.1 * 3.0
    views = [
        Camera.look_at(torch.tensor([x, 0.0, -3.0]), torch.zeros(3), width=64, height=64, fov_y=0.4)
        for x in (-0.3, 0.0, 0.3)
    ]
    seen = [_seen(radius * ball, camera) for camera in views]
    masks, depths = [m for m, _ in seen], [d for _, d in seen]
    true = torch.stack([c.to_camera(torch.zeros(3)) for c in views])[:, 2]
    off = {}
    for front in (True, False):
        found = locate(ball, masks, depths, views, front=front, smooth=False)
        off[front] = float(((found.shifts[:, 2] - true) / true).abs().max())
    return CheckResult(
        off[True] < 0.01,
        f"depth of its centre off by {100 * off[True]:.2f} %; by {100 * off[False]:.1f} % if "
        "the front is taken for the middle",
    )


def cut_masks() -> CheckResult:
    """Half of the mask hidden in three frames of ten: the scale by the median and by the mean."""
    ball = _ball(3000)
    views = [
        Camera.look_at(torch.tensor([x, 0.0, -3.0]), torch.zeros(3), width=64, height=64, fov_y=0.4)
        for x in torch.linspace(-0.4, 0.4, 10).tolist()
    ]
    masks = [_seen(0.3 * ball, camera)[0] for camera in views]
    for mask in masks[::4]:
        columns = mask.any(0).nonzero().squeeze(1)
        mask[:, : int(columns.float().mean())] = False
    shifts = torch.stack([c.to_camera(torch.zeros(3)) for c in views])
    median = fit_scale(ball, masks, views, shifts, quantile=0.0)
    mean = fit_scale(ball, masks, views, shifts, reduce="mean", frames="all", quantile=0.0)
    off = [abs(fit.scale / 0.3 - 1) for fit in (median, mean)]
    return CheckResult(
        off[0] < 0.03 and not median.counted[::4].any(),
        f"median off by {100 * off[0]:.1f} %, mean by {100 * off[1]:.1f} % with "
        f"{mean.spread / max(median.spread, 1e-9):.0f} times the spread",
    )


def near_plane() -> CheckResult:
    """Gaussians at the camera centre, on its plane and behind it, with every CPU rasterizer."""
    camera, scene = cameras(1, 0.0)[0], wall(60)
    z = torch.tensor([0.0, 1e-6, -1e-6, 0.005, -0.5, -4.0])
    ahead = camera.world_to_camera[2, :3]
    means = torch.cat((scene.means, camera.center + z[:, None] * ahead))
    crossing = Gaussians.from_points(means, scales=0.2, opacity=0.9)
    crossing = crossing.replace(sh=torch.rand(crossing.sh.shape))
    shown = []
    for key in RASTERIZERS:
        leaf = crossing.map(lambda x: x.clone().requires_grad_())
        output = component(key).render(leaf, camera)
        output.color.sum().backward()
        grads = [leaf.means.grad, leaf.log_scales.grad, leaf.quats.grad]
        finite = all(g is not None and bool(torch.isfinite(g).all()) for g in grads)
        drawn = int((output.info["radii"][len(scene) :] > 0).sum())
        shown.append((finite and bool(torch.isfinite(output.color).all()), drawn))
    return CheckResult(
        all(finite and drawn == 0 for finite, drawn in shown),
        f"{len(RASTERIZERS)} rasterizers: finite {[f for f, _ in shown]}, drawn of 6 "
        f"{[d for _, d in shown]}",
    )


def principal_point() -> CheckResult:
    """A small Gaussian, with (cx, cy) off the middle of the image by a tenth of it."""
    plain = cameras(1, 0.0)[0]
    K = plain.K.clone()
    K[0, 2] += 0.1 * SIZE
    K[1, 2] -= 0.07 * SIZE
    camera = replace(plain, K=K)
    point = torch.tensor([[0.21, -0.13, 0.0]])
    white = Gaussians.from_points(point, torch.ones(1, 3), scales=0.06, opacity=0.9)
    expected, _ = camera.project(point)
    worst = 0.0
    for key in RASTERIZERS:
        with torch.no_grad():
            light = component(key).render(white, camera).color.sum(-1)
        middle = (camera.pixel_grid() * light[..., None]).sum((0, 1)) / light.sum()
        worst = max(worst, float((middle - expected[0]).norm()))
    return CheckResult(
        worst < 0.1, f"off by {worst:.3f} px at most, {len(RASTERIZERS)} rasterizers"
    )


def lens_removed() -> CheckResult:
    """k1 = -0.1: undistorted points are at their pinhole pixels."""
    K = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    lens = Lens.opencv(K, [-0.1, 0, 0, 0], 64, 48)
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.3, 0.3, 9))
    rays = np.stack((x, y), -1).reshape(-1, 2)
    bent = rays * (1 - 0.1 * (rays**2).sum(-1, keepdims=True))
    straight = lens.undistortion().pixels(bent * [60, 60] + [32, 24])
    wanted = rays * [lens.K[0, 0], lens.K[1, 1]] + [float(lens.K[0, 2]), float(lens.K[1, 2])]
    off = float(np.abs(np.asarray(straight) - wanted).max())
    bend = float(np.abs((bent - rays) * 60).max())
    return CheckResult(
        off < 0.1, f"off by {off:.3f} px; the lens moves points by up to {bend:.1f} px"
    )
