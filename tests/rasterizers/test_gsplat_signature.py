"""`hoigs.gsplat.rasterization` is gsplat's: values, gradients, entries of `info`, training."""

from __future__ import annotations

import itertools
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
from hoigs.gsplat import rasterization

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
        {"camera_model": "fisheye"}, {"covars": torch.eye(3).expand(COUNT, 3, 3)},
        {"distributed": True}, {"sparse_grad": True}, {"with_ut": True}, {"render_mode": "N"},
        {"sh_degree": 5}, {"quats": torch.ones(COUNT, 3)}, {"backgrounds": torch.zeros(3)},
    ],
)  # fmt: skip
def test_what_is_not_supported_is_named(other: dict[str, Any]) -> None:
    with pytest.raises(RenderError, match=next(iter(other))):
        rasterization(**{**scene(), **other})
    with pytest.raises(TypeError, match="sh_degre'"):
        rasterization(**scene(), sh_degre=3)


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
