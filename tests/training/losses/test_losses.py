"""Loss terms against numbers worked out by hand."""

from __future__ import annotations

import pytest
import torch
from small_clip import small_clip, truth

from hoigs.core.spec.train_schema import LossSpec
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Frame
from hoigs.core.values.moment import Moment
from hoigs.metrics.image_loss import image_loss
from hoigs.metrics.ssim import ssim
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.training.losses import align_depth, crop_around, depth_loss, term_weights


def test_supplement_weights_and_overrides():
    supplement = {"human": 0.5, "object": 1.0, "scene": 0.25, "depth": 1.0}
    assert term_weights(LossSpec(weights="supp")) == supplement
    assert set(term_weights(LossSpec()).values()) == {1.0}
    assert term_weights(LossSpec(depth=0.1))["depth"] == 0.1


def test_image_loss_mixes_l1_and_dssim():
    a, b = torch.zeros(16, 16, 3), torch.full((16, 16, 3), 0.25)
    assert float(image_loss(a, b, 0.0)) == pytest.approx(0.25)
    assert float(image_loss(a, a, 0.2)) == pytest.approx(0.0, abs=1e-6)
    assert float(image_loss(a, b, 0.2)) > 0.8 * 0.25


def test_depth_loss_skips_what_is_unknown():
    depth = torch.full((8, 8), 2.0)
    prior = torch.full((8, 8), 4.0)
    alpha = torch.ones(8, 8)
    prior[0] = 0.0  # unknown
    loss = depth_loss(depth, alpha, prior, "metric")
    assert loss is not None and float(loss) == pytest.approx(0.5)
    assert depth_loss(depth, alpha, torch.zeros(8, 8), "metric") == 0
    assert depth_loss(depth, alpha, prior, "none") is None
    assert depth_loss(depth, 0.4 * alpha, prior, "metric") == 0


def test_depth_that_is_no_depth_is_skipped():  # F44
    depth = torch.rand(20, 8, generator=torch.Generator().manual_seed(0)) + 2
    alpha, good = torch.ones(20, 8), torch.full((20, 8), 4.2)
    bad, unknown = good.clone(), good.clone()
    bad[:4], bad[4:8], bad[8:12], bad[12:16] = torch.nan, 0.0, torch.inf, -1.0
    unknown[:16] = 0.0
    leaf = depth.clone().requires_grad_()
    found, expected = (depth_loss(leaf, alpha, prior, "metric") for prior in (bad, unknown))
    assert found is not None and torch.equal(found, expected)
    found.backward()
    assert torch.isfinite(leaf.grad).all() and (leaf.grad[:16] == 0).all()
    assert depth_loss(depth, alpha, torch.full_like(good, torch.nan), "metric") == 0


def test_depth_sees_a_scale_about_the_camera_that_the_image_does_not():  # F17
    camera, scene = small_clip().cameras[0], truth()
    alpha = torch.tensor(1.1, requires_grad=True)
    scaled = scene.replace(
        means=camera.center + alpha * (scene.means - camera.center),
        log_scales=scene.log_scales + alpha.log(),
    )
    true, drawn = (TorchRasterizer().render(g, camera) for g in (scene, scaled))
    image = (drawn.color - true.color).abs().mean()
    depth = depth_loss(drawn.depth, drawn.alpha, true.expected_depth, "metric")
    (by_image,) = torch.autograd.grad(image, alpha, retain_graph=True)
    (by_depth,) = torch.autograd.grad(depth, alpha)
    assert by_depth > 0.1 and by_image.abs() < 0.01 * by_depth


def test_affine_disparity_is_recovered_through_outliers():
    torch.manual_seed(0)
    depth = 1.0 + 3.0 * torch.rand(400)
    prior = (1.0 / depth - 0.1) / 0.7
    prior[:20] += 3.0
    aligned = align_depth(depth, prior, "affine-disparity")
    assert float((aligned[20:] - depth[20:]).abs().median()) < 0.02


def scene_depth() -> tuple[torch.Tensor, torch.Tensor]:
    """Depths of a render, and a disparity with another scale and a shift, both metres-like."""
    g = torch.Generator().manual_seed(3)
    depth = 1.0 + 3.0 * torch.rand(500, generator=g)
    return depth, (1.0 / depth - 0.1) / 0.7


def test_how_a_depth_prior_meets_the_render():
    """Each fit against its formula in float64: factors and lines in disparity."""
    depth, relative = scene_depth()
    metric = 1.3 * depth  # a scale is wrong, nothing else
    torch.testing.assert_close(align_depth(depth, metric, "metric"), metric)  # auto: as it stands
    torch.testing.assert_close(align_depth(depth, metric, "metric", "scale"), depth)
    torch.testing.assert_close(
        align_depth(depth, metric, "metric", "affine"), depth, rtol=1e-3, atol=0
    )
    factor = ((1 / depth.double()) / relative.double()).median()
    scaled = align_depth(depth, relative, "affine-disparity", "scale").double()
    torch.testing.assert_close(scaled, 1 / (factor * relative.double()), rtol=1e-4, atol=0)
    # scaling cannot mend a shift of disparity; scale and shift can
    assert ((scaled - depth) / depth).abs().max() > 0.15
    for fit in ("auto", "affine"):
        line = align_depth(depth, relative, "affine-disparity", fit)
        torch.testing.assert_close(line, depth, rtol=1e-3, atol=0)
    shifted = 1.0 / (0.7 / depth + 0.1)  # metres, but wrong by a shift in disparity
    assert (align_depth(depth, shifted, "metric", "scale") - depth).abs().max() > 0.2
    line = align_depth(depth, shifted, "metric", "affine")
    torch.testing.assert_close(line, depth, rtol=1e-3, atol=0)


@pytest.mark.parametrize("known", [15, 16])
def test_depth_needs_sixteen_pixels(known: int):
    depth, prior = torch.full((8, 8), 2.0), torch.zeros(8, 8)
    prior.view(-1)[:known] = 4.0
    found = depth_loss(depth, torch.ones(8, 8), prior, "metric")
    assert found is not None and (found == 0) == (known < 16)
    prior[-1] = torch.inf  # unknown, too
    again = depth_loss(depth, torch.ones(8, 8), prior, "metric")
    assert again is not None and float(again) == float(found)


@pytest.mark.parametrize(
    ("rows", "columns", "box"),
    [
        ((30, 70), (40, 100), (21, 79, 31, 109)),  # 0.15 of 60 is 9
        ((30, 90), (40, 80), (21, 99, 31, 89)),
        ((50, 54), (60, 63), (42, 62, 52, 71)),  # 8 at least
        ((0, 60), (100, 120), (0, 69, 91, 120)),  # within the frame
        ((60, 100), (0, 60), (51, 100, 0, 69)),
    ],
)
def test_a_crop_has_a_margin_and_what_may_hide_the_entity(rows, columns, box):
    masks = {name: torch.zeros(100, 120, dtype=torch.bool) for name in ("cup", "human", "none")}
    masks["cup"][slice(*rows), slice(*columns)] = True
    masks["human"][:, 45:62] = True
    no_scene = torch.zeros(100, 120, dtype=torch.bool)
    no_scene[:, 110:] = True
    image = torch.randint(256, (100, 120, 3), dtype=torch.uint8)
    camera = Camera(torch.eye(3), torch.eye(4), 120, 100)
    frame = Frame(0, Moment(0.0), camera, image, masks, None, ignored=no_scene)
    crop = crop_around(frame, "cup")
    top, bottom, left, right = box
    inside = (slice(top, bottom), slice(left, right))
    assert (crop.top, crop.left, *crop.mask.shape) == (top, left, bottom - top, right - left)
    assert (crop.camera.height, crop.camera.width) == tuple(crop.mask.shape)
    assert crop.area == int(masks["cup"].sum())
    assert torch.equal(crop.pixels, image[inside]) and torch.equal(crop.cut(image), image[inside])
    assert torch.equal(crop.mask, masks["cup"][inside])
    hidden = (masks["human"] & ~masks["cup"]) | no_scene
    assert torch.equal(crop.ignore, hidden[inside])
    assert crop_around(frame, "none") is None


def test_depth_loss_equals_its_formula():
    """Mean |D_render / alpha - D| over known, opaque pixels, over the median of D."""
    g = torch.Generator().manual_seed(0)
    alpha = torch.rand(9, 11, generator=g)
    depth = alpha * (2 + torch.rand(9, 11, generator=g))
    prior = (1 + torch.rand(9, 11, generator=g)) * (torch.rand(9, 11, generator=g) > 0.2)
    pairs = [
        (float(d) / float(a), float(p))
        for d, a, p in zip(depth.flatten(), alpha.flatten(), prior.flatten(), strict=True)
        if a > 0.5 and p > 0
    ]
    middle = sorted(p for _, p in pairs)[(len(pairs) - 1) // 2]
    expected = sum(abs(d - p) for d, p in pairs) / len(pairs) / middle
    leaf = depth.clone().requires_grad_()
    found = depth_loss(leaf, alpha, prior, "metric")
    assert float(found.detach()) == pytest.approx(expected, rel=1e-5)
    found.backward()
    assert (leaf.grad[(alpha <= 0.5) | (prior == 0)] == 0).all() and leaf.grad.abs().max() > 0
    assert depth_loss(depth, alpha, prior, "metric", "scale") < found


def test_main_texts_plain_sum_is_half_and_half_doubled():
    torch.manual_seed(0)
    a, b = torch.rand(20, 24, 3), torch.rand(20, 24, 3)
    plain = (a - b).abs().mean() + 1 - ssim(a, b)
    torch.testing.assert_close(2 * image_loss(a, b, 0.5, "torch"), plain)
