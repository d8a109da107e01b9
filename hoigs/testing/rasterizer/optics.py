"""R70 to R72: cameras that are no pinhole, against the oracle's, and what is not declared."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import torch

from hoigs.core.errors import RenderError
from hoigs.core.interfaces.rasterizer import OPTICS, RenderRequest
from hoigs.core.maths.optics import Optics
from hoigs.core.values.camera import Camera
from hoigs.testing.checks import CheckError, require
from hoigs.testing.rasterizer.subject import (
    CHECKS,
    RasterizerSubject,
    Scene,
    random_gaussians,
    random_scene,
    reference,
    require_reference_gradients,
    require_reference_picture,
)

FISHEYE = (0.05, -0.02, 0.01, -0.003)
RADIAL = (-0.28, 0.07, -0.004, 0.02, 0.01, 0.003)


@cache
def optics_scenes() -> dict[str, Scene]:
    """Scenes by name: every model and shutter, and cameras with Gaussians all around them."""
    base = random_scene(90, degree=1)
    camera = base.camera
    turn, shift = torch.tensor([0.03, -0.02, 0.05]), torch.tensor([0.1, 0.05, -0.05])
    last = camera.moved(turn, shift).world_to_camera
    far = camera.moved(torch.tensor([-0.3, 0.1, 0.2]), torch.tensor([0.2, -0.4, 0.1]))
    flat = camera.K * torch.tensor([[0.3], [0.3], [1.0]])
    flat[:2, 2] = camera.K[:2, 2]

    def seen_by(optics: Optics, antialiased: bool = False) -> Scene:
        view = replace(camera, K=flat if optics.model == "ortho" else camera.K, optics=optics)
        return Scene(base.gaussians, view, base.request.replace(antialiased=antialiased))

    lens = Optics(
        radial=RADIAL, tangential=(0.004, -0.006), thin_prism=(0.01, -0.004, 0.006, 0.003)
    )
    return {
        "unscented": seen_by(Optics()),
        "ortho": seen_by(Optics("ortho")),
        "fisheye": seen_by(Optics("fisheye")),
        "a distorted fisheye": seen_by(Optics("fisheye", FISHEYE), antialiased=True),
        "a distorted pinhole": seen_by(lens),
        "a fisheye among its Gaussians": _all_around(Optics("fisheye", FISHEYE)),
        "a lens that turns back": _all_around(Optics(radial=(-0.3, 0.02))),
        "rows": seen_by(Optics("fisheye", FISHEYE, shutter="top_to_bottom",
                               last_world_to_camera=last), antialiased=True),
        "columns backwards": seen_by(replace(lens, shutter="right_to_left",
                                             last_world_to_camera=last)),
        "rows in a fast turn": seen_by(replace(lens, shutter="top_to_bottom",
                                               last_world_to_camera=far.world_to_camera)),
    }  # fmt: skip


def _all_around(optics: Optics) -> Scene:
    """Most rows are behind, beside or beyond what the lens shows; one is in the image centre."""
    gaussians = random_gaussians(160, degree=1, seed=3)
    means = 2.0 * torch.nn.functional.normalize(gaussians.means, dim=-1)
    means[0] = torch.tensor([0.0, 0.0, 2.0])
    K = torch.tensor([[13.0, 0.0, 22.5], [0.0, 13.0, 15.5], [0.0, 0.0, 1.0]])
    camera = Camera(K, torch.eye(4), 44, 30, optics)
    return Scene(gaussians.replace(means=means), camera, RenderRequest())


def _declared(subject: RasterizerSubject) -> dict[str, Scene]:
    able = subject.rasterizer.capabilities.optics
    return {
        name: scene
        for name, scene in optics_scenes().items()
        if scene.camera.optics is not None and scene.camera.optics.needs <= able
    }


def any_optics(subject: RasterizerSubject) -> str | None:
    return None if _declared(subject) else "no optics are declared"


def undeclared_optics(subject: RasterizerSubject) -> str | None:
    missing = OPTICS - subject.rasterizer.capabilities.optics
    return None if missing else "all optics are declared"


@CHECKS.check("R70", any_optics)
def pictures_through_optics_are_the_oracles(subject: RasterizerSubject) -> None:
    """Through every declared lens and shutter the picture is the oracle's, and so is who is in."""
    for name, scene in _declared(subject).items():
        try:
            output = require_reference_picture(subject, scene)
            shown, wanted = (x.info["radii"].cpu() > 0 for x in (output, reference(scene).output))
            require(torch.equal(shown, wanted), "other rows are drawn")
        except CheckError as error:
            raise CheckError(f"{name}: {error}") from error


@CHECKS.check("R71", any_optics)
def gradients_through_optics_are_the_oracles(subject: RasterizerSubject) -> None:
    """So are the gradients of every input, of the pose and of the last pose."""
    for name, scene in _declared(subject).items():
        try:
            require_reference_gradients(subject, scene)
        except CheckError as error:
            raise CheckError(f"{name}: {error}") from error


@CHECKS.check("R72", undeclared_optics)
def undeclared_optics_are_refused_by_name(subject: RasterizerSubject) -> None:
    """Optics that are not declared raise a RenderError that names backend and optics."""
    able = subject.rasterizer.capabilities.optics
    for scene in optics_scenes().values():
        optics = scene.camera.optics
        missing = (optics.needs - able) if optics is not None else ()
        if not missing:
            continue
        try:
            subject.draw(scene)
        except RenderError as error:
            names = (type(subject.rasterizer).__name__, *missing)
            require(all(x in str(error) for x in names), f"the error names no {names}: {error}")
        else:
            raise CheckError(f"a camera with {' and '.join(missing)} was drawn")
