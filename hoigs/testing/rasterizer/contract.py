"""R80 to R86: repeatability, unchanged inputs, and errors that name what is wrong."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from hoigs.core.errors import CameraError, RenderError
from hoigs.core.interfaces.rasterizer import RenderOutput, RenderRequest
from hoigs.core.values.gaussians import Gaussians
from hoigs.rasterizers.compositing import project_gaussians
from hoigs.testing.checks import CheckError, require, require_close, require_finite, require_zero
from hoigs.testing.rasterizer.drawing import require_same_images, squares
from hoigs.testing.rasterizer.subject import (
    CHECKS,
    RAW,
    RasterizerSubject,
    Scene,
    a_camera,
    deterministic,
    fixed_options,
    forged,
    front_camera,
    images,
    on,
    one_gaussian,
    random_gaussians,
    random_scene,
    received,
)


@CHECKS.check("R80", deterministic)
def two_runs_agree_bit_for_bit(subject: RasterizerSubject) -> None:
    """Pictures and gradients of two runs are the same bits."""
    scene = random_scene(150)
    (first, a), (second, b) = (subject.drawn(scene, squares) for _ in range(2))
    for name, image in images(first).items():
        require(torch.equal(image, images(second)[name]), f"{name} differs from run to run")
    for name in a:
        same = torch.equal(received(a, name), received(b, name))
        require(same, f"gradient of {name} differs from run to run")


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
            values: dict[str, Any] = {
                "gaussians": GOOD, "camera": front_camera(), "request": RenderRequest()
            }  # fmt: skip
            (field,) = changes
            values[part] = forged(values[part], **changes)
            message = _refusal(subject, f"a wrong {part}.{field}", **values)
            name = type(subject.rasterizer).__name__
            named = name in message and (field in message or part == "camera")
            require(named, f"the error for {part}.{field} names neither: {message}")


@CHECKS.check("R85")
def another_device_is_refused(subject: RasterizerSubject) -> None:
    """A camera or features on another device than the Gaussians are refused by name."""
    gaussians, camera = GOOD.to(subject.device), front_camera()
    here = on(subject.device, camera)
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
        what = f"request.{option} = {other}"
        message = _refusal(subject, what, GOOD, front_camera(), request)
        named = option in message and str(value) in message
        require(named, f"the error does not name {option} and {value}: {message}")


def _refusal(
    subject: RasterizerSubject, what: str, gaussians: Any, camera: Any, request: Any
) -> str:
    """The message of the RenderError that `what` has to raise."""
    try:
        subject.render(gaussians, camera, request)
    except RenderError as error:
        return str(error)
    raise CheckError(f"{what} was drawn")


# R60 to R66: broken and extreme numbers affect only the rows that hold them.

ROWS = (*RAW, "features", "screen_offsets")
NOT_FINITE = (math.nan, math.inf, -math.inf)
# rows that the rules of `hoigs.core.maths.projection` do not draw, whatever else they hold
CULLED = (
    *((name, x) for name in ROWS for x in NOT_FINITE if name != "opacity_logits" or math.isnan(x)),
    ("quats", 0.0),
    ("quats", 1e-40),
    ("quats", 1e30),
    ("log_scales", 20.0),
    ("log_scales", 80.0),
    ("log_scales", 1e30),
    ("means", 1e15),
    ("means", 3e38),
    ("screen_offsets", 1e30),
)


def require_only_good_rows(subject: RasterizerSubject, scene: Scene, good: Tensor) -> None:
    """Picture and gradients are those of the good rows alone; the others get zeros."""
    mixed, gradients = subject.drawn(scene, squares)
    clean, clean_gradients = subject.drawn(rows_of(scene, good), squares)
    for name, image in images(clean).items():
        require_finite(name, image.detach())
        require_close(name, images(mixed)[name], image, atol=2e-6, rtol=1e-5)
    for name in gradients:
        gradient, wanted = received(gradients, name), received(clean_gradients, name)
        what = f"gradient of {name}"
        if name not in ROWS:
            scale = float(wanted.abs().max())
            require_close(what, gradient, wanted, atol=1e-4 * scale)
            continue
        require_zero(f"{what} in bad rows", gradient[~good])
        require_close(f"{what} in good rows", gradient[good], wanted, atol=1e-6, rtol=1e-4)
    require_zero("info['radii'] of bad rows", mixed.info["radii"].cpu()[~good])
    for name in {"radii", "means2d", "depths"} & mixed.info.keys():
        require_finite(f"info['{name}']", mixed.info[name])


def rows_of(scene: Scene, rows: Tensor) -> Scene:
    """Some rows of a scene."""
    fields = {
        name: value[rows]
        for name in ("features", "screen_offsets")
        if (value := getattr(scene.request, name)) is not None
    }
    return Scene(scene.gaussians[rows], scene.camera, scene.request.replace(**fields))


def corrupted(scene: Scene, damage: Callable[[dict[str, Tensor]], None]) -> Scene:
    """A copy whose row tensors, by name, `damage` has changed in place."""
    parts: dict[str, Tensor] = {name: getattr(scene.gaussians, name).clone() for name in RAW}
    for name in ("features", "screen_offsets"):
        parts[name] = getattr(scene.request, name).clone()
    damage(parts)
    fields = {name: parts[name] for name in ("features", "screen_offsets")}
    gaussians = Gaussians(*(parts[name] for name in RAW))
    return Scene(gaussians, scene.camera, scene.request.replace(**fields))


@CHECKS.check("R60")
def bad_rows_affect_only_themselves(subject: RasterizerSubject) -> None:
    """NaN, infinities, zero quaternions, huge scales and places, in whole rows and in one entry."""
    for seed in range(2):
        generator = torch.Generator().manual_seed(seed)
        count = 3 * len(CULLED)
        bad = torch.randperm(count, generator=generator)[: len(CULLED)]
        good = torch.ones(count, dtype=torch.bool)
        good[bad] = False

        def damage(parts: dict[str, Tensor], whole: bool = seed == 0, bad: Tensor = bad) -> None:
            for row, (name, value) in zip(bad.tolist(), CULLED):
                if whole or parts[name].dim() == 1 or (name == "quats" and math.isfinite(value)):
                    parts[name][row] = value
                else:
                    parts[name][row].view(-1)[-1] = value

        scene = random_scene(count, degree=1, seed=seed, channels=2, offset=1.0)
        require_only_good_rows(subject, corrupted(scene, damage), good)


@CHECKS.check("R61")
def random_bits_affect_only_their_rows(subject: RasterizerSubject) -> None:
    """Rows whose fields are random bits, in each field alone and in all of them."""
    for seed, names in enumerate(((name,) for name in ROWS), start=1):
        _random_bits(subject, seed, names)
    _random_bits(subject, 0, ROWS)


def _random_bits(subject: RasterizerSubject, seed: int, names: tuple[str, ...]) -> None:
    count, generator = 60, torch.Generator().manual_seed(seed)
    broken = torch.rand(count, generator=generator) < 0.5

    def damage(parts: dict[str, Tensor]) -> None:
        for name in names:
            shape = parts[name][broken].shape
            bits = torch.randint(-(2**31), 2**31, shape, generator=generator, dtype=torch.int64)
            bits[::2] |= 0x7F800000  # every other row: NaN of all kinds and infinities
            parts[name][broken] = bits.to(torch.int32).view(torch.float32)

    scene = corrupted(random_scene(count, degree=1, seed=seed, channels=2), damage)
    # some random bits are numbers that are drawn by the rules; those rows are left out
    exact = scene.gaussians.to(torch.float64)
    culled = torch.ones(count, dtype=torch.bool)
    culled[project_gaussians(exact, scene.camera, scene.request).index] = False
    keep = culled | ~broken
    require(int((culled & broken).sum()) > 10, "too few rows are broken")
    require_only_good_rows(subject, rows_of(scene, keep), ~broken[keep])


@CHECKS.check("R62")
def denormal_numbers_draw_as_zero(subject: RasterizerSubject) -> None:
    """Denormal values in every field draw what zeros draw, with finite gradients."""
    gaussians, quats = random_gaussians(40, degree=1), random_gaussians(40, seed=1).quats

    def half_filled(value: float) -> Gaussians:
        filled = gaussians.map(lambda x: torch.cat((x[:20], torch.full_like(x[:20], value))))
        return filled.replace(quats=quats)

    tiny, zero = half_filled(1e-40), half_filled(0.0)
    output, gradients = subject.drawn(Scene(tiny, a_camera()), squares)
    wanted = subject.render(zero, a_camera())
    for name, image in images(wanted).items():
        require_close(name, images(output)[name], image, atol=1e-6, rtol=1e-6)
    for name in gradients:
        received(gradients, name)


@CHECKS.check("R63")
def large_values_change_only_their_pixels(subject: RasterizerSubject) -> None:
    """A colour or feature of 1e30 and opacities at their ends change only pixels they cover."""
    scene = random_scene(60, degree=0, channels=2, offset=0.0)
    behind_all = scene.camera.to_camera(scene.gaussians.means)[:, 2].argmax()
    means = scene.gaussians.means.clone()
    means[behind_all] = scene.camera.unproject(torch.tensor([5.0, 5.0]), torch.tensor(9.0))
    scales = scene.gaussians.log_scales.clone()
    scales[behind_all] = math.log(0.3)
    gaussians = scene.gaussians.replace(means=means, log_scales=scales)
    alone = torch.zeros(60, dtype=torch.bool)
    alone[behind_all] = True
    covered = (subject.render(gaussians, scene.camera, RenderRequest(subset=alone)).alpha > 0).cpu()
    require(0 < int(covered.sum()) < covered.numel() / 2, "the scene does not show the row")

    def elsewhere(output: RenderOutput) -> Tensor:
        values = [image[~covered.to(image.device)] for image in images(output).values()]
        return sum((value.square().sum() for value in values), torch.zeros(()))

    plain = Scene(gaussians, scene.camera, scene.request)
    wanted, wanted_gradients = subject.drawn(plain, elsewhere)

    def enlarge(parts: dict[str, Tensor]) -> None:
        parts["sh"][behind_all] = 1e30
        parts["features"][behind_all] = -1e30

    output, gradients = subject.drawn(corrupted(plain, enlarge), elsewhere)
    for name, image in images(wanted).items():
        got = images(output)[name].detach().cpu()[~covered]
        want = image.detach().cpu()[~covered]
        require_close(f"{name} elsewhere", got, want, atol=2e-6, rtol=1e-5)
    others = ~alone
    for name in ROWS:
        actual, want = received(gradients, name), received(wanted_gradients, name)
        what = f"gradient of {name} in other rows"
        require_close(what, actual[others], want[others], atol=1e-5, rtol=1e-4)
    for logit, opacity in ((1e30, 1.0), (-1e30, 0.0)):
        splat = one_gaussian(scale=3.0).replace(opacity_logits=torch.tensor([logit]))
        (limit,) = subject.choices("max_alpha", (0.999,))
        alpha = subject.render(splat, a_camera(), RenderRequest(max_alpha=limit)).alpha.max()
        require_close(f"alpha with logit {logit:g}", alpha, min(opacity, limit), atol=1e-6)


@CHECKS.check("R64")
def a_broken_camera_is_drawn_or_refused(subject: RasterizerSubject) -> None:
    """NaN, infinity and zero in the camera give a finite picture, a RenderError or a CameraError.

    The camera is forged, as no camera looks at its values where they require gradients or lie on
    a GPU.
    """
    gaussians, camera = random_gaussians(30, degree=1), a_camera()
    for field, place in (("K", (0, 0)), ("K", (1, 2)), ("world_to_camera", (0, 0)),
                         ("world_to_camera", (2, 3))):  # fmt: skip
        for value in (*NOT_FINITE, 0.0, 1e30, -1e30):
            broken = getattr(camera, field).clone()
            broken[place] = value
            scene = Scene(gaussians, forged(camera, **{field: broken}))
            try:
                output, gradients = subject.drawn(scene, squares)
            except (RenderError, CameraError):
                continue
            what = f"with {field}{list(place)} = {value}"
            for name, image in images(output).items():
                require_finite(f"{name} {what}", image.detach())
            for name in RAW:
                received(gradients, name, what)


@CHECKS.check("R65")
def a_broken_background_pixel_affects_no_other(subject: RasterizerSubject) -> None:
    """NaN in one pixel of the background shows there and nowhere else."""
    scene = random_scene(60, degree=0, channels=1, offset=0.0)
    clean = subject.draw(scene)
    assert scene.request.background is not None
    back = scene.request.background.clone()
    back[3, 5] = math.nan
    output = subject.render(scene.gaussians, scene.camera, scene.request.replace(background=back))
    there = torch.zeros_like(clean.alpha, dtype=torch.bool)
    there[3, 5] = True
    require_close("color elsewhere", output.color[~there], clean.color[~there], atol=0.0)
    for name in ("alpha", "depth", "features"):
        require_close(name, images(output)[name], images(clean)[name], atol=0.0)


@CHECKS.check("R66")
def infinite_logits_are_opaque_or_nothing(subject: RasterizerSubject) -> None:
    """A logit of +infinity is an opacity of 1, one of -infinity of 0; their gradients are zero."""
    for limit in subject.choices("max_alpha", (0.999, 0.5)):
        opaque = one_gaussian(scale=300.0).replace(opacity_logits=torch.tensor([math.inf]))
        alpha = subject.render(opaque, a_camera(), RenderRequest(max_alpha=limit)).alpha.max()
        require_close("alpha of an infinite logit", alpha, limit, atol=1e-6)
    for cut in subject.choices("min_alpha", (1 / 255, 0.0)):
        scene = random_scene(60, degree=1, channels=2)
        request = scene.request.replace(min_alpha=cut)
        logits = scene.gaussians.opacity_logits.clone()
        logits[:20] = torch.tensor([math.inf, -math.inf]).repeat(10)
        finite = logits.clamp(-100.0, 100.0)  # opacities of 0 and 1 in float32
        (output, gradients), (wanted, wanted_gradients) = (
            subject.drawn(
                Scene(scene.gaussians.replace(opacity_logits=x), scene.camera, request), squares
            )
            for x in (logits, finite)
        )
        require_same_images(output, wanted)
        for name in gradients:
            gradient, want = received(gradients, name), received(wanted_gradients, name)
            size = float(want.abs().max())
            require_close(f"gradient of {name}", gradient, want, atol=1e-4 * size)
            if name == "opacity_logits":
                require_zero("gradient of infinite logits", gradient[:20])
