"""Bad rows cost only themselves; empty and wrong input is answered; runs repeat."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from raster_scenes import (
    CUT,
    RAW,
    Backend,
    a_camera,
    assert_same_picture,
    clear_of_cutoffs,
    forged,
    front_camera,
    images,
    one_gaussian,
    random_scene,
)
from torch import Tensor

from hoigs.core.errors import RenderError
from hoigs.core.gaussians import Gaussians
from hoigs.core.rasterizer import RenderOutput, RenderRequest

NOT_FINITE = [math.nan, math.inf, -math.inf]
POISONS = [
    *[(name, value) for name in (*RAW, "features", "screen_offsets") for value in NOT_FINITE],
    ("quats", 0.0),
    ("quats", 1e-40),
    ("quats", 1e30),
    ("log_scales", 20.0),
    ("log_scales", 80.0),
    ("log_scales", 1e30),
    ("means", 1e15),
    ("means", 3e38),
    ("screen_offsets", 1e30),
]


def loss(output: RenderOutput) -> Tensor:
    return sum((image.square().mean() for image in images(output).values()), torch.zeros(()))


@pytest.mark.parametrize("all_entries", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_bad_rows_cost_only_themselves(backend: Backend, seed: int, all_entries: bool) -> None:
    """Rows with NaN, infinities, zero quaternions or huge scales, strewn among good ones."""
    generator = torch.Generator().manual_seed(seed)
    count = 3 * len(POISONS)
    gaussians, camera = random_scene(count, degree=1, seed=seed), a_camera()
    inputs = {name: getattr(gaussians, name).clone() for name in RAW}
    inputs["features"] = torch.randn(count, 2, generator=generator)
    inputs["screen_offsets"] = torch.randn(count, 2, generator=generator)
    bad = torch.randperm(count, generator=generator)[: len(POISONS)]
    for row, (name, value) in zip(bad.tolist(), POISONS):
        whole = all_entries or (name == "quats" and math.isfinite(value))
        inputs[name][row] = (
            value if whole or inputs[name].dim() == 1 else inputs[name][row].flatten()[0]
        )
        if not whole and inputs[name].dim() > 1:
            inputs[name][row].view(-1)[-1] = value
    good = torch.ones(count, dtype=torch.bool)
    good[bad] = False

    def drawn(rows: Tensor) -> tuple[RenderOutput, dict[str, Tensor]]:
        leaves = {name: x[rows].clone().requires_grad_() for name, x in inputs.items()}
        request = RenderRequest(
            features=leaves["features"], screen_offsets=leaves["screen_offsets"]
        )
        output = backend.render(Gaussians(*(leaves[k] for k in RAW)), camera, request)
        loss(output).backward()
        return output, {name: x.grad for name, x in leaves.items()}

    mixed, mixed_grads = drawn(torch.ones(count, dtype=torch.bool))
    clean, clean_grads = drawn(good)
    for name, image in images(clean).items():
        torch.testing.assert_close(images(mixed)[name], image, atol=2e-6, rtol=1e-5)
    for name, grad in mixed_grads.items():
        assert torch.isfinite(grad).all(), name
        assert not grad[bad].any(), name
        torch.testing.assert_close(grad[good], clean_grads[name], atol=1e-7, rtol=1e-4)
    assert not mixed.info["radii"].cpu()[bad].any()
    assert all(torch.isfinite(mixed.info[k]).all() for k in ("radii", "means2d", "depths"))


def test_denormal_numbers_are_as_good_as_zero(backend: Backend) -> None:
    gaussians, camera = random_scene(40, degree=1), a_camera()
    tiny, zero = (
        gaussians.map(lambda x, v=v: torch.cat((x[:20], torch.full_like(x[:20], v))))
        for v in (1e-40, 0.0)
    )
    quats = torch.randn(40, 4)
    leaves = tiny.replace(quats=quats).map(lambda x: x.clone().requires_grad_())
    output = backend.render(leaves, camera)
    wanted = backend.render(zero.replace(quats=quats), camera)
    torch.testing.assert_close(output.color.detach(), wanted.color)
    loss(output).backward()
    assert all(torch.isfinite(getattr(leaves, name).grad).all() for name in RAW)


@pytest.mark.parametrize("min_alpha", [1 / 255, 0.0])
def test_no_gaussians_leave_the_background(backend: Backend, min_alpha: float) -> None:
    gaussians = random_scene(10)[:0].map(lambda x: x.clone().requires_grad_())
    background = torch.tensor([0.3, 0.2, 0.1], requires_grad=True)
    request = RenderRequest(features=torch.zeros(0, 3), background=background, min_alpha=min_alpha)
    output = backend.render(gaussians, front_camera(), request)
    assert output.features.shape == (15, 21, 3)
    assert not output.alpha.any() and not output.depth.any() and not output.features.any()
    torch.testing.assert_close(
        output.color.detach().cpu(), background.detach().expand(15, 21, 3), rtol=0, atol=0
    )
    loss(output).backward()
    assert background.grad.gt(0).all()
    assert gaussians.means.grad is None or gaussians.means.grad.shape == (0, 3)
    assert output.info["radii"].shape == (0,)


def test_all_behind_the_camera(backend: Backend) -> None:
    gaussians = random_scene(30)
    gaussians = gaussians.replace(means=gaussians.means - torch.tensor([0.0, 0.0, 9.0]))
    leaves = gaussians.map(lambda x: x.clone().requires_grad_())
    output = backend.render(leaves, front_camera())
    assert not output.alpha.any() and not output.expected_depth.any()
    loss(output).backward()
    assert not leaves.means.grad.any()


def test_partly_culled(backend: Backend) -> None:
    gaussians, camera = random_scene(200, seed=4), a_camera()
    gaussians = gaussians.replace(means=gaussians.means * 3.0)
    wanted = CUT.render(gaussians, camera)
    shown = wanted.info["radii"] > 0
    assert 20 < int(shown.sum()) < 180
    output = backend.render(gaussians, camera)
    clear = clear_of_cutoffs(gaussians, camera, RenderRequest())
    assert_same_picture(output, wanted, clear)
    assert torch.equal((output.info["radii"] > 0).cpu(), shown)


def test_a_splat_over_the_whole_image_and_beyond(backend: Backend) -> None:
    """Centre far off screen, but its edge reaches in: the clamp of the Jacobian is at work."""
    camera = front_camera()
    giant = one_gaussian((6.0, -3.0, 2.0), scale=4.0, opacity=0.9)
    wanted = CUT.render(giant, camera)
    assert float(wanted.alpha.max()) > 0.1
    assert_same_picture(
        backend.render(giant, camera), wanted, clear_of_cutoffs(giant, camera, RenderRequest())
    )


def test_two_runs_agree_bit_for_bit(backend: Backend) -> None:
    if not backend.rasterizer.capabilities.deterministic:
        pytest.skip("the backend does not promise it")
    results = []
    for _ in range(2):
        leaves = random_scene(150).map(lambda x: x.clone().requires_grad_())
        output = backend.render(leaves, a_camera())
        loss(output).backward()
        results.append([*images(output).values(), *(getattr(leaves, k).grad for k in RAW)])
    assert all(torch.equal(a, b) for a, b in zip(*results))


GOOD = random_scene(6, degree=1)
WRONG_GAUSSIANS: list[dict[str, Any]] = [
    {"means": torch.zeros(6, 2)},
    {"means": torch.zeros(())},
    {"quats": torch.zeros(5, 4)},
    {"log_scales": torch.zeros(6, 1)},
    {"opacity_logits": torch.zeros(6, 1)},
    {"sh": torch.zeros(6, 5, 3)},
    {"sh": torch.zeros(6, 3)},
    {"quats": torch.zeros(6, 4, dtype=torch.float64)},
    {"means": torch.zeros(6, 3, dtype=torch.float16)},
]
WRONG_REQUESTS: list[dict[str, Any]] = [
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
]
WRONG_CAMERAS: list[dict[str, Any]] = [
    {"width": 0},
    {"height": -3},
    {"K": torch.eye(4)},
    {"world_to_camera": torch.eye(3)},
]


@pytest.mark.parametrize("part", ["gaussians", "request", "camera"])
def test_wrong_input_is_refused_by_name(backend: Backend, part: str) -> None:
    values = {"gaussians": GOOD, "camera": front_camera(), "request": RenderRequest()}
    wrong = {
        "gaussians": WRONG_GAUSSIANS,
        "request": WRONG_REQUESTS,
        "camera": WRONG_CAMERAS,
    }[part]
    for changes in wrong:
        (field,) = changes
        changed = values | {part: forged(values[part], **changes)}
        with pytest.raises(RenderError) as caught:
            backend.render(**changed)
        assert type(backend.rasterizer).__name__ in str(caught.value)
        assert field in str(caught.value) or part == "camera", f"{changes}: {caught.value}"


def test_another_device_is_refused(backend: Backend) -> None:
    if backend.device.type != "cpu":
        pytest.skip("the CPU's case covers it")
    nowhere = replace(front_camera(), K=torch.eye(3, device="meta"))
    with pytest.raises(RenderError, match="meta"):
        backend.rasterizer.render(GOOD, nowhere)
