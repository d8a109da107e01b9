"""Sampling against torch's own, the CPU kernels against float64, and planes of space and time."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from hoigs.core.device import replacement
from hoigs.core.fast import choose
from hoigs.core.maths.feature_planes import PairedPlanes, ProductPlanes, roughness, sample_planes


def test_equals_grid_sample():
    planes = torch.randn(3, 7, 5, 4, dtype=torch.float64, requires_grad=True)
    points = (torch.rand(3, 50, 2, dtype=torch.float64) * 2.6 - 1.3).requires_grad_()
    ours = sample_planes(planes, points)
    theirs = F.grid_sample(
        planes.permute(0, 3, 1, 2), points[:, None], align_corners=True, padding_mode="border"
    )
    torch.testing.assert_close(ours, theirs[:, :, 0].permute(2, 0, 1).flatten(1))
    weights = torch.randn_like(ours)
    grads = torch.autograd.grad((ours * weights).sum(), (planes, points))
    expected = torch.autograd.grad(
        (theirs[:, :, 0].permute(2, 0, 1).flatten(1) * weights).sum(), (planes, points)
    )
    torch.testing.assert_close(grads, expected)


def everything(planes: Tensor, points: Tensor, upstream: Tensor) -> list[Tensor]:
    """Samples, and gradients of planes and points."""
    planes, points = planes.clone().requires_grad_(), points.clone().requires_grad_()
    samples = sample_planes(planes, points)
    return [samples.detach(), *torch.autograd.grad(samples, (planes, points), upstream)]


SHAPES = [((3, 16, 12, 32), 3000), ((2, 9, 1, 37), 700), ((1, 1, 6, 16), 10), ((3, 4, 5, 3), 0)]


def close_to_its_twin(
    shape: tuple[int, ...], count: int, device: str = "cpu", scale: float = 1.0
) -> None:
    torch.manual_seed(0)
    planes, points = torch.randn(shape), torch.rand(shape[0], count, 2) * 2.6 - 1.3
    points[:, :2] = torch.tensor((-1.0, 1.0))  # edges
    upstream = scale * torch.randn(count, shape[0] * shape[3])
    exact = everything(planes.double(), points.double(), upstream.double())
    found = everything(planes.to(device), points.to(device), upstream.to(device))
    for ours, theirs in zip(found, exact, strict=True):
        bound = 2e-6 * float(theirs.abs().amax()) if count else 0.0
        torch.testing.assert_close(ours.cpu().double(), theirs, rtol=0, atol=bound)


@pytest.mark.parametrize(("shape", "count"), SHAPES)
def test_the_cpu_kernel_equals_its_float64_twin(shape: tuple[int, ...], count: int) -> None:
    planes = torch.zeros(shape)
    assert replacement(sample_planes, planes) and not replacement(sample_planes, planes.double())
    close_to_its_twin(shape, count)


@pytest.mark.parametrize("scale", [1e-20, 1.0, 1e20])
@pytest.mark.parametrize(("shape", "count"), SHAPES)
def test_the_cuda_kernel_as_scalar_code_equals_its_float64_twin(
    shape: tuple[int, ...], count: int, scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(
        choose.KERNELS, "hoigs.core.maths.feature_planes.sample_planes", "planes_cuda"
    )
    close_to_its_twin(shape, count, scale=scale)


@pytest.mark.parametrize("value", [0.0, torch.inf, torch.nan])
def test_the_cuda_kernel_of_gradients_that_vanish_or_are_none(
    value: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(
        choose.KERNELS, "hoigs.core.maths.feature_planes.sample_planes", "planes_cuda"
    )
    upstream = torch.zeros(5, 12)
    upstream[2, 3] = value
    _, planes, _ = everything(torch.randn(3, 4, 5, 4), torch.rand(3, 5, 2), upstream)
    assert (planes == 0).all() if value == 0 else not torch.isfinite(planes).all()


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize(("shape", "count"), SHAPES)
def test_the_cuda_kernel_equals_its_float64_twin(shape: tuple[int, ...], count: int) -> None:
    assert replacement(sample_planes, torch.zeros(1, device="cuda")) is not None
    close_to_its_twin(shape, count, "cuda")


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_the_cuda_kernel_gives_the_same_bits_in_every_run() -> None:
    torch.manual_seed(0)
    values = torch.randn(3, 8, 8, 32), torch.rand(3, 20_000, 2) * 2 - 1, torch.randn(20_000, 96)
    first, second = (everything(*(x.cuda() for x in values)) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_the_cpu_kernel_gives_the_same_bits_on_any_number_of_cores() -> None:
    torch.manual_seed(0)
    values = torch.randn(3, 8, 8, 32), torch.rand(3, 2000, 2) * 2 - 1, torch.randn(2000, 96)
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 4):
            torch.set_num_threads(threads)
            results.append(everything(*values))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_a_point_that_is_not_a_number_gives_features_that_are_not() -> None:
    points = torch.zeros(1, 2, 2)
    points[0, 1, 0] = torch.nan
    samples = sample_planes(torch.ones(1, 3, 3, 16), points)
    assert (samples[0] == 1).all() and samples[1].isnan().all()


def test_corners_edges_and_single_cells():
    planes = torch.arange(6.0).view(1, 2, 3, 1)  # rows along the second coordinate
    corners = torch.tensor([[[-1.0, -1], [1, -1], [-1, 1], [1, 1], [0, 0]]])
    assert sample_planes(planes, corners).flatten().tolist() == [0, 2, 3, 5, 2.5]
    one = torch.full((1, 1, 1, 1), 4.0)
    assert sample_planes(one, corners).flatten().tolist() == [4.0] * 5


def test_paired_planes_by_hand():
    torch.manual_seed(0)
    planes = PairedPlanes(channels=2, resolution=5, time_resolution=4)
    points = torch.rand(6, 3) * 2 - 1
    torch.testing.assert_close(planes(points), planes(points, 0.3))  # time planes start at one
    assert planes(points).shape == (6, 6) and planes.width == 6
    with torch.no_grad():
        planes.time.normal_()
    # the first two features are xy times zt, the next xz times yt, the last yz times xt
    space = planes.space.permute(0, 3, 1, 2)
    time = planes.time.permute(0, 3, 1, 2)
    clock = torch.full((6,), 2 * 0.3 - 1)
    x, y, z = points.unbind(-1)

    def read(plane: torch.Tensor, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        return F.grid_sample(plane[None], torch.stack((u, v), -1)[None, None], align_corners=True)[
            0, :, 0
        ].T

    expected = torch.cat(
        (
            read(space[0], x, y) * read(time[0], z, clock),
            read(space[1], x, z) * read(time[1], y, clock),
            read(space[2], y, z) * read(time[2], x, clock),
        ),
        dim=-1,
    )
    torch.testing.assert_close(planes(points, 0.3), expected)


def test_all_of_the_time_axis_is_used():  # F10
    planes = PairedPlanes(channels=1, resolution=3, time_resolution=6)
    points = torch.rand(20, 3) * 2 - 1
    for frame in range(12):
        planes(points, frame / 11).sum().backward()
    assert (planes.time.grad.abs().sum((0, 2, 3)) > 0).all()


def test_penalties_by_hand():
    planes = PairedPlanes(channels=1, resolution=2, time_resolution=3)
    assert planes.time_smoothness() == 0 and planes.time_sparsity() == 0
    with torch.no_grad():
        planes.time[:, 1] = 3.0
    assert planes.time_smoothness().item() == 16  # (1 - 6 + 1)^2
    torch.testing.assert_close(planes.time_sparsity(), torch.tensor(2 / 3))
    assert PairedPlanes(1, 2, 2).time_smoothness() == 0


def test_product_planes_are_4dgs_field():
    """Against grid_sample on six planes xy, xz, xt, yz, yt, zt, multiplied, scales concatenated."""
    torch.manual_seed(0)
    field = ProductPlanes(3, (4, 8), 5).double()
    for parameter in field.parameters():
        torch.nn.init.uniform_(parameter, 0.2, 1.5)
    points = torch.rand(20, 3, dtype=torch.float64) * 2.4 - 1.2
    clock = 0.3
    four = torch.cat((points, torch.full((20, 1), clock, dtype=torch.float64)), 1)
    scales = []
    for space, time in zip(field.space, field.time, strict=True):
        product = torch.ones(20, 3, dtype=torch.float64)
        for plane, axes in zip(
            (*space, *time), ((0, 1), (0, 2), (1, 2), (0, 3), (1, 3), (2, 3)), strict=True
        ):
            sampled = F.grid_sample(
                plane.permute(2, 0, 1)[None],
                four[None, None, :, axes],
                align_corners=True,
                padding_mode="border",
            )
            product = product * sampled[0, :, 0].T
        scales.append(product)
    torch.testing.assert_close(field(points, (1 + clock) / 2), torch.cat(scales, 1))
    assert field.width == 6 and field.space[1].shape == (3, 8, 8, 3)
    assert field.time[1].shape == (3, 5, 8, 3)  # time keeps its resolution


def test_roughness():
    line = torch.arange(4.0).view(1, 4, 1, 1)
    assert roughness(line) == 0 and roughness(line[:, :2]) == 0
    assert roughness(line**2) == 4  # second difference 2, squared


def test_no_time_planes_are_time_planes_of_one():
    points = torch.rand(6, 3) * 2 - 1
    for make in (
        lambda time: PairedPlanes(2, 5, time),
        lambda time: ProductPlanes(2, (4, 8), time),
    ):
        torch.manual_seed(0)
        ones, none = make(4), make(0)
        stored = {k: v for k, v in ones.state_dict().items() if not k.startswith("time")}
        assert len(stored) < len(ones.state_dict())
        none.load_state_dict(stored)
        torch.testing.assert_close(none(points, 0.3), ones(points, 0.3), rtol=0, atol=0)
    assert PairedPlanes(2, 5, 0).time_sparsity() == PairedPlanes(2, 5, 0).time_smoothness() == 0
    assert (
        ProductPlanes(2, (4,), 0).time_sparsity()
        == 0
        == ProductPlanes(2, (4,), 0).time_smoothness()
    )
