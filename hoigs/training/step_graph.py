"""A training step's loss and all its gradients by one CUDA graph."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.func import functional_call

from hoigs.core.errors import PluginError
from hoigs.core.fast.graphs import capturing, why_not_cuda_graph_safe
from hoigs.core.fast.streams import side_by_side
from hoigs.core.interfaces.density import DensityControl
from hoigs.core.model.scene import SceneModel, SceneState
from hoigs.core.spec.train_schema import Graphs
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Frame
from hoigs.training.graphs import (
    Deformed,
    GraphKey,
    components_of,
    first_difference,
    in_one_tensor,
    leaves_of,
    mode_of,
    on_stream,
    root_cause,
)
from hoigs.training.losses import Crop
from hoigs.training.objective import JointObjective, ObjectiveResult
from hoigs.training.views import TrainingView

T = TypeVar("T", bound=Any)
BOX = 5  # top, left, height, width, area


class StepGradients:
    """The loss of a view and its gradients in `.grad`, by one CUDA graph where possible.

    The graph reads a view from memory of its own (`ViewMemory`), into which each step copies its
    frame's; people and objects are drawn alone in the whole frame, and compared within the box of
    their mask, so that one graph serves all frames. It is captured anew where what it reads has
    moved (`GraphKey`), as by density control, and where the rasterizer would take more memory. A
    step whose key no longer holds runs eagerly, and so does every step of an objective with a term
    that no graph can hold: of that the scene's part is captured alone (`GraphedScene`).

    The first graph of each structure is compared with eager execution, in losses and gradients. If
    they differ, or if capturing fails, later steps run without it, and a warning gives the reason.

    Args:
        objective: its model is on its device. graphs: `TrainSpec.graphs`.
        kernel_by_kernel: do the same on any device without capturing graphs: for tests.

    Attributes:
        mode: how steps run while the key holds. reason: why. captures: how often graphs were.
    """

    def __init__(
        self, objective: JointObjective, graphs: Graphs, *, kernel_by_kernel: bool = False
    ) -> None:
        self._objective, self._model = objective, objective.model
        self._step = _Step(objective)
        self._key: _StepKey | None = None
        self._captured: _CapturedStep | None = None
        self._memory: ViewMemory | None = None
        self._compared: set[object] = set()
        self._stream: torch.cuda.Stream | None = None
        self._least = _Needs()
        self.captures = 0
        unsafe, device = why_not_whole(objective), self._model.device
        self.mode, self.reason = mode_of(graphs, unsafe, device, kernel_by_kernel)

    def __call__(
        self, view: TrainingView, camera: Camera, generator: torch.Generator
    ) -> ObjectiveResult:
        """The loss, with gradients in `.grad` of parameters and of the result's offsets.

        Those of a graph are valid until the next call.

        Args:
            view: on the model's device. camera: its own, refined where cameras are.
            generator: as for `JointObjective`.
        """
        objective = self._objective
        if self.mode == "plain":
            result = objective(view, camera, generator)
            result.total.backward()
            return result
        backgrounds = objective.backgrounds(view, generator)
        self._least = self._least.with_view(view)
        if self._key is None or not self._key.holds(objective, view, self._least):
            self._release()
            self._key = _StepKey(objective, view, self._least)
            return self._eager(view, camera, backgrounds)
        memory = self._model.rasterizer.graph_memory(self._model.device)
        if self._captured is not None and self._captured.drawn != memory:
            self._release()  # and captured at once: an eager step would round in another way
        if self._captured is None:
            self._capture(view, backgrounds)
            if self._captured is None:
                return self._eager(view, camera, backgrounds)
        assert self._memory is not None
        self._memory.fill(view, backgrounds)
        return self._captured.run(view)

    def used(self) -> dict[str, Any]:
        """What is captured, for the run's record: "step", "scene" or "plain" (nothing), and why."""
        scene = self._objective.graphed_scene
        if self.mode != "plain":
            return {"mode": "step", "captures": self.captures, "why": self.reason}
        if scene.mode == "plain":
            return {"mode": "plain", "captures": scene.captures, "why": scene.reason}
        return {"mode": "scene", "captures": scene.captures, "why": self.reason}

    def sentence(self) -> str | None:
        """The same for a reader; None where no graphs are wanted, or there is no GPU."""
        used = self.used()
        scene = self._objective.graphed_scene
        if self._model.device.type != "cuda" or (
            used["mode"] == "plain" and not scene.why_slower()
        ):
            return None
        return {
            "step": "CUDA graphs: of whole training steps",
            "scene": f"CUDA graphs: of the scene's part of a step alone, since {used['why']}",
            "plain": f"no CUDA graphs, slower than it could be: {used['why']}",
        }[used["mode"]]

    def _release(self) -> None:
        """Free the graph, once the device has finished with it."""
        if self._captured is not None and self._stream is not None:
            torch.cuda.synchronize(self._stream.device)
        self._captured = None

    def _eager(
        self, view: TrainingView, camera: Camera, backgrounds: Mapping[str, Tensor]
    ) -> ObjectiveResult:
        deformed = Deformed(self._model(view.frame.moment.to(self._model.device)))
        result = self._objective.losses(view, camera, deformed, backgrounds, _NO_CHOICES)
        result.total.backward()
        return result

    def _capture(self, view: TrainingView, backgrounds: Mapping[str, Tensor]) -> None:
        """Capture a graph, and compare that of a new structure; on failure use none from now on."""
        assert self._key is not None
        try:
            if self.mode == "graph" and self._stream is None:
                self._stream = torch.cuda.Stream(self._model.device)
            if self._memory is None or not self._memory.fits(self._key, self._least):
                self._memory = ViewMemory(view, self._key, self._least, self._model)
            self._memory.fill(view, backgrounds)
            drawn = self._model.rasterizer.graph_memory(self._model.device)
            made = _CapturedStep(self._step, self._memory, self._stream)
            failure = None
            if self._key.structure not in self._compared:
                failure = self._difference(made, view)
        except (RuntimeError, TypeError, ValueError, NotImplementedError, PluginError) as error:
            # what CUDA or a component raises when it is captured; reported below
            failure = root_cause(error)
        if failure is None:
            self._captured = made
            self._compared.add(self._key.structure)
            made.drawn = drawn
            self.captures += 1
            return
        self.mode, self.reason = "plain", failure
        warnings.warn(f"training continues without graphs of whole steps: {failure}", stacklevel=4)

    def _difference(self, made: _CapturedStep, view: TrainingView) -> str | None:
        """How losses or gradients differ from eager execution; None where they agree."""
        found, expected = (step.values(view) for step in (made, made.uncaptured()))
        if set(found) != set(expected):
            odd = sorted(set(found) ^ set(expected))
            return f"{odd[0]} is there either by the graph or by eager execution, not both"
        return first_difference(
            {f"{name} by the graph": (found[name], value) for name, value in expected.items()}
        )


_NO_CHOICES = torch.Generator()  # a step without plugins' terms draws no random numbers


def why_not_whole(objective: JointObjective) -> str | None:
    """Why no graph can hold a whole step of this objective; None if one can."""
    spec, kind = objective.spec, objective.depth_kind
    metric = kind == "metric" and spec.depth_fit == "auto"
    fitted = objective.weights["depth"] > 0 and kind != "none" and not metric
    for name, present in (
        ("train.loss.lpips", objective.lpips is not None and spec.lpips > 0),
        ("train.loss.face", spec.face > 0),
        ("train.rates.camera", objective.cameras is not None),
        ("objectives", bool(objective.objectives)),
        (f"train.loss.scene_loss: {spec.scene_loss}", spec.scene_loss != "full"),
        (f"train.loss.ssim: {spec.ssim}", spec.ssim != "warp"),
        ("a depth prior that is fitted to each frame", fitted),
    ):
        if present:
            return f"{name} is not part of graphs of whole steps"
    model = objective.model
    components = components_of(model) | {"rasterizer": model.rasterizer, "decoder": model.decoder}
    for name, control in objective.density.items():
        if type(control).regularizers is not DensityControl.regularizers:
            components[f"{name}.density"] = control
    return why_not_cuda_graph_safe(components)


@dataclass(frozen=True)
class _Needs:
    """What some view so far had; it only grows, so that views without it do not change the graph.

    Attributes:
        crops: names of those with a mask. depth, ignored: whether there was one.
    """

    crops: tuple[str, ...] = ()
    depth: bool = False
    ignored: bool = False

    def with_view(self, view: TrainingView) -> _Needs:
        frame = view.frame
        crops = self.crops
        if not set(view.crops) <= set(crops):
            crops = tuple(sorted({*crops, *view.crops}))
        depth = self.depth or frame.depth is not None
        return _Needs(crops, depth, self.ignored or frame.ignored is not None)


class _StepKey(GraphKey):
    """A `GraphKey` of the model, and what else a captured step depends on.

    Attributes:
        size: height and width of the pictures.
    """

    def __init__(self, objective: JointObjective, view: TrainingView, needs: _Needs) -> None:
        super().__init__(objective.model, view.frame.moment)
        self._settled, self._needs = objective.settled, needs
        self.size = _size(view)
        self.structure = (self.structure, self._settled, needs)

    def holds(self, objective: JointObjective, view: TrainingView, needs: _Needs) -> bool:  # type: ignore[override]
        model = objective.model
        same = self._settled == objective.settled and self._needs == needs
        if not same or _size(view) != self.size:
            return False
        return super().holds(model, view.frame.moment)


def _size(view: TrainingView) -> tuple[int, int]:
    height, width = view.frame.image.shape[:2]
    return height, width


class ViewMemory:
    """Where a captured step reads its view: memory that stays, filled anew before each replay.

    Args:
        view: any of the clip's. key: of the step. model: whose device and entities count.
    """

    def __init__(self, view: TrainingView, key: _StepKey, needs: _Needs, model: SceneModel) -> None:
        frame, device = view.frame, model.device
        height, width = key.size
        self._needs, layout = needs, key.layout
        drawn = {*model.names("human"), *model.names("object")}
        self.names = [name for name in needs.crops if name in drawn]
        empty = torch.zeros(height, width, dtype=torch.bool, device=device)
        self._layout, self._size = layout, (height, width)
        self._image = torch.empty_like(frame.image)
        self._masks = {name: empty.clone() for name in self.names}
        self._hidden = {name: empty.clone() for name in self.names}
        self._ignored = empty.clone() if needs.ignored else None
        self._depth = torch.zeros(height, width, device=device) if needs.depth else None
        self._fixed: dict[int, Tensor] = {}  # by position: camera and boxes, on the CPU
        count = 9 + 16 + (BOX + 3) * len(self.names) + len(layout.pack(frame.moment))
        self._row = torch.zeros(count, dtype=torch.float64, device=device)

    def fits(self, key: _StepKey, needs: _Needs) -> bool:
        return self._needs == needs and self._size == key.size and self._layout == key.layout

    def fill(self, view: TrainingView, backgrounds: Mapping[str, Float[Tensor, "3"]]) -> None:
        """Copy a view; without waiting for the device, once its camera has been seen."""
        frame = view.frame
        fixed = self._fixed.get(frame.position)
        if fixed is None:
            fixed = self._fixed[frame.position] = self._of_frame(view)
        black = torch.zeros(3)
        colors = [backgrounds.get(name, black).double() for name in self.names]
        row = torch.cat([fixed, *colors, self._layout.pack(frame.moment)])
        # not pinned: CUDA has read the source when this returns, so it may be freed
        self._row.copy_(row, non_blocking=True)
        self._image.copy_(frame.image)
        for name in self.names:
            crop = view.crops.get(name)
            if crop is None:
                continue  # its box is empty
            height, width = crop.mask.shape
            box = (slice(crop.top, crop.top + height), slice(crop.left, crop.left + width))
            self._masks[name][box].copy_(crop.mask)
            self._hidden[name][box].copy_(crop.ignore)
        if self._ignored is not None:
            _copy_or_clear(self._ignored, frame.ignored)
        if self._depth is not None:
            _copy_or_clear(self._depth, frame.depth)

    def _of_frame(self, view: TrainingView) -> Tensor:
        camera = view.frame.camera
        boxes = []
        for name in self.names:
            crop = view.crops.get(name)
            box = [0] * BOX if crop is None else [crop.top, crop.left, *crop.mask.shape, crop.area]
            boxes.append(torch.tensor(box, dtype=torch.float64))
        parts = [camera.K, camera.world_to_camera, *boxes]
        return torch.cat([part.detach().reshape(-1).to("cpu", torch.float64) for part in parts])

    def view(self, dtype: torch.dtype) -> tuple[TrainingView, Camera, dict[str, Tensor]]:
        """The view in this memory, its camera, and the colours behind what is drawn alone."""
        height, width = self._size
        start, single = 25, self._row.to(dtype)
        camera = Camera(single[:9].view(3, 3), single[9:25].view(4, 4), width, height)
        boxes, colors = {}, {}
        for name in self.names:
            boxes[name] = self._row[start : start + BOX].to(torch.int32)
            start += BOX
        for name in self.names:
            colors[name] = single[start : start + 3].contiguous()
            start += 3
        moment = self._layout.unpack(self._row[start:], dtype)
        frame = Frame(0, moment, camera, self._image, {}, self._depth, self._ignored)
        crops = {
            name: Crop(
                camera, self._image, self._masks[name], self._hidden[name], 1, box=boxes[name]
            )
            for name in self.names
        }
        return TrainingView(frame, crops), camera, colors


def _copy_or_clear(into: Tensor, values: Tensor | None) -> None:
    if values is None:
        into.zero_()
    else:
        into.copy_(values)


class _Step(nn.Module):
    """What is captured: from the memory of a view to losses."""

    def __init__(self, objective: JointObjective) -> None:
        super().__init__()
        self.scene, self._objective = objective.model, objective

    def forward(
        self, view: TrainingView, camera: Camera, backgrounds: Mapping[str, Tensor]
    ) -> ObjectiveResult:
        deformed = Deformed(self.scene(view.frame.moment))
        return self._objective.losses(view, camera, deformed, backgrounds, _NO_CHOICES)


class _CapturedStep:
    """One graph: forward and backward of a step, from the memory of a view.

    Args:
        stream: to capture on; None launches kernel by kernel, the same in every other respect.

    Attributes:
        drawn: the rasterizer's `graph_memory` before it was captured.
    """

    drawn = 0

    def __init__(self, step: _Step, memory: ViewMemory, stream: torch.cuda.Stream | None) -> None:
        self._step, self.memory = step, memory
        self._parameters = {n: p for n, p in step.named_parameters() if p.requires_grad}
        self._graph: torch.cuda.CUDAGraph | None = None
        if stream is None:
            return
        graph = torch.cuda.CUDAGraph()
        with on_stream(stream), side_by_side({}):
            self._compute()  # what only a first call does
            with capturing(graph, stream):
                self._compute()
        self._graph = graph

    def run(self, view: TrainingView) -> ObjectiveResult:
        """The losses of the view that the memory holds, with gradients in `.grad`."""
        if self._graph is None:
            self._compute()
        else:
            self._graph.replay()
        for parameter, gradient in self._gradients:
            parameter.grad = gradient
        result = self._result
        terms = {name: t for name, t in result.terms.items() if _has_part(name, view)}
        return replace(result, terms=terms)

    def uncaptured(self) -> _CapturedStep:
        """The same step from the same memory, kernel by kernel."""
        return _CapturedStep(self._step, self.memory, None)

    def values(self, view: TrainingView) -> dict[str, Tensor]:
        """Losses and gradients of the view that the memory holds, by what a message calls them."""
        result = self.run(view)
        names = {id(p): name.removeprefix("scene.") for name, p in self._parameters.items()}
        found = {f"the loss {name}": term for name, term in result.terms.items()}
        for parameter, gradient in self._gradients:
            found[f"the gradient of {names[id(parameter)]}"] = gradient
            parameter.grad = None
        if result.screen_offsets.grad is not None:
            found["the gradient on the screen"] = result.screen_offsets.grad
        # a second run may use the same memory
        return {name: value.clone() for name, value in found.items()}

    def _compute(self) -> None:
        leaves = leaves_of(self._parameters)
        dtype = next(iter(leaves.values())).dtype
        with torch.enable_grad():
            view, camera, backgrounds = self.memory.view(dtype)
            result = functional_call(self._step, leaves, (view, camera, backgrounds))
        drawn = [result.screen_offsets]
        if result.absolute_gradients is not None:
            drawn.append(result.absolute_gradients)
        found = torch.autograd.grad(result.total, [*leaves.values(), *drawn], allow_unused=True)
        ours, of_drawn = found[: len(leaves)], found[len(leaves) :]
        order, sizes, flat = in_one_tensor(ours)  # of the graph's own, written by each replay
        finite = torch.isfinite(flat).all()
        parameters = list(self._parameters.values())
        self._gradients = [
            (parameters[i], piece.view(parameters[i].shape))
            for i, piece in zip(order, flat.split(sizes), strict=True)
        ]
        self._result = _without_history(result, finite, of_drawn)


def _has_part(term: str, view: TrainingView) -> bool:
    """Whether a term is of something that this view shows."""
    kind, _, rest = term.partition("/")
    if kind in ("human", "object"):
        return rest.partition("/")[0] in view.crops
    return kind != "depth" or view.frame.depth is not None


def _without_history(
    result: ObjectiveResult, finite: Tensor, of_drawn: Sequence[Tensor | None]
) -> ObjectiveResult:
    """The result as values; its screen gradients are zero where any gradient is not finite."""
    offsets = result.screen_offsets.detach()
    absolutes = None if result.absolute_gradients is None else result.absolute_gradients.detach()
    for tensor, gradient in zip((offsets, absolutes), of_drawn, strict=False):
        if tensor is not None and gradient is not None:
            tensor.grad = torch.where(finite, gradient, 0.0)
    state, composite = result.state, result.composite
    values = SceneState(
        {name: gaussians.detach() for name, gaussians in state.gaussians.items()},
        {name: _detached(residual) for name, residual in state.residuals.items()},
        {name: _detached(tokens) for name, tokens in state.tokens.items()},
    )
    return replace(
        result,
        terms={name: term.detach() for name, term in result.terms.items()},
        total=torch.where(finite, result.total.detach(), 0.0),
        state=values,
        composite=_detached(composite),
        screen_offsets=offsets,
        absolute_gradients=absolutes,
        finite=finite,
    )


def _detached(values: T) -> T:
    """A dataclass whose tensors have no history."""
    plain = {
        f.name: value.detach() if isinstance(value := getattr(values, f.name), Tensor) else value
        for f in fields(values)
    }
    return replace(values, **plain)
