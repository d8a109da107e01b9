"""A model's tensors as a compact checkpoint, which every reader of checkpoints accepts."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from hoigs.compression.packed import pack, unpack
from hoigs.core.errors import CheckpointError

FORMAT = "hoigs-compact"
VERSION = 2
READABLE = (1, VERSION)
COMPOSED = "composed"  # key of the tensors that are not written, since spec and clip determine them


def write_compact(
    folder: Path,
    state: Mapping[str, Tensor],
    composed: Mapping[str, Tensor],
    meta: Mapping[str, Any],
    extra: Mapping[str, Tensor] | None = None,
) -> int:
    """Write `step_000123.safetensors` and `.json`; the JSON comes last and completes it.

    Args:
        state: of the trained model. composed: state of the untrained model of spec and clip, with
            as many Gaussians; tensors that are equal in both are not written.
        meta: of the model's checkpoint (step, counts, spec_name, model_hash).
        extra: other tensors, lossless, by full name ("cameras.…").

    Returns:
        Bytes of both files.

    Raises:
        ValueError: a value is not finite.
    """
    same = [k for k, v in state.items() if k in composed and _equal(v, composed[k])]
    again = set(same)
    mine = {f"model.{k}": v for k, v in state.items() if k not in again}
    kept = {k: v.to(torch.float64) if v.is_floating_point() else v
            for k, v in (extra or {}).items()}  # fmt: skip
    streams, described = pack(mine | kept)
    record = {
        **{key: meta[key] for key in ("step", "time_s", "counts", "spec_name", "model_hash")},
        "format": FORMAT,
        "version": VERSION,
        "tensors": described,
        COMPOSED: same,
    }
    folder.mkdir(parents=True, exist_ok=True)
    stem = f"step_{meta['step']:06d}"
    weights, page = folder / f"{stem}.safetensors", folder / f"{stem}.json"
    temporary = weights.with_suffix(f".{os.getpid()}.part")
    save_file(streams, temporary)
    temporary.replace(weights)
    temporary = page.with_suffix(f".{os.getpid()}.part")
    temporary.write_text(json.dumps(record))
    temporary.replace(page)
    return weights.stat().st_size + page.stat().st_size


def read_compact(streams: Mapping[str, Tensor], meta: Mapping[str, Any]) -> dict[str, Tensor]:
    """Tensors of a compact checkpoint, by their names in an ordinary one.

    Raises:
        CheckpointError: damaged, or of another version.
    """
    if meta.get("version") not in READABLE:
        expected = " or ".join(map(str, READABLE))
        raise CheckpointError(f"{FORMAT} version {meta.get('version')!r}, expected {expected}")
    found = unpack(streams, meta["tensors"])
    return {
        name: value.float() if name.startswith("cameras.") and value.dtype == torch.float64
        else value
        for name, value in found.items()
    }  # fmt: skip


def _equal(a: Tensor, b: Tensor) -> bool:
    return a.shape == b.shape and a.dtype == b.dtype and bool(torch.equal(a.cpu(), b.cpu()))
