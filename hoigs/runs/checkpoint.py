"""Checkpoints: safetensors with a JSON file beside it, each written under a temporary name."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from hoigs.core.errors import CheckpointError
from hoigs.core.model.scene import SceneModel
from hoigs.core.parameters import timed_parameters
from hoigs.core.system.files import (
    read_json,
    regular_file,
    short,
    validated,
    write_whole,
    written_whole,
)
from hoigs.core.system.tensor_files import TensorFile, save_tensors
from hoigs.runs.compact import COMPOSED, read_compact
from hoigs.runs.compact import FORMAT as COMPACT
from hoigs.runs.run_folder import CheckpointRecord, CompactRecord

FORMAT = "hoigs-checkpoint"
VERSION = 2
MOST_GAUSSIANS = 10**8  # of an entity whose means are not stored, since spec and clip give them
PIECE = 2**20  # numbers checked at a time, which takes memory for a few times as many
FEW = 3  # names in a message
ADVICE = "train again, or restore it from a copy"
READABLE = (1, VERSION)  # spec keys of version 1 had other names, so its model hashes differ


@dataclass(frozen=True)
class Checkpoint:
    """The complete state of training after a step.

    A pruned or compressed checkpoint holds the model alone, which can be drawn but not resumed.

    Attributes:
        tensors: "model.*", "optimizer.*", "density.*", "cameras.*", "rng.*"; of a training in
            windows "windows.*".
        meta: format, version, step, time_s, counts, sampler, skipped, spec_name, model_hash.
        files: of a training in windows, tensors that lie in files, in place of those in `tensors`.
    """

    tensors: dict[str, torch.Tensor]
    meta: dict[str, Any]
    files: Mapping[str, TensorFile] = field(default_factory=dict)

    def part(self, prefix: str) -> dict[str, torch.Tensor]:
        """The tensors whose names start with `prefix.`, under the rest of their names."""
        start = prefix + "."
        return {k.removeprefix(start): v for k, v in self.tensors.items() if k.startswith(start)}

    def save(self, folder: Path) -> Path:
        """Write `step_000123.safetensors`, then `.json`, which marks the checkpoint complete.

        Raises:
            CheckpointError, OSError: the disk is full or cannot be written; nothing is left there.
        """
        folder.mkdir(parents=True, exist_ok=True)
        stem = f"step_{self.meta['step']:06d}"
        weights, meta = folder / f"{stem}.safetensors", folder / f"{stem}.json"
        try:
            with written_whole(weights, weights.with_suffix(".safetensors.part")) as part:
                if self.files:
                    save_tensors({**self.tensors, **self.files}, part)
                else:
                    tensors = {k: v.detach().cpu().contiguous() for k, v in self.tensors.items()}
                    save_file(tensors, part)
        except SafetensorError as error:
            raise CheckpointError(f"{weights} cannot be written: {error}") from error
        write_whole(meta, json.dumps(self.meta, indent=1), meta.with_suffix(".json.part"))
        return weights


def _complete(folder: Path) -> list[Path]:
    return sorted(
        (
            p
            for p in folder.glob("step_*.json")
            if p.stem.removeprefix("step_").isdecimal() and p.with_suffix(".safetensors").exists()
        ),
        key=lambda p: int(p.stem.removeprefix("step_")),  # beyond 999999 names grow
    )


def complete_checkpoints(folder: Path) -> list[int]:
    """The steps of the complete checkpoints in a run's `checkpoints/` folder, in order."""
    return [int(path.stem.removeprefix("step_")) for path in _complete(folder)]


def remove_checkpoint(folder: Path, step: int) -> None:
    """Remove a checkpoint, the file that marks it complete first; nothing if there is none."""
    for ending in ("json", "safetensors"):
        (folder / f"step_{step:06d}.{ending}").unlink(missing_ok=True)


def has_checkpoint(folder: Path) -> bool:
    """Whether a run's `checkpoints/` folder has a complete checkpoint."""
    return bool(_complete(folder))


def latest_checkpoint(folder: Path) -> Path:
    """The JSON file of the newest complete checkpoint in a run's `checkpoints/` folder.

    Raises:
        CheckpointError: there is none.
    """
    found = _complete(folder)
    if not found:
        raise CheckpointError(
            f"{folder}: no checkpoint here; expected step_*.safetensors with step_*.json beside "
            "it, as `hoigs train` writes them"
        )
    return found[-1]


def load_newest(folder: Path, parts: Collection[str] | None = None) -> Checkpoint:
    """The newest complete checkpoint in a run's `checkpoints/` folder.

    Args:
        parts: as of `load_checkpoint`.

    Raises:
        CheckpointError: there is none, or it is damaged; the message then names the newest one that
            is whole, if any, and how to go back to it.
    """
    newest = latest_checkpoint(folder)
    try:
        return load_checkpoint(newest, parts)
    except CheckpointError as error:
        broken = [newest.stem]
        for older in reversed(_complete(folder)[:-1]):
            try:
                whole = load_checkpoint(older)
            except CheckpointError:
                broken.append(older.stem)
                continue
            files = ", ".join(f"{folder / stem}.json" for stem in broken)
            raise CheckpointError(
                f"{error}\nThe checkpoint of step {whole.meta['step']} is whole: to use it, "
                f"remove {files} and give the same command again"
            ) from error
        raise


def load_checkpoint(meta_path: Path, parts: Collection[str] | None = None) -> Checkpoint:
    """Read one checkpoint; `meta_path` is its JSON file.

    Args:
        parts: of the tensors, "model" or "optimizer"; None: all. A compact checkpoint is read
            whole.

    Raises:
        CheckpointError: a file is damaged or absent, or of another format, or holds values that
            are not finite.
    """
    meta = read_json(meta_path, error=CheckpointError, advice=ADVICE)
    if not isinstance(meta, dict):
        raise CheckpointError(f"{meta_path}: damaged: expected an object, got {short(meta)}")
    compact = meta.get("format") == COMPACT
    if not compact and (meta.get("format") != FORMAT or meta.get("version") not in READABLE):
        raise CheckpointError(
            f"{meta_path}: format {short(meta.get('format'))} version "
            f"{short(meta.get('version'))}, expected {FORMAT!r} version "
            f"{' or '.join(map(str, READABLE))}"
        )
    record = CompactRecord if compact else CheckpointRecord
    validated(meta, record, meta_path, error=CheckpointError, advice=ADVICE)
    weights = meta_path.with_suffix(".safetensors")
    try:
        tensors = _read(weights, None if compact else parts)
    except (OSError, SafetensorError, ValueError, KeyError) as error:
        raise CheckpointError(f"{weights}: damaged or absent: {error}; {ADVICE}") from error
    if compact:
        try:
            tensors = read_compact(tensors, meta)
        except CheckpointError as error:
            raise CheckpointError(f"{weights}: {error}; {ADVICE}") from error
    _check_values(weights, tensors)
    if not compact:
        tensors = _read(weights, parts)  # anew: no page of the file is in memory until it is used
    _check_counts(meta_path, meta["counts"], tensors)
    return Checkpoint(tensors, meta)


def _read(path: Path, parts: Collection[str] | None) -> dict[str, torch.Tensor]:
    with safe_open(regular_file(path), framework="pt") as file:
        names = [n for n in file.keys() if parts is None or n.partition(".")[0] in parts]  # noqa: SIM118
        return {name: file.get_tensor(name) for name in names}


def _check_values(path: Path, tensors: Mapping[str, torch.Tensor]) -> None:
    """CheckpointError if a number is NaN or infinite: it would be drawn, and scored, in silence."""
    for name, values in tensors.items():
        if not values.is_floating_point() or name.startswith("density."):
            continue
        pieces = values.flatten().split(PIECE)
        count = sum(int((~torch.isfinite(piece)).sum()) for piece in pieces)
        if count:
            raise CheckpointError(
                f"{path}: damaged: {name} has {count} of {values.numel()} values that are NaN or "
                f"infinite; {ADVICE}"
            )


def _check_counts(path: Path, counts: dict[str, int], tensors: dict[str, torch.Tensor]) -> None:
    """CheckpointError unless as many Gaussians are stored as the record says."""
    for name, count in counts.items():
        means = tensors.get(f"model.entities.{name}.means")
        stored = MOST_GAUSSIANS if means is None or means.dim() == 0 else len(means)
        if count > stored or (means is not None and count != stored):
            raise CheckpointError(
                f"{path}: damaged: {count} Gaussians of {name!r}, but "
                f"{stored if means is not None else 'at most ' + str(stored)} are stored; {ADVICE}"
            )


def restore_model(
    model: SceneModel, checkpoint: Checkpoint, hashes: Sequence[str], *, in_file: bool = False
) -> None:
    """Load the parameters of a checkpoint into a composed model.

    Args:
        hashes: of models that it may be of, that of `model` first (`Spec.model_hashes`).
        in_file: parameters with rows for times, which grow with the clip, stay in the checkpoint's
            file, and come into memory as they are read. For models that are not trained, and files
            that nobody removes.

    Raises:
        CheckpointError: the checkpoint belongs to another spec, or its tensors do not fit.
    """
    stored = checkpoint.meta["model_hash"]
    if checkpoint.meta["version"] == VERSION and stored not in hashes:
        raise CheckpointError(
            f"checkpoint of step {checkpoint.meta['step']} was made by the spec "
            f"{checkpoint.meta['spec_name']!r} (model hash {stored[:12]}), but this model's hash "
            f"is {hashes[0][:12]}: its `model`, `interaction` or `entities` differ; use the "
            "spec.yaml that lies beside the checkpoint"
        )
    counts = checkpoint.meta["counts"]
    if set(counts) != set(model.entities):
        raise CheckpointError(
            f"checkpoint holds the entities {sorted(counts)}, the model has "
            f"{sorted(model.entities)}; it belongs to another clip"
        )
    try:
        for name, count in counts.items():
            model.entity(name).resize(count)
    except (RuntimeError, IndexError, ValueError) as error:
        raise CheckpointError(f"checkpoint does not fit the model: {error}") from error
    composed = model.state_dict()
    known = {name: composed[name] for name in checkpoint.meta.get(COMPOSED, ()) if name in composed}
    stored = known | checkpoint.part("model")
    timed = {name for name, _ in timed_parameters(model)} if in_file else set()
    kept = {
        name: parameter
        for name, parameter in model.named_parameters()
        if name in timed and name in stored and stored[name].shape == parameter.shape
    }
    try:
        model.load_state_dict(stored | kept)
    except RuntimeError as error:
        raise CheckpointError(
            f"checkpoint does not fit the model: {_differences(stored, composed)}. Settings that "
            "are `auto` follow the clip, as whether its poses are exact and objects' rotations "
            "known: a run can be used with another clip if that says the same of them"
        ) from error
    for name, parameter in kept.items():
        parameter.data = stored[name].to(parameter.dtype)


def _differences(stored: Mapping[str, torch.Tensor], composed: Mapping[str, torch.Tensor]) -> str:
    """What a state and a model do not have in common, a few names of each kind."""
    found = {
        "it alone has": sorted(set(stored) - set(composed)),
        "the model alone has": sorted(set(composed) - set(stored)),
        "they differ in the size of": [
            f"{name} ({list(stored[name].shape)}, the model's {list(value.shape)})"
            for name, value in composed.items()
            if name in stored and stored[name].shape != value.shape
        ],
    }
    parts = []
    for what, names in found.items():
        more = f" and {len(names) - FEW} more" if len(names) > FEW else ""
        parts += [f"{what} {', '.join(names[:FEW])}{more}"] if names else []
    return "; ".join(parts)


def restore_cameras(cameras: nn.Module | None, checkpoint: Checkpoint) -> None:
    """Load the camera corrections of a checkpoint, if it has any.

    Raises:
        CheckpointError: the run refines no cameras, or the corrections are of another clip.
    """
    stored = checkpoint.part("cameras")
    if not stored:
        return
    if cameras is None:
        raise CheckpointError(
            f"checkpoint of step {checkpoint.meta['step']} has refined cameras, but "
            "train.rates.camera is 0: resume with the rate that it was trained with"
        )
    try:
        cameras.load_state_dict(stored)
    except RuntimeError as error:
        raise CheckpointError(f"the checkpoint's cameras are of another clip: {error}") from error
