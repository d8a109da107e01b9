"""Checkpoints: safetensors with a JSON beside it, never pickle; written whole or not at all."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from hoigs.compression.compact import COMPOSED, read_compact
from hoigs.compression.compact import FORMAT as COMPACT
from hoigs.core.errors import CheckpointError
from hoigs.core.scene import SceneModel

FORMAT = "hoigs-checkpoint"
VERSION = 1


@dataclass(frozen=True)
class Checkpoint:
    """All that a run needs to go on as if it had never stopped.

    Attributes:
        tensors: "model.*", "optimizer.*", "density.*", "cameras.*", "rng.*".
        meta: format, version, step, counts, spec_hash, model_hash, sampler order.

    One that was pruned or compressed has the model alone: it is drawn, but not trained on.
    """

    tensors: dict[str, torch.Tensor]
    meta: dict[str, Any]

    def part(self, prefix: str) -> dict[str, torch.Tensor]:
        """Tensors whose names start with `prefix.`, without it."""
        start = prefix + "."
        return {k.removeprefix(start): v for k, v in self.tensors.items() if k.startswith(start)}

    def save(self, folder: Path) -> Path:
        """Write `step_000123.safetensors` and `.json`; the JSON comes last and completes it."""
        folder.mkdir(parents=True, exist_ok=True)
        stem = f"step_{self.meta['step']:06d}"
        weights, meta = folder / f"{stem}.safetensors", folder / f"{stem}.json"
        tensors = {k: v.detach().cpu().contiguous() for k, v in self.tensors.items()}
        temporary = weights.with_suffix(".safetensors.part")
        save_file(tensors, temporary)
        temporary.replace(weights)
        temporary = meta.with_suffix(".json.part")
        temporary.write_text(json.dumps(self.meta, indent=1))
        temporary.replace(meta)
        return weights


def _complete(folder: Path) -> list[Path]:
    return sorted(
        (p for p in folder.glob("step_*.json") if p.with_suffix(".safetensors").exists()),
        key=lambda p: int(p.stem.removeprefix("step_")),  # beyond 999999 names grow
    )


def has_checkpoint(folder: Path) -> bool:
    """Whether a run has come as far as its first checkpoint."""
    return bool(_complete(folder))


def latest_checkpoint(folder: Path) -> Path:
    """The JSON of the newest complete checkpoint in a run's `checkpoints/` folder."""
    found = _complete(folder)
    if not found:
        raise CheckpointError(
            f"{folder}: no checkpoint here; expected step_*.safetensors with step_*.json beside "
            "it, as `hoigs train` writes them"
        )
    return found[-1]


def load_checkpoint(meta_path: Path) -> Checkpoint:
    """Read one checkpoint, refusing what is damaged or from another program."""
    try:
        meta = json.loads(meta_path.read_text())
    except (OSError, json.JSONDecodeError) as error:
        raise CheckpointError(f"{meta_path}: cannot be read as JSON: {error}") from error
    compact = meta.get("format") == COMPACT
    if not compact and (meta.get("format") != FORMAT or meta.get("version") != VERSION):
        raise CheckpointError(
            f"{meta_path}: format {meta.get('format')!r} version {meta.get('version')!r}, "
            f"expected {FORMAT!r} version {VERSION}"
        )
    try:
        tensors = load_file(meta_path.with_suffix(".safetensors"))
    except (OSError, SafetensorError) as error:
        raise CheckpointError(
            f"{meta_path.with_suffix('.safetensors')}: damaged or absent: {error}"
        ) from error
    if compact:
        try:
            tensors = read_compact(tensors, meta)
        except CheckpointError as error:
            raise CheckpointError(f"{meta_path.with_suffix('.safetensors')}: {error}") from error
    return Checkpoint(tensors, meta)


def restore_model(model: SceneModel, checkpoint: Checkpoint, model_hash: str) -> None:
    """Give a freshly composed model the parameters of a checkpoint.

    Raises:
        CheckpointError: the checkpoint belongs to another spec, or its tensors do not fit.
    """
    stored = checkpoint.meta["model_hash"]
    if stored != model_hash:
        raise CheckpointError(
            f"checkpoint of step {checkpoint.meta['step']} was made by the spec "
            f"{checkpoint.meta['spec_name']!r} (model hash {stored[:12]}), but this model's hash "
            f"is {model_hash[:12]}: its `model`, `interaction` or `entities` differ; use the "
            "spec.yaml that lies beside the checkpoint"
        )
    counts = checkpoint.meta["counts"]
    if set(counts) != set(model.entities):
        raise CheckpointError(
            f"checkpoint holds the entities {sorted(counts)}, the model has "
            f"{sorted(model.entities)}; it belongs to another clip"
        )
    for name, count in counts.items():
        model.entity(name).resize(count)
    composed = model.state_dict()
    known = {name: composed[name] for name in checkpoint.meta.get(COMPOSED, ()) if name in composed}
    try:
        model.load_state_dict(known | checkpoint.part("model"))
    except RuntimeError as error:
        raise CheckpointError(f"checkpoint does not fit the model: {error}") from error


def restore_cameras(cameras: nn.Module | None, checkpoint: Checkpoint) -> None:
    """Give camera corrections what a checkpoint holds; one without any leaves them as they are.

    Raises:
        CheckpointError: there are corrections, but none are wanted, or of another clip.
    """
    stored = checkpoint.part("cameras")
    if not stored:
        return
    if cameras is None:
        raise CheckpointError(
            f"checkpoint of step {checkpoint.meta['step']} has refined cameras, but "
            "train.rates.camera is 0: go on with the rate that it was trained with"
        )
    try:
        cameras.load_state_dict(stored)
    except RuntimeError as error:
        raise CheckpointError(f"its cameras are of another clip: {error}") from error
