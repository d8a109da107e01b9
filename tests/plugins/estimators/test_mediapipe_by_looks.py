"""Whether the person is followed as a few looks show them, or by MediaPipe's detector."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hoigs.core.interfaces.estimator import EntityRequest, PromptError, VideoRequest
from hoigs.plugins.estimators.mediapipe.estimator import LOOKS, MediapipeEstimator

FRAMES, WIDTH, HEIGHT = 80, 320, 240
NOTHING = np.zeros((HEIGHT, WIDTH, 3), np.uint8)


class Followed(MediapipeEstimator):
    """Finds who walks to the right, a pixel a frame; `looks` are at these frames' places.

    Attributes:
        seen: places of looks that show them. beside: of looks that show somebody else, too.
        astray: from which frame on the way leads elsewhere. lost: frames without landmarks.
    """

    seen, beside, astray, lost = range(LOOKS + 1), range(0), FRAMES, range(0)

    def _run(self, python, out, order, chosen, video, progress, look=False) -> None:
        out.parent.mkdir(parents=True, exist_ok=True)
        if look:
            rows = [(k, 0.9, 100 + order[k], 120, 150) for k in self.seen]
            rows += [(k, 0.8, 280, 120, 150) for k in self.beside]
            np.savez(out, people=np.array(rows, np.float32).reshape(-1, 5))
            return
        points = np.zeros((1, FRAMES, 33, 4), np.float32)
        points[..., 3] = 1
        points[0, :, :, 0] = 100 + np.arange(FRAMES)[:, None]
        points[0, :, :, 1] = 120
        points[0, self.astray :, :, 0] += 90
        points[0, list(self.lost)] = np.nan
        if chosen is None:
            points[..., 1] = 77  # the detector's
        elif self.astray < 0:
            raise PromptError("no person is found there: 0 of human")
        fate = np.zeros((1, FRAMES), np.uint8)
        np.savez(out, image_xyzv=points, world_xyzv=points, fate=fate)

    def _python(self, video) -> Path:
        return Path("python")


def found(tmp_path: Path, **fields: object) -> np.ndarray:
    estimator = Followed(Followed.Config(masks=False))
    for name, value in fields.items():
        setattr(estimator, name, value)
    video = VideoRequest(
        FRAMES, WIDTH, HEIGHT, lambda i: NOTHING, tmp_path, tmp_path,
        entities=(EntityRequest("human", "human"),),
    )  # fmt: skip
    return estimator.estimate(video).landmarks["human"].image_xyzv


@pytest.mark.parametrize(
    ("fields", "by_looks"),
    [
        ({}, True),
        ({"seen": range(6)}, True),
        ({"seen": range(5)}, False),  # too few show anybody
        ({"beside": range(2)}, False),  # two people: which of them is said elsewhere
        ({"beside": range(1)}, True),  # seen once, a coat
        ({"lost": range(10)}, True),
        ({"lost": range(20)}, False),
        ({"astray": 70}, True),
        ({"astray": 40}, False),  # the way leads to something else
        ({"astray": -1}, False),  # nobody is found again in the square
    ],
)
def test_the_way_that_looks_agree_with_is_taken(
    tmp_path: Path, fields: dict[str, object], by_looks: bool
) -> None:
    middle = np.nanmedian(found(tmp_path, **fields)[..., 1])
    assert middle == (120 if by_looks else 77)
