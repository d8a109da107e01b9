"""Rows by indices: what indexing gives, and the same bits every time."""

from __future__ import annotations

import torch

from hoigs.core.fast.batched import joint_transforms
from hoigs.core.maths.nearest import mesh_edges, mesh_roughness
from hoigs.core.maths.rows import added_rows, rows_of

HANDS = (-1, *(0,) * 20, *range(1, 21), *(5,) * 12)  # one joint has many children


def test_rows_and_sums_are_those_of_indexing(device: torch.device) -> None:
    values = torch.randn(9, 2, 3, dtype=torch.float64, device=device, requires_grad=True)
    indices = torch.tensor([[0, 3], [3, 8], [3, 0]], device=device)
    upstream = torch.randn(3, 2, 2, 3, dtype=torch.float64, device=device)
    found = rows_of(values, indices)
    assert torch.equal(found, values[indices])
    (gradient,) = torch.autograd.grad(found, values, upstream)
    (expected,) = torch.autograd.grad(values[indices], values, upstream)
    torch.testing.assert_close(gradient, expected)
    sums = added_rows(upstream.flatten(0, 1), indices.flatten(), 9)
    torch.testing.assert_close(sums, expected)


def test_no_gradient_depends_on_the_order_of_threads(device: torch.device) -> None:
    generator = torch.Generator().manual_seed(0)
    few = torch.randint(50, (40_000, 3), generator=generator).to(device)
    edges = mesh_edges(torch.randint(2000, (30_000, 3), generator=generator).to(device))
    values, rotations, joints = (
        torch.randn(*size, generator=generator).to(device).requires_grad_()
        for size in ((2000, 3), (len(HANDS), 3), (len(HANDS), 3))
    )
    weights = torch.randn(40_000, 3, 3, generator=generator).to(device)
    still = torch.zeros(3, device=device)

    def gradients() -> list[torch.Tensor]:
        posed = joint_transforms(rotations, joints, HANDS, still)
        rows = (rows_of(values, few) * weights).sum() + mesh_roughness(values, edges)
        return list(torch.autograd.grad(rows + posed.sin().sum(), (values, rotations, joints)))

    first = gradients()
    for _ in range(20):
        assert all(map(torch.equal, gradients(), first))
