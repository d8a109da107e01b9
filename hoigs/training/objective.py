"""One step of the joint objective: what is drawn, what it is compared with, and the sum."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from hoigs.core.camera import Camera
from hoigs.core.clip import Frame
from hoigs.core.density import DensityControl
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.core.rasterizer import RenderOutput, RenderRequest
from hoigs.core.scene import SceneModel, SceneState
from hoigs.core.train_spec import Graphs, LossSpec
from hoigs.evaluation.lpips import Lpips
from hoigs.training.camera_refinement import CameraRefinement
from hoigs.training.face import FaceTexture, face_loss, visible
from hoigs.training.losses import (
    depth_loss,
    image_loss,
    masked_loss,
    scene_only_loss,
    term_weights,
)
from hoigs.training.recorded import Deformed, RecordedScene
from hoigs.training.regions import Crop, crop_around, dilate, inside, union

RESTRAINED = ("residual_pose", "residual_means")  # penalties of what the interaction asks for
CAMERA_WEIGHT = 0.1  # of the penalty on camera corrections: holds what no image decides


@dataclass(frozen=True)
class ObjectiveResult:
    """What one step produced.

    Attributes:
        terms: unweighted losses by name. total: their weighted sum.
        state: the Gaussians that were drawn. composite: the full render.
        screen_offsets: receives the screen-space gradient of `state.joined()`, pixels.
        absolute_gradients: receives its absolute sums, where a density control asks for them.
    """

    terms: dict[str, Tensor]
    total: Float[Tensor, ""]
    state: SceneState
    composite: RenderOutput
    screen_offsets: Float[Tensor, "N 2"]
    weights: dict[str, float] = field(default_factory=dict)
    absolute_gradients: Float[Tensor, "N 2"] | None = None


class JointObjective:
    """L = w_h L_human + w_o L_object + w_s L_scene + w_d L_depth + regularisers.

    `depth_scale` brings the depth prior to the world's scale, where its own is another.
    L_human and L_object draw the entity alone over a random background, on the crop of its mask
    (L_human may compare the composite there instead or too, and adds L_face where asked: LossSpec);
    L_scene compares the composite (or the scene alone); L_depth compares the composite's depth.
    Neither is computed where it has no weight.
    """

    def __init__(
        self,
        model: SceneModel,
        spec: LossSpec,
        depth_kind: str,
        lpips: Lpips | None = None,
        density: Mapping[str, DensityControl] | None = None,
        faces: Mapping[str, FaceTexture] | None = None,
        cameras: CameraRefinement | None = None,
        depth_scale: float = 1.0,
        graphs: Graphs = "off",
    ) -> None:
        self.model, self.spec, self.depth_kind, self.lpips = model, spec, depth_kind, lpips
        self.density = dict(density or {})  # whose regularisers count too
        self.faces = dict(faces or {})
        self.cameras, self.depth_scale = cameras, depth_scale
        self.weights = term_weights(spec)
        restrained = any(spec.regularizers.get(key, 0.0) > 0 for key in RESTRAINED)
        self.recorded = RecordedScene(model, graphs, self.weight_of, restrained=restrained)

    def __call__(self, frame: Frame, camera: Camera, generator: torch.Generator) -> ObjectiveResult:
        device = camera.K.device
        deformed = self._deform(frame.moment)
        state = deformed.state
        offsets = torch.zeros(
            sum(len(g) for g in state.gaussians.values()), 2, device=device, requires_grad=True
        )
        absolutes = None
        if any(control.absolute_gradients for control in self.density.values()):
            absolutes = torch.zeros_like(offsets, requires_grad=True)
        composite = self.model.rasterizer.render(
            state.joined(),
            camera,
            RenderRequest(screen_offsets=offsets, absolute_gradients=absolutes),
        )
        there = frame.to(device)
        image = there.rgb
        terms: dict[str, Tensor] = {}
        terms.update(self._scene(there, image, camera, state, composite, offsets, absolutes))
        if there.depth is not None and self.weights["depth"] > 0:
            prior = there.depth * self.depth_scale
            if there.ignored is not None:
                prior = prior.masked_fill(there.ignored, 0.0)  # 0 = unknown
            depth = depth_loss(
                composite.depth, composite.alpha, prior, self.depth_kind, self.spec.depth_fit
            )
            if depth is not None:
                terms["depth"] = depth
        for kind in ("human", "object"):
            for name in self.model.names(kind):
                crop = None
                if name in frame.masks:
                    crop = crop_around(frame, camera, name, there)
                if crop is None:  # not seen in this frame: the terms are skipped, not zero
                    continue
                if kind == "object" or self.spec.human_image != "composite":
                    terms.update(self._alone(name, kind, crop, state, generator))
                if kind == "human":
                    terms.update(self._human(name, there, crop, camera, image, state, composite))
        weights = {name: self.weights[name.partition("/")[0]] for name in terms}
        for name in self.model.entities:
            own = None if deformed.penalties is None else deformed.penalties[name]
            self._regularize(name, state.gaussians[name], own, terms, weights)
        if self.cameras is not None:
            terms["regularizer/camera"] = self.cameras.penalty(frame.position)
            weights["regularizer/camera"] = self.spec.regularizers.get("camera", CAMERA_WEIGHT)
        for name, residual in state.residuals.items():
            self._restrain(name, residual, terms, weights)
        total = composite.color.new_zeros(())
        for name, term in terms.items():
            total = total + weights[name] * term
        if not total.requires_grad:  # a frame that tells nothing
            total = total + 0 * composite.color.sum()
        return ObjectiveResult(terms, total, state, composite, offsets, weights, absolutes)

    def _deform(self, moment: Moment) -> Deformed:
        """Apart, so that it can be timed apart."""
        return self.recorded(moment)

    def weight_of(self, name: str, penalty: str) -> float:
        """Weight of a penalty of an entity's deformation or density control."""
        weight = self.model.entity(name).deformation.regularizer_weights.get(penalty, 0.0)
        if name in self.density:
            weight = self.density[name].regularizer_weights.get(penalty, weight)
        return self.spec.regularizers.get(penalty, weight)

    def _scene(
        self,
        frame: Frame,
        image: Tensor,
        camera: Camera,
        state: SceneState,
        composite: RenderOutput,
        offsets: Tensor,
        absolutes: Tensor | None,
    ) -> dict[str, Tensor]:
        terms: dict[str, Tensor] = {}
        if self.weights["scene"] == 0:
            return terms
        blank = frame.ignored
        dssim = (self.spec.lambda_dssim, self.spec.ssim)
        if self.spec.scene_loss in ("full", "both"):
            drawn = composite.color
            if blank is not None:
                drawn = torch.where(blank[..., None], image, drawn)
            terms["scene"] = image_loss(drawn, image, *dssim)
        scenes, kind = self.model.names("scene"), self.spec.scene_loss
        modelled = {n: m for n, m in frame.masks.items() if n in self.model.entities}
        left_out = frame.masks if kind == "background" else modelled
        told = not frame.unknown & {*left_out, *self.model.entities}  # what to leave out is known
        if kind in ("masked", "both", "background") and scenes and told:
            alone = self._scene_alone(camera, state, composite, offsets, absolutes)
            dynamic = union(left_out.values())
            if dynamic is not None:
                dynamic = dilate(dynamic, self.spec.dilate)
            hidden = union(m for m in (dynamic, blank) if m is not None)
            terms["scene/masked"] = scene_only_loss(alone.color, image, hidden, *dssim)
        return terms

    def _scene_alone(
        self,
        camera: Camera,
        state: SceneState,
        composite: RenderOutput,
        offsets: Tensor,
        absolutes: Tensor | None,
    ) -> RenderOutput:
        """Without people and things. Where the composite is not compared, density control looks
        here."""
        scenes, request = self.model.names("scene"), RenderRequest()
        if self.spec.scene_loss != "both":
            if len(scenes) == len(self.model.entities):
                return composite
            request = RenderRequest(
                screen_offsets=_of(scenes, state, offsets),
                absolute_gradients=None if absolutes is None else _of(scenes, state, absolutes),
            )
        return self.model.rasterizer.render(state.joined(scenes), camera, request)

    def _alone(
        self, name: str, kind: str, crop: Crop, state: SceneState, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """An entity over a colour in place of everything else."""
        background = torch.zeros(3)
        if self.spec.background == "random":
            background = torch.rand(3, generator=generator)
        background = background.to(crop.image)
        output = self.model.rasterizer.render(
            state.gaussians[name], crop.camera, RenderRequest(background=background)
        )
        dssim = (self.spec.lambda_dssim, self.spec.ssim)
        terms = {f"{kind}/{name}": masked_loss(output.color, crop, background, *dssim)}
        if kind == "human" and self.lpips is not None and self.spec.lpips > 0:
            target = torch.where(crop.mask[..., None], crop.image, background)
            render = torch.where(crop.ignore[..., None], target, output.color)
            terms[f"{kind}/{name}/lpips"] = self.spec.lpips * self.lpips(render, target)
        return terms

    def _human(
        self,
        name: str,
        frame: Frame,
        crop: Crop,
        camera: Camera,
        image: Tensor,
        state: SceneState,
        composite: RenderOutput,
    ) -> dict[str, Tensor]:
        """What L_human has beyond the human drawn alone."""
        terms = {}
        if self.spec.human_image != "alone":
            render = inside(composite.color, crop, camera)
            if frame.ignored is not None:
                hidden = inside(frame.ignored[..., None], crop, camera)
                render = torch.where(hidden, crop.image, render)
            dssim = (self.spec.lambda_dssim, self.spec.ssim)
            terms[f"human/{name}/composite"] = image_loss(render, crop.image, *dssim)
            if self.lpips is not None and self.spec.lpips > 0:
                perceived = self.spec.lpips * self.lpips(render, crop.image)
                terms[f"human/{name}/composite/lpips"] = perceived
        if name in self.faces and self.spec.face > 0:
            mask = visible(frame, name)
            entity, posed = self.model.entity(name), state.gaussians[name]
            face = face_loss(self.faces[name], entity, posed, camera, image, mask)
            if face is not None:
                terms[f"human/{name}/face"] = self.spec.face * face
        return terms

    def _restrain(
        self, name: str, residual: Residual, terms: dict[str, Tensor], weights: dict[str, float]
    ) -> None:
        """Penalties of what the interaction asked for: mean squared, radians or metres."""
        for key, value in zip(RESTRAINED, (residual.pose, residual.means), strict=True):
            weight = self.spec.regularizers.get(key, 0.0)
            if weight > 0 and value is not None:
                terms[f"regularizer/{name}/{key}"] = value.square().sum(-1).mean()
                weights[f"regularizer/{name}/{key}"] = weight

    def _regularize(
        self,
        name: str,
        current: Gaussians,
        own: Mapping[str, Tensor] | None,
        terms: dict[str, Tensor],
        weights: dict[str, float],
    ) -> None:
        """`own`: the penalties of the deformation that count, where they are known already."""
        penalties = dict(self.model.entity(name).regularizers() if own is None else own)
        if name in self.density:
            penalties |= self.density[name].regularizers(current)
        for key, value in penalties.items():
            weight = self.weight_of(name, key)
            if weight > 0:
                terms[f"regularizer/{name}/{key}"] = value
                weights[f"regularizer/{name}/{key}"] = weight


def _of(names: Sequence[str], state: SceneState, values: Shaped[Tensor, "N C"]) -> Tensor:
    """Rows of some entities, of what has one for each Gaussian of `state.joined()`."""
    parts = [values[rows] for name, rows in state.slices().items() if name in names]
    return parts[0] if len(parts) == 1 else torch.cat(parts)
