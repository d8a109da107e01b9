"""R01 to R14: the drawing rules, one by one, against what can be written down by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import torch

from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.testing.compare import require, require_close
from hoigs.testing.rasterizer.reference import require_reference_picture
from hoigs.testing.rasterizer.scenes import (
    Scene,
    a_camera,
    front_camera,
    images,
    one_gaussian,
    random_gaussians,
)
from hoigs.testing.rasterizer.subject import CHECKS, RasterizerSubject, free

CENTRE = (7, 10)  # pixel of `front_camera` at its principal point


@CHECKS.check("R01")
def one_gaussian_is_the_formula(subject: RasterizerSubject) -> None:
    """One Gaussian is the closed form: centre, falloff, alpha, depth, background, info."""
    camera = front_camera(cx=9.0, cy=8.2)
    back = torch.tensor([0.2, 0.3, 0.4])
    output = subject.render(one_gaussian(), camera, RenderRequest(background=back))
    variance = (20.0 * 0.2 / 2.0) ** 2 + 0.3
    offsets = camera.pixel_grid() - torch.tensor([9.0, 8.2])
    alpha = 0.6 * torch.exp(-0.5 * offsets.square().sum(-1) / variance)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    color = alpha[..., None] * torch.tensor([0.9, 0.4, 0.1]) + (1 - alpha[..., None]) * back
    require_close("alpha", output.alpha, alpha, atol=1e-5)
    require_close("color", output.color, color, atol=1e-5)
    require_close("depth", output.depth, 2.0 * alpha, atol=1e-5)
    seen = alpha > 0
    expected = output.expected_depth.cpu()[seen]
    require_close("expected_depth", expected, torch.full_like(expected, 2.0), atol=1e-4)
    radius = float(math.ceil(3 * math.sqrt(variance)))
    require_close("radius", output.info["radii"][0], radius, atol=0.0)


@CHECKS.check("R02")
def outputs_keep_their_shapes(subject: RasterizerSubject) -> None:
    """Images are [H, W, ...] on the device of the input, all of one floating dtype."""
    request = RenderRequest(features=torch.zeros(9, 3))
    output = subject.render(random_gaussians(9), a_camera(6, 4), request)
    shapes = {"color": (4, 6, 3), "alpha": (4, 6), "depth": (4, 6), "features": (4, 6, 3)}
    for name, image in images(output).items():
        require(image.shape == shapes[name], f"{name} has shape {list(image.shape)}")
        require(image.device.type == subject.device.type, f"{name} is on {image.device}")
        require(image.dtype == output.color.dtype, f"{name} is {image.dtype}")
    require(output.color.dtype.is_floating_point, f"color is {output.color.dtype}")
    radii = output.info["radii"]
    require(radii.shape == (9,), f"info['radii'] has shape {list(radii.shape)}, expected [9]")
    bare = subject.render(random_gaussians(9), a_camera(6, 4))
    require(bare.features is None, "there are features that were not requested")


@CHECKS.check("R03")
def the_nearer_hides_the_farther(subject: RasterizerSubject) -> None:
    """The nearer hides the farther, whatever the order of their rows."""
    far = one_gaussian((0, 0, 4), scale=1.0, opacity=0.5, color=(0, 0, 1))
    near = one_gaussian((0, 0, 2), scale=1.0, opacity=0.8, color=(1, 0, 0))
    for parts in ([far, near], [near, far]):
        output = subject.render(Gaussians.cat(parts), front_camera())
        require_close("color", output.color[CENTRE], torch.tensor([0.8, 0.0, 0.1]), atol=1e-5)
        require_close("depth", output.depth[CENTRE], 0.8 * 2 + 0.1 * 4, atol=1e-5)


@CHECKS.check("R04")
def equal_depths_are_drawn_by_index(subject: RasterizerSubject) -> None:
    """Of equally deep Gaussians the lower index is in front."""
    red = one_gaussian(scale=1.0, opacity=0.8, color=(1, 0, 0))
    blue = one_gaussian(scale=1.0, opacity=0.8, color=(0, 0, 1))
    color = subject.render(Gaussians.cat([red, blue]), front_camera()).color[CENTRE]
    require_close("color", color, torch.tensor([0.8, 0.0, 0.16]), atol=1e-5)


@CHECKS.check("R05")
def max_alpha_clamps(subject: RasterizerSubject) -> None:
    """One Gaussian covers at most max_alpha."""
    solid = one_gaussian(scale=3.0).replace(opacity_logits=torch.tensor([30.0]))
    for limit in subject.choices("max_alpha", (0.999, 0.99, 0.5)):
        output = subject.render(solid, front_camera(), RenderRequest(max_alpha=limit))
        require_close(f"alpha with max_alpha {limit}", output.alpha[CENTRE], limit, atol=1e-6)
    if {"max_alpha", "min_transmittance"} & subject.rasterizer.capabilities.fixed.keys():
        return
    whole = RenderRequest(max_alpha=1.0, min_transmittance=0.0)
    output = subject.render(solid, front_camera(), whole)
    require_close("alpha with max_alpha 1", output.alpha[CENTRE], 1.0, atol=1e-6)


@CHECKS.check("R06")
def min_alpha_is_the_only_edge(subject: RasterizerSubject) -> None:
    """A splat ends where its alpha falls to min_alpha, not at some number of sigmas."""
    camera = front_camera(61, 61, cx=30.5, cy=30.5)
    splat = one_gaussian(scale=0.6, opacity=0.99)
    variance = (20 * 0.6 / 2) ** 2 + 0.3
    distance = (camera.pixel_grid() - 30.5).norm(dim=-1)
    for limit in subject.choices("min_alpha", (1 / 255, 0.05, 1e-4)):
        output = subject.render(splat, camera, RenderRequest(min_alpha=limit))
        radius = math.sqrt(2 * math.log(0.99 / limit) * variance)
        seen = (output.alpha > 0).cpu()
        require(seen[distance < radius - 1e-3].all(), f"min_alpha {limit}: it ends too early")
        require(not seen[distance > radius + 1e-3].any(), f"min_alpha {limit}: it ends too late")
    if {"min_alpha", "min_transmittance"} & subject.rasterizer.capabilities.fixed.keys():
        return
    unlimited = RenderRequest(min_alpha=0.0, min_transmittance=0.0)
    drawn = subject.render(splat, camera, unlimited).color
    require((drawn > 0).all(), "with min_alpha 0 it still has an edge")


@CHECKS.check("R07")
def min_transmittance_stops(subject: RasterizerSubject) -> None:
    """The splat that would bring the transmittance to the limit, and all behind, are left out."""
    layers = [one_gaussian((0, 0, 2 + i), scale=50.0, opacity=0.8) for i in range(7)]
    limits = subject.choices("min_transmittance", (0.5, 0.1, 1e-3, 1e-4, 0.0))
    for limit in limits:
        drawn = sum(0.2 ** (i + 1) > limit for i in range(7))
        request = RenderRequest(min_transmittance=limit)
        output = subject.render(Gaussians.cat(layers), front_camera(), request)
        wanted = 1 - 0.2**drawn
        what = f"1 - alpha with min_transmittance {limit}"
        require_close(what, 1 - output.alpha[CENTRE], 1 - wanted, atol=1e-6, rtol=1e-3)


@CHECKS.check("R08")
def near_plane(subject: RasterizerSubject) -> None:
    """Gaussians nearer than `near` are not drawn, and those beyond are."""
    splat = one_gaussian((0, 0, 0.04), scale=0.004)
    alpha = subject.render(splat, front_camera()).alpha
    require(not alpha.any(), "a Gaussian at 0.04 m is drawn although near is 0.05 m")
    alpha = subject.render(splat, front_camera(), RenderRequest(near=0.03)).alpha
    require(alpha.max() > 0.5, "a Gaussian at 0.04 m is not drawn although near is 0.03 m")


@CHECKS.check("R09")
def low_pass_is_the_variance_of_a_point(subject: RasterizerSubject) -> None:
    """A point is drawn with variance low_pass, and keeps its opacity."""
    point = one_gaussian(scale=1e-6, opacity=0.8)
    for low_pass in subject.choices("low_pass", (0.3, 2.0)):
        output = subject.render(point, front_camera(), RenderRequest(low_pass=low_pass))
        beside = 0.8 * math.exp(-0.5 / low_pass)  # one pixel from the centre
        require_close(f"low_pass {low_pass}: centre", output.alpha[CENTRE], 0.8, atol=1e-5)
        require_close(f"low_pass {low_pass}: beside", output.alpha[7, 11], beside, atol=1e-5)


@CHECKS.check("R14", free("antialiased"))
def antialiased_points_fade(subject: RasterizerSubject) -> None:
    """Antialiased, a Gaussian keeps its opacity times its area on screen: small ones fade."""
    request = RenderRequest(antialiased=True)
    for sigma in (0.3, 1.0, 4.0):  # pixels
        splat = one_gaussian(scale=sigma * 2.0 / 20.0, opacity=0.8)
        output = subject.render(splat, front_camera(), request)
        variance = sigma**2 + 0.3
        centre = 0.8 * sigma**2 / variance
        beside = centre * math.exp(-0.5 / variance)  # one pixel from the centre
        require_close(f"sigma {sigma}: centre", output.alpha[CENTRE], centre, atol=1e-5)
        require_close(f"sigma {sigma}: beside", output.alpha[7, 11], beside, atol=1e-5)


@cache
def offset_scene() -> Scene:
    """One that its offset brings into the image, and one that it takes out."""
    outside, inside = one_gaussian((3.0, 0.0, 2.0), scale=0.3), one_gaussian((0.1, 0.1, 2.5))
    offsets = torch.tensor([[-30.0, 1.0], [40.0, 0.0]])
    request = RenderRequest(screen_offsets=offsets)
    return Scene(Gaussians.cat([outside, inside]), front_camera(), request)


@CHECKS.check("R10")
def screen_offsets_move_the_splat(subject: RasterizerSubject) -> None:
    """Screen offsets shift a splat on the image, even into it and out, and change nothing else."""
    moved = RenderRequest(screen_offsets=torch.tensor([[3.0, -2.0]]))
    got = subject.render(one_gaussian(), front_camera(), moved).alpha
    wanted = subject.render(one_gaussian(), front_camera(cx=13.5, cy=5.5)).alpha
    require_close("alpha", got, wanted, atol=1e-6)
    shown = require_reference_picture(subject, offset_scene()).info["radii"].gt(0).tolist()
    require(shown == [True, False], f"info['radii'] > 0 is {shown}, expected [True, False]")


@CHECKS.check("R11")
def a_cropped_camera_draws_the_crop(subject: RasterizerSubject) -> None:
    """The principal point is honoured: moving it by whole pixels moves the picture."""
    gaussians, camera = random_gaussians(100), a_camera()
    gaussians = gaussians.replace(means=gaussians.means * 0.3)  # off the Jacobian's clamp
    whole = subject.render(gaussians, camera).color
    part = subject.render(gaussians, camera.cropped(7, 4, 25, 19)).color
    require_close("color of the crop", part, whole[4:23, 7:32], atol=2e-5)


@CHECKS.check("R12")
def background_shows_through(subject: RasterizerSubject) -> None:
    """A background colour is the image of that colour, and adds (1 - alpha) of it."""
    gaussians, camera = random_gaussians(60, degree=0), a_camera()
    color = torch.tensor([0.1, 0.6, 0.9])
    image = color.expand(camera.height, camera.width, 3).contiguous()
    a = subject.render(gaussians, camera, RenderRequest(background=color))
    b = subject.render(gaussians, camera, RenderRequest(background=image))
    black = subject.render(gaussians, camera)
    require_close("color over an image", b.color, a.color, atol=1e-6)
    under = black.color + (1 - black.alpha)[..., None] * color.to(black.color)
    require_close("color over a colour", a.color, under, atol=2e-6)
    for name in ("alpha", "depth"):
        require_close(name, getattr(a, name), getattr(black, name), atol=0.0)


@CHECKS.check("R13")
def a_camera_may_be_anywhere(subject: RasterizerSubject) -> None:
    """Moving the world and the camera together changes nothing."""
    gaussians, camera = random_gaussians(80, degree=0), a_camera()
    shift = torch.tensor([5.0, -3.0, 2.0])
    pose = camera.world_to_camera.clone()
    pose[:3, 3] -= pose[:3, :3] @ shift
    moved: Camera = replace(camera, world_to_camera=pose)
    a = subject.render(gaussians, camera)
    b = subject.render(gaussians.replace(means=gaussians.means + shift), moved)
    require_close("alpha", b.alpha, a.alpha, atol=5e-5)
    require_close("depth", b.depth, a.depth, atol=2e-4)
