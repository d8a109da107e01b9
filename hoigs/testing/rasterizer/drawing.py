"""Drawing rules one by one, whole pictures against the oracle's, and the independence of rows."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from hoigs.core.interfaces.rasterizer import RenderOutput, RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import Gaussians
from hoigs.testing.checks import require, require_close, require_zero
from hoigs.testing.rasterizer.subject import (
    CHECKS,
    RasterizerSubject,
    Scene,
    a_camera,
    free,
    front_camera,
    images,
    one_gaussian,
    random_gaussians,
    random_scene,
    reference,
    require_reference_picture,
)

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


# R20 to R27: whole pictures, against the oracle's.

SIZES = ((1, 1), (1, 37), (50, 3), (16, 16), (33, 65))


@cache
def rich_scene(seed: int) -> Scene:
    return random_scene(seed=seed, channels=5, offset=1.0 - seed)  # moved, and in place


@cache
def sized_scene(width: int, height: int) -> Scene:
    return Scene(random_gaussians(60, degree=0), a_camera().resized(width, height))


@cache
def harmonic_scene(stored: int, active: int | None) -> Scene:
    request = RenderRequest(sh_degree=active)
    return Scene(random_gaussians(40, degree=stored), a_camera(20, 14), request)


@cache
def opacity_scene(logit: float) -> Scene:
    gaussians = random_gaussians(60, degree=0)
    return Scene(gaussians.replace(opacity_logits=torch.full((60,), logit)), a_camera())


@cache
def channel_scene(channels: int) -> Scene:
    features = torch.randn(50, channels, generator=torch.Generator().manual_seed(1))
    request = RenderRequest(features=features)
    return Scene(random_gaussians(50, degree=0), a_camera(20, 14), request)


@cache
def spread_scene() -> Scene:
    gaussians = random_gaussians(200, seed=4)
    return Scene(gaussians.replace(means=gaussians.means * 3.0), a_camera())


@cache
def giant_scene() -> Scene:
    return Scene(one_gaussian((6.0, -3.0, 2.0), scale=4.0, opacity=0.9), front_camera())


@CHECKS.check("R20")
def pictures_are_the_oracles(subject: RasterizerSubject) -> None:
    """Colour, alpha, depth, features and `info` are the oracle's."""
    for seed in (0, 1):
        scene = rich_scene(seed)
        wanted = reference(scene).output
        require(0.3 < wanted.alpha.mean() < 0.95, "the scene is too empty or too full")
        output = require_reference_picture(subject, scene)
        radii = output.info["radii"]
        require_close("info['radii']", radii, wanted.info["radii"], atol=1.0, rtol=1e-3)
        for name in {"means2d", "depths"} & output.info.keys():
            what = f"info['{name}']"
            require_close(what, output.info[name], wanted.info[name], atol=1e-4, rtol=1e-4)


@CHECKS.check("R21")
def any_image_size(subject: RasterizerSubject) -> None:
    """Images of 1 x 1, of one column, of a few rows and beyond a tile's edge."""
    for width, height in SIZES:
        output = require_reference_picture(subject, sized_scene(width, height))
        require(output.color.shape == (height, width, 3), f"{width}x{height} has another shape")


@CHECKS.check("R22")
def a_large_image(subject: RasterizerSubject) -> None:
    """4000 x 3000 pixels: every corner is reached, and memory stays within 400 bytes a pixel."""
    camera = front_camera(4000, 3000, 4000.0, cx=2000.0, cy=1500.0)
    places = [
        ((u - 2000) / 2000, (v - 1500) / 2000) for u, v in ((4, 4), (3996, 2996), (2000, 1500))
    ]
    parts = [one_gaussian((x, y, 2.0), scale=0.005) for x, y in places]
    gaussians = Gaussians.cat(parts)
    before = _reset_peak(subject.device)
    with torch.no_grad():
        output = subject.render(gaussians, camera, RenderRequest(background=torch.ones(3)))
    used = _peak(subject.device) - before
    for row, column in ((4, 4), (2995, 3995), (1500, 2000)):
        require_close(f"alpha at {row, column}", output.alpha[row, column], 0.6, atol=0.01)
    require_close("color of an empty place", output.color[500, 500], torch.ones(3), atol=0.0)
    require_close("pixels seen", float((output.alpha > 0).sum()), 5400.0, atol=800.0)
    limit = 400 * 4000 * 3000
    require(used <= limit, f"it took {used / 1e6:.0f} MB, expected at most {limit / 1e6:.0f}")


@CHECKS.check("R23")
def harmonics_of_every_degree(subject: RasterizerSubject) -> None:
    """Spherical harmonics stored to degree 0 to 3, used to every degree."""
    for stored in range(4):
        for active in (*range(stored), 3, None):
            scene = harmonic_scene(stored, active)
            output = require_reference_picture(subject, scene)
            if active is not None and active < stored:
                fewer = scene.gaussians.sh[:, : (active + 1) ** 2].contiguous()
                only = subject.render(scene.gaussians.replace(sh=fewer), scene.camera)
                require_close(f"degree {active} of {stored}", output.color, only.color, atol=1e-6)


@CHECKS.check("R24")
def opacity_near_zero_and_one(subject: RasterizerSubject) -> None:
    """Opacities of almost 0, just above min_alpha, and of 1."""
    for logit in (-20.0, -5.5, 12.0, 40.0):
        require_reference_picture(subject, opacity_scene(logit))


@CHECKS.check("R25")
def partly_culled(subject: RasterizerSubject) -> None:
    """Random Gaussians, half of them outside the image, some behind the camera."""
    scene = spread_scene()
    shown = reference(scene).output.info["radii"] > 0
    require(20 < int(shown.sum()) < 180, "the scene is not partly culled")
    output = require_reference_picture(subject, scene)
    wrong = ((output.info["radii"] > 0).cpu() != shown).nonzero().flatten().tolist()
    require(not wrong, f"rows {wrong}: info['radii'] > 0 is not where the oracle draws")


@CHECKS.check("R26")
def a_splat_beyond_the_image(subject: RasterizerSubject) -> None:
    """A giant far off the image whose edge reaches in: the clamp of the Jacobian applies."""
    wanted = reference(giant_scene()).output
    require(wanted.alpha.max() > 0.1, "the giant is not in the picture")
    require_reference_picture(subject, giant_scene())


@CHECKS.check("R27")
def any_number_of_features(subject: RasterizerSubject) -> None:
    """0, 1, 17 and 40 feature channels."""
    for channels in (0, 1, 17, 40):
        output = require_reference_picture(subject, channel_scene(channels))
        shape = None if output.features is None else list(output.features.shape)
        require(shape == [14, 20, channels], f"features have shape {shape}")


def _reset_peak(device: torch.device) -> int:
    """Bytes in use now; the peak is counted from here on."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return torch.cuda.memory_allocated(device)
    return _peak(device)


def _peak(device: torch.device) -> int:
    """Most bytes in use: of the device, or of this process since it started."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if sys.platform == "win32":
        return 0  # Windows needs another package for it
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


# R30 to R35: the order of rows does not matter, nor do rows change each other.


def squares(output: RenderOutput) -> Tensor:
    """A loss in which every image takes part."""
    return sum((image.square().mean() for image in images(output).values()), torch.zeros(()))


def require_same_images(got: RenderOutput, wanted: RenderOutput) -> None:
    for name, image in images(wanted).items():
        require_close(name, images(got)[name], image, atol=2e-6, rtol=1e-5)


@CHECKS.check("R30")
def order_of_rows_does_not_matter(subject: RasterizerSubject) -> None:
    """Permuted rows make the same picture, and their report is permuted."""
    gaussians, camera = random_gaussians(120), a_camera()
    order = torch.randperm(120, generator=torch.Generator().manual_seed(2))
    a, b = subject.render(gaussians, camera), subject.render(gaussians[order], camera)
    require_same_images(b, a)
    require_close("info['radii']", b.info["radii"].cpu(), a.info["radii"].cpu()[order], atol=0.0)


@CHECKS.check("R31")
def features_are_composited_like_colours(subject: RasterizerSubject) -> None:
    """Features that are the colours come out as the colours; N channels are N single ones."""
    gaussians, camera = random_gaussians(80, degree=0), a_camera()
    extra = torch.randn(80, 6, generator=torch.Generator().manual_seed(3))
    features = torch.cat((gaussians.colors.clamp_min(0), extra), -1)
    output = subject.render(gaussians, camera, RenderRequest(features=features))
    together = images(output)["features"]
    require_close("features that are the colours", together[..., :3], output.color, atol=2e-6)
    for i in range(features.shape[1]):
        alone = subject.render(gaussians, camera, RenderRequest(features=features[:, i : i + 1]))
        single = images(alone)["features"][..., 0]
        require_close(f"channel {i}", together[..., i], single, atol=2e-6, rtol=1e-5)


@CHECKS.check("R32")
def subset_draws_only_those(subject: RasterizerSubject) -> None:
    """Rows outside `subset` neither show nor occlude: as if they were removed."""
    scene = random_scene(90, channels=3)
    mask = torch.rand(90, generator=torch.Generator().manual_seed(5)) < 0.4
    request = scene.request
    some = subject.render(scene.gaussians, scene.camera, request.replace(subset=mask))
    assert request.features is not None and request.screen_offsets is not None
    fewer = request.replace(
        features=request.features[mask], screen_offsets=request.screen_offsets[mask]
    )
    only = subject.render(scene.gaussians[mask], scene.camera, fewer)
    require_same_images(some, only)
    require_zero("info['radii'] outside the subset", some.info["radii"].cpu()[~mask])
    no_rows = torch.zeros(90, dtype=torch.bool)
    none = subject.render(scene.gaussians, scene.camera, RenderRequest(subset=no_rows))
    require_zero("alpha of an empty subset", none.alpha)


@CHECKS.check("R33")
def no_gaussians_leave_the_background(subject: RasterizerSubject) -> None:
    """Without Gaussians the picture is the background, and can still be differentiated."""
    back = torch.tensor([0.3, 0.2, 0.1])
    for limit in subject.choices("min_alpha", (1 / 255, 0.0)):
        request = RenderRequest(features=torch.zeros(0, 3), background=back, min_alpha=limit)
        scene = Scene(random_gaussians(10)[:0], front_camera(), request)
        output, gradients = subject.drawn(scene, squares)
        features = images(output)["features"]
        require(features.shape == (15, 21, 3), f"features have shape {list(features.shape)}")
        for name in ("alpha", "depth", "features"):
            require_zero(name, images(output)[name].detach())
        require_close("color", output.color, back.expand(15, 21, 3), atol=0.0)
        slope = gradients["background"]
        require(slope is not None and (slope > 0).all(), f"gradient of background is {slope}")
        radii = output.info["radii"]
        require(radii.shape == (0,), f"info['radii'] has shape {list(radii.shape)}")


@CHECKS.check("R34")
def all_behind_the_camera(subject: RasterizerSubject) -> None:
    """A scene behind the camera is empty, and every gradient is zero."""
    gaussians = random_gaussians(30)
    behind = gaussians.replace(means=gaussians.means - torch.tensor([0.0, 0.0, 9.0]))
    output, gradients = subject.drawn(Scene(behind, front_camera()), squares)
    for name, image in images(output).items():
        require_zero(name, image.detach())
    require_zero("expected_depth", output.expected_depth.detach())
    for name, gradient in gradients.items():
        require_zero(f"gradient of {name}", gradient)


@CHECKS.check("R35")
def one_row_alone(subject: RasterizerSubject) -> None:
    """N = 1 and N = 7 draw what those rows are, in images of one pixel and more."""
    gaussians = random_gaussians(7, degree=1)
    for camera in (a_camera(), a_camera(1, 1)):
        order = torch.argsort(camera.to_camera(gaussians.means)[:, 2])
        whole = subject.render(gaussians, camera)
        color, left = torch.zeros_like(whole.color), torch.ones_like(whole.alpha)
        for row in order.tolist():
            single = subject.render(gaussians[row : row + 1], camera)
            color = color + left[..., None] * single.color
            left = left * (1 - single.alpha)
        require_close("color", whole.color, color, atol=1e-5)
        require_close("alpha", whole.alpha, 1 - left, atol=1e-5)
