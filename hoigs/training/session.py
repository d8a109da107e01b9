"""Session: from a command line to a Trainer; all input is checked before a file is made."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from hoigs.core.clip import Clip
from hoigs.core.clip_health import examine
from hoigs.core.compose import compose, compose_density
from hoigs.core.errors import HoigsError
from hoigs.core.fault import Fault
from hoigs.core.registry import Registry, default_registry
from hoigs.core.scene import SceneModel
from hoigs.core.spec import Spec
from hoigs.evaluation.lpips import Lpips, find_weights
from hoigs.training.camera_refinement import CameraRefinement
from hoigs.training.checkpoint import (
    has_checkpoint,
    latest_checkpoint,
    load_checkpoint,
    restore_cameras,
    restore_model,
)
from hoigs.training.clip_source import clip_folder, require_folder
from hoigs.training.reader_choice import ReaderChoice, choose_reader, recorded_reader
from hoigs.training.resuming import (
    DEFAULT_SPEC,
    changes_of,
    clip_and_reader,
    default_out,
    own_spec,
)
from hoigs.training.run_folder import RunFolder, versions
from hoigs.training.trainer import StepReport, Trainer


def read_clip(
    folder: Path | str,
    registry: Registry | None = None,
    width: int | None = None,
    *,
    allow_faults: bool = False,
    reader: ReaderChoice | None = None,
) -> Clip:
    """The clip in `folder`, by the reader that knows its layout, at a training width.

    Args:
        folder: as `hoigs prepare` makes it, any layout that an installed reader knows, or
            "builtin:NAME".
        registry: where readers are looked up; by default what is installed.
        width: shrink frames to this image width, aspect kept; those that are narrower, and all
            with None, stay as they are.
        allow_faults: let pass what training can go on without (`ClipReader.allow_faults`).
        reader: from `choose_reader`; None looks at the folder.

    Raises:
        ClipError: no reader knows it, several do, or the reader found it incomplete.
    """
    registry = registry or default_registry()
    folder = clip_folder(folder, registry)
    require_folder(folder)
    choice = reader or choose_reader(folder, registry)
    choice.reader.allow_faults = allow_faults
    clip = choice.reader.read(folder)
    if width is None or width >= clip.cameras[0].width:
        return clip
    return clip.resized(width)


@dataclass
class Session:
    """One training run, ready to start.

    Attributes:
        faults: of the clip, which training goes on with; in the run's provenance too.
        reader: key of the reader that read the clip.
        changes: of a run that goes on: what of its spec is another now, "train.steps: 10 -> 20".
    """

    spec: Spec
    clip: Clip
    run: RunFolder
    trainer: Trainer
    faults: list[Fault] = field(default_factory=list)
    reader: str = ""
    changes: list[str] = field(default_factory=list)

    @classmethod
    def open(
        cls,
        clip: Path | str | None = None,
        spec: str | Path | Spec | None = None,
        *,
        out: Path | None = None,
        overrides: Sequence[str] = (),
        device: str = "cpu",
        resume: bool = False,
        overwrite: bool = False,
        plugins: Sequence[Path] = (),
        lpips_weights: Path | None = None,
        allow_faults: bool = False,
        reader: str | None = None,
        reader_settings: Sequence[str] = (),
    ) -> Session:
        """Check the spec, the clip and the output folder, compose the model, then make the run.

        A run that goes on (`resume`) keeps its own spec, clip, reader and allowed faults; what is
        given stands in their place.

        Args:
            clip: a folder or "builtin:NAME". spec: by default "hoigs".
            out: the run; by default runs/CLIP-SPEC.
            overrides: "a.b=value", laid over the spec.
            allow_faults: train without masks, images and depth that are absent or broken.
            reader: its name; by default the one that knows the clip's layout.
            reader_settings: of that reader, "key=value".

        Raises:
            HoigsError: anything wrong with the input; no folder has been made by then.
        """
        registry = default_registry(plugin_files=plugins)
        if spec is None:
            spec = own_spec(out or default_out(clip, DEFAULT_SPEC)) if resume else DEFAULT_SPEC
        if not isinstance(spec, Spec):
            spec = Spec.load(spec, overrides=overrides, registry=registry)
        torch.manual_seed(spec.train.seed)
        run = RunFolder(out or default_out(clip, spec.name))
        begun: dict[str, Any] = {}  # provenance of the run that goes on
        if resume:
            run.require()
            begun = run.read_provenance()
        else:
            run.refuse_existing(overwrite)
        folder, choice = clip_and_reader(clip, run, begun, registry, reader, reader_settings)
        allow_faults = allow_faults or bool(begun.get("allow_faults"))
        source = read_clip(
            folder, registry, spec.train.width, allow_faults=allow_faults, reader=choice
        )
        faults = examine(source)
        model = compose(spec, source, registry).to(device)
        trainer = Trainer(
            model,
            source,
            spec.train,
            density=compose_density(spec, source, registry),
            run=run,
            identity={"spec_name": spec.name, "model_hash": spec.model_hash()},
            lpips=_perceptual(spec, lpips_weights, device),
        )
        record = {
            "spec_hash": spec.hash(),
            "clip": {
                "name": source.name,
                "path": run.relative(folder),
                "reader": choice.record(run.relative),
            },
            "allow_faults": allow_faults,
            "clip_faults": [fault.to_dict() for fault in faults],
        }
        changes = changes_of(run.spec, spec) if resume else []
        if resume:
            if has_checkpoint(run.checkpoints):
                trainer.resume(load_checkpoint(latest_checkpoint(run.checkpoints)))
            else:  # stopped before the first one: from the beginning
                run.cut_metrics(0)
            run.go_on(spec.dump(), record)
        else:
            provenance = {
                "versions": versions(),
                "components": registry.provenance(spec)
                | {f"body of {n}": registry.origin(t.model) for n, t in source.bodies.items()},
                **record,
                "clip_provenance": dict(source.provenance),
                "device": device,
            }
            run.create(spec.dump(), provenance, overwrite)
        return cls(spec, source, run, trainer, faults, choice.key, changes)

    def train(self, on_step: Callable[[StepReport], None] | None = None) -> None:
        self.trainer.train(on_step)


def _perceptual(spec: Spec, weights: Path | None, device: str) -> Lpips | None:
    """The LPIPS term if the spec asks for it; asking without weights is an error, not a skip."""
    if spec.train.loss.lpips == 0:
        return None
    net = spec.train.loss.lpips_net
    found = find_weights(weights, net or "alex")
    if found.location is None:
        raise HoigsError(f"train.loss.lpips is {spec.train.loss.lpips}, but {found.reason}")
    loaded = Lpips.load(found)
    if net not in (None, loaded.net):
        raise HoigsError(f"train.loss.lpips_net is {net}, but {found.location} is {loaded.net}")
    return loaded.to(device)


@dataclass(frozen=True)
class LoadedRun:
    """A finished run, read back: spec, clip at training width, and the trained model.

    Where cameras were refined, the clip's are those that training ended with.
    """

    spec: Spec
    clip: Clip
    model: SceneModel
    step: int
    provenance: dict[str, Any]

    @classmethod
    def open(
        cls,
        path: Path,
        *,
        clip: Path | str | None = None,
        rasterizer: str | None = None,
        device: str = "cpu",
        plugins: Sequence[Path] = (),
    ) -> LoadedRun:
        """Read a run folder; `clip` and `rasterizer` replace what it was trained with."""
        run = RunFolder(path)
        run.require()
        registry = default_registry(plugin_files=plugins)
        changes = []
        if rasterizer is not None:
            key = rasterizer if ":" in rasterizer else f"rasterizer:{rasterizer}"
            changes.append(f"rasterizer.use={key}")
        spec = Spec.load(run.spec, overrides=changes, registry=registry)
        provenance = run.read_provenance()
        own = path / provenance["clip"]["path"]
        folder = own if clip is None else clip_folder(clip, registry)
        if not folder.is_dir():
            raise HoigsError(f"{folder}: the clip of this run is not there; give --clip FOLDER")
        torch.manual_seed(spec.train.seed)
        allowed = bool(provenance.get("allow_faults"))
        recorded = provenance["clip"].get("reader") if clip is None else None
        choice = recorded_reader(recorded, path, folder, registry) if recorded else None
        source = read_clip(folder, registry, spec.train.width, allow_faults=allowed, reader=choice)
        model = compose(spec, source, registry).to(device)
        checkpoint = load_checkpoint(latest_checkpoint(run.checkpoints))
        restore_model(model, checkpoint, spec.model_hash())
        if checkpoint.part("cameras"):
            refinement = CameraRefinement.of(source)
            restore_cameras(refinement, checkpoint)
            source = refinement.refined(source)
        model.eval()
        model.set_progress(min(1.0, checkpoint.meta["step"] / spec.train.steps))
        return cls(spec, source, model, checkpoint.meta["step"], provenance)
