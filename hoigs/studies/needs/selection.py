"""The clip of a search: some training frames are held back, test frames are sealed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from hoigs.core.errors import ClipError
from hoigs.core.values.clip import Clip, FrameStore

SELECTION = "selection"  # name of the split


class SealedFrameError(RuntimeError):
    """A test frame was read during the choice of a model."""


class SealedStore(FrameStore):
    """Another store, some frames of which cannot be read.

    Args:
        base: the other store. sealed: positions whose frames raise SealedFrameError.
    """

    def __init__(self, base: FrameStore, sealed: Iterable[int]) -> None:
        self.base, self.sealed = base, frozenset(sealed)
        self.root = base.root

    def _open(self, position: int) -> FrameStore:
        if position in self.sealed:
            raise SealedFrameError(
                f"frame {position} is a test frame, and a model may not be chosen by it: the "
                "component that read it (an initializer, for example) may read clip.split['train'] "
                "only"
            )
        return self.base

    def image(self, position: int) -> UInt8[Tensor, "H W 3"]:
        return self._open(position).image(position)

    def mask(self, entity: str, position: int) -> Bool[Tensor, "H W"]:
        return self._open(position).mask(entity, position)

    def depth(self, position: int) -> Float[Tensor, "H W"] | None:
        return self._open(position).depth(position)

    def ignored(self, position: int) -> Bool[Tensor, "H W"] | None:
        return self._open(position).ignored(position)

    def mask_known(self, entity: str, position: int) -> bool:
        return self._open(position).mask_known(entity, position)


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
