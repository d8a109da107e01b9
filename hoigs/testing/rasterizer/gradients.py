"""R40 to R53: gradients, against the oracle's, the rules and finite differences."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor
from torch.autograd.gradcheck import GradcheckError

from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.values.camera import Camera
from hoigs.core.values.gaussians import SH_C0, Gaussians
from hoigs.testing.checks import CheckError, require, require_close, require_zero
from hoigs.testing.rasterizer.subject import (
    CHECKS,
    ORACLE,
    PARTS,
    RAW,
    RasterizerSubject,
    Scene,
    a_camera,
    absolute_gradients,
    camera_gradients,
    float64,
    free,
    front_camera,
    images,
    on,
    one_gaussian,
    random_gaussians,
    random_scene,
    received,
    reference,
    require_reference_gradients,
    require_reference_picture,
    weighing,
)


@cache
def graded_scene(seed: int = 0, degree: int = 3, offset: float = 0.5) -> Scene:
    return random_scene(100, degree=degree, seed=seed, offset=offset)


@cache
def thin_scene() -> Scene:
    """Antialiased discs, some of them seen from their edge."""
    scene = random_scene(100, seed=2)
    log_scales = scene.gaussians.log_scales.clone()
    log_scales[::2, 2] = -7.0
    gaussians = scene.gaussians.replace(log_scales=log_scales)
    return Scene(gaussians, scene.camera, scene.request.replace(antialiased=True))


@CHECKS.check("R40")
def gradients_are_the_oracles(subject: RasterizerSubject) -> None:
    """Every raw field, features, offsets and background get the oracle's gradient."""
    names = (*RAW, "features", "screen_offsets", "background")
    for scene in (graded_scene(0), graded_scene(1, offset=0.0)):
        require_reference_gradients(subject, scene, names=names)


@CHECKS.check("R41")
def gradients_of_each_image_alone(subject: RasterizerSubject) -> None:
    """The same when the loss sees colour, alpha, depth or features alone."""
    for part in PARTS:
        require_reference_gradients(subject, graded_scene(), (part,))


@CHECKS.check("R42", camera_gradients)
def gradients_of_the_pose(subject: RasterizerSubject) -> None:
    """The camera's pose gets the oracle's gradient, through positions and through colours."""
    moved, in_place = graded_scene(0), graded_scene(1, offset=0.0)
    for scene, parts in ((moved, PARTS), (in_place, ("color",)), (in_place, ("depth",))):
        require_reference_gradients(subject, scene, parts, ("world_to_camera",))


@CHECKS.check("R43")
def gradients_of_every_harmonic_degree(subject: RasterizerSubject) -> None:
    """Coefficients, and means through the direction of view, for SH degrees 0, 1 and 2."""
    for degree in range(3):
        scene = graded_scene(3, degree, 0.0)
        require_reference_gradients(subject, scene, ("color",), ("sh", "means"))


@CHECKS.check("R44")
def background_colour_takes_its_gradient(subject: RasterizerSubject) -> None:
    """The gradient of a background colour is the sum of (1 - alpha)."""
    request = RenderRequest(background=torch.tensor([0.2, 0.5, 0.7]))
    scene = Scene(random_gaussians(50, degree=0), a_camera(), request)
    output, gradients = subject.drawn(scene, lambda output: output.color.sum())
    left = float((1 - output.alpha.detach()).sum())
    slope = received(gradients, "background")
    require_close("gradient of background", slope, torch.full((3,), left), atol=0.0, rtol=1e-5)


@CHECKS.check("R45")
def screen_offsets_get_the_screen_space_gradient(subject: RasterizerSubject) -> None:
    """Zero offsets that require grad, as density control uses them, get the true slope."""
    request = RenderRequest(screen_offsets=torch.zeros(50, 2))
    scene = Scene(random_gaussians(50, degree=0), a_camera(), request)
    _, gradients = subject.drawn(scene, lambda output: output.color.square().sum())
    slopes = received(gradients, "screen_offsets")
    seen = int(slopes.norm(dim=-1).argmax())
    losses = []
    for step in (1e-4, -1e-4):
        shifted = torch.zeros(50, 2, dtype=torch.float64)
        shifted[seen, 0] = step
        moved = RenderRequest(screen_offsets=shifted)
        losses.append(ORACLE.render(scene.gaussians, scene.camera, moved).color.square().sum())
    slope = (losses[0] - losses[1]) / 2e-4
    what = f"gradient of screen_offsets[{seen}, 0]"
    require_close(what, slopes[seen, 0], slope, atol=0.0, rtol=1e-3)


@CHECKS.check("R46")
def no_gradient_where_alpha_is_clamped(subject: RasterizerSubject) -> None:
    """Where alpha is clamped to max_alpha, shape and opacity get no gradient."""
    splat = one_gaussian(scale=30.0).replace(opacity_logits=torch.tensor([20.0]))
    (limit,) = subject.choices("max_alpha", (0.3,))
    scene = Scene(splat, front_camera(), RenderRequest(max_alpha=limit))
    output, gradients = subject.drawn(scene, lambda output: output.alpha[5:10, 8:13].sum())
    require_close("alpha", output.alpha[7, 10], limit, atol=1e-6)
    for name in ("means", "log_scales", "opacity_logits"):
        require_zero(f"gradient of {name}", gradients[name])


@CHECKS.check("R47")
def no_gradient_to_colours_clamped_at_zero(subject: RasterizerSubject) -> None:
    """A colour below zero is drawn as zero and gets no gradient."""
    scene = Scene(one_gaussian(color=(-0.5, 0.5, 0.5)), front_camera())
    output, gradients = subject.drawn(scene, lambda output: output.color.sum())
    require_zero("the red image", output.color[..., 0].detach())
    slopes = received(gradients, "sh")
    require_zero("gradient of the red coefficient", slopes[0, 0, 0])
    require(slopes[0, 0, 1] > 0, f"gradient of the green coefficient is {float(slopes[0, 0, 1])}")


@CHECKS.check("R48")
def culled_rows_get_zero_gradients(subject: RasterizerSubject) -> None:
    """Rows behind the camera, off the image and fainter than min_alpha get zero gradients."""
    behind, aside = one_gaussian((0, 0, -2)), one_gaussian((50, 0, 2))
    faint = one_gaussian(opacity=0.001)
    scene = Scene(Gaussians.cat([behind, one_gaussian(), aside, faint]), front_camera())
    output, gradients = subject.drawn(
        scene, lambda output: output.color.square().sum() + output.depth.sum()
    )
    shown = output.info["radii"].gt(0).tolist()
    require(shown == [False, True, False, False], f"info['radii'] > 0 is {shown}")
    for name in RAW:
        gradient = received(gradients, name)
        require_zero(f"gradient of {name} in culled rows", gradient[[0, 2, 3]])
    slope = received(gradients, "opacity_logits")
    require(slope[1] != 0, "the one that is seen got no gradient")


@CHECKS.check("R49", float64, free("min_alpha", "min_transmittance"))
def gradcheck_in_float64(subject: RasterizerSubject) -> None:
    """torch.autograd.gradcheck of every input in float64, without cut-offs.

    Its fast mode, a random direction of each input and output, takes a twentieth of the time.
    """
    generator = torch.Generator().manual_seed(1)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    camera = a_camera(4, 3).to(torch.float64)
    leaves = [
        normal(3, 3) * 0.4,
        normal(3, 4),
        normal(3, 3) * 0.3 - 0.7,
        normal(3) * 0.5,
        normal(3, 4, 3) * 0.2,
        normal(3, 1),
        normal(3, 2) * 0.1,
        torch.rand(3, generator=generator, dtype=torch.float64),
    ]
    if camera_gradients(subject) is None:
        leaves.append(camera.world_to_camera.clone())
    device = subject.device
    smooth = RenderRequest(min_alpha=0.0, min_transmittance=0.0)

    def render(*x: Tensor) -> tuple[Tensor, ...]:
        request = smooth.replace(features=x[5], screen_offsets=x[6], background=x[7])
        pose = x[8] if len(x) > 8 else camera.world_to_camera.to(device)
        view = Camera(on(device, camera).K, pose, 4, 3)
        return tuple(images(subject.rasterizer.render(Gaussians(*x[:5]), view, request)).values())

    inputs = [x.to(device).requires_grad_() for x in leaves]
    try:
        torch.autograd.gradcheck(render, inputs, eps=1e-6, atol=1e-6, fast_mode=True)
    except GradcheckError as error:
        raise CheckError(f"in the order of the fields: {error}") from error


@CHECKS.check("R50", float64)
def float64_is_the_oracle(subject: RasterizerSubject) -> None:
    """In float64 pictures and gradients are the oracle's to 1e-9, at every pixel."""
    scene = graded_scene()
    to64 = {
        name: x.double()
        for name in ("features", "screen_offsets", "background")
        if (x := getattr(scene.request, name)) is not None
    }
    gaussians = scene.gaussians.to(torch.float64)
    exact = Scene(gaussians, scene.camera.to(torch.float64), scene.request.replace(**to64))
    everywhere = torch.ones_like(reference(scene).clear)
    wanted, wanted_gradients = ORACLE.drawn(exact, weighing(PARTS, everywhere))
    output, gradients = subject.drawn(exact, weighing(PARTS, everywhere))
    for name, image in images(output).items():
        require_close(name, image, images(wanted)[name], atol=1e-9)
    for name in gradients:
        gradient, want = received(gradients, name), received(wanted_gradients, name)
        require_close(f"gradient of {name}", gradient, want, atol=1e-9, rtol=1e-9)


@CHECKS.check("R51", absolute_gradients)
def absolute_gradients_are_the_oracles(subject: RasterizerSubject) -> None:
    """Each pixel's |gradient|, of all images together, is summed; nothing else changes."""
    scene = graded_scene()
    request = scene.request.replace(absolute_gradients=torch.full((100, 2), 3.0))
    asking = Scene(scene.gaussians, scene.camera, request)
    for parts in (PARTS, ("color",)):
        require_reference_gradients(subject, asking, parts)
    require_close("colour", subject.draw(asking).color, subject.draw(scene).color, atol=0.0)


@CHECKS.check("R52", free("antialiased"))
def antialiased_gradients_are_the_oracles(subject: RasterizerSubject) -> None:
    """Antialiased, the picture and the gradient of every input are the oracle's, of discs too."""
    require_reference_picture(subject, thin_scene())
    require_reference_gradients(subject, thin_scene())


@CHECKS.check("R53")
def black_learns(subject: RasterizerSubject) -> None:
    """A channel that is exactly 0, or below it by no more than rounding, takes its gradient."""
    for degree in (0, 1):
        gaussians = random_gaussians(12, degree=degree)
        black = -0.5 / SH_C0
        sh = torch.zeros_like(gaussians.sh)
        sh[:4, 0], sh[4:8, 0] = black, torch.tensor([1.2, black, 0.3])
        sh[8:, 0] = black * (1 + 1e-7)
        scene = Scene(gaussians.replace(sh=sh), a_camera())
        _, gradients = subject.drawn(scene, lambda output: output.color.sum())
        slopes = received(gradients, "sh")
        least = float(slopes[:, 0].min())
        require(least > 0, f"of the coefficients of colours at 0 one has the gradient {least:g}")
        require_reference_gradients(subject, scene, ("color",), ("sh",))
