"""Gaussians: activation, deltas, joining, starting values."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from hoigs.core.errors import NotFiniteError
from hoigs.core.maths.rotations import quats_to_matrices
from hoigs.core.values.gaussians import SH_C0, GaussianDelta, Gaussians, neighbour_distances


def a_cloud(count: int = 7, degree: int = 1, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        normal(count, 3),
        normal(count, 4),
        normal(count, 3),
        normal(count),
        normal(count, (degree + 1) ** 2, 3),
    )


def assert_equal(a: Gaussians, b: Gaussians) -> None:
    torch.testing.assert_close(a.tensors(), b.tensors())


def test_activation() -> None:
    cloud = a_cloud()
    torch.testing.assert_close(cloud.scales, torch.exp(cloud.log_scales))
    torch.testing.assert_close(cloud.opacities, 1 / (1 + torch.exp(-cloud.opacity_logits)))
    torch.testing.assert_close(cloud.colors, 0.5 + 0.2820948 * cloud.sh[:, 0])
    assert (len(cloud), cloud.sh_degree) == (7, 1)
    assert [a_cloud(degree=d).sh_degree for d in range(4)] == [0, 1, 2, 3]


def test_covariances_have_the_axes_and_variances() -> None:
    cloud = a_cloud().to(torch.float64)
    rotations = quats_to_matrices(cloud.quats)
    turned = rotations.mT @ cloud.covariances() @ rotations
    torch.testing.assert_close(turned, torch.diag_embed(cloud.scales**2), atol=1e-10, rtol=1e-8)


def test_covariances_do_not_depend_on_the_length_of_the_quaternion() -> None:
    cloud = a_cloud()
    longer = cloud.replace(quats=cloud.quats * -7.5)
    torch.testing.assert_close(longer.covariances(), cloud.covariances())


@pytest.mark.parametrize(
    "index",
    [slice(1, 4), torch.tensor([3, 3, 0]), torch.tensor([True, False] * 3 + [True])],
    ids=["slice", "rows", "mask"],
)
def test_rows(index: slice | Tensor) -> None:
    cloud = a_cloud()
    some = cloud[index]
    assert len(some) == len(cloud.means[index])
    torch.testing.assert_close(some.sh, cloud.sh[index])


def test_no_delta_moves_nothing() -> None:
    cloud = a_cloud()
    assert_equal(cloud.moved(GaussianDelta()), cloud)
    zero = GaussianDelta(
        means=torch.zeros(7, 3),
        quats=torch.zeros(7, 4),
        log_scales=torch.zeros(7, 3),
        opacity_logits=torch.zeros(7),
        sh=torch.zeros(7, 4, 3),
    )
    still = cloud.moved(zero)
    torch.testing.assert_close(still.covariances(), cloud.covariances())
    assert_equal(still.replace(quats=cloud.quats), cloud)


def test_delta_adds_and_turns_after_the_rest_rotation() -> None:
    cloud = a_cloud()
    half = torch.tensor([0.3, -0.2, 0.7])
    turn = torch.cat((torch.tensor([0.0]), half)).expand(7, 4)
    delta = GaussianDelta(means=torch.ones(7, 3), quats=turn, log_scales=torch.full((7, 3), 0.5))
    moved = cloud.moved(delta)
    torch.testing.assert_close(moved.means, cloud.means + 1)
    torch.testing.assert_close(moved.scales, cloud.scales * torch.tensor(0.5).exp())
    rotation = quats_to_matrices(torch.cat((torch.ones(1), half)))
    torch.testing.assert_close(
        quats_to_matrices(moved.quats), rotation @ quats_to_matrices(cloud.quats)
    )


def test_a_quaternion_delta_that_cancels_identity_has_finite_gradients() -> None:
    cloud = a_cloud()
    turn = torch.zeros(7, 4)
    turn[:, 0] = -1.0
    turn.requires_grad_()
    moved = cloud.moved(GaussianDelta(quats=turn))
    assert torch.isfinite(moved.quats).all()
    moved.quats.sum().backward()
    assert torch.isfinite(turn.grad).all()


def test_cat_keeps_order_and_pads_harmonics() -> None:
    a, b = a_cloud(3, degree=0), a_cloud(2, degree=2, seed=1)
    both = Gaussians.cat([a, b])
    assert (len(both), both.sh_degree) == (5, 2)
    assert_equal(both[3:], b)
    torch.testing.assert_close(both.sh[:3, :1], a.sh)
    assert not both.sh[:3, 1:].any()
    with pytest.raises(ValueError, match="at least one"):
        Gaussians.cat([])


def test_from_points_is_3dgs_start() -> None:
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 4], [9, 9, 9]])
    colors = torch.rand(5, 3)
    cloud = Gaussians.from_points(points, colors, sh_degree=2)
    torch.testing.assert_close(cloud.colors, colors)
    torch.testing.assert_close(cloud.opacities, torch.full((5,), 0.1))
    assert cloud.sh.shape == (5, 9, 3) and not cloud.sh[:, 1:].any()
    assert float(cloud.scales[0, 0]) == pytest.approx((1 + 2 + 4) / 3)
    torch.testing.assert_close(quats_to_matrices(cloud.quats), torch.eye(3).expand(5, 3, 3))
    cloud.means.add_(1)
    assert points[0, 0] == 0, "the points were not copied"


def test_from_points_defaults_and_dtypes() -> None:
    points = torch.zeros(2, 3, dtype=torch.float64)
    cloud = Gaussians.from_points(points, scales=0.3)
    assert all(x.dtype == torch.float64 for x in cloud.tensors().values())
    torch.testing.assert_close(
        cloud.scales, torch.full((2, 3), 0.3, dtype=torch.float64), rtol=1e-12, atol=0
    )
    torch.testing.assert_close(cloud.colors, torch.full((2, 3), 0.5).double())
    each = Gaussians.from_points(points, scales=torch.tensor([0.1, 0.0]))
    assert torch.isfinite(each.log_scales).all()


def test_neighbour_distances_of_few_points() -> None:
    assert neighbour_distances(torch.zeros(3, 3)).tolist() == pytest.approx([0.01] * 3)
    assert neighbour_distances(torch.zeros(0, 3)).shape == (0,)


@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "opacity_logits", "sh"])
def test_check_finite_names_the_field(name: str) -> None:
    cloud = a_cloud().clone()
    cloud.check_finite()
    getattr(cloud, name)[2] = float("nan")
    with pytest.raises(NotFiniteError, match=rf"human\.{name}: 1 of 7"):
        cloud.check_finite("human")


def test_detach_and_clone() -> None:
    cloud = a_cloud().map(lambda x: x.requires_grad_())
    assert not cloud.detach().means.requires_grad
    copy = cloud.detach().clone()
    copy.means.zero_()
    assert cloud.means.any()


def test_base_colour_constant() -> None:
    assert pytest.approx((1 / (4 * torch.pi)) ** 0.5) == SH_C0


@pytest.mark.parametrize("given", [True, False])
def test_flat_gaussians_lie_in_the_surface(given: bool) -> None:
    torch.manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(800, 3), dim=-1)
    flat = Gaussians.from_points(
        directions, scales=0.05, thickness=0.2, normals=directions if given else None
    )
    axes = quats_to_matrices(flat.quats) * flat.log_scales.exp()[:, None, :]
    along = (axes.mT @ directions[..., None]).norm(dim=1)[:, 0]  # standard deviations
    assert torch.allclose(along.median(), torch.tensor(0.01), rtol=0.05)
    assert along.max() < (0.0101 if given else 0.03)
    assert torch.allclose(flat.log_scales[:, :2].exp(), torch.tensor(0.05))


def test_flat_gaussians_of_one_and_two_points() -> None:
    for count in (1, 2, 3):
        assert Gaussians.from_points(torch.rand(count, 3), thickness=0.5).quats.isfinite().all()


@pytest.mark.parametrize("opacity", [1.0, 0.99999999])
def test_opaque_has_a_finite_logit(opacity: float) -> None:
    opaque = Gaussians.from_points(torch.zeros(2, 3), opacity=opacity)
    opaque.check_finite()
    assert float(opaque.opacities.min()) > 1 - 1e-6


@pytest.mark.parametrize("opacity", [0.0, -0.1, 1.001, float("nan"), float("inf")])
def test_other_opacities_are_refused(opacity: float) -> None:
    with pytest.raises(ValueError, match=f"opacity is {opacity}"):
        Gaussians.from_points(torch.zeros(2, 3), opacity=opacity)


def test_from_points_takes_arrays() -> None:
    points, colors = np.random.default_rng(0).random((2, 5, 3))
    made = Gaussians.from_points(points, colors)
    same = Gaussians.from_points(torch.tensor(points).float(), torch.tensor(colors).float())
    assert made.means.dtype == torch.float32
    assert_equal(made, same)


@pytest.mark.parametrize(
    ("arguments", "error", "facts"),
    [
        ({"points": [[0.0, 0.0, 0.0]]}, TypeError, ("points", "list")),
        ({"points": torch.zeros(4, 3).int()}, TypeError, ("points", "int32")),
        ({"points": torch.zeros(3, 4)}, ValueError, ("points", "[3, 4]", "[N, 3]")),
        ({"colors": np.zeros((4, 3), np.uint8)}, TypeError, ("colors", "uint8")),
        ({"colors": torch.zeros(1, 3)}, ValueError, ("colors", "[1, 3]", "[4, 3]")),
        ({"normals": torch.zeros(5, 3)}, ValueError, ("normals", "[5, 3]", "[4, 3]")),
    ],
)
def test_from_points_names_the_argument_that_is_wrong(
    arguments, error, facts, as_users_run_it
) -> None:
    with pytest.raises(error) as caught:
        Gaussians.from_points(**{"points": torch.rand(4, 3), **arguments})
    for fact in facts:
        assert fact in str(caught.value)


def test_channels_go_with_their_rows() -> None:
    plain, with_channels = a_cloud(), a_cloud().replace(channels=torch.rand(7, 2))
    assert plain[:3].channels is None and len(with_channels[:3].channels) == 3
    both = Gaussians.cat([plain, with_channels])
    assert both.channels[:7].abs().sum() == 0
    assert torch.equal(both.channels[7:], with_channels.channels)
    moved = with_channels.moved(GaussianDelta(means=torch.ones(7, 3)))
    assert torch.equal(moved.channels, with_channels.channels)
    with pytest.raises(NotFiniteError, match="channels: 7 of 7"):
        with_channels.replace(channels=torch.full((7, 2), torch.nan)).check_finite()
