"""Forward kinematics against a walk over the tree, and skinning of points and orientations."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from hoigs.core.device import replacement
from hoigs.core.maths.rotations import axis_angle_to_matrices, multiply_quats, quats_to_matrices
from hoigs.core.maths.skinning import (
    ancestor_table,
    joint_transforms,
    joint_turns,
    skin,
    skin_gaussians,
    skin_quats,
)

CHAIN = tuple(range(-1, 11))
FORK = (-1, 0, 0, 1, 1, 2, 5, 6, 7, 0)
LONE = (-1,)


def walked(rotations: Tensor, joints: Tensor, parents: tuple[int, ...], transl: Tensor) -> Tensor:
    turns = axis_angle_to_matrices(rotations)
    world, places = [turns[..., 0, :, :]], [joints[..., 0, :] + transl]
    for j, p in enumerate(parents[1:], start=1):
        bone = joints[..., j, :] - joints[..., p, :]
        places.append(places[p] + (world[p] @ bone[..., None])[..., 0])
        world.append(world[p] @ turns[..., j, :, :])
    rotation, place = torch.stack(world, -3), torch.stack(places, -2)
    shift = place - (rotation @ joints[..., None])[..., 0]
    top = torch.cat((rotation, shift[..., None]), -1)
    bottom = torch.tensor((0.0, 0.0, 0.0, 1.0)).to(top).expand(*top.shape[:-2], 1, 4)
    return torch.cat((top, bottom), -2)


def inputs(parents: tuple[int, ...], batch: tuple[int, ...], dtype: torch.dtype) -> list[Tensor]:
    generator = torch.Generator().manual_seed(len(parents))
    shapes = (*batch, len(parents), 3), (len(parents), 3), (*batch, 3)
    return [
        torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype).requires_grad_()
        for shape in shapes
    ]


@pytest.mark.parametrize("parents", [CHAIN, FORK, LONE])
@pytest.mark.parametrize("batch", [(), (3,)])
def test_equals_a_walk_over_the_tree(parents: tuple[int, ...], batch: tuple[int, ...]) -> None:
    rotations, joints, transl = inputs(parents, batch, torch.float64)
    ours = joint_transforms(rotations, joints, parents, transl)
    theirs = walked(rotations, joints, parents, transl)
    torch.testing.assert_close(ours, theirs, atol=1e-12, rtol=1e-12)
    weights = torch.randn_like(ours)
    gradients = [
        torch.autograd.grad((weights * out).sum(), (rotations, joints, transl), retain_graph=True)
        for out in (ours, theirs)
    ]
    for a, b in zip(*gradients, strict=True):
        torch.testing.assert_close(a, b, atol=1e-11, rtol=1e-11)


def test_single_precision_is_as_good_as_a_walk() -> None:
    exact = walked(*_with(CHAIN, inputs(CHAIN, (), torch.float64)))
    values = inputs(CHAIN, (), torch.float32)
    ours = joint_transforms(values[0], values[1], CHAIN, values[2])
    assert (ours - exact).abs().max() < 2e-5 * exact.abs().max()


def _with(parents: tuple[int, ...], values: list[Tensor]) -> tuple:
    return values[0], values[1], parents, values[2]


def test_a_tree_out_of_order_is_refused() -> None:
    for parents, joint in (((-1, 2, 0), 1), ((0, 0, 1), 0), ((-1, -1, 0), 1)):
        rotations, joints, transl = inputs(parents, (), torch.float32)
        with pytest.raises(ValueError, match=f"joint {joint} has parent"):
            joint_transforms(rotations, joints, parents, transl)


def test_quaternion_blend_does_not_collapse():
    """A point halfway between a joint and one twisted by nearly 180 degrees about the bone."""
    parents = (-1, 0)
    twist = axis_angle_to_matrices(torch.tensor([math.radians(178), 0, 0]))
    transforms = torch.eye(4).repeat(2, 1, 1)
    transforms[1, :3, :3] = twist
    quats = skin_quats(transforms, torch.tensor([[0.5, 0.5]]), parents, ancestor_table(parents))
    half = axis_angle_to_matrices(torch.tensor([math.radians(89), 0, 0]))
    torch.testing.assert_close(quats_to_matrices(quats)[0], half, atol=1e-5, rtol=0)


def test_quaternion_signs_follow_the_tree():
    """Turns that add up beyond 180 degrees along a chain still blend to the middle."""
    parents = (-1, 0, 1, 2)
    angles = torch.tensor([0.0, 2.0, 4.0, 6.0])
    zero = torch.zeros(4)
    transforms = torch.eye(4).repeat(4, 1, 1)
    transforms[:, :3, :3] = axis_angle_to_matrices(torch.stack((zero, zero, angles), -1))
    weights = torch.tensor([[0.5, 0.5, 0, 0], [0, 0.5, 0.5, 0], [0, 0, 0.5, 0.5]])
    quats = skin_quats(transforms, weights, parents, ancestor_table(parents))
    middle = torch.stack((zero[:3], zero[:3], torch.tensor([1.0, 3.0, 5.0])), -1)
    torch.testing.assert_close(
        quats_to_matrices(quats), axis_angle_to_matrices(middle), atol=1e-5, rtol=0
    )


def test_skin_by_hand():
    transforms = torch.eye(4).repeat(2, 1, 1)
    transforms[1, :3, 3] = torch.tensor([2.0, 0, 0])
    points = skin(
        torch.tensor([[1.0, 1, 1], [0, 0, 0]]), transforms, torch.tensor([[0.5, 0.5], [0, 1]])
    )
    torch.testing.assert_close(points, torch.tensor([[2.0, 1, 1], [2, 0, 0]]))


def skinned(dtype: torch.dtype, joints: int, frozen: bool) -> list[Tensor]:
    """Points and rotations after skinning, and the gradients of all that is not frozen."""
    generator = torch.Generator().manual_seed(joints)
    shapes = (700, 3), (700, 4), (700, joints), (joints, 3, 4), (joints, 4)
    values = [torch.randn(shape, generator=generator) for shape in shapes]
    values[2] = values[2].softmax(-1)
    values[4] = torch.nn.functional.normalize(values[4] + torch.tensor([3.0, 0, 0, 0]), dim=-1)
    sources = [x.to(dtype).requires_grad_(not frozen or i < 2) for i, x in enumerate(values)]
    points, quats, weights, top, turns = sources
    last = torch.tensor((0.0, 0.0, 0.0, 1.0)).to(top).expand(joints, 1, 4)
    out = skin_gaussians(points, quats, weights, torch.cat((top, last), 1), turns)
    upstream = [torch.randn(x.shape, generator=generator).to(dtype) for x in out]
    wanted = [x for x in sources if x.requires_grad]
    return [*(x.detach() for x in out), *torch.autograd.grad(out, wanted, upstream)]


@pytest.mark.parametrize(("joints", "frozen"), [(52, False), (5, False), (16, False), (55, True)])
def test_the_cpu_kernel_equals_its_float64_twin(joints: int, frozen: bool) -> None:
    assert replacement(skin_gaussians, torch.zeros(1)) is not None
    found, exact = skinned(torch.float32, joints, frozen), skinned(torch.float64, joints, frozen)
    assert len(found) == (4 if frozen else 7)
    for ours, theirs in zip(found, exact, strict=True):
        bound = 2e-6 * float(theirs.abs().amax())
        torch.testing.assert_close(ours.double(), theirs, rtol=0, atol=bound)


def test_the_cpu_kernel_gives_the_same_bits_on_any_number_of_cores() -> None:
    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 4):
            torch.set_num_threads(threads)
            results.append(skinned(torch.float32, 52, frozen=False))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_gaussians_are_skinned_as_points_and_rotations_are() -> None:
    rotations, joints, transl = inputs(FORK, (), torch.float64)
    transforms = joint_transforms(rotations, joints, FORK, transl)
    table = ancestor_table(FORK).double()
    weights = torch.rand(9, len(FORK), dtype=torch.float64).softmax(-1)
    points, quats = torch.randn(9, 3).double(), torch.randn(9, 4).double()
    turns = joint_turns(transforms, FORK, table)
    means, turned = skin_gaussians(points, quats, weights, transforms, turns)
    torch.testing.assert_close(means, skin(points, transforms, weights))
    expected = multiply_quats(skin_quats(transforms, weights, FORK, table), quats)
    torch.testing.assert_close(turned, expected)
