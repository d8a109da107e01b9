"""The model's part of a training step by CUDA graphs: features to Gaussians, and penalties."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.func import functional_call

from hoigs.core.errors import HoigsError, PluginError
from hoigs.core.fast.graphs import capturing, why_not_cuda_graph_safe
from hoigs.core.first_order import first_order
from hoigs.core.model.scene import SceneModel, SceneState
from hoigs.core.spec.train_schema import Graphs
from hoigs.core.values.gaussians import Gaussians
from hoigs.core.values.moment import Moment, MomentLayout
from hoigs.core.values.tokens import Residual, Tokens

# A computation and its gradient, captured once as two CUDA graphs and replayed.

Key = tuple[str, ...]
Compute = Callable[[Mapping[str, Tensor]], dict[Key, Tensor]]


def leaves_of(parameters: Mapping[str, nn.Parameter]) -> dict[str, Tensor]:
    """Leaf tensors that share the parameters' memory.

    A capture must not use a parameter itself, since autograd remembers its shape, which density
    control changes, and the stream on which it was last used.
    """
    return {name: p.detach().requires_grad_() for name, p in parameters.items()}


@contextmanager
def on_stream(stream: torch.cuda.Stream) -> Iterator[None]:
    """Capture on a stream in the block, which waits for the present one, and that for it then."""
    current = torch.cuda.current_stream(stream.device)
    stream.wait_stream(current)
    # set the stream here too: a capture that fails does not restore the previous one
    with torch.cuda.device(stream.device), torch.cuda.stream(stream):
        yield
    current.wait_stream(stream)


def in_one_tensor(gradients: Sequence[Tensor | None]) -> tuple[list[int], list[int], Tensor]:
    """Places of the gradients that there are, how many numbers each has, and all in one tensor."""
    found = {i: gradient for i, gradient in enumerate(gradients) if gradient is not None}
    # multiples of 16 bytes first, which keeps them aligned: fused Adam is faster then
    order = sorted(found, key=lambda i: found[i].numel() % 4 != 0)
    sizes = [found[i].numel() for i in order]
    return order, sizes, torch.cat([found[i].reshape(-1) for i in order])


class GraphedStep:
    """Named tensors computed from parameters; `backward()` of them replays their gradient.

    Each call overwrites the outputs of the one before, so `backward()` must come before the next
    call. Gradients of the parameters are copies; parameters that no output depends on get none.

    Args:
        compute: from leaves, by the names of `parameters`, to tensors by key. It may read only
            memory that stays: parameters, buffers, and what its caller fills before each call.
        parameters: that are trained, all of one dtype.
        stream: to capture on; None launches kernel by kernel, the same in every other respect.

    Attributes:
        differentiable, fixed: outputs with and without a gradient, as the last replay left them.

    Raises:
        RuntimeError: it cannot be captured; with CUDA's message.
        ValueError: parameters of several dtypes, or no output depends on any.
    """

    def __init__(
        self,
        compute: Compute,
        parameters: Mapping[str, nn.Parameter],
        stream: torch.cuda.Stream | None = None,
    ) -> None:
        dtypes = sorted({str(p.dtype) for p in parameters.values()})
        if len(dtypes) > 1:
            raise ValueError(f"parameters of several dtypes ({', '.join(dtypes)})")
        self._compute, self.parameters = compute, dict(parameters)
        self._graphs: tuple[torch.cuda.CUDAGraph, torch.cuda.CUDAGraph] | None = None
        self._replay_index = 0
        self._zero_filled: set[int] = set()  # indices of upstream gradients that are zeros
        if stream is None:
            self._warm_up()
        else:
            self._capture(stream)

    def __call__(self) -> dict[Key, Tensor]:
        """The outputs, computed from the current contents of the memory that `compute` reads."""
        values = _Replay.apply(self, *self.parameters.values())
        return {**self.fixed, **dict(zip(self.differentiable, values, strict=True))}

    def replay(self) -> int:
        """Compute `differentiable` and `fixed`; returns the index of this replay."""
        self._replay_index += 1
        if self._graphs is None:
            self._run()
        else:
            self._graphs[0].replay()
        return self._replay_index

    def replay_backward(
        self, gradients: Sequence[Tensor | None], replay_index: int
    ) -> list[Tensor | None]:
        """Gradients of the parameters, from those of the `differentiable` outputs.

        Raises:
            RuntimeError: the outputs of that replay have been overwritten.
        """
        if replay_index != self._replay_index:
            raise RuntimeError(
                "the memory of this step's forward pass has been overwritten by a later one: "
                "call backward() before the next forward pass, or set train.graphs to off"
            )
        pairs = zip(self._upstream, gradients, strict=True)
        given = [(ours, theirs) for ours, theirs in pairs if theirs is not None]
        if given:
            torch._foreach_copy_([ours for ours, _ in given], [theirs for _, theirs in given])
        missing = {i for i, gradient in enumerate(gradients) if gradient is None}
        stale = [self._upstream[i] for i in missing - self._zero_filled]
        if stale:
            torch._foreach_zero_(stale)
        self._zero_filled = missing
        if self._graphs is None:
            self._run_backward()
        else:
            self._graphs[1].replay()
        found: list[Tensor | None] = [None] * len(self.parameters)
        parameters = list(self.parameters.values())
        # a copy, since `.grad` keeps it and the next replay overwrites this memory
        for i, piece in zip(self._order, self._flat.clone().split(self._sizes), strict=True):
            found[i] = piece.view(parameters[i].shape)
        return found

    def _run(self) -> None:
        self._leaves = leaves_of(self.parameters)
        with torch.enable_grad():
            found = self._compute(self._leaves)
        self.differentiable = {key: value for key, value in found.items() if value.requires_grad}
        self.fixed = {key: value for key, value in found.items() if not value.requires_grad}

    def _run_backward(self) -> None:
        found = torch.autograd.grad(
            list(self.differentiable.values()), list(self._leaves.values()), self._upstream,
            allow_unused=True,
        )  # fmt: skip
        self._order, self._sizes, self._flat = in_one_tensor(found)  # so that one copy suffices

    def _warm_up(self) -> None:
        """Run once without a graph: find the outputs, and do what only a first call does."""
        self._run()
        if not self.differentiable:
            raise ValueError("no output depends on a trained parameter")
        self._upstream = [
            torch.zeros_like(value, memory_format=torch.contiguous_format)
            for value in self.differentiable.values()
        ]
        self._zero_filled = set(range(len(self._upstream)))
        self._run_backward()

    def _capture(self, stream: torch.cuda.Stream) -> None:
        graphs = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        with on_stream(stream):
            self._warm_up()
            with capturing(graphs[0], stream):
                self._run()
            with capturing(graphs[1], stream, pool=graphs[0].pool()):
                self._run_backward()
        self.differentiable = {key: value.detach() for key, value in self.differentiable.items()}
        self._leaves = {}
        self._graphs = graphs


class _Replay(torch.autograd.Function):
    """From parameters to the differentiable outputs of a GraphedStep."""

    @staticmethod
    def forward(ctx: Any, step: GraphedStep, *parameters: Tensor) -> tuple[Tensor, ...]:
        del parameters  # the graph reads their memory
        ctx.set_materialize_grads(False)
        ctx.step, ctx.replay_index = step, step.replay()
        return tuple(value.detach() for value in step.differentiable.values())

    @staticmethod
    @first_order("a training step of CUDA graphs", "train.graphs: off has the second, too")
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        return None, *ctx.step.replay_backward(gradients, ctx.replay_index)


# What a captured graph of a model depends on.


class GraphKey:
    """The memory, shape and `requires_grad` of all tensors of a model, and the layout of moments.

    A graph that was captured when this key was made may be replayed as long as `holds` is True.

    Attributes:
        layout: of moments with these people.
        structure: the operations that are captured, whatever the shapes. Two keys of one model
            with equal structure need only one comparison of the graph with eager execution.
    """

    def __init__(self, model: SceneModel, moment: Moment) -> None:
        self._interaction_enabled = model.interaction_enabled
        self.layout = MomentLayout.of(moment, model.entities, betas=True)
        stores = [s for m in model.modules() for s in (m._parameters, m._buffers)]
        self._sizes = [(store, len(store)) for store in stores if store]
        # the detached tensors keep the memory allocated, so that no other tensor can take its place
        self._tensors = [
            (store, name, x, None if x is None else x.detach(), x is not None and x.requires_grad)
            for store in stores
            for name, x in store.items()
        ]
        people = tuple((name, p.convention) for name, p in self.layout.people.items())
        kinds = tuple((name, x is None, trained) for _, name, x, _, trained in self._tensors)
        self.structure: tuple[object, ...] = (self._interaction_enabled, people, kinds)

    def holds(self, model: SceneModel, moment: Moment) -> bool:
        """Whether nothing has changed since this key was made."""
        if model.interaction_enabled != self._interaction_enabled or not self.layout.fits(moment):
            return False
        if any(len(store) != size for store, size in self._sizes):
            return False
        for store, name, tensor, memory, trained in self._tensors:
            if store.get(name) is not tensor:
                return False
            if tensor is not None and memory is not None:
                same = tensor.data_ptr() == memory.data_ptr() and tensor.shape == memory.shape
                if not same or tensor.requires_grad != trained:
                    return False
        return True


Mode = Literal["graph", "cached", "plain"]
# Largest relative L2 difference of a tensor between a graph and eager execution. Sums in another
# order differed by 6e-4 in tokens of a recorded clip; what a graph reads from memory that is not
# its own any more is another picture.
TOLERANCE = 2e-3


def mode_of(
    graphs: Graphs, unsafe: str | None, device: torch.device, kernel_by_kernel: bool
) -> tuple[Mode, str]:
    """How steps run, and why.

    Args:
        unsafe: why a graph cannot hold them; None if it can.
    """
    if graphs == "off":
        return "plain", "train.graphs is off"
    if unsafe is not None:
        return "plain", unsafe
    if kernel_by_kernel:
        return "cached", "kernel_by_kernel is set"
    if device.type != "cuda":
        return "plain", f"CUDA graphs need a CUDA device, the model is on {device}"
    return "graph", "every component is cuda_graph_safe"


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
        unsafe = why_not_cuda_graph_safe(components_of(model))
        self.mode, self.reason = mode_of(graphs, unsafe, model.device, kernel_by_kernel)
        if self._required and self.mode == "plain":
            raise HoigsError(f"train.graphs is on, but {self.reason}; set it to auto or off")

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
            failure = root_cause(error)
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
        difference = first_difference(pairs)
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
        return first_difference(pairs)


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
        found: dict[Key, Tensor] = {("joined", f): x for f, x in joined.tensors().items()}
        for name, gaussians in state.gaussians.items():
            found |= {("gaussians", name, f): x for f, x in gaussians.tensors().items()}
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


def first_difference(pairs: Mapping[str, tuple[Tensor, Tensor]]) -> str | None:
    """The first pair that differs by more than `TOLERANCE`, as a message; one device-to-host copy.

    Relative to each tensor's norm plus a millionth of the largest norm, which excuses tensors that
    hold nothing but rounding.
    """
    if not pairs:
        return None
    rows = [torch.stack(((a - b).norm(), b.norm())).double() for a, b in pairs.values()]
    found = torch.stack(rows).tolist()
    floor = 1e-6 * max(norm for _, norm in found)
    for name, (distance, norm) in zip(pairs, found, strict=True):
        if not distance <= TOLERANCE * norm + floor:  # NaN differs too
            return f"{name} differs by {distance:.3g}, of {norm:.3g}, from eager execution"
    return None


def root_cause(error: BaseException) -> str:
    """The first line of the first error; a failed capture raises more errors on its way out."""
    while error.__context__ is not None:
        error = error.__context__
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
