"""JointObjective: the loss of one training frame and its terms (HOIGS Eq. 15)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from hoigs.core.device import constant
from hoigs.core.fast.streams import apart
from hoigs.core.interfaces.density import DensityControl
from hoigs.core.interfaces.rasterizer import RenderOutput, RenderRequest
from hoigs.core.model.camera_refinement import CameraRefinement
from hoigs.core.model.objective import TrainingMoment, Weighted
from hoigs.core.model.scene import SceneModel, SceneState
from hoigs.core.spec.train_schema import Graphs, LossSpec
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Frame
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual
from hoigs.metrics.lpips import Lpips
from hoigs.metrics.regions import dilate
from hoigs.training.face import FaceTexture, face_loss, visible
from hoigs.training.graphs import Deformed, GraphedScene
from hoigs.training.losses import Comparison, Crop, depth_loss, image_losses, term_weights, union
from hoigs.training.views import TrainingView

RESIDUAL_PENALTIES = ("residual_pose", "residual_means")  # on corrections by the interaction
Terms = dict[str, tuple[Tensor, float]]  # losses by name, unweighted, and their weights
Part = tuple[RenderOutput | None, Terms]
WHOLE = ""  # what is of no entity: no name is empty
CAMERA_WEIGHT = 0.1  # of camera corrections; moving all cameras and the scene changes no image


@dataclass(frozen=True)
class ObjectiveResult:
    """The loss of one frame, and what density control needs after its backward pass.

    Attributes:
        terms: unweighted losses by name. weights: of each. total: their weighted sum.
        state: the Gaussians that were drawn. composite: the render of all entities.
        screen_offsets: its gradient is the screen-space one of `state.joined()`, per pixel.
        absolute_gradients: its gradient is the sum of absolute values over pixels; None if no
            density control needs that.
        finite: whether all gradients are, on the device; None where nobody has looked yet.
    """

    terms: dict[str, Tensor]
    total: Float[Tensor, ""]
    state: SceneState
    composite: RenderOutput
    screen_offsets: Float[Tensor, "N 2"]
    weights: dict[str, float] = field(default_factory=dict)
    absolute_gradients: Float[Tensor, "N 2"] | None = None
    finite: Bool[Tensor, ""] | None = None


@dataclass(frozen=True)
class Extras:
    """What the loss has terms of, beside the images.

    Attributes:
        lpips: needed if `LossSpec.lpips` > 0.
        density: of each entity; their regularizers are added.
        faces: textures for L_face, by human. cameras: corrections, which are penalised.
        depth_scale: factor from the units of the depth prior to metres in the world.
        objectives: that plugins bring.
    """

    lpips: Lpips | None = None
    density: Mapping[str, DensityControl] | None = None
    faces: Mapping[str, FaceTexture] | None = None
    cameras: CameraRefinement | None = None
    depth_scale: float = 1.0
    objectives: Sequence[Weighted] = ()


class JointObjective:
    """L = w_h L_human + w_o L_object + w_s L_scene + w_d L_depth + regularizers (HOIGS Eq. 15).

    L_human (Eq. 16) and L_object (Eq. 17) render the entity alone over a random background, in the
    crop of its mask; L_human may compare the composite there, instead or too, and adds LPIPS and
    L_face as LossSpec declares. L_scene (Eq. 18) compares the composite, or the scene alone.
    L_depth compares the composite's depth with the prior. A term without weight is not computed.

    Args:
        spec: settings of the losses. depth_kind: `Clip.depth_kind` of the prior.
        extras: what further terms are made from. graphs: `TrainSpec.graphs`.

    Attributes:
        settled: people, objects and the interaction get no gradients, and have no terms of their
            own.
    """

    settled = False

    def __init__(
        self,
        model: SceneModel,
        spec: LossSpec,
        depth_kind: str,
        extras: Extras | None = None,
        graphs: Graphs = "off",
    ) -> None:
        extras = extras or Extras()
        self.model, self.spec, self.depth_kind, self.lpips = model, spec, depth_kind, extras.lpips
        self.density, self.faces = dict(extras.density or {}), dict(extras.faces or {})
        self.cameras, self.depth_scale = extras.cameras, extras.depth_scale
        self.objectives = tuple(extras.objectives)
        self.weights = term_weights(spec)
        restrained = any(spec.regularizers.get(key, 0.0) > 0 for key in RESIDUAL_PENALTIES)
        self.graphed_scene = GraphedScene(model, graphs, self.weight_of, restrained=restrained)

    def __call__(
        self, view: TrainingView | Frame, camera: Camera, generator: torch.Generator
    ) -> ObjectiveResult:
        """The loss of a view on the model's device, or of a frame on the CPU.

        Args:
            camera: the frame's, refined where cameras are, on the model's device.
            generator: of random backgrounds, CPU.
        """
        if isinstance(view, Frame):
            view = TrainingView.of(view, camera.K.device)
        backgrounds = self.backgrounds(view, generator)
        return self.losses(view, camera, self._deform(view.frame.moment), backgrounds, generator)

    def backgrounds(
        self, view: TrainingView, generator: torch.Generator
    ) -> dict[str, Float[Tensor, "3"]]:
        """The colour behind each person and object that is drawn alone, on the CPU."""
        kinds = ("object",) if self.spec.human_image == "composite" else ("human", "object")
        drawn = [n for k in kinds for n in self.model.names(k) if n in view.crops]
        if self.settled:
            return {}
        if self.spec.background == "black":
            return {name: torch.zeros(3) for name in drawn}
        return {name: torch.rand(3, generator=generator) for name in drawn}

    def losses(
        self,
        view: TrainingView,
        camera: Camera,
        deformed: Deformed,
        backgrounds: Mapping[str, Float[Tensor, "3"]],
        generator: torch.Generator,
    ) -> ObjectiveResult:
        """The loss of a view, given the scene at its moment.

        Args:
            view, camera: on the model's device. backgrounds: from the method of that name, on any
                device. generator: of what plugins draw.
        """
        frame, device = view.frame, camera.K.device
        state = self._settled(deformed.state) if self.settled else deformed.state
        if self.model.decoder is not None and state.moment is None:  # from a CUDA graph
            state = replace(state, moment=frame.moment.to(device))
        offsets = torch.zeros(
            sum(len(g) for g in state.gaussians.values()), 2, device=device, requires_grad=True
        )
        absolutes = None
        if any(control.absolute_gradients for control in self.density.values()):
            absolutes = torch.zeros_like(offsets, requires_grad=True)
        further = () if self.settled else self.objectives
        at = TrainingMoment(self.model, frame, camera, state, generator)
        channels = [objective.channels(at) for objective in further]
        drawn = [c for c in channels if c is not None]
        request = RenderRequest(
            features=torch.cat(drawn, 1) if drawn else None,
            screen_offsets=offsets,
            absolute_gradients=absolutes,
        )
        trained = self.model.names("scene" if self.settled else None)
        own: dict[str, Callable[[], Part]] = {
            n: partial(self._of_entity, n, view, camera, state, deformed.penalties, backgrounds)
            for n in trained
        }
        own[WHOLE] = partial(self._of_composite, view, camera, state, request)
        found = apart(own, (state, camera, view, backgrounds, request))
        composite, terms = found.pop(WHOLE)
        assert composite is not None
        for _, own_terms in found.values():
            terms |= own_terms
        for name in () if self.settled else self.model.names("human"):
            crop = view.crops.get(name)
            if crop is not None:
                more = self._human(name, frame, crop, camera, state, composite)
                terms |= self._weighted(more)
        start = 0
        for objective, channel in zip(further, channels, strict=True):
            shown = None
            if channel is not None and composite.features is not None:
                end = start + channel.shape[1]
                shown, start = composite.features[..., start:end], end
            more = objective.terms(at, composite, shown)
            terms |= {name: (term, objective.weight) for name, term in more.items()}
        if self.cameras is not None:
            weight = self.spec.regularizers.get("camera", CAMERA_WEIGHT)
            terms["regularizer/camera"] = (self.cameras.penalty(frame.position), weight)
        for name, residual in () if self.settled else state.residuals.items():
            terms |= self._of_residual(name, residual)
        losses = {name: term for name, (term, _) in terms.items()}
        weights = {name: weight for name, (_, weight) in terms.items()}
        total = composite.color.new_zeros(())
        if terms:
            factors = constant(tuple(weights.values()), total)
            total = torch.stack([loss.reshape(()) for loss in losses.values()]) @ factors
        if not total.requires_grad:  # no term applies to this frame
            total = total + 0 * composite.color.sum()
        return ObjectiveResult(losses, total, state, composite, offsets, weights, absolutes)

    def _of_composite(
        self, view: TrainingView, camera: Camera, state: SceneState, request: RenderRequest
    ) -> Part:
        """The render of all entities, and its terms."""
        frame = view.frame
        composite = self.model.draw(state.joined(), camera, request, state.moment)
        terms = self._composite(view, composite)
        terms |= self._scene_alone(frame, camera, state, composite, request)
        if frame.depth is not None and self.weights["depth"] > 0:
            prior = frame.depth * self.depth_scale
            if frame.ignored is not None:
                prior = prior.masked_fill(frame.ignored, 0.0)  # 0 = unknown
            depth = depth_loss(
                composite.depth, composite.alpha, prior, self.depth_kind, self.spec.depth_fit
            )
            if depth is not None:
                terms["depth"] = depth
        return composite, self._weighted(terms)

    def _of_entity(
        self,
        name: str,
        view: TrainingView,
        camera: Camera,
        state: SceneState,
        penalties: Mapping[str, Mapping[str, Tensor]] | None,
        backgrounds: Mapping[str, Float[Tensor, "3"]],
    ) -> Part:
        """The terms of an entity alone: of its render, and penalties."""
        terms: Terms = {}
        kind, crop = self.model.entity(name).kind, view.crops.get(name)
        if crop is not None and name in backgrounds:
            alone = self._alone(name, kind, crop, camera, state, backgrounds[name])
            terms = self._weighted(alone)
        own = None if penalties is None else penalties[name]
        return None, terms | self._penalties(name, state.gaussians[name], own)

    def _weighted(self, terms: Mapping[str, Tensor]) -> Terms:
        """Terms with the weight of what they are of, which their names begin with."""
        return {name: (term, self.weights[name.partition("/")[0]]) for name, term in terms.items()}

    def _settled(self, state: SceneState) -> SceneState:
        """Without gradients but of scenes."""
        scenes = self.model.names("scene")
        kept = {n: g if n in scenes else g.detach() for n, g in state.gaussians.items()}
        return replace(state, gaussians=kept, whole=None)

    def _deform(self, moment: Moment) -> Deformed:
        """A method of its own, so that benchmarks can time it."""
        return self.graphed_scene(moment)

    def weight_of(self, name: str, penalty: str) -> float:
        """Weight of a penalty of an entity's deformation or density control."""
        weight = self.model.entity(name).deformation.regularizer_weights.get(penalty, 0.0)
        if name in self.density:
            weight = self.density[name].regularizer_weights.get(penalty, weight)
        return self.spec.regularizers.get(penalty, weight)

    def _composite(self, view: TrainingView, composite: RenderOutput) -> dict[str, Tensor]:
        """The image losses of the composite: of all of it (L_scene), and of each human's crop."""
        frame, found = view.frame, {}
        if self.weights["scene"] > 0 and self.spec.scene_loss in ("full", "both"):
            found["scene"] = Comparison(frame.image, ignored=frame.ignored)
        if self.spec.human_image != "alone":
            for name in self.model.names("human"):
                crop = view.crops.get(name)
                if crop is not None:
                    hidden = None if frame.ignored is None else crop.cut(frame.ignored)
                    found[f"human/{name}/composite"] = Comparison(
                        crop.pixels, ignored=hidden, top=crop.top, left=crop.left, box=crop.box
                    )
        if not found:
            return {}
        losses = self._image_losses(composite.color, list(found.values()))
        return dict(zip(found, losses, strict=True))

    def _image_losses(self, render: Tensor, comparisons: list[Comparison]) -> list[Tensor]:
        return image_losses(render, comparisons, self.spec.lambda_dssim, self.spec.ssim)

    def _scene_alone(
        self,
        frame: Frame,
        camera: Camera,
        state: SceneState,
        composite: RenderOutput,
        request: RenderRequest,
    ) -> dict[str, Tensor]:
        """L_scene of the scene drawn alone, without the pixels of people and objects."""
        scenes, kind = self.model.names("scene"), self.spec.scene_loss
        if self.weights["scene"] == 0 or kind == "full" or not scenes:
            return {}
        modelled = {n: m for n, m in frame.masks.items() if n in self.model.entities}
        left_out = frame.masks if kind == "background" else modelled
        if frame.unknown & {*left_out, *self.model.entities}:  # a mask is missing
            return {}
        alone = self._draw_scene(camera, state, composite, request)
        dynamic = union(left_out.values())
        if dynamic is not None:
            dynamic = dilate(dynamic, self.spec.dilate)
        hidden = union(m for m in (dynamic, frame.ignored) if m is not None)
        compared = Comparison(frame.image, ignored=hidden)
        return {"scene/masked": self._image_losses(alone.color, [compared])[0]}

    def _draw_scene(
        self,
        camera: Camera,
        state: SceneState,
        composite: RenderOutput,
        request: RenderRequest,
    ) -> RenderOutput:
        """The render of the scene entities alone.

        Where the composite is not compared, this render has the gradients for density control.

        Args:
            request: that of the composite.
        """
        scenes, own = self.model.names("scene"), RenderRequest()
        if self.spec.scene_loss != "both":
            if len(scenes) == len(self.model.entities):
                return composite
            own = RenderRequest(
                screen_offsets=_of(scenes, state, request.screen_offsets),
                absolute_gradients=_of(scenes, state, request.absolute_gradients),
            )
        return self.model.draw(state.joined(scenes), camera, own, state.moment)

    def _alone(
        self,
        name: str,
        kind: str,
        crop: Crop,
        camera: Camera,
        state: SceneState,
        background: Float[Tensor, "3"],
    ) -> dict[str, Tensor]:
        """The entity rendered alone over one colour: L_object (Eq. 17), or L_img of Eq. 16.

        L1 is divided by the area of the mask.
        """
        # without waiting for what the device is doing: CUDA has read the colour at the return
        background = background.to(camera.K, non_blocking=True)
        output = self.model.draw(
            state.gaussians[name],
            crop.seen_from(camera),
            RenderRequest(background=background),
            state.moment,
        )
        compared = Comparison(
            crop.pixels, crop.mask, crop.ignore, background, area=crop.area, box=crop.box
        )  # fmt: skip
        terms = {f"{kind}/{name}": self._image_losses(output.color, [compared])[0]}
        if kind == "human" and self.lpips is not None and self.spec.lpips > 0:
            perceived = self.lpips(compared.render_of(output.color), compared.target)
            terms[f"{kind}/{name}/lpips"] = self.spec.lpips * perceived
        return terms

    def _human(
        self,
        name: str,
        frame: Frame,
        crop: Crop,
        camera: Camera,
        state: SceneState,
        composite: RenderOutput,
    ) -> dict[str, Tensor]:
        """LPIPS of the composite and L_face, further terms of L_human (HOIGS Eq. 16)."""
        terms = {}
        if self.spec.human_image != "alone" and self.lpips is not None and self.spec.lpips > 0:
            render = crop.cut(composite.color)
            if frame.ignored is not None:
                render = torch.where(crop.cut(frame.ignored)[..., None], crop.image, render)
            perceived = self.spec.lpips * self.lpips(render, crop.image)
            terms[f"human/{name}/composite/lpips"] = perceived
        if name in self.faces and self.spec.face > 0:
            mask = visible(frame, name)
            entity, posed = self.model.entity(name), state.gaussians[name]
            face = face_loss(self.faces[name], entity, posed, camera, frame.rgb, mask)
            if face is not None:
                terms[f"human/{name}/face"] = self.spec.face * face
        return terms

    def _of_residual(self, name: str, residual: Residual) -> Terms:
        """Mean squared correction by the interaction, radians^2 and metres^2."""
        found = {}
        for key, value in zip(RESIDUAL_PENALTIES, (residual.pose, residual.means), strict=True):
            weight = self.spec.regularizers.get(key, 0.0)
            if weight > 0 and value is not None:
                found[f"regularizer/{name}/{key}"] = (value.square().sum(-1).mean(), weight)
        return found

    def _penalties(self, name: str, current: Gaussians, own: Mapping[str, Tensor] | None) -> Terms:
        """Penalties of the deformation and of density control that have a weight.

        Args:
            own: those of the deformation, if they have been computed already.
        """
        penalties = dict(self.model.entity(name).regularizers() if own is None else own)
        if name in self.density:
            penalties |= self.density[name].regularizers(current)
        return {
            f"regularizer/{name}/{key}": (value, weight)
            for key, value in penalties.items()
            if (weight := self.weight_of(name, key)) > 0
        }


def _of(
    names: Sequence[str], state: SceneState, values: Shaped[Tensor, "N C"] | None
) -> Tensor | None:
    """The rows of some entities, of values with one row for each Gaussian of `state.joined()`."""
    if values is None:
        return None
    parts = [values[rows] for name, rows in state.slices().items() if name in names]
    return parts[0] if len(parts) == 1 else torch.cat(parts)
