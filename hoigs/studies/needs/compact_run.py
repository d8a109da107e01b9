"""A run in few bytes: the same folder with a quantised model, and what that costs."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hoigs.compression.compact import write_compact
from hoigs.core.compose import compose
from hoigs.core.registry import Registry, default_registry
from hoigs.core.scene import SceneModel
from hoigs.studies.needs.halving import Ledger
from hoigs.studies.needs.judge import Judge, Look
from hoigs.studies.needs.selection import selection_frames
from hoigs.training.checkpoint import latest_checkpoint, load_checkpoint, restore_model
from hoigs.training.reader_choice import recorded_reader
from hoigs.training.run_folder import RunFolder
from hoigs.training.session import LoadedRun

UNLIMITED = float("inf")


@dataclass(frozen=True)
class Compacted:
    """What a compact run is like.

    Attributes:
        bytes_before: of the model's tensors, unpacked. bytes_after: of both files.
        before, after: looks at the model and at what is read back. frames: positions looked at.
    """

    path: Path
    bytes_before: int
    bytes_after: int
    before: Look
    after: Look
    frames: tuple[int, ...]

    @property
    def drop(self) -> float:
        """dB, in the region where it is most."""
        return self.before.drop_to(self.after)

    def __str__(self) -> str:
        share = self.bytes_before / self.bytes_after
        return (
            f"{self.bytes_before / 1e6:.2f} MB of tensors are {self.bytes_after / 1e6:.2f} MB on "
            f"disk, {share:.1f} times less, {self.drop:+.3f} dB worse at most"
        )


def compact_run(
    run: Path,
    out: Path,
    *,
    clip: Path | str | None = None,
    positions: Sequence[int] | None = None,
    device: str = "cpu",
    plugins: Sequence[Path] = (),
    overwrite: bool = False,
) -> Compacted:
    """Write a run folder with a compact checkpoint, read it back, and look at both.

    Args:
        out: its folder; every verb that takes a run takes it, but training does not go on from it.
        clip: as for `LoadedRun.open`. positions: frames looked at; by default those that
            `hoigs needs` holds back, which the training has seen.

    Raises:
        HoigsError: there is no such run, or `out` is there already.
    """
    target = RunFolder(out)
    target.refuse_existing(overwrite)
    loaded = LoadedRun.open(run, clip=clip, device=device, plugins=plugins)
    registry = default_registry(plugin_files=plugins)
    if positions is None:
        positions = selection_frames(loaded.clip.split["train"])
    judge = Judge(loaded.clip, positions, Ledger(UNLIMITED))
    before = judge.look(loaded.model)
    source = RunFolder(run)
    checkpoint = load_checkpoint(latest_checkpoint(source.checkpoints))
    provenance = moved_provenance(loaded.provenance, run, target, registry) | {"compact": True}
    temporary = RunFolder(out.with_name(f".{out.name}.compact.{os.getpid()}.part"))
    try:
        temporary.create(loaded.spec.dump(), provenance)
        shutil.copyfile(source.metrics, temporary.metrics)
        size = write_compact(
            temporary.checkpoints,
            loaded.model.state_dict(),
            _composed(loaded, registry).state_dict(),
            checkpoint.meta,
            {f"cameras.{k}": v for k, v in checkpoint.part("cameras").items()},
        )
        again = _composed(loaded, registry)
        packed = load_checkpoint(latest_checkpoint(temporary.checkpoints))
        restore_model(again, packed, loaded.spec.model_hash())
        again.to(device).eval()
        again.set_progress(1.0)
        after = judge.look(again)
        put_in_place(temporary, target)
    finally:
        shutil.rmtree(temporary.path, ignore_errors=True)
    numbers = loaded.model.state_dict().values()
    unpacked = sum(t.numel() * t.element_size() for t in numbers)
    return Compacted(out, unpacked, size, before, after, tuple(positions))


def put_in_place(new: RunFolder, target: RunFolder) -> None:
    """Rename a finished folder over another, which goes."""
    old = target.path.with_name(f".{target.path.name}.old.{os.getpid()}.part")
    if target.path.exists():
        target.path.replace(old)
    new.path.replace(target.path)
    shutil.rmtree(old, ignore_errors=True)


def _composed(loaded: LoadedRun, registry: Registry) -> SceneModel:
    """The model as its spec and clip give it, with as many Gaussians as the trained one."""
    model = compose(loaded.spec, loaded.clip, registry)
    for name in model.entities:
        model.entity(name).resize(len(loaded.model.entity(name)))
    return model


def moved_provenance(
    provenance: dict[str, Any], run: Path, target: RunFolder, registry: Registry
) -> dict[str, Any]:
    """A run's provenance with paths that hold from another folder."""
    clip = provenance["clip"]
    folder = run / clip["path"]
    moved = {**clip, "path": target.relative(folder)}
    if clip.get("reader"):
        moved["reader"] = recorded_reader(clip["reader"], run, folder, registry).record(
            target.relative
        )
    return provenance | {"clip": moved}
