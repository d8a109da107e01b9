"""Session: a Trainer from a clip, a spec and options, checked before any file is written."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from hoigs.core.clip_folder.health import examine, require_useful
from hoigs.core.errors import HoigsError
from hoigs.core.model.compose import compose, compose_density, compose_objectives
from hoigs.core.options import verb
from hoigs.core.registry.registry import default_registry
from hoigs.core.reporting import Diagnostic
from hoigs.core.spec.schema import Spec, require_fitting
from hoigs.core.system.safe_replace import refuse_within
from hoigs.core.values.clip import Clip
from hoigs.metrics.lpips import Lpips, find_weights
from hoigs.runs.checkpoint import has_checkpoint, load_newest
from hoigs.runs.choices import pick_device
from hoigs.runs.clip_source import read_clip
from hoigs.runs.kept_clip import save_kept
from hoigs.runs.resuming import (
    DEFAULT_SPEC,
    changes_of,
    clip_and_reader,
    default_out,
    load_spec,
    own_spec,
)
from hoigs.runs.run_folder import RunFolder, command_line, versions
from hoigs.training.options import TrainOptions
from hoigs.training.trainer import StepReport, Trainer


@dataclass
class Session:
    """One training run, ready to start.

    `open` seeds torch's random state, from which the steps of `train` draw; `hoigs.train` restores
    the caller's.

    Attributes:
        faults: defects of the clip that training tolerates; the run's provenance lists them too.
        reader: registry key of the reader that read the clip.
        changes: of a resumed run, the changed settings of its spec: "train.steps: 10 -> 20".
    """

    spec: Spec
    clip: Clip
    run: RunFolder
    trainer: Trainer
    faults: list[Diagnostic] = field(default_factory=list)
    reader: str = ""
    changes: list[str] = field(default_factory=list)

    @classmethod
    @verb(TrainOptions, "spec")
    def open(cls, clip: Path | str | None = None, *, options: TrainOptions) -> Session:
        """Check the spec, the clip and the output folder, compose the model, then create the run.

        A resumed run keeps its spec, clip, reader and `allow_faults` unless others are given.
        `budget`, `evaluate` and `view` are for `hoigs.train`: nothing is done about them here.

        Args:
            clip: a clip folder, or "builtin:NAME"; with `resume` by default the run's.

        Raises:
            HoigsError: the input is wrong; nothing has been written.
        """
        registry = default_registry(plugin_files=options.plugins)
        device, resume = pick_device(options.device), options.resume
        out = None if options.out is None else Path(options.out)
        spec = options.spec
        if spec is None:
            spec = own_spec(out or default_out(clip, DEFAULT_SPEC)) if resume else DEFAULT_SPEC
        if not isinstance(spec, Spec):
            spec = load_spec(spec, options.spec_settings(), registry)
        elif options.spec_settings():
            raise HoigsError(
                f"overrides {options.spec_settings()} expect a spec's name or file, not a Spec; "
                "change the Spec itself: spec.model_copy(update=...)"
            )
        require_fitting(spec, registry)
        torch.manual_seed(spec.train.seed)
        run = RunFolder(out or default_out(clip, spec.name))
        earlier: dict[str, Any] = {}  # provenance of the resumed run
        if resume:
            run.require()
            earlier = run.read_provenance()
        else:
            run.refuse_existing(options.overwrite, [clip] if clip else [], resumable=True)
            if clip:
                refuse_within(run.path, Path(clip))
        run.lock("training")
        with ExitStack() as on_failure:
            on_failure.callback(run.unlock)
            # the clip, and what training tolerates of it
            folder, choice = clip_and_reader(
                clip, run, earlier, registry, options.reader, options.reader_settings
            )
            allow_faults = options.allow_faults or bool(earlier.get("allow_faults"))
            source = read_clip(
                folder, registry, spec.train.width, allow_faults=allow_faults, reader=choice
            )
            faults = examine(source)
            if not allow_faults:
                require_useful(source, faults)
            # the model and its trainer
            model = compose(spec, source, registry).to(device)
            trainer = Trainer(
                model,
                source,
                spec.train,
                density=compose_density(spec, source, registry),
                objectives=compose_objectives(spec, source, registry),
                run=run,
                identity={"spec_name": spec.name, "model_hash": spec.model_hash()},
                lpips=lpips_term(spec, options.lpips_weights, device),
            )
            trainer.hashes = spec.model_hashes()
            # the run folder
            record = {
                "spec_hash": spec.hash(),
                "clip": {
                    "name": source.name,
                    "path": run.relative(folder),
                    "reader": choice.record(run.relative),
                },
                "allow_faults": allow_faults,
                "clip_faults": [fault.to_dict() for fault in faults],
                "windows": None if trainer.windows is None else trainer.windows.sentence(),
            }
            changes = changes_of(run.spec, spec) if resume else []
            # Adam keeps two numbers for each parameter
            run.require_room(3 * sum(p.numel() * p.element_size() for p in model.parameters()))
            if resume:
                if has_checkpoint(run.checkpoints):
                    trainer.resume(load_newest(run.checkpoints))
                else:  # stopped before its first checkpoint: start again
                    run.cut_metrics(0)
                run.update(spec.dump(), record)
            else:
                provenance = {
                    "versions": versions(),
                    **command_line(),
                    "options": options.record("spec", "out", "overwrite"),
                    "components": registry.provenance(spec)
                    | {f"body of {n}": registry.origin(t.model) for n, t in source.bodies.items()},
                    **record,
                    "clip_provenance": dict(source.provenance),
                    "device": device,
                }
                run.create(spec.dump(), provenance, options.overwrite, [folder])
            try:
                save_kept(source, run.kept_clip)
            except BaseException:  # a full disk: no run that cannot be drawn from is left
                run.remove_unstarted()
                raise
            on_failure.pop_all()
        return cls(spec, source, run, trainer, faults, choice.key, changes)

    def train(self, on_step: Callable[[StepReport], None] | None = None) -> None:
        """`Trainer.train`; the run folder is then free for other processes.

        A new run that fails before its first checkpoint is removed.
        """
        try:
            self.trainer.train(on_step)
        except Exception:
            self.run.remove_unstarted()
            raise
        finally:
            self.run.unlock()


def lpips_term(spec: Spec, weights: Path | str | None, device: str) -> Lpips | None:
    """The network of the LPIPS term; None if the term has no weight.

    Raises:
        HoigsError: the term has weight, but there are no network weights, or those of another net.
    """
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
