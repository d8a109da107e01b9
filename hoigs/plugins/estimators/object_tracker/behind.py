"""An object against what is behind it: the scene, and people who keep still."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.footage import Footage, Window, bins_of, histogram
from hoigs.plugins.estimators.object_tracker.prompts import PromptedMask, walked
from hoigs.plugins.estimators.object_tracker.scene import StaticScene, scene_behind

ROUNDS = 4
UNKNOWN = 0.3  # share of the object's pixels of which the scene without people says nothing
AROUND = 0.8  # of the object's radius: so much beside its mask may be its own
SURE = 4.0  # largest log-odds
STILL = 0.9  # how probable it is that what is not the object is what was there before
PEAK = 0.3  # share of a colour's own bin among those that differ from it by noise alone


@dataclass(frozen=True)
class Behind:
    """What an object that is known roughly passes in front of.

    Attributes:
        scene: what was there while the object was elsewhere, people who keep still included.
    """

    footage: Footage
    scene: StaticScene

    @classmethod
    def of(
        cls, footage: Footage, scene: StaticScene, masks: Bool[np.ndarray, "F h w"]
    ) -> Behind | None:
        """None where the scene without people says enough."""
        seen = np.flatnonzero(masks.any((1, 2)))
        some = seen[:: max(1, len(seen) // 24)]
        hidden = [np.isnan(scene.difference(i)[masks[i]]).mean() for i in some]
        if not hidden or np.mean(hidden) < UNKNOWN:
            return None
        radius = float(np.sqrt(masks[seen].sum((1, 2)).mean() / np.pi))
        return cls(footage, scene_behind(footage, masks, AROUND * radius))

    def odds(
        self,
        i: int,
        window: Window,
        colors: Float[np.ndarray, "n n 3"],
        inside: Float[np.ndarray, "B"],
        outside: Bool[np.ndarray, "n n"],
    ) -> Float[np.ndarray, "n n"]:
        """Log-odds of a window's pixels: the object's colours against those of the place, and of
        all else that moves `outside` it. NaN where the place is never seen."""
        away = window.cut(self.scene.difference(i))
        spread = window.cut(self.scene.spread, outside=1.5)
        bins = bins_of(colors)
        moved = np.nan_to_num(1 - np.exp(-((away / 3) ** 2) / 2))
        others = histogram(bins, outside * moved)[bins]
        # the wider colours vary at a place, the less one of them says
        same = PEAK * np.exp(-(away**2) / 2) * (1.5 / spread) ** 3
        rest = STILL * same + (1 - STILL) * others
        return np.log((inside[bins] + 2e-4) / (rest + 2e-4)).clip(-SURE, SURE)

    def regrown(self, prompt: PromptedMask) -> PromptedMask:
        """A prompted mask with all that is connected to it and was not there before."""
        soft = prompt.soft
        for _ in range(ROUNDS):
            y, x = np.nonzero(soft > 0.5)
            half = 1.1 * max(np.ptp(x), np.ptp(y)) + 4
            window = Window.around((x.min() + x.max() + 1) / 2, (y.min() + y.max() + 1) / 2, half)
            soft = window.paste(self._grown(prompt, window, window.cut(soft)), soft.shape)
            soft = soft / np.float32(255)
            if not (soft > 0.5).any():
                return prompt
        return replace(prompt, soft=soft)

    def _grown(self, prompt: PromptedMask, window: Window, soft: np.ndarray) -> np.ndarray:
        colors = window.cut(self.footage.colors(prompt.frame))
        valid = window.inside(self.footage.shape)
        mask = soft > 0.5
        apart = ndimage.distance_transform_edt(~mask)
        inside = histogram(bins_of(colors), np.where(mask, soft, 0))
        odds = self.odds(prompt.frame, window, colors, inside, (apart > 2) & valid)
        radius = np.sqrt(mask.sum() / np.pi)
        depth = ndimage.distance_transform_edt(mask)
        place = np.where(mask, np.minimum(depth / 4, 1), -0.3 - 0.2 * apart / radius)
        odds = np.where(np.isnan(odds), 3 * place, odds) + place
        odds = np.where(valid & (window.cut(prompt.barred) < 0.5), odds, -9)
        grown = walked(odds, colors)
        labels, _ = ndimage.label(grown > 0.5)
        own = np.bincount(labels.ravel(), mask.ravel() * 1.0)
        own[0] = 0
        whole = filled(labels == own.argmax())
        return np.where(whole, np.maximum(grown, 0.6), np.where(labels > 0, 0, grown))


def filled(mask: Bool[np.ndarray, "n n"], largest: float = 0.03) -> Bool[np.ndarray, "n n"]:
    """A mask without its holes, but those that are `largest` of it or more."""
    holes, _ = ndimage.label(ndimage.binary_fill_holes(mask) & ~mask)
    big = np.bincount(holes.ravel()) > largest * mask.sum()
    big[0] = True
    return mask | ~big[holes]
