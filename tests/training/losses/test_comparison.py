"""Image losses against boxes of a frame: numbers by hand, and kernels against the float64 twin."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from hoigs.core.spec.train_schema import LossSpec
from hoigs.training import losses as comparison
from hoigs.training.losses import Comparison, image_losses

CUDA = pytest.param(
    "cuda",
    marks=[
        pytest.mark.gpu,
        pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
    ],
)


def test_l1_of_an_entity_is_by_its_area_and_blind_to_ignored_pixels() -> None:
    mask = torch.zeros(12, 12, dtype=torch.bool)
    mask[:3, :4] = True
    one = Comparison(
        torch.full((12, 12, 3), 128, dtype=torch.uint8),
        shown=mask,
        background=torch.tensor([1.0, 0.0, 0.0]),
        area=12,
    )
    render = one.target.clone()
    render[5, 5] += 0.6  # sticks out of the mask by one pixel, 0.6 in three channels
    assert float(image_losses(render, [one], 0.0, "torch")[0]) == pytest.approx(0.6 / 12)
    ignored = torch.zeros_like(mask)
    ignored[5, 5] = True
    hidden = replace(one, ignored=ignored)
    assert float(image_losses(render, [hidden], 0.0, "torch")[0]) == 0


def scene(height: int = 70, width: int = 90) -> tuple[Tensor, list[Comparison]]:
    """A render, and the whole frame, a box of it, and one of an entity over a colour."""
    generator = torch.Generator().manual_seed(3)
    render = torch.rand(height, width, 3, generator=generator)
    pixels = (255 * torch.rand(height, width, 3, generator=generator)).byte()
    masks = torch.rand(2, height, width, generator=generator) > 0.6
    box = (slice(7, 60), slice(20, 81))
    placed = {"top": 7, "left": 20}
    ground = torch.tensor([0.2, 0.9, 0.4])
    return render, [
        Comparison(pixels, ignored=masks[1]),
        Comparison(pixels[box], **placed),
        Comparison(pixels[box], masks[0][box], masks[1][box], ground, area=321, **placed),
    ]


def values_and_gradient(
    render: Tensor, comparisons: list[Comparison], dtype: torch.dtype
) -> tuple[Tensor, Tensor]:
    """By torch: the terms, and the gradient of a weighted sum of them."""
    leaf = render.to(dtype).requires_grad_()
    ours = [
        replace(c, background=None if c.background is None else c.background.to(dtype))
        for c in comparisons
    ]
    terms = torch.stack(image_losses(leaf, ours, 0.3, "torch"))
    return terms.detach(), torch.autograd.grad(terms @ weights(terms), leaf)[0]


def weights(terms: Tensor) -> Tensor:
    return torch.tensor([1.0, 0.7, 2.0]).to(terms)[: len(terms)]


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("chosen", [slice(0, 3), slice(1, 3), slice(2, 3)], ids=str)
def test_kernels_agree_with_the_twin(device: str, chosen: slice) -> None:
    render, comparisons = scene()
    comparisons = comparisons[chosen]
    exact, exact_gradient = values_and_gradient(render, comparisons, torch.float64)
    leaf = render.to(device).requires_grad_()
    moved = [
        replace(
            c,
            **{k: v.to(device) for k, v in vars(c).items() if isinstance(v, Tensor)},
        )
        for c in comparisons
    ]
    terms = comparison._by_kernels(leaf, moved, 0.3)
    gradient = torch.autograd.grad(terms @ weights(terms), leaf)[0].cpu()
    torch.testing.assert_close(terms.detach().cpu().double(), exact, rtol=2e-6, atol=0)
    assert float((gradient - exact_gradient).norm() / exact_gradient.norm()) < 1e-5
    assert ((gradient == 0) == (exact_gradient == 0)).all()


def test_pixels_in_another_order_are_refused() -> None:
    render, comparisons = scene()
    planes = comparisons[0].pixels.permute(2, 0, 1).contiguous().permute(1, 2, 0)
    with pytest.raises(ValueError, match="rows of RGB bytes"):
        comparison._by_kernels(render, [replace(comparisons[0], pixels=planes)], 0.3)


def test_masks_of_unequal_strides_are_refused() -> None:
    render, comparisons = scene()
    one = comparisons[2]
    assert one.shown is not None
    with pytest.raises(ValueError, match="one width"):
        comparison._by_kernels(render, [replace(one, shown=one.shown.clone())], 0.3)


def test_ssim_by_kernels_and_by_convolutions_give_the_same_gradients() -> None:
    render, comparisons = scene(40, 90)
    comparisons = comparisons[:1]
    found = {}
    for backend in ("warp", "torch"):
        leaf = render.clone().requires_grad_()
        (term,) = image_losses(leaf, comparisons, 0.3, backend)  # type: ignore[arg-type]
        found[backend] = (torch.autograd.grad(term, leaf)[0], term.detach())
    for warp, plain in zip(found["warp"], found["torch"], strict=True):
        assert float((warp - plain).norm() / plain.norm()) < 1e-5
    assert LossSpec().ssim == "warp"
    assert LossSpec.model_validate({"ssim": "torch"}).ssim == "torch"
