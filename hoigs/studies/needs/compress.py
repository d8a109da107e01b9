"""compress: a copy of a run with a quantised model, and what that costs in PSNR."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hoigs.core.model.compose import compose
from hoigs.core.model.scene import SceneModel
from hoigs.core.registry.registry import Registry, default_registry
from hoigs.core.system.files import named
from hoigs.core.system.random_state import callers_random_state
from hoigs.runs.checkpoint import latest_checkpoint, load_checkpoint, restore_model
from hoigs.runs.choices import pick_device
from hoigs.runs.clip_source import recorded_folder, recorded_reader
from hoigs.runs.compact import write_compact
from hoigs.runs.loaded_run import LoadedRun
from hoigs.runs.run_folder import RunFolder
from hoigs.studies.needs.search_space import StepBudget
from hoigs.studies.needs.trial import Scores, Validator, selection_frames

UNLIMITED = float("inf")


@dataclass(frozen=True)
class Compacted:
    """Size and quality of a compressed run.

    Attributes:
        bytes_before: of the model's tensors. bytes_after: of the two compressed files.
        before, after: scores of the model and of what is read back. frames: scored positions.
    """

    path: Path
    bytes_before: int
    bytes_after: int
    before: Scores
    after: Scores
    frames: tuple[int, ...]

    @property
    def drop(self) -> float:
        """Loss of PSNR in the region that loses most, dB."""
        return self.before.drop_to(self.after)

    def __str__(self) -> str:
        share = self.bytes_before / self.bytes_after
        return (
            f"{self.bytes_before / 1e6:.2f} MB of tensors are {self.bytes_after / 1e6:.2f} MB on "
            f"disk, {share:.1f} times less, and lose {self.drop:.3f} dB at most"
        )


def compact_of(run: Path) -> Path:
    """Default folder of the compressed copy of a run."""
    run = named(run)
    return run.with_name(f"{run.name}-compact")


@callers_random_state()
def compress(
    run: Path | str,
    *,
    out: Path | str | None = None,
    clip: Path | str | None = None,
    device: str = "auto",
    overwrite: bool = False,
    plugins: Sequence[Path | str] = (),
    positions: Sequence[int] | None = None,
) -> Compacted:
    """Write a copy of a run with 8 and 16 bits a number, read it back, and score both.

    Args:
        out: its folder, by default RUN-compact. It is a run folder, but cannot be trained further.
        clip, device, plugins: as for `open_run`. overwrite: replace the run in `out`.
        positions: frames that are scored, by default those that `needs` holds back; they are
            training frames.

    Raises:
        HoigsError: there is no such run, or `out` exists.
    """
    run = Path(run)
    out = Path(out) if out is not None else compact_of(run)
    target, device = RunFolder(out), pick_device(device)
    inputs = [run] if clip is None else [run, clip]
    target.refuse_existing(overwrite, inputs)
    loaded = LoadedRun.open(run, clip=clip, device=device, plugins=plugins)
    registry = default_registry(plugin_files=plugins)
    if positions is None:
        positions = selection_frames(loaded.clip.split["train"])
    validator = Validator(loaded.clip, positions, StepBudget(UNLIMITED))
    before = validator.score(loaded.model)
    source = RunFolder(run)
    checkpoint = load_checkpoint(latest_checkpoint(source.checkpoints))
    provenance = moved_provenance(loaded.provenance, run, target, registry) | {"compact": True}
    temporary = RunFolder(out.with_name(f".{out.name}.compact.{os.getpid()}.part"))
    try:
        temporary.create(loaded.spec.dump(), provenance)
        shutil.copyfile(source.metrics, temporary.metrics)
        temporary.keep_clip_of(source)
        size = write_compact(
            temporary.checkpoints,
            loaded.model.state_dict(),
            _composed(loaded, registry).state_dict(),
            checkpoint.meta,
            {f"cameras.{k}": v for k, v in checkpoint.part("cameras").items()},
        )
        again = _composed(loaded, registry)
        packed = load_checkpoint(latest_checkpoint(temporary.checkpoints))
        restore_model(again, packed, loaded.spec.model_hashes())
        again.to(device).eval()
        again.set_progress(1.0)
        after = validator.score(again)
        target.replace_by(temporary, overwrite, inputs)
    finally:
        shutil.rmtree(temporary.path, ignore_errors=True)
    numbers = loaded.model.state_dict().values()
    unpacked = sum(t.numel() * t.element_size() for t in numbers)
    return Compacted(out, unpacked, size, before, after, tuple(positions))


def _composed(loaded: LoadedRun, registry: Registry) -> SceneModel:
    """The untrained model of the run's spec and clip, with as many Gaussians as the trained one."""
    model = compose(loaded.spec, loaded.clip, registry)
    for name in model.entities:
        model.entity(name).resize(len(loaded.model.entity(name)))
    return model


def moved_provenance(
    provenance: dict[str, Any], run: Path, target: RunFolder, registry: Registry
) -> dict[str, Any]:
    """A run's provenance with paths relative to another folder."""
    clip = provenance["clip"]
    folder = recorded_folder(run, provenance, registry)
    moved = {**clip, "path": target.relative(folder)}
    if clip.get("reader"):
        reader = recorded_reader(clip["reader"], run, folder, registry)
        moved["reader"] = reader.record(target.relative)
    return provenance | {"clip": moved}
