"""Read by `mediapipe_script.py`: landmarks of a person whom MediaPipe's detector does not find.

That detector looks for a face. Where the frame cuts the head off, the model of landmarks can do
without it if it is shown the square in which the person stands: squares of several sizes and
heights are tried in one frame, and the one whose shoulders and arms are seen best is followed.
It imports nothing of hoigs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from mediapipe_doubts import NARROW, SQUARE, TURNED, UNLIKE, UNSURE, doubt, share_on

SIZES = (0.8, 1.1, 1.5, 2.0)  # sides of the squares, in longer sides of the image
HEIGHTS = (0.2, 0.5, 0.8, 1.1)  # their middles, in heights of the image
SURE = 0.8  # mean visibility of shoulders and of the better arm, for a person to be found;
FAIR, CLOSE = 0.35, 0.08  # or so much, if the pose in the mirror is off by so little;
KEPT = 0.5  # and of one who was clicked on or detected
ON = 0.5  # share of the seen landmarks that lie on the frame's mask of people, to be found there
TRIED = 4  # best squares, each of which is checked
AROUND = ((0.0, 1.0), (0.0, 1.2), (0.0, 1.4), (-0.2, 1.5), (0.0, 0.85))  # squares about the one
# that was found: shift of the middle, down, and side, in its sides
DOUBTED = 2.0  # times as far off in the mirror as others may be: some frames show an arm alone
STEP = 0.5  # doubt, as the mirror's, of shoulders that moved by their distance since they were seen
AGAIN = 15  # frames until a search that found nobody is repeated, or one that was lost is left
SHOULDERS, LEFT, RIGHT, HIPS = [11, 12], [13, 15], [14, 16], [23, 24]
HEAD, LEGS = slice(0, 11), slice(25, 33)
SAME = 0.8  # of the first distance of the shoulders: less is a part of them taken for the whole
FAR = 0.1  # of the square's side: shoulders that moved farther take it with them
LEAST_BROAD = (
    0.08  # of the image's longer side: shoulders closer together are those of no one so near
)
GRAPH = """
input_stream: "image"
input_stream: "square"
input_side_packet: "model_complexity"
input_side_packet: "enable_segmentation"
output_stream: "landmarks"
output_stream: "world"
output_stream: "mask"
node {
  calculator: "PoseLandmarkByRoiCpu"
  input_side_packet: "MODEL_COMPLEXITY:model_complexity"
  input_side_packet: "ENABLE_SEGMENTATION:enable_segmentation"
  input_stream: "IMAGE:image"
  input_stream: "ROI:square"
  output_stream: "LANDMARKS:landmarks"
  output_stream: "WORLD_LANDMARKS:world"
  output_stream: "SEGMENTATION_MASK:mask"
}
"""


class GuidedPose:
    """MediaPipe's model of landmarks in a square that is searched for, then followed.

    Args:
        graph: of `landmark_graph`. rect: makes a square for it, NormalizedRect.
        check: `mediapipe_check.Check`, of the same graph.
    """

    def __init__(self, graph, rect, check) -> None:
        self.graph, self.rect, self.check = graph, rect, check
        self.shoulders: Any = None  # where they were last, pixels; and their middle at the square
        self.placed: Any = None
        self.square: Any = None  # x, y of the middle and side, pixels
        self.around = AROUND[0]  # which of the squares about it showed the person last
        self.broad = 0.0  # distance of the shoulders when the person was found, pixels
        self.wait = 0

    def process(self, image, wide):
        """Landmarks in the image and in space, the person's mask, and what became of the frame, of
        `mediapipe_doubts`; None where nobody is found.

        Landmarks of somebody who is not believed in this frame are NaN.

        Args:
            wide: the frame's mask of people, or None.
        """
        if self.square is not None:
            found, why = self.followed(image, wide)
            if found is not None and not why:
                return self.follow(found)
            self.wait += 1
            if self.wait <= AGAIN:  # another square now would more often be a wrong one
                nothing = np.full((33, 4), np.nan)
                return None if found is None else (nothing, nothing, found[3], why)
            self.square, self.wait = None, 0
        if self.wait:
            self.wait -= 1
            return None
        found = self.chosen(image, self.search(image, wide))
        if found is None:
            self.wait = AGAIN
            return None
        return self.follow(found)

    def earlier(self, frames):
        """What `process` gives for frames before the one in which somebody was found, the latest
        first, as long as they are seen there; the way ahead goes on from the frame found.

        Args:
            frames: images with their masks of people, or None.
        """
        now = self.square, self.around, self.shoulders, self.placed
        for image, wide in frames:
            found, why = self.followed(image, wide)
            if found is None or why:
                break
            yield self.follow(found)
        self.square, self.around, self.shoulders, self.placed = now

    def followed(self, image, wide):
        """What is seen in the square that showed the person last, or in the one about the first
        that leaves the least doubt, and why it is not believed."""
        x, y, side = self.square
        best, why, least = None, UNSURE, np.inf
        for around in (self.around, *(other for other in AROUND if other != self.around)):
            found = self.look(image, wide, (x, y + around[0] * side, around[1] * side))
            if found is None:
                continue
            reason, off, found = self.against(image, found, least)
            if best is None or off < least:
                best, why, least, nearest = found, reason, off, around
            if least < CLOSE:
                break
        if not why:
            self.around = nearest
        return best, why

    def chosen(self, image, tried):
        """The one whose pose is most alike in the mirror, if it is alike; None if none is.

        Shoulders just above the picture are not seen, and others that are seen may be the edge of a
        sleeve: how well they are seen does not tell the right square."""
        near: list[tuple] = []
        for found in [f for f in tried if not f[5] and f[0] >= FAIR][:TRIED]:
            off, found = self.mirrored(image, found)
            if off < (self.check.most if found[0] >= SURE else CLOSE):
                near.append((off, len(near), found))
        return min(near)[2] if near else None

    def mirrored(self, image, found):
        """How far the pose in the mirror is off; what `look` found, with even places."""
        score, points, space, mask, square, why = found
        off, points, space = self.check.seen(image, points, space, square)
        return off, (score, points, space, mask, square, why)

    def against(self, image, found, least):
        """Why somebody who is followed is not believed, 0 if they are; how much is against it, or
        infinite from `least` on: how far the pose in the mirror is off, and how far the shoulders
        moved; and `found`."""
        score, points, *_, why = found
        if why or score < FAIR:
            return why or UNSURE, np.inf, found
        moved = np.linalg.norm(points[SHOULDERS, :2] - self.shoulders, axis=1).mean() / self.broad
        if STEP * moved >= least:
            return UNLIKE, np.inf, found
        off, found = self.mirrored(image, found)
        why = 0 if off < DOUBTED * self.check.most else UNLIKE
        return why, off + STEP * moved, found

    def search(self, image, wide):
        """What is seen in all squares, the best first."""
        height, width = image.shape[:2]
        middle = width / 2 if wide is None else middle_of(wide > 0.5)
        if middle is None:
            return []
        squares = [(middle, y * height, s * max(width, height)) for s in SIZES for y in HEIGHTS]
        looks = (self.look(image, wide, square) for square in squares)
        # anything may look like a person in some square: here, the mask of people has to agree
        tried = [f for f in looks if f is not None and (wide is None or share_on(f[1], wide) >= ON)]
        return sorted(tried, key=lambda f: -f[0])

    def look(self, image, wide, square):
        """Score (0 if they are nobody's), landmarks, places in space, mask, square, and why they
        are nobody's; or None."""
        height, width = image.shape[:2]
        found = seen_in(self.graph, self.rect, image, square)
        if found is None:
            return None
        points, space, mask = found
        broad = np.ptp(points[SHOULDERS, 0])
        near = broad >= max(LEAST_BROAD * max(width, height), SAME * self.broad)
        # the head is out of view: its guess tells a good square, and nothing once one is followed
        why = 0 if near else NARROW
        why = why or (0 if upright(points, head=self.square is None) else TURNED)
        why = why or doubt(points, mask, wide)
        points[HEAD, 3] = 0.0  # one that can be seen is found by the detector
        x, y = points[LEGS, :2].astype(int).clip(0, [width - 1, height - 1]).T
        points[LEGS, 3] *= mask[y, x]  # not on the person: on a table before them
        return 0.0 if why else score(points[:, 3]), points, space, mask, square, why

    def follow(self, found):
        """Keeps the square over the person: it moves with the shoulders, if they move far."""
        _, points, space, mask, square, _ = found
        pair = points[SHOULDERS, :2]
        if self.square is None:
            self.square, self.around, self.placed = square, AROUND[0], pair.mean(0)
            self.broad = self.broad or float(np.ptp(pair[:, 0]))
        x, y, side = self.square
        if np.linalg.norm(pair.mean(0) - self.placed) > FAR * side:
            x, y = np.array((x, y)) + pair.mean(0) - self.placed
            self.placed = pair.mean(0)
        self.square, self.shoulders, self.wait = (x, y, side), pair, 0
        return points, space, mask, SQUARE


def landmark_graph(complexity):
    """MediaPipe's graph of the model of landmarks alone, and what makes a square for it."""
    from google.protobuf import text_format
    from mediapipe.framework import calculator_pb2
    from mediapipe.framework.formats import rect_pb2
    from mediapipe.python.solution_base import SolutionBase

    config = text_format.Parse(GRAPH, calculator_pb2.CalculatorGraphConfig())
    sides = {"model_complexity": complexity, "enable_segmentation": True}
    return SolutionBase(graph_config=config, side_inputs=sides), rect_pb2.NormalizedRect


def seen_in(graph, rect, image, square):
    """Landmarks in the image, places in space and mask of the person in a square; None if none."""
    height, width = image.shape[:2]
    x, y, side = square
    roi = rect(x_center=x / width, y_center=y / height, width=side / width,
               height=side / height, rotation=0.0)  # fmt: skip
    found = graph.process({"image": image, "square": roi})
    if found.landmarks is None or found.mask is None:
        return None
    points, space = rows_of(found.landmarks), rows_of(found.world)
    points[:, :3] *= [width, height, width]
    inside = (points[:, :2] >= 0).all(1) & (points[:, :2] < [width, height]).all(1)
    points[:, 3] *= inside  # what lies outside is supposed, not seen
    return points, space, np.array(found.mask)


def upright(points, *, head: bool) -> bool:
    """Whether the shoulders are above the hips, and, with `head`, the head above the shoulders."""
    shoulders, hips = points[SHOULDERS, 1].mean(), points[HIPS, 1].mean()
    return bool(shoulders < hips and (not head or points[0, 1] < shoulders))


def score(visibility) -> float:
    """Mean visibility of the shoulders and the arm that is seen better."""
    arm = max(visibility[LEFT].mean(), visibility[RIGHT].mean())
    return float((visibility[SHOULDERS].mean() + arm) / 2)


def middle_of(mask):
    """Mean x of a mask; None if it is empty."""
    columns = mask.sum(0)
    return float(np.average(np.arange(len(columns)), weights=columns)) if columns.any() else None


def rows_of(found):
    return np.array([[p.x, p.y, p.z, p.visibility] for p in found.landmark])
