"""Trial: a short training of one candidate's entities alone, scored on the selection frames."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from hoigs.core.errors import HoigsError
from hoigs.core.model.compose import compose, compose_density
from hoigs.core.registry.registry import Registry
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import Clip, Frame
from hoigs.metrics.psnr import psnr_from_mse
from hoigs.metrics.regions import dilate
from hoigs.studies.needs.criterion import Score
from hoigs.studies.needs.search_space import Kind, Overrides, Region
from hoigs.studies.needs.selection import SELECTION
from hoigs.training.trainer import Trainer

CONTACT = 0.05  # of the longer side: how far from an object a human's pixels count as contact


def isolated(
    kind: Kind, names: Sequence[str], blocks: Mapping[str, Sequence[str]], steps: int
) -> Overrides:
    """Overrides that restrict a spec to some entities, for a trial.

    An entity is rendered alone and compared within its mask, so that the trial does not depend on
    choices of other search spaces. The depth and face losses and camera refinement are off: they
    need the whole scene.
    """
    found: Overrides = {
        "entities": list(names),
        "train.steps": steps,
        "train.preview_every": 0,
        "train.loss.depth": 0.0,
        "train.loss.depth_fit": "scale",
        "train.loss.face": 0.0,
        "train.loss.lpips": 0.0,
        "train.rates.camera": 0.0,
    }
    if kind == "scene":
        found["train.loss.scene_loss"] = "background"
    else:
        found["train.loss.scene"] = 0.0
    if kind != "pair":
        found["interaction"] = {"use": "interaction:none"}
        found |= {f"model.{key}.features": None for keys in blocks.values() for key in keys}
    return found


class Trial:
    """A short training that can be continued.

    Args:
        spec: resolved, of a trial. view: from `selection_view`. region: where it is scored.
        names: entities that the region "own" is made of.

    Raises:
        SpecError: the candidate cannot be built for this clip.
    """

    def __init__(
        self,
        spec: Spec,
        view: Clip,
        region: Region,
        names: Sequence[str],
        registry: Registry,
        device: str = "cpu",
    ) -> None:
        torch.manual_seed(spec.train.seed)
        self.view, self.region, self.names = view, region, tuple(names)
        with warnings.catch_warnings():
            # few knots on a turning object are what is being tried
            warnings.filterwarnings("ignore", message="the object turns")
            self.model = compose(spec, view, registry).to(device)
        self.trainer = Trainer(
            self.model, view, spec.train, density=compose_density(spec, view, registry)
        )
        self.seconds = 0.0

    @property
    def parameters(self) -> int:
        return sum(p.numel() for p in self.model.parameters() if p.requires_grad)

    def advance(self, until: int) -> Score:
        """Train on to a step, and score."""
        began = time.perf_counter()
        self.trainer.train(until=until)
        score = score_model(self.model, self.view, self.region, self.names)
        self.seconds += time.perf_counter() - began
        return score


@torch.no_grad()
def score_model(
    model: Any,
    view: Clip,
    region: Region,
    names: Sequence[str],
    positions: Sequence[int] | None = None,
) -> Score:
    """A model on the selection frames (or others), frames without the region left out.

    Raises:
        HoigsError: fewer than two frames show the region.
    """
    was_training = model.training
    model.eval()
    values, squares, pixels = [], [], []
    positions = view.split[SELECTION] if positions is None else positions
    for position in positions:
        frame = view[position]
        where = region_of(frame, view, region, names)
        if not where.any():
            continue
        output = model.render(frame.moment.to(model.device), frame.camera.to(model.device))
        errors = (output.color.cpu().clamp(0, 1) - frame.rgb)[where].square()
        values.append(float(psnr_from_mse(errors.mean())))
        squares.append(float(errors.mean(-1).sum()))
        pixels.append(int(where.sum()))
    model.train(was_training)
    if len(values) < 2:
        raise HoigsError(
            f"{' and '.join(names)}: seen in {len(values)} of the {len(positions)} frames held "
            "back; at least two are needed to choose a model (hold more back: --share)"
        )
    trained = sum(p.numel() for p in model.parameters() if p.requires_grad)
    return Score(tuple(values), tuple(squares), tuple(pixels), trained)


def region_of(
    frame: Frame, clip: Clip, region: Region, names: Sequence[str]
) -> Bool[Tensor, "H W"]:
    """Pixels of a frame that a search space is scored on; none where a needed mask is unknown."""
    empty = torch.zeros(frame.image.shape[:2], dtype=torch.bool)
    masks = frame.masks
    if frame.unknown & (set(names) if region == "own" else set(masks)):
        return empty

    def union(chosen: Sequence[str]) -> Bool[Tensor, "H W"]:
        joined = empty.clone()
        for name in chosen:
            joined |= masks[name]
        return joined

    if region == "own":
        found = union(names)
    elif region == "background":
        found = ~union(list(masks))
    else:
        objects = union([n for n in masks if clip.kinds[n] == "object"])
        people = union([n for n in masks if clip.kinds[n] == "human"])
        found = objects | (people & dilate(objects, max(2, round(CONTACT * max(empty.shape)))))
    return found if frame.ignored is None else found & ~frame.ignored
