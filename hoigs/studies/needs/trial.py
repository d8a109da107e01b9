"""Trial: a short training of one candidate's entities alone, scored on the selection frames."""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from hoigs.core.errors import ClipError, HoigsError
from hoigs.core.interfaces.rasterizer import RenderRequest
from hoigs.core.model.compose import compose, compose_density, compose_objectives
from hoigs.core.model.scene import SceneModel
from hoigs.core.registry.registry import Registry
from hoigs.core.spec.schema import Spec
from hoigs.core.values.clip import Clip, Frame, FrameStore, OverStore
from hoigs.metrics.psnr import psnr_from_mse
from hoigs.metrics.regions import default_band, dilate, region_masks
from hoigs.studies.needs.search_space import (
    SCORING,
    Kind,
    Overrides,
    Region,
    Score,
    StepBudget,
    as_settings,
)
from hoigs.training.trainer import Trainer

# The clip of a search: some training frames are held back, test frames are sealed.

SELECTION = "selection"  # name of the split


class SealedFrameError(RuntimeError):
    """A test frame was read during the choice of a model."""


class SealedStore(OverStore):
    """Another store, some frames of which cannot be read.

    Args:
        base: the other store. sealed: positions whose frames raise SealedFrameError.
    """

    def __init__(self, base: FrameStore, sealed: Iterable[int]) -> None:
        super().__init__(base)
        self.sealed = frozenset(sealed)

    def _at(self, position: int) -> tuple[FrameStore, int]:
        if position in self.sealed:
            raise SealedFrameError(
                f"frame {position} is a test frame, and a model may not be chosen by it: the "
                "component that read it (an initializer, for example) may read clip.split['train'] "
                "only"
            )
        return self.base, position


def selection_frames(train: Sequence[int], share: float = 0.05, least: int = 3) -> list[int]:
    """Training positions to hold back: a share, at least `least`, evenly spaced, no first or last.

    Raises:
        ClipError: too few training frames to hold any back.
    """
    count = max(least, round(share * len(train)))
    if len(train) < 2 * count + 2:
        raise ClipError(
            f"{len(train)} training frames are too few to hold {count} back: at least "
            f"{2 * count + 2} are needed to choose a model"
        )
    return [sorted(train)[int((k + 0.5) * len(train) / count)] for k in range(count)]


def selection_view(clip: Clip, share: float = 0.05, least: int = 3) -> Clip:
    """`clip` with the frames that are held back moved from the split "train" to "selection".

    It has no "test" split and no held-out view; pixels, masks and depth of all other frames cannot
    be read. Cameras, poses and tracks are unchanged.

    Raises:
        ClipError: as `selection_frames`.
    """
    held = selection_frames(clip.split["train"], share, least)
    train = [p for p in clip.split["train"] if p not in set(held)]
    return replace(sealed_view(clip), split={"train": train, SELECTION: held})


def sealed_view(clip: Clip) -> Clip:
    """`clip` with its training split alone; images, masks and depth of other frames are sealed."""
    sealed = set(range(len(clip))) - set(clip.split["train"])
    return replace(
        clip,
        store=SealedStore(clip.store, sealed),
        split={"train": clip.split["train"]},
        held_out=None,
    )


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
        self._made = spec, registry, device
        with warnings.catch_warnings():
            # few knots on a turning object are what is being tried
            warnings.filterwarnings("ignore", message="the object turns")
            self.model = compose(spec, view, registry).to(device)
        self.trainer = Trainer(
            self.model, view, spec.train, density=compose_density(spec, view, registry),
            objectives=compose_objectives(spec, view, registry),
        )  # fmt: skip
        self.seconds = 0.0

    def on(self, view: Clip) -> Trial:
        """The same trial from its beginning, on a view with other images."""
        spec, registry, device = self._made
        return Trial(spec, view, self.region, self.names, registry, device)

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


# Validator: PSNR of a few frames by region, to measure what pruning costs.

WATCHED = ("human_object", "object", "background")  # a small object is little of the first


@dataclass(frozen=True)
class Scores:
    """Mean PSNR, dB, over the frames that show a region; by region, at least one."""

    psnr: Mapping[str, float]

    def drop_to(self, other: Scores) -> float:
        """How much worse `other` is, dB, in the region where that is most."""
        return max(self.psnr[region] - other.psnr[region] for region in self.psnr)


@dataclass
class Validator:
    """Scores models on validation frames; each scoring is entered in a budget.

    Args:
        clip: at training width. positions: of the frames. budget: in steps of the full spec.
    """

    clip: Clip
    positions: Sequence[int]
    budget: StepBudget

    @property
    def cost(self) -> float:
        """Of one scoring, in steps of the full spec."""
        return SCORING * len(self.positions)

    @property
    def affordable(self) -> bool:
        return self.budget.left >= self.cost

    @torch.no_grad()
    def score(self, model: SceneModel, subset: Bool[Tensor, " N"] | None = None) -> Scores:
        """Render every frame and score it.

        Args:
            subset: rows of the joined Gaussians to render; None renders all.

        Raises:
            HoigsError: no frame shows any region. BudgetError: it exceeds the budget.
        """
        self.budget.spend("scoring", self.cost)
        values: dict[str, list[float]] = {}
        for position in self.positions:
            frame = self.clip[position]
            output = model.render(
                frame.moment.to(model.device),
                frame.camera.to(model.device),
                request=RenderRequest(subset=subset),
            )
            squares = (output.color.cpu().clamp(0, 1) - frame.rgb).square().mean(-1)
            band = default_band(frame.camera.width, frame.camera.height)
            masks = region_masks(frame, self.clip.kinds, band)
            for region in WATCHED:
                if masks[region].any():
                    error = squares[masks[region]].mean()
                    values.setdefault(region, []).append(float(psnr_from_mse(error)))
        if not values:
            raise HoigsError(
                f"frames {list(self.positions)} show neither people, objects nor background: "
                "the model cannot be scored on them"
            )
        return Scores({region: mean(found) for region, found in values.items()})


# A trained model with its spec, and the same model composed anew under a smaller spec.


@dataclass(frozen=True)
class Trained:
    """Input and result of pruning.

    Attributes:
        clip: at training width. model: in eval mode, at the end of its training.
    """

    spec: Spec
    model: SceneModel
    clip: Clip
    registry: Registry

    def blocks(self) -> dict[str, list[str]]:
        """Entities of the model by key of their block in the spec."""
        found: dict[str, list[str]] = {}
        for name in self.model.entities:
            block = self.spec.block(name, self.model.entity(name).kind)
            assert block is not None  # it was composed from this spec
            found.setdefault(block[0], []).append(name)
        return found

    def recomposed(
        self, overrides: Mapping[str, Any], changed: Mapping[str, Tensor] | None = None
    ) -> Trained:
        """The same model composed anew under another spec.

        Args:
            overrides: of the spec. changed: tensors that replace those of the model, by name.
                Tensors that the new model does not have are dropped.

        Raises:
            KeyError: the new model needs a tensor that neither has.
        """
        spec = overridden(self.spec, overrides, self.registry)
        model = compose(spec, self.clip, self.registry).to(self.model.device)
        for name in model.entities:
            model.entity(name).resize(len(self.model.entity(name)))
        state = self.model.state_dict() | dict(changed or {})
        missing = [key for key in model.state_dict() if key not in state]
        if missing:
            raise KeyError(f"the model with {', '.join(overrides)} lacks {', '.join(missing)}")
        model.load_state_dict({key: state[key] for key in model.state_dict()})
        model.eval()
        model.set_progress(1.0)
        return replace(self, spec=spec, model=model)


def overridden(spec: Spec, overrides: Mapping[str, Any], registry: Registry) -> Spec:
    """A spec with some keys set anew, name and summary kept."""
    with tempfile.TemporaryDirectory(prefix="hoigs-spec-") as folder:
        path = Path(folder) / "spec.yaml"
        path.write_text(spec.dump(), encoding="utf-8")
        return Spec.load(path, overrides=as_settings(overrides), registry=registry)


def state_prefix(entity: str) -> str:
    """How an entity's tensors are named in the model's state."""
    return f"entities.{entity}."
