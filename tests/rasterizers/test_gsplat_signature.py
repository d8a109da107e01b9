"""`hoigs.gsplat.rasterization` is gsplat's: values, gradients, entries of `info`, training."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
import torch
from gsplat_twin import (
    fully_fused_projection,
    isect_offset_encode,
    isect_tiles,
    rasterize_to_pixels,
    spherical_harmonics,
)
from torch import Tensor

from hoigs.core.errors import RenderError
from hoigs.core.maths.rotations import axis_angle_to_matrices, quats_to_matrices
from hoigs.gsplat import rasterization
from hoigs.rasterizers.oracle import OracleRasterizer

WIDTH, HEIGHT, CAMERAS, COUNT = 50, 38, 2, 60
INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")


def scene(
    batch: tuple[int, ...] = (), *, sh: int | None = 3, channels: int = 3, per_view: bool = False
) -> dict[str, Any]:
    torch.manual_seed(3)
    means = torch.rand(*batch, COUNT, 3) * 2 - 1
    means[..., 2] += 3
    views = torch.eye(4).repeat(*batch, CAMERAS, 1, 1)
    views[..., :3, 3] = 0.2 * torch.randn(*batch, CAMERAS, 3)
    K = torch.tensor([[45.0, 0, 26], [0, 47, 18], [0, 0, 1]])
    last = (channels,) if sh is None else ((sh + 1) ** 2, 3)
    given = {
        "means": means,
        "quats": torch.randn(*batch, COUNT, 4),
        "scales": 0.02 + 0.15 * torch.rand(*batch, COUNT, 3),
        "opacities": torch.rand(*batch, COUNT),
        "colors": torch.randn(*batch, *(CAMERAS,) * per_view, COUNT, *last),
        "viewmats": views,
        "backgrounds": torch.rand(*batch, CAMERAS, channels),
    }
    given = {name: value.requires_grad_() for name, value in given.items()}
    shape = {"width": WIDTH, "height": HEIGHT, "sh_degree": sh}
    return {**given, "Ks": K.expand(*batch, CAMERAS, 3, 3), **shape}


def one_image(given: dict[str, Any], b: tuple[int, ...], c: int, mode: str) -> tuple[Tensor, ...]:
    """By the operations of gsplat, in torch."""
    g = {name: given[name][b] for name in INPUTS}
    view, degree = g["viewmats"][c], given["sh_degree"]
    radii, means2d, depths, conics, _ = fully_fused_projection(
        g["means"], None, g["quats"], g["scales"], view[None], given["Ks"][b][c][None],
        WIDTH, HEIGHT, eps2d=0.3, near_plane=0.01, far_plane=1e10, calc_compensations=False,
        opacities=g["opacities"],
    )  # fmt: skip
    shown = (radii[0] > 0).all(-1)
    colors = g["colors"]
    if colors.dim() == (3 if degree is None else 4):
        colors = colors[c]
    if degree is not None:
        directions = g["means"] + view[:3, :3].mT @ view[:3, 3]
        colors = (spherical_harmonics(degree, directions, colors) + 0.5).clamp_min(0)
    parts = ([colors] if "RGB" in mode else []) + ([depths[0][:, None]] if mode != "RGB" else [])
    tiles = (-(-WIDTH // 16), -(-HEIGHT // 16))
    _, keys, members = isect_tiles(means2d[:, shown], radii[:, shown], depths[:, shown], 16, *tiles)
    image, alpha = rasterize_to_pixels(
        means2d[:, shown], conics[:, shown], torch.cat(parts, -1)[None, shown],
        g["opacities"][None, shown], WIDTH, HEIGHT, 16, isect_offset_encode(keys, 1, *tiles),
        members,
    )  # fmt: skip
    image = image[0]
    if "ED" in mode:
        image = torch.cat((image[..., :-1], image[..., -1:] / alpha[0].clamp_min(1e-10)), -1)
    if "RGB" in mode:
        behind = (1 - alpha[0]) * g["backgrounds"][c]
        image = image + torch.cat((behind, *(0 * alpha[0],) * (mode != "RGB")), -1)
    return image, alpha[0]


@pytest.mark.parametrize(
    ("mode", "sh", "channels", "per_view", "batch", "packed"),
    [
        ("RGB", 3, 3, False, (), True),
        ("RGB+D", 2, 3, True, (2,), False),
        ("RGB+ED", None, 5, False, (1, 2), True),
        ("D", None, 3, True, (), False),
        ("ED", 4, 3, False, (), True),
        ("RGB", 4, 3, True, (), False),
        ("RGB+D", None, 35, True, (), True),
    ],
)
def test_values_and_gradients(mode, sh, channels, per_view, batch, packed) -> None:
    given = scene(batch, sh=sh, channels=channels, per_view=per_view)
    images, alphas, _ = rasterization(**given, render_mode=mode, packed=packed)
    rows = itertools.product(*map(range, batch))
    expected = [one_image(given, b, c, mode) for b in rows for c in range(CAMERAS)]
    want = [
        torch.stack(part).reshape(*batch, CAMERAS, HEIGHT, WIDTH, -1) for part in zip(*expected)
    ]
    assert images.shape == want[0].shape and alphas.shape == want[1].shape
    torch.testing.assert_close(images, want[0], atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(alphas, want[1], atol=2e-5, rtol=1e-4)
    weights = torch.randn_like(images)
    leaves = [given[name] for name in INPUTS]
    ours = torch.autograd.grad((images * weights).sum(), leaves, allow_unused=True)
    theirs = torch.autograd.grad((want[0] * weights).sum(), leaves, allow_unused=True)
    for name, a, b in zip(INPUTS, ours, theirs):
        a, b = (torch.zeros(()) if x is None else x for x in (a, b))
        assert (a - b).norm() <= 2e-4 * b.norm() + 1e-6, name


@pytest.mark.parametrize("packed", [False, True])
def test_entries_of_info(packed: bool) -> None:
    given = scene()
    images, _, info = rasterization(**given, packed=packed, absgrad=True)
    info["means2d"].retain_grad()
    images.square().sum().backward()
    for c in range(CAMERAS):
        radii, means2d, depths, conics, _ = fully_fused_projection(
            given["means"], None, given["quats"], given["scales"], given["viewmats"][c : c + 1],
            given["Ks"][c : c + 1], WIDTH, HEIGHT, eps2d=0.3, near_plane=0.01, far_plane=1e10,
            calc_compensations=False, opacities=given["opacities"],
        )  # fmt: skip
        names = ("radii", "means2d", "depths", "conics", "tiles_per_gauss")
        if packed:
            mine = info["camera_ids"] == c
            drawn = torch.zeros(COUNT, dtype=torch.bool)
            drawn[info["gaussian_ids"][mine]] = True
        else:
            drawn = (info["radii"][c] > 0).all(-1)
            mine = (c, drawn)
        found = {name: info[name][mine] for name in names}
        # gsplat's boxes are of whole pixels: a few reach the image that are not drawn here
        shown = (radii[0] > 0).all(-1)
        assert not (drawn & ~shown).any() and (shown & ~drawn).sum() <= 3 < drawn.sum()
        tiles = (info["tile_width"], info["tile_height"])
        radii = radii * drawn[:, None]
        counts, keys, _ = isect_tiles(means2d, radii, depths, 16, *tiles)
        shown = drawn
        torch.testing.assert_close(found["means2d"], means2d[0, shown], atol=1e-4, rtol=1e-5)
        torch.testing.assert_close(found["depths"], depths[0, shown], check_stride=False)
        torch.testing.assert_close(found["conics"], conics[0, shown], atol=1e-4, rtol=1e-3)
        assert found["tiles_per_gauss"].tolist() == counts[shown].tolist()
        starts = info["isect_offsets"][c].flatten() - info["isect_offsets"][c, 0, 0]
        assert starts.tolist() == isect_offset_encode(keys, 1, *tiles).flatten().tolist()
    place = info["means2d"]
    assert place.grad.shape == place.absgrad.shape == place.shape
    assert (place.absgrad >= place.grad.abs() * 0.999).all() and place.absgrad.gt(0).any()
    assert len(info["flatten_ids"]) == len(info["isect_ids"]) == info["tiles_per_gauss"].sum()


def test_culling_by_distance_and_size() -> None:
    given = scene()
    depths = given["means"][:, 2] + given["viewmats"][:, 2, 3, None]
    far = float(depths.median())
    _, _, info = rasterization(**given, far_plane=far, packed=False)
    drawn = info["radii"][..., 0] > 0
    assert drawn.any() and not drawn[depths > far].any()
    _, _, whole = rasterization(**given, packed=False)
    _, _, clipped = rasterization(**given, radius_clip=6.0, packed=False)
    for c in range(CAMERAS):
        radii, *_ = fully_fused_projection(
            given["means"], None, given["quats"], given["scales"], given["viewmats"][c : c + 1],
            given["Ks"][c : c + 1], WIDTH, HEIGHT, eps2d=0.3, near_plane=0.01, far_plane=1e10,
            calc_compensations=False, opacities=given["opacities"],
        )  # fmt: skip
        kept = (whole["radii"][c] > 0).all(-1) & (radii[0] > 6).any(-1)
        assert 0 < kept.sum() < COUNT
        assert ((clipped["radii"][c] > 0).all(-1) == kept).all()


@pytest.mark.parametrize(
    "other",
    [
        {"camera_model": "ftheta"}, {"covars": torch.eye(3).expand(COUNT, 3, 3)},
        {"distributed": True}, {"sparse_grad": True}, {"with_eval3d": True}, {"render_mode": "N"},
        {"sh_degree": 5}, {"quats": torch.ones(COUNT, 3)}, {"backgrounds": torch.zeros(3)},
        {"radial_coeffs": torch.zeros(CAMERAS, 6)},
        {"radial_coeffs": torch.zeros(CAMERAS, 6), "camera_model": "fisheye", "with_ut": True},
        {"thin_prism_coeffs": torch.zeros(CAMERAS, 4), "camera_model": "ortho", "with_ut": True},
        {"viewmats_rs": torch.eye(4).expand(CAMERAS, 4, 4), "with_ut": True},
        {"rolling_shutter": 0, "with_ut": True}, {"rolling_shutter": "sideways"},
        {"global_z_order": False}, {"ut_params": object()},
    ],
)  # fmt: skip
def test_what_is_not_supported_is_named(other: dict[str, Any]) -> None:
    with pytest.raises(RenderError, match=next(iter(other))):
        rasterization(**{**scene(), **other})
    with pytest.raises(TypeError, match="sh_degre'"):
        rasterization(**scene(), sh_degre=3)


FISHEYE = torch.tensor([[0.05, -0.02, 0.01, -0.003], [0.0, 0.03, 0.0, 0.0]])
LENSES: dict[str, dict[str, Any]] = {
    "pinhole": {"with_ut": True},
    "ortho": {"camera_model": "ortho"},
    "fisheye": {"camera_model": "fisheye"},
    "distorted fisheye": {"camera_model": "fisheye", "with_ut": True, "radial_coeffs": FISHEYE},
    "distorted": {
        "with_ut": True,
        "radial_coeffs": torch.tensor([[-0.2, 0.05, 0, 0.01, 0, 0], [0.1, 0, 0, 0, 0, 0]]),
        "tangential_coeffs": torch.tensor([[0.004, -0.006], [0.0, 0.01]]),
        "thin_prism_coeffs": torch.tensor([[0.01, -0.004, 0.006, 0.003], [0.0] * 4]),
    },
}


def places(points: Tensor, K: Tensor, lens: dict[str, Any], c: int) -> Tensor:
    """gsplat's and OpenCV's formulas, written out."""
    x, y, z = points.unbind(-1)
    if lens.get("camera_model") == "ortho":
        return points[..., :2] * K.diagonal()[:2] + K[:2, 2]
    none = torch.zeros(2, 6).to(points)
    k = lens.get("radial_coeffs", none)[c].to(points)
    p = lens.get("tangential_coeffs", none)[c].to(points)
    s = lens.get("thin_prism_coeffs", none)[c].to(points)
    if lens.get("camera_model") == "fisheye":
        r = (x * x + y * y).sqrt()
        theta = torch.atan2(r, z)
        bent = theta * (1 + sum(k[i] * theta ** (2 * i + 2) for i in range(4)))
        a, b = bent * x / r, bent * y / r
    else:
        a, b = x / z, y / z
        r2 = a * a + b * b
        gain = (1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3) / (
            1 + k[3] * r2 + k[4] * r2**2 + k[5] * r2**3
        )
        a, b = (
            gain * a + 2 * p[0] * a * b + p[1] * (r2 + 2 * a * a) + s[0] * r2 + s[1] * r2**2,
            gain * b + p[0] * (r2 + 2 * b * b) + 2 * p[1] * a * b + s[2] * r2 + s[3] * r2**2,
        )
    return torch.stack((a, b), -1) * K.diagonal()[:2] + K[:2, 2]


def unscented_image(given: dict[str, Any], lens: dict[str, Any], c: int) -> tuple[Tensor, Tensor]:
    """Seven weighted points (alpha 0.1, beta 2, kappa 0) in float64, then gsplat's compositing."""
    means, quats, scales, view = (
        given[name].double() for name in ("means", "quats", "scales", "viewmats")
    )
    rotation, K = view[c, :3, :3], given["Ks"][c].double()
    axes = (quats_to_matrices(quats) * scales[:, None]).mT * math.sqrt(0.03)
    points = torch.cat((means[:, None], means[:, None] + axes, means[:, None] - axes), 1)
    uv = places(points @ rotation.mT + view[c, :3, 3], K, lens, c)
    weights = torch.tensor([-99.0, *[0.5 / 0.03] * 6], dtype=torch.float64)
    center = (weights[:, None] * uv).sum(1)
    weights = weights + torch.tensor([1 - 0.01 + 2, *[0.0] * 6], dtype=torch.float64)
    off = uv - center[:, None]
    cov = (weights[:, None, None] * off[..., None] * off[..., None, :]).sum(1)
    cov = cov + 0.3 * torch.eye(2).double()
    inverse = torch.linalg.inv(cov)
    conics = torch.stack((inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]), -1)
    depths = (means @ rotation.mT + view[c, :3, 3])[:, 2]
    reach = (2 * (given["opacities"].detach() * 255).clamp_min(1).log()).sqrt().clamp_max(3.33)
    radii = (reach[:, None] * cov.detach().diagonal(dim1=1, dim2=2).sqrt()).ceil()
    size = torch.tensor([WIDTH, HEIGHT])
    shown = (depths > 0.01) & (given["opacities"] >= 1 / 255)
    shown &= ((center + radii > 0) & (center - radii < size)).all(-1)
    mean2d, conic, radius = (x[None, shown].float() for x in (center, conics, radii))
    tiles = (-(-WIDTH // 16), -(-HEIGHT // 16))
    _, keys, members = isect_tiles(
        mean2d.detach(), radius.int(), depths[None, shown].float().detach(), 16, *tiles
    )
    image, alpha = rasterize_to_pixels(
        mean2d, conic, given["colors"][None, shown], given["opacities"][None, shown], WIDTH, HEIGHT,
        16, isect_offset_encode(keys, 1, *tiles), members,
    )  # fmt: skip
    return image[0] + (1 - alpha[0]) * given["backgrounds"][c], alpha[0]


@pytest.mark.parametrize("name", LENSES)
def test_cameras_that_are_no_pinhole(name: str) -> None:
    lens, given = LENSES[name], scene(sh=None)
    given["means"] = (given["means"].detach() * torch.tensor([1.5, 1.5, 1.0])).requires_grad_()
    if name == "ortho":
        given["Ks"] = given["Ks"] * torch.tensor([[0.3, 1, 1], [1, 0.3, 1], [1, 1, 1]])
    images, alphas, info = rasterization(**given, **lens)
    want = [torch.stack(x) for x in zip(*(unscented_image(given, lens, c) for c in range(CAMERAS)))]
    torch.testing.assert_close(images, want[0], atol=5e-5, rtol=1e-4)
    torch.testing.assert_close(alphas, want[1], atol=5e-5, rtol=1e-4)
    assert info["conics"].isfinite().all() and (info["radii"] > 0).any()
    weights = torch.randn_like(images)
    leaves = [given[name] for name in INPUTS]
    ours = torch.autograd.grad((images * weights).sum(), leaves)
    theirs = torch.autograd.grad((want[0] * weights).sum(), leaves)
    for field, a, b in zip(INPUTS, ours, theirs):
        assert (a - b).norm() <= 5e-4 * b.norm() + 1e-6, field


def test_rolling_shutters_are_of_each_camera() -> None:
    """Batches, a motion of each camera, and the gradient of the last pose; as the oracle draws."""
    given = scene((2,), sh=2)
    torch.manual_seed(4)
    motion = axis_angle_to_matrices(0.05 * torch.randn(2, CAMERAS, 3))
    last = given["viewmats"].detach().clone()
    last[..., :3, :3] = motion @ last[..., :3, :3]
    last[..., :3, 3] += 0.1 * torch.randn(2, CAMERAS, 3)
    last.requires_grad_()
    rolling = {
        "with_ut": True,
        "camera_model": "fisheye",
        "viewmats_rs": last,
        "rolling_shutter": 2,
    }
    leaves = [last, given["viewmats"], given["means"]]
    found = []
    for rasterizer in (None, OracleRasterizer(OracleRasterizer.Config(cutoffs=True))):
        images, _, _ = rasterization(**given, **rolling, rasterizer=rasterizer)
        torch.manual_seed(5)
        weighted = (images * torch.randn(images.shape)).sum()
        found.append((images, *torch.autograd.grad(weighted, leaves)))
    torch.testing.assert_close(found[0][0], found[1][0].float(), atol=2e-5, rtol=1e-4)
    for a, b in zip(found[0][1:], found[1][1:]):
        assert (a - b).norm() <= 5e-4 * b.norm()
    still, _, _ = rasterization(**given, camera_model="fisheye")
    assert (still - found[0][0]).abs().max() > 0.05


@pytest.mark.parametrize(("absgrad", "packed"), [(False, False), (True, True)])
def test_gsplats_own_strategy_trains(absgrad: bool, packed: bool) -> None:
    strategies = pytest.importorskip("gsplat", reason="gsplat is not installed")
    with torch.no_grad():
        target, _, _ = rasterization(**scene(sh=None))
    given = scene(sh=None)
    torch.manual_seed(0)
    params = torch.nn.ParameterDict(
        {
            "means": given["means"].detach()[::3] + 0.1 * torch.randn(COUNT // 3, 3),
            "scales": torch.full((COUNT // 3, 3), 0.1).log(),
            "quats": torch.randn(COUNT // 3, 4),
            "opacities": torch.zeros(COUNT // 3),
            "colors": torch.full((COUNT // 3, 3), 0.5),
        }
    )
    optimizers = {name: torch.optim.Adam([value], lr=0.02) for name, value in params.items()}
    strategy = strategies.DefaultStrategy(
        refine_start_iter=10, refine_every=20, reset_every=1000, grow_grad2d=1e-5, absgrad=absgrad
    )
    strategy.check_sanity(params, optimizers)
    state, losses = strategy.initialize_state(), []
    rest = {key: given[key].detach() for key in ("viewmats", "Ks", "backgrounds")}
    for step in range(60):
        image, _, info = rasterization(
            params["means"], params["quats"], params["scales"].exp(),
            params["opacities"].sigmoid(), params["colors"], width=WIDTH, height=HEIGHT,
            packed=packed, absgrad=absgrad, **rest,
        )  # fmt: skip
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (image - target).square().mean()
        losses.append(loss.item())
        loss.backward()
        strategy.step_post_backward(params, optimizers, state, step, info, packed=packed)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
    assert len(params["means"]) > COUNT // 3
    assert losses[-1] < 0.5 * losses[0]
