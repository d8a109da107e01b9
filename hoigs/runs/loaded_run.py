"""LoadedRun: a run folder read back, with its clip and its trained model."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from hoigs.core.errors import CheckpointError, HoigsError
from hoigs.core.model.camera_refinement import CameraRefinement
from hoigs.core.model.compose import compose
from hoigs.core.model.scene import SceneModel
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.core.spec.schema import Spec
from hoigs.core.system.random_state import callers_random_state
from hoigs.core.values.clip import Clip
from hoigs.runs.checkpoint import load_newest, restore_cameras, restore_model
from hoigs.runs.choices import pick_device, with_rasterizer
from hoigs.runs.clip_source import clip_folder, read_clip, recorded_folder, recorded_reader
from hoigs.runs.kept_clip import load_kept
from hoigs.runs.resuming import load_spec
from hoigs.runs.run_folder import RunFolder

DRAWN = ("model", "cameras")  # what is read of a checkpoint: moments are three times as large


@dataclass(frozen=True)
class LoadedRun:
    """A run read back: its spec, its clip at training width and its model in eval mode.

    Attributes:
        clip: with the refined cameras, if training refined them. step: of the newest checkpoint.
    """

    spec: Spec
    clip: Clip
    model: SceneModel
    step: int
    provenance: dict[str, Any]

    @classmethod
    @callers_random_state()
    def open(
        cls,
        path: Path | str,
        *,
        clip: Path | str | None = None,
        rasterizer: str | None = None,
        device: str = "cpu",
        plugins: Sequence[Path | str] = (),
        pixels: bool = True,
    ) -> LoadedRun:
        """Read a run folder.

        Args:
            clip: in place of the one that it was trained on, a folder or "builtin:NAME".
            rasterizer: in place of the spec's. device: "cpu", "cuda" or "auto".
            plugins: Python files to load (and run) first.
            pixels: whether the clip's images will be needed. If not, a run whose clip is gone is
                opened with the cameras and poses that it keeps.

        Raises:
            HoigsError: this is no run, it is damaged, or its clip is not there.
        """
        path = Path(path)
        run = RunFolder(path)
        run.require()
        registry = default_registry(plugin_files=plugins)
        device, changes = pick_device(device), with_rasterizer((), rasterizer)
        spec = load_spec(run.spec, changes, registry)
        provenance = run.read_provenance()
        torch.manual_seed(spec.train.seed)
        gone = clip is None and not (path / provenance["clip"]["path"]).is_dir()
        if gone and not pixels and run.kept_clip.is_file():
            source = load_kept(run.kept_clip)
        else:
            source = _clip_of(path, provenance, clip, spec.train.width, registry)
        checkpoint = load_newest(run.checkpoints, DRAWN)
        model = compose(spec, source, registry)
        ended = checkpoint.meta["step"] >= spec.train.steps  # or else training removes old ones
        restore_model(model, checkpoint, spec.model_hashes(), in_file=ended)
        _try(model, source, run.checkpoints)
        model.to(device)
        if checkpoint.part("cameras"):
            refinement = CameraRefinement.of(source)
            restore_cameras(refinement, checkpoint)
            source = refinement.refined(source)
        model.eval()
        model.set_progress(min(1.0, checkpoint.meta["step"] / spec.train.steps))
        return cls(spec, source, model, checkpoint.meta["step"], provenance)

    def newer(self, path: Path) -> LoadedRun:
        """This run at the newest checkpoint, without reading the spec and the clip again.

        Raises:
            HoigsError: the checkpoint is damaged, belongs to another spec or refines cameras.
        """
        checkpoint = load_newest(RunFolder(path).checkpoints, DRAWN)
        if checkpoint.part("cameras"):
            raise HoigsError(f"{path}: with refined cameras the clip has to be read again")
        model = copy.deepcopy(self.model)
        restore_model(model, checkpoint, self.spec.model_hashes())
        model.eval()
        step = checkpoint.meta["step"]
        model.set_progress(min(1.0, step / self.spec.train.steps))
        return replace(self, model=model, step=step)


def _clip_of(
    path: Path,
    provenance: dict[str, Any],
    clip: Path | str | None,
    width: int | None,
    registry: Registry,
) -> Clip:
    """The clip of a run with its pixels, or another one that was named."""
    if clip is None:
        folder = recorded_folder(path, provenance, registry)
    else:
        folder = clip_folder(clip, registry)
    allowed = bool(provenance.get("allow_faults"))
    recorded = provenance["clip"].get("reader") if clip is None else None
    choice = recorded_reader(recorded, path, folder, registry) if recorded else None
    return read_clip(folder, registry, width, allow_faults=allowed, reader=choice)


@torch.no_grad()
def _try(model: SceneModel, clip: Clip, checkpoints: Path) -> None:
    """Compute one moment of a restored model: its stored indices may point anywhere.

    Raises:
        CheckpointError: that fails.
    """
    integers = any(not v.is_floating_point() and v.numel() for v in model.state_dict().values())
    if not integers:
        return
    try:
        model(clip.moments[0])
    except (IndexError, RuntimeError, ValueError) as error:
        raise CheckpointError(
            f"{checkpoints}: the newest checkpoint is damaged: its model cannot be computed "
            f"({str(error).splitlines()[0]})"
        ) from error


def open_run(
    run: Path | str,
    *,
    clip: Path | str | None = None,
    rasterizer: str | None = None,
    device: str = "auto",
    plugins: Sequence[Path | str] = (),
) -> LoadedRun:
    """`LoadedRun.open` on CUDA where available."""
    return LoadedRun.open(run, clip=clip, rasterizer=rasterizer, device=device, plugins=plugins)
