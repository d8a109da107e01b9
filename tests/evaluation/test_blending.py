"""Poses of test frames between their neighbours' and their own: how far, training frames tell."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from hoigs.core.model.compose import compose
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import POSES_ESTIMATED, Clip, FrameStore
from hoigs.evaluation.evaluate import score
from hoigs.evaluation.options import ScoreOptions
from hoigs.evaluation.posing import blended, own_share, pose_between, posed_clip
from hoigs.plugins.bodies.anny import AnnyBody
from hoigs.plugins.deformation.skinned_body import SkinnedBody
from hoigs.plugins.readers.clip import ClipFolderReader
from hoigs.synthesis import SceneConfig, builtin_clip

TESTS = (2, 6)


class Drawn(FrameStore):
    """A model's own pictures of a clip."""

    def __init__(self, base: FrameStore, images: list[Tensor]) -> None:
        self.base, self.images = base, images

    def image(self, position: int) -> Tensor:
        return self.images[position]

    def mask(self, entity: str, position: int) -> Tensor:
        return self.base.mask(entity, position)

    def depth(self, position: int) -> Tensor | None:
        return self.base.depth(position)


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> tuple[SceneModel, Clip]:
    """A human before a wall who stands still, as the model draws it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOIGS_CACHE", str(tmp_path_factory.mktemp("cache")))
        clip = ClipFolderReader().read(builtin_clip(AnnyBody(), SceneConfig.tiny()))
    changes = ["entities=[scene, human]", "model.human.points=1500", "train.steps=1"]
    clip = replace(clip, held_out=None, provenance={POSES_ESTIMATED: True})
    model = compose(Spec.load("hoigs", overrides=changes), clip).eval()
    human = model.entity("human")
    human.sh.data[:, 0] = 1.5 * torch.sin(20 * human.means.detach())
    train = [p for p in range(len(clip)) if p not in TESTS]
    first = clip.moments[0].poses["human"]
    moments = [m.with_pose("human", first) for m in clip.moments]
    cameras = [clip.cameras[0]] * len(clip)
    split = {"train": train, "test": list(TESTS)}
    return model, replace(clip, moments=moments, cameras=cameras, split=split)


def filmed(model: SceneModel, clip: Clip, shift: Callable[[int], float]) -> Clip:
    """The clip with the person moved sideways by so many metres in each frame, and drawn there."""
    moments, images = [], []
    for p, moment in enumerate(clip.moments):
        pose = moment.poses["human"]
        moved = moment.with_pose(
            "human", pose.replace(transl=pose.transl + torch.tensor([shift(p), 0.0, 0.0]))
        )
        with torch.no_grad():
            color = model.render(moved, clip.cameras[p]).color
        moments.append(moved)
        images.append((255 * color.clamp(0, 1)).round().to(torch.uint8))
    return replace(clip, moments=moments, store=Drawn(clip.store, images))


def jolts(position: int) -> float:
    return 0.03 * (-1) ** (position // 2 + position)


def test_a_jolt_that_training_frames_bear_out_is_kept(still: tuple[SceneModel, Clip]) -> None:
    model, clip = still
    jolted = filmed(model, clip, jolts)
    assert own_share(model, jolted) == 1
    for p in TESTS:
        own, found = (m.poses["human"] for m in (jolted.moments[p], blended(model, jolted, p, 1.0)))
        torch.testing.assert_close(found.transl, own.transl)
        torch.testing.assert_close(found.rotations, own.rotations, atol=1e-5, rtol=0)
    (view,) = score(model, jolted, timing_frames=0).views
    assert (view.protocol.test_pose, view.protocol.own_share) == ("blended", 1.0)
    assert "100 % of the way" in view.protocol.footnotes()[0]


def test_noise_of_estimates_is_not_taken_for_motion(still: tuple[SceneModel, Clip]) -> None:
    """The same poses, of a person whose pictures show them standing still."""
    model, clip = still
    noisy = replace(filmed(model, clip, jolts), store=filmed(model, clip, lambda _: 0.0).store)
    refined(model, noisy)
    try:
        assert own_share(model, noisy) == 0
        with torch.no_grad():
            found = posed_clip(model, noisy, ScoreOptions(test_pose="blended"))
            for p in TESTS:
                shown = human(model).pose(found.moments[p]).transl
                torch.testing.assert_close(shown, clip.moments[p].poses["human"].transl)
    finally:
        human(model).refinement.transl.data.zero_()  # type: ignore[union-attr]


def refined(model: SceneModel, clip: Clip) -> None:
    """Corrections of training frames as a training would end with: back to where they stand."""
    for p in clip.split["train"]:
        human(model).refinement.transl.data[p, 0] = -jolts(p)  # type: ignore[union-attr]


def human(model: SceneModel) -> SkinnedBody:
    deformation = model.entity("human").deformation
    assert isinstance(deformation, SkinnedBody) and deformation.refinement is not None
    return deformation


def test_no_share_is_interpolation_and_the_test_frame_is_not_read(
    still: tuple[SceneModel, Clip],
) -> None:
    model, clip = still
    jolted = filmed(model, clip, jolts)
    p = TESTS[0]
    between = pose_between(*(jolted.moments[q].poses["human"] for q in (p - 1, p + 1)), 0.5)
    torch.testing.assert_close(blended(model, jolted, p, 0.0).poses["human"].transl, between.transl)
    images = [image.clone() for image in jolted.store.images]  # type: ignore[attr-defined]
    for q in TESTS:
        images[q] = 255 - images[q]
    other = replace(jolted, store=Drawn(jolted.store, images))
    assert own_share(model, other) == own_share(model, jolted)
    # of two training frames neither lies between others: nothing can be found out
    few = replace(jolted, split={"train": [0, 4], "test": [2]})
    assert own_share(model, few) == 0
    with pytest.raises(ValueError, match="no training frames"):
        posed_clip(model, replace(jolted, split={"test": [2]}), ScoreOptions(test_pose="blended"))
