"""The matched profiles of baselines: what they share with hoigs, and how well a model fits."""

from __future__ import annotations

import torch

from hoigs.core.model.scene import SceneModel
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import Clip
from hoigs.metrics.psnr import psnr


@torch.no_grad()
def score(model: SceneModel, clip: Clip) -> float:
    """Mean PSNR, dB, over the training frames."""
    frames = [clip[position] for position in clip.split["train"]]
    return sum(
        psnr(model.render(f.moment, f.camera).color.clamp(0, 1), f.rgb).item() for f in frames
    ) / len(frames)


def matched(name: str) -> tuple[Spec, Spec]:
    """The matched profiles of a baseline and of hoigs, which differ in the method alone."""
    ours, hoigs = Spec.load(f"{name}@matched"), Spec.load("hoigs@matched")
    loss = ours.train.loss.model_copy(update={"regularizers": {}})
    assert loss == hoigs.train.loss.model_copy(update={"regularizers": {}})
    assert ours.train.rates == hoigs.train.rates and ours.train.steps == hoigs.train.steps
    assert (ours.rasterizer, ours.low_pass) == (hoigs.rasterizer, hoigs.low_pass)
    assert ours.evaluation == hoigs.evaluation
    return ours, hoigs
