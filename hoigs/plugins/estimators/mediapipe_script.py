"""Run by the Python of an environment with mediapipe; it imports nothing of hoigs.

Reads RGB frames from standard input and writes one .npz file: image_xyzv and world_xyzv
[N, 33, 4], NaN where no person is found; and, if masks are wanted, `person`, the bits of boolean
masks [N, H, ceil(W / 8)], their `size`, and `several` [N], whether other people are seen.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

PADDING = 0.5  # of the height, above: a detector of faces finds people whose head is cut off
MARGIN = 1.25  # of the person's box, the second look at the person's mask
CREDIBLE = 0.5  # share of the seen landmarks that have to lie on the person's mask
TALL = 0.3  # height of the landmarks in heights of the mask, below which they are of something else
SEEN = 0.5  # visibility
OTHER, ELSEWHERE = 0.25, 0.2  # of the largest part's area; of a part, that is the person's own
AROUND, EDGE = 0.01, 0.2  # in longer sides and of 1: about a person's own mask
SOFT = 1 / 640  # of the longer side: standard deviation by which the person's mask is smoothed


def main() -> None:
    sys.path.append(str(Path(__file__).parent))  # last: -I leaves it out, nothing there may shadow
    try:
        import cv2
        import mediapipe
    except ImportError as error:
        sys.exit(f"this Python has no mediapipe: {error}")
    settings = json.loads(sys.argv[1])
    width, height, count = settings["width"], settings["height"], settings["count"]
    factor = min(1.0, settings["longest"] / max(width, height))
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    finder = Finder(cv2, mediapipe.solutions, settings, size[0] / width)
    for i in range(count):
        pixels = sys.stdin.buffer.read(height * width * 3)
        if len(pixels) != height * width * 3:
            sys.exit(f"frame {i} of {count} did not come")
        image = np.frombuffer(pixels, np.uint8).reshape(height, width, 3)
        if factor < 1:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        try:
            finder.add(i, np.ascontiguousarray(image))
        except LookupError as error:
            sys.exit(str(error))
    with Path(settings["out"]).open("wb") as out:
        np.savez_compressed(out, size=np.array(size), **finder.arrays(width / size[0]))


class Finder:
    """Landmarks and masks, frame by frame."""

    def __init__(self, cv2, solutions, settings, factor) -> None:
        self.cv2, self.masks = cv2, settings["masks"]
        pose = {**settings["pose"], "enable_segmentation": self.masks, "smooth_segmentation": False}
        self.whole, self.padded = solutions.pose.Pose(**pose), solutions.pose.Pose(**pose)
        self.selfie: Any = None
        self.close: Any = None
        if self.masks:
            self.selfie = solutions.selfie_segmentation.SelfieSegmentation(model_selection=0)
            self.close = solutions.selfie_segmentation.SelfieSegmentation(model_selection=0)
        self.guided: Any = None  # made where it is needed
        self.complexity = settings["pose"]["model_complexity"]
        self.following = False  # a person whom `guided` found and the detector does not
        self.rows: dict[str, list] = {"image_xyzv": [], "world_xyzv": []}
        self.person: list[np.ndarray] = []
        self.several: list[bool] = []  # whether others are seen beside the person followed
        self.chosen: Any = None
        if settings["person"] is not None:
            from mediapipe_chosen import ChosenPose
            from mediapipe_guided import landmark_graph

            prompts = {
                number: (
                    [(factor * x, factor * y, on) for x, y, on in points],
                    None if box is None else [factor * c for c in box],
                )
                for number, points, box in settings["person"]["prompts"]
            }
            back = settings["person"]["back"]
            self.chosen = ChosenPose(*landmark_graph(self.complexity), prompts, back)

    def add(self, number, image) -> None:
        wide = None if self.selfie is None else self.selfie.process(image).segmentation_mask
        if self.chosen is None:
            image_xyzv, world_xyzv, own = self.landmarks(image, wide)
        else:
            nothing = np.full((33, 4), np.nan)
            found = self.chosen.process(number, image) or (nothing, nothing, None)
            image_xyzv, world_xyzv, own = found
        self.rows["image_xyzv"].append(image_xyzv)
        self.rows["world_xyzv"].append(world_xyzv)
        if wide is None:
            return
        if self.chosen is not None:
            self.keep(image, np.zeros_like(wide) if own is None else self.of_one(image, wide, own))
            return
        if self.following and own is not None:
            self.several.append(False)
            self.keep(image, own)  # segmentation of selfies takes tables in where there is no head
            return
        self.several.append(own is not None and self.another(wide, own))
        if self.several[-1]:
            self.keep(image, self.of_one(image, wide, own))
            return
        near = self.near(image, wide > 0.5)
        mean = wide if near is None else (wide + near) / 2
        person = mean if own is None else (2 * mean + own) / 3
        self.keep(image, person)

    def keep(self, image, person) -> None:
        # cells of the models are several pixels wide: without this, edges are stairs
        person = self.cv2.GaussianBlur(person, (0, 0), max(1.0, SOFT * max(image.shape)))
        self.person.append(np.packbits(person > 0.5, axis=1))

    def another(self, wide, own) -> bool:
        """Whether the mask of people has a large part that is not of the person followed."""
        count, parts, stats, _ = self.cv2.connectedComponentsWithStats(np.uint8(wide > 0.5))
        areas = stats[:, self.cv2.CC_STAT_AREA]
        large = [i for i in range(1, count) if areas[i] >= OTHER * areas[1:].max()]
        return any((own[parts == i] > 0.5).mean() < ELSEWHERE for i in large)

    def of_one(self, image, wide, own):
        """The mask of one of several people: of the segmentations of all, what lies at their own
        one, which knows them apart and is coarse. Each may miss a part of them, or, in the whole
        image, one without a head altogether: a pixel needs one of both."""
        around = self.cv2.GaussianBlur(own, (0, 0), max(1.0, AROUND * max(image.shape))) > EDGE
        near = self.near(image, own > 0.5)
        people = wide if near is None else np.maximum(wide, near)
        return (2 * np.where(around, people, 0) + own) / 3

    def landmarks(self, image, wide):
        """In the image and in space, and the mask of their person; looked for a second time with a
        border above the image where they are not found, as with a head out of view, and then
        without the detector (mediapipe_guided.py)."""
        if self.following and (found := self.guided.process(image, wide)) is not None:
            return found
        self.following = False
        height, width = image.shape[:2]
        border = round(PADDING * height)
        for pose, above in ((self.whole, 0), (self.padded, border)):
            padded = self.cv2.copyMakeBorder(
                image, above, 0, 0, 0, self.cv2.BORDER_REPLICATE
            )  # fmt: skip
            found = pose.process(padded)
            if found.pose_landmarks is None:
                continue
            # z is in the scale of x
            points = points_of(found.pose_landmarks) * [width, height + above, width, 1.0]
            points[:, 1] -= above
            if not credible(points, wide):
                pose.reset()
                continue
            own = found.segmentation_mask
            own = None if own is None else own[above:]
            return points, points_of(found.pose_world_landmarks), own
        if self.guided is None:
            from mediapipe_guided import GuidedPose, landmark_graph

            self.guided = GuidedPose(*landmark_graph(self.complexity), credible)
        if (found := self.guided.process(image, wide)) is not None:
            self.following = True
            return found
        nothing = np.full((33, 4), np.nan)
        return nothing, nothing, None

    def near(self, image, inside):
        """The mask of a picture of the person alone, which shows more detail."""
        box = box_of(inside, MARGIN)
        if box is None:
            return None
        x0, y0, x1, y1 = box
        part = np.zeros(inside.shape, np.float32)
        cut = np.ascontiguousarray(image[y0:y1, x0:x1])
        part[y0:y1, x0:x1] = self.close.process(cut).segmentation_mask
        return part

    def arrays(self, scale):
        """What is written; `scale`: pixels of the video a pixel of the images here."""
        rows = {name: np.array(found, np.float32) for name, found in self.rows.items()}
        rows["image_xyzv"][..., :3] *= scale
        if self.masks:
            rows["person"] = np.array(self.person)
            rows["several"] = np.array(self.several or [False] * len(self.person))
        return rows


def credible(points, wide) -> bool:
    """Whether landmarks are of the masked person: most of those seen are on it, and not on a small
    thing, such as a mug, that was taken for a person."""
    if wide is None:
        return True
    rows = np.flatnonzero((wide > 0.5).any(1))
    if not len(rows):
        return True
    seen = points[points[:, 3] > SEEN, :2]
    inside = seen[(seen >= 0).all(1) & (seen[:, 0] < wide.shape[1]) & (seen[:, 1] < wide.shape[0])]
    if len(inside) < 4:
        return False
    x, y = inside.astype(int).T
    tall = np.ptp(inside[:, 1]) >= TALL * (rows[-1] - rows[0])
    return bool(tall and (wide[y, x] > 0.5).mean() >= CREDIBLE)


def box_of(mask, margin):
    """x0, y0, x1, y1 of a square about a mask, within the image; None if it is empty."""
    if not mask.any():
        return None
    ys, xs = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    half = margin * max(np.ptp(ys), np.ptp(xs), 8) / 2
    x, y = (xs[0] + xs[-1]) / 2, (ys[0] + ys[-1]) / 2
    height, width = mask.shape
    return (
        int(max(0, x - half)), int(max(0, y - half)),
        int(min(width, x + half + 1)), int(min(height, y + half + 1)),
    )  # fmt: skip


def points_of(found):
    return np.array([[p.x, p.y, p.z, p.visibility] for p in found.landmark])


if __name__ == "__main__":
    main()
