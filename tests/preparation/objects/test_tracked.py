"""A painted box between two hands, whose turning is found from its texture."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hoigs.core.maths.rotations import axis_angle_to_matrices
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import ObjectTrack
from hoigs.preparation.mask_stack import MaskStack, outlines_of
from hoigs.preparation.objects import make_object as making
from hoigs.preparation.objects.alignment import Aligned, Poses, make_crops
from hoigs.preparation.objects.filmed import Filmed
from hoigs.preparation.objects.hands import hand_motion, upward
from hoigs.preparation.objects.make_object import ObjectWay, make_object
from hoigs.preparation.objects.search import ballistic, flights_by_texture
from hoigs.preparation.objects.shape import completed, held_object, hull, with_samples
from hoigs.preparation.objects.tracked import (
    ObjectConfidence,
    between,
    tracked_object,
)
from hoigs.preparation.objects.watched import UntrackableError, watched

FRAMES, SIZE, FPS = 12, 96, 12.0
PARENTS = (-1, *range(51))
HALF = torch.tensor([0.17, 0.12, 0.13])
CAMERA = Camera(torch.tensor([[170.0, 0, 48], [0, 170, 48], [0, 0, 1]]), torch.eye(4), SIZE, SIZE)


def poses(angle: float) -> tuple[torch.Tensor, torch.Tensor]:
    """A swing about the vertical by `angle` radians to either side, 2 m away."""
    phase = torch.linspace(-1, 1, FRAMES)
    turns = torch.stack((0.2 * phase, angle * phase, 0 * phase), -1)
    places = torch.stack((0.15 * phase, 0.05 * phase, 2 + 0 * phase), -1)
    return axis_angle_to_matrices(turns), places


def picture(rotation: torch.Tensor, place: torch.Tensor, contrast: float):
    """Image and mask of the box, ray-cast: each face is painted with its own waves."""
    rays = torch.linalg.solve(
        CAMERA.K, torch.cat((CAMERA.pixel_grid(), torch.ones(SIZE, SIZE, 1)), -1)[..., None]
    )[..., 0]
    origin, rays = -place @ rotation, rays @ rotation
    near, far = (-HALF - origin) / rays, (HALF - origin) / rays
    enter = torch.minimum(near, far).amax(-1)
    mask = enter < torch.maximum(near, far).amin(-1)
    at = origin + rays * enter[..., None]
    waves = torch.stack([torch.sin(at @ w) for w in WAVES], -1)
    color = (0.5 + contrast * waves).clamp(0, 1)
    image = torch.where(mask[..., None], color, torch.tensor([0.1, 0.3, 0.1]))
    return (255 * image).byte().numpy(), mask.numpy()


WAVES = 20 * torch.randn(3, 3, 3, generator=torch.Generator().manual_seed(0)).sum(0)


def filmed(contrast: float = 0.35, *, motion: tuple[torch.Tensor, torch.Tensor] | None = None):
    """Images, masks of object and person, and joints of a body whose palms are at its sides."""
    rotations, places = motion or poses(0.7)
    shown = [picture(r, t, contrast) for r, t in zip(rotations, places, strict=True)]
    joints = torch.zeros(FRAMES, 52, 3) + torch.tensor([0, 0, 2.5])
    for side, wrist, first in ((-1.0, 20, 22), (1.0, 21, 37)):
        for joint, forward in ((wrist, 0.0), (first, 0.1), (first + 3, 0.1), (first + 6, 0.1)):
            local = torch.tensor([side * (HALF[0] + 0.02), 0.02, 0.05 - forward])
            joints[:, joint] = (rotations @ local) + places
    images = np.stack([image for image, _ in shown])
    objects = MaskStack(mask for _, mask in shown)
    humans = MaskStack(np.zeros_like(mask) for _, mask in shown)
    return images, objects, humans, joints


def around(
    images, objects: MaskStack, humans: MaskStack, joints: torch.Tensor | None = None
) -> Filmed:
    """As `make_object` needs them."""
    cameras = [CAMERA] * len(objects)
    return Filmed(objects, humans, humans, cameras, lambda: iter(images), FPS, joints, PARENTS)


def not_flat(*_: object) -> object:
    raise UntrackableError("it is a box")


def angles(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return torch.rad2deg(torch.acos((((a * b).sum((-1, -2)) - 1) / 2).clamp(-1, 1)))


def test_turning_and_shape_of_a_held_box() -> None:
    images, objects, humans, joints = filmed()
    joints = joints + 0.02 * torch.randn(joints.shape, generator=torch.Generator().manual_seed(1))
    shown = around(images, objects, humans, joints)
    track, normals, confidence = tracked_object(
        watched(shown), 800, lambda _: None, levels=((5.0, 6, 60), (2.0, 2, 60))
    )
    rotations, places = poses(0.7)
    left, _, right = torch.linalg.svd((track.rotations.mT @ rotations).sum(0))
    off = angles(track.rotations @ left @ right, rotations)
    assert float(off.median()) < 6  # of a swing of 80 degrees, after a quarter of the steps
    assert float((track.translations - places).norm(dim=-1).mean()) < 0.03
    outwards = (normals * track.points).sum(-1) > 0
    assert float(outwards.float().mean()) > 0.95
    assert np.nanmedian(confidence.agreement) > 0.8 and confidence.held > 0.6
    assert np.nanmedian(np.abs(confidence.hand_distance)) < 0.06


def test_what_has_no_texture_is_refused() -> None:
    images, objects, humans, joints = filmed(contrast=0.0)
    rng = np.random.default_rng(0)
    noisy = np.clip(images + rng.normal(size=images.shape) * 4, 0, 255).astype(np.uint8)
    with pytest.raises(UntrackableError, match="texture"):
        watched(around(noisy, objects, humans, joints))


def test_what_is_seen_briefly_goes_the_old_way_by_name() -> None:
    images, objects, humans, joints = filmed()
    brief = MaskStack(m if i < 5 else np.zeros_like(m) for i, m in enumerate(objects))
    made = make_object(
        None, around(images, brief, humans, joints), way="auto", radius=0.1, count=200,
        progress=lambda _: None,
    )  # fmt: skip
    assert made.confidence.way == "outline" and "5 frames" in made.confidence.reason
    assert "roll" in made.track.provenance


def test_hands_turn_what_they_hold_and_nothing_else() -> None:
    _, objects, _, joints = filmed()
    cameras = [CAMERA] * FRAMES
    held = hand_motion(joints, objects, outlines_of(objects), cameras, FPS)
    rotations, _ = poses(0.7)
    assert held.near.all()
    turned = torch.from_numpy(held.rotations).float()
    assert float(angles(turned @ turned[0].mT, (rotations @ rotations[0].mT)).max()) < 1
    away = hand_motion(joints + 1.0, objects, outlines_of(objects), cameras, FPS)
    assert not away.held.any() and np.allclose(away.rotations, np.eye(3))


def test_what_a_hand_moves_does_not_rest_where_it_turns_back() -> None:
    """A push to and fro: half a period after a frame the object is where it was."""
    phase = torch.arange(FRAMES) * torch.pi / 2
    places = torch.stack((0.05 * phase.sin(), 0 * phase, 2 + 0 * phase), -1)
    _, objects, _, joints = filmed(motion=(torch.eye(3).expand(FRAMES, 3, 3), places))
    outlines, cameras = outlines_of(objects), [CAMERA] * FRAMES
    pushed = hand_motion(joints, objects, outlines, cameras, 2 * FPS)
    assert pushed.near.all() and pushed.held.all() and not pushed.rests.any()


def test_what_stays_rests_with_hands_at_it_or_not() -> None:
    still = torch.eye(3).expand(FRAMES, 3, 3), torch.tensor([0.0, 0, 2]).expand(FRAMES, 3)
    _, objects, _, joints = filmed(motion=still)
    for offset in (0.0, 1.0):
        motion = hand_motion(joints + offset, objects, outlines_of(objects), [CAMERA] * FRAMES, FPS)
        assert motion.rests.all() and not motion.held.any()


def test_what_is_hidden_moves_with_the_hands_that_hold_it() -> None:
    phase = torch.linspace(0, 1, FRAMES)[:, None]
    rotations = axis_angle_to_matrices(phase * torch.tensor([0.0, 2.0, 0.0]))
    places = torch.cat((0.2 * (3 * phase).sin(), 0.1 * (3 * phase).cos(), 2 + phase), -1)
    _, objects, _, joints = filmed(motion=(rotations, places))
    shown = np.array([not 3 <= i < 9 for i in range(FRAMES)])
    slivers = MaskStack(
        m & (np.arange(SIZE) < 0 if 3 <= i < 9 else True) for i, m in enumerate(objects)
    )
    hands = hand_motion(joints, slivers, outlines_of(slivers), [CAMERA] * FRAMES, FPS)
    assert hands.near.all()
    hands = replace(hands, held=np.ones(FRAMES, bool), rotations=rotations.double().numpy())
    part = Poses(rotations[shown], places[shown])
    turned, moved = between(part, torch.zeros(3), shown, hands)
    torch.testing.assert_close(turned, rotations, atol=1e-4, rtol=0)
    torch.testing.assert_close(moved, places, atol=1e-4, rtol=0)


def test_a_person_behind_the_object_hides_nothing_of_it_but_other_objects_do() -> None:
    images, objects, nothing, _ = filmed()
    beside = MaskStack(~mask for mask in objects)
    shown = np.ones(FRAMES, bool)
    cases = ((3.0, beside, nothing, 0.0), (1.5, beside, nothing, 1.0), (3.0, nothing, beside, 1.0))
    for depth, person, others, share in cases:
        body = torch.tensor([0.0, 0.0, depth]).expand(FRAMES, 1, 3)
        crops = make_crops(
            replace(around(images, objects, person), others=others), shown, 32, body,
            np.full(FRAMES, 2.2),
        )  # fmt: skip
        assert float(crops.hidden[crops.masks == 0].mean()) == share


@pytest.mark.parametrize(("angle", "one_sided"), [(0.3, True), (2.5, False)])
def test_a_back_that_no_frame_shows_is_filled(angle: float, one_sided: bool) -> None:
    """A fit leaves a dome behind the front; the box is 0.34 broad, 0.24 high and 0.26 deep."""
    rotations, places = poses(angle)
    images, objects, humans, _ = filmed(motion=(rotations, places))
    crops = make_crops(
        around(images, objects, humans), np.ones(FRAMES, bool), 96, torch.zeros(FRAMES, 0, 3),
        np.full(FRAMES, 2.5),
    )  # fmt: skip
    known = Poses(rotations, places)
    surface = hull(crops, known, 0.35, 800)
    rays = torch.nn.functional.normalize(surface.rest, dim=-1)
    box = rays * (HALF / rays.abs()).amin(-1, keepdim=True)
    dome = torch.where(rays[:, 2:] > 0, 0.13 * rays, box)  # z points away from the camera
    found, depth = completed(crops, with_samples(dome, surface.faces, 800), known, dome, 0.35)
    if not one_sided:
        assert depth is None and torch.equal(found, dome)
        return
    assert depth is not None and 0.22 < depth < 0.3
    front = rays[:, 2] < -0.9
    assert torch.equal(found[front], dome[front])
    back = rays[:, 2] > 0.3
    off = [(v[back] - box[back]).norm(dim=-1).mean() for v in (dome, found)]
    assert off[1] < 0.5 * off[0]


def test_what_is_seen_from_above_does_not_hang_down_at_the_back() -> None:
    """Outlines allow everything behind the lower front edge, on the rays that go down past it."""
    swing, places = poses(0.3)
    rotations = axis_angle_to_matrices(torch.tensor([0.4, 0.0, 0.0])) @ swing
    images, objects, humans, _ = filmed(motion=(rotations, places))
    crops = make_crops(
        around(images, objects, humans), np.ones(FRAMES, bool), 96, torch.zeros(FRAMES, 0, 3),
        np.full(FRAMES, 2.5),
    )  # fmt: skip
    surface = hull(crops, Poses(rotations, places), 0.35, 800)
    found, depth = completed(crops, surface, Poses(rotations, places), surface.rest, 0.35)
    assert depth is not None
    # y points down, z away from the camera
    below = [
        float((v[:, 1] - HALF[1])[v[:, 2] > 0].clamp_min(0).max()) for v in (surface.rest, found)
    ]
    assert below[0] > 0.05 and below[1] < 0.4 * below[0], below


def test_a_spin_in_flight_is_found_by_texture() -> None:
    _, places = poses(0.7)
    flight = slice(3, 9)
    turns = torch.zeros(FRAMES, 3)
    turns[:, 1] = torch.tensor([-0.7, -0.4, 0, *[0] * 6, 0, 0.4, 0.7])
    turns[flight, 0] = torch.linspace(0, 2 * torch.pi, 8)[1:-1]
    rotations = axis_angle_to_matrices(turns)
    images, objects, humans, _ = filmed(motion=(rotations, places))
    crops = make_crops(
        around(images, objects, humans), np.ones(FRAMES, bool), 64, torch.zeros(FRAMES, 0, 3),
        np.ones(FRAMES),
    )  # fmt: skip
    known = np.array([i for i in range(FRAMES) if not 3 <= i < 9])
    surface = hull(crops, Poses(rotations, places), 0.3, 600)
    agreement = np.ones(len(known))
    first = Aligned(
        known, Poses(rotations[known], places[known]), surface.rest, agreement, agreement, 0.0
    )
    guess = Poses(torch.eye(3).expand(FRAMES, 3, 3), places)
    found = flights_by_texture(crops, surface, first, guess, np.array([0.0, -1, 0]), FPS)
    assert float(angles(found.rotations[flight], rotations[flight]).max()) < 25
    assert float(angles(guess.rotations[flight], rotations[flight]).max()) > 120


def test_up_is_where_balance_keeps_the_body() -> None:
    """And not where a bent head is."""
    joints = np.zeros((4, 52, 3))
    joints[:, [7, 8]] = (0, 0, -0.06)
    joints[:, [10, 11]] = (0, 0, 0.06)
    joints[:, [0, 9, 16, 17], 1] = (0.9, 1.2, 1.4, 1.4)
    joints[:, 15] = (0, 1.5, 0.4)
    np.testing.assert_allclose(upward(joints), (0, 1, 0), atol=1e-9)


def test_a_throw_need_not_leave_the_hand_at_a_frame() -> None:
    """Hands move it until then; its place along the view comes from gravity."""
    times = torch.arange(12) / 16
    flight = torch.stack(
        (0.3 * times, 0.2 + 3.4 * times - 9.81 / 2 * times**2, 3.5 + 0.2 * times), -1
    )
    known = flight.clone()
    known[[0, -1], 1] += 0.12  # in the hand, which has not got that far
    rays = torch.nn.functional.normalize(flight, dim=-1)
    crops = SimpleNamespace(
        frames=np.arange(12), centers=lambda: torch.zeros(12, 3),
        middles=lambda rows: rays[rows].double().numpy(),
    )  # fmt: skip
    rows = np.arange(1, 11)
    found = ballistic(crops, known, rows, np.array([0.0, 1.0, 0.0]), 16.0)  # type: ignore[arg-type]
    assert float((found - flight[rows]).norm(dim=-1).max()) < 0.02


def test_a_shape_far_off_its_masks_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where landmarks are wrong, and the texture is another thing's."""
    images, objects, humans, joints = filmed()

    def collapsed(*arguments: object, **settings: object) -> object:
        points = 0.01 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
        rotations, places = poses(0.7)
        seen = torch.ones(FRAMES, dtype=torch.bool)
        track = ObjectTrack(points, torch.full_like(points, 0.5), rotations, places, seen)
        return track, points, replace(ObjectConfidence.none("t", FRAMES, ""),
                                      outline=np.full(FRAMES, 0.1))  # fmt: skip

    monkeypatch.setattr(making, "plate_object", not_flat)
    monkeypatch.setattr(making, "tracked_object", collapsed)
    made = make_object(
        None, around(images, objects, humans, joints), way="auto", radius=None, count=200,
        progress=lambda _: None,
    )  # fmt: skip
    assert made.confidence.way == "outline" and "held back" in made.confidence.reason


@pytest.mark.parametrize(("way", "beside", "taken"), [
    ("auto", 0.15, "outline"), ("auto", 0.0, "texture and hands"),
    ("texture", 0.15, "texture and hands"),
])  # fmt: skip
def test_poses_that_leave_the_masks_lose_to_the_outlines(
    way: ObjectWay, beside: float, taken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of something shiny, whose texture is that of what it mirrors."""
    images, objects, humans, joints = filmed()
    shown = around(images, objects, humans, joints)
    settings = {"radius": None, "count": 400, "progress": lambda _: None}
    good = make_object(None, shown, way="outline", **settings)  # type: ignore[arg-type]
    _, normals, _ = held_object(shown, 400)

    def moved(*arguments: object, **_: object) -> object:
        places = good.track.translations + torch.tensor([beside, 0.0, 0.0])
        confidence = replace(
            good.confidence, way="texture and hands", outline=np.full(FRAMES, 0.01)
        )
        return replace(good.track, translations=places), normals, confidence

    monkeypatch.setattr(making, "plate_object", not_flat)
    monkeypatch.setattr(making, "tracked_object", moved)
    made = make_object(None, shown, way=way, **settings)  # type: ignore[arg-type]
    assert made.confidence.way == taken
    assert ("held back" in made.confidence.reason) == (taken == "outline")
