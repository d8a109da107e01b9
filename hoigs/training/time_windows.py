"""Training in windows: of parameters with rows for times of the clip, those of one are in memory.

A parameter that has rows for times (`hoigs.core.parameters.TimeRows`) grows with the clip, and with
it its gradient and two moments of Adam. A step reads the rows about one time. So the clip's time is
cut into windows; before a step the rows of its frame's window, with their moments, are read from
files, and after it they are written there. Frames come in the order in which they would come
without windows, as several in a row from one part of the clip would pull the scene towards it.

Without windows Adam would go on to move the rows of the other windows, by their moments. Those
moves, of gradients that are zero, are made up for when rows are read again (`_caught_up`). What is
left are penalties of these parameters, which see one window at a time. Neighbouring windows share
the rows about the time where they meet, so nothing has to be joined: the model is one function of
time, and a checkpoint is that of an ordinary training.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from hoigs.core.model.scene import SceneModel
from hoigs.core.parameters import TimeRows, timed_parameters
from hoigs.core.system.tensor_files import TensorFile
from hoigs.core.values.moment import Moment
from hoigs.training.optimizer import GroupedAdam, Schedule

MOMENTS = ("exp_avg", "exp_avg_sq")
BETAS = 0.9, 0.999  # of Adam
FADED = 120  # steps without a gradient after which a moment moves nothing any more


@dataclass(frozen=True)
class _Paged:
    """A parameter, its rows, and the files of its values and moments.

    Attributes:
        last: of each row, the number of optimizer steps that its values and moments have seen.
    """

    parameter: nn.Parameter
    rows: TimeRows
    values: TensorFile
    moments: dict[str, TensorFile]
    last: Int[np.ndarray, " T"]


class TimeWindows:
    """The windows of one training.

    Args:
        frames: of the clip. chunk: of a window, at most.
        fixed: entities whose number of Gaussians changes in training; their parameters with a row
            for each Gaussian stay whole.
        folder: for the files, made and removed by `opened`; None: the system's temporary one.

    Attributes:
        names: of the parameters that are cut. done: optimizer steps.
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
        self.chunk, self.count, self.done = chunk, max(1, -(-frames // chunk)), 0
        self._end = 1  # the last step
        self._rows = dict(_rows_of(model, fixed)) if self.count > 1 else {}
        self.names = [name for name in self._rows if name in optimizer.names]
        self._last: dict[str, np.ndarray] = {}
        self._paged: dict[str, _Paged] = {}
        self._present: int | None = None

    def sentence(self) -> str:
        """How the clip is trained, for people."""
        if self.names:
            return (
                f"trained in {self.count} windows of at most {self.chunk} frames: of "
                f"{len(self.names)} parameters that grow with the clip, one window's rows are in "
                "memory"
            )
        why = "no parameter of this model grows with the clip"
        if self.count == 1:
            why = f"all frames fit in one window of {self.chunk}"
        return f"trained at once: {why}"

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
        self._end = end
        hook = self.model.register_forward_pre_hook(self._before_forward, with_kwargs=True)
        try:
            self._write(folder)
            yield
            self._catch_up()
        finally:
            hook.remove()
            self._whole(self.done < end)
            self._paged = {}
            shutil.rmtree(folder, ignore_errors=True)

    def stepped(self) -> None:
        """Count an optimizer step."""
        self.done += 1

    def files(self, finished: bool) -> dict[str, TensorFile]:
        """What a checkpoint holds of these parameters: their whole values and moments.

        Args:
            finished: after the last step, whose model is used: all windows are brought up to it.
        """
        if finished:
            self._catch_up()
        self._leave()
        found: dict[str, TensorFile] = {}
        for name, paged in self._paged.items():
            found[f"model.{name}"] = paged.values
            found |= {f"optimizer.{name}.{key}": file for key, file in paged.moments.items()}
        return found

    def state(self) -> dict[str, Tensor]:
        """Of each parameter, the steps that its rows have seen; to be called after `files`."""
        return {name: torch.from_numpy(p.last.copy()) for name, p in self._paged.items()}

    def load(self, state: dict[str, Tensor]) -> None:
        """Of a checkpoint; empty of a training without windows."""
        self._last = {name: last.numpy().copy() for name, last in state.items()}

    def _before_forward(self, _: nn.Module, given: tuple[Any, ...], named: dict[str, Any]) -> None:
        moment: Moment = given[0] if given else named["moment"]
        window = min(max(int(float(moment.time) * self.count), 0), self.count - 1)
        if self._paged:
            self._enter(window)

    def _about(self, rows: TimeRows, window: int) -> slice:
        return rows.about(window / self.count, (window + 1) / self.count)

    @torch.no_grad()
    def _write(self, folder: Path) -> None:
        for number, name in enumerate(self.names):
            parameter, rows = self.optimizer.names[name], self._rows[name]
            shape, state = tuple(parameter.shape), self.optimizer.adam.state.pop(parameter, {})
            files = {
                key: TensorFile(folder / f"{number}.{key}", shape) for key in ("values", *MOMENTS)
            }
            values = files.pop("values")
            values.write(parameter)
            for key, file in files.items():
                file.write(state[key]) if key in state else file.zero()
            self.done = max(self.done, int(state.get("step", 0)))
            last = self._last.get(name)
            if last is None:
                last = np.full(rows.count, self.done, np.int64)
            self._paged[name] = _Paged(parameter, rows, values, files, last)
        self._last = {}

    @torch.no_grad()
    def _enter(self, window: int) -> None:
        """Take the rows of a window into memory, in place of others."""
        if window == self._present:
            return
        self._leave()
        for name, paged in self._paged.items():
            rates = partial(self._rates, self.optimizer.schedule_of(name))
            parameter, rows = paged.parameter, self._about(paged.rows, window)
            paged.rows.first, parameter.grad = rows.start, None
            device = parameter.device
            values, mean, square = (
                file.read(rows).to(device) for file in (paged.values, *paged.moments.values())
            )
            parameter.data, mean, square = _caught_up(
                values, mean, square, paged.last[rows], self.done, rates
            )
            self.optimizer.adam.state[parameter] = {
                "step": torch.tensor(float(self.done), device=device),
                "exp_avg": mean,
                "exp_avg_sq": square,
            }
        self._present = window

    def _rates(self, schedule: Schedule, steps: Int[np.ndarray, "S R"]) -> Float[np.ndarray, "S R"]:
        """Learning rates of steps by their numbers, from 1."""
        numbers, places = np.unique(steps, return_inverse=True)  # most rows missed the same steps
        rates = np.array([schedule.at((number - 1) / self._end) for number in numbers])
        return rates[places.reshape(steps.shape)]

    @torch.no_grad()
    def _leave(self) -> None:
        """Write the present rows to their files; they stay in memory, too."""
        if self._present is None:
            return
        for paged in self._paged.values():
            rows = self._about(paged.rows, self._present)
            paged.values.write(paged.parameter, rows)
            for key, file in paged.moments.items():
                file.write(self.optimizer.adam.state[paged.parameter][key], rows)
            paged.last[rows] = self.done

    def _catch_up(self) -> None:
        for window in range(self.count):
            self._enter(window)

    @torch.no_grad()
    def _whole(self, moments: bool) -> None:
        self._leave()
        for name, paged in self._paged.items():
            parameter, paged.rows.first = paged.parameter, 0
            parameter.grad, device = None, parameter.device
            parameter.data = paged.values.read().to(device)
            self.optimizer.adam.state.pop(parameter, None)
            if moments and self.done:
                self.optimizer.adam.state[parameter] = {
                    "step": torch.tensor(float(self.done), device=device),
                    **{k: file.read().to(device) for k, file in paged.moments.items()},
                }
                self._last[name] = paged.last
        self._present = None


def _caught_up(
    values: Float[Tensor, "A R *rest"],
    mean: Float[Tensor, "A R *rest"],
    square: Float[Tensor, "A R *rest"],
    last: Int[np.ndarray, " R"],
    done: int,
    rates: Callable[[Int[np.ndarray, "S R"]], Float[np.ndarray, "S R"]],
) -> tuple[Tensor, Tensor, Tensor]:
    """Rows and their moments after steps of Adam without a gradient.

    Args:
        last: steps that each row has seen. done: steps to be seen. rates: learning rates of steps
            by their numbers, from 1.
    """
    missed = (done - last).astype(np.float64)
    if not missed.any():
        return values, mean, square
    first, second = BETAS
    step = np.arange(1, FADED + 1)[:, None]
    at = np.maximum(last, 1) + step
    moves = first**step / second ** (step / 2) * np.sqrt(1 - second**at) / (1 - first**at)
    moved = np.where(step <= missed, moves * rates(last + step), 0).sum(0)

    def by_row(factors: Float[np.ndarray, " R"]) -> Tensor:
        return torch.from_numpy(factors).to(values).reshape(1, -1, *[1] * (values.dim() - 2))

    values = values - by_row(moved) * mean / (square.sqrt() + 1e-15)
    return values, mean * by_row(first**missed), square * by_row(second**missed)


def _rows_of(model: SceneModel, fixed: Collection[str]) -> Iterator[tuple[str, TimeRows]]:
    """Every parameter that has rows for times, but for those of `fixed` with one a Gaussian."""
    whole = {
        f"entities.{entity}.{name}"
        for entity in fixed
        for name, _ in model.entity(entity).per_gaussian()
    }
    for name, rows in timed_parameters(model):
        if name not in whole and rows.count > 1:
            yield name, rows
