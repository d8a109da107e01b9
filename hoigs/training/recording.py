"""A recording: a computation and its gradient, captured once as CUDA graphs and replayed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from hoigs.core.capture import capturing

Key = tuple[str, ...]
Compute = Callable[[Mapping[str, Tensor]], dict[Key, Tensor]]


def leaves_of(parameters: Mapping[str, nn.Parameter]) -> dict[str, Tensor]:
    """Tensors on the parameters' memory, without their history.

    What is captured must not hang on a parameter itself: autograd would remember its shape, which
    density control changes, and the stream on which it was used last.
    """
    return {name: p.detach().requires_grad_() for name, p in parameters.items()}


class Recording:
    """Named tensors computed from parameters; a call replays it, `backward()` replays its gradient.

    Outputs stand in memory that the next call overwrites, so their gradients must have been asked
    for by then. Gradients of parameters are copies. Those that no output depends on get none.

    Args:
        compute: leaves, by the names of `parameters`, to tensors by key. It must read only memory
            that stays: of parameters, buffers, and what its caller fills before each call.
        parameters: that are trained, all of one dtype.
        stream: to capture on; None computes launch by launch, the same in every other respect.

    Raises:
        RuntimeError: it cannot be captured; CUDA's words.
        ValueError: parameters of several dtypes, or none that any output depends on.
    """

    def __init__(
        self,
        compute: Compute,
        parameters: Mapping[str, nn.Parameter],
        stream: torch.cuda.Stream | None = None,
    ) -> None:
        kinds = sorted({str(p.dtype) for p in parameters.values()})
        if len(kinds) > 1:
            raise ValueError(f"parameters of several dtypes ({', '.join(kinds)})")
        self._compute, self.parameters = compute, dict(parameters)
        self._graphs: tuple[torch.cuda.CUDAGraph, torch.cuda.CUDAGraph] | None = None
        self._turn = 0
        self._zero: set[int] = set()  # which of the outputs' gradients stand at zero
        if stream is None:
            self._rehearse()
        else:
            self._capture(stream)

    def __call__(self) -> dict[Key, Tensor]:
        """The outputs, from what now stands in the memory that is read."""
        live = _Replay.apply(self, *self.parameters.values())
        return {**self.fixed, **dict(zip(self.live, live, strict=True))}

    def replay(self) -> int:
        """Compute the outputs, into `live` and `fixed`; the number of this turn."""
        self._turn += 1
        if self._graphs is None:
            self._run()
        else:
            self._graphs[0].replay()
        return self._turn

    def replay_backward(self, gradients: Sequence[Tensor | None], turn: int) -> list[Tensor | None]:
        """Gradients of the parameters, in their order, from those of `live`, in theirs.

        Raises:
            RuntimeError: the outputs of that turn are gone.
        """
        if turn != self._turn:
            raise RuntimeError(
                "the memory of this step's forward pass has been overwritten by a later one: "
                "call backward() before the next forward pass, or set train.graphs to off"
            )
        pairs = zip(self._gradients, gradients, strict=True)
        given = [(ours, theirs) for ours, theirs in pairs if theirs is not None]
        if given:
            torch._foreach_copy_([ours for ours, _ in given], [theirs for _, theirs in given])
        missing = {i for i, gradient in enumerate(gradients) if gradient is None}
        stale = [self._gradients[i] for i in missing - self._zero]
        if stale:
            torch._foreach_zero_(stale)
        self._zero = missing
        if self._graphs is None:
            self._run_backward()
        else:
            self._graphs[1].replay()
        found: list[Tensor | None] = [None] * len(self.parameters)
        parameters = list(self.parameters.values())
        # a copy: `.grad` keeps it, and the next turn writes here again
        for i, piece in zip(self._order, self._flat.clone().split(self._sizes), strict=True):
            found[i] = piece.view(parameters[i].shape)
        return found

    def _run(self) -> None:
        self._leaves = leaves_of(self.parameters)
        with torch.enable_grad():
            found = self._compute(self._leaves)
        self.live = {key: value for key, value in found.items() if value.requires_grad}
        self.fixed = {key: value for key, value in found.items() if not value.requires_grad}

    def _run_backward(self) -> None:
        found = torch.autograd.grad(
            list(self.live.values()), list(self._leaves.values()), self._gradients,
            allow_unused=True,
        )  # fmt: skip
        reached = [i for i, gradient in enumerate(found) if gradient is not None]
        # those of whole 16 bytes first, which keeps them aligned; fused Adam is quicker then
        self._order = sorted(reached, key=lambda i: found[i].numel() % 4 != 0)
        self._sizes = [found[i].numel() for i in self._order]
        # one tensor for all, so that one copy takes them out
        self._flat = torch.cat([found[i].reshape(-1) for i in self._order])

    def _rehearse(self) -> None:
        """Once launch by launch: what there is, and everything that only a first call does."""
        self._run()
        if not self.live:
            raise ValueError("nothing that is trained takes part")
        self._gradients = [
            torch.zeros_like(value, memory_format=torch.contiguous_format)
            for value in self.live.values()
        ]
        self._zero = set(range(len(self._gradients)))
        self._run_backward()

    def _capture(self, stream: torch.cuda.Stream) -> None:
        current = torch.cuda.current_stream(stream.device)
        stream.wait_stream(current)
        graphs = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        # the stream outside too: a capture that fails does not restore the one before
        with torch.cuda.device(stream.device), torch.cuda.stream(stream):
            self._rehearse()
            with capturing(graphs[0], stream):
                self._run()
            with capturing(graphs[1], stream, pool=graphs[0].pool()):
                self._run_backward()
        current.wait_stream(stream)
        self.live = {key: value.detach() for key, value in self.live.items()}
        self._leaves = {}
        self._graphs = graphs


class _Replay(torch.autograd.Function):
    """Parameters in, outputs of a recording out."""

    @staticmethod
    def forward(ctx: Any, recording: Recording, *parameters: Tensor) -> tuple[Tensor, ...]:
        del parameters  # read where they stand
        ctx.set_materialize_grads(False)
        ctx.recording, ctx.turn = recording, recording.replay()
        return tuple(value.detach() for value in recording.live.values())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        return None, *ctx.recording.replay_backward(gradients, ctx.turn)
