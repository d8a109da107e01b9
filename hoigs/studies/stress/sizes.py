"""Settings that adapt a spec to a small clip and a short training."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from hoigs.core.spec.schema import Spec

# shares of all points, where a spec has such a block
SHARES = {"human": 0.3, "object": 0.1}
ROOM = 2.0  # cap of the scene's Gaussians, times those at the start
# settings of components that are counted in steps, by place
COUNTED = {
    "density": ("interval", "reset_every"),
    "deformation": ("promote_from", "promote_every", "promote_until"),
}


def small_settings(spec: Spec, points: int, steps: int) -> list[str]:
    """Overrides for a short training on a small clip; the same rules for all methods.

    All entities together start with `points` Gaussians, and the scene's cap is twice its own.
    Settings in steps are scaled with the length of the training. The LPIPS and face losses, which
    need files or larger images, are off.
    """
    settings = {
        "train.steps": steps,
        "train.preview_every": 0,
        "train.loss.lpips": 0.0,
        "train.loss.face": 0.0,
        "train.checkpoint_every": steps,
    }
    shrink = steps / spec.train.steps
    if spec.train.sh_interval is not None:
        settings["train.sh_interval"] = max(1, round(shrink * spec.train.sh_interval))
    blocks = dict(modelled(spec))
    scene = 1.0 - sum(SHARES[kind] for kind in blocks.values() if kind in SHARES)
    for name, kind in blocks.items():
        count = round(points * SHARES.get(kind, scene))
        settings[f"model.{name}.points"] = count
        block = spec.model[name]
        if "cap" in block.density.settings:
            settings[f"model.{name}.density.cap"] = round(ROOM * count)
        for part, keys in COUNTED.items():
            own: dict[str, Any] = getattr(block, part).settings
            for key in keys:
                if own.get(key) is not None:
                    least = 10 if key == "interval" else 1
                    settings[f"model.{name}.{part}.{key}"] = max(least, round(shrink * own[key]))
    return [f"{key}={value}" for key, value in settings.items()]


def modelled(spec: Spec) -> Iterator[tuple[str, str]]:
    """Name and kind of each model block that a clip with "human" and "object" makes use of."""
    for entity in ("scene", "human", "object"):
        block = spec.block(entity, entity)
        if block is not None and spec.selects(entity, entity):
            yield block[0], entity
