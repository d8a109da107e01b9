"""The model's part of a training step by CUDA graphs: features to Gaussians, and penalties."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.func import functional_call

from hoigs.core.cuda_graphs.eligibility import why_not_cuda_graph_safe
from hoigs.core.errors import HoigsError, PluginError
from hoigs.core.model.scene import SceneModel, SceneState
from hoigs.core.spec.train_schema import Graphs
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment
from hoigs.core.values.tokens import Residual, Tokens
from hoigs.training.graphs.graph_key import GraphKey
from hoigs.training.graphs.graphed_step import GraphedStep, Key, leaves_of

Mode = Literal["graph", "cached", "plain"]

FIELDS = tuple(f.name for f in fields(Gaussians))
# largest relative L2 difference of a tensor between a graph and eager execution
VALUE_TOLERANCE, GRADIENT_TOLERANCE = 1e-4, 1e-3


@dataclass(frozen=True)
class Deformed:
    """The scene at a moment.

    Attributes:
        state: its Gaussians. Those of a graph are valid until the next call; their tokens carry no
            gradient, nor do residuals without a regularizer.
        penalties: of each entity's deformation, those with a weight, by name; None where they were
            not computed.
    """

    state: SceneState
    penalties: Mapping[str, Mapping[str, Tensor]] | None = None


class GraphedScene:
    """`SceneModel.forward` and the penalties in training, by CUDA graphs where possible.

    Time and poses go to the device in one copy; one graph computes the outputs, a second one the
    gradients. Graphs depend on memory that density control replaces and on which parts of the model
    take part, so a GraphKey is checked before each step. A step whose key no longer holds runs
    eagerly, and the next one captures new graphs. A model that changes at every step is therefore
    never captured.

    The first graphs of each structure (`GraphKey.structure`) are compared with eager execution, in
    values and in gradients. If they differ, or if capturing fails, all later steps run eagerly, and
    a warning gives the reason.

    Args:
        model: on its device. In eval mode, and without gradients, it is called directly.
        graphs: `TrainSpec.graphs`.
        weight_of: weight of an entity's penalty of that name; those without weight are left out.
        restrained: whether a regularizer needs gradients of the residuals themselves.
        kernel_by_kernel: do the same on any device without capturing graphs: for tests.

    Attributes:
        mode: how steps run while the key holds. reason: why.
        captures: how often graphs were captured.

    Raises:
        HoigsError: `graphs` is "on", and graphs cannot be used.
    """

    def __init__(
        self,
        model: SceneModel,
        graphs: Graphs,
        weight_of: Callable[[str, str], float],
        *,
        restrained: bool = False,
        kernel_by_kernel: bool = False,
    ) -> None:
        self._model, self._step = model, _ModelStep(model, weight_of, restrained)
        self._wanted, self._required = graphs != "off", graphs == "on"
        self._graph_key: GraphKey | None = None
        self._graphed_step: GraphedStep | None = None
        self._compared: set[object] = set()
        self._stream: torch.cuda.Stream | None = None
        self.captures = 0
        self.mode, self.reason = self._choose(graphs, kernel_by_kernel)
        if self._required and self.mode == "plain":
            raise HoigsError(f"train.graphs is on, but {self.reason}; set it to auto or off")

    def _choose(self, graphs: Graphs, kernel_by_kernel: bool) -> tuple[Mode, str]:
        if graphs == "off":
            return "plain", "train.graphs is off"
        unsafe = why_not_cuda_graph_safe(components_of(self._model))
        if unsafe is not None:
            return "plain", unsafe
        if kernel_by_kernel:
            return "cached", "kernel_by_kernel is set"
        if self._model.device.type != "cuda":
            return "plain", f"CUDA graphs need a CUDA device, the model is on {self._model.device}"
        return "graph", "every component is cuda_graph_safe"

    def __call__(self, moment: Moment) -> Deformed:
        """The scene at a moment; one on the CPU is fastest, since graphs copy it from there."""
        if self.mode == "plain" or not (self._model.training and torch.is_grad_enabled()):
            return self._eager(moment)
        if self._graph_key is None or not self._graph_key.holds(self._model, moment):
            self._release()
            self._graph_key = GraphKey(self._model, moment)
            return self._eager(moment)
        if self._graphed_step is None:
            self._capture(moment, self._graph_key)
            if self._graphed_step is None:
                return self._eager(moment)
        # not pinned: CUDA has read the source when this returns, so it may be freed
        self._moment_row.copy_(self._graph_key.layout.pack(moment), non_blocking=True)
        return self._assembled(self._graphed_step())

    def why_slower(self) -> str | None:
        """Why a GPU runs this scene without the graphs that were wanted; None otherwise."""
        slower = self._wanted and self.mode == "plain" and self._model.device.type == "cuda"
        return self.reason if slower else None

    def _release(self) -> None:
        """Free the graphs, once the device has finished with them."""
        if self._graphed_step is not None and self._stream is not None:
            torch.cuda.synchronize(self._stream.device)
        self._graphed_step = None

    def _eager(self, moment: Moment) -> Deformed:
        return Deformed(self._model(moment.to(self._model.device)))

    def _assembled(self, values: dict[Key, Tensor]) -> Deformed:
        terms = values.pop(("penalties",), None)
        parts: dict[Key, dict[str, Any]] = {}
        for key, value in values.items():
            parts.setdefault(key[:-1], {})[key[-1]] = value
        gaussians = {n: Gaussians(**parts["gaussians", n]) for n in self._model.entities}
        residuals = {k[1]: Residual(**p) for k, p in parts.items() if k[0] == "residuals"}
        tokens = {k[1]: Tokens(**p) for k, p in parts.items() if k[0] == "tokens"}
        penalties: dict[str, dict[str, Tensor]] = {n: {} for n in gaussians}
        if terms is not None:
            for (name, penalty), term in zip(self._step.penalties, terms.unbind(), strict=True):
                penalties[name][penalty] = term
        joined = Gaussians(**parts["joined",])
        return Deformed(SceneState(gaussians, residuals, tokens, joined), penalties)

    def _capture(self, moment: Moment, graph_key: GraphKey) -> None:
        """Capture graphs and compare those of a new structure; on failure use none from now on."""
        trained = {
            f"scene.{name}": p for name, p in self._model.named_parameters() if p.requires_grad
        }
        self._moment_row = graph_key.layout.pack(moment).to(self._model.device)
        try:
            if self.mode == "graph" and self._stream is None:
                self._stream = torch.cuda.Stream(self._model.device)
            step = GraphedStep(self._compute, trained, self._stream)
            failure = None
            if graph_key.structure not in self._compared:
                failure = self._difference(step, moment)
        except (RuntimeError, TypeError, ValueError, NotImplementedError, PluginError) as error:
            # what CUDA or a component raises when it is captured; reported below
            failure = _root_cause(error)
        if failure is None:
            self._graphed_step = step
            self._compared.add(graph_key.structure)
            self.captures += 1
            return
        self.mode, self.reason = "plain", failure
        if self._required:
            raise HoigsError(f"train.graphs is on, but {failure}; set it to auto or off")
        warnings.warn(f"training continues without CUDA graphs: {failure}", stacklevel=3)

    def _compute(self, leaves: Mapping[str, Tensor]) -> dict[Key, Tensor]:
        assert self._graph_key is not None
        dtype = next(iter(leaves.values())).dtype
        moment = self._graph_key.layout.unpack(self._moment_row, dtype)
        found: dict[Key, Tensor] = functional_call(self._step, dict(leaves), (moment,))
        return found

    def _difference(self, step: GraphedStep, moment: Moment) -> str | None:
        """How values or gradients differ from eager execution; None where they agree."""
        leaves = leaves_of(step.parameters)
        eager = functional_call(self._step, leaves, (moment.to(self._model.device),))
        replay_index = step.replay()
        graphed = {**step.differentiable, **step.fixed}
        keys = [key for key, value in eager.items() if value.requires_grad]
        if set(graphed) != set(eager) or keys != list(step.differentiable):
            return "the graph does not have the outputs of eager execution"
        names = {" of ".join(key[::-1]): key for key in eager}
        pairs = {f"{n} of the graph": (graphed[k], eager[k].detach()) for n, k in names.items()}
        difference = _first_difference(pairs, VALUE_TOLERANCE)
        if difference is not None:
            return difference
        generator = torch.Generator(self._model.device).manual_seed(0)  # not the run's own numbers
        upstream = [
            torch.randn(eager[k].shape, dtype=eager[k].dtype, device=eager[k].device,
                        generator=generator)
            for k in keys
        ]  # fmt: skip
        expected = torch.autograd.grad(
            [eager[k] for k in keys], list(leaves.values()), upstream, allow_unused=True
        )
        found = step.replay_backward(upstream, replay_index)
        pairs = {}
        for name, ours, theirs in zip(leaves, found, expected, strict=True):
            name = name.removeprefix("scene.")
            if (ours is None) != (theirs is None):
                return f"{name} has a gradient either by the graph or by eager execution, not both"
            if ours is not None and theirs is not None:
                pairs[f"the gradient of {name} by the graph"] = (ours, theirs)
        return _first_difference(pairs, GRADIENT_TOLERANCE)


def components_of(model: SceneModel) -> dict[str, object]:
    """The components that take part in a step, by their place in a spec."""
    found: dict[str, object] = {"interaction": model.interaction}
    for name in model.entities:
        found[f"{name}.deformation"] = model.entity(name).deformation
        found[f"{name}.features"] = model.entity(name).features
    return found


class _ModelStep(nn.Module):
    """What is captured: from a moment to named tensors.

    Attributes:
        penalties: entity and name of each of the penalties in the last output.
    """

    def __init__(
        self, scene: SceneModel, weight_of: Callable[[str, str], float], restrained: bool
    ) -> None:
        super().__init__()
        self.scene, self._weight_of, self._restrained = scene, weight_of, restrained
        self.penalties: list[tuple[str, str]] = []

    def forward(self, moment: Moment) -> dict[Key, Tensor]:
        state: SceneState = self.scene(moment)
        joined = state.joined()
        found: dict[Key, Tensor] = {("joined", f): getattr(joined, f) for f in FIELDS}
        for name, gaussians in state.gaussians.items():
            found |= {("gaussians", name, f): getattr(gaussians, f) for f in FIELDS}
        for name, tokens in state.tokens.items():
            found["tokens", name, "features"] = tokens.features.detach()
            found["tokens", name, "positions"] = tokens.positions.detach()
        for name, residual in state.residuals.items():
            for part, value in (("pose", residual.pose), ("means", residual.means)):
                if value is not None:
                    found["residuals", name, part] = value if self._restrained else value.detach()
        penalties = {
            (name, key): value
            for name in state.gaussians
            for key, value in self.scene.entity(name).regularizers().items()
            if self._weight_of(name, key) > 0
        }
        self.penalties = list(penalties)
        if penalties:
            found["penalties",] = torch.stack(list(penalties.values()))
        return found


def _first_difference(pairs: Mapping[str, tuple[Tensor, Tensor]], tolerance: float) -> str | None:
    """The first pair that differs by more than `tolerance`, as a message; one device-to-host copy.

    Relative to each tensor's norm plus a millionth of the largest norm, which excuses tensors that
    hold nothing but rounding.
    """
    if not pairs:
        return None
    rows = [torch.stack(((a - b).norm(), b.norm())).double() for a, b in pairs.values()]
    found = torch.stack(rows).tolist()
    floor = 1e-6 * max(norm for _, norm in found)
    for name, (distance, norm) in zip(pairs, found, strict=True):
        if not distance <= tolerance * norm + floor:  # NaN differs too
            return f"{name} differs by {distance:.3g}, of {norm:.3g}, from eager execution"
    return None


def _root_cause(error: BaseException) -> str:
    """The first line of the first error; a failed capture raises more errors on its way out."""
    while error.__context__ is not None:
        error = error.__context__
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
