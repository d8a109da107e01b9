"""Pixels that show no scene teach nothing and are not scored."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import torch
from small_clip import small_clip

from hoigs.core.interfaces.rasterizer import RenderOutput
from hoigs.core.model.entity import Entity
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.train_schema import LossSpec, TrainSpec
from hoigs.core.values.clip import Clip, Frame, FrameStore
from hoigs.core.values.gaussians import Gaussians
from hoigs.evaluation.evaluate import score
from hoigs.plugins.deformation.static import Static
from hoigs.rasterizers.torch_tiles import TorchRasterizer
from hoigs.training.objective import JointObjective
from hoigs.training.trainer import Trainer, preview_scores


class Counting(TorchRasterizer):
    """How often it was asked."""

    asked = 0

    def render(self, *arguments: Any, **named: Any) -> RenderOutput:
        self.asked += 1
        return super().render(*arguments, **named)


def model(clip: Clip, *, beside: bool = False) -> SceneModel:
    """A scene; `beside`: and a thing far behind all cameras."""
    points = Gaussians.from_points(clip.points, clip.point_colors, scales=0.12, opacity=0.6)
    entities = {"scene": Entity(points, Static())}
    if beside:
        behind = points.replace(means=points.means - 1000)
        entities["object"] = Entity(behind, Static(), kind="object")
    return SceneModel(entities, rasterizer=Counting())


def stores(clip: Clip, ignored: torch.Tensor) -> tuple[FrameStore, FrameStore, FrameStore]:
    """The clip's store, one that ignores these pixels and paints them black, and one that only
    ignores them."""
    base = clip.store

    class Known(type(base)):  # type: ignore[misc]
        def ignored(self, position: int) -> torch.Tensor:
            del position
            return ignored

    class Painted(Known):
        def image(self, position: int) -> torch.Tensor:
            return base.image(position).masked_fill(ignored[..., None], 0)

    return base, Painted(base.images), Known(base.images)


def gradient(scene: SceneModel, frame: Frame, loss: str) -> torch.Tensor:
    scene.zero_grad()
    objective = JointObjective(scene, LossSpec(scene_loss=loss, ssim="torch"), "none")  # type: ignore[arg-type]
    objective(frame, frame.camera, torch.Generator()).total.backward()
    return torch.cat([p.grad.flatten() for p in scene.parameters() if p.grad is not None])


def test_what_is_painted_there_changes_no_gradient() -> None:
    clip = small_clip()
    scene, frame = model(clip), clip[2]
    ignored = torch.zeros(frame.image.shape[:2], dtype=torch.bool)
    ignored[:24, 10:50] = True
    painted = frame.image.clone()
    painted[ignored] = 0
    for loss in ("full", "masked", "both"):
        clean = gradient(scene, replace(frame, ignored=ignored), loss)
        # SSIM windows beside the patch see its pixels in both images: fill them alike
        dirty = gradient(scene, replace(frame, image=painted, ignored=ignored), loss)
        blind = gradient(scene, replace(frame, image=painted), loss)
        near = torch.nn.functional.cosine_similarity
        assert near(clean, dirty, dim=0) > 0.97
        assert near(clean, dirty, dim=0) > near(clean, blind, dim=0) + 0.05


def test_a_scene_drawn_alone_tells_density_control_where_to_grow() -> None:
    """`screen_offsets` take part in the picture that is compared, whichever that is."""
    clip = small_clip()
    frame, found = clip[2], {}
    for loss, others in product(("full", "masked", "background"), (False, True)):
        scene = model(clip, beside=others)
        spec = LossSpec(scene_loss=loss, ssim="torch")  # type: ignore[arg-type]
        result = JointObjective(scene, spec, "none")(frame, frame.camera, torch.Generator())
        result.total.backward()
        gradient = result.screen_offsets.grad
        assert gradient is not None
        found[loss, others] = gradient[: len(scene.entity("scene"))]
        # a scene that is all there is was drawn already
        assert scene.rasterizer.asked == (2 if others and loss != "full" else 1)  # type: ignore[union-attr]
    assert found["full", False].norm() > 0
    for gradient in found.values():  # nothing is masked here: the same picture
        torch.testing.assert_close(gradient, found["full", False], rtol=1e-3, atol=1e-7)


def test_what_has_no_weight_is_not_computed() -> None:
    clip = small_clip()
    scene, frame = model(clip), clip[2]
    for loss in ("full", "masked", "both"):
        spec = LossSpec(scene_loss=loss, ssim="torch", scene=0.0)  # type: ignore[arg-type]
        result = JointObjective(scene, spec, "none")(frame, frame.camera, torch.Generator())
        result.total.backward()  # of a frame that tells nothing, too
        assert not result.terms and result.total.item() == 0
    assert scene.rasterizer.asked == 3  # type: ignore[union-attr]


def test_a_background_learns_nothing_from_people_that_the_model_has_not() -> None:
    clip = small_clip()
    scene, frame = model(clip), clip[2]
    person = torch.zeros(frame.image.shape[:2], dtype=torch.bool)
    person[:, :40] = True
    frame = replace(frame, masks={"human": person})
    painted = frame.image.clone()
    painted[person] = 255 - painted[person]
    for loss, learns in (("background", False), ("masked", True)):
        before = gradient(scene, frame, loss)
        after = gradient(scene, replace(frame, image=painted), loss)
        assert bool((before - after).norm() > 0.05 * before.norm()) == learns
    unknown = replace(frame, unknown=frozenset({"human"}))
    objective = JointObjective(scene, LossSpec(scene_loss="background", ssim="torch"), "none")
    assert not objective(unknown, frame.camera, torch.Generator()).terms


def test_scores_leave_them_out_and_say_so() -> None:
    clip = small_clip()
    scene = model(clip)
    clip = replace(clip, split={"train": [0, 1], "test": [2, 3]})
    ignored = torch.zeros(64, 64, dtype=torch.bool)
    ignored[:24, 10:50] = True
    base, *both = stores(clip, ignored)

    def scores_of(store: object) -> tuple[float, float]:
        judged = score(scene, replace(clip, store=store), timing_frames=0)  # type: ignore[arg-type]
        view = judged.views[0]
        return view.mean("full", "psnr"), view.protocol.ignored  # type: ignore[return-value]

    painted, known = map(scores_of, both)
    assert painted == known
    assert abs(painted[1] - 24 * 40 / 64**2) < 1e-6
    assert scores_of(base)[1] == 0


def test_previews_leave_them_out_too() -> None:
    clip = small_clip()
    ignored = torch.zeros(64, 64, dtype=torch.bool)
    ignored[:24] = True
    base, *both = stores(clip, ignored)

    def preview(store: object) -> dict[str, float]:
        trainer = Trainer(model(clip), replace(clip, store=store), TrainSpec())  # type: ignore[arg-type]
        return preview_scores(trainer.clip, trainer._draw)

    painted, known = map(preview, both)
    assert painted and painted == known
    assert painted != preview(base)
