"""deformation:object-bone and deformation:rigid-frames: objects that move as a whole."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from hoigs.core.interfaces.body import LEFT_WRIST, RIGHT_WRIST
from hoigs.core.interfaces.context import BuildContext
from hoigs.core.maths.rotations import axis_angle_to_matrices, quats_to_matrices
from hoigs.core.model.entity import Entity
from hoigs.core.values.clip import ObjectTrack
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import BodyPose, Moment
from hoigs.core.values.tokens import Residual
from hoigs.plugins.deformation.skinned_body import FrameCorrections
from hoigs.plugins.deformation.zoo.object_bone import (
    Attachment,
    ObjectBone,
    ObjectBoneConfig,
    attachments_of,
    rest_transitions,
    state_of,
)
from hoigs.plugins.deformation.zoo.rigid_frames import RigidFrames

FRAMES = 12


def thing(count: int = 20) -> Gaussians:
    generator = torch.Generator().manual_seed(2)
    points = 0.1 * torch.randn(count, 3, generator=generator)
    canonical = Gaussians.from_points(points, scales=0.01)
    return canonical.replace(quats=torch.randn(count, 4, generator=generator))


def poses(toy_pose) -> BodyPose:
    """A walk: every frame is its own pose."""
    each = [toy_pose(seed, size=0.3) for seed in range(FRAMES)]
    fields = ("global_orient", "body", "left_hand", "right_hand", "transl")
    stacked = {name: torch.stack([getattr(p, name) for p in each]) for name in fields}
    return BodyPose(**stacked, betas=torch.zeros(2))


def wrist(body, pose: BodyPose, joint: int) -> tuple[Tensor, Tensor]:
    """Rotation of a joint in the world and its place, from the body's own forward pass."""
    return body.skinning_transforms(pose)[joint, :3, :3], body(pose).joints[joint]


def held(body, walk: BodyPose, joint: int, quat: Tensor, place: Tensor) -> ObjectTrack:
    """The track of an object that a wrist holds."""
    rotations, translations = [], []
    for f in range(FRAMES):
        turn, origin = wrist(body, walk.frame(f), joint)
        rotations.append(turn @ quats_to_matrices(quat))
        translations.append(turn @ place + origin)
    canonical = thing()
    seen = torch.ones(FRAMES, dtype=torch.bool)
    return ObjectTrack(
        canonical.means, canonical.colors, torch.stack(rotations), torch.stack(translations), seen
    )


def bone(
    body, attachments: list[Attachment], *transitions: float, refine: bool = False
) -> ObjectBone:
    return ObjectBone(
        ObjectBoneConfig(refine=refine), bodies={"human": body}, attachments=attachments,
        transitions=transitions, num_frames=FRAMES,
    )  # fmt: skip


IDENTITY = Attachment("human/left", torch.tensor([1.0, 0, 0, 0]), torch.zeros(3), 0.0)


def test_with_no_offset_it_is_the_wrist(toy_body, toy_pose):
    model = bone(toy_body, [IDENTITY])
    canonical, pose = thing(), toy_pose(3)
    out = Entity(canonical, model, kind="object")(Moment(0.4, poses={"human": pose}))
    turn, origin = wrist(toy_body, pose, LEFT_WRIST)
    torch.testing.assert_close(out.means, canonical.means @ turn.mT + origin, atol=1e-5, rtol=0)
    expected = turn @ quats_to_matrices(canonical.quats)
    torch.testing.assert_close(quats_to_matrices(out.quats), expected, atol=1e-5, rtol=0)
    shifted = Entity(canonical, model)(
        Moment(0.4, poses={"human": pose}), Residual(means=torch.ones(20, 3))
    )
    torch.testing.assert_close(shifted.means, out.means + 1)


@pytest.mark.parametrize("rule", ["nearest", "steadiest"])
def test_the_offset_starts_from_the_track(toy_body, toy_pose, rule):
    walk = poses(toy_pose)
    quat = torch.nn.functional.normalize(torch.tensor([0.4, -0.3, 0.8, 0.1]), dim=0)
    track = held(toy_body, walk, RIGHT_WRIST, quat, torch.tensor([0.05, -0.02, 0.03]))
    found = attachments_of({"human": toy_body}, {"human": walk}, track, [], rule)
    assert [a.bone for a in found] == ["human/right"] and found[0].spread < 1e-4
    model = bone(toy_body, found)
    canonical = thing()
    for f in range(FRAMES):
        out = model(canonical, Moment(f / (FRAMES - 1), poses={"human": walk.frame(f)}))
        expected = canonical.means @ track.rotations[f].mT + track.translations[f]
        torch.testing.assert_close(out.means, expected, atol=1e-4, rtol=0)


def test_put_down_it_belongs_to_the_world(toy_body, toy_pose):
    walk = poses(toy_pose)
    quat, place = torch.tensor([1.0, 0, 0, 0]), torch.tensor([0.1, 0.0, 0.0])
    track = held(toy_body, walk, LEFT_WRIST, quat, place)
    last = FRAMES // 2
    track.rotations[last:] = track.rotations[last]
    track.translations[last:] = track.translations[last]
    transitions = [(last - 0.5) / (FRAMES - 1)]
    bodies, walks = {"human": toy_body}, {"human": walk}
    found = attachments_of(bodies, walks, track, transitions, "steadiest")
    assert [a.bone for a in found] == ["human/left", "world"]
    assert all("/" in a.bone for a in attachments_of(bodies, walks, track, [0.5], "nearest"))
    model = bone(toy_body, found, *transitions)
    canonical = thing()
    for f in (0, last - 1, last, FRAMES - 1):
        out = model(canonical, Moment(f / (FRAMES - 1), poses={"human": walk.frame(f)}))
        expected = canonical.means @ track.rotations[f].mT + track.translations[f]
        torch.testing.assert_close(out.means, expected, atol=1e-4, rtol=0)


def test_transitions_of_a_track_that_rests_moves_and_rests():
    seconds = torch.arange(90) / 30
    x = (seconds - 1).clamp(0, 1)  # a metre in the second second
    places = torch.stack((x, 0 * x, 0 * x), 1)
    places[75] += 0.3  # one frame that the tracker lost
    turns = torch.eye(3).expand(90, 3, 3)
    seen = torch.ones(90, dtype=torch.bool)
    track = ObjectTrack(torch.zeros(1, 3), torch.zeros(1, 3), turns, places, seen)
    found = rest_transitions(track, 30.0)
    assert found == pytest.approx([1 / 3, 2 / 3], abs=0.02)
    assert [state_of(t, found) for t in (0.0, 0.2, 0.5, 0.9)] == [0, 0, 1, 2]
    track = ObjectTrack(torch.zeros(1, 3), torch.zeros(1, 3), turns, 0 * places, seen)
    assert rest_transitions(track, 30.0) == []


def test_states_have_offsets_of_their_own(toy_body, toy_pose):
    model = bone(toy_body, [IDENTITY, IDENTITY], 0.5)
    with torch.no_grad():
        model.offset_translations[1] += 1
    pose = toy_pose(0)
    early, late = (model.pose(Moment(t, poses={"human": pose}))[1] for t in (0.49, 0.5))
    assert (late - early).norm().item() == pytest.approx(math.sqrt(3), abs=1e-4)


def perturbed(model) -> Entity:
    torch.manual_seed(4)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return Entity(thing(), model, kind="object")


def make(name: str, body, walk: BodyPose) -> Entity:
    track = held(body, walk, LEFT_WRIST, torch.tensor([1.0, 0, 0, 0]), torch.zeros(3))
    if name == "rigid-frames":
        return perturbed(RigidFrames(track=track))
    found = attachments_of({"human": body}, {"human": walk}, track, [0.5], "nearest")
    return perturbed(bone(body, found, 0.5, refine=True))


@pytest.mark.parametrize("name", ["object-bone", "rigid-frames"])
def test_gradients_reach_every_parameter(toy_body, toy_pose, name):
    walk = poses(toy_pose)
    entity = make(name, toy_body, walk)
    weights = torch.randn(20, 3), torch.randn(20, 4)
    total = sum(entity.regularizers().values())
    for f in range(FRAMES):
        out = entity(Moment(f / (FRAMES - 1), poses={"human": walk.frame(f)}))
        total = total + (weights[0] * out.means).sum() + (weights[1] * out.quats).sum()
    total.backward()
    for key, parameter in entity.deformation.named_parameters():
        assert (parameter.grad.flatten(1).norm(dim=1) > 0).all(), key
    assert not list(toy_body.parameters())


@pytest.mark.parametrize("name", ["object-bone", "rigid-frames"])
def test_it_stays_rigid(toy_body, toy_pose, name):
    walk = poses(toy_pose)
    entity = make(name, toy_body, walk)
    before = torch.cdist(entity.means, entity.means)
    for f in (0, 4, FRAMES - 1):
        out = entity(Moment(f / (FRAMES - 1), poses={"human": walk.frame(f)}))
        torch.testing.assert_close(torch.cdist(out.means, out.means), before, atol=1e-4, rtol=0)


def test_rigid_frames_start_on_the_track(toy_body, toy_pose):
    track = held(toy_body, poses(toy_pose), LEFT_WRIST, IDENTITY.quat, torch.ones(3))
    model, canonical = RigidFrames(track=track), thing()
    for f in range(FRAMES):
        out = model(canonical, Moment(f / (FRAMES - 1)))
        expected = canonical.means @ track.rotations[f].mT + track.translations[f]
        torch.testing.assert_close(out.means, expected, atol=1e-4, rtol=0)


def test_test_frames_follow_their_neighbours():
    corrections = FrameCorrections(5, trained=[0, 2, 4])
    with torch.no_grad():
        corrections.shifts[:] = torch.tensor([0.0, 99, 1, 99, 3])[:, None]
    found = [corrections(t / 4)[1][0].item() for t in range(5)]
    assert found == pytest.approx([0, 0.5, 1, 2, 3])
    quat = corrections(0.3)[0]
    torch.testing.assert_close(quat, torch.tensor([1.0, 0, 0, 0]))
    turned = axis_angle_to_matrices(torch.tensor([0.0, 0.4, 0.0]))
    with torch.no_grad():
        corrections.turns[2] = torch.tensor([0.0, 0.4, 0.0])
    torch.testing.assert_close(quats_to_matrices(corrections(0.5)[0]), turned)


def test_mistakes_are_told(toy_body):
    with pytest.raises(ValueError, match="2 states, got 1"):
        bone(toy_body, [IDENTITY], 0.5)
    with pytest.raises(ValueError, match="human/left, human/right"):
        bone(toy_body, [Attachment("human/middle", IDENTITY.quat, IDENTITY.place, 0.0)])
    model = bone(toy_body, [IDENTITY])
    with pytest.raises(ValueError, match='no body pose for "human"'):
        model(thing(), Moment(0.0))
    with pytest.raises(ValueError, match="a clip and a track"):
        ObjectBone.from_config(ObjectBoneConfig(), BuildContext())
    with pytest.raises(ValueError, match="needs a track"):
        RigidFrames.from_config(RigidFrames.Config(), BuildContext())
