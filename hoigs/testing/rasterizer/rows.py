"""R30 to R35: the order of rows does not matter, nor do rows change each other."""

from __future__ import annotations

import torch
from torch import Tensor

from hoigs.core.interfaces.rasterizer import RenderOutput, RenderRequest
from hoigs.testing.compare import require, require_close, require_zero
from hoigs.testing.rasterizer.scenes import (
    Scene,
    a_camera,
    front_camera,
    images,
    random_gaussians,
    random_scene,
)
from hoigs.testing.rasterizer.subject import CHECKS, RasterizerSubject


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
