"""A computation and its gradient, captured once as two CUDA graphs and replayed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from hoigs.core.cuda_graphs.capture import capturing
from hoigs.core.first_order import first_order

Key = tuple[str, ...]
Compute = Callable[[Mapping[str, Tensor]], dict[Key, Tensor]]


def leaves_of(parameters: Mapping[str, nn.Parameter]) -> dict[str, Tensor]:
    """Leaf tensors that share the parameters' memory.

    A capture must not use a parameter itself, since autograd remembers its shape, which density
    control changes, and the stream on which it was last used.
    """
    return {name: p.detach().requires_grad_() for name, p in parameters.items()}


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
        self._zero_filled: set[int] = (
            set()
        )  # indices of upstream gradients that are filled with zeros
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
        reached = [i for i, gradient in enumerate(found) if gradient is not None]
        # multiples of 16 bytes first, which keeps them aligned: fused Adam is faster then
        self._order = sorted(reached, key=lambda i: found[i].numel() % 4 != 0)
        self._sizes = [found[i].numel() for i in self._order]
        # one tensor for all, so that one copy suffices
        self._flat = torch.cat([found[i].reshape(-1) for i in self._order])

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
        current = torch.cuda.current_stream(stream.device)
        stream.wait_stream(current)
        graphs = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        # set the stream here too: a capture that fails does not restore the previous one
        with torch.cuda.device(stream.device), torch.cuda.stream(stream):
            self._warm_up()
            with capturing(graphs[0], stream):
                self._run()
            with capturing(graphs[1], stream, pool=graphs[0].pool()):
                self._run_backward()
        current.wait_stream(stream)
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
