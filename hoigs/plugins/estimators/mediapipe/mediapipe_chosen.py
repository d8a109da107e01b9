"""Read by `mediapipe_script.py`: landmarks of the one of several people whom the user clicked on.

MediaPipe's detector takes whom it likes. Its model of landmarks is therefore shown the square
about the person clicked on, found in that frame and followed from there (`mediapipe_people.py`).
As in MediaPipe's own graph the next square is that about the hips with all limbs, guessed ones too:
one about those that are seen leaves out legs behind a table, sees less, and is smaller again.
It imports nothing of hoigs.
"""

from __future__ import annotations

import numpy as np
from mediapipe_check import hips_square
from mediapipe_guided import KEPT, score, seen_in

SIZES = (0.4, 0.6, 0.9, 1.3, 1.8)  # sides of the squares, in longer sides of the image
SHIFTS = (-0.3, 0.0, 0.3)  # of the click from their middles, in sides: up, on and down the person
ON = 0.5  # of the person's own mask, at a click
SEEN = 0.5  # visibility
MARGIN = 1.25  # of a box about them, the first square
STEADY = 0.5  # share of its last side that a square keeps
WIDER = (1.0, 1.4)  # sides in which someone who is lost is looked for
SAME = 0.08  # in sides, mean distance of landmarks of one and the same person
JUMP, GROWTH = 0.35, 1.6  # in sides, from frame to frame: what moves or grows more is someone else


class ChosenPose:
    """MediaPipe's model of landmarks in the square about one person.

    Args:
        graph, rect: of `landmark_graph`.
        prompts: by number of a frame: points (x, y, on the person or not) and a box
            (x0, y0, x1, y1) or None, pixels of the images here.
    """

    def __init__(self, graph, rect, prompts) -> None:
        self.graph, self.rect, self.prompts = graph, rect, prompts
        self.square = (0.0, 0.0, 0.0)  # x, y of the middle and side, pixels: until it is found
        self.first: tuple[float, float, float] | None = None

    def prompted(self, number, image):
        """The next square, and landmarks in the image and in space and the mask of the person at
        the frame's prompt.

        Raises:
            LookupError: nobody is found there; its one argument ends with `number`.
        """
        found = self.search(image, *self.prompts[number])
        if found is None:
            raise LookupError(f"no person is found there: {number}")
        return found

    def followed(self, image):
        """The same of the person in the square; None where they are lost."""
        x, y, side = self.square
        found = None
        for wider in WIDER:
            found = self.look(image, (x, y, wider * side))
            if found is None:
                continue
            x1, y1, side1 = hips_square(found[0])
            if np.hypot(x1 - x, y1 - y) < JUMP * side and 1 / GROWTH < side1 / side < GROWTH:
                break
            found = None
        if found is None:
            return None
        return (x1, y1, STEADY * side + (1 - STEADY) * side1), found

    def take(self, square):
        """This is where the person is."""
        self.square = square
        self.first = self.first or square

    def restart(self):
        """Goes back to where the person was found first."""
        if self.first is not None:
            self.square = self.first

    def search(self, image, points, box):
        """The next square, and what is seen in the one with the best person on the prompt."""
        inside = [(x, y) for x, y, on in points if on]
        outside = [(x, y) for x, y, on in points if not on]
        if box is not None:
            x0, y0, x1, y1 = box
            squares = [((x0 + x1) / 2, (y0 + y1) / 2, MARGIN * max(x1 - x0, y1 - y0))]
        else:
            x, y = np.mean(inside, axis=0)
            sides = [s * max(image.shape[:2]) for s in SIZES]
            squares = [(x, y - shift * side, side) for side in sides for shift in SHIFTS]
        best = None
        for square in squares:
            found = self.look(image, square)
            if found is None or not self.agrees(found[2], inside, outside):
                continue
            # the same once more, in the square that it will be followed in
            closer = self.look(image, hips_square(found[0]))
            if closer is None or not self.agrees(closer[2], inside, outside):
                if box is None:
                    continue
                closer = found  # seen in the box that was drawn about them
            value = closer[0][:, 3].mean()  # more of the person
            if best is None or value > best[0]:
                best = value, hips_square(closer[0]), closer
        return None if best is None else best[1:]

    def agrees(self, mask, inside, outside) -> bool:
        """Whether a mask has the points that it should have, and not the others."""

        def at(points):
            columns, rows = np.array(points).reshape(-1, 2).astype(int).T
            height, width = mask.shape[:2]
            return mask[rows.clip(0, height - 1), columns.clip(0, width - 1)] > ON

        return bool(at(inside).all() and not at(outside).any())

    def look(self, image, square):
        """What is seen in a square; None if it is nobody."""
        found = seen_in(self.graph, self.rect, image, square)
        if found is None or score(found[0][:, 3]) < KEPT or (found[0][:, 3] > SEEN).sum() < 4:
            return None
        return found


def same(points, others, side) -> bool:
    """Whether landmarks are of one person, by those that are seen in both."""
    both = (points[:, 3] > SEEN) & (others[:, 3] > SEEN)
    if both.sum() < 4:
        return False
    return bool(np.linalg.norm((points - others)[both, :2], axis=1).mean() < SAME * side)
