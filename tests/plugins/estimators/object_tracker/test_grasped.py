"""A thing that a hand grasps while no mask of a person says which pixels are the hand's."""

from __future__ import annotations

import numpy as np
from disc_world import H, W

from hoigs.plugins.estimators.object_tracker.footage import bins_of, histogram, lab_of, to_features
from hoigs.plugins.estimators.object_tracker.propagation import own_colors

Y, X = np.mgrid[:H, :W] + 0.5
WALL, SKIN, BROWN, GREEN = (90, 95, 120), (205, 150, 125), (150, 105, 80), (60, 130, 70)


def test_colours_of_the_hand_that_holds_it_are_not_learnt_as_the_object_s() -> None:
    """They were, a little more in each frame, until the mask was the hand."""
    thing = np.hypot(X - 50, Y - 40) < 14
    side, hand = thing & (X < 44), (np.abs(X - 56) < 5) & (Y < 40)
    image = np.broadcast_to(WALL, (H, W, 3)).copy()
    for region, color in ((thing, BROWN), (side, GREEN), (hand, SKIN)):
        image[region] = color
    image += np.random.default_rng(0).integers(-4, 5, image.shape)
    bins = bins_of(to_features(lab_of(np.uint8(image))))
    known = histogram(bins, (thing & ~hand & ~side) * 1.0)
    mask = (thing | (hand & (Y > 24))).astype(np.float32)  # it takes in fingers, of a hand beyond
    before = histogram(bins, mask * 1.0)
    learnt = own_colors(bins, mask, np.ones((H, W), bool), known)
    skin, new = (histogram(bins, region * 1.0) for region in (hand, side))
    assert np.minimum(before, skin).sum() > 0.2
    assert np.minimum(learnt, skin).sum() < 0.05
    assert np.minimum(learnt, new).sum() > 0.15  # a side of the object that was not seen before
