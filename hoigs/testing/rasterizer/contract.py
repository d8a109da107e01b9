"""R80 to R86: repeatability, unchanged inputs, and errors that name what is wrong."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from typing import Any

import torch

from hoigs.core.errors import RenderError
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.testing.checks import CheckError
from hoigs.testing.compare import require, require_close
from hoigs.testing.rasterizer.rows import squares
from hoigs.testing.rasterizer.scenes import (
    RAW,
    a_camera,
    forged,
    front_camera,
    images,
    random_gaussians,
    random_scene,
)
from hoigs.testing.rasterizer.subject import (
    CHECKS,
    RasterizerSubject,
    deterministic,
    fixed_options,
)


@CHECKS.check("R80", deterministic)
def two_runs_agree_bit_for_bit(subject: RasterizerSubject) -> None:
    """Pictures and gradients of two runs are the same bits."""
    scene = random_scene(150)
    (first, a), (second, b) = (subject.drawn(scene, squares) for _ in range(2))
    for name, image in images(first).items():
        require(torch.equal(image, images(second)[name]), f"{name} differs from run to run")
    for name, gradient in a.items():
        again = b[name]
        assert gradient is not None and again is not None
        require(torch.equal(gradient, again), f"gradient of {name} differs from run to run")


@CHECKS.check("R81")
def renders_do_not_remember(subject: RasterizerSubject) -> None:
    """Earlier renders do not change a render, and a copy of the rasterizer draws the same."""
    scene = random_scene(100)
    first = subject.draw(scene)
    kept = {name: image.clone() for name, image in images(first).items()}
    subject.render(random_gaussians(300, seed=8), a_camera(70, 50))
    again = subject.draw(scene)
    other = RasterizerSubject(copy.deepcopy(subject.rasterizer), subject.device).draw(scene)
    for name, image in kept.items():
        require_close(f"{name}, kept", images(first)[name], image, atol=0.0)
        require_close(f"{name}, drawn again", images(again)[name], image, atol=1e-6)
        require_close(f"{name} of a copy", images(other)[name], image, atol=1e-6)


@CHECKS.check("R82")
def inputs_stay_as_they_were(subject: RasterizerSubject) -> None:
    """Rendering and its backward pass change no input."""
    scene = random_scene(60, degree=1)
    rows = scene.gaussians.to(subject.device)
    before = rows.clone()
    leaves = rows.map(lambda x: x.requires_grad_())
    squares(subject.render(leaves, scene.camera, scene.request)).backward()
    for name in RAW:
        require(torch.equal(getattr(rows, name), getattr(before, name)), f"{name} was changed")


@CHECKS.check("R83")
def no_graph_without_gradients(subject: RasterizerSubject) -> None:
    """A render under no_grad, or without a leaf that requires grad, keeps no graph."""
    scene = random_scene(20)
    plain = subject.draw(scene)
    leaves = scene.gaussians.map(lambda x: x.clone().requires_grad_())
    with torch.no_grad():
        without = subject.render(leaves, scene.camera, scene.request)
    for output in (plain, without):
        for name, image in images(output).items():
            require(not image.requires_grad, f"{name} requires grad")
    require(subject.render(leaves, scene.camera).color.requires_grad, "color lost its graph")


GOOD = random_gaussians(6, degree=1)
WRONG: dict[str, list[dict[str, Any]]] = {
    "gaussians": [
        {"means": torch.zeros(6, 2)},
        {"means": torch.zeros(())},
        {"quats": torch.zeros(5, 4)},
        {"log_scales": torch.zeros(6, 1)},
        {"opacity_logits": torch.zeros(6, 1)},
        {"sh": torch.zeros(6, 5, 3)},
        {"sh": torch.zeros(6, 3)},
        {"quats": torch.zeros(6, 4, dtype=torch.float64)},
        {"means": torch.zeros(6, 3, dtype=torch.float16)},
    ],
    "request": [
        {"features": torch.zeros(7, 2)},
        {"features": torch.zeros(6)},
        {"screen_offsets": torch.zeros(6, 3)},
        {"subset": torch.ones(5, dtype=torch.bool)},
        {"subset": torch.ones(6)},
        {"background": torch.zeros(4)},
        {"background": torch.zeros(21, 15, 3)},
        {"sh_degree": 4},
        {"sh_degree": -1},
        {"near": -1.0},
        {"near": math.nan},
        {"low_pass": -0.1},
        {"max_alpha": 0.0},
        {"max_alpha": 1.5},
        {"min_alpha": -0.1},
        {"min_transmittance": 1.0},
    ],
    "camera": [
        {"width": 0},
        {"height": -3},
        {"K": torch.eye(4)},
        {"world_to_camera": torch.eye(3)},
    ],
}


@CHECKS.check("R84")
def wrong_input_is_refused_by_name(subject: RasterizerSubject) -> None:
    """Wrong shapes, dtypes and limits raise a RenderError that names backend and field."""
    for part, mistakes in WRONG.items():
        for changes in mistakes:
            values = {"gaussians": GOOD, "camera": front_camera(), "request": RenderRequest()}
            message = _refusal(subject, **{**values, part: forged(values[part], **changes)})
            (field,) = changes
            name = type(subject.rasterizer).__name__
            require(message is not None, f"a wrong {part}.{field} was drawn")
            named = name in (message or "") and (field in (message or "") or part == "camera")
            require(named, f"the error for {part}.{field} names neither: {message}")


@CHECKS.check("R85")
def another_device_is_refused(subject: RasterizerSubject) -> None:
    """A camera or features on another device than the Gaussians are refused by name."""
    gaussians, camera = GOOD.to(subject.device), front_camera()
    here = replace(
        camera,
        K=camera.K.to(subject.device),
        world_to_camera=camera.world_to_camera.to(subject.device),
    )
    nowhere = replace(here, K=torch.eye(3, device="meta"))
    elsewhere = RenderRequest(features=torch.zeros(6, 2, device="meta"))
    for view, request in ((nowhere, None), (here, elsewhere)):
        try:
            subject.rasterizer.render(gaussians, view, request)
        except RenderError as error:
            require("meta" in str(error), f"the error does not name the device: {error}")
        else:
            raise CheckError("tensors of another device were drawn")


@CHECKS.check("R86", fixed_options)
def fixed_options_are_refused_by_name(subject: RasterizerSubject) -> None:
    """Another value of an option that is declared fixed raises a RenderError with its value."""
    for option, value in subject.rasterizer.capabilities.fixed.items():
        other = not value if isinstance(value, bool) else value * 0.5
        request = RenderRequest().replace(**{option: other})
        message = _refusal(subject, GOOD, front_camera(), request)
        require(message is not None, f"request.{option} = {other} was drawn")
        named = option in (message or "") and str(value) in (message or "")
        require(named, f"the error does not name {option} and {value}: {message}")


def _refusal(subject: RasterizerSubject, gaussians: Any, camera: Any, request: Any) -> str | None:
    """The message of the RenderError, or None when it was drawn."""
    try:
        subject.render(gaussians, camera, request)
    except RenderError as error:
        return str(error)
    return None
