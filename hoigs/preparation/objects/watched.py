"""What poses by texture start from: the frames that show an object, cut out, and its hands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from hoigs.preparation.mask_stack import Outlines, outlines_of
from hoigs.preparation.objects.alignment import Crops, make_crops
from hoigs.preparation.objects.filmed import Filmed
from hoigs.preparation.objects.hands import HandMotion, along_bones, hand_motion, no_hands

FEWEST = 8  # frames that show the object whole
SMALLEST = 10  # pixels across, median
FAINTEST, BLUR = 0.02, 2.5  # relative contrast of texture; pixels of a crop it is blurred by
BEHIND = 0.5  # of its radius behind the hands: from there on the person hides nothing of it
SIDE = 96  # of the crops, pixels


class UntrackableError(Exception):
    """Why an object's rotation cannot be found from its texture."""


@dataclass(frozen=True)
class Watched:
    """An object in the frames that show it; radius: metres within which it lies, about."""

    filmed: Filmed
    outlines: Outlines
    hands: HandMotion
    crops: Crops
    radius: float


def watched(filmed: Filmed) -> Watched:
    """Raises:
    UntrackableError: too few frames, too small, always cut by the border, or no texture.
    """
    cameras, outlines = filmed.cameras, outlines_of(filmed.masks)
    _check(outlines)
    bones = torch.zeros(len(cameras), 0, 3)
    if filmed.joints is not None:
        hands = hand_motion(filmed.joints, filmed.masks, outlines, cameras, filmed.fps)
        bones = along_bones(filmed.joints, filmed.parents)
    else:
        assert filmed.depths is not None
        hands = no_hands(outlines, filmed.depths, cameras, filmed.fps)
    # metres within which the object lies, from the largest extent of its outlines
    rows = np.flatnonzero(outlines.whole)
    metres = [
        outlines.lengths[i] * hands.depths[i] / float(cameras[i].K[0, 0]) for i in rows.tolist()
    ]
    radius = 0.9 * float(np.quantile(metres, 0.95))
    crops = make_crops(filmed, outlines.observed, SIDE, bones, hands.depths + BEHIND * radius)
    contrast = crops.contrast(BLUR)
    if contrast < FAINTEST:
        raise UntrackableError(
            f"it has hardly any texture: its brightness varies by {100 * contrast:.1f} % "
            f"({100 * FAINTEST:.0f} % are needed)"
        )
    return Watched(filmed, outlines, hands, crops, radius)


def _check(outlines: Outlines) -> None:
    whole = int(outlines.whole.sum())
    if whole < FEWEST:
        raise UntrackableError(
            f"{whole} frames show it whole, and {FEWEST} are needed: it is seen too briefly, or "
            "the border of the image cuts it"
        )
    across = float(np.median(np.sqrt(outlines.areas[outlines.whole])))
    if across < SMALLEST:
        raise UntrackableError(f"it is {across:.0f} pixels across, and {SMALLEST} are needed")
