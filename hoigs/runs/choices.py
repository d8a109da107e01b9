"""The options `device` and `rasterizer`, which everything that runs a model has."""

from __future__ import annotations

from collections.abc import Sequence

from hoigs.core.errors import HoigsError


def pick_device(name: str) -> str:
    """`name` itself, or for "auto" "cuda" if available, else "cpu".

    Raises:
        HoigsError: `name` is a CUDA device, and this machine has none.
    """
    import torch

    if name == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise HoigsError(f'device "{name}": this machine has no CUDA device; use "cpu"')
    return name


def with_rasterizer(overrides: Sequence[str] | None, rasterizer: str | None) -> list[str]:
    """Overrides of a spec ("a.b=value") and one for the rasterizer.

    Args:
        rasterizer: "warp" or "rasterizer:warp"; None keeps the spec's.
    """
    chosen = list(overrides or ())
    if rasterizer is not None:
        key = rasterizer if ":" in rasterizer else f"rasterizer:{rasterizer}"
        chosen.append(f"rasterizer.use={key}")
    return chosen
