"""Trainer: fits a SceneModel to the training frames of a Clip and keeps the run folder."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from types import FrameType, TracebackType
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from hoigs.core.clip_folder.health import depth_factor
from hoigs.core.errors import CheckpointError, Interrupted
from hoigs.core.interfaces.deformation import DeformationModel, StepStatistics
from hoigs.core.interfaces.density import DensityControl, DensityStatistics, check_rasterizer
from hoigs.core.model.camera_refinement import CameraRefinement, check_camera_gradients
from hoigs.core.model.objective import Weighted
from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.train_schema import TrainSpec
from hoigs.core.system.random_state import repeatable_convolutions
from hoigs.core.system.threads import short_waits_when_busy
from hoigs.core.values.camera import Camera
from hoigs.core.values.clip import Clip, Frame
from hoigs.core.values.moment import Moment
from hoigs.metrics.lpips import Lpips
from hoigs.metrics.psnr import psnr, region_psnr
from hoigs.runs.checkpoint import FORMAT, VERSION, Checkpoint, restore_cameras, restore_model
from hoigs.runs.run_folder import RunFolder
from hoigs.training.checkpointing import CheckpointWriter, EpochSampler
from hoigs.training.density import EntityDensity, evolve
from hoigs.training.face import unwrap_faces
from hoigs.training.nan_guard import (
    NanGuard,
    first_not_finite,
    gradients_finite,
    require_finite_outputs,
)
from hoigs.training.objective import Extras, JointObjective, ObjectiveResult
from hoigs.training.optimizer import GroupedAdam, entity_extent
from hoigs.training.step_graph import StepGradients
from hoigs.training.time_windows import TimeWindows
from hoigs.training.unseen import Filling
from hoigs.training.views import TrainingViews

# What training reports of itself: logged steps, and PSNR of previews.

PREVIEWED = 4  # frames


@dataclass(frozen=True)
class StepReport:
    """One logged step: a line of `metrics.jsonl`, and the argument of `on_step`.

    Attributes:
        time_s: of training since the run began, previews aside. loss: the weighted sum.
        losses: unweighted terms. counts: Gaussians by entity. psnr: of previews by split, dB.
    """

    step: int
    time_s: float
    loss: float
    losses: dict[str, float]
    counts: dict[str, int]
    psnr: dict[str, float] = field(default_factory=dict)

    def record(self) -> dict[str, Any]:
        record = dict(vars(self))
        if not self.psnr:
            del record["psnr"]
        return record


@torch.no_grad()
def preview_scores(clip: Clip, draw: Callable[[Frame], Float[Tensor, "H W 3"]]) -> dict[str, float]:
    """PSNR of PREVIEWED frames of each split, in dB, for the curves of the report.

    Args:
        draw: the picture of a frame, by the model as it is now.
    """
    scores = {}
    for split, positions in clip.split.items():
        stride = max(1, len(positions) // PREVIEWED)
        values = []
        for position in list(positions)[::stride][:PREVIEWED]:
            frame = clip[position]
            color = draw(frame).cpu().clamp(0, 1)
            if frame.ignored is None:
                values.append(float(psnr(color, frame.rgb)))
            elif not frame.ignored.all():
                values.append(float(region_psnr(color, frame.rgb, ~frame.ignored)))
        if values:
            scores[split] = sum(values) / len(values)
    return scores


# StopRequest: Ctrl-C, SIGTERM and a closed terminal end a training after its present step.

SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)
)
NOTICE = b"\nstopping after this step, with a checkpoint; once more to stop at once\n"


class StopRequest:
    """Inside, the first SIGINT, SIGTERM or SIGHUP is kept in `signal`; a second one acts as usual.

    Python handles signals in the main thread alone; in another one nothing changes.

    Attributes:
        signal: number of the signal that came, or None.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.getsignal(number) for number in SIGNALS}
            for number, before in self._before.items():
                if before is not signal.SIG_IGN:  # nohup, or a shell's background job
                    signal.signal(number, self._request)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self._restore()

    def _request(self, number: int, _: FrameType | None) -> None:
        self.signal = number
        self._restore()
        with contextlib.suppress(OSError):  # the terminal may be gone
            os.write(2, NOTICE)  # print may be interrupted in the middle of its own buffer

    def _restore(self) -> None:
        for number, before in self._before.items():
            signal.signal(number, signal.SIG_DFL if before is None else before)
        self._before = {}


class Trainer:
    """The training loop: one frame a step, chosen by EpochSampler.

    Args:
        model: composed, on its device. clip: at training width.
        spec: the `train` section of a spec.
        density: controller by entity; entities without one keep their number of Gaussians.
        run: folder for metrics and checkpoints; None keeps everything in memory.
        identity: stored in checkpoints to recognise the spec (spec_name, model_hash).
        lpips: the network of the LPIPS term; needed if `spec.loss.lpips` > 0.

    Attributes:
        viewed: write checkpoints for a viewer too (`CheckpointWriter`).
        settled: the step after which people, objects and the interaction are done (`spec.passes`).

    Raises:
        SpecError: the rasterizer lacks a gradient that the density control or cameras need.
        ValueError: no LPIPS weights, no face, or no training frames where the spec needs them.
    """

    def __init__(
        self,
        model: SceneModel,
        clip: Clip,
        spec: TrainSpec,
        *,
        density: Mapping[str, DensityControl] | None = None,
        run: RunFolder | None = None,
        identity: Mapping[str, str] | None = None,
        lpips: Lpips | None = None,
        objectives: Sequence[Weighted] = (),
    ) -> None:
        if spec.loss.lpips > 0 and lpips is None:
            raise ValueError("train.loss.lpips > 0 needs LPIPS weights: give lpips=")
        self.model, self.clip, self.spec, self.run = model, clip, spec, run
        self.identity = dict(identity or {"spec_name": "", "model_hash": ""})
        self.hashes: Sequence[str] = (self.identity["model_hash"],)  # of checkpoints to resume from
        self.generator = torch.Generator().manual_seed(spec.seed)
        self.views = TrainingViews(clip, model.device)
        for control in (density or {}).values():
            check_rasterizer(control, model.rasterizer)
        # before a checkpoint is restored, so that a resumed run has the same texture
        faces = unwrap_faces(model, clip) if spec.loss.face > 0 else None
        self.cameras: CameraRefinement | None = None
        if spec.rates.camera > 0:
            check_camera_gradients(model.rasterizer)
            self.cameras = CameraRefinement.of(clip).to(model.device)
        scale = 1 / depth_factor(clip) if spec.loss.depth_fit == "auto" else 1.0
        extras = Extras(lpips, density, faces, self.cameras, scale, objectives)
        graphs = spec.graphs if spec.chunk is None else "off"
        self.objective = JointObjective(model, spec.loss, clip.depth_kind, extras, graphs)
        self.gradients = StepGradients(self.objective, graphs)
        scene_extent, frames = clip.extent(), clip.split["train"]
        self.settled = spec.steps
        if spec.passes is not None:
            self.settled = min(spec.steps, spec.passes * len(frames))
        self.optimizer = GroupedAdam(
            model, spec.rates, spec.warmup, scene_extent, self.cameras,
            steps=spec.steps, settled=self.settled,
        )  # fmt: skip
        self.windows = self._windows({n for n, c in (density or {}).items() if not c.keeps_all})
        self.sampler = EpochSampler(frames, self.generator)
        self.density = {
            name: EntityDensity(
                model.entity(name), control, entity_extent(model.entity(name), scene_extent)
            )
            for name, control in (density or {}).items()
            if not control.keeps_all
        }
        self.unseen = Filling(spec, self.settled)
        self.guard = NanGuard()
        self.viewed = False
        self.step = 0
        self.elapsed = 0.0

    def _windows(self, fixed: set[str]) -> TimeWindows | None:
        if self.spec.chunk is None:
            return None
        folder = None if self.run is None else self.run.windows
        frames = self.clip.num_frames
        return TimeWindows(self.model, self.optimizer, frames, self.spec.chunk, fixed, folder)

    @short_waits_when_busy()
    @repeatable_convolutions()  # those of LPIPS
    def train(
        self, on_step: Callable[[StepReport], object] | None = None, *, until: int | None = None
    ) -> None:
        """Train to `spec.steps`, writing metrics and checkpoints.

        With a run folder, the first Ctrl-C, SIGTERM or SIGHUP ends the present step and writes a
        checkpoint; a second one stops at once.

        Args:
            until: stop after this step; another call continues. Schedules depend on `spec.steps`
                alone.

        Raises:
            NotFiniteError: see `NanGuard`.
            Interrupted: stopped by a signal; the message has the command that continues.
        """
        whole = nullcontext() if self.windows is None else self.windows.opened(self.spec.steps)
        if self.run is None:
            with whole:
                self._steps(on_step, until, None)
            return
        with StopRequest() as stop, whole:
            self._steps(on_step, until, stop)

    def _steps(
        self,
        on_step: Callable[[StepReport], object] | None,
        until: int | None,
        stop: StopRequest | None,
    ) -> None:
        end = self.spec.steps if until is None else min(until, self.spec.steps)
        writer = None
        if self.run is not None:
            writer = CheckpointWriter(self.run, self.spec, self.checkpoint, self.viewed)
        self.model.train()
        started = time.perf_counter() - self.elapsed
        while self.step < end:
            result = self._step()
            self.elapsed = time.perf_counter() - started
            report = self._report(result)
            started = time.perf_counter() - self.elapsed  # previews do not count
            if report is not None:
                if self.run is not None:
                    self.run.log(report.record())
                if on_step is not None:
                    on_step(report)
            if self.step == self.spec.steps:
                self.guard.require_any(self.step)
            signal = None if stop is None else stop.signal
            if writer is not None:
                writer.after(self.step, signal is not None)
            if self.run is not None and signal is not None and self.step < end:
                out = shlex.quote(str(self.run.path))
                raise Interrupted(
                    f"stopped at step {self.step} of {self.spec.steps}; continue with: "
                    f"hoigs train --resume --out {out}",
                    signal,
                )
        self.model.eval()
        self.model.set_progress(self.step / self.spec.steps)

    def _step(self) -> dict[str, torch.Tensor] | None:
        """One optimizer step: its loss terms and their "total"; None if the guard skipped it.

        No reference to the autograd graph may leave this method: a graph keeps the shapes of its
        parameters, and density control changes them. The terms stay on the device, since most steps
        report none.
        """
        progress = self.step / self.spec.steps
        self.step += 1
        warming = self.spec.warmup.interaction * self.settled
        self.model.interaction_enabled = self.step - 1 >= warming
        self.objective.settled = self.step > self.settled
        self.optimizer.set_progress(progress)
        self.model.set_progress(progress)
        view = self.views[self.sampler.next()]
        camera = self._camera(view.frame)
        self.optimizer.zero_grad()
        result = self.gradients(view, camera, self.generator)
        logged = self.step in (1, self.spec.steps) or self.step % self.spec.log_every == 0
        if logged:
            require_finite_outputs(self.model, result.state)
        if not self._finite(result, wait=logged):
            self.optimizer.zero_grad()
            return None
        self.unseen.spare(self.model)
        interval = self.spec.sh_interval
        self.optimizer.step(None if interval is None else self.step // interval, result.finite)
        if self.windows is not None:
            self.windows.stepped()
        fixed = replace(camera, world_to_camera=camera.world_to_camera.detach())
        self._evolve(result, view.frame.moment, fixed)
        self._refine(result, camera.width, camera.height)
        self.unseen.after(self.step, self.model, self.clip)
        terms = {**result.terms, "total": result.total}
        return {name: term.detach() for name, term in terms.items()}

    def _finite(self, result: ObjectiveResult, wait: bool) -> bool:
        """Whether the step may be taken. Where the device skips it by itself, the guard is told of
        that later, or at once if it is to wait."""

        def culprit() -> str | None:
            return first_not_finite(result.terms, result.state.gaussians, self.optimizer.names)

        if result.finite is not None:
            self.guard.watch(self.step, result.finite)
            return self.guard.read(culprit, wait) or not wait
        self.guard.read(culprit, wait=True)
        if gradients_finite(self.optimizer.names):
            self.guard.passed()
            return True
        self.guard.failed(self.step, culprit() or "a gradient")
        return False

    def _camera(self, frame: Frame) -> Camera:
        """The frame's camera on the model's device, with its present corrections."""
        camera = frame.camera.to(self.model.device)
        return camera if self.cameras is None else self.cameras(camera, frame.position)

    def _evolve(self, result: ObjectiveResult, moment: Moment, camera: Camera) -> None:
        """Call `evolve` of the deformations that override it."""
        gradient, radii = result.screen_offsets.grad, result.composite.info["radii"]
        for name, row in result.state.slices().items():
            entity = self.model.entity(name)
            if type(entity.deformation).evolve is DeformationModel.evolve or self._done(name):
                continue
            own = result.terms.get(f"{entity.kind}/{name}")
            if own is None:
                own = result.terms.get("scene", result.terms.get("scene/masked"))
            statistics = StepStatistics(
                moment.to(self.model.device, non_blocking=True),
                camera,
                own.detach() if own is not None else result.total.new_zeros(()),
                gradient[row] if gradient is not None else None,
                radii[row],
                self.step,
                self.spec.steps,
            )
            evolve(entity, statistics, self.optimizer)

    def _refine(self, result: ObjectiveResult, width: int, height: int) -> None:
        """Update the statistics of density control, and apply its decisions."""
        gradient, absolute = result.screen_offsets.grad, None
        if result.absolute_gradients is not None:
            absolute = result.absolute_gradients.grad
        radii = result.composite.info["radii"]
        rows = result.state.slices()
        for name, density in self.density.items():
            if self._done(name):
                continue
            row = rows[name]
            if gradient is not None:
                mine = None if absolute is None else absolute[row]
                density.statistics.add(
                    gradient[row], radii[row], width, height, absolute_gradient=mine,
                    loss=result.total.detach(),
                )  # fmt: skip
            density.refine(result.state.gaussians[name], self.optimizer, self.step, self.spec.steps)
            rate = self.optimizer.position_rate(name)
            density.perturb(self.step, self.spec.steps, rate)

    def _done(self, name: str) -> bool:
        """Whether an entity changes no more."""
        return self.step > self.settled and self.model.entity(name).kind != "scene"

    def _report(self, terms: dict[str, torch.Tensor] | None) -> StepReport | None:
        last = self.step == self.spec.steps
        preview = self.spec.preview_every
        scored = preview > 0 and (last or self.step % preview == 0 or self.step == 1)
        if terms is None or not (scored or last or self.step % self.spec.log_every == 0):
            return None
        # one transfer from the device for all terms
        values = torch.stack([term.reshape(()) for term in terms.values()]).tolist()
        losses = dict(zip(terms, values, strict=True))
        total = losses.pop("total")
        return StepReport(
            step=self.step,
            time_s=round(self.elapsed, 3),
            loss=total,
            losses=losses,
            counts=self.model.count(),
            psnr=preview_scores(self.clip, self._draw) if scored else {},
        )

    def _draw(self, frame: Frame) -> torch.Tensor:
        moment = frame.moment.to(self.model.device)
        return self.model.render(moment, self._camera(frame)).color

    def checkpoint(self) -> Checkpoint:
        """The complete state of training; see Checkpoint."""
        windows = self.windows
        files = {} if windows is None else windows.files(finished=self.step == self.spec.steps)
        tensors = {f"model.{k}": v for k, v in self.model.state_dict().items()}
        tensors |= {f"optimizer.{k}": v for k, v in self.optimizer.tensors().items()}
        for name, density in self.density.items():
            tensors |= {f"density.{name}.{k}": v for k, v in vars(density.statistics).items()}
        if self.cameras is not None:
            tensors |= {f"cameras.{k}": v for k, v in self.cameras.state_dict().items()}
        if windows is not None:
            tensors |= {f"windows.{k}": v for k, v in windows.state().items()}
        tensors |= {f"hidden.{k}": v for k, v in self.unseen.hidden.items()}
        tensors["rng.generator"] = self.generator.get_state()
        tensors["rng.torch"] = torch.get_rng_state()
        meta = {
            "format": FORMAT,
            "version": VERSION,
            "step": self.step,
            "time_s": self.elapsed,
            "counts": self.model.count(),
            "sampler": self.sampler.state(),
            "skipped": self.guard.skipped,
            **self.identity,
        }
        return Checkpoint(tensors, meta, files)

    def resume(self, checkpoint: Checkpoint) -> None:
        """Restore a checkpoint; the rest of the run then equals an unbroken one.

        Raises:
            CheckpointError: it belongs to another spec or clip, is damaged, or holds a model alone.
        """
        it = f"the checkpoint of step {checkpoint.meta['step']}"
        if not checkpoint.part("optimizer"):
            raise CheckpointError(
                f"{it} was pruned or compressed: it has a model, but no optimizer state to resume "
                "with"
            )
        try:
            self._restore(checkpoint)
        except (KeyError, RuntimeError, TypeError, ValueError, AttributeError) as error:
            raise CheckpointError(f"{it} is damaged: {error}") from error
        if self.run is not None:
            self.run.cut_metrics(self.step)

    def _restore(self, checkpoint: Checkpoint) -> None:
        device = self.model.device
        restore_model(self.model, checkpoint, self.hashes)
        restore_cameras(self.cameras, checkpoint)
        self.optimizer.load_tensors(checkpoint.part("optimizer"))
        for name, density in self.density.items():
            density.statistics = DensityStatistics.zeros(len(density.entity), device)
            for key, value in checkpoint.part(f"density.{name}").items():
                setattr(density.statistics, key, value.to(device).clone())
        hidden = checkpoint.part("hidden")
        self.unseen.hidden = {name: kept.to(device) for name, kept in hidden.items()}
        self.generator.set_state(checkpoint.tensors["rng.generator"])
        torch.set_rng_state(checkpoint.tensors["rng.torch"])
        self.sampler.load(checkpoint.meta["sampler"])
        if self.windows is not None:
            self.windows.load(checkpoint.part("windows"))
        self.step, self.elapsed = checkpoint.meta["step"], checkpoint.meta["time_s"]
