"""Rotations against scipy, at every angle, with gradients that stay finite."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from hoigs.core.device import replacement
from hoigs.core.maths import rotations as R

AXIS = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.81]).double(), dim=0)


def random_quats(*shape: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(*shape, 4, generator=generator, dtype=torch.float64)


def scipy_matrices(quats: Tensor) -> Tensor:
    xyzw = quats[:, [1, 2, 3, 0]].numpy()
    return torch.from_numpy(Rotation.from_quat(xyzw).as_matrix())


def test_matrices_are_scipys() -> None:
    quats = random_quats(50)
    torch.testing.assert_close(R.quats_to_matrices(quats), scipy_matrices(quats))


def test_products_compose_right_to_left() -> None:
    a, b = random_quats(20), random_quats(20, seed=1)
    product = R.quats_to_matrices(R.multiply_quats(a, b))
    torch.testing.assert_close(product, R.quats_to_matrices(a) @ R.quats_to_matrices(b))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, math.pi / 2, 3.1, math.pi])
def test_matrices_to_quats_inverts_at_every_angle(angle: float) -> None:
    axes = torch.cat((torch.eye(3), -torch.eye(3), AXIS[None].float())).double()
    matrices = torch.from_numpy(Rotation.from_rotvec((axes * angle).numpy()).as_matrix())
    matrices.requires_grad_()
    quats = R.matrices_to_quats(matrices)
    torch.testing.assert_close(quats.norm(dim=-1), torch.ones(7).double())
    torch.testing.assert_close(R.quats_to_matrices(quats), matrices)
    quats.sum().backward()
    assert torch.isfinite(matrices.grad).all()


def test_batches_of_any_shape() -> None:
    quats = random_quats(2, 3)
    matrices = R.quats_to_matrices(quats)
    assert matrices.shape == (2, 3, 3, 3)
    again = R.quats_to_matrices(R.matrices_to_quats(matrices))
    torch.testing.assert_close(again, matrices)
    assert R.axis_angle_to_matrices(torch.zeros(3)).shape == (3, 3)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-5, 1e-4, 1.1e-4, 0.5, 3.0, math.pi])
def test_axis_angle_is_scipys(angle: float) -> None:
    vector = (AXIS * angle).requires_grad_()
    wanted = Rotation.from_rotvec(vector.detach().numpy()).as_matrix()
    matrix = R.axis_angle_to_matrices(vector)
    torch.testing.assert_close(matrix, torch.from_numpy(wanted), atol=1e-12, rtol=0)
    (matrix * torch.arange(9.0).reshape(3, 3)).sum().backward()
    assert torch.isfinite(vector.grad).all() and vector.grad.any()
    back = R.matrices_to_axis_angle(matrix.detach())
    torch.testing.assert_close(back.abs(), vector.detach().abs(), atol=1e-7, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 0.3, 2.0])
def test_gradients_of_the_exponential_map(angle: float) -> None:
    vector = (AXIS * angle).requires_grad_()
    assert torch.autograd.gradcheck(R.axis_angle_to_matrices, (vector,), eps=1e-6, atol=1e-5)


def test_the_generator_at_zero() -> None:
    """The derivative of exp at 0 is the cross-product matrix."""
    jacobian = torch.autograd.functional.jacobian(
        R.axis_angle_to_matrices, torch.zeros(3, dtype=torch.float64)
    )
    wanted = torch.linalg.cross(
        torch.eye(3).double()[:, None].expand(3, 3, 3), torch.eye(3).double().expand(3, 3, 3)
    )
    torch.testing.assert_close(jacobian, wanted.permute(2, 1, 0))


def test_axis_angle_of_both_signs_of_a_quaternion() -> None:
    quats = random_quats(30)
    torch.testing.assert_close(R.quats_to_axis_angle(-quats), R.quats_to_axis_angle(quats))
    assert (R.quats_to_axis_angle(quats).norm(dim=-1) <= math.pi + 1e-9).all()
    near = torch.tensor([[1.0, 0.0, 0.0, 0.0], [1.0, 1e-9, 0.0, 0.0]], dtype=torch.float64)
    near.requires_grad_()
    vectors = R.quats_to_axis_angle(near)
    torch.testing.assert_close(vectors[1, 0].item(), 2e-9, atol=1e-15, rtol=0)
    vectors.sum().backward()
    torch.testing.assert_close(near.grad[:, 1:], torch.full((2, 3), 2.0).double())


def test_a_zero_quaternion_stays_finite() -> None:
    zero = torch.zeros(2, 4, requires_grad=True)
    matrices = R.quats_to_matrices(zero)
    assert torch.isfinite(matrices).all()
    matrices.sum().backward()
    assert torch.isfinite(zero.grad).all()


class TestSlerp:
    def test_ends_and_middle(self) -> None:
        start = R.axis_angle_to_quats(torch.zeros(3).double())
        end = R.axis_angle_to_quats(AXIS * 1.2)
        for r in (0.0, 0.25, 0.5, 1.0):
            between = R.quats_to_axis_angle(R.slerp(start, end, r))
            torch.testing.assert_close(between, AXIS * 1.2 * r)

    def test_takes_the_shorter_arc(self) -> None:
        a, b = random_quats(20), random_quats(20, seed=1)
        r = torch.linspace(0, 1, 20).double()[:, None]
        one = R.quats_to_matrices(R.slerp(a, b, r))
        torch.testing.assert_close(R.quats_to_matrices(R.slerp(a, -b, r)), one)
        turn = R.quats_to_axis_angle(R.multiply_quats(b, a * torch.tensor([1.0, -1, -1, -1])))
        half = R.slerp(a, b, 0.5)
        part = R.multiply_quats(half, a * torch.tensor([1.0, -1.0, -1.0, -1.0]))
        torch.testing.assert_close(R.quats_to_axis_angle(part), turn / 2)

    @pytest.mark.parametrize("gap", [0.0, 1e-8, 1e-3, 0.06, 0.0633, 1.0, math.pi - 1e-3])
    def test_value_and_gradient_at_every_gap(self, gap: float) -> None:
        """Also on both sides of the switch to linear interpolation."""
        a = random_quats()
        b = R.multiply_quats(R.axis_angle_to_quats(AXIS * gap), R.normalize_quats(a))
        leaves = [a.requires_grad_(), b.detach().requires_grad_()]
        between = R.slerp(*leaves, 0.3)
        wanted = R.multiply_quats(
            R.axis_angle_to_quats(AXIS * gap * 0.3), R.normalize_quats(leaves[0])
        )
        torch.testing.assert_close(between, wanted, atol=5e-7, rtol=0)
        assert torch.autograd.gradcheck(lambda x, y: R.slerp(x, y, 0.3), leaves, atol=1e-4)

    def test_products_that_round_to_more_than_one(self) -> None:  # F46
        generator = torch.Generator().manual_seed(0)
        keys = R.normalize_quats(torch.randn(4000, 4, generator=generator))
        keys = (keys * (1 + 1e-7)).requires_grad_()
        assert ((keys * keys).sum(-1) > 1).any()
        between = R.slerp(keys, keys.detach().clone(), 0.3)
        between.sum().backward()
        assert torch.isfinite(between).all() and torch.isfinite(keys.grad).all()

    def test_position_takes_a_gradient(self) -> None:
        r = torch.tensor([[0.3]], dtype=torch.float64, requires_grad=True)
        a, b = random_quats(1), random_quats(1, seed=2)
        assert torch.autograd.gradcheck(lambda r: R.slerp(a, b, r), (r,))


def test_exp_se3_is_the_matrix_exponential():
    generator = torch.Generator().manual_seed(2)
    turns = torch.randn(30, 3, generator=generator, dtype=torch.float64)
    turns = torch.cat((turns, 1e-3 * turns[:5], 1e-9 * turns[:5], 0 * turns[:2]))
    shifts = torch.randn(len(turns), 3, generator=generator, dtype=torch.float64)
    quats, moved = R.exp_se3(turns, shifts)
    for w, v, quat, shift in zip(turns, shifts, quats, moved, strict=True):
        generator_matrix = torch.zeros(4, 4, dtype=torch.float64)
        x, y, z = w
        generator_matrix[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        generator_matrix[:3, 3] = v
        expected = torch.linalg.matrix_exp(generator_matrix)
        torch.testing.assert_close(R.quats_to_matrices(quat), expected[:3, :3])
        torch.testing.assert_close(shift, expected[:3, 3])


def test_exp_se3_has_gradients_at_rest():
    turns = torch.zeros(3, 3, dtype=torch.float64, requires_grad=True)
    shifts = torch.randn(3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(R.exp_se3, (turns, shifts))
    big = torch.randn(3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(R.exp_se3, (big, shifts))


def test_turned_quats_by_kernel_and_in_float64() -> None:
    torch.manual_seed(0)
    change, quats, upstream = torch.randn(3, 600, 4).unbind()
    quats[0] = 0  # stays zero
    assert replacement(R.turned_quats, change, quats) is not None
    results = []
    for dtype in (torch.float32, torch.float64):
        a, b = change.to(dtype).requires_grad_(), quats.to(dtype).requires_grad_()
        turned = R.turned_quats(a, b)
        results.append([turned.detach(), *torch.autograd.grad(turned, (a, b), upstream.to(dtype))])
    (turned, to_change, to_quats), exact = results
    assert (turned[0] == 0).all()
    for ours, theirs in zip((turned, to_change, to_quats[1:]), (*exact[:2], exact[2][1:])):
        bound = 2e-6 * float(theirs.abs().amax())
        torch.testing.assert_close(ours.double(), theirs, rtol=0, atol=bound)
    identity = torch.tensor((1.0, 0.0, 0.0, 0.0)).double()
    turn = R.normalize_quats(change.double() + identity)
    plain = R.multiply_quats(turn, R.normalize_quats(quats.double()))
    torch.testing.assert_close(exact[0], plain)


def test_the_relative_turn_takes_one_rotation_to_the_other():
    before, after = (torch.randn(20, 4, dtype=torch.float64) for _ in range(2))
    expected = R.multiply_quats(after, R.conjugate_quats(before))
    torch.testing.assert_close(R.relative_quats(after, before), expected)
    turned = R.multiply_quats(R.normalize_quats(expected), R.normalize_quats(before))
    torch.testing.assert_close(turned, R.normalize_quats(after))
