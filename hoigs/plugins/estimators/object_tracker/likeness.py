"""How much each pixel speaks for a thing that people handle: place, motion and colours together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from hoigs.plugins.estimators.object_tracker.footage import (
    Footage,
    bare_limbs,
    bins_of,
    histogram,
    odds_of,
    usual_torso,
)
from hoigs.plugins.estimators.object_tracker.scene import Scene

WRISTS, FEET = (15, 16), (27, 28, 31, 32)  # among MediaPipe's landmarks
REACH = 0.8  # torsos around the hands in which colours of things are learnt
CHANGED = 6.0  # units of noise by which a pixel differs from the scene


@dataclass(frozen=True)
class Likeness:
    """What is known of one video.

    Attributes:
        people: landmarks of each.
        colors: log-odds of each bin of colours: around the hands against on the body and in the
            scene; None where no hands are known.
        torso: its usual length in pixels (`usual_torso`); NaN where nobody's is known.
    """

    footage: Footage
    scene: Scene
    people: Sequence[Float[np.ndarray, "F 33 4"]]
    colors: Float[np.ndarray, "B"] | None
    torso: float

    @classmethod
    def of(
        cls,
        footage: Footage,
        scene: Scene,
        people: Sequence[Float[np.ndarray, "F 33 4"]],
        frames: Sequence[int],
    ) -> Likeness:
        """Learnt from some frames."""
        torso = usual_torso(people)
        first = cls(footage, scene, people, None, torso)
        body: list[np.ndarray] = []
        around: list[np.ndarray] = []
        scenery: list[np.ndarray] = []
        for i in frames if np.isfinite(torso) else ():
            if not first._seen(i, WRISTS):
                continue
            bins = bins_of(footage.colors(i))
            bare = bare_limbs(footage.shape, [p[i] for p in people], torso) & footage.person[i]
            shown = footage.person[i] | (first._standing_out(i) > 0)
            gap = first._gap(i, WRISTS)
            near = (gap < REACH * torso) & shown
            far = (gap > 2 * REACH * torso) & ~footage.person[i]
            for found, region in ((body, bare), (around, near), (scenery, far)):
                found += [histogram(bins, region * 1.0)] if region.any() else []
        if not body or not around:
            return first
        others = np.maximum(np.mean(body, 0), np.mean(scenery, 0) if scenery else 0)
        colors = odds_of(np.mean(around, 0), others).clip(-2, 2)
        return cls(footage, scene, people, colors, torso)

    def odds(self, i: int) -> Float[np.ndarray, "h w"]:
        """Log-odds of each pixel of a frame."""
        odds = self._standing_out(i)
        if self.colors is not None:
            odds += self.colors[bins_of(self.footage.colors(i))]
        odds[self.footage.blank[i]] = -9
        return odds

    def _standing_out(self, i: int) -> Float[np.ndarray, "h w"]:
        """Log-odds by what differs from the scene and is no limb."""
        person, held = self.footage.person[i], self.footage.held[i]
        away = self.scene.difference(i)
        known = np.isfinite(away)
        moving = np.nan_to_num(away, nan=0.0) > CHANGED
        odds = np.where(moving, 1.5, np.where(known, -3.0, -1.0))
        rim = ndimage.binary_dilation(person, iterations=self.footage.unit) & ~person
        odds[rim] -= 1.5  # masks end a little too early
        within = np.where(held, 1.0, -0.7)
        return np.where(person, within, odds)

    def _seen(self, i: int, marks: Sequence[int]) -> list[Float[np.ndarray, "2"]]:
        """x, y of everybody's landmarks that are seen."""
        return [p[i, k, :2] for p in self.people for k in marks if p[i, k, 3] > 0.3]

    def _gap(self, i: int, marks: Sequence[int]) -> Float[np.ndarray, "h w"]:
        """Pixels to the nearest of some landmarks, or to the person where no hand is seen."""
        height, width = self.footage.shape
        y, x = np.mgrid[:height, :width] + 0.5
        if self._seen(i, WRISTS):
            places = self._seen(i, marks)
            return np.min([np.hypot(x - at[0], y - at[1]) for at in places], axis=0)
        person = self.footage.person[i]
        return (
            ndimage.distance_transform_edt(~person) if person.any() else np.zeros((height, width))
        )

    def nearness(self, i: int) -> Float[np.ndarray, "h w"]:
        """From 1 at the hands and feet, falling with distance: a half at the length of a torso."""
        near = self.torso if np.isfinite(self.torso) else 0.12 * self.footage.diagonal
        return 1 / (1 + (self._gap(i, (*WRISTS, *FEET)) / near) ** 4)
