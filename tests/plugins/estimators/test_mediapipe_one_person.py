"""Landmarks that leap from one person to another are of the one whom most frames show."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hoigs.core.interfaces.estimator import EntityRequest, Estimates, PromptError, VideoRequest
from hoigs.plugins.estimators.mediapipe.estimator import MediapipeEstimator
from hoigs.plugins.estimators.mediapipe.one_person import someone_else

FRAMES, WIDTH, HEIGHT = 60, 320, 240


def walking(x: float, side: float, count: int = FRAMES) -> np.ndarray:
    """Landmarks of somebody who walks to the right, a pixel a frame."""
    spread = np.random.default_rng(0).uniform(-side / 2, side / 2, (33, 2))
    image = np.ones((count, 33, 4))
    image[..., :2] = spread
    image[..., 0] += x + np.arange(count)[:, None]
    image[..., 1] += 120
    return image


def test_a_large_bystander_is_someone_else_and_so_is_one_of_the_same_size_elsewhere() -> None:
    seen = walking(100, 80)
    seen[20:35] = walking(90, 220)[20:35]
    assert np.flatnonzero(someone_else(seen)).tolist() == list(range(20, 35))
    seen[20:35] = walking(190, 80)[20:35]
    assert someone_else(seen).sum() == 15


def test_one_person_who_is_lost_for_a_while_or_mistaken_for_a_moment_is_one() -> None:
    seen = walking(100, 80)
    seen[20:35] = np.nan
    seen[50:53] = walking(190, 80)[50:53]
    assert not someone_else(seen).any()
    mistaken = [5, 12, 13, 40, 44, 58]  # now and then in the same way, which is nobody
    seen[mistaken] = walking(190, 80)[mistaken]
    assert not someone_else(seen).any()
    assert not someone_else(np.full((4, 33, 4), np.nan)).any()


class Leaping(MediapipeEstimator):
    """Goes over to a large bystander for 15 frames, unless it is told whom to follow.

    Attributes:
        followed: frames in which the person is found again who is followed.
    """

    followed = FRAMES

    def _by_looks(self, video, given, progress) -> None:
        return None

    def _run(self, python, out, order, chosen, video, progress, look=False) -> None:
        out.parent.mkdir(parents=True, exist_ok=True)
        json.dumps(chosen)  # as the script is told
        points = walking(100, 80)
        if chosen is None:
            points[20:35] = walking(90, 220)[20:35]
        elif not self.followed:
            raise PromptError("no person is found there")
        else:
            points[self.followed :] = np.nan
        np.savez(
            out, image_xyzv=np.float32(points[None]), world_xyzv=np.float32(points[None]),
            fate=np.zeros((1, FRAMES), np.uint8),
        )  # fmt: skip

    def _python(self, video) -> Path:
        return Path("python")


@pytest.mark.parametrize(("followed", "seen"), [(FRAMES, 60), (20, 45), (0, 45)])
def test_they_are_followed_or_others_are_left_out(tmp_path: Path, followed: int, seen: int) -> None:
    estimator = Leaping(Leaping.Config(masks=False))
    video = VideoRequest(
        FRAMES, WIDTH, HEIGHT, lambda i: np.zeros((HEIGHT, WIDTH, 3), np.uint8), tmp_path, tmp_path,
        entities=(EntityRequest("human", "human"),),
    )  # fmt: skip
    whole = estimator.estimate(video)
    assert isinstance(whole, Estimates) and whole.landmarks is not None
    estimator.followed = followed
    for file in tmp_path.glob("*.npz"):
        file.unlink()
    image = estimator.estimate(video).landmarks["human"].image_xyzv
    known = image[np.isfinite(image[:, 0, 0])]
    assert len(known) == seen and np.ptp(known[..., 1], axis=1).max() < 100
