"""Training in windows: of parameters with rows for times of the clip, those of one are in memory.

A parameter that has rows for times (`hoigs.core.time_rows.TimeRows`) grows with the clip, and with
it its gradient and two moments of Adam. A step reads the rows about one time. So the clip's time is
cut into windows, training visits one after the other (`WindowSampler`), and the rows of the others,
with their moments, lie in files. Neighbouring windows share the rows about the time where they
meet, so that nothing has to be joined: the model is one function of time, as without windows.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import nn

from hoigs.core.model.scene import SceneModel
from hoigs.core.storage.tensor_files import TensorFile
from hoigs.core.time_rows import TimeRows
from hoigs.core.values.moment import Moment
from hoigs.training.optimizer import GroupedAdam

MOMENTS = ("exp_avg", "exp_avg_sq")
ROUNDS = 10  # in which training visits all windows, at least, where it has the steps


@dataclass(frozen=True)
class _Paged:
    """A parameter, its rows, and the files of its values and moments."""

    parameter: nn.Parameter
    rows: TimeRows
    values: TensorFile
    moments: dict[str, TensorFile]


class TimeWindows:
    """The windows of one training.

    Args:
        frames: of the clip. chunk: of a window, at most.
        fixed: entities whose number of Gaussians changes in training; their parameters with a row
            for each Gaussian stay whole.
        folder: for the files, made and removed by `opened`; None: the system's temporary one.

    Attributes:
        names: of the parameters that are cut. steps: that each window has had.
    """

    def __init__(
        self,
        model: SceneModel,
        optimizer: GroupedAdam,
        frames: int,
        chunk: int,
        fixed: Collection[str] = (),
        folder: Path | None = None,
    ) -> None:
        self.model, self.optimizer, self.folder = model, optimizer, folder
        self.chunk, self.count = chunk, max(1, -(-frames // chunk))
        self.steps = [0] * self.count
        self._rows = dict(_rows_of(model, fixed)) if self.count > 1 else {}
        self.names = [name for name in self._rows if name in optimizer.names]
        self._paged: dict[str, _Paged] = {}
        self._present: int | None = None

    def sentence(self) -> str:
        """How the clip is trained, for people."""
        if self.names:
            return (
                f"trained in {self.count} windows of at most {self.chunk} frames, by turns: of "
                f"{len(self.names)} parameters that grow with the clip, one window's rows are in "
                "memory"
            )
        why = "no parameter of this model grows with the clip"
        if self.count == 1:
            why = f"all frames fit in one window of {self.chunk}"
        return f"trained at once: {why}"

    def of(self, time: float) -> int:
        """The window of a time in [0, 1]."""
        return min(max(int(time * self.count), 0), self.count - 1)

    @contextmanager
    def opened(self, end: int) -> Iterator[None]:
        """Parameters hold the rows of the window that the model was last called in; whole again
        after the block.

        Args:
            end: the last step: after it the moments are not read again.
        """
        if not self.names:
            yield
            return
        if self.folder is None:
            folder = Path(tempfile.mkdtemp(prefix="hoigs-windows-"))
        else:
            folder = self.folder
            shutil.rmtree(folder, ignore_errors=True)  # of a killed training
            folder.mkdir()
        hook = self.model.register_forward_pre_hook(
            lambda _, given, named: self.enter(
                float((given[0] if given else named["moment"]).time)
            ),
            with_kwargs=True,
        )
        try:
            self._write(folder)
            yield
            self._whole(sum(self.steps) < end)
        finally:
            hook.remove()
            self._paged, self._present = {}, None
            shutil.rmtree(folder, ignore_errors=True)

    def _before_forward(self, _: nn.Module, given: tuple[Any, ...], named: dict[str, Any]) -> None:
        moment: Moment = given[0] if given else named["moment"]
        self.enter(float(moment.time))

    def enter(self, time: float) -> None:
        """Take the rows about a time into memory, in place of others."""
        window = self.of(time)
        if window == self._present:
            return
        self._leave()
        for paged in self._paged.values():
            rows = self._about(paged.rows, window)
            paged.rows.first = rows.start
            parameter, steps = paged.parameter, self.steps[window]
            parameter.grad, device = None, parameter.device
            parameter.data = paged.values.read(rows).to(device)
            self.optimizer.adam.state[parameter] = {
                "step": torch.tensor(float(steps), device=device),
                **{
                    key: file.read(rows).to(device) if steps else torch.zeros_like(parameter)
                    for key, file in paged.moments.items()
                },
            }
        self._present = window

    def stepped(self) -> None:
        """Count an optimizer step of the present window."""
        if self._present is not None:
            self.steps[self._present] += 1

    def files(self) -> dict[str, TensorFile]:
        """What a checkpoint holds of these parameters: their whole values and moments."""
        self._leave()
        found: dict[str, TensorFile] = {}
        for name, paged in self._paged.items():
            found[f"model.{name}"] = paged.values
            found |= {f"optimizer.{name}.{key}": file for key, file in paged.moments.items()}
        return found

    def state(self) -> dict[str, Any]:
        return {"chunk": self.chunk, "steps": list(self.steps)}

    def load(self, state: dict[str, Any] | None, step: int) -> None:
        """Of a checkpoint of `step` steps, which may be of a training with other windows."""
        same = state is not None and len(state["steps"]) == self.count
        self.steps = [int(n) for n in state["steps"]] if state and same else [step] * self.count

    def _about(self, rows: TimeRows, window: int) -> slice:
        return rows.about(window / self.count, (window + 1) / self.count)

    @torch.no_grad()
    def _write(self, folder: Path) -> None:
        for number, name in enumerate(self.names):
            parameter = self.optimizer.names[name]
            shape, state = tuple(parameter.shape), self.optimizer.adam.state.pop(parameter, {})
            files = {
                key: TensorFile(folder / f"{number}.{key}", shape) for key in ("values", *MOMENTS)
            }
            values = files.pop("values")
            values.write(parameter)
            for key, file in files.items():
                file.write(state[key]) if key in state else file.zero()
            self._paged[name] = _Paged(parameter, self._rows[name], values, files)
        self.enter(0.0)

    @torch.no_grad()
    def _leave(self) -> None:
        """Write the present rows to their files; they stay in memory, too."""
        if self._present is None or not self.steps[self._present]:
            return
        for paged in self._paged.values():
            rows = self._about(paged.rows, self._present)
            paged.values.write(paged.parameter, rows)
            state = self.optimizer.adam.state.get(paged.parameter, {})
            for key, file in paged.moments.items():
                if key in state:
                    file.write(state[key], rows)

    @torch.no_grad()
    def _whole(self, moments: bool) -> None:
        self._leave()
        for paged in self._paged.values():
            parameter = paged.parameter
            parameter.grad, paged.rows.first = None, 0
            parameter.data = paged.values.read().to(parameter.device)
            self.optimizer.adam.state.pop(parameter, None)
            if moments and any(self.steps):
                self.optimizer.adam.state[parameter] = {
                    "step": torch.tensor(float(sum(self.steps)), device=parameter.device),
                    **{k: file.read().to(parameter.device) for k, file in paged.moments.items()},
                }


def _rows_of(model: SceneModel, fixed: Collection[str]) -> Iterator[tuple[str, TimeRows]]:
    """Every parameter that has rows for times, but for those of `fixed` with one a Gaussian."""
    whole = {
        f"entities.{entity}.{name}"
        for entity in fixed
        for name, _ in model.entity(entity).per_gaussian()
    }
    for path, module in model.named_modules():
        for name, rows in getattr(module, "time_rows", {}).items():
            full = f"{path}.{name}"
            if full not in whole and rows.count > 1:
                yield full, rows


class WindowSampler:
    """Every window a round, in a new order; in a visit several of its frames, in an order of its
    own, which goes on where the visit before it ended. A checkpoint holds its state.

    Args:
        positions: of the frames to train on, by window.
        steps: of the training.

    Raises:
        ValueError: there are no positions.
    """

    def __init__(
        self, positions: Sequence[Sequence[int]], steps: int, generator: torch.Generator
    ) -> None:
        self.positions = [list(some) for some in positions if some]
        if not self.positions:
            raise ValueError("no frames to train on: the clip's split has no 'train' positions")
        self.generator = generator
        self.visit = max(1, steps // (ROUNDS * len(self.positions)))
        self.queue: list[int] = []
        self.waiting: list[list[int]] = [[] for _ in self.positions]

    def next(self) -> int:
        if not self.queue:
            for window in self._shuffled(range(len(self.positions))):
                self.queue += [self._of(window) for _ in range(self._length(window))]
            self.queue.reverse()
        return self.queue.pop()

    def _length(self, window: int) -> int:
        """Frames of a visit: as many as the window has of all."""
        share = len(self.positions[window]) * len(self.positions) / sum(map(len, self.positions))
        return max(1, round(self.visit * share))

    def _of(self, window: int) -> int:
        if not self.waiting[window]:
            self.waiting[window] = self._shuffled(self.positions[window])
        return self.waiting[window].pop()

    def _shuffled(self, values: Sequence[int]) -> list[int]:
        order = torch.randperm(len(values), generator=self.generator).tolist()
        return [values[i] for i in order]

    def state(self) -> dict[str, Any]:
        return {"queue": list(self.queue), "windows": [list(some) for some in self.waiting]}

    def load(self, state: dict[str, Any]) -> None:
        windows = state.get("windows", [])
        known = {p for some in self.positions for p in some}
        unknown = sorted({*state["queue"], *(p for some in windows for p in some)} - known)
        if unknown:
            raise ValueError(f"frames {unknown[:5]} are not among those that are trained on")
        if len(windows) == len(self.positions):
            self.queue, self.waiting = list(state["queue"]), [list(some) for some in windows]
