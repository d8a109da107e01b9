"""The model's part of a training step, replayed: features, interaction, deformation, penalties."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.func import functional_call

from hoigs.core.errors import HoigsError
from hoigs.core.features import Tokens
from hoigs.core.gaussians import Gaussians
from hoigs.core.interaction import Residual
from hoigs.core.moment import Moment
from hoigs.core.recordable import why_not_recordable
from hoigs.core.scene import SceneModel, SceneState
from hoigs.core.train_spec import Graphs
from hoigs.training.recording import Key, Recording, leaves_of
from hoigs.training.stamp import Stamp

Mode = Literal["graph", "cached", "plain"]

FIELDS = tuple(f.name for f in fields(Gaussians))
VALUES, GRADIENTS = 1e-4, 1e-3  # largest relative L2 difference to the plain path, of each tensor


@dataclass(frozen=True)
class Deformed:
    """The scene at a moment.

    Attributes:
        state: its Gaussians; of a recording they are valid until the next one is asked for, and
            tokens carry no gradient, nor do residuals that nothing restrains.
        penalties: of each entity's deformation, those that count, by name; None where they were
            not computed along.
    """

    state: SceneState
    penalties: Mapping[str, Mapping[str, Tensor]] | None = None


class RecordedScene:
    """`SceneModel.forward` and the penalties in training, by CUDA graphs where they can be had.

    Time and poses go to the device in one copy; two graphs do the rest, one forward, one backward.
    They hold for the memory that they were captured on. Density control exchanges that, and parts
    of the model join in during a run, so what was captured is looked at before each step. A step
    that finds it changed is done plainly, and the next one is recorded: a model that changes at
    every step is never recorded, and recordings are no more than changes.

    The first recording of each set of parts is compared with the plain path, in values and in
    gradients; where they differ, or capturing fails, all steps are plain from then on, with a
    warning.

    Args:
        model: on its device. In eval mode, and without gradients, it is called as it is.
        graphs: `TrainSpec.graphs`.
        weight_of: of an entity's penalty of that name; penalties without weight are left out.
        restrained: whether residuals need gradients of their own.
        launches: do all of it on any device, launch by launch, without graphs: for tests.

    Attributes:
        mode: what is done, if the model is as it was. reason: why, in words.
        recordings: how often there was a new one.

    Raises:
        HoigsError: graphs are asked for and cannot be had.
    """

    def __init__(
        self,
        model: SceneModel,
        graphs: Graphs,
        weight_of: Callable[[str, str], float],
        *,
        restrained: bool = False,
        launches: bool = False,
    ) -> None:
        self._model, self._whole = model, _Whole(model, weight_of, restrained)
        self._insisted = graphs == "on"
        self._stamp: Stamp | None = None
        self._recording: Recording | None = None
        self._compared: set[object] = set()
        self._stream: torch.cuda.Stream | None = None
        self.recordings = 0
        self.mode, self.reason = self._choose(graphs, launches)
        if self._insisted and self.mode == "plain":
            raise HoigsError(f"train.graphs is on, but {self.reason}; set it to auto or off")

    def _choose(self, graphs: Graphs, launches: bool) -> tuple[Mode, str]:
        if graphs == "off":
            return "plain", "train.graphs is off"
        refused = why_not_recordable(self._model)
        if refused is not None:
            return "plain", refused
        if launches:
            return "cached", "asked for"
        if self._model.device.type != "cuda":
            return "plain", f"CUDA graphs need a CUDA device, the model is on {self._model.device}"
        return "graph", "every component is recordable"

    def __call__(self, moment: Moment) -> Deformed:
        """The scene at a moment, which is best left on the CPU."""
        if self.mode == "plain" or not (self._model.training and torch.is_grad_enabled()):
            return self._plain(moment)
        if self._stamp is None or not self._stamp.holds(self._model, moment):
            self._let_go()
            self._stamp = Stamp(self._model, moment)
            return self._plain(moment)
        if self._recording is None:
            self._record(moment, self._stamp)
            if self._recording is None:
                return self._plain(moment)
        # not pinned: CUDA has copied it before this returns, so that it may go at once
        self._row.copy_(self._stamp.layout.pack(moment), non_blocking=True)
        return self._assembled(self._recording())

    def _let_go(self) -> None:
        """Of a recording that no longer holds, when the device is done with it."""
        if self._recording is not None and self._stream is not None:
            torch.cuda.synchronize(self._stream.device)
        self._recording = None

    def _plain(self, moment: Moment) -> Deformed:
        return Deformed(self._model(moment.to(self._model.device)))

    def _assembled(self, values: dict[Key, Tensor]) -> Deformed:
        counted = values.pop(("penalties",), None)
        parts: dict[Key, dict[str, Any]] = {}
        for key, value in values.items():
            parts.setdefault(key[:-1], {})[key[-1]] = value
        gaussians = {n: Gaussians(**parts["gaussians", n]) for n in self._model.entities}
        residuals = {k[1]: Residual(**p) for k, p in parts.items() if k[0] == "residuals"}
        tokens = {k[1]: Tokens(**p) for k, p in parts.items() if k[0] == "tokens"}
        penalties: dict[str, dict[str, Tensor]] = {n: {} for n in gaussians}
        if counted is not None:
            for (name, penalty), term in zip(self._whole.counted, counted.unbind(), strict=True):
                penalties[name][penalty] = term
        joined = Gaussians(**parts["joined",])
        return Deformed(SceneState(gaussians, residuals, tokens, joined), penalties)

    def _record(self, moment: Moment, stamp: Stamp) -> None:
        """Record and, if this set of parts is new, compare; or be plain from now on."""
        trained = {
            f"scene.{name}": p for name, p in self._model.named_parameters() if p.requires_grad
        }
        self._row = stamp.layout.pack(moment).to(self._model.device)
        try:
            if self.mode == "graph" and self._stream is None:
                self._stream = torch.cuda.Stream(self._model.device)
            recording = Recording(self._recorded, trained, self._stream)
            failed = None
            if stamp.parts not in self._compared:
                failed = self._difference(recording, moment)
        except (RuntimeError, TypeError, ValueError, NotImplementedError) as error:
            # what CUDA or a component says of being recorded; raised or warned of below
            failed = _words(error)
        if failed is None:
            self._recording = recording
            self._compared.add(stamp.parts)
            self.recordings += 1
            return
        self.mode, self.reason = "plain", failed
        if self._insisted:
            raise HoigsError(f"train.graphs is on, but {failed}; set it to auto or off")
        warnings.warn(f"training goes on without CUDA graphs: {failed}", stacklevel=3)

    def _recorded(self, leaves: Mapping[str, Tensor]) -> dict[Key, Tensor]:
        assert self._stamp is not None
        dtype = next(iter(leaves.values())).dtype
        moment = self._stamp.layout.unpack(self._row, dtype)
        found: dict[Key, Tensor] = functional_call(self._whole, dict(leaves), (moment,))
        return found

    def _difference(self, recording: Recording, moment: Moment) -> str | None:
        """How values or gradients differ from the plain path's; None where they agree."""
        leaves = leaves_of(recording.parameters)
        plain = functional_call(self._whole, leaves, (moment.to(self._model.device),))
        turn = recording.replay()
        ours = {**recording.live, **recording.fixed}
        live = [key for key, value in plain.items() if value.requires_grad]
        if set(ours) != set(plain) or live != list(recording.live):
            return "a recording does not have the plain path's outputs"
        names = {" of ".join(key[::-1]): key for key in plain}
        pairs = {f"{n} of a recording": (ours[k], plain[k].detach()) for n, k in names.items()}
        differs = _differing(pairs, VALUES)
        if differs is not None:
            return differs
        generator = torch.Generator(self._model.device).manual_seed(0)  # not the run's own numbers
        asked = [
            torch.randn(plain[k].shape, dtype=plain[k].dtype, device=plain[k].device,
                        generator=generator)
            for k in live
        ]  # fmt: skip
        wanted = torch.autograd.grad(
            [plain[k] for k in live], list(leaves.values()), asked, allow_unused=True
        )
        found = recording.replay_backward(asked, turn)
        pairs = {}
        for name, mine, theirs in zip(leaves, found, wanted, strict=True):
            name = name.removeprefix("scene.")
            if (mine is None) != (theirs is None):
                return f"{name} has a gradient by the recording or by the plain path, not by both"
            if mine is not None and theirs is not None:
                pairs[f"the gradient of {name} by a recording"] = (mine, theirs)
        return _differing(pairs, GRADIENTS)


class _Whole(nn.Module):
    """What is recorded: a moment to named tensors.

    Attributes:
        counted: entity and name of each of the penalties in the last output.
    """

    def __init__(
        self, scene: SceneModel, weight_of: Callable[[str, str], float], restrained: bool
    ) -> None:
        super().__init__()
        self.scene, self._weight_of, self._restrained = scene, weight_of, restrained
        self.counted: list[tuple[str, str]] = []

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
        self.counted = list(penalties)
        if penalties:
            found["penalties",] = torch.stack(list(penalties.values()))
        return found


def _differing(pairs: Mapping[str, tuple[Tensor, Tensor]], allowed: float) -> str | None:
    """The first pair that differs by more than is allowed, in words; one answer of the device.

    Relative to each tensor's norm, and to a millionth of the largest, for those that are nothing
    but rounding.
    """
    if not pairs:
        return None
    rows = [torch.stack(((a - b).norm(), b.norm())).double() for a, b in pairs.values()]
    found = torch.stack(rows).tolist()
    floor = 1e-6 * max(size for _, size in found)
    for name, (apart, size) in zip(pairs, found, strict=True):
        if not apart <= allowed * size + floor:  # so with NaN too
            return f"{name} differs by {apart:.3g}, of {size:.3g}, from the plain path's"
    return None


def _words(error: BaseException) -> str:
    """The first cause, in its first line: what ends a capture is told again by all around it."""
    while error.__context__ is not None:
        error = error.__context__
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
