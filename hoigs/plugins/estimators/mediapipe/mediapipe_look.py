"""Read by `mediapipe_script.py`: who is in a frame.

MediaPipe follows one person; its detector finds several, by their faces. People without one are
looked for by its model of landmarks, in squares all over the frame. It imports nothing of hoigs.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from mediapipe_check import UNLIKE, difference, hips_square
from mediapipe_chosen import same
from mediapipe_guided import HEAD, KEPT, SHOULDERS, landmark_graph, score, seen_in, upright

GRAPH = """
input_stream: "image"
output_stream: "detections"
node {
  calculator: "PoseDetectionCpu"
  input_stream: "IMAGE:image"
  output_stream: "DETECTIONS:detections"
}
"""
SQUARES, ROWS = (0.7, 1.1, 1.6), (0.35, 0.7)  # sides and middles of squares, in image heights
SURE, BROAD = 0.9, 0.1  # mean visibility of shoulders and arm, without a face; their distance
MINE = 0.35  # of the square's side from somebody's hips, along the image: it is them
ONE_PLACE = 0.2  # the same between middles of hips: less than people who stand side by side
FAINT = 0.5  # of the sureness of a person without a face: others come first
TILES, OVERLAP = (0.6, 0.35), 0.4  # sides of squares for the detector, in image heights; of a side
CLEAR = 0.85  # of the detector, in such a square: of posts, trunks and leaves it is less sure
ROUND = 2.5  # side of the square about a person, in distances of the detector's two points


class Look:
    """Everybody whom detector and model of landmarks agree on."""

    def __init__(self, complexity) -> None:
        from google.protobuf import text_format
        from mediapipe.framework import calculator_pb2
        from mediapipe.python.solution_base import SolutionBase

        config = text_format.Parse(GRAPH, calculator_pb2.CalculatorGraphConfig())
        self.detector = SolutionBase(graph_config=config)
        self.landmarks = landmark_graph(complexity)

    def people(self, image):
        """How sure, the hips' middle and the side of the square, pixels, of each."""
        found = []
        for sure, *square in self.detected(image):
            seen = seen_in(*self.landmarks, image, square)
            if seen is not None and score(seen[0][:, 3]) >= KEPT and self.real(image, seen, square):
                found.append((sure, *square))
        return found

    def with_small(self, image, found):
        """Those found, and whom `small` finds elsewhere."""
        return found + [
            one for one in self.small(image)
            if not any(same_place(one[1:], other[1:]) for other in found)
        ]  # fmt: skip

    def small(self, image):
        """The same of those whom the detector misses in the whole image, as they are small or it
        takes another: it is shown squares all over it."""
        height, width = image.shape[:2]
        found: list[tuple[float, float, float, float]] = []
        for side in (round(share * height) for share in TILES):
            for x0, y0 in product(starts(width, side), starts(height, side)):
                for sure, x, y, wide in self.detected(image[y0 : y0 + side, x0 : x0 + side]):
                    found.append((sure, x + x0, y + y0, wide))
        kept: list[tuple[float, float, float, float]] = []
        for sure, *square in sorted(found, reverse=True):
            if sure < CLEAR or any(same_place(square, one[1:]) for one in kept):
                continue
            seen = seen_in(*self.landmarks, image, square)
            if seen is None or score(seen[0][:, 3]) < KEPT:
                continue
            square = hips_square(seen[0])  # in which they are followed
            again = seen_in(*self.landmarks, image, square)
            if again is None or not same(seen[0], again[0], square[2]):
                continue
            if self.real(image, again, square) and not any(same_place(square, k[1:]) for k in kept):
                kept.append((sure, *square))
        return kept

    def detected(self, image):
        """How sure, the hips' middle and the side of the square of each that the detector finds."""
        height, width = image.shape[:2]
        found = []
        result = self.detector.process({"image": np.ascontiguousarray(image)})
        for one in result.detections or []:
            points = one.location_data.relative_keypoints[:2]
            hips, rim = (np.array((p.x * width, p.y * height)) for p in points)
            side = ROUND * float(np.linalg.norm(hips - rim))
            found.append((float(one.score[0]), float(hips[0]), float(hips[1]), side))
        return found

    def real(self, image, seen, square) -> bool:
        """Whether what is seen in a square is a person in the mirror, too."""
        return difference(*self.landmarks, image, seen[0], square) < UNLIKE

    def faceless(self, image, found):
        """Likewise those without a face, whom two squares show, and who are none of the found."""
        height, width = image.shape[:2]
        seen: list[tuple[float, float, float, float]] = []
        more: list[tuple[float, float, float, float]] = []
        for side in (s * height for s in SQUARES):
            for x in np.arange(side / 4, width, side / 2):
                for y in (row * height for row in ROWS):
                    one = self.upper_body(image, (float(x), y, side))
                    if one is None or any(near(one, other) for other in (*found, *more)):
                        continue
                    if any(near(one, other) for other in seen):
                        more.append(one)
                    seen.append(one)
        return more

    def upper_body(self, image, square):
        """How sure, middle and side of a square about somebody whose face need not be seen."""
        one = seen_in(*self.landmarks, image, square)
        if one is None or not upright(one[0], head=True):
            return None
        points = one[0].copy()
        points[HEAD, 3] = 0.0
        sure = score(points[:, 3])
        if sure < SURE or np.ptp(points[SHOULDERS, 0]) < BROAD * len(image):
            return None
        if not self.real(image, (points,), square):
            return None
        return FAINT * sure, float(points[SHOULDERS, 0].mean()), square[1], square[2]


def near(one, other) -> bool:
    """Whether two squares are of one person."""
    return abs(one[1] - other[1]) < MINE * max(one[3], other[3])


def same_place(one, other) -> bool:
    """Whether two squares, x and y of the middle and the side, are of one person."""
    apart = np.hypot(one[0] - other[0], one[1] - other[1])
    return bool(apart < ONE_PLACE * max(one[2], other[2]))


def starts(length, side):
    """Where squares of a side begin that cover a length and overlap."""
    count = int(np.ceil(max(0, length - side) / ((1 - OVERLAP) * side))) + 1
    return np.linspace(0, max(0, length - side), count).round().astype(int)
