"""Object initialisation against a scene of known truth: scale, place, world transform."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.model.object_placement import (
    OPENGL_TO_OPENCV,
    Reading,
    fit_scale,
    locate,
    mask_box,
    place_in_world,
    placed_track,
    projected_area,
    seen_middle,
)
from hoigs.core.values.camera import Camera

SIZE, FRAMES, TRUE_SCALE = 128, 12, 0.23


def bracket() -> torch.Tensor:
    """A solid L with a nose: no symmetry at all; canonical units, about its mean."""
    g = torch.Generator().manual_seed(0)
    bar = torch.rand(4000, 3, generator=g) * torch.tensor([2.0, 0.6, 0.7])
    leg = torch.rand(4000, 3, generator=g) * torch.tensor([0.5, 1.6, 0.7])
    nose = torch.rand(1500, 3, generator=g) * torch.tensor([0.4, 0.3, 0.5])
    points = torch.cat((bar, leg, nose + torch.tensor([1.5, 0.1, 0.7])))
    return points - points.mean(0)


class Truth:
    """Cameras on an arc about a bracket that flies and turns: masks and depth from its points."""

    def __init__(self, shape: torch.Tensor | None = None, path: float = 0.25) -> None:
        self.shape = bracket() if shape is None else shape
        steps = torch.linspace(0, 1, FRAMES)
        axis = torch.tensor([0.3, 0.9, -0.2])
        self.turns = axis_angle_to_matrices(axis * 1.5 * steps[:, None])
        self.places = torch.stack((path * (2 * steps - 1), 0.1 * steps, 0.1 * steps), 1)
        self.cameras, self.masks, self.depths = [], [], []
        for i, s in enumerate(steps.tolist()):
            angle = 0.6 * (s - 0.5)
            eye = torch.tensor([2.5 * math.sin(angle), 0.3, -2.5 * math.cos(angle)])
            camera = Camera.look_at(eye, torch.zeros(3), width=SIZE, height=SIZE, fov_y=0.6)
            mask, depth = seen(self.world(i), camera)
            self.cameras.append(camera)
            self.masks.append(mask)
            self.depths.append(depth)

    def world(self, i: int) -> torch.Tensor:
        return TRUE_SCALE * self.shape @ self.turns[i].mT + self.places[i]

    def in_camera(self) -> tuple[torch.Tensor, torch.Tensor]:
        """v_t and R_obj^t as the truth knows them."""
        shifts = [c.to_camera(p) for c, p in zip(self.cameras, self.places, strict=True)]
        turns = [
            c.world_to_camera[:3, :3] @ r for c, r in zip(self.cameras, self.turns, strict=True)
        ]
        return torch.stack(shifts), torch.stack(turns)


def seen(points: torch.Tensor, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    xy, z = camera.project(points)
    at = xy.floor().long()
    inside = ((at >= 0) & (at < SIZE)).all(1)
    depth = torch.full((SIZE * SIZE,), torch.inf)
    depth.scatter_reduce_(0, (at[:, 1] * SIZE + at[:, 0])[inside], z[inside], "amin")
    depth = depth.view(SIZE, SIZE)
    return torch.isfinite(depth), torch.where(torch.isfinite(depth), depth, 0.0)


def test_the_scale_is_the_papers_formula():
    """mean_t sqrt(A_mask / A_proj), written out in float64, of the object placed unscaled."""
    truth = Truth()
    small = 0.3 * truth.shape
    shifts, turns = truth.in_camera()
    ratios = []
    for i, camera in enumerate(truth.cameras):
        points = (small.double() @ turns[i].double().mT) + shifts[i].double()
        xy = points[:, :2] / points[:, 2:] * camera.K[0, 0].double()
        rows, columns = truth.masks[i].nonzero(as_tuple=True)
        box = (int(rows.max() - rows.min()) + 1) * (int(columns.max() - columns.min()) + 1)
        ratios.append(math.sqrt(box / float((xy.amax(0) - xy.amin(0)).prod())))
    paper = Reading(reduce="mean", frames="all", iterations=1, quantile=0.0)
    fit = fit_scale(small, truth.masks, truth.cameras, shifts, turns, paper)
    assert fit.scale == pytest.approx(sum(ratios) / FRAMES, rel=1e-4)
    torch.testing.assert_close(fit.ratios, torch.tensor(ratios), rtol=1e-4, atol=0)
    other = replace(paper, reduce="median")
    other = fit_scale(small, truth.masks, truth.cameras, shifts, turns, other)
    assert other.scale == pytest.approx(sorted(ratios)[(FRAMES - 1) // 2], rel=1e-4)


def test_iterating_removes_the_bias_of_thick_objects():
    truth = Truth()
    shifts, turns = truth.in_camera()
    once = fit_scale(
        truth.shape, truth.masks, truth.cameras, shifts, turns, Reading(iterations=1, quantile=0.0)
    )
    thrice = fit_scale(
        truth.shape, truth.masks, truth.cameras, shifts, turns, Reading(quantile=0.0)
    )
    assert abs(once.scale / TRUE_SCALE - 1) > 0.1
    assert abs(thrice.scale / TRUE_SCALE - 1) < 0.03
    assert thrice.spread < once.spread + 1e-3
    # what reaches behind the camera has no box: the paper's single evaluation is refused
    with pytest.raises(ValueError, match="behind the camera"):
        fit_scale(9 * truth.shape, truth.masks, truth.cameras, shifts, turns, Reading(iterations=1))
    large = fit_scale(
        9 * truth.shape, truth.masks, truth.cameras, shifts, turns, Reading(quantile=0.0)
    )
    assert large.scale == pytest.approx(thrice.scale / 9, rel=1e-3)


def test_cut_masks_pull_the_mean_down_and_leave_the_median():  # F19
    truth = Truth()
    shifts, turns = truth.in_camera()
    masks = [m.clone() for m in truth.masks]
    for mask in masks[::3]:  # a hand hides half of it
        left, _, right, _ = mask_box(mask)
        mask[:, : (left + right) // 2] = False
    args = (truth.shape, masks, truth.cameras, shifts, turns)
    mean = fit_scale(*args, Reading(reduce="mean", frames="all", quantile=0.0))
    median = fit_scale(*args, Reading(quantile=0.0))
    assert mean.scale < 0.95 * TRUE_SCALE
    assert abs(median.scale / TRUE_SCALE - 1) < 0.03
    assert mean.spread > 3 * median.spread
    assert not median.counted[::3].any()


def test_masks_at_the_border_do_not_count():
    truth = Truth(path=0.75)  # it enters and leaves the image
    shifts, turns = truth.in_camera()
    fit = fit_scale(truth.shape, truth.masks, truth.cameras, shifts, turns, Reading(quantile=0.0))
    assert not fit.counted[0] and not fit.counted[-1]
    assert abs(fit.scale / TRUE_SCALE - 1) < 0.03
    everything = fit_scale(
        truth.shape, truth.masks, truth.cameras, shifts, turns,
        Reading(frames="all", reduce="mean", quantile=0.0),
    )  # fmt: skip
    assert everything.counted.sum() > fit.counted.sum()
    assert everything.scale < fit.scale


def test_stray_points_are_cut_off_by_the_quantile():
    truth = Truth()
    stray = truth.shape.clone()
    stray[:10] *= 4
    camera, shift = truth.cameras[0], torch.tensor([0.0, 0, 2.5])
    clean = projected_area(TRUE_SCALE * truth.shape + shift, camera)
    assert projected_area(TRUE_SCALE * stray + shift, camera) == pytest.approx(clean, rel=0.02)
    assert projected_area(TRUE_SCALE * stray + shift, camera, 0.0) > 2 * clean
    assert projected_area(truth.shape - shift, camera) is None


def test_a_box_of_splats_is_wider_by_their_half_alpha():
    """Ends of the box by the Gaussian's own formula, exp(-x^2 / 2 sigma^2) = 1/2, in float64."""
    truth = Truth()
    camera, shift = truth.cameras[0], torch.tensor([0.1, 0, 2.5])
    points, sigmas = TRUE_SCALE * truth.shape + shift, torch.rand(len(truth.shape)) * 0.05
    reach = math.sqrt(2 * math.log(2)) * sigmas.double()
    assert torch.exp(-(reach**2) / (2 * sigmas.double() ** 2)).allclose(torch.tensor(0.5).double())
    focal, z = camera.K[0, 0].double(), points[:, 2].double()
    sides = [
        ((points[:, k].double() + reach) / z * focal).max()
        - ((points[:, k].double() - reach) / z * focal).min()
        for k in (0, 1)
    ]
    found = projected_area(points, camera, 0.0, sigmas)
    assert found == pytest.approx(float(sides[0] * sides[1]), rel=1e-5)
    assert found > 1.1 * projected_area(points, camera, 0.0)
    shifts, turns = truth.in_camera()
    args = (truth.shape, truth.masks, truth.cameras, shifts, turns)
    thick = fit_scale(*args, sigmas=torch.full((len(truth.shape),), 0.2)).scale
    assert thick < 0.9 * fit_scale(*args).scale


def test_world_transform_equals_the_equation():
    """R_t^-1 ((S mu + v_t) - t_t) in float64, with an explicit matrix inverse."""
    truth = Truth()
    camera, shift = truth.cameras[3], torch.tensor([0.2, -0.1, 2.0])
    view = camera.world_to_camera.double()
    inside = 0.4 * truth.shape.double() + shift.double() - view[:3, 3]
    expected = (torch.linalg.inv(view[:3, :3]) @ inside.mT).mT
    placed = place_in_world(truth.shape, 0.4, shift, camera)
    torch.testing.assert_close(placed.double(), expected, atol=1e-5, rtol=0)


def test_a_rotation_per_frame_meets_the_truth_and_none_does_not():
    truth = Truth()
    shifts, turns = truth.in_camera()
    rigid, paper = [], []
    for i, camera in enumerate(truth.cameras):
        world = truth.world(i)
        placed = place_in_world(truth.shape, TRUE_SCALE, shifts[i], camera, turns[i])
        rigid.append(float((placed - world).norm(dim=1).max()))
        still = place_in_world(truth.shape @ turns[0].mT, TRUE_SCALE, shifts[i], camera)
        paper.append(float((still - world).norm(dim=1).mean()))
    assert max(rigid) < 1e-5
    assert paper[0] < 1e-5 and paper[-1] > 0.1  # the paper's object never turns on its own


def test_generator_axes_are_an_input():
    """A shape in OpenGL's axes, upright before the camera, must not arrive upside down."""
    flip = torch.tensor(OPENGL_TO_OPENCV)
    truth = Truth()
    shifts, turns = truth.in_camera()
    generated = truth.shape @ flip.mT  # the same object, written in other axes
    placed = place_in_world(generated, TRUE_SCALE, shifts[2], truth.cameras[2], turns[2] @ flip)
    torch.testing.assert_close(placed, truth.world(2), atol=1e-5, rtol=0)
    wrong = place_in_world(generated, TRUE_SCALE, shifts[2], truth.cameras[2], turns[2])
    assert (wrong - truth.world(2)).norm(dim=1).mean() > 0.1
    assert torch.linalg.det(flip) == 1


def test_front_of_a_ball():  # F18
    i = torch.arange(8000) + 0.5  # evenly spread, so that none of the back shows through
    z, turn = 1 - i / 4000, i * math.pi * (3 - 5**0.5)
    ring = (1 - z * z).sqrt()
    ball = torch.stack((ring * turn.cos(), ring * turn.sin(), z), 1)
    assert float(seen_middle(ball)[2]) == pytest.approx(-2 / 3, abs=0.04)
    assert seen_middle(ball)[:2].abs().max() < 0.03
    truth = Truth(shape=1.1 * ball)
    shifts, turns = truth.in_camera()
    found = locate(truth.shape, truth.masks, truth.depths, truth.cameras, turns)
    naive = locate(
        truth.shape, truth.masks, truth.depths, truth.cameras, turns, Reading(front=False)
    )
    depth = shifts[:, 2]
    assert ((found.shifts[:, 2] - depth) / depth).abs().max() < 0.01
    assert ((naive.shifts[:, 2] - depth) / depth).abs().max() > 0.05
    assert abs(found.fit.scale / TRUE_SCALE - 1) < 0.03 < abs(naive.fit.scale / TRUE_SCALE - 1)


def test_located_and_placed_as_a_track():
    truth = Truth()
    _, turns = truth.in_camera()
    masks, depths = list(truth.masks), list(truth.depths)
    masks[5], depths[7] = torch.zeros_like(masks[5]), None  # unseen, and without depth
    found = locate(truth.shape, masks, depths, truth.cameras, turns, Reading(quantile=0.0))
    assert (~found.observed).nonzero().squeeze(1).tolist() == [5, 7]
    assert abs(found.fit.scale / TRUE_SCALE - 1) < 0.04
    colors = torch.rand(len(truth.shape), 3)
    track = placed_track(
        truth.shape, colors, found, truth.cameras, turns, provenance="a test's own shape"
    )
    for i in range(FRAMES):
        world = track.points @ track.rotations[i].mT + track.translations[i]
        same = place_in_world(
            truth.shape, found.fit.scale, found.shifts[i], truth.cameras[i], turns[i]
        )
        torch.testing.assert_close(world, same, atol=1e-5, rtol=0)
        assert (world - truth.world(i)).norm(dim=1).mean() < 0.04  # of a thing 0.5 m long
    jumpy = locate(truth.shape, masks, depths, truth.cameras, turns, Reading(smooth=False))
    bends = [(p.shifts[2:] - 2 * p.shifts[1:-1] + p.shifts[:-2]).norm() for p in (found, jumpy)]
    assert bends[0] < bends[1]


def test_errors_speak():
    truth = Truth()
    shifts, turns = truth.in_camera()
    empty = [torch.zeros_like(m) for m in truth.masks]
    with pytest.raises(ValueError, match="empty in every frame"):
        fit_scale(truth.shape, empty, truth.cameras, shifts, turns)
    with pytest.raises(ValueError, match="no frame has known depth"):
        locate(truth.shape, truth.masks, [None] * FRAMES, truth.cameras, turns)
    full = [torch.ones_like(m) for m in truth.masks]
    with pytest.raises(ValueError, match='frames="all"'):
        fit_scale(truth.shape, full, truth.cameras, shifts, turns)
    with pytest.raises(ValueError, match="at least 1 iteration"):
        fit_scale(truth.shape, truth.masks, truth.cameras, shifts, turns, Reading(iterations=0))
